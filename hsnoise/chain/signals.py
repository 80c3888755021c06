"""Passing a signal through the sensor's effects, one after the other."""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable
from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.compiling import jit_quick
from hsnoise._core.keys import named_key
from hsnoise._core.types import NotDeclared
from hsnoise.chain.arrivals import Arrivals
from hsnoise.chain.shared import Shared, identity
from hsnoise.effects import AbstractEffect, Stage

SCALES = ("read_noise_scale", "dark_current_scale")  # the ways in which an effect scales what another draws


def apply_by_effect(key, light, shape, effects, capture, shared=None, *, quick=False):
    """The signal after the last effect, [frame, row, column]; each effect is compiled separately. See `signals`."""
    steps = signals(key, light, shape, effects, capture, shared, quick=quick)
    return reduce(lambda _, step: step[1], steps, jnp.broadcast_to(light, _whole(capture, shape)))


def signals(key, light, shape, effects, capture, shared: Shared | None = None, *, quick=False):
    """Each effect in turn with the signal after it, where `light` (e-, of `shape` or a scalar) falls on the sensor.

    Several exposures are drawn together if `capture.exposure_s` is [exposure]: their keys, light and signals have this
    axis first (a scalar stands for all), and each is as it would be alone. What they have in common is drawn once.
    shared: what other draws may have in common with this one; quick: whether effects are compiled quickly, which is
    impossible inside another program. Raises ValueError, naming the effect, if an effect does not return a signal of
    this shape.
    """
    factor, sample_one = QUICK if quick else THOROUGH
    whole = _whole(capture, shape)
    once = _Anew() if shared is None else _Once(shared, (identity((key, light, capture)), shape))
    scales = {what: _scale_of(what, key, effects, capture, shape, once, factor) for what in SCALES}
    of_light = _scale_of("light_scale", key, effects, capture, shape, once, factor)
    capture = dataclasses.replace(capture, **scales)
    signal = light if of_light is None else jnp.broadcast_to(light, whole) * of_light
    seen = {scales: _seen_with(capture, scales) for scales in {effect.scaled_by for effect in effects}}
    for effect in effects:
        try:
            drawn = once.after(effect, partial(sample_one, key, signal, shape, effect, seen[effect.scaled_by]))
        except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
            raise TypeError(
                f"{effect.name}: JAX cannot compile its sample; use jax.numpy instead of numpy, jnp.where instead of if"
            ) from error
        except Exception as error:
            error.add_note(f"in the sample of the effect {effect.name}")
            raise
        if drawn is None:
            raise ValueError(f"{effect.name}: its sample returned None, expected the signal; is a return missing?")
        if not isinstance(drawn, jax.Array):
            raise ValueError(f"{effect.name}: its sample returned a {type(drawn).__name__}, expected one array.")
        if np.shape(drawn) != whole:
            got = np.shape(drawn)[len(whole) - len(shape) :]
            raise ValueError(f"{effect.name}: its sample returned shape {got}, expected {shape}.")
        if jnp.iscomplexobj(drawn) or drawn.dtype == bool:
            kind = "booleans" if drawn.dtype == bool else "complex numbers"
            raise ValueError(f"{effect.name}: its sample returned {kind}, expected real numbers.")
        if jnp.issubdtype(drawn.dtype, jnp.integer) and effect.acts_at < Stage.DIGITAL:
            drawn = drawn.astype(jnp.result_type(light, jnp.float32))  # whole electrons; the next effects expect floats
        signal = drawn
        yield effect, signal


apply_in_one = partial(jax.jit, static_argnums=2)(apply_by_effect)


def apply_fenced(key, light, shape, effects, capture):
    """As `apply_in_one`, inside a larger program. On CPUs XLA would fuse the draws with the steps before and after
    (mosaic, demosaicking) and compute them slowly and repeatedly; as a branch of a condition they stay separate.
    """

    def draw(key, light, effects, capture):
        return apply_in_one(key, light, shape, effects, capture)

    def fenced(*of):
        counts = jax.eval_shape(draw, *of)
        always = jax.lax.optimization_barrier(jnp.asarray(True))
        return jax.lax.cond(always, draw, lambda *_: jnp.zeros(counts.shape, counts.dtype), *of)

    return jax.lax.platform_dependent(key, light, effects, capture, cpu=fenced, default=draw)


def _seen_with(capture, scales):
    """The capture with these scales alone: the program of an effect is then the same whatever others scale."""
    unused = [what for what in SCALES if what not in scales]
    return dataclasses.replace(capture, **{what: NotDeclared(what) for what in unused})


def may_scale(what: str, effect: AbstractEffect) -> bool:
    """Whether an effect scales what another draws; `what` is one of SCALES."""
    return getattr(type(effect), what) is not getattr(AbstractEffect, what)


class _Anew:
    """Draws everything."""

    def factor(self, what, effect, draw):
        return draw()

    def after(self, effect, draw):
        return draw()


class _Once:
    """Draws what is not `shared` yet. A signal follows from `start`, the factors and the effects up to here."""

    def __init__(self, shared: Shared, start: Hashable):
        self.shared, self.start = shared, start
        self.factors: dict[str, tuple] = {}
        self.trail: Hashable = start

    def factor(self, what, effect, draw):
        of = (what, identity(effect))
        self.factors[what] = (*self.factors.get(what, ()), of)
        return self.shared.get((self.start, of), draw)

    def after(self, effect, draw):
        used = (*effect.scaled_by, *(["light_scale"] if self.trail is self.start else []))
        self.trail = self.trail, identity(effect), tuple(self.factors.get(what) for what in used)
        return self.shared.get(self.trail, draw)


def _scale_of(what, key, effects, capture, shape, once, factor):
    """Product of all effects' factors on the read noise or dark current of each pixel; None: 1."""
    factors = [
        once.factor(what, effect, partial(factor, what, key, effect, capture, shape))
        for effect in effects
        if may_scale(what, effect)
    ]
    factors = [factor for factor in factors if factor is not None]
    return reduce(jnp.multiply, factors) if factors else None


def _factor(what, key, effect, capture, shape):
    def draw(key, _, capture):
        return getattr(effect, what)(capture, shape, key=named_key(key, effect.name))

    return _each(draw, key, None, capture)


def _sample_one(key, signal, shape, effect, capture):
    def draw(key, signal, capture):
        own = named_key(key, effect.stream or effect.name)
        if isinstance(effect, Arrivals):
            return effect.expose(signal, shape, capture, key=own)
        return effect.sample(jnp.broadcast_to(signal, shape), capture, key=own)

    return _each(draw, key, signal, capture)


FORMS = ((_factor, (0, 4)), (_sample_one, (2,)))
THOROUGH = tuple(jax.jit(form, static_argnums=static) for form, static in FORMS)
QUICK = tuple(jit_quick(form, static) for form, static in FORMS)


def _each(draw, key, signal, capture):
    """What `draw` makes of the capture's only exposure, or of each."""
    if np.ndim(capture.exposure_s) == 0:
        return draw(key, signal, capture)
    scales = {what: getattr(capture, what) for what in SCALES}
    own = {what: scale for what, scale in scales.items() if isinstance(scale, jax.Array)}

    def one(key, signal, exposure_s, own):
        return draw(key, signal, dataclasses.replace(capture, exposure_s=exposure_s, **own))

    return jax.vmap(one, (0, 0 if np.ndim(signal) else None, 0, 0))(key, signal, capture.exposure_s, own)


def _whole(capture, shape):
    """Shape of the signals of all exposures of a capture whose frames have `shape` each."""
    return (*np.shape(capture.exposure_s), *shape)
