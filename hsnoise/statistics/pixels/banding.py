"""Bands that move from frame to frame: one sharp line in the spectrum of row or column means."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

FEWEST_FRAMES, FEWEST_LINES = 3, 64
PADDED = 8  # lines of the spectrum for each frequency, so that none lies between two
LEAST_PERIODS = 4  # in a frame: slower bands look like drifts
NEAR, AROUND = 3, 10  # frequencies that belong to a line, and among which it stands out: a hump is wider
SHARP = 30.0  # times the power around it
MOSTLY = 0.3  # share of what the lines of a frame vary


class Banding(NamedTuple):
    """A sinusoid over rows or columns: its frequency, cycles per line, and its variance with its error, DN^2."""

    frequency: float
    variance_dn2: float
    error_dn2: float

    def of_rows_dn2(self, apart: int = 0) -> float:
        """Covariance of the means of rows (or columns) so far `apart`, DN^2."""
        return self.variance_dn2 * float(np.cos(2 * np.pi * self.frequency * apart))


def banding_of(means_dn: np.ndarray) -> Banding | None:
    """The sinusoid in means of rows or columns [frame, line]; None if no line stands out and holds much of them."""
    frames, lines = means_dn.shape
    if frames < FEWEST_FRAMES or lines < FEWEST_LINES:
        return None
    left = (means_dn - means_dn.mean(0)) * np.sqrt(frames / (frames - 1))
    left -= left.mean(1, keepdims=True)
    power = np.mean(np.abs(np.fft.rfft(left * np.hanning(lines), PADDED * lines)) ** 2, 0)
    first = PADDED * LEAST_PERIODS
    k = first + int(power[first:].argmax())
    around = np.abs(np.arange(len(power)) - k)
    beside = power[(around > PADDED * NEAR) & (around < PADDED * AROUND)]
    if power[k] < SHARP * float(np.median(beside)):
        return None
    frequency = k / (PADDED * lines)
    squares = _squares(left, frequency)
    variance, error = float(squares.mean()), float(squares.std(ddof=1) / np.sqrt(frames))
    return Banding(frequency, variance, error) if variance > MOSTLY * float(np.mean(left**2)) else None


def _squares(left: np.ndarray, frequency: float) -> np.ndarray:
    """Mean square of the sinusoid in each frame [frame], less what noise adds to it."""
    phase = 2 * np.pi * frequency * np.arange(left.shape[1])
    waves = np.stack([np.cos(phase), np.sin(phase)], 1)[:, : 1 if frequency == 0.5 else 2]
    sizes = np.linalg.lstsq(waves, left.T, rcond=None)[0]
    wave = (waves @ sizes).T
    rest, freedom = left - wave, left.shape[1] - waves.shape[1]
    return np.mean(wave**2, 1) - waves.shape[1] / left.shape[1] * np.sum(rest**2, 1) / freedom
