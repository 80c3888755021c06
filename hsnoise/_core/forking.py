"""Forked processes: the threads of JAX do not live on in them, and work that waits for those would wait for ever."""

from __future__ import annotations

import os

from jax._src import xla_bridge  # no public name says whether JAX has started

_is_without_threads = False


def check_not_forked() -> None:
    """Raise RuntimeError in a process that was forked after JAX had started."""
    if _is_without_threads:
        raise RuntimeError(
            "this process was forked after JAX had started, whose threads it lacks, so that it would wait for ever;"
            ' start processes by multiprocessing.get_context("spawn") or "forkserver", or before JAX starts'
        )


def _after_fork() -> None:
    global _is_without_threads
    _is_without_threads = xla_bridge.backends_are_initialized()


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_after_fork)
