"""From light to counts: photometry, the arrival of electrons, the chain of effects, effects as JSON.

May import `_core`, `frames` and `effects`. Its public module is `hsnoise.model`.
"""
