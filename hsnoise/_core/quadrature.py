"""Nodes and weights of quadrature rules, made once: a search asks for the same ones thousands of times."""

from __future__ import annotations

from functools import lru_cache

import numpy as np


@lru_cache
def normal_nodes(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Hermite nodes and weights, of sum 1, for means over a standard normal variable; read-only."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(number)
    weights /= weights.sum()
    for array in (nodes, weights):
        array.flags.writeable = False
    return nodes, weights
