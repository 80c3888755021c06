"""`python -m hsnoise` is the command line."""

import sys

from hsnoise.cli import main

sys.exit(main())
