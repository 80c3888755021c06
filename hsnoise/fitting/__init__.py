"""How fits are made: maximum likelihood, the paper's line fit, fits pixel by pixel, by simulation; results and notes.

`hsnoise.fit` is the door. May import `simulation`, `likelihood`, `hsnoise.lut` and what these may.
"""
