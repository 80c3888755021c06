"""Settings of the tests of effects."""

from __future__ import annotations

import jax
import pytest


@pytest.fixture(autouse=True, scope="module")
def compile_quickly():
    """Hundreds of programs run once on few pixels: compiling them with all optimisations takes twice as long."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
