"""Captures: `FrameStack`, frames read one at a time, Bayer orders, checks of counts, the shipped example.

May import `_core`.
"""
