"""The likelihood of a model: row histograms and flats in a `Summary`, integrals over row gains, parameters.

May import `_core`, `frames`, `effects`, `chain`, `statistics` and `hsnoise.model`.
"""
