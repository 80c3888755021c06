"""The base of every package: types, random keys, checked arguments, threads, compiling, atomic files.

Knows nothing of cameras. Imports no other package of hsnoise.
"""
