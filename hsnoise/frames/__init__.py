"""Captures: `FrameStack`, frames read one at a time, Bayer orders, checks of counts, the example that is shipped.

May import `_core`.
"""
