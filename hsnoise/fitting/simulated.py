"""Fitting effects that only say how they are drawn, by simulated statistics, together with the base parameters.

The statistics are those of the capture's structure, and the score (gradient of the exact base likelihood at the base
fit), which carries all that the likelihood knows of the base parameters. Their expectation and covariance are
simulated with common random numbers, and the parameters sought at which the expectation meets the measurement
(efficient method of moments: Gallant and Tauchen, "Which moments to match?", Econometric Theory 12, 1996).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, reduce

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.threads import in_threads
from hsnoise._core.types import unit_in_words
from hsnoise.fitting.covariances import as_scattered, not_surer_than
from hsnoise.fitting.gradients import gradient_at
from hsnoise.fitting.notes import near_zero, parameter_notes
from hsnoise.fitting.result import NOT_CONVERGED, FitResult
from hsnoise.frames.stack import FrameStack
from hsnoise.likelihood.coordinates import Coordinates, coordinates_for
from hsnoise.likelihood.parameters import Parameters, parameters_of
from hsnoise.likelihood.plan import plan_rules, replan
from hsnoise.likelihood.summary import coding_of, summarise, without_counts
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import FAR_OFF, black_level_of, draw_capture, floored_variance, part_of, share_of_far
from hsnoise.statistics.structure import structure

COVARIANCE_DRAWS, MEAN_DRAWS, SLOPE_DRAWS, LAST_DRAWS = 36, 12, 4, 48
MOST_SLOPES, MOST_ITERATIONS = 4, 20  # derivatives cost four times what means do, and change little near the end
SLACK, MUCH_LESS = 0.02, 0.8  # of the cost: rare counts make it rough; a step for which old derivatives are good enough
LEAST_DAMPING = 0.1  # of the information, once a step failed
SHORT_STEP, LONG_STEP = 0.2, 1.0  # standard errors: where the search ends, and where it has failed
SURE_STEP = 2.0  # derivatives taken after a shorter step are near enough
STEP_SIGMA, STEP_LOG = 2.0, 0.2  # for derivatives: standard errors, and for effects at most this in the logarithm
PRIOR_SIGMA = 1.5  # of the logarithm of an effect's parameter: keeps what the data do not determine in place
MOST_SPREAD = 0.25  # variance of base parameters, of themselves, from which they are unknown
LONGEST_STEP, LONGEST_OF_BASE = 1.5, 0.5  # of the logarithm of an effect's parameter; for base parameters half of it
SHRINKAGE = 0.1  # of a correlation to its diagonal, at least
MARGIN = 1.15
UNKNOWN = 100.0  # deviation of what the base fit does not know, in sizes


@dataclass(frozen=True)
class Problem:
    """A capture, its base fit, and the numbers to be found: y = (base in whitened units, effects unconstrained).

    given: the model that was handed over; its base parameters are another place to start.
    """

    part: FrameStack
    base: FitResult
    model: NoiseModel
    extra: tuple[str, ...]
    seed: int
    given: NoiseModel

    @cached_property
    def coordinates(self) -> Coordinates:
        """Those of the base fit, without shares of outliers: its likelihood gives the score."""
        with jax.enable_x64(True):
            return coordinates_for(self.base.summary, self.base.params)

    @cached_property
    def added(self) -> Parameters:
        """The numbers of the effects that the base fit lacks."""
        return parameters_of(self.model, self.extra)

    @cached_property
    def centre(self) -> np.ndarray:
        with jax.enable_x64(True):
            return np.asarray(self.coordinates.start())

    @cached_property
    def sizes(self) -> np.ndarray:
        """What a change of each base coordinate is measured by: as much as doubles the parameter, say."""
        with jax.enable_x64(True):
            return self.coordinates.sizes(self.centre)

    @cached_property
    def spread(self) -> tuple[np.ndarray, np.ndarray]:
        """Variances and directions of the covariance of the base coordinates over their sizes."""
        slope = np.maximum(np.abs(self.slope(self.centre)), 1e-12) * self.sizes
        covariance, unknown = self._base_covariance()
        covariance[unknown], covariance[:, unknown] = 0.0, 0.0
        covariance[unknown, unknown] = (UNKNOWN * slope[unknown]) ** 2
        covariance = covariance / slope[:, None] / slope[None, :]
        # Beside a deviation of millions, one of thousandths would have no digits.
        share = np.minimum(1.0, UNKNOWN / np.sqrt(np.diagonal(covariance)))
        return np.linalg.eigh(covariance * share[:, None] * share[None, :])

    def _base_covariance(self) -> tuple[np.ndarray, np.ndarray]:
        """Covariance of the base fit in the order of the coordinates, and which of these it did not fit."""
        names, fitted = self.coordinates.names, self.base.names
        covariance = np.diag(np.full(len(names), np.inf))
        here = [i for i, name in enumerate(names) if name in fitted]
        there = [fitted.index(names[i]) for i in here]
        covariance[np.ix_(here, here)] = self.base.covariance[np.ix_(there, there)]
        return covariance, ~np.isfinite(np.diagonal(covariance))

    @cached_property
    def whiten(self) -> np.ndarray:
        """Square root of the covariance of the base coordinates, directions without information cut to MOST_SPREAD."""
        values, vectors = self.spread
        return self.sizes[:, None] * vectors * np.sqrt(np.clip(values, 1e-16, MOST_SPREAD))

    @cached_property
    def prior(self) -> np.ndarray:
        """Inverse variances that keep numbers near the start: of effects, and where the base fit knew nothing."""
        base = np.where(self.spread[0] < MOST_SPREAD, 1e-6, 1.0)
        return np.concatenate([base, np.full(len(self.added.numbers), PRIOR_SIGMA**-2)])

    def slope(self, vector: np.ndarray) -> np.ndarray:
        """d parameter / d coordinate of the base."""
        with jax.enable_x64(True):
            return np.asarray(self.coordinates.slope(jnp.asarray(vector)))

    @cached_property
    def coding(self):
        return coding_of(self.part)

    @cached_property
    def rules(self):
        return plan_rules(self.coordinates.base, summarise(self.part, coding=self.coding), MARGIN)

    @cached_property
    def start(self) -> np.ndarray:
        return np.concatenate([np.zeros(len(self.centre)), self.added.read(self.model)])

    @cached_property
    def other_start(self) -> np.ndarray | None:
        """Where the base parameters are those of `given`, which may know more of the effects than `base` did."""
        vector = self.coordinates.read(self.given)
        if not np.all(np.isfinite(vector)) or np.allclose(vector, self.centre, rtol=1e-6):
            return None
        return np.concatenate([np.linalg.solve(self.whiten, vector - self.centre), self.start[len(vector) :]])

    def base_vector(self, y: np.ndarray) -> np.ndarray:
        """The coordinates of the base."""
        n = len(self.centre)
        return self.centre + self.whiten @ y[:n]

    def at(self, y: np.ndarray) -> NoiseModel:
        """The model whose numbers are y."""
        return self.added.put(self.coordinates.put(self.model, self.base_vector(y)), y[len(self.centre) :])

    def in_float64(self, y: np.ndarray) -> NoiseModel:
        with jax.enable_x64(True):
            return self.at(y)

    def statistics(self, part: FrameStack) -> tuple[np.ndarray, np.ndarray]:
        """Score in whitened units and structure, one after the other, and a rough error of each."""
        found = structure(part, black_level_of(self.base.params))
        summary = summarise(part, coding=self.coding)
        with jax.enable_x64(True):
            rules = replan(self.rules, plan_rules(self.coordinates.base, summary, MARGIN))
            _, gradient = gradient_at(self.coordinates, jnp.asarray(self.centre), without_counts(summary), rules)
            score = self.whiten.T @ np.asarray(gradient)
        return np.concatenate([score, found.values]), np.concatenate([np.full(len(score), 0.3), found.error])

    def share_of(self, step: np.ndarray) -> float:
        """How much of a step may be made at once: statistics are straight lines of the parameters only nearby."""
        n = len(self.centre)
        base, own = np.abs(self.whiten @ step[:n]) / self.sizes, np.abs(step[n:])
        longest = max(base.max() / LONGEST_OF_BASE, own.max(initial=0.0) / LONGEST_STEP)
        return min(1.0, 1 / max(longest, 1e-12))

    def draw(self, y: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
        return self.statistics(draw_capture(self.seed + number, self.at(y), self.part))


def fit_synthetic(base: FitResult, stack: FrameStack, model: NoiseModel, *, seed: int = 0, progress=None) -> FitResult:
    """`base` with the effects of `model` that it lacks, and base parameters corrected for them.

    base: fit of the same capture without those effects. model: its values are where the search for the effects starts.
    Raises RuntimeError where the model's draws have no statistics.
    """
    part, tick = part_of(stack), progress or (lambda: None)
    extra = tuple(name for name in model.names if name not in base.params)
    whole = reduce(NoiseModel.add, (model[name] for name in extra), base.params)
    problem = Problem(part, base, whole, extra, seed, model)
    return _result(problem, *_search(problem, tick))


@dataclass(frozen=True)
class _Point:
    """Statistics of draws at y [draw, statistic], and how far the measured ones are off [statistic], in deviations."""

    y: np.ndarray
    drawn: np.ndarray
    off: np.ndarray

    def weight(self, equal: np.ndarray) -> np.ndarray:
        """Weights [statistic, statistic], those of statistics that are far off made smaller."""
        share = share_of_far(self.off)
        return share[:, None] * equal * share

    def uphill(self, gain: np.ndarray, problem: Problem) -> np.ndarray:
        return gain @ self.off - problem.prior * (self.y - problem.start)

    def cost(self, weight: np.ndarray, problem: Problem) -> float:
        return float(self.off @ weight @ self.off + problem.prior @ (self.y - problem.start) ** 2)


def _search(problem: Problem, tick) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Where simulation meets measurement: y, its covariance, the last step in standard errors, iterations.

    Gauss-Newton, with Levenberg's damping where a step leads away. Statistics that are far off count less (Huber): what
    the model still lacks must not bend what it can describe.
    """
    measured, _ = problem.statistics(problem.part)
    scale, equal = _weights(problem, problem.start, tick)

    def point(y: np.ndarray, count: int = MEAN_DRAWS) -> _Point:
        drawn = _draws(problem, y, tick, count)
        return _Point(y, drawn, (measured - drawn.mean(0)) / scale)

    here, damping, taken, wanted, fresh, iterations = _first(problem, point), 0.0, 0, True, False, 0
    by = np.where(np.arange(len(here.y)) < len(problem.centre), STEP_SIGMA, STEP_LOG)
    while iterations < MOST_ITERATIONS:
        iterations += 1
        weight = here.weight(equal)
        if wanted:
            slopes = _slopes(problem, here.y, by, here.drawn, tick) / scale[:, None]
            taken, fresh, of = taken + 1, True, here.y
        gain = slopes.T @ weight
        information = gain @ slopes + np.diag(problem.prior)
        covariance = np.linalg.inv(information)
        deviation = np.sqrt(np.diagonal(covariance))
        by = np.minimum(by, STEP_SIGMA * deviation)
        uphill = here.uphill(gain, problem)
        length = float(np.abs(covariance @ uphill / deviation).max())
        if not np.isfinite(length):
            raise RuntimeError(_not_finite(problem, here.y))
        step = np.linalg.solve(information + damping * np.diag(np.diagonal(information)), uphill)
        ahead = here.y + step * problem.share_of(step)
        if length < SHORT_STEP:
            # Derivatives of another place would end the search where those of here do not.
            wanted = np.abs((here.y - of) / deviation).max() > SURE_STEP and taken < 2 * MOST_SLOPES
            if wanted:
                continue
            here = replace(here, y=ahead)
            break
        there = point(ahead)
        before, after = here.cost(weight, problem), there.cost(weight, problem)
        if after < (1 + SLACK) * before + 1:
            most = MOST_SLOPES if after < MUCH_LESS * before else 2 * MOST_SLOPES
            wanted = length >= SURE_STEP and taken < most
            here, fresh, damping = there, False, damping / 10 if damping > LEAST_DAMPING else 0.0
        else:
            damping, wanted = max(10 * damping, LEAST_DAMPING), not fresh and taken < 2 * MOST_SLOPES
    # The search knows means to a third of their scatter, and scatter from where it began.
    here = point(here.y, LAST_DRAWS)
    step = covariance @ here.uphill(gain, problem)
    scattered = as_scattered(covariance, gain, (here.drawn - here.drawn.mean(0)) / scale)
    return here.y + step * problem.share_of(step), scattered, length, iterations


def _first(problem: Problem, point) -> _Point:
    """Where the search starts: at the base fit, or with the base parameters that were given, whichever is nearer."""
    starts = [problem.start] if problem.other_start is None else [problem.start, problem.other_start]
    return min(map(point, starts), key=lambda of: np.minimum(np.abs(of.off), FAR_OFF) @ np.abs(of.off))


def _not_finite(problem: Problem, y: np.ndarray) -> str:
    with jax.enable_x64(True):
        values = np.asarray(problem.added.values(y[len(problem.centre) :]))
    at = [f"{name} {value:.3g}" for name, value in zip(problem.added.names, values, strict=True)]
    return f"statistics of draws are not finite at {', '.join(at)}; fit from another start"


def _result(problem: Problem, y: np.ndarray, covariance: np.ndarray, last_step: float, iterations: int) -> FitResult:
    n, base = len(problem.centre), problem.base
    turn = np.zeros((len(y), len(y)))
    turn[:n, :n] = problem.slope(problem.base_vector(y))[:, None] * problem.whiten
    with jax.enable_x64(True):
        turn[range(n, len(y)), range(n, len(y))] = np.asarray(problem.added.slope(jnp.asarray(y[n:])))
    of_base = "" if base.method == "ml" else f"; of the fit that it starts from: {base.outcome}"
    met = "simulated statistics met" if last_step < LONG_STEP else f"{NOT_CONVERGED}simulated statistics not met"
    result = replace(
        base,
        params=problem.in_float64(y),
        outliers=None,
        names=(*base.names, *problem.added.names),
        covariance=not_surer_than(base.covariance, _in_order(problem, turn @ covariance @ turn.T)),
        method="synthetic",
        outcome=f"{met}: the last step was {last_step:.1g} standard errors long{of_base}",
        iterations=iterations,
        log_likelihood=float("nan"),
    )
    how = f"{', '.join(problem.extra)}: fitted by simulated statistics (synthetic likelihood), together with all other"
    of_line = base.notes if base.method == "line" else ()
    told = (f"{how} parameters.", *of_line, *_loose(problem, covariance, result), *parameter_notes(result))
    return result.with_notes(tuple(dict.fromkeys(told)))


def _in_order(problem: Problem, covariance: np.ndarray) -> np.ndarray:
    """`covariance` of all numbers that moved in the order of the table; what the base fit measured keeps its own."""
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
    """Sentences on numbers of effects that hardly moved from where the search started; covariance: of y."""
    deviation = np.sqrt(np.diagonal(covariance))[len(problem.centre) :]
    told = []
    for name, sigma in zip(problem.added.names, deviation, strict=True):
        if sigma <= 0.7 * PRIOR_SIGMA:
            continue
        value, error, unit = result.table[name]
        if value < 2 * error:
            told.append(f"{near_zero(name, value, error, unit_in_words(unit))}.")
        else:
            told.append(f"{name} is not determined by this capture: its value is close to where the search started.")
    return told


def _weights(problem: Problem, y: np.ndarray, tick) -> tuple[np.ndarray, np.ndarray]:
    """Deviation [statistic] and inverse correlation of statistics, noise of simulated means included."""
    drawn = in_threads(lambda i: problem.draw(y, MEAN_DRAWS + i), range(COVARIANCE_DRAWS), tick)
    values, floor, n = np.stack([v for v, _ in drawn]), np.median([e for _, e in drawn], axis=0), len(drawn)
    variance = floored_variance(values.var(0, ddof=1), n - 1, floor**2)
    scale = np.sqrt(variance * (1 + 1 / MEAN_DRAWS))
    z = (values - values.mean(0)) / np.sqrt(variance)
    correlation = z.T @ z / (n - 1)
    # Shrunk to its diagonal: fewer draws than statistics.
    share = max(SHRINKAGE, min(1.0, len(scale) / (n * 4)))
    whole = (1 - share) * correlation + (share + 0.02) * np.eye(len(scale))
    return scale, np.linalg.inv(whole)


def _draws(problem: Problem, y: np.ndarray, tick, count: int) -> np.ndarray:
    """Statistics of draws at y [draw, statistic]."""
    return np.stack([v for v, _ in in_threads(lambda i: problem.draw(y, i), range(count), tick)])


def _slopes(problem: Problem, y: np.ndarray, steps: np.ndarray, drawn: np.ndarray, tick) -> np.ndarray:
    """Derivatives of the statistics at y [statistic, number] over `steps`, by random numbers common with `drawn`."""

    def difference(task: tuple[int, int]) -> np.ndarray:
        which, number = task
        moved = y.copy()
        moved[which] += steps[which]
        return (problem.draw(moved, number)[0] - drawn[number]) / steps[which]

    tasks = [(which, number) for which in range(len(y)) for number in range(SLOPE_DRAWS)]
    slopes = np.stack(in_threads(difference, tasks, tick)).reshape(len(y), SLOPE_DRAWS, -1)
    mean, variance = slopes.mean(1), slopes.var(1, ddof=1) / SLOPE_DRAWS
    # Hundreds of statistics that tell nothing would by their noise pass for information, and make steps too short.
    return (mean * np.clip(1 - variance / np.maximum(mean**2, 1e-300), 0, 1)).T
