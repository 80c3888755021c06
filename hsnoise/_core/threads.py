"""The same work on many items, on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor


def in_threads(function: Callable, arguments: Iterable, tick: Callable[[], None] = lambda: None) -> list:
    """`function(argument)` for each, on all cores; results in order. NumPy and JAX release Python's lock."""

    def one(argument):
        result = function(argument)
        tick()
        return result

    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
        return list(pool.map(one, arguments))
