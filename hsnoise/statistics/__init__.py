"""What a capture is compared by: statistics of its structure, the three-dimensional decomposition, single pixels.

The same for measured frames and draws of a model, of which nothing is known here. May import `_core`, `frames` and, for
what proposals of effects ask of a capture, `effects`.
"""
