"""What a candidate does to the statistics: mean shift and spread against amplitude, by common random numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hsnoise.criticism.candidates import made
from hsnoise.effects import Maker
from hsnoise.likelihood.parameters import Number, numbers_of, read_noise_dn
from hsnoise.model import NoiseModel
from hsnoise.simulation.gaussian import Gaussian
from hsnoise.simulation.reference import Reference
from hsnoise.simulation.simulator import Simulator

RELATIVE_ERROR = 0.12  # of a shift: details and interpolation
DRAWN_ERROR = 0.05  # of a shift drawn at an amplitude that is searched further
NEARBY_ERROR = 0.02  # of a shift drawn with parameters brought close to the capture
SLOPE_DRAWS = 2
STEP, REACH = 0.03, 5.0  # relative step of a base parameter, and how many such steps it may be off
FAR_REACH = 30.0  # likewise, of the row gain: another kind of row noise can pass for a row gain where there is none
SPECTRUM_STEP = 0.05  # of the exponent and the white share of the row gain
BASE = (("gain", "value"), ("dark_current", "rate"), ("read_noise", "sigma"), ("row_gain", "sigma"))
LEVEL, SPECTRUM = ("black_level", "value"), (("row_gain", "exponent"), ("row_gain", "white_share"))


@dataclass(frozen=True)
class Fingerprint:
    """Shifts of the statistics [amplitude, detail, statistic] in units of the base draws' deviation.

    error: of a shift, relative.
    """

    name: str
    maker: Maker
    amplitudes: tuple[float, ...]
    shifts: np.ndarray
    error: float = RELATIVE_ERROR

    def distribution(self, amplitude: float, null: Gaussian) -> Gaussian:
        """Distribution of the statistics with the effect at `amplitude` in the sensor."""
        return distribution_of(self.at(amplitude), null, self.error)

    def at(self, amplitude: float) -> np.ndarray:
        """Shifts [detail, statistic], interpolated between the amplitudes that were drawn, linear from 0."""
        knots = (0.0, *self.amplitudes)
        values = np.concatenate([np.zeros_like(self.shifts[:1]), self.shifts])
        i = min(int(np.searchsorted(knots, amplitude, side="right")), len(knots) - 1)
        share = (amplitude - knots[i - 1]) / (knots[i] - knots[i - 1])
        return values[i - 1] + share * (values[i] - values[i - 1])


def distribution_of(
    shifts: np.ndarray, null: Gaussian, error: float = RELATIVE_ERROR, *, of_details: bool = True
) -> Gaussian:
    """Distribution of the statistics where an effect shifts them by one of `shifts` [detail, statistic].

    error: of a shift, relative; of_details: whether the scatter over details is included.
    """
    mean = shifts.mean(0)
    covariance = null.covariance.copy()
    covariance[np.diag_indices_from(covariance)] += (error * mean) ** 2
    if of_details:
        spread = (shifts - mean) / np.sqrt(max(len(shifts) - 1, 1))
        covariance += spread.T @ spread
    return Gaussian(mean, covariance)


@dataclass(frozen=True)
class Bench:
    """The common base for drawing candidates: the simulator of the model, and draws of the model itself."""

    simulator: Simulator
    base: Reference

    @staticmethod
    def of(simulator: Simulator, draws: int) -> Bench:
        return Bench(simulator, simulator.reference(simulator.model, draws))

    @property
    def model(self) -> NoiseModel:
        return self.simulator.model

    @property
    def z(self) -> np.ndarray:
        """The capture [statistic] in units of the base draws' deviation."""
        return self.base.z(self.simulator.measured.values)

    def fingerprints(self, wanted: Mapping[str, tuple[Maker, tuple[float, ...]]], details: int) -> list[Fingerprint]:
        """Draw candidates, by name a maker and amplitudes, on top of the model; each amplitude with several details.

        All are drawn in one go, details outermost, so that one effect is compiled while another is drawn, and none is
        compiled twice.
        """
        tasks = [
            (name, amplitude, detail)
            for detail in range(details)
            for name, (_, amplitudes) in wanted.items()
            for amplitude in amplitudes
        ]
        if not tasks:
            return []
        models = [(self.model.add(made(wanted[name][0], *rest)), rest[1]) for name, *rest in tasks]
        shifts = dict(zip(tasks, self.shifts(models), strict=True))
        return [
            Fingerprint(name, maker, of, np.array([[shifts[name, a, detail] for detail in range(details)] for a in of]))
            for name, (maker, of) in wanted.items()
        ]

    def slopes(self) -> np.ndarray:
        """Shifts that wrong base parameters could cause [parameter, statistic]: a refit would absorb them."""
        moved, reach = zip(*_moved_models(self.model), strict=True)
        steps = 1 / np.array(reach)
        return self.simulator.slopes(self.model, moved, steps, SLOPE_DRAWS).mean(0) / self.base.deviation

    def shifts(self, wanted: Sequence[tuple[NoiseModel, int]]) -> np.ndarray:
        """Statistics of draws of changed models, by model and number, less those of the model [draw, statistic].

        From the same random numbers, in units of the base draws' deviation.
        """
        numbers = [number for _, number in wanted]
        return (self.simulator.drawn(wanted) - self.base.draws[numbers]) / self.base.deviation


def base_numbers(model: NoiseModel) -> list[Number]:
    """The numbers of the base model that may be wrong: a refit would move them."""
    places = (*BASE, LEVEL, *(SPECTRUM if model.shutter == "rolling" else ()))
    own = [n for n in numbers_of(model) if n.place in places]
    return [n for n in own if not n.spec.holds(n.value_in(model))]


def _moved_models(model: NoiseModel) -> list[tuple[NoiseModel, float]]:
    """For each base parameter: the model with it a little off, and how many such steps it may be off."""
    models = []
    for number in base_numbers(model):
        value = number.value_in(model)
        # A black level is off by a share of the noise, not of itself.
        step = 0.5 * STEP * read_noise_dn(model) if number.place == LEVEL else STEP * value
        step = SPECTRUM_STEP if number.place in SPECTRUM else step
        reach = FAR_REACH if number.place == ("row_gain", "sigma") else REACH
        models.append((number.put_in(model, min(value + step, number.bounds[1])), reach))
    return models
