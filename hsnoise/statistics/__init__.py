"""The statistics by which captures are compared: structure, three-dimensional decomposition, single pixels.

They treat measured frames and a model's draws alike and know nothing of models. May import `_core`, `frames` and, for
what proposals of effects ask of a capture, `effects`.
"""
