"""Train the video enhancer: the command `hsnoise train`, by default with output to build/train.

python -m benchmarks.train --preset cpu --clips FOLDER
"""

from __future__ import annotations

import sys

from hsnoise.cli import main as cli


def main(argv: list[str] | None = None) -> None:
    """Run the command; raises SystemExit if it fails."""
    code = cli.main(["train", "--out", "build/train", *(sys.argv[1:] if argv is None else argv)])
    if code:
        sys.exit(code)


if __name__ == "__main__":
    main()
