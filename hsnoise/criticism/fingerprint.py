"""What a candidate does to the statistics: mean shift and spread against amplitude, by common random numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from hsnoise._core.threads import in_threads
from hsnoise.criticism.candidates import made
from hsnoise.criticism.gaussian import Gaussian
from hsnoise.criticism.reference import Reference, measure
from hsnoise.effects import Maker
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import draw_capture

RELATIVE_ERROR = 0.12  # of a shift: details and interpolation
SLOPE_DRAWS = 3
STEP, REACH = 0.03, 5.0  # relative step of a base parameter, and how many of them it may be off
BASE = {"gain": "value", "dark_current": "rate", "read_noise": "sigma", "row_gain": "sigma", "black_level": "value"}

Task = tuple[Maker, float, int]  # candidate, amplitude, detail


@dataclass(frozen=True)
class Fingerprint:
    """Shifts of the statistics [amplitude, detail, statistic] in units of the base draws' deviation."""

    name: str
    maker: Maker
    amplitudes: tuple[float, ...]
    shifts: np.ndarray

    def law(self, amplitude: float, null: Gaussian) -> Gaussian:
        """Law of the statistics with the effect at `amplitude` in the sensor."""
        return law_of(self.at(amplitude), null)

    def at(self, amplitude: float) -> np.ndarray:
        """Shifts [detail, statistic], interpolated between the amplitudes that were drawn, linear from 0."""
        knots = (0.0, *self.amplitudes)
        values = np.concatenate([np.zeros_like(self.shifts[:1]), self.shifts])
        i = min(int(np.searchsorted(knots, amplitude, side="right")), len(knots) - 1)
        share = (amplitude - knots[i - 1]) / (knots[i] - knots[i - 1])
        return values[i - 1] + share * (values[i] - values[i - 1])


def law_of(shifts: np.ndarray, null: Gaussian, of_details: bool = True) -> Gaussian:
    """Law of the statistics with something in the sensor that shifts them by one of `shifts` [detail, statistic].

    of_details: their scatter is part of it.
    """
    mean = shifts.mean(0)
    covariance = null.covariance + np.diag((RELATIVE_ERROR * mean) ** 2)
    if of_details:
        spread = shifts - mean
        covariance = covariance + spread.T @ spread / max(len(shifts) - 1, 1)
    return Gaussian(mean, covariance)


@dataclass(frozen=True)
class Bench:
    """What every candidate is drawn on: the model, a capture to be like, the draws of the model, where seeds start.

    `drawn` holds shifts [statistic] by candidate, amplitude and detail.
    """

    model: NoiseModel
    part: FrameStack
    base: Reference
    seed: int
    tick: Callable[[], None]
    drawn: dict[Task, np.ndarray] = field(default_factory=dict)

    def fingerprints(self, wanted: Mapping[str, tuple[Maker, tuple[float, ...]]], details: int) -> list[Fingerprint]:
        """Draw candidates, by name a maker and amplitudes, on top of the model; each amplitude with several details.

        The draws share their random numbers with those of the model. All are drawn in one go, so that one effect is
        compiled while another is drawn, and none a second time.
        """
        tasks = [
            (maker, amplitude, detail)
            for detail in range(details)
            for maker, amplitudes in wanted.values()
            for amplitude in amplitudes
        ]
        new = [task for task in tasks if task not in self.drawn]

        def draw(task: Task) -> np.ndarray:
            return self.shift(self.model.add(made(*task)), task[2])

        self.drawn.update(zip(new, in_threads(draw, new, self.tick), strict=True))
        prints = []
        for name, (maker, amplitudes) in wanted.items():
            shifts = [[self.drawn[maker, amplitude, detail] for detail in range(details)] for amplitude in amplitudes]
            prints.append(Fingerprint(name, maker, amplitudes, np.array(shifts)))
        return prints

    def slopes(self) -> np.ndarray:
        """Shifts that wrong base parameters could make [parameter, statistic]: what a refit would absorb."""
        moved = _moved_models(self.model)
        tasks = [(one, number) for one in moved for number in range(SLOPE_DRAWS)]
        shifts = in_threads(lambda task: self.shift(*task), tasks, self.tick)
        return REACH * np.stack(shifts).reshape(len(moved), SLOPE_DRAWS, -1).mean(1)

    def shift(self, changed: NoiseModel, number: int) -> np.ndarray:
        """Statistics of draw `number` of a changed model less those of the model, of the same random numbers."""
        values = measure(draw_capture(self.seed + number, changed, self.part), self.model).values
        return (values - self.base.draws[number]) / self.base.deviation


def _moved_models(model: NoiseModel) -> list[NoiseModel]:
    """The model with one base parameter a little off, for each of them."""
    models = []
    for name, what in BASE.items():
        if name not in model:
            continue
        value = np.asarray(getattr(model[name], what), float)
        # A black level is off by a share of the noise, not of itself.
        noise_dn = float(np.mean(np.asarray(model["gain"].value))) * float(model["read_noise"].sigma)
        steps = np.full(value.shape, 0.5 * STEP * noise_dn) if name == "black_level" else STEP * value
        for i in np.ndindex(value.shape):
            changed = value.copy()
            changed[i] += steps[i]
            models.append(model.with_value(name, what, changed))
    if "row_gain" in model and model.shutter == "rolling":
        models.append(model.with_value("row_gain", "exponent", np.asarray(model["row_gain"].exponent) + 0.05))
        share = float(model["row_gain"].white_share)
        if 0 < share < 1:
            models.append(model.with_value("row_gain", "white_share", min(share + 0.05, 1.0)))
    return models
