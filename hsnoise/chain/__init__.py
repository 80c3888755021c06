"""From light to counts: photometry, the arrival of electrons, one effect after the other, effects as JSON.

May import `_core`, `frames` and `effects`. `hsnoise.model` is its door.
"""
