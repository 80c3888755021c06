"""A model closed with measured components: what no effect explains is measured, and drawn like any other effect.

The maps of this sensor take the place of the effects that draw the pattern of any sensor of the make. What changes from
frame to frame stays with the named effects as far as they are right; the rest is measured, by the difference between
measured frames and frames drawn from the model, until they agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from hsnoise._core.arguments import seed_of
from hsnoise._core.keys import named_key
from hsnoise._core.types import RandomKey, cfa_tile
from hsnoise.criticism import sentences, shares
from hsnoise.criticism.compare import Comparison, compared
from hsnoise.criticism.held_out import with_flats
from hsnoise.criticism.measured_curve import with_response
from hsnoise.criticism.measured_light import with_photo_response
from hsnoise.criticism.measured_maps import Sensor
from hsnoise.criticism.measured_noise import (
    ALLOWED,
    capture_like,
    mean_power,
    misfit,
    of_axis,
    with_distribution,
    with_hits,
    with_read_noise,
    with_shot_noise,
    with_spectra,
    with_spread,
)
from hsnoise.criticism.shares import Share
from hsnoise.effects import Stage
from hsnoise.frames.source import as_stack
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.defects import MOST, defects
from hsnoise.simulation.draws import check_fits, draw_capture
from hsnoise.simulation.portion import Portion, usable_flats
from hsnoise.simulation.simulator import Purpose, key_for
from hsnoise.statistics.apart import FEWEST_FRAMES, Apart
from hsnoise.statistics.pixels.narrow import Narrow, is_narrow, narrow_from_posterior
from hsnoise.statistics.structure import OF_FLATS

NEEDED = ("gain", "read_noise")
MOST_COUNTS = 1 << 26  # of an exposure in memory; of larger ones the first frames
COURSE = "frame_settling"  # of a run: it is the same in drawn frames
ROUNDS = 4  # draws that bring the model nearer


@dataclass(frozen=True)
class ClosedModel:
    """A model closed with measured components.

    Attributes:
        params: the NoiseModel, for `hsnoise.sample`, `save`, ...
        named: the model that was closed.
        replaced: its effects that the maps of this sensor, the distribution and the hits stand for.
        overshot: its effects that drew more than there is, in whose place the spectra were measured whole.
        shares: of each component of the noise budget, explained by names or only by measured components.
        static: a sentence on the effects that are most of the static variance.
        comparison: with frames that it was not made from, or with those that it was made from if there are no others;
            before: that of the model that was closed, with the same frames.
    """

    params: NoiseModel
    named: NoiseModel
    replaced: tuple[str, ...]
    overshot: tuple[str, ...]
    shares: tuple[Share, ...]
    static: str
    comparison: Comparison
    before: Comparison

    @property
    def helps(self) -> bool:
        """Whether all groups of statistics together come nearer than with the named effects alone.

        Where most counts clip, maps cannot be measured. The error is of the worst group, which may be one that neither
        model describes.
        """
        return self.comparison.total < self.before.total

    @property
    def largest_unexplained(self) -> Share | None:
        """The component of which the largest part of the whole variance is unexplained beyond chance, if any."""
        return shares.largest_unexplained(self.shares)

    @property
    def summary(self) -> str:
        """How near the closed model comes, in a sentence."""
        return sentences.closed(self.comparison.error, self.before.error, self.largest_unexplained)

    def __str__(self) -> str:
        replaced = sentences.replaced(self.replaced, self.overshot)
        return "\n".join(one for one in (self.summary, shares.printed(self.shares), self.static, replaced) if one)

    __repr__ = __str__


def closed(
    model: Any,
    stack: Any,
    *,
    held_out: FrameStack | None = None,
    before: Sequence[int] = (),
    seed: int = 0,
    **keywords,
) -> ClosedModel:
    """Close a model with what is measured of one sensor: the best realism, and a measure of how much names explain.

    Args:
        model: a fit, or a NoiseModel with a gain and read noise.
        stack: frames from which components are measured: a path or a list of paths, with the keywords of
            `hsnoise.load`; a FrameStack; or an array of counts with FrameStack's keywords. Darks of two frames or more
            are used, flats of two frames or more for the response of each pixel, and flats of five levels or more for
            the response of all.
        held_out: other darks of the same sensor, to judge by, beside the flats; None: the frames themselves.
        before: for each exposure of `held_out`, how many frames of its series come before it, by which a level that
            settles is told; default: none.
        seed: of all draws.

    Raises:
        FileNotFoundError, TypeError, ValueError: what `load` or `FrameStack` refuse; a model that does not fit the
            stack; no dark exposure of two frames.
    """
    params, seed = getattr(model, "params", model), seed_of("seed", seed)
    stack = as_stack(stack, **keywords)
    check_fits(params, stack, "model")
    missing = [name for name in NEEDED if name not in params]
    if missing:
        raise ValueError(f"model: expected a model with {' and '.join(NEEDED)}, this one lacks {', '.join(missing)}")
    darks, flats = repeated_darks(stack), _flats(stack)
    in_series = any(effect.in_series for effect in params)
    judge, bad = _judge(darks if held_out is None else held_out, before if in_series else (), flats)
    with jax.enable_x64(True):
        closing = _Closing.of(darks, params, seed)
        models = [closing.nearer(start) for start in closing.starts(params)]
    if len(models) > 1:
        models = [min(models, key=lambda model: compared(_sound(model, bad), judge.darks, seed=seed).total)]
    with jax.enable_x64(True):
        models = closing.with_light(models[0], stack, flats)
    found, comparison = _nearest(models, judge, bad, seed)
    key = key_for(seed, Purpose.SHARES)
    gone = [effect for effect in params if effect.name not in found]
    replaced = tuple(effect.name for effect in gone if effect.measurable or effect.stage == Stage.LIGHT)
    return ClosedModel(
        params=found,
        named=params,
        replaced=replaced,
        overshot=tuple(effect.name for effect in gone if effect.name not in replaced),
        shares=shares.shares_of(params, judge.darks.frames, key, closed=found, before=judge.darks.before),
        static=_static(params, judge.darks.frames, key, replaced),
        comparison=comparison,
        before=compared(params, judge, seed=seed),
    )


def _nearest(models: list[NoiseModel], judge: Portion, bad: np.ndarray, seed: int) -> tuple[NoiseModel, Comparison]:
    """The model whose flats are nearest to those of `judge`, and its comparison."""
    found = [(model, compared(_sound(model, bad), judge, seed=seed)) for model in models]
    return min(found, key=lambda one: sum(one[1].groups.get(group, 0.0) for group in OF_FLATS.values()))


def _judge(darks: FrameStack, before: Sequence[int], flats: FrameStack | None) -> tuple[Portion, np.ndarray]:
    """The frames to judge by, and their defects [row, column]."""
    if before and len(before) != darks.n_exposures:
        raise ValueError(f"before: expected a number for each of {darks.n_exposures} exposures held out, got {before}")
    ahead = [before[i] for i in darks.repeated_darks] if before else []
    judging = repeated_darks(darks)
    judging = judging if flats is None else with_flats(judging, flats)
    ahead += [0] * (judging.n_exposures - len(ahead)) if ahead else []
    return Portion.of(judging, before=tuple(ahead)), _defects(judging)


def _defects(stack: FrameStack) -> np.ndarray:
    """Pixels [row, column] that a comparison leaves out: few that are stuck or dead."""
    counts = [np.stack(list(stack.frames(i))) for i in range(stack.n_exposures)]
    bad = defects(counts, stack.kind, len(cfa_tile(stack.cfa)))
    return bad & (bad.mean() <= MOST)


def _sound(model: NoiseModel, bad: np.ndarray) -> NoiseModel:
    """The model with usual pixels in place of bad ones, for which neighbours stand in where frames are compared."""
    if not bad.any():
        return model
    usual = jax.tree.map(lambda of: np.where(bad, np.median(of), of).astype(of.dtype), model["measured_map"])
    return model.add(usual)


def repeated_darks(stack: FrameStack) -> FrameStack:
    """The dark exposures of two frames or more. Raises ValueError without any."""
    if not stack.repeated_darks:
        raise ValueError("stack: expected two frames or more of a dark exposure, to tell what stays from what changes")
    return _in_memory(stack, stack.repeated_darks)


def _flats(stack: FrameStack) -> FrameStack | None:
    """The flats that can be compared, if any."""
    usable = usable_flats(stack)
    return _in_memory(stack, usable) if usable else None


def _in_memory(stack: FrameStack, exposures: list[int]) -> FrameStack:
    """Some exposures, of which all frames, or as many as may be held, are used."""
    most = max(FEWEST_FRAMES, MOST_COUNTS // (stack.shape[0] * stack.shape[1]))
    return stack.select(exposures=exposures, frames=slice(0, most))


def _static(named: NoiseModel, frames: FrameStack, key: RandomKey, effects: tuple[str, ...]) -> str:
    longest = frames.select(exposures=[int(np.argmax(frames.exposure_s))])
    return shares.in_words(shares.static_by_effect(named, longest, key, effects), shares.static_dn2(longest))


def _apart(darks: FrameStack, model: NoiseModel) -> tuple[Apart, ...]:
    """The exposures without the course that the model gives the level of a run, which stays in it."""
    found = []
    for i, exposure_s in enumerate(darks.exposure_s):
        frames = np.stack(list(darks.frames(i)))
        if COURSE in model:
            course_e = np.asarray(model[COURSE].course(len(frames)))
            frames = frames - (float(np.mean(model["gain"].value)) * course_e)[:, None, None]
        found.append(Apart.of(frames, float(exposure_s)))
    return tuple(found)


def _narrow(darks: FrameStack, rng: np.random.Generator) -> Narrow | None:
    """Levels and noise of pixels by the exposure with most frames, if their noise is below a count."""
    frames = np.stack(list(darks.frames(int(np.argmax(darks.n_frames)))))
    step = len(cfa_tile(darks.cfa))
    planes = [(slice(p // step, None, step), slice(p % step, None, step)) for p in range(step * step)]
    if not all(is_narrow(frames[:, *at]) for at in planes):
        return None
    level, sigma, slopes = np.empty(darks.shape), np.empty(darks.shape), []
    for at in planes:
        found = narrow_from_posterior(frames[:, *at], rng)
        level[at], sigma[at] = found.level, found.sigma
        slopes.append(found.slope)
    return Narrow(level, sigma, float(np.mean(slopes)))


@dataclass(frozen=True)
class _Closing:
    """The frames that are measured, what they were taken apart into, and the key of all draws."""

    darks: FrameStack
    sensor: Sensor
    key: RandomKey

    @staticmethod
    def of(darks: FrameStack, model: NoiseModel, seed: int) -> _Closing:
        key = key_for(seed, Purpose.CLOSE)
        words = np.asarray(jax.random.bits(named_key(key, "maps"), (4,), np.uint32))
        rng = np.random.default_rng(words)
        return _Closing(darks, Sensor(_apart(darks, model), rng, darks.window, _narrow(darks, rng)), key)

    def starts(self, model: NoiseModel) -> list[NoiseModel]:
        """The model with maps in place of patterns; and without effects that overshoot, where there are any.

        A spectrum has the right power, but not the phase of what stands still, as rows that are read together do.
        """
        for effect in [one for one in model if one.measurable]:
            model = model.remove(effect.name)
        model = with_hits(self.sensor.with_map(model), self.sensor)
        holding = self.named_that_hold(model)
        return [model] if holding is model else [holding, model]

    def nearer(self, model: NoiseModel) -> NoiseModel:
        """The model brought nearer draw by draw."""
        for number in range(ROUNDS):
            drawn = self.drawn(model, number)
            before, model = mean_power(model), with_spectra(model, self.sensor.seen, drawn)
            if self.sensor.narrow is not None:  # how often pixels hold each count has told the rest
                continue
            model = with_read_noise(model, self.sensor, drawn, mean_power(model) - before)
            model = with_spread(with_shot_noise(model, self.sensor, drawn), self.sensor, drawn)
            if number == 0:
                model = with_distribution(model, self.sensor)
        return model

    def with_light(self, model: NoiseModel, stack: FrameStack, flats: FrameStack | None) -> list[NoiseModel]:
        """The closed model with what flats tell; two where they show a bent response, which may be that of the lamp.

        flats: those of `stack` that can be compared; without any, a bent response is taken for the sensor's.
        """
        bent = with_response(model, stack)
        if flats is None:
            return [bent]
        models = [model] if bent is model else [model, bent]
        return [with_photo_response(one, flats, self.sensor.rng) for one in models]

    def drawn(self, model: NoiseModel, number: int) -> tuple[Apart, ...]:
        """Frames drawn as the measured ones were taken, taken apart."""
        return _apart(draw_capture(jax.random.fold_in(self.key, number), model, self.darks), model)

    def named_that_hold(self, model: NoiseModel) -> NoiseModel:
        """The model without effects that overshoot in rows, columns or frames: their noise is measured whole."""
        like = capture_like(model, self.darks.shape, float(self.darks.exposure_s.max()))
        axes = ("gain", "row", "column", "frame")
        feeding = {axis: {one.name for one in model if of_axis(one, axis, like)} - {COURSE} for axis in axes}
        bare = model
        for name in set().union(*feeding.values()):
            bare = bare.remove(name)
        with_named, without = self.drawn(model, ROUNDS), self.drawn(bare, ROUNDS)
        for axis, names in feeding.items():
            if misfit(axis, self.sensor.seen, with_named) > misfit(axis, self.sensor.seen, without) + ALLOWED:
                for name in names & set(model.names):
                    model = model.remove(name)
        return model
