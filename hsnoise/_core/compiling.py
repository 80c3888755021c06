"""Compiling large programs that run often, and small ones that hardly do."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any

import equinox as eqx
import jax


def jit_lean(function: Callable) -> Callable:
    """`equinox.filter_jit` without XLA's fusion emitters for CPUs, for functions that no other program calls.

    Without them the likelihood runs as fast and compiles in half the time and memory. JAX refuses these options
    inside another program, so do not use this for functions that users may trace.
    """

    @cache
    def compiled():  # at the first call, not on import: asking for the options starts a backend
        jit: Any = eqx.filter_jit  # its type does not mention compiler_options
        return jit(function, compiler_options=lean_options())

    return wraps(function)(lambda *arguments: compiled()(*arguments))


def jit_quick(function: Callable, static_argnums: tuple[int, ...]) -> Callable:
    """`jax.jit` for programs that run some dozen times: on CPUs they compile in a third of the time, and run as fast
    or a tenth slower. They cannot be part of another program, as those of `jit_lean`.
    """

    @cache
    def compiled():
        options: Any = {}
        if jax.default_backend() == "cpu" and lean_options():
            options = {**lean_options(), "xla_backend_optimization_level": 1, "xla_cpu_parallel_codegen_split_count": 1}
        return jax.jit(function, static_argnums=static_argnums, compiler_options=options)

    return wraps(function)(lambda *arguments: compiled()(*arguments))


@cache
def lean_options() -> dict[str, bool]:
    """XLA's options for lean programs; none in versions (0.12 and later) that do not know them."""
    options = {"xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:  # a version of XLA that does not know them
        return {}
    return options
