"""What a signal goes through in the sensor: one effect after the other."""

from __future__ import annotations

import dataclasses
from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._keys import named_key
from hsnoise.arrivals import Arrivals
from hsnoise.effects import AbstractEffect, Stage


def apply_by_effect(key, light, shape, effects, capture):
    """What leaves the last effect, [frame, row, column]; each is compiled by itself."""
    return reduce(lambda _, step: step[1], signals(key, light, shape, effects, capture), jnp.broadcast_to(light, shape))


def signals(key, light, shape, effects, capture):
    """Each effect and what leaves it, in turn, where `light` (e-, of `shape` or a scalar) falls on the sensor.

    Raises ValueError, naming the effect, for one that returns no signal of this shape.
    """
    scales = [_read_noise_scale(key, effect, capture, shape) for effect in effects if _may_scale(effect)]
    scales = [scale for scale in scales if scale is not None]
    if scales:
        capture = dataclasses.replace(capture, read_noise_scale=reduce(jnp.multiply, scales))
    signal = light
    for effect in effects:
        try:
            drawn = _sample_one(key, signal, shape, effect, capture)
        except Exception as error:
            error.add_note(f"in the sample of the effect {effect.name}")
            raise
        if drawn is None:
            raise ValueError(f"{effect.name}: its sample returned None, expected the signal; is a return missing?")
        if np.shape(drawn) != shape:
            raise ValueError(f"{effect.name}: its sample returned shape {np.shape(drawn)}, expected {shape}.")
        if jnp.iscomplexobj(drawn):
            raise ValueError(f"{effect.name}: its sample returned complex numbers, expected real ones.")
        if jnp.issubdtype(drawn.dtype, jnp.integer) and effect.acts_at < Stage.DIGITAL:
            drawn = drawn.astype(jnp.result_type(light, jnp.float32))  # whole electrons; those after it expect floats
        signal = drawn
        yield effect, signal


apply_in_one = partial(jax.jit, static_argnums=2)(apply_by_effect)


def apply_fenced(key, light, shape, effects, capture):
    """As `apply_in_one`, within a larger program. On CPUs XLA would merge the draws with what is done before and after
    (mosaic, demosaicking), and compute them slowly and several times: as the branch of a condition they stay whole.
    """

    def draw(key, light, effects, capture):
        return apply_in_one(key, light, shape, effects, capture)

    def fenced(*of):
        counts = jax.eval_shape(draw, *of)
        always = jax.lax.optimization_barrier(jnp.asarray(True))
        return jax.lax.cond(always, draw, lambda *_: jnp.zeros(counts.shape, counts.dtype), *of)

    return jax.lax.platform_dependent(key, light, effects, capture, cpu=fenced, default=draw)


def _may_scale(effect: AbstractEffect) -> bool:
    return type(effect).read_noise_scale is not AbstractEffect.read_noise_scale


@partial(jax.jit, static_argnums=3)
def _read_noise_scale(key, effect, capture, shape):
    return effect.read_noise_scale(capture, shape, key=named_key(key, effect.name))


@partial(jax.jit, static_argnums=2)
def _sample_one(key, signal, shape, effect, capture):
    own = named_key(key, effect.stream or effect.name)
    if isinstance(effect, Arrivals):
        return effect.expose(signal, shape, capture, key=own)
    return effect.sample(jnp.broadcast_to(signal, shape), capture, key=own)
