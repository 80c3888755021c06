"""Gain, read noise and dark current of all colours together: electrons are the same in every colour."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from hsnoise.statistics.pixels.transfer import ROUNDING

ROUNDS = 30
ROW_GAIN_THERE = 3.0  # standard errors of its variance
UNKNOWN = 1e6  # relative error of an unknown value


class Channel(Protocol):
    """What a colour says alone: gain, variance without signal and growth, their covariance; row gain's variance."""

    values: np.ndarray
    covariance: np.ndarray
    row_gain: tuple[float, float]


def joint_estimate(channels: Sequence[Channel]) -> tuple[np.ndarray, np.ndarray]:
    """Gain [channel], read noise and dark current in electrons, which all colours share, by least squares."""
    n = len(channels)
    if all(one.covariance[0, 0] >= UNKNOWN**2 for one in channels):
        return np.append(np.ones(n), [0.0, 0.0]), np.eye(n + 2) * UNKNOWN**2
    data = np.concatenate([_without_rows(one) for one in channels])
    weight = np.zeros((3 * n, 3 * n))
    for c, one in enumerate(channels):
        weight[3 * c : 3 * c + 3, 3 * c : 3 * c + 3] = np.linalg.inv(one.covariance + np.diag([0, 1e-12, 1e-24]))
    known = [c for c in range(n) if channels[c].covariance[0, 0] < (UNKNOWN / 2) ** 2]
    gain = np.array([one.values[0] if c in known else np.nan for c, one in enumerate(channels)])
    gain = np.where(np.isnan(gain), np.nanmean(gain) if known else 1.0, gain)
    floor = np.array([max(data[3 * c + 1], 1e-6) for c in range(n)])
    theta = np.concatenate([gain, [float(np.sqrt(np.mean(floor / gain**2)))], [float(np.mean(data[2::3] / gain))]])
    for _ in range(ROUNDS):
        model, slopes = _expected(theta, n)
        information = slopes.T @ weight @ slopes + np.diag(np.append(np.full(n, 1e-14), [1e-14, 1e-14]))
        step = np.linalg.solve(information, slopes.T @ weight @ (data - model))
        theta = theta + np.clip(step, -0.5 * np.abs(theta) - 1e-9, 0.5 * np.abs(theta) + 1e-9)
    off = data - model
    chi2 = float(off @ weight @ off) / max(2 * n - 2, 1) if n > 1 else 1.0
    return theta, np.linalg.inv(information) * max(chi2, 1.0)


def _without_rows(one: Channel) -> np.ndarray:
    """Gain, variance without signal less rounding, and growth, without what row gain adds to variances."""
    widened = 1 + (one.row_gain[0] if one.row_gain[0] > ROW_GAIN_THERE * one.row_gain[1] else 0.0)
    return np.array([one.values[0] / widened, (one.values[1] - ROUNDING) / widened, one.values[2]])


def _expected(theta: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gain, variance and growth of each channel, and their derivatives."""
    gain, sigma, rate = theta[:n], theta[n], theta[n + 1]
    model, slopes = np.empty(3 * n), np.zeros((3 * n, n + 2))
    model[0::3], model[1::3], model[2::3] = gain, gain**2 * sigma**2, gain * rate
    for c in range(n):
        slopes[3 * c, c] = 1
        slopes[3 * c + 1, [c, n]] = 2 * gain[c] * sigma**2, 2 * gain[c] ** 2 * sigma
        slopes[3 * c + 2, [c, n + 1]] = rate, gain[c]
    return model, slopes
