"""Effects that may be missing from a model, as they propose themselves for a capture.

An amplitude of 1 is a modest effect; details that a user cannot know (period, corner, number of taps) vary from draw
to draw, so that an effect is recognised whatever they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from hsnoise._core.arguments import listed
from hsnoise._core.types import RandomKey, channel_index
from hsnoise.effects import (
    ADC,
    EFFECTS,
    AbstractEffect,
    CaptureFacts,
    DarkCurrent,
    Gain,
    Maker,
    ReadNoise,
    ShotNoise,
)
from hsnoise.fitting.pixel_fit import PixelFit
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import black_level_of, check_effects, check_fits, draw_capture, light_of
from hsnoise.simulation.portion import Portion
from hsnoise.simulation.simulator import Purpose, key_for
from hsnoise.statistics.panels import may_be_outputs
from hsnoise.statistics.pixels.comb import comb_in
from hsnoise.statistics.pixels.row_groups import row_groups_in
from hsnoise.statistics.pixels.waves import over_first, waves_in
from hsnoise.statistics.structure import Structure, code_step, moving_line, places, structure

SHORT_SHARE = 0.02  # of the longest exposure: a bias frame, or nearly
LINE_DRAWS = 6  # of the model, which has no spectral lines of its own
TINY_ERROR = 1e-9  # of statistics whose scatter only draws can show

Suspect = AbstractEffect | type[AbstractEffect]  # what a user may pass


def facts_of(model: NoiseModel, portion: Portion, seed: RandomKey | int, pixel: PixelFit | None = None) -> CaptureFacts:
    """What effects need to know about a capture and its fitted model to propose themselves.

    pixel: what a fit that follows each pixel over time has measured; None for other fits.
    """
    part = portion.frames
    darks = [i for i, kind in enumerate(part.kind) if kind == "dark"]
    exposures_s = {float(part.exposure_s[i]) for i in darks}
    longest = max(exposures_s)
    key = key_for(seed, Purpose.LINES)
    drawn = [draw_capture(jax.random.fold_in(key, number), model, part) for number in range(LINE_DRAWS)]
    facts = CaptureFacts(
        effects=model.names,
        cfa=model.cfa,
        shutter=part.shutter,
        read_noise_e=float(model["read_noise"].sigma),
        dark_e_per_s=float(model["dark_current"].rate) if "dark_current" in model else 0.0,
        gain=np.asarray(model["gain"].value, float),
        frames=max(part.n_frames[i] for i in darks),
        longest_s=max(longest, 1e-9),
        has_exposure=longest > 0,
        has_bias=min(exposures_s) < SHORT_SHARE * longest,
        exposures_differ=len(exposures_s) > 1,
        levels=len(exposures_s) + part.n_exposures - len(darks),
        light_e=max(float(light_of(model, part, i).mean()) for i in range(part.n_exposures)),
        line=moving_line(part, drawn, black_level_of(model)),
        waves=over_first(waves_in(part)),
        may_be_outputs=may_be_outputs(part, drawn),
        places=places(part),
        code_step=code_step(part),
        comb=None if (comb := comb_in(part)) is None else (comb.sigma, tuple(comb.errors.tolist())),
        row_groups=row_groups_in(part),
    )
    return facts if pixel is None else replace(facts, pixels_followed=True, coupled=pixel.coupled)


def built_in(facts: CaptureFacts) -> dict[str, Maker]:
    """Effects that a capture can show and the model lacks: name to maker, which takes amplitude and generator."""
    return proposed((effect for effect in EFFECTS if effect.name not in facts.effects), facts)


def proposed(effects: Iterable[Suspect], facts: CaptureFacts) -> dict[str, Maker]:
    """Makers by name: of classes as they propose themselves, if the capture can show them; of instances by `given`."""
    makers: dict[str, Maker] = {}
    for effect in effects:
        if isinstance(effect, AbstractEffect):
            makers[effect.name] = given(effect)
        elif facts.frames >= effect.least_frames and (maker := effect.propose(facts)) is not None:
            makers[effect.name] = maker
    return makers


def can_be_proposed(effect: type[AbstractEffect]) -> bool:
    """Whether a class has a `propose` of its own."""
    return effect.propose.__func__ is not AbstractEffect.propose.__func__


def given(effect: AbstractEffect) -> Maker:
    """The maker of an effect instance: it scales the amplitudes that are not held.

    If the effect marks none, it scales parameters that may be 0 and have no upper bound, or else those that may be 0.
    """
    specs = effect.specs()
    may_be_zero = {name for name, spec in specs.items() if spec.low == 0}
    scaled = {name for name, spec in specs.items() if spec.amplitude and spec.held is not True}
    if not any(spec.amplitude for spec in specs.values()):
        scaled = {name for name in may_be_zero if specs[name].high is None} or may_be_zero

    def make(amplitude: float, rng: np.random.Generator) -> AbstractEffect:
        values = {name: np.asarray(getattr(effect, name)) for name in specs}
        values |= {name: specs[name].scaled(values[name], amplitude) for name in scaled}
        return type(effect)(**values, **effect.settings())

    return make


def made(maker: Maker, amplitude: float, detail: int) -> AbstractEffect:
    """The effect at an amplitude, with details number `detail`."""
    return maker(amplitude, np.random.default_rng(detail))


def check_candidates(candidates: Any) -> tuple[Suspect, ...]:
    """The candidates of a user. Raises TypeError unless they are effects, ValueError for two with the same name."""
    if isinstance(candidates, AbstractEffect) or _is_effect_class(candidates):
        raise TypeError(f"candidates: expected a list of effects, got one effect, {candidates.name}")
    candidates = listed("candidates", candidates, "a list of effects")
    for effect in candidates:
        if _is_effect_class(effect) and not can_be_proposed(effect):
            raise TypeError(
                f"candidates: expected effects that are instances, or classes with a propose; {effect.__name__} is a"
                " class without one"
            )
        if not isinstance(effect, AbstractEffect) and not _is_effect_class(effect):
            raise TypeError(f"candidates: expected effects (of AbstractEffect), got {effect!r}")
    names = [effect.name for effect in candidates]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise ValueError(f"candidates: {', '.join(sorted(twice))} given more than once")
    return candidates


def _is_effect_class(candidate: Any) -> bool:
    return isinstance(candidate, type) and issubclass(candidate, AbstractEffect)


def check_makers(
    candidates: tuple[Suspect, ...], model: NoiseModel, like: FrameStack, facts: CaptureFacts
) -> dict[str, Maker]:
    """Makers of a user's candidates, by name, without those that the capture cannot show.

    Raises TypeError if `propose` makes another kind of effect, ValueError if its draws are not a sensor's signal.
    """
    makers = proposed(candidates, facts)
    for one in candidates:
        if one.name in makers:
            effect = made(makers[one.name], 1.0, 0)
            if getattr(effect, "name", None) != one.name:
                raise TypeError(f"candidates: expected {one.name}.propose to make {one.name} effects, got {effect!r}")
            check_effects(model.add(effect), like)
    return makers


def not_in(model: NoiseModel, candidates: tuple[Suspect, ...]) -> tuple[Suspect, ...]:
    """The candidates. Raises ValueError for one that the model has."""
    for effect in candidates:
        if effect.name in model:
            raise ValueError(f"candidates: {effect.name} is in the model already")
    return candidates


def with_own_statistics(model: NoiseModel, candidates: Iterable[Suspect]) -> Callable[[FrameStack], Structure] | None:
    """A function for the statistics of a capture and those that a user's effects define; None if none defines any.

    These are measured for each dark exposure, in a group named after the effect.
    """
    own = [one for one in candidates if one.statistics.__func__ is not AbstractEffect.statistics.__func__]
    black = black_level_of(model)

    def measure(stack: FrameStack) -> Structure:
        found, added = structure(stack, black), []
        black_map = black[channel_index(model.cfa, stack.shape)]
        for i in (i for i, kind in enumerate(stack.kind) if kind == "dark"):
            above = np.stack(list(stack.frames(i))).astype(np.float32) - black_map
            for effect in own:
                for what, value in effect.statistics(above).items():
                    if not np.isfinite(value):
                        raise ValueError(f"{effect.name}: expected finite statistics, {what} is {value}")
                    added.append((effect.name, f"{effect.name}: {what}, {stack.exposure_s[i]:g} s, {i}", float(value)))
        if not added:
            return found
        groups, names, values = zip(*added, strict=True)
        return replace(
            found,
            names=(*found.names, *names),
            groups=(*found.groups, *groups),
            values=np.concatenate([found.values, values]),
            error=np.concatenate([found.error, np.full(len(values), TINY_ERROR)]),
        )

    return measure if own else None


def check_start(model: NoiseModel | None, candidates: tuple[Suspect, ...], portion: Portion, seed: int) -> None:
    """Raise ValueError or TypeError for a model or candidates that cannot be drawn."""
    if not candidates:
        return
    stack = portion.frames
    typical = [ShotNoise(), DarkCurrent(50.0), ReadNoise(3.0), Gain(1.0), ADC()]
    base = NoiseModel(typical, cfa=stack.cfa, shutter=stack.shutter, exposure_s=0.1) if model is None else model
    check_fits(base, stack, "model")
    check_makers(not_in(base, candidates), base, stack, facts_of(base, portion, seed))
