"""Judge a trained enhancer: the command `hsnoise evaluate`, which writes to build/evaluate unless told otherwise.

python -m benchmarks.evaluate build/train/weights.eqx --clips FOLDER
"""

from __future__ import annotations

import sys

from hsnoise.cli import main as cli


def main(argv: list[str] | None = None) -> None:
    """Run the command; raises SystemExit where it does not end well."""
    code = cli.main(["evaluate", "--out", "build/evaluate", *(sys.argv[1:] if argv is None else argv)])
    if code:
        sys.exit(code)


if __name__ == "__main__":
    main()
