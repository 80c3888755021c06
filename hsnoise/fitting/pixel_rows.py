"""What the rows of a frame share: how one row resembles the next, and the next but one; the row gain of darks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hsnoise._core.coloured import EXPONENTS, banks_of, exponent_of, fading_power, power_of_banks
from hsnoise.fitting.pixel_joint import UNKNOWN
from hsnoise.statistics.decomposition import Component, mean_of
from hsnoise.statistics.pixels.banding import Banding
from hsnoise.statistics.pixels.sample import without_outliers
from hsnoise.statistics.pixels.survey import Group, Plane, Survey

TOGETHER = 6.0  # chance deviations above which rows are not white
COMBED = 4.0  # above which a row resembles the next but one more than the next: in one series of rows it is less
LEAST_ERROR = 0.01  # of an exponent or a share: no spectrum is exactly a power law
HIT = 2.0  # ratio of the mean temporal variance to that without outliers: hits make most of it

Number = tuple[float, float]


class RowSpectrum(NamedTuple):
    """The spectrum of what rows share in a frame, values with their errors.

    exponent: of one series over all rows; 0 if they are white. The error is infinite then, and if rows are redder or
    bluer than any exponent allows. banks: exponent and shared part of the variance if two banks convert even and odd
    rows; else None. It shows in mono sensors, whose planes have all rows. widened: factor on the error of the variance
    of the rows that holds for independent rows: where they resemble each other, there are fewer.
    """

    exponent: Number
    banks: tuple[Number, Number] | None
    widened: float


WHITE = RowSpectrum((0.0, np.inf), None, 1.0)


def row_spectrum(
    planes: Sequence[Plane], rows: int, known_dn2: Callable[[int], float] = lambda apart: 0.0
) -> RowSpectrum:
    """The spectrum from the covariance of rows of one colour's planes; rows: of the frame.

    known_dn2: the part of the covariance of rows so far apart that is of other effects.
    """
    if not planes:
        return WHITE
    step = rows // len(planes[0].row_mean_dn)
    alone, near, but_one = _covariances(planes, "row", step, known_dn2)
    if alone.variance_dn2 <= 0:
        return WHITE
    combed = (but_one.variance_dn2 - near.variance_dn2) / np.hypot(but_one.chance_dn2, near.chance_dn2)
    banks = None
    if step == 1 and combed > COMBED and near.variance_dn2 > -TOGETHER * near.chance_dn2:
        of = np.array([near.variance_dn2, but_one.variance_dn2]) / alone.variance_dn2
        errors = np.array([near.standard_error_dn2, but_one.standard_error_dn2]) / alone.variance_dn2
        banks = _banks(of, np.hypot(errors, of * alone.standard_error_dn2 / alone.variance_dn2), rows)
    exponent = _exponent(near, alone, rows, step)
    power = fading_power(rows, np.float32(exponent[0])) if banks is None else _power_of(banks, rows)
    return RowSpectrum(exponent, banks, widened(np.array(power, float)))


def column_spectrum(planes: Sequence[Plane], columns: int, known_dn2: float) -> RowSpectrum:
    """Likewise of what columns share in a frame; known_dn2: their variance by other effects."""
    if not planes:
        return WHITE
    step = columns // len(planes[0].column_mean_dn)
    alone, near, _ = _covariances(planes, "column", step, lambda apart: known_dn2)
    if alone.variance_dn2 <= TOGETHER * alone.chance_dn2:
        return WHITE
    exponent = _exponent(near, alone, columns, step)
    return RowSpectrum(exponent, None, widened(np.array(fading_power(columns, np.float32(exponent[0])), float)))


def _covariances(
    planes: Sequence[Plane], axis: str, step: int, known_dn2: Callable[[int], float]
) -> tuple[Component, ...]:
    """Variance of lines over frames, and covariance of neighbours and of the next but one, without what is known."""
    parts = [(p.components[f"{axis}_x_frame"], *getattr(p, f"{axis}s_together")) for p in planes]
    means = [mean_of(list(of)) for of in zip(*parts, strict=True)]
    return tuple(replace(one, variance_dn2=one.variance_dn2 - known_dn2(lag * step)) for lag, one in enumerate(means))


def _exponent(near: Component, alone: Component, rows: int, step: int) -> Number:
    """Of one series, from the covariance of rows `step` apart and their variance."""
    if abs(near.variance_dn2) < TOGETHER * near.chance_dn2:
        return WHITE.exponent
    correlation = near.variance_dn2 / alone.variance_dn2
    error = np.hypot(near.standard_error_dn2, correlation * alone.standard_error_dn2) / alone.variance_dn2
    low, middle, high = (exponent_of(correlation + way * error, rows, step) for way in (-1, 0, 1))
    return middle, np.inf if middle in EXPONENTS else max((high - low) / 2, LEAST_ERROR)


def _power_of(banks: tuple[Number, Number], rows: int) -> np.ndarray:
    (exponent, _), (shared, _) = banks
    return np.array(power_of_banks(rows, np.float32(exponent), shared), float)


def widened(power: np.ndarray) -> float:
    """Root of the sum of squared correlations at all lags (Bartlett's formula for a variance)."""
    power[0] = 0.0  # the mean of the rows is the frame's
    return float(np.sqrt(np.mean(power**2)) / np.mean(power))


def _banks(correlations: np.ndarray, errors: np.ndarray, rows: int) -> tuple[Number, Number]:
    """Exponent and shared part from the correlations one and two rows apart, and their errors."""

    def numbers(of: np.ndarray) -> np.ndarray:
        return np.array(banks_of(float(of[0]), float(of[1]), rows))

    found = numbers(correlations)
    at = (float(found[0]), 0.0), (float(np.clip(found[1], 0, 1)), 0.0)
    wide = errors * widened(_power_of(at, rows))
    # Whole errors, up and down: at a bound of the exponent, derivatives of one side are zero.
    steps = np.stack([wide, -wide])[..., None] * np.eye(2)
    apart = np.abs([[numbers(correlations + step) - found for step in of] for of in steps]).max(0)
    error = np.maximum(np.sqrt((apart**2).sum(0)), LEAST_ERROR)
    return (at[0][0], float(error[0])), (at[1][0], float(error[1]))


def row_gain_of_darks(
    found: Survey, c: int, spectrum: RowSpectrum, banding: tuple[str, Banding] | None, growth: float
) -> tuple[float, float]:
    """Variance of the row gain, from the growth of the variance of row means with the squared signal; its error.

    Rows that resemble each other, bands, and noise of some frames vary more from exposure to exposure.
    """
    groups = found.repeated_darks
    signal = growth * np.array([g.exposure_s for g in groups])
    parts = [_rows_over_frames(group, c) for group in groups]
    y = np.array([one.variance_dn2 for one in parts])
    error = spectrum.widened * np.array([one.standard_error_dn2 for one in parts]) + 1e-12
    of_band = banding[1].error_dn2 if banding is not None and banding[0] == "row" else 0.0
    error = np.maximum(np.hypot(error, of_band), [g.rows_error_dn2(c) for g in groups])
    if len(groups) < 2 or np.ptp(signal) <= 0:
        return 0.0, UNKNOWN
    unit = float(np.abs(signal).max())  # signals of a thousandth of a count would be lost in the inverse
    design = np.stack([np.ones_like(signal), (signal / unit) ** 2], 1) / error[:, None]
    covariance = np.linalg.pinv(design.T @ design)
    theta = covariance @ design.T @ (y / error)
    error_of_gain = float(np.sqrt(covariance[1, 1])) / unit**2
    return (float(theta[1]) / unit**2, error_of_gain) if error_of_gain < 1 else (0.0, UNKNOWN)


def _rows_over_frames(group: Group, c: int) -> Component:
    """Variance of rows over frames; where hits make most of the noise, without them: tracks lie in few rows."""
    planes = group.of(c)
    found = mean_of([p.components["row_x_frame"] for p in planes])
    noise_dn2 = without_outliers(group.pixels(c, "pair_variance_dn2").astype(np.float64), group.n_frames)[0]
    if np.mean([p.components["temporal"].variance_dn2 for p in planes]) < HIT * noise_dn2:
        return found
    cut = float(np.mean([p.halves.rows_dn2 for p in planes]))
    return replace(found, variance_dn2=min(found.variance_dn2, cut))
