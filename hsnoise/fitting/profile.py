"""Standard errors where the gain is weakly known: there the likelihood is no parabola and its curvature too sure."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hsnoise.fitting.maximise import Maximum, quasi_newton
from hsnoise.likelihood.coordinates import Coordinates
from hsnoise.likelihood.gradients import gradient_at, rules_at
from hsnoise.likelihood.plan import replan
from hsnoise.likelihood.summary import Summary, without_counts

WEAK = 0.12  # standard error of the log gain from which the curvature is not trusted
FIRST_SIGMA, ENOUGH_SIGMA, STEPS = 2.0, 1.5, 4
FARTHEST = 3.0  # of the log gain
LEAST_Z = 0.3  # a likelihood flatter than this is taken for this


def profile_errors(coordinates: Coordinates, maximum: Maximum, summary: Summary) -> np.ndarray:
    """Standard errors of the parameters from the profile likelihood of the mean log gain; 0 where it is well known.

    The gain is moved up and down until the likelihood, maximised over all else, has fallen by that of about two
    standard errors; what a parameter moved by, over the number of standard errors fallen, is its error.
    """
    gains = coordinates.where("gain")
    pin = gains / gains.sum()
    along = maximum.whiten.T @ pin
    sigma = float(np.linalg.norm(along))
    if sigma < WEAK or not maximum.converged:
        return np.zeros(len(pin))
    across = np.linalg.svd(along[None])[2][1:].T  # whitened directions that leave the gain where it is
    rules = rules_at(coordinates, maximum.vector, summary)
    top, _ = gradient_at(coordinates, jnp.asarray(maximum.vector), without_counts(summary), rules)
    direction = maximum.whiten @ along / sigma
    sides = [_side(coordinates, maximum, summary, rules, float(top), sign * direction, across) for sign in (-1, 1)]
    return np.max(sides, axis=0)


def _side(coordinates, maximum: Maximum, summary: Summary, rules, top: float, direction, across) -> np.ndarray:
    light = without_counts(summary)
    shift, step = FIRST_SIGMA, np.abs(direction[coordinates.where("gain").argmax()])
    for _ in range(STEPS):
        shift = min(shift, FARTHEST / step)
        vector = maximum.vector + shift * direction
        rules = replan(rules, rules_at(coordinates, vector, summary))
        reach = coordinates.reach(vector)
        vector, _ = quasi_newton(coordinates, vector, maximum.whiten @ across, reach, top, light, rules)
        value, _ = gradient_at(coordinates, vector, light, rules)
        z = np.sqrt(2 * max(top - float(value), 0.0))
        if z > ENOUGH_SIGMA or shift * step >= FARTHEST:
            break
        shift *= float(np.clip(2 / max(z, LEAST_Z), 1.2, 3.0))
    moved = np.asarray(coordinates.values(vector)) - maximum.values
    return np.abs(moved) / max(z, LEAST_Z)
