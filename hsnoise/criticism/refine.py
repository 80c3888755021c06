"""Parameters of one or two candidates brought closer to the capture: a few Gauss-Newton steps on simulated draws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce

import numpy as np

from hsnoise._core.threads import in_threads
from hsnoise.criticism.fingerprint import BASE, RELATIVE_ERROR, Bench, law_of
from hsnoise.criticism.gaussian import Gaussian
from hsnoise.criticism.ranking import Evidence, Pair
from hsnoise.effects import AbstractEffect
from hsnoise.likelihood.parameters import Number, Parameters, numbers_of, of_numbers, parameters_of
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import share_of_far

ITERATIONS = 3
DRAWS, SLOPE_DRAWS, PAIR_DRAWS = 6, 3, 12
STEP, LONGEST_STEP = 0.2, 1.0  # of an unconstrained number: mostly a logarithm
PRIOR_SIGMA, BASE_SIGMA = 1.0, 0.3  # of unconstrained numbers of effects, and of the base
MANY_DRAWS = 24
NEARBY_ERROR = 0.02  # of shifts close to the capture
TINY = 1e-3  # a parameter of the base that is zero

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

    model = _stepped(model, parameters_of(model, names), step, bench)
    return tuple(model[name] for name in names)


def refined_pair(pair: Pair, start: Sequence[AbstractEffect], bench: Bench, evidence: Evidence) -> Pair:
    """A pair with parameters refined together from `start`, and drawn together: strong effects do not just add."""
    effects = refined(start, bench, evidence)
    model = reduce(NoiseModel.add, effects, bench.model)
    shifts = np.stack(in_threads(lambda number: bench.shift(model, number), range(PAIR_DRAWS), bench.tick))
    law = law_of(shifts, evidence.null)
    score = evidence.score(law)
    again = replace(pair, effects=(effects[0], effects[1]), score=score, misfit=evidence.misfit(law), law=law)
    return max(pair, again, key=lambda one: one.score)


def with_base(effect: AbstractEffect, bench: Bench, evidence: Evidence) -> tuple[float, AbstractEffect]:
    """Log-likelihood ratio of an effect, and the effect, with its parameters and the base brought close to the capture.

    Unlike fingerprints on a base that the effect has bent, it tells variants of one effect that differ little. It is
    no evidence that there is the effect at all: nothing of the base is held against it.
    """
    own = bench.base.law.covariance
    model = bench.model.add(effect)
    own_numbers, of_base = parameters_of(model, (effect.name,)).numbers, _base_numbers(model)
    prior = np.repeat([PRIOR_SIGMA, BASE_SIGMA], [len(own_numbers), len(of_base)]) ** -2

    def step(shifts: np.ndarray, slopes: np.ndarray, gone: np.ndarray) -> np.ndarray:
        law = _law_nearby(shifts, own)
        off = evidence.z - law.mean
        share = share_of_far(off / np.sqrt(np.diagonal(law.covariance)))
        weighted = slopes.T @ (share[:, None] * np.linalg.inv(law.covariance) * share)
        return np.linalg.solve(weighted @ slopes + np.diag(prior), weighted @ off - prior * gone)

    there = _stepped(model, of_numbers(model, (*own_numbers, *of_base)), step, bench)
    numbers = range(min(MANY_DRAWS, len(bench.base.draws)))
    shifts = np.stack(in_threads(lambda number: bench.shift(there, number), numbers, bench.tick))
    return evidence.score(_law_nearby(shifts, own)), there[effect.name]


def _stepped(model: NoiseModel, turned: Parameters, step_of: Step, bench: Bench) -> NoiseModel:
    """The model after a few steps of its numbers, made from shifts, slopes and how far the numbers have gone."""
    start = y = turned.read(model)
    for _ in range(ITERATIONS if turned.numbers else 0):  # an effect may hold all its numbers
        step = step_of(*_shifts_and_slopes(model, turned, y, bench), y - start)
        y = y + step * min(1.0, LONGEST_STEP / max(np.abs(step).max(), 1e-12))
    return turned.put(model, y)


def _law_nearby(shifts: np.ndarray, own: np.ndarray) -> Gaussian:
    """Law of the statistics around draws with these shifts [draw, statistic]; own: covariance of a model's draws."""
    mean = shifts.mean(0)
    return Gaussian(mean, own * (1 + 1 / len(shifts)) + np.diag((NEARBY_ERROR * mean) ** 2))


def _base_numbers(model: NoiseModel) -> list[Number]:
    """The base parameters that are not zero; black levels are told by the means of the counts alone."""
    names = [name for name in BASE if name in model and name != "black_level"]
    return [n for n in numbers_of(model, names) if n.field == BASE[n.effect] and n.value_in(model) > TINY]


def _shifts_and_slopes(
    model: NoiseModel, turned: Parameters, y: np.ndarray, bench: Bench
) -> tuple[np.ndarray, np.ndarray]:
    """Shifts at y [draw, statistic] and their derivatives [statistic, number], by common random numbers."""
    moved = [turned.put(model, y + STEP * (np.arange(len(y)) == i)) for i in range(len(y))]
    tasks = [(turned.put(model, y), number) for number in range(DRAWS)]
    tasks += [(one, number) for one in moved for number in range(SLOPE_DRAWS)]
    drawn = np.stack(in_threads(lambda task: bench.shift(*task), tasks, bench.tick))
    shifts = drawn[:DRAWS]
    apart = drawn[DRAWS:].reshape(len(y), SLOPE_DRAWS, -1) - shifts[None, :SLOPE_DRAWS]
    return shifts, apart.mean(1).T / STEP
