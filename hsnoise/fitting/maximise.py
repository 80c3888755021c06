"""Maximum likelihood with Optimistix: quasi-Newton steps in whitened coordinates, observed information at the end."""

from __future__ import annotations

from dataclasses import replace
from functools import partial, reduce
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.memory import give_back_free_memory
from hsnoise.likelihood.coordinates import Coordinates
from hsnoise.likelihood.darks import Rules
from hsnoise.likelihood.gradients import gradient_at, likelihood_at, parameters_at, prior_at, rules_at
from hsnoise.likelihood.plan import CLOSE_MARGIN, plan_rules, replan
from hsnoise.likelihood.summary import Summary, every_nth_row, some_frames, without_counts
from hsnoise.model import NoiseModel

ROUNDS = 16
STEPS = 60
CLOSE_SIGMA = 0.03  # converged: the next Newton step is shorter than this many standard errors
# First guess of a coordinate's standard error: the first, or the second over the root of pixels if that is less.
FIRST_SPREAD, FIRST_SPREAD_OF_ONE = 0.03, 33.0
MANY_ROWS, PILOT_ROWS = 30_000, 3_000
FAR_OFF = 1e12  # loss where a step is not allowed to end
CHORDS = 12
CHORD_CLOSE_SIGMA = 0.1  # likewise, with the curvature of only part of the frames
DIFFERENCE_SIGMA = 0.1  # step of the derivative of the gradient
REFINEMENTS = 4  # of the curvature
IDLE_BELOW = -3.0  # softplus coordinate: less than 5 % of what the data resolve
TURNS = 3  # of rounds: two more if parameters leave their bound
OFF_BOUND, WORTH_NATS = 0.0, 0.5  # softplus coordinate (0.7 of what the data resolve); log-likelihood to gain there


class Maximum(NamedTuple):
    """The end of a fit: parameters, their information (inverse covariance), and how the search went.

    `values` are those of the free numbers in `model` and `outliers`, `vector` the same in coordinates, and `whiten` a
    square root of their covariance.
    """

    model: NoiseModel
    outliers: np.ndarray | None
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

    A capture of very many rows is fitted on some rows of a few of its frames first. The curvature of those frames,
    scaled up, then guides a few Newton steps on all, each the cost of one gradient, and gives the standard errors.
    """
    if _n_rows(summary) < 2 * MANY_ROWS:
        return _by_rounds(coordinates, summary)
    give_back_free_memory()  # here and after compiling: keeps the fit within 1 GiB
    frames = max(1, int(max(summary.n_frames) * MANY_ROWS / _n_rows(summary)))
    few, thinning = some_frames(summary, 0, frames), 1
    coarsest = max(h.row_stride for h in summary.histograms)
    while _n_rows(few) > 2 * thinning * PILOT_ROWS and summary.shape[0] % (2 * thinning * coarsest) == 0:
        thinning *= 2
    pilot = _by_rounds(coordinates, every_nth_row(few, thinning))
    give_back_free_memory()
    scale = sum(summary.n_frames) / sum(few.n_frames)
    vector, whiten, iterations = pilot.vector, pilot.whiten / np.sqrt(thinning), pilot.iterations
    for turn in range(TURNS):
        darks, flats = _pieces(coordinates, vector, summary, frames)
        # Rows carry information on their neighbours' gains: all rows tell more than the thinned ones scaled up.
        guide = partial(_gradients_of_pieces, coordinates, [*darks[: len(summary.channels)], *flats], 1 / scale)
        _, _, whiten = _curvature(coordinates, vector, whiten, guide)
        if turn == 0:
            vector, _, _, steps = _chords(vector, whiten, guide)
            iterations += steps
        whole = partial(_gradients_of_pieces, coordinates, [*darks, *flats], 1.0)
        ahead, value, distance, steps = _chords(vector, whiten / np.sqrt(scale), whole)
        iterations += steps
        if distance < CHORD_CLOSE_SIGMA:
            break
        vector = ahead  # too far for one curvature: measure it again here

    def anew(point):
        parts = _pieces(coordinates, point, few, frames)
        return _gradients_of_pieces(coordinates, [*parts[0], *parts[1]], 1 / scale, point[None])

    information = _in_parameters(coordinates, vector, whiten, anew) * scale
    whiten = whiten / np.sqrt(scale)
    return _ended(coordinates, ahead, whiten, information, value, iterations, distance, CHORD_CLOSE_SIGMA)


def _n_rows(summary: Summary) -> int:
    return sum(h.counts[..., 0].size for h in summary.histograms)


def _by_rounds(coordinates: Coordinates, summary: Summary) -> Maximum:
    """Rounds of quasi-Newton steps, each with a fresh curvature and fresh quadrature rules.

    Repeated if a parameter ended at its bound of zero although the likelihood is higher above it.
    """
    light = _on_device(without_counts(summary))
    vector = np.asarray(eqx.filter_jit(Coordinates.start)(coordinates))
    rules = _on_device(plan_rules(coordinates.base, summary, outliers=coordinates.outliers))
    iterations = 0
    for _ in range(TURNS):
        vector, value, whiten, rules, steps, distance = _rounds(coordinates, vector, summary, light, rules)
        iterations += steps

        def anew(point, rules=rules):
            own = replan(rules, rules_at(coordinates, point, summary))
            return _gradients(coordinates, light, _on_device(own), point[None])

        ahead = _off_bounds(coordinates, vector, value, anew)
        if (ahead == vector).all():
            break
        vector, rules = ahead, _on_device(replan(rules, rules_at(coordinates, ahead, summary)))
    information = _in_parameters(coordinates, vector, whiten, anew)
    return _ended(coordinates, vector, whiten, information, float(value), iterations, distance)


def _rounds(coordinates: Coordinates, vector, summary: Summary, light: Summary, rules):
    """From `vector` until the likelihood stops rising: (vector, value, whitening, rules, steps, errors left)."""
    pixels = sum(h.counts.sum(dtype=np.float64) for h in summary.histograms) + 1.0
    whiten = min(FIRST_SPREAD, FIRST_SPREAD_OF_ONE / np.sqrt(pixels)) * np.eye(len(vector))
    value, _, whiten = _curvature(coordinates, vector, whiten, partial(_gradients, coordinates, light, rules))
    iterations, distance = 0, np.inf
    for _ in range(ROUNDS):
        ahead, steps = quasi_newton(coordinates, vector, whiten, coordinates.reach(vector), value, light, rules)
        iterations += int(steps)
        if not np.isfinite(ahead).all():
            distance = np.inf
            break
        rules = _on_device(replan(rules, rules_at(coordinates, ahead, summary)))
        value, gradient, whiten = _curvature(coordinates, ahead, whiten, partial(_gradients, coordinates, light, rules))
        # Length of the remaining Newton step in standard errors.
        distance = float(np.linalg.norm(whiten.T @ gradient)) if np.isfinite(value) else np.inf
        if not np.isfinite(distance):
            break
        vector = ahead
        if distance < CLOSE_SIGMA:
            break
    return vector, value, whiten, rules, iterations, distance


def _off_bounds(coordinates, vector, value, gradient_anew) -> np.ndarray:
    """`vector`, with parameters taken off their bound where the likelihood is higher above it.

    At the bound it is flat in their coordinates, even if it rises above, so a search that gets there stays there.
    """
    ahead = np.array(vector)
    for i in np.flatnonzero(_idle(coordinates, vector)):
        end = coordinates.put_inside(vector, i, OFF_BOUND)
        if gradient_anew(end)[0][0] > value + WORTH_NATS:
            ahead[i] = end[i]
    return ahead


def _on_device(tree):
    return jax.tree.map(jnp.asarray, tree)  # once, not with every gradient


def _pieces(coordinates: Coordinates, vector, summary: Summary, frames: int) -> tuple[list[tuple[Summary, Rules]], ...]:
    """The likelihood as a sum of pieces, of darks and of flats: (summary, rules) for each.

    A piece of the darks is `frames` frames of one channel. All have the same shape, so memory and compilation are
    those of one piece; the channels of the first frames come first.
    """
    channels = range(len(summary.channels))
    light = without_counts(replace(summary, flats=None))
    parts = (some_frames(summary, start, start + frames) for start in range(0, max(summary.n_frames), frames))
    plan = partial(rules_at, coordinates, vector, margin=CLOSE_MARGIN)
    rules = [[plan(part, channel=c) for c in channels] for part in parts]
    # Channels of the same stride also share a program.
    strides = [h.row_stride for h in summary.histograms]
    most = {
        stride: reduce(
            lambda one, other: replan(other, one), [of[c] for of in rules for c in channels if strides[c] == stride]
        )
        for stride in set(strides)
    }
    darks = [(light, replan(most[strides[c]], of[c])) for of in rules for c in channels]
    return darks, [] if summary.flats is None else [(replace(summary, histograms=()), ())]


def _gradients_of_pieces(coordinates: Coordinates, pieces, flats_weight: float, points):
    """Values and gradients at `points`, summed over the pieces."""
    values, gradients = [], []
    for point in jnp.asarray(points):
        value, gradient = (np.asarray(x) for x in prior_at(coordinates, point))
        for light, rules in pieces:
            weight = 1.0 if light.histograms else flats_weight
            of_piece, slope = likelihood_at(coordinates, point, light, rules)
            value, gradient = value + weight * np.asarray(of_piece), gradient + weight * np.asarray(slope)
        values.append(value)
        gradients.append(gradient)
    return np.asarray(values), np.asarray(gradients)


def _chords(vector, whiten, gradients):
    """Newton steps with the curvature in `whiten`: (vector, value, standard errors left, steps).

    A step that lowers the likelihood and ends farther away is retried at a quarter of its length.
    """
    best, ahead, length, steps = (vector, -np.inf, np.inf), vector, 1.0, 0
    while True:
        (value,), (gradient,) = gradients(ahead[None])
        distance = float(np.linalg.norm(whiten.T @ gradient)) if np.isfinite(value) else np.inf
        if np.isfinite(distance) and (value > best[1] or distance < best[2]):
            best, step, length = (ahead, float(value), distance), whiten @ (whiten.T @ gradient), 1.0
        else:
            length /= 4
        if best[2] < CLOSE_SIGMA or not np.isfinite(best[2]) or steps == CHORDS:
            return *best, steps
        steps += 1
        ahead = best[0] + length * step


def quasi_newton(coordinates, vector, whiten, reach, reference, summary, rules):
    """BFGS in coordinates whose unit is about one standard error, so that its first step is Newton's: (vector, steps).

    It moves in the span of the columns of `whiten`, less than `reach` from `vector`. The gradient is that of
    `gradient_at`, compiled once for all callers; only the solver's step is compiled separately.
    """
    import optimistix as optx  # at the top, it would take a seventh of `import hsnoise`

    solver = optx.BFGS(rtol=0.0, atol=1e-2, norm=optx.max_norm)
    y = jnp.zeros(whiten.shape[1])
    state, steps, done = _begin(solver, y), 0, False
    while not done and steps < STEPS:
        ahead = vector + whiten @ state.y_eval
        told = FAR_OFF, jnp.zeros_like(y)
        if (np.abs(ahead - vector) < reach).all():  # once a search reaches this limit, most steps lie beyond it
            value, gradient = gradient_at(coordinates, ahead, summary, rules)
            if np.isfinite(value):
                told = reference - value, -(whiten.T @ gradient)
        y, state, done = _step(solver, y, told, state)
        steps += 1
    return vector + whiten @ y, steps


def _told(y, told):
    """The function with the given value and slope at `y`."""
    value, slope = told
    return value + slope @ (y - jax.lax.stop_gradient(y)), None


@eqx.filter_jit
def _begin(solver, y):
    return solver.init(_told, y, None, {}, jax.ShapeDtypeStruct((), y.dtype), None, frozenset())


@eqx.filter_jit
def _step(solver, y, told, state):
    y, state, _ = solver.step(_told, y, told, {}, state, frozenset())
    done, _ = solver.terminate(_told, y, told, {}, state, frozenset())
    return y, state, done


def _gradients(coordinates, summary, rules, points):
    """Values and gradients at `points`, one at a time."""
    found = [gradient_at(coordinates, point, summary, rules) for point in jnp.asarray(points)]
    values, gradients = zip(*found, strict=True)
    return np.asarray(values), np.asarray(gradients)


def _curvature(coordinates, vector, whiten, gradients_at):
    """Value, gradient and whitening W at `vector`, where W W' is the inverse of the negative Hessian.

    The Hessian comes from differences of exact gradients along the columns of an earlier W. There all directions have
    similar curvature, so one that is a thousand times better known than another does not swamp it. Repeated if the
    earlier W was too far off.
    """
    active = ~_idle(coordinates, vector)
    # Idle coordinates, along which nothing changes, are left out and keep their unit.
    inner = _root((whiten @ whiten.T)[np.ix_(active, active)])
    whole = np.eye(len(vector))
    for _ in range(REFINEMENTS):
        steps = DIFFERENCE_SIGMA / np.maximum(np.abs(inner).max(0), 1.0)
        points = np.repeat(np.asarray(vector)[None], len(vector) + 1, axis=0)
        points[1 : 1 + active.sum(), active] += (inner * steps).T
        values, gradients = (np.asarray(x) for x in gradients_at(points))
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
    """Coordinates of parameters at a bound, so far out that nothing changes."""
    return coordinates.inside(vector) < IDLE_BELOW


def _root(covariance: np.ndarray) -> np.ndarray:
    """A square root W, W W' = covariance, of a matrix whose entries may differ by orders of magnitude."""
    scale = np.sqrt(np.diagonal(covariance))
    values, vectors = np.linalg.eigh(covariance / scale[:, None] / scale[None, :])
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 1e-15))


def _in_parameters(coordinates, vector, whiten, gradient_anew) -> np.ndarray:
    """Information on the parameters themselves, from the whitening of the coordinates.

    A parameter at a bound (no dark current, no row gain, a white share of 0 or 1) has a coordinate far out where
    nothing changes; its row is measured between two values off the bound, within what the data resolve. `gradient_anew`
    plans the rules at each point, because the nodes for rows without gain all lie at 1.
    """
    slope = np.asarray(parameters_at(coordinates, vector)[2])
    active = ~_idle(coordinates, vector)
    inverse = np.linalg.inv(slope[active, None] * whiten[np.ix_(active, active)])
    information = np.zeros((len(vector), len(vector)))
    information[np.ix_(active, active)] = inverse.T @ inverse
    at_bound = np.flatnonzero(coordinates.inside(vector) < 0).tolist()
    for i in at_bound:
        ends = [coordinates.put_inside(vector, i, depth) for depth in (0.0, 1.5)]
        gradients = [gradient_anew(end)[1][0] for end in ends]
        at_ends = (parameters_at(coordinates, jnp.asarray(e)) for e in ends)
        values, slopes = zip(*(map(np.asarray, at_end[1:3]) for at_end in at_ends), strict=True)
        low, high = (np.asarray(g) / s for g, s in zip(gradients, slopes, strict=True))
        row = -(high - low) / (values[1][i] - values[0][i])
        if row[i] <= 0:
            row[i] = low[i] ** 2  # falls from the bound like an exponential distribution, whose deviation is 1 / slope
        alone = np.where(np.arange(len(row)) == i, row, 0.0)
        coupled = np.where(np.isin(np.arange(len(row)), at_bound), alone, row)
        # The couplings are measured over a range and may contradict the rest: then they are left out.
        for chosen in (coupled, alone):
            information[i], information[:, i] = chosen, chosen
            if _is_positive(information, [j for j in range(len(row)) if j == i or j not in at_bound]):
                break
    return information


def _is_positive(matrix: np.ndarray, places: list[int]) -> bool:
    part = matrix[np.ix_(places, places)]
    scale = np.sqrt(np.maximum(np.diagonal(part), 0.0))
    if not scale.all():
        return False
    return bool(np.linalg.eigvalsh(part / scale[:, None] / scale[None, :]).min() > 1e-9)


def _ended(coordinates, vector, whiten, information, value, iterations, distance, close_sigma=CLOSE_SIGMA) -> Maximum:
    (model, outliers), values, _, log_prior = jax.tree.map(np.asarray, parameters_at(coordinates, vector))
    return Maximum(
        model=model,
        outliers=outliers,
        values=values,
        information=information,
        log_likelihood=value - float(log_prior),
        iterations=iterations,
        converged=bool(distance < close_sigma),
        outcome=f"the next Newton step is {distance:.1g} standard errors long" if np.isfinite(distance) else "diverged",
        vector=np.asarray(vector),
        whiten=whiten,
    )
