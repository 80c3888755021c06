"""The same work on many items, on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

from threadpoolctl import ThreadpoolController


def number_of_threads() -> int:
    """How many `in_threads` uses."""
    return min(os.cpu_count() or 1, 8)


def in_threads(function: Callable, arguments: Iterable) -> list:
    """`function(argument)` for each, on all cores; results in order. NumPy and JAX release Python's lock."""
    # BLAS with threads of its own beside ours would wait for cores that are taken: ten times slower on small matrices.
    with _libraries().limit(limits=1, user_api="blas"), ThreadPoolExecutor(number_of_threads()) as pool:
        return list(pool.map(function, arguments))


@lru_cache(maxsize=1)
def _libraries() -> ThreadpoolController:
    """The thread pools of the libraries in this process; looking for them takes milliseconds."""
    return ThreadpoolController()
