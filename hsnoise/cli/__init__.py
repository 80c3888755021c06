"""The command line: options, progress, printed pages and written files.

May import everything. `hsnoise.cli.main` is the entry point.
"""
