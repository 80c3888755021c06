"""The command line: options, progress, what is printed and what is written.

May import everything. `hsnoise.cli.main` is the door.
"""
