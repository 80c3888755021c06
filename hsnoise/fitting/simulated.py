"""Fitting effects that can be drawn but have no likelihood, by simulated statistics, with the base parameters.

The statistics are those of the capture's structure, and the score (gradient of the exact base likelihood at the base
fit), which carries all the likelihood's information on the base parameters. Their expectation and covariance are
simulated with common random numbers, and the fit seeks the parameters at which the expectation matches the measurement
(efficient method of moments: Gallant and Tauchen, "Which moments to match?", Econometric Theory 12, 1996).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.threads import in_threads
from hsnoise._core.types import unit_in_words
from hsnoise.fitting.covariances import as_scattered, not_surer_than
from hsnoise.fitting.notes import near_zero, parameter_notes
from hsnoise.fitting.problem import PRIOR_SIGMA, Problem
from hsnoise.fitting.result import FitResult, Method, Status
from hsnoise.model import NoiseModel
from hsnoise.simulation.gaussian import FAR_OFF, share_of_far, shrunk_covariance
from hsnoise.simulation.portion import Portion
from hsnoise.simulation.simulator import Purpose, Simulator, key_for

MEAN_DRAWS, SLOPE_DRAWS = 8, 2
LAST_DRAWS, LAST_SLOPES = 32, 6  # at the end; noise in the slopes of few draws passes for information
SCATTER_DRAWS, SCATTER_FROM = 32, 1000  # draws for the weights; numbered apart from those for the means
MOST_SLOPES, MOST_ITERATIONS = 4, 20
SLOPE_NOISE = 8.0  # a slope of fewer standard errors than the root of this counts as zero
SLACK = 0.02  # of the cost: tolerated rise, as rare counts make it rough
STUCK, FAR = 6, 4.0  # steps without a fall by more, while the cost is so many times that of the model's own draws
AS_FORESEEN = 0.5  # share of the fall of the cost that derivatives foresee; if it falls less, they are not accurate
LEAST_DAMPING = 0.1  # of the information, after a failed step
SHORT_STEP, LONG_STEP = 0.2, 1.0  # last step in standard errors: below, the search ends; above, it has failed
SURE_STEP = 2.0  # after a shorter step the derivatives are still accurate enough
STEP_SIGMA, STEP_LOG = 2.0, 0.2  # of derivatives: in standard errors; for effects at most this in the logarithm


def draft_synthetic(
    base: FitResult,
    portion: Portion,
    model: NoiseModel,
    *,
    seed: int = 0,
    tick: Callable[[], None] = lambda: None,
) -> Draft:
    """`base` with the effects of `model` that it lacks, and base parameters corrected for them, but for its end.

    That end, `Draft.finished`, takes almost half of the draws.

    base: fit of the same capture without those effects. model: its values start the search for the effects.
    Raises RuntimeError if the statistics of the model's draws are not finite.
    """
    extra = tuple(name for name in model.names if name not in base.params)
    whole = reduce(NoiseModel.add, (model[name] for name in extra), base.params)
    problem = Problem(portion, base, whole, extra, model)
    key = key_for(seed, Purpose.REFIT)
    return _search(problem, Simulator(base.params, portion, key, tick, problem.statistics))


@dataclass(frozen=True, eq=False)
class Draft:
    """Where the search of a fit ended: near enough to be judged, without standard errors.

    Attributes:
        problem, yard: what is fitted, and the scale of the statistics; y: the parameters that were found.
        weight: of the statistics; by: steps of derivatives [number].
        last_step: in standard errors; iterations: of the search.
    """

    problem: Problem
    yard: _Yardstick
    y: np.ndarray
    weight: np.ndarray
    by: np.ndarray
    last_step: float
    iterations: int

    @property
    def params(self) -> NoiseModel:
        """The model."""
        return self.problem.in_float64(self.y)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fitted numbers."""
        return (*self.problem.base.names, *self.problem.added.names)

    @property
    def has_settled(self) -> bool:
        """Whether a step more hardly moves it."""
        return self.last_step < LONG_STEP

    def finished(self) -> FitResult:
        """The fit, by one step more and with standard errors."""
        y, covariance = self.after_last_step()
        return _result(self, y, covariance)

    def after_last_step(self) -> tuple[np.ndarray, np.ndarray]:
        """y after a step from where the search ended, and its covariance.

        The search knows means only to a third of their scatter, slopes only from two draws, and the scatter only where
        it began.
        """
        y, yard, problem = self.y, self.yard, self.problem
        last = yard.simulator.reference(problem.at(y), LAST_DRAWS)
        here, slopes = yard.point(y, LAST_DRAWS), yard.slopes(y, self.by, LAST_SLOPES)
        gain = slopes.T @ self.weight
        covariance = np.linalg.inv(gain @ slopes + np.diag(problem.prior))
        step = covariance @ here.uphill(gain, problem)
        scattered = as_scattered(covariance, gain, problem.prior, (last.draws - last.mean) / yard.deviation)
        return y + step * problem.share_of(step), scattered


@dataclass(frozen=True)
class _Point:
    """A point y, and how far the measured statistics are from the mean of draws there [statistic], in deviations."""

    y: np.ndarray
    off: np.ndarray

    def uphill(self, gain: np.ndarray, problem: Problem) -> np.ndarray:
        return gain @ self.off - problem.prior * (self.y - problem.start)

    def cost(self, weight: np.ndarray, problem: Problem) -> float:
        return float(self.off @ weight @ self.off + problem.prior @ (self.y - problem.start) ** 2)


@dataclass(frozen=True)
class _Yardstick:
    """The scale of the statistics: their deviation [statistic], and in its units draws [draw, statistic] and weights.

    equal: weights [statistic, statistic] if none is far off, from all draws; halves: from each half of the draws.
    """

    problem: Problem
    simulator: Simulator
    deviation: np.ndarray
    scatter: np.ndarray
    equal: np.ndarray
    halves: tuple[np.ndarray, np.ndarray]

    @staticmethod
    def of(problem: Problem, simulator: Simulator, y: np.ndarray) -> _Yardstick:
        """From draws at y that are not used for the means."""
        found = simulator.reference(problem.at(y), SCATTER_DRAWS, SCATTER_FROM)
        scatter = (found.draws - found.mean) / found.deviation
        equal, first, second = in_threads(
            lambda some: np.linalg.inv(shrunk_covariance(some)), [scatter, scatter[::2], scatter[1::2]]
        )
        return _Yardstick(problem, simulator, found.deviation, scatter, equal, (first, second))

    def point(self, y: np.ndarray, count: int = MEAN_DRAWS) -> _Point:
        mean = self.simulator.draws(self.problem.at(y), count).mean(0)
        return _Point(y, (self.simulator.measured.values - mean) / self.deviation)

    def errors(self, slopes: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Standard errors of estimates [number]: the scatter of half of the draws, with weights from the other half."""
        found, prior = [], self.problem.prior
        for equal, others in zip(self.halves, (self.scatter[1::2], self.scatter[::2]), strict=True):
            gain = slopes.T @ _weighted(equal, share)
            covariance = np.linalg.inv(gain @ slopes + np.diag(prior))
            found.append(np.diagonal(as_scattered(covariance, gain, prior, others - others.mean(0))))
        return np.sqrt(np.mean(found, 0))

    def slopes(self, y: np.ndarray, steps: np.ndarray, count: int = SLOPE_DRAWS) -> np.ndarray:
        """Derivatives of the statistics at y [statistic, number], over `steps`, from `count` draws."""
        moved = [self.problem.at(y + steps * (np.arange(len(y)) == i)) for i in range(len(y))]
        slopes = self.simulator.slopes(self.problem.at(y), moved, steps, count)
        return _without_noise(slopes / self.deviation).T


def _weighted(equal: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Weights [statistic, statistic], reduced by `share` for statistics that are far off."""
    return share[:, None] * equal * share


def _without_noise(slopes: np.ndarray) -> np.ndarray:
    """Mean of slopes [draw, number, statistic], shrunk toward zero where draws differ.

    Otherwise the noise of hundreds of zero slopes would pass for information: estimates would stay near the start, and
    their errors would be too small. The variance of so few draws is pooled: one factor per number times one per
    statistic.
    """
    mean, variance = slopes.mean(0), slopes.var(0, ddof=1) / len(slopes)
    of_number = np.maximum(variance.mean(1, keepdims=True), 1e-300)
    pooled = of_number * (variance / of_number).mean(0)
    return mean * np.clip(1 - SLOPE_NOISE * pooled / np.maximum(mean**2, 1e-300), 0, 1)


def _search(problem: Problem, simulator: Simulator) -> Draft:
    """Where simulation matches measurement.

    Gauss-Newton, with Levenberg's damping after a step that fits worse and Broyden's updates of the derivatives.
    Statistics that are far off count less (Huber), so that what the model still lacks does not bias the rest.
    """
    yard = _Yardstick.of(problem, simulator, problem.start)
    here, damping, taken, wanted, fresh, iterations, still = _first(problem, yard), 0.0, 0, True, False, 0, 0
    by = np.where(np.arange(len(here.y)) < len(problem.centre), STEP_SIGMA, STEP_LOG)
    while iterations < MOST_ITERATIONS and still < STUCK:
        iterations += 1
        share = share_of_far(here.off)
        weight = _weighted(yard.equal, share)
        if wanted:
            slopes, taken, fresh = yard.slopes(here.y, by), taken + 1, True
        gain = slopes.T @ weight
        information = gain @ slopes + np.diag(problem.prior)
        covariance = np.linalg.inv(information)
        deviation = yard.errors(slopes, share)
        by = np.minimum(by, STEP_SIGMA * deviation)
        uphill = here.uphill(gain, problem)
        length = float(np.abs(covariance @ uphill / deviation).max())
        if not np.isfinite(length):
            raise RuntimeError(_not_finite(problem, here.y))
        step = np.linalg.solve(information + damping * np.diag(np.diagonal(information)), uphill)
        ahead = here.y + step * problem.share_of(step)
        if length < SHORT_STEP:
            here = replace(here, y=ahead)
            break
        there = yard.point(ahead)
        before, after = here.cost(weight, problem), there.cost(weight, problem)
        foreseen = replace(there, off=here.off - slopes @ (ahead - here.y)).cost(weight, problem)
        still = still + 1 if after > max((1 - SLACK) * before, FAR * len(here.off)) else 0
        if after < (1 + SLACK) * before + 1:
            if length >= SURE_STEP:  # after shorter ones mostly rare counts differ
                slopes = _updated(slopes, here, there)
            falls_less = before - after < AS_FORESEEN * (before - foreseen)
            wanted = length >= SURE_STEP and falls_less and taken < MOST_SLOPES
            here, fresh, damping = there, False, damping / 10 if damping > LEAST_DAMPING else 0.0
        else:
            damping, wanted = max(10 * damping, LEAST_DAMPING), not fresh and taken < 2 * MOST_SLOPES
    return Draft(problem, yard, here.y, weight, by, length, iterations)


def _updated(slopes: np.ndarray, here: _Point, there: _Point) -> np.ndarray:
    """Derivatives [statistic, number] that reproduce what a step did to the statistics, changed as little as possible.

    Reference: Broyden, "A class of methods for solving nonlinear simultaneous equations", Math. Comp. 19, 1965.
    """
    step = there.y - here.y
    return slopes + np.outer(here.off - there.off - slopes @ step, step) / max(step @ step, 1e-12)


def _first(problem: Problem, yard: _Yardstick) -> _Point:
    """Where the search starts: at the base fit, or with the base parameters that were given, whichever is nearer."""
    starts = [problem.start] if problem.other_start is None else [problem.start, problem.other_start]
    return min(map(yard.point, starts), key=lambda of: np.minimum(np.abs(of.off), FAR_OFF) @ np.abs(of.off))


def _not_finite(problem: Problem, y: np.ndarray) -> str:
    with jax.enable_x64(True):
        values = np.asarray(problem.added.values(y[len(problem.centre) :]))
    at = [f"{name} {value:.3g}" for name, value in zip(problem.added.names, values, strict=True)]
    return f"statistics of draws are not finite at {', '.join(at)}; fit from another start"


def _result(draft: Draft, y: np.ndarray, covariance: np.ndarray) -> FitResult:
    problem = draft.problem
    n, base = len(problem.centre), problem.base
    turn = np.zeros((len(y), len(y)))
    turn[:n, :n] = problem.slope(problem.base_vector(y))[:, None] * problem.whiten
    with jax.enable_x64(True):
        turn[range(n, len(y)), range(n, len(y))] = np.asarray(problem.added.slope(jnp.asarray(y[n:])))
    of_base = "" if base.method == Method.ML else f"; of the fit that it starts from: {base.outcome}"
    withheld = base.withheld
    if not base.has_gain:
        withheld = (*withheld, *(number.name for number in problem.added.numbers if number.is_in_electrons))
    result = replace(
        base,
        params=problem.in_float64(y),
        outliers=None,
        names=(*base.names, *problem.added.names),
        withheld=withheld,
        covariance=not_surer_than(problem.of_base, _in_order(problem, turn @ covariance @ turn.T)),
        method=Method.SYNTHETIC,
        status=Status.MET if draft.has_settled else Status.NOT_MET,
        detail=f"the last step was {draft.last_step:.1g} standard errors long{of_base}",
        iterations=draft.iterations,
        log_likelihood=float("nan"),
    )
    how = f"{', '.join(problem.extra)}: fitted by simulated statistics (synthetic likelihood), together with all other"
    of_line = base.notes if base.method == Method.LINE else ()
    told = (f"{how} parameters.", *of_line, *_loose(problem, covariance, result), *parameter_notes(result))
    return result.with_notes(tuple(dict.fromkeys(told)))


def _in_order(problem: Problem, covariance: np.ndarray) -> np.ndarray:
    """`covariance` of all varied numbers, in table order; what only the base fit measured keeps its own."""
    base, added = problem.base, problem.added.names
    moved, names = [*problem.coordinates.names, *added], [*base.names, *added]
    whole = np.zeros((len(names), len(names)))
    whole[: len(base.names), : len(base.names)] = base.covariance
    here = [i for i, name in enumerate(names) if name in moved]
    there = [moved.index(names[i]) for i in here]
    whole[here] = whole[:, here] = 0.0
    whole[np.ix_(here, here)] = covariance[np.ix_(there, there)]
    return whole


def _loose(problem: Problem, covariance: np.ndarray, result: FitResult) -> list[str]:
    """Sentences on numbers of effects that are hardly better known than at the start; covariance: of y."""
    deviation = np.sqrt(np.diagonal(covariance))[len(problem.centre) :]
    told = []
    for number, sigma in zip(problem.added.numbers, deviation, strict=True):
        name = number.name
        if sigma <= 0.7 * PRIOR_SIGMA:
            continue
        value, error, unit = result.in_dn(number.effect)[name]
        if value < 2 * error:
            told.append(f"{near_zero(name, value, error, unit_in_words(unit))}.")
        else:
            told.append(f"{name} is not determined by this capture: its value is close to where the search started.")
    return told
