"""Readers, one file format a module, and how files are sorted into a capture: `load`.

May import `_core` and the modules of `frames` beside it.
"""
