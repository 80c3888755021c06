"""What the rows of a frame share: how one row resembles the next, and the next but one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hsnoise._core.coloured import EXPONENTS, banks_of, exponent_of
from hsnoise.statistics.decomposition import mean_of
from hsnoise.statistics.pixels.survey import Plane

TOGETHER = 6.0  # chance deviations above which rows are not white, or resemble the next but one more than the next
LEAST_ERROR = 0.01  # of an exponent or a share: no spectrum is exactly a power law
STEP = 1e-3  # of a correlation, for derivatives

Number = tuple[float, float]


class RowSpectrum(NamedTuple):
    """The spectrum of what rows share in a frame, values with their errors.

    exponent: of one series over all rows; 0 if they are white. The error is infinite then, and if rows are redder or
    bluer than any exponent allows. banks: exponent and shared part of the variance if two banks convert even and odd
    rows; else None. It shows in mono sensors, whose planes have all rows.
    """

    exponent: Number
    banks: tuple[Number, Number] | None


WHITE = RowSpectrum((0.0, np.inf), None)


def row_spectrum(planes: Sequence[Plane], rows: int) -> RowSpectrum:
    """The spectrum from the covariance of rows of one colour's planes; rows: of the frame."""
    if not planes:
        return WHITE
    alone = mean_of([p.components["row_x_frame"] for p in planes])
    near, but_one = (mean_of([p.rows_together[lag] for p in planes]) for lag in (0, 1))
    if alone.variance_dn2 <= 0:
        return WHITE
    combed = (but_one.variance_dn2 - near.variance_dn2) / np.hypot(but_one.chance_dn2, near.chance_dn2)
    step = rows // len(planes[0].row_mean_dn)
    banks = None
    if step == 1 and combed > TOGETHER and near.variance_dn2 > -TOGETHER * near.chance_dn2:
        of = np.array([near.variance_dn2, but_one.variance_dn2]) / alone.variance_dn2
        errors = np.array([near.standard_error_dn2, but_one.standard_error_dn2]) / alone.variance_dn2
        banks = _banks(of, np.hypot(errors, of * alone.standard_error_dn2 / alone.variance_dn2), rows)
    if abs(near.variance_dn2) < TOGETHER * near.chance_dn2:
        return RowSpectrum(WHITE.exponent, banks)
    correlation = near.variance_dn2 / alone.variance_dn2
    error = np.hypot(near.standard_error_dn2, correlation * alone.standard_error_dn2) / alone.variance_dn2
    low, middle, high = (exponent_of(correlation + way * error, rows, step) for way in (-1, 0, 1))
    exponent = (middle, np.inf) if middle in EXPONENTS else (middle, max((high - low) / 2, LEAST_ERROR))
    return RowSpectrum(exponent, banks)


def _banks(correlations: np.ndarray, errors: np.ndarray, rows: int) -> tuple[Number, Number]:
    """Exponent and shared part from the correlations one and two rows apart, and their errors."""

    def numbers(of: np.ndarray) -> np.ndarray:
        return np.array(banks_of(float(of[0]), float(of[1]), rows))

    found = numbers(correlations)
    slopes = np.stack([numbers(correlations + step) - found for step in STEP * np.eye(2)]) / STEP
    error = np.maximum(np.sqrt(((slopes * errors[:, None]) ** 2).sum(0)), LEAST_ERROR)
    return (float(found[0]), float(error[0])), (float(found[1]), float(error[1]))
