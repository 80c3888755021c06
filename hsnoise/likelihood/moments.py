"""Where a fit starts: moment estimates from row means and variances, corrected for clipping at zero."""

from __future__ import annotations

import jax
import numpy as np
import scipy  # its parts are imported when they are used

from hsnoise.effects import ADC, BlackClamp, BlackLevel, DarkCurrent, Gain, ReadNoise, RowGain, ShotNoise
from hsnoise.likelihood.summary import RowHistograms, Summary
from hsnoise.model import NoiseModel

CLAMPED_E = 6.0
FURTHEST = 3.0  # factor between the gains from means and from variances: beyond, the means do not show the gain


def unclip(mean, variance):
    """Mean and variance before clipping at 0 of a normal variable with these moments after it (any shape)."""
    t = np.linspace(-3.0, 9.0, 601)
    density = np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi)
    clipped_mean = t * scipy.special.ndtr(t) + density
    clipped_variance = (t * t + 1) * scipy.special.ndtr(t) + t * density - clipped_mean**2
    spread = np.sqrt(np.maximum(variance, 1e-6))
    position = np.interp(mean / spread, clipped_mean / np.sqrt(clipped_variance), t)
    sigma = spread / np.sqrt(np.interp(position, t, clipped_variance))
    far = mean / spread > 6.0
    return np.where(far, mean, position * sigma), np.where(far, variance, sigma**2)


def model_of(
    summary: Summary, *, gain, dark_current, read_noise, black_level, row_gain=None, black_clamp=None
) -> NoiseModel:
    """The paper's model of the sensor of a capture, in float64, from values of its effects.

    row_gain: sigma [channel] and exponent, None for a model without; black_clamp likewise. Its default exposure is
    the median one of the darks.
    """
    exposures = summary.exposure_s if len(summary.exposure_s) else summary.flats.exposure_s
    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        rows = [] if row_gain is None else [RowGain(*row_gain)]
        clamp = [] if black_clamp is None else [BlackClamp(black_clamp)]
        electrons = [ShotNoise(), DarkCurrent(dark_current), ReadNoise(read_noise)]
        return NoiseModel(
            [*electrons, *rows, Gain(gain), BlackLevel(black_level), *clamp, ADC(summary.white_level_dn)],
            cfa=summary.cfa,
            shutter=summary.shutter,
            exposure_s=float(np.sort(exposures)[len(exposures) // 2]),
        )


def start_model(summary: Summary, with_row_gain: bool = True, with_clamp: bool = False) -> NoiseModel:
    """Moment estimates: the photon transfer line of the exposures and the spread of row means.

    with_clamp: the camera subtracts part of the dark signal, so that the means do not show it.
    """
    if not summary.histograms:
        return _start_of_flats(summary, with_row_gain)
    estimates = [_channel_moments(summary, h, with_clamp) for h in summary.histograms]
    black = np.array([b for _, _, _, b, _ in estimates])
    gain = np.array([_slope(signal, variance) for signal, variance, *_ in estimates])
    electrons = [np.maximum(signal, 0.0) / k for (signal, *_), k in zip(estimates, gain, strict=True)]
    t = summary.exposure_s
    rate = np.mean([(e * t).sum() / max((t * t).sum(), 1e-300) for e in electrons]) if t.any() else 0.0
    if t.any():
        gain = _of_one_rate(gain, rate * t, [signal for signal, *_ in estimates])
    read = np.mean(
        [
            np.median(np.maximum(variance / k**2 - e, 0.02 * variance / k**2))
            for (_, variance, *_), k, e in zip(estimates, gain, electrons, strict=True)
        ]
    )
    sigma = np.array([spread for _, _, spread, *_ in estimates])
    return model_of(
        summary,
        gain=gain,
        dark_current=max(float(rate), 1e-9),
        read_noise=np.sqrt(max(float(read), 1e-4)),
        row_gain=(sigma, 0.0 if summary.shutter == "global" else 0.8) if with_row_gain else None,
        black_level=black,
        black_clamp=np.array([clamp for *_, clamp in estimates]) if with_clamp else None,
    )


def _of_one_rate(gain, dark_e, signals):
    """Gains with which all channels hold the same dark electrons [exposure]: means give ratios better than variances.

    Coloured rows have no common offset, so that a likelihood that starts far from the means has nowhere to put it.
    """
    told = np.array([(dark_e * x).sum() / max((dark_e**2).sum(), 1e-300) for x in signals])
    return np.where((told > gain / FURTHEST) & (told < gain * FURTHEST), told, gain)


def _start_of_flats(summary: Summary, with_row_gain: bool) -> NoiseModel:
    """Photon transfer line of flats alone."""
    flats = summary.flats
    signal = flats.mean_dn - summary.black_level_dn
    gain = np.array([_slope(x, v) for x, v in zip(signal.T, flats.variance_dn2.T, strict=True)])
    read = np.median(np.maximum(flats.variance_dn2 - gain * signal, 0.02 * flats.variance_dn2) / gain**2)
    excess = flats.row_power_dn2 - flats.variance_dn2 / flats.row_pixels
    sigma = np.sqrt(np.clip((excess / signal**2).mean(0), 1e-6, 1.0))
    return model_of(
        summary,
        gain=gain,
        dark_current=0.0,
        read_noise=np.sqrt(read),
        row_gain=(sigma, 0.0) if with_row_gain else None,
        black_level=summary.black_level_dn,
    )


def binned_moments(histograms: RowHistograms):
    """Pixels, mean and variance of each row [exposure, frame, row] within the bins: free of far outliers."""
    edges = histograms.edges_dn
    width = edges[:, 1:2] - edges[:, :1]
    centres = np.concatenate([edges[:, :1] - width / 2, (edges[:, 1:] + edges[:, :-1]) / 2, edges[:, -1:]], axis=1)
    inside = np.ones(centres.shape)
    inside[:, -1] = 0.0
    inside[edges[:, 0] > 0.5, 0] = 0.0  # an open bin, unless it holds the code 0 alone
    powers = np.stack([inside, inside * centres, inside * centres**2], axis=-1)
    # Frame by frame: as floats the histograms take four times the memory.
    sums = [[frame.astype(np.float64) @ p for frame in of] for of, p in zip(histograms.counts, powers, strict=True)]
    pixels, first, second = np.moveaxis(np.array(sums), -1, 0)
    n = np.maximum(pixels, 2)
    mean = first / n
    return pixels, mean, (second - n * mean**2) / (n - 1)


def _channel_moments(summary: Summary, histograms: RowHistograms, with_clamp: bool):
    """Signal and variance [exposure] in DN, spread of the row gain, black level DN and clamp DN/s of one channel."""
    c = summary.channels.index(histograms.channel)
    pixels, row_mean, row_variance = binned_moments(histograms)
    used = pixels > 2
    n = np.maximum(pixels, 2)
    row_mean, row_variance = unclip(row_mean, row_variance)
    level = np.array([m[u].mean() for m, u in zip(row_mean, used, strict=True)])
    variance = np.array([np.median(v[u]) for v, u in zip(row_variance, used, strict=True)])
    variance = np.maximum(variance - 1 / 12, 1e-3)
    black = _black_start(summary, c, level, variance)
    clamp = _clamp_start(summary.exposure_s, level, variance) if with_clamp else 0.0
    signal = level - black + clamp * summary.exposure_s
    spread = np.array([row_mean[e][used[e]].var() for e in range(len(level))]) - variance / n.max((1, 2))
    relative = np.maximum(spread, 0.0) / np.maximum(signal**2, variance)
    sigma = np.sqrt(np.clip(relative[np.argmax(signal)], 1e-4, 1.0))
    return signal, variance, sigma, black, clamp


def _clamp_start(exposure_s, level, variance) -> float:
    """The clamp at which the longest exposure holds CLAMPED_E electrons: the variance gives only gain^2 times rate."""
    growth, drift = (max(float(np.polyfit(exposure_s, y, 1)[0]), 0.0) for y in (variance, level))
    longest = exposure_s.max()
    gain = np.sqrt(growth * longest / CLAMPED_E)
    return max(gain * CLAMPED_E / longest - drift, 0.0)


def _black_start(summary: Summary, c: int, level, variance) -> float:
    if summary.black_level_dn is not None:
        return float(summary.black_level_dn[c])
    t = summary.exposure_s
    if np.ptp(t) > 0:
        return float(np.polyval(np.polyfit(t, level, 1), 0.0))
    return float(np.maximum(level.mean() - np.sqrt(variance.mean()), 0.0))


def _slope(signal, variance) -> float:
    """Gain from the photon transfer line, kept within what shot noise alone would allow."""
    highest = float((variance / np.maximum(signal, 1e-6)).min())
    if np.ptp(signal) > 0.02 * np.sqrt(variance.max()):
        slope = float(np.polyfit(signal, variance, 1, w=np.sqrt(np.maximum(signal, 1e-3)))[0])
        if slope > 0:
            return min(max(slope, 0.1 * highest), highest) if highest < 1e4 else slope
    return min(0.5 * highest, 1.0)
