"""Frames that no fit of `improve` has seen, and the one score by which additions are judged on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from hsnoise.criticism import sentences
from hsnoise.criticism.outcomes import Improvement
from hsnoise.effects import AbstractEffect
from hsnoise.frames.joining import replaced
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.gaussian import JITTER, kept_variance
from hsnoise.simulation.portion import Portion
from hsnoise.simulation.reference import Reference
from hsnoise.simulation.simulator import Purpose, Simulator, key_for
from hsnoise.statistics.structure import structure

SHARE, LEAST_HELD_OUT, LEAST_FITTED = 0.25, 2, 4  # of the dark frames of an exposure
LEAST_IN_SERIES = 4  # frames that tell what passes from one to the next from what stays
DRAWS, LEAST_DRAWS = 96, 40  # of a model that is judged
MOST_DOUBLED = 2  # times that they are doubled where they do not tell
GROUPS = 8  # of draws; without one after the other (jackknife), they tell the error of the simulation
MOST_DRAWN = 60_000_000  # pixels of the draws of a model
SIDE_DRAWS = 40


def split_frames(portion: Portion, stack: FrameStack) -> tuple[FrameStack, FrameStack | None]:
    """The stack without the last frames of its darks, and those; all and None if there are too few to spare.

    Without darks that are not in its portion, where frames are spared.
    """
    darks = portion.darks
    spared = [max(LEAST_HELD_OUT, int(SHARE * n)) for n in darks.frames.n_frames]
    kept = [n - some for n, some in zip(darks.frames.n_frames, spared, strict=True)]
    if min(kept) < LEAST_FITTED:
        return stack, None
    used = [i for i, kind in enumerate(stack.kind) if kind != "dark" or i in darks.chosen]
    of_darks = dict(zip(darks.chosen, kept, strict=True))
    frames = [slice(of_darks.get(i)) for i in used]
    return stack.select(exposures=used, frames=frames), darks.frames.select(frames=[slice(n, None) for n in kept])


def with_flats(darks: FrameStack, flats: FrameStack) -> FrameStack:
    """Darks, which may be of a part of the sensor, with the same part of its flats."""
    if darks.window != flats.window and darks.window is not None:
        whole = replaced(flats, window=flats.window or (0, 0, *flats.shape))
        rows, columns = (
            slice(first - before, first - before + size)
            for first, before, size in zip(darks.window, whole.window[:2], darks.shape, strict=False)
        )
        flats = whole.select(rows=rows, columns=columns)
    return FrameStack.join(darks, flats)


def split_in_words(fitted: FrameStack, held_out: FrameStack | None) -> str:
    """Which frames were fitted and which held out, in words."""
    if held_out is None:
        return ""
    return sentences.frames_apart(frames_of_darks(fitted), held_out.n_frames)


def frames_of_darks(stack: FrameStack) -> tuple[int, ...]:
    """The number of frames of each dark exposure."""
    return tuple(n for n, kind in zip(stack.n_frames, stack.kind, strict=True) if kind == "dark")


@dataclass(frozen=True, eq=False)
class Judge:
    """The frames by which additions are judged: darks that no fit has seen, and all flats.

    The score of a model is the log density of the statistics of these frames, normal with the means and deviations of
    its draws, those that scatter together weighted by what is their own: a proper score, whose difference between two
    models is nearly a likelihood ratio. Of frames that neither model has seen, chance alone makes such a ratio c nats
    or more with probability exp(-c) at most, however few frames there are. Flats are too few to be spared, and darks
    may be, too: of frames that a fit has seen, each fitted number costs a nat, by which a model comes nearer without
    describing anything (Akaike, IEEE Trans. Autom. Control 19, 1974).

    Attributes:
        portion: these frames, and how many came before them.
        unseen: whether a fit has seen none of its darks.
        seed: of the draws.
        kept: what was drawn of the frames alone, and of the frames after those before them.
    """

    portion: Portion
    unseen: bool
    seed: int
    kept: tuple[dict, dict] = field(default_factory=lambda: ({}, {}))

    @staticmethod
    def of(fitted: FrameStack, held_out: FrameStack, seed: int) -> Judge:
        """Of the darks held out from a fit, and of its flats."""
        before = frames_of_darks(fitted)
        flats = [i for i, kind in enumerate(fitted.kind) if kind == "flat"]
        stack = with_flats(held_out, fitted.select(exposures=flats)) if flats else held_out
        return Judge(Portion.of(stack, before=(*before, *[0] * len(flats))), True, seed)

    def of_effect(self, effect: AbstractEffect, fitted: Portion) -> Judge:
        """This judge; for what passes from frame to frame, which few frames held out do not show, the fitted ones."""
        few = min(self.portion.darks.frames.n_frames) < LEAST_IN_SERIES
        return Judge(fitted, False, self.seed) if self.unseen and effect.in_series and few else self

    @cached_property
    def without_flats(self) -> Judge:
        """The same without flats."""
        return replace(self, portion=self.portion.darks, kept=({}, {}))

    def score(self, model: NoiseModel) -> float:
        """Log score of a model, nats."""
        simulator = self._simulator(model)
        own = simulator.reference(model, self._draws(simulator))
        return weighted_score(own, simulator.measured.values, own_shares(own))

    def improvement(
        self, before: NoiseModel, after: NoiseModel, numbers: int, tick: Callable[[], None] = lambda: None
    ) -> Improvement:
        """By how much one model predicts the frames better than another.

        numbers: how many more were fitted for it; tick: called after each draw. Where the draws do not tell, up to four
        times as many are made.
        """
        simulator = replace(self._simulator(before, after), tick=tick)
        cost = 0 if self.unseen and "flat" not in self.portion.frames.kind else numbers
        draws = self._draws(simulator)
        found = _improvement(simulator, before, after, draws, cost)
        for _ in range(MOST_DOUBLED):
            if found.is_open:
                draws *= 2
                found = _improvement(simulator, before, after, draws, cost)
        return found

    def _simulator(self, *models: NoiseModel) -> Simulator:
        """Draws of the frames; with those before them if something depends on the number of a frame."""
        in_series = any(effect.in_series for model in models for effect in model)
        portion = self.portion if in_series else replace(self.portion, before=())
        # One level for all: each model's own would give them different statistics.
        measure = partial(structure, black_level_dn=self._level_dn)
        key, kept = key_for(self.seed, Purpose.HELD_OUT), self.kept[in_series]
        return Simulator(models[0], portion, key, measure=measure, kept=kept)

    @cached_property
    def _level_dn(self) -> float:
        darks = self.portion.darks.frames
        return float(darks.frame(int(np.argmin(darks.exposure_s)), 0).mean())

    @staticmethod
    def _draws(simulator: Simulator) -> int:
        rows, columns = simulator.portion.frames.shape
        drawn = (sum(simulator.portion.frames.n_frames) + sum(simulator.portion.before)) * rows * columns
        return int(np.clip(MOST_DRAWN // drawn, LEAST_DRAWS, DRAWS))


def _improvement(simulator: Simulator, before: NoiseModel, after: NoiseModel, draws: int, cost: float) -> Improvement:
    old, new = (simulator.reference(model, draws) for model in (before, after))
    values, weight = simulator.measured.values, own_shares(old, new)

    def gain(some: np.ndarray) -> float:
        first, second = (weighted_score(of.of_draws(some), values, weight) for of in (old, new))
        return second - first

    others = [np.delete(np.arange(draws), some) for some in np.array_split(np.arange(draws), GROUPS)]
    error = float(np.sqrt((GROUPS - 1) * np.var([gain(some) for some in others])))
    return Improvement(gain(np.arange(draws)), error, cost)


def own_shares(*models: Reference) -> np.ndarray:
    """How much of each statistic is its own [statistic]: 1 if it is independent of all others, 1 / k of k copies.

    From squared correlations in the draws of each model, less what chance makes of them.
    """
    others = np.mean([_squares_with_others(model) for model in models], axis=0)
    return 1 / (1 + np.maximum(others, 0.0))


def _squares_with_others(model: Reference) -> np.ndarray:
    z = model.own_z()
    n, d = z.shape
    scatter = z.std(0)
    z = (z - z.mean(0)) / np.where(scatter > 0, scatter, 1.0)
    return ((z.T @ z / n) ** 2).sum(0) - (scatter > 0) - (d - 1) / (n - 1)


def weighted_score(own: Reference, values: np.ndarray, weight: np.ndarray) -> float:
    """Sum of the log densities of statistics under a model's draws, each times its weight, nats.

    A proper score of each statistic alone (a composite likelihood: Varin, Reid, Firth, "An overview of composite
    likelihood methods", Statistica Sinica 21, 2011). How hundreds of statistics scatter together is not known from a
    few dozen draws, and the scatter of that decided before; the weights make up for what they have in common.
    """
    variance = kept_variance(own.own_z()) + JITTER
    densities = -(own.z(values) ** 2) / (2 * variance) - np.log(variance) / 2 - np.log(own.deviation)
    return float(weight @ densities)


def log_score(own: Reference, values: np.ndarray) -> float:
    """Log density of statistics under the normal distribution of a model's draws, nats."""
    return float(own.distribution.log_density(own.z(values)) - np.log(own.deviation).sum())


def score_of_side(model: NoiseModel, portion: Portion, seed: int) -> float:
    """Log score of a model with an effect on one side of the gain, on the frames that were fitted, nats."""
    simulator = Simulator(model, portion, key_for(seed, Purpose.SIDE))
    return log_score(simulator.reference(model, SIDE_DRAWS), simulator.measured.values)
