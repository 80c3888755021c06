"""What a candidate does to the statistics: mean shift and spread against amplitude, by common random numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from hsnoise.criticism.candidates import Maker, seeded
from hsnoise.criticism.gaussian import Gaussian
from hsnoise.criticism.reference import Reference
from hsnoise.draws import black_level_of, draw_capture, in_threads
from hsnoise.effects import AbstractEffect
from hsnoise.model import NoiseModel
from hsnoise.stack import FrameStack
from hsnoise.structure import structure

AMPLITUDES = (0.35, 1.0, 2.5)
DETAILS = 4  # draws at each amplitude, each with other details
GRID = np.geomspace(0.15, 5.0, 18)
RELATIVE_ERROR = 0.12  # of a shift: details and interpolation
SLOPE_DRAWS = 3
STEP, REACH = 0.03, 5.0  # relative step of a base parameter, and how many of them it may be off
BASE = {"gain": "value", "dark_current": "rate", "read_noise": "sigma", "row_gain": "sigma", "black_level": "value"}


@dataclass(frozen=True)
class Fingerprint:
    """Shifts of the statistics [amplitude, detail, statistic] in units of the base draws' deviation."""

    name: str
    effect: Callable[[int, float], AbstractEffect]
    shifts: np.ndarray

    def law(self, amplitude: float, null: Gaussian) -> Gaussian:
        """Law of the statistics with the effect at `amplitude` in the sensor."""
        shifts = self.at(amplitude)
        mean = shifts.mean(0)
        spread = shifts - mean
        scatter = spread.T @ spread / max(len(shifts) - 1, 1)
        return Gaussian(mean, null.covariance + scatter + np.diag((RELATIVE_ERROR * mean) ** 2))

    def at(self, amplitude: float) -> np.ndarray:
        """Shifts [detail, statistic], interpolated between the amplitudes that were drawn, linear from 0."""
        knots = (0.0, *AMPLITUDES)
        values = np.concatenate([np.zeros_like(self.shifts[:1]), self.shifts])
        i = min(int(np.searchsorted(knots, amplitude, side="right")), len(knots) - 1)
        share = (amplitude - knots[i - 1]) / (knots[i] - knots[i - 1])
        return values[i - 1] + share * (values[i] - values[i - 1])


def fingerprint(
    name: str, maker: Maker, model: NoiseModel, darks: FrameStack, base: Reference, seed: int, tick
) -> Fingerprint:
    """Draw a candidate on top of the model; the draws share their random numbers with those of `base`."""
    black = black_level_of(model)

    def shift(task: tuple[float, int]) -> np.ndarray:
        amplitude, detail = task
        effect = seeded(maker, detail)(amplitude)
        values = structure(draw_capture(seed + detail, model.add(effect), darks), black).values
        return (values - base.draws[detail]) / base.deviation

    tasks = [(amplitude, detail) for amplitude in AMPLITUDES for detail in range(DETAILS)]
    shifts = np.stack(in_threads(shift, tasks, tick)).reshape(len(AMPLITUDES), DETAILS, -1)
    return Fingerprint(name, lambda detail, amplitude: seeded(maker, detail)(amplitude), shifts)


def base_slopes(model: NoiseModel, darks: FrameStack, base: Reference, seed: int, tick) -> np.ndarray:
    """Shifts that wrong base parameters could make [parameter, statistic]: what a refit would absorb."""
    black = black_level_of(model)
    moved = _moved_models(model)

    def shift(task: tuple[int, int]) -> np.ndarray:
        which, draw = task
        values = structure(draw_capture(seed + draw, moved[which], darks), black).values
        return (values - base.draws[draw]) / base.deviation

    tasks = [(which, draw) for which in range(len(moved)) for draw in range(SLOPE_DRAWS)]
    shifts = np.stack(in_threads(shift, tasks, tick)).reshape(len(moved), SLOPE_DRAWS, -1)
    return REACH * shifts.mean(1)


def _moved_models(model: NoiseModel) -> list[NoiseModel]:
    """The model with one base parameter a little off, for each of them."""
    models = []
    for name, field in BASE.items():
        if name not in model:
            continue
        value = np.asarray(getattr(model[name], field), float)
        # A black level is off by a share of the noise, not of itself.
        noise_dn = float(np.mean(np.asarray(model["gain"].value))) * float(model["read_noise"].sigma)
        steps = np.full(value.shape, 0.5 * STEP * noise_dn) if name == "black_level" else STEP * value
        for i in np.ndindex(value.shape):
            changed = value.copy()
            changed[i] += steps[i]
            models.append(_with(model, name, field, changed))
    if "row_gain" in model and model.shutter == "rolling":
        models.append(_with(model, "row_gain", "exponent", np.asarray(model["row_gain"].exponent) + 0.05))
    return models


def _with(model: NoiseModel, name: str, field: str, value: np.ndarray) -> NoiseModel:
    changed = eqx.tree_at(lambda effect: getattr(effect, field), model[name], jnp.asarray(value))
    return model.remove(name).add(changed)
