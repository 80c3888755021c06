"""Readers, one module per file format, and `load`, which sorts files into a capture.

May import `_core` and the other modules of `frames`.
"""
