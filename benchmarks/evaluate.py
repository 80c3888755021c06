"""Score a trained enhancer: the command `hsnoise evaluate`, by default with output to build/evaluate.

python -m benchmarks.evaluate build/train/weights.eqx --clips FOLDER
"""

from __future__ import annotations

import sys

from hsnoise.cli import main as cli


def main(argv: list[str] | None = None) -> None:
    """Run the command; raises SystemExit if it fails."""
    code = cli.main(["evaluate", "--out", "build/evaluate", *(sys.argv[1:] if argv is None else argv)])
    if code:
        sys.exit(code)


if __name__ == "__main__":
    main()
