"""The enhancer around the network of `hsnoise.stlstm`: its weights, video in and out, training.

May import `simulation`, `hsnoise.model`, `hsnoise.stlstm` and what these may import; nothing that fits.
"""
