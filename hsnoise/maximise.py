"""Maximum likelihood with Optimistix: quasi-Newton steps in whitened coordinates, observed information at the end."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from hsnoise.coordinates import Coordinates
from hsnoise.physics import Physics, Rules, evaluate
from hsnoise.plan import plan_rules
from hsnoise.statistics import Summary, first_frames, without_counts

ROUNDS = 16
STEPS = 60
CLOSE_SIGMA = 0.03  # converged: the next Newton step is shorter than this many standard errors
FIRST_SPREAD = 0.03  # taken for a standard error of every coordinate before one is known
PILOT_ROWS = 30_000
CHORDS, CHORD_MARGIN = 12, 1.06
DIFFERENCE_SIGMA = 0.1  # step of the derivative of the gradient
REFINEMENTS = 4  # of the curvature
IDLE_BELOW = -3.0  # softplus coordinate: less than 5 % of what the data resolve


class Maximum(NamedTuple):
    """Where a fit ended: parameters, information in them (inverse covariance), and how it went.

    `vector` is the same in coordinates, and `whiten` a square root of their covariance.
    """

    physics: Physics
    values: np.ndarray
    information: np.ndarray
    log_likelihood: float
    iterations: int
    converged: bool
    outcome: str
    vector: np.ndarray
    whiten: np.ndarray


def maximise(coordinates: Coordinates, summary: Summary) -> Maximum:
    """Maximise log-likelihood plus weak prior from `coordinates.base`. Call with float64 enabled.

    A capture of very many rows is fitted on a few of its frames first; their curvature, scaled up, then guides a few
    Newton steps on all of it, each the cost of one gradient, and gives the standard errors.
    """
    frames = max(summary.n_frames, default=1)
    rows = sum(h.counts[..., 0].size for h in summary.histograms)
    few = max(1, int(frames * PILOT_ROWS / max(rows, 1)))
    if rows < 2 * PILOT_ROWS or few >= frames:
        return _by_rounds(coordinates, summary)
    pilot = first_frames(summary, few)
    start = _by_rounds(coordinates, pilot)
    return _by_chords(coordinates, summary, start, sum(summary.n_frames) / sum(pilot.n_frames))


def _by_rounds(coordinates: Coordinates, summary: Summary) -> Maximum:
    """Rounds of quasi-Newton steps, each from a fresh curvature and with fresh quadrature rules."""
    light = without_counts(summary)
    vector = eqx.filter_jit(Coordinates.vector)(coordinates, coordinates.base)
    rules = plan_rules(coordinates.base, summary)
    whiten = FIRST_SPREAD * np.eye(len(vector))
    value, gradient, whiten = _curvature(coordinates, vector, whiten, light, rules)
    iterations, distance = 0, np.inf
    for _ in range(ROUNDS):
        ahead, steps = quasi_newton(coordinates, vector, whiten, coordinates.reach(vector), value, light, rules)
        iterations += int(steps)
        if not np.isfinite(ahead).all():
            distance = np.inf
            break
        rules = replan(rules, plan_rules(_parameters(coordinates, ahead)[0], summary))
        value, gradient, whiten = _curvature(coordinates, ahead, whiten, light, rules)
        # Length in standard errors of the Newton step that is left.
        distance = float(np.linalg.norm(whiten.T @ gradient)) if np.isfinite(value) else np.inf
        if not np.isfinite(distance):
            break
        vector = ahead
        if distance < CLOSE_SIGMA:
            break
    information = _in_parameters(coordinates, vector, whiten, light, rules)
    return _ended(coordinates, vector, whiten, information, float(value), iterations, distance)


def _by_chords(coordinates: Coordinates, summary: Summary, start: Maximum, scale: float) -> Maximum:
    """Newton steps on all frames with the curvature of a pilot fit times `scale`."""
    light = without_counts(summary)
    vector, whiten = start.vector, start.whiten / np.sqrt(scale)
    rules = plan_rules(start.physics, summary, CHORD_MARGIN)
    best, steps = np.inf, 0
    while True:
        value, gradient = (np.asarray(x) for x in gradient_at(coordinates, jnp.asarray(vector), light, rules))
        distance = float(np.linalg.norm(whiten.T @ gradient)) if np.isfinite(value) else np.inf
        if distance < CLOSE_SIGMA or distance > 2 * best or steps == CHORDS:
            break
        best, steps = min(best, distance), steps + 1
        vector = vector + whiten @ (whiten.T @ gradient)
    information = start.information * scale
    return _ended(coordinates, vector, whiten, information, float(value), start.iterations + steps, distance)


def _objective(coordinates: Coordinates, vector, summary: Summary, rules: Rules):
    return evaluate(coordinates.physics(vector), summary, rules) + coordinates.log_prior(vector)


@eqx.filter_jit
def quasi_newton(coordinates, vector, whiten, reach, reference, summary, rules):
    """BFGS in coordinates whose unit is about one standard error, so that its first step is Newton's.

    It moves in the space that the columns of `whiten` span, less than `reach` from `vector`.
    """

    def loss(y, _):
        ahead = vector + whiten @ y
        loss = reference - _objective(coordinates, ahead, summary, rules)
        return jnp.where(jnp.isfinite(loss) & (jnp.abs(ahead - vector) < reach).all(), loss, 1e12)

    solver = optx.BFGS(rtol=0.0, atol=1e-2, norm=optx.max_norm)
    solution = optx.minimise(loss, solver, jnp.zeros(whiten.shape[1]), max_steps=STEPS, throw=False)
    return vector + whiten @ solution.value, solution.stats["num_steps"]


@eqx.filter_jit
def gradient_at(coordinates, vector, summary, rules):
    return jax.value_and_grad(partial(_at, coordinates, summary, rules))(vector)


@eqx.filter_jit
def _gradients(coordinates, points, summary, rules):
    return jax.lax.map(jax.value_and_grad(partial(_at, coordinates, summary, rules)), points)


def _at(coordinates, summary, rules, vector):
    return _objective(coordinates, vector, summary, rules)


@eqx.filter_jit
def _parameters(coordinates, vector):
    physics = coordinates.physics(vector)
    return physics, coordinates.flat(physics), coordinates.slope(vector), coordinates.log_prior(vector)


def _curvature(coordinates, vector, whiten, summary, rules):
    """Value, gradient and whitening W at `vector`, W W' the inverse of minus the Hessian.

    The Hessian comes from differences of exact gradients along the columns of an earlier W: there all directions curve
    alike, and one that is a thousand times better known than another does not drown it. Repeated where the earlier W
    was too far off.
    """
    active = ~_idle(coordinates, vector)
    # Idle coordinates, where nothing changes, keep the unit and stay out of it.
    inner = _root((whiten @ whiten.T)[np.ix_(active, active)])
    whole = np.eye(len(vector))
    for _ in range(REFINEMENTS):
        steps = DIFFERENCE_SIGMA / np.maximum(np.abs(inner).max(0), 1.0)
        points = np.repeat(np.asarray(vector)[None], len(vector) + 1, axis=0)
        points[1 : 1 + active.sum(), active] += (inner * steps).T
        values, gradients = (np.asarray(x) for x in _gradients(coordinates, jnp.asarray(points), summary, rules))
        change = (gradients[1 : 1 + active.sum()] - gradients[0])[:, active]
        hessian = change / steps[:, None] @ inner
        if not np.isfinite(hessian).all():
            return np.nan, gradients[0], whiten
        curvature, directions = np.linalg.eigh(-0.5 * (hessian + hessian.T))
        # A direction that curves the wrong way gets a step of moderate length.
        positive = np.where(curvature > 1e-6, curvature, np.maximum(np.abs(curvature), 1e-3))
        inner = inner @ directions / np.sqrt(positive)
        if curvature.max() < 10 and curvature.max() < 30 * curvature.min():
            break
    whole[np.ix_(active, active)] = inner
    return values[0], gradients[0], whole


def _idle(coordinates, vector) -> np.ndarray:
    """Coordinates of parameters at their bound of zero, so far out that nothing changes."""
    idle = np.zeros(len(vector), bool)
    idle[coordinates.bounded] = np.asarray(vector)[coordinates.bounded] < IDLE_BELOW
    return idle


def _root(covariance: np.ndarray) -> np.ndarray:
    """A square root W, W W' = covariance, of a matrix whose entries may differ by orders of magnitude."""
    scale = np.sqrt(np.diagonal(covariance))
    values, vectors = np.linalg.eigh(covariance / scale[:, None] / scale[None, :])
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 1e-15))


def replan(old: Rules, new: Rules) -> Rules:
    """New rules with the old numbers of nodes where they are enough, which spares a compilation."""

    def enough(old, new):
        pairs = zip(old.blocks, new.blocks, strict=True)
        return replace(new, blocks=tuple(replace(n, nodes=max(o.nodes, n.nodes)) for o, n in pairs))

    return tuple(enough(o, n) for o, n in zip(old, new, strict=True))


def _in_parameters(coordinates, vector, whiten, summary, rules) -> np.ndarray:
    """Information on the parameters themselves, from the whitening of the coordinates.

    A parameter at its bound of zero (no dark current, no row gain) has a coordinate far out where nothing changes; its
    row is measured between two positive values within what the data resolve.
    """
    slope = np.asarray(_parameters(coordinates, vector)[2])
    active = ~_idle(coordinates, vector)
    inverse = np.linalg.inv(slope[active, None] * whiten[np.ix_(active, active)])
    information = np.zeros((len(vector), len(vector)))
    information[np.ix_(active, active)] = inverse.T @ inverse
    at_bound = [i for i in coordinates.bounded if vector[i] < 0]
    points = np.repeat(np.asarray(vector)[None], len(vector) + 1, axis=0)
    for i in at_bound:
        ends = points.copy()
        ends[:2, i] = (0.0, 1.5)
        _, gradients = _gradients(coordinates, jnp.asarray(ends), summary, rules)
        at_ends = (_parameters(coordinates, jnp.asarray(e)) for e in ends[:2])
        values, slopes = zip(*(map(np.asarray, at_end[1:3]) for at_end in at_ends), strict=True)
        low, high = (np.asarray(g) / s for g, s in zip(gradients[:2], slopes, strict=True))
        row = -(high - low) / (values[1][i] - values[0][i])
        alone = np.where(np.arange(len(row)) == i, row, 0.0)
        coupled = np.where(np.isin(np.arange(len(row)), at_bound), alone, row)
        # Measured over a range, the couplings may contradict the rest: then they are left out.
        for chosen in (coupled, alone):
            information[i], information[:, i] = chosen, chosen
            if _is_positive(information, [j for j in range(len(row)) if j == i or j not in at_bound]):
                break
    return information


def _is_positive(matrix: np.ndarray, places: list[int]) -> bool:
    part = matrix[np.ix_(places, places)]
    scale = np.sqrt(np.maximum(np.diagonal(part), 1e-300))
    return bool(np.linalg.eigvalsh(part / scale[:, None] / scale[None, :]).min() > 1e-9)


def _ended(coordinates, vector, whiten, information, value, iterations, distance) -> Maximum:
    physics, values, _, log_prior = jax.tree.map(np.asarray, _parameters(coordinates, vector))
    return Maximum(
        physics=physics,
        values=values,
        information=information,
        log_likelihood=value - float(log_prior),
        iterations=iterations,
        converged=bool(distance < CLOSE_SIGMA),
        outcome=f"the next Newton step is {distance:.1g} standard errors long" if np.isfinite(distance) else "diverged",
        vector=np.asarray(vector),
        whiten=whiten,
    )
