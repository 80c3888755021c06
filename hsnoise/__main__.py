"""`python -m hsnoise` is the command line."""

import sys

from hsnoise.cli.main import main

sys.exit(main())
