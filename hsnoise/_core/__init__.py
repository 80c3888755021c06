"""What everything stands on: types, random keys, checked arguments, threads, compiling, whole files.

Knows nothing of cameras. Imports no other package of hsnoise.
"""
