"""The paper's spectrum of the row gain: a straight line through log power against log frequency."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

BANDS_PER_OCTAVE = 2
LEAST_DOF = 2.0  # effective degrees of freedom of a band's power, below which it is left out
LOWEST, HIGHEST = -1.0, 4.0


def band_means(spectrum: np.ndarray, sensor_rows: int) -> np.ndarray:
    """Means of spectra over half-octave bands of cycles per frame.

    Args:
        spectrum: [..., frequency], from 0 cycles per frame on; a colour with every second row has half as many.
        sensor_rows: rows of the sensor, of all colours.

    Returns:
        [..., band], the same bands whatever the colour; 0 where the spectrum ends below.
    """
    edges, modes = _edges(sensor_rows), _modes(spectrum.shape[-1], sensor_rows)
    starts = np.minimum(edges[:-1], spectrum.shape[-1] - 1)
    return np.where(modes > 0, np.add.reduceat(spectrum[..., : edges[-1]], starts, axis=-1) / np.maximum(modes, 1), 0.0)


def spectrum_exponent(
    power: np.ndarray, noise: np.ndarray, n_frames: int, sensor_rows: int, strides: Sequence[int]
) -> np.ndarray:
    """Minus the slope of log power against log frequency, one for all colours, within -1 ... 4; 0 without any power.

    A colour that has every second row sees high frequencies folded back: the line goes through the power over what
    folding and averaging over bands make of the power law found so far.

    Args:
        power: [replicate, channel, band], of the row gain, that of measurement noise taken off.
        noise: [replicate, channel, 1 or band], what was taken off.
        n_frames: frames in each mean.
        sensor_rows: rows of the sensor.
        strides: [channel], 2 for a colour that has every second sensor row, else 1.
    """
    modes = np.stack([_modes(sensor_rows // stride // 2 + 1, sensor_rows) for stride in strides])
    weight = modes * (np.maximum(power, 0.0) / np.maximum(power + noise, 1e-300)) ** 2
    dof = 2 * n_frames * weight
    weight = np.where(dof > LEAST_DOF, weight, 0.0)
    # The log of a mean square is low by 1 / dof on average.
    log_power = np.log(np.where(dof > LEAST_DOF, power, 1.0)) + 1 / np.maximum(dof, LEAST_DOF)
    frequency = np.concatenate([[0.0], np.log(np.arange(1, sensor_rows // 2 + 1))])
    log_frequency = band_means(frequency, sensor_rows)
    exponent = np.zeros(len(power))
    for _ in range(8):
        law = np.stack([_folded_law(exponent, sensor_rows, stride) for stride in strides], 1)
        slope = _common_slope(log_frequency, log_power - np.log(np.where(law > 0, law, 1.0)), weight)
        exponent = np.clip(exponent - slope, LOWEST, HIGHEST)
    return exponent


def _edges(sensor_rows: int) -> np.ndarray:
    octaves = np.log2(max(sensor_rows // 2, 2))
    return np.unique(np.round(2 ** np.arange(0, octaves + 0.5, 1 / BANDS_PER_OCTAVE)).astype(int))


def _modes(frequencies: int, sensor_rows: int) -> np.ndarray:
    """Frequencies in each band, of a spectrum with as many as `frequencies`."""
    return np.diff(np.minimum(_edges(sensor_rows), frequencies))


def _folded_law(exponent: np.ndarray, sensor_rows: int, stride: int) -> np.ndarray:
    """Power [replicate, band] of frequency^-exponent in every `stride`-th row."""
    cycles = np.abs(np.fft.fftfreq(sensor_rows, 1 / sensor_rows))
    law = np.where(cycles == 0, 0.0, np.maximum(cycles, 1.0) ** -exponent[:, None])
    law = law.reshape(len(exponent), stride, sensor_rows // stride).mean(1)
    return band_means(law[:, : sensor_rows // stride // 2 + 1], sensor_rows)


def _common_slope(x, y, weight):
    """Slope of parallel lines [replicate] of y [replicate, channel, band] against x [band]; 0 without any weight."""
    total = np.maximum(weight.sum(-1, keepdims=True), 1e-300)
    moved = x - (weight * x).sum(-1, keepdims=True) / total
    return (weight * moved * y).sum((1, 2)) / np.maximum((weight * moved**2).sum((1, 2)), 1e-300)
