"""Power spectra of series that are measured a few times: smooth, never negative, and of the right total."""

from __future__ import annotations

import numpy as np

SMOOTH = 9  # bins over which a spectrum is even
LINE = 6.0  # errors by chance above which a bin is a line and stays one
THERE = 3.0  # errors by chance above which a spectrum is more than nothing


def periodogram(series: np.ndarray) -> np.ndarray:
    """Mean of |FFT|^2 / length over series [series, place], at 0 to 0.5 cycles per place [frequency]."""
    total, block = 0.0, 4096  # series at a time
    for start in range(0, len(series), block):
        total = total + (np.abs(np.fft.rfft(series[start : start + block], axis=1)) ** 2).sum(0, dtype=np.float64)
    return np.asarray(total) / series.size


def smoothed(power: np.ndarray, chance: np.ndarray) -> np.ndarray:
    """A spectrum [frequency] made smooth, but for lines; `chance`: standard error of each bin if there is nothing."""
    pad = min(SMOOTH // 2, len(power) - 1)
    window = np.ones(2 * pad + 1) / (2 * pad + 1)
    even = np.convolve(np.pad(power, pad, mode="reflect"), window, "valid")
    return np.where(np.abs(power - even) > LINE * chance, power, even)


def not_negative(power: np.ndarray, chance: np.ndarray) -> np.ndarray:
    """The spectrum smooth and not negative, with its total unchanged; zeros where the total may be chance."""
    total, error = power.sum(), np.sqrt((chance**2).sum())
    above = np.maximum(smoothed(power, chance), 0)
    if total < THERE * error or not above.any():
        return np.zeros_like(power)
    return above * (total / above.sum())


def series_from_posterior(
    estimate: np.ndarray, halves: np.ndarray, error: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """True values [place] drawn from their posterior, frequency by frequency.

    Args:
        estimate [place]: measured; halves [half, place]: from two halves of the frames, whose cross spectrum is free of
            the noise of estimation.
        error [frequency]: spectrum of the errors of `estimate`.
    """
    n = len(estimate)
    one, two = np.fft.rfft(halves, axis=1)
    # The cross spectrum of one pair of series scatters by about the noise of a half, twice that of the whole.
    prior = not_negative((one * two.conj()).real / n, np.sqrt(2) * error)
    share = np.where(prior > 0, prior / np.where(prior > 0, prior + error, 1.0), 0.0)
    noise = np.fft.rfft(rng.standard_normal(n)) * np.sqrt(share * error)
    return np.fft.irfft(share * np.fft.rfft(estimate) + noise, n)
