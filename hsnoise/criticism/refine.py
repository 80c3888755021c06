"""A candidate's parameters brought closer to the capture: a few Gauss-Newton steps on simulated statistics."""

from __future__ import annotations

import numpy as np

from hsnoise._threads import in_threads
from hsnoise.criticism.fingerprint import RELATIVE_ERROR, Bench
from hsnoise.criticism.ranking import Evidence
from hsnoise.effects import AbstractEffect
from hsnoise.model import NoiseModel
from hsnoise.synthetic import Knob, knobs

ITERATIONS = 3
DRAWS, SLOPE_DRAWS = 6, 3
STEP, LONGEST_STEP = 0.2, 1.0  # of an unconstrained number: mostly a logarithm
PRIOR_SIGMA = 1.0


def refined(effect: AbstractEffect, bench: Bench, evidence: Evidence) -> AbstractEffect:
    """`effect` with the parameters at which its draws come closest to the capture."""
    model = bench.model.add(effect)
    turned = knobs(model, (effect.name,))
    y = np.array([knob.read(model) for knob in turned])
    for _ in range(ITERATIONS):
        shifts, slopes = _shifts_and_slopes(model, turned, y, bench)
        mean = shifts.mean(0)
        covariance = evidence.null.covariance + np.diag((RELATIVE_ERROR * mean) ** 2 + shifts.var(0, ddof=1))
        weighted = np.linalg.solve(covariance, slopes).T
        information = weighted @ slopes + np.eye(len(y)) / PRIOR_SIGMA**2
        step = np.linalg.solve(information, weighted @ (evidence.z - mean))
        y = y + step * min(1.0, LONGEST_STEP / max(np.abs(step).max(), 1e-12))
    return _at(model, turned, y)[effect.name]


def _shifts_and_slopes(
    model: NoiseModel, turned: list[Knob], y: np.ndarray, bench: Bench
) -> tuple[np.ndarray, np.ndarray]:
    """Shifts at y [draw, statistic] and their derivatives [statistic, knob], by common random numbers."""
    moved = [_at(model, turned, y + STEP * (np.arange(len(y)) == i)) for i in range(len(y))]
    tasks = [(_at(model, turned, y), number) for number in range(DRAWS)]
    tasks += [(one, number) for one in moved for number in range(SLOPE_DRAWS)]
    drawn = np.stack(in_threads(lambda task: bench.shift(*task), tasks, bench.tick))
    shifts = drawn[:DRAWS]
    apart = drawn[DRAWS:].reshape(len(y), SLOPE_DRAWS, -1) - shifts[None, :SLOPE_DRAWS]
    return shifts, apart.mean(1).T / STEP


def _at(model: NoiseModel, turned: list[Knob], y: np.ndarray) -> NoiseModel:
    for knob, x in zip(turned, y, strict=True):
        model = knob.put(model, x)
    return model
