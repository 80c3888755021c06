"""Parameters of one or two candidates brought closer to the capture: a few Gauss-Newton steps on simulated draws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import numpy as np

from hsnoise.criticism.fingerprint import (
    DRAWN_ERROR,
    LEVEL,
    NEARBY_ERROR,
    RELATIVE_ERROR,
    Bench,
    base_numbers,
    distribution_of,
)
from hsnoise.criticism.ranking import Evidence, Pair
from hsnoise.effects import AbstractEffect
from hsnoise.likelihood.parameters import Number, Parameters, of_numbers, parameters_of, read_noise_dn
from hsnoise.model import NoiseModel
from hsnoise.simulation.gaussian import Gaussian, share_of_far

ITERATIONS = 3
SHORT_STEP = 0.05  # of an unconstrained number: where a search ends
DRAWS, SLOPE_DRAWS, PAIR_DRAWS, NEARBY_DRAWS = 6, 2, 12, 16
STEP, LONGEST_STEP = 0.2, 1.0  # of an unconstrained number: mostly a logarithm
PRIOR_SIGMA, BASE_SIGMA = 1.0, 0.3  # of unconstrained numbers of effects, and of the base
BLACK_SIGMA = 0.1  # of a black level, in units of the read noise
TINY = 1e-3  # a parameter of the base that is zero


class WithBase(NamedTuple):
    """An effect with the base fitted to it.

    score: log-likelihood ratio, nats; misfit: normal score of the worst group; start, effect: before and after;
    distribution: of the statistics there.
    """

    score: float
    misfit: float
    start: AbstractEffect
    effect: AbstractEffect
    distribution: Gaussian


Step = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def refined(effects: Sequence[AbstractEffect], bench: Bench, evidence: Evidence) -> tuple[AbstractEffect, ...]:
    """The effects, in the sensor together, with the parameters at which draws come closest to the capture."""
    names = tuple(effect.name for effect in effects)
    model = reduce(NoiseModel.add, effects, bench.model)

    def step(shifts: np.ndarray, slopes: np.ndarray, gone: np.ndarray) -> np.ndarray:
        mean = shifts.mean(0)
        covariance = evidence.null.covariance + np.diag((RELATIVE_ERROR * mean) ** 2 + shifts.var(0, ddof=1))
        weighted = np.linalg.solve(covariance, slopes).T
        information = weighted @ slopes + np.eye(len(gone)) / PRIOR_SIGMA**2
        return np.linalg.solve(information, weighted @ (evidence.z - mean))

    turned = parameters_of(model, names)
    start = y = turned.read(model)
    for _ in range(ITERATIONS if turned.numbers else 0):  # an effect may hold all its numbers
        taken = _limited(step(_shifts(model, turned, y, bench), _slopes(model, turned, y, bench), y - start))
        y = y + taken
        if np.abs(taken).max() < SHORT_STEP:
            break
    model = turned.put(model, y)
    return tuple(model[name] for name in names)


def refined_pair(pair: Pair, start: Sequence[AbstractEffect], bench: Bench, evidence: Evidence) -> Pair:
    """A pair with parameters refined together from `start`, and drawn together: strong effects do not just add."""
    effects = refined(start, bench, evidence)
    model = reduce(NoiseModel.add, effects, bench.model)
    shifts = bench.shifts([(model, number) for number in range(PAIR_DRAWS)])
    distribution = distribution_of(shifts, evidence.null, DRAWN_ERROR)
    score, misfit = evidence.score(distribution), evidence.misfit(distribution)
    again = replace(pair, effects=(effects[0], effects[1]), score=score, misfit=misfit, distribution=distribution)
    return max(pair, again, key=lambda one: one.score)


def with_base(effect: AbstractEffect, bench: Bench, evidence: Evidence) -> WithBase:
    """Log-likelihood ratio of an effect, and the effect, with its parameters and the base brought close to the capture.

    Unlike fingerprints on a base that the effect has biased, it separates variants of one effect that differ little. It
    is no evidence for the effect itself, because the base is free. Slopes are taken where the search starts: the
    influence of the base on the statistics hardly depends on the effect.
    """
    own = bench.base.distribution.covariance
    model = bench.model.add(effect)
    of_effect, of_base = parameters_of(model, (effect.name,)).numbers, _free_base(model)
    prior = np.array([PRIOR_SIGMA] * len(of_effect) + [_base_sigma(n, model) for n in of_base]) ** -2
    turned = of_numbers(model, (*of_effect, *of_base))
    slopes = np.concatenate(
        [
            _slopes(model, of_numbers(model, of_effect), turned.read(model)[: len(of_effect)], bench),
            _slopes(bench.model, of_numbers(bench.model, of_base), turned.read(model)[len(of_effect) :], bench),
        ],
        axis=1,
    )
    start = y = turned.read(model)
    for _ in range(ITERATIONS):
        nearby = _nearby(_shifts(model, turned, y, bench), own)
        off = evidence.z - nearby.mean
        share = share_of_far(off / np.sqrt(np.diagonal(nearby.covariance)))
        weighted = slopes.T @ (share[:, None] * np.linalg.inv(nearby.covariance) * share)
        taken = _limited(np.linalg.solve(weighted @ slopes + np.diag(prior), weighted @ off - prior * (y - start)))
        y = y + taken
        if np.abs(taken).max() < SHORT_STEP:
            break
    there = turned.put(model, y)
    numbers = range(min(NEARBY_DRAWS, len(bench.base.draws)))
    nearby = _nearby(bench.shifts([(there, number) for number in numbers]), own)
    return WithBase(evidence.score(nearby), evidence.misfit(nearby), effect, there[effect.name], nearby)


def _limited(step: np.ndarray) -> np.ndarray:
    """A step, shortened where it is longer than statistics are straight lines of the parameters."""
    return step * min(1.0, LONGEST_STEP / max(np.abs(step).max(), 1e-12))


def _nearby(shifts: np.ndarray, own: np.ndarray) -> Gaussian:
    """Distribution of the statistics around draws with these shifts [draw, statistic]; own: covariance of draws."""
    mean = shifts.mean(0)
    return Gaussian(mean, own * (1 + 1 / len(shifts)) + np.diag((NEARBY_ERROR * mean) ** 2))


def _free_base(model: NoiseModel) -> list[Number]:
    """The base parameters that move with an effect, without sizes that are zero.

    A black level that stays where the fit left it, or an exponent of the row gain, would hold the others.
    """
    numbers = [n for n in base_numbers(model) if n.field != "white_share"]
    return [n for n in numbers if n.spec.low is None or n.value_in(model) > TINY]


def _base_sigma(number: Number, model: NoiseModel) -> float:
    """Prior standard deviation of a base parameter's coordinate."""
    return BLACK_SIGMA * read_noise_dn(model) if number.place == LEVEL else BASE_SIGMA


def _shifts(model: NoiseModel, turned: Parameters, y: np.ndarray, bench: Bench) -> np.ndarray:
    """Shifts of the statistics at y [draw, statistic]."""
    there = turned.put(model, y)
    return bench.shifts([(there, number) for number in range(DRAWS)])


def _slopes(model: NoiseModel, turned: Parameters, y: np.ndarray, bench: Bench) -> np.ndarray:
    """Derivatives of the statistics at y [statistic, number], by common random numbers."""
    if not turned.numbers:
        return np.zeros((len(bench.base.mean), 0))
    moved = [turned.put(model, y + STEP * (np.arange(len(y)) == i)) for i in range(len(y))]
    slopes = bench.simulator.slopes(turned.put(model, y), moved, np.full(len(y), STEP), SLOPE_DRAWS)
    return (slopes.mean(0) / bench.base.deviation).T
