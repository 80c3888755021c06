"""Signals that several draws have in common, as far as their models, keys and light are the same."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

import jax
import numpy as np


class Shared:
    """What was drawn more than once, by all that it follows from: most signals never come again.

    For one thread.
    """

    def __init__(self) -> None:
        self._once: set[Hashable] = set()
        self._again: dict[Hashable, Any] = {}

    def get(self, name: Hashable, draw: Callable[[], Any]) -> Any:
        """What `draw` returns, or returned before by this name."""
        if name in self._again:
            return self._again[name]
        drawn = draw()
        if name in self._once:
            self._again[name] = drawn
        self._once.add(name)
        return drawn


def identity(tree: Any) -> Hashable:
    """What two PyTrees of concrete arrays have in common that hold the same."""
    leaves, form = jax.tree.flatten(tree)
    return form, tuple(_bytes(leaf) for leaf in leaves)


def _bytes(leaf: Any) -> Hashable:
    if isinstance(leaf, jax.Array) and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf).tobytes()
