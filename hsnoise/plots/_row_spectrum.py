"""Spectrum of the row gain of a fit."""

from __future__ import annotations

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hsnoise._core.types import seconds
from hsnoise.effects import RowGain
from hsnoise.likelihood import rows
from hsnoise.likelihood.summary import RowHistograms, Summary
from hsnoise.plots._moments import beta_rule, count_moments
from hsnoise.plots._pixel_transfer import transfers_of
from hsnoise.plots._style import COLOURS, FIT, MARKERS, NAMES, new_figure, tidy, title_of

BANDS_PER_OCTAVE = 3
SHOWN_IN_DARKS = 1e-3  # smaller row gains are invisible in darks; flats may still determine them
SMALLEST_SIGMA = 1e-6
FAINT = 0.01  # of the smallest measured power: a weaker row gain is left out
ALONE = "row gain alone"
LEGEND = ("measured", "measured, in bands", "fitted: row gain + pixel noise", ALONE, "pixel noise alone")


def row_spectrum(fit) -> Figure:
    """Power spectrum of the row gain along the rows, measured and fitted, log-log; one panel per colour.

    Measured: the periodogram of row means, divided by the response of a row mean to its gain, averaged over the frames
    of the exposure that shows the row gain best. Each row's mean over frames (hot pixels, fixed patterns) is not row
    gain and is subtracted, unless there is a single frame. Fitted: row gain plus the pixel noise in a row mean. Power
    is normalised so that its mean over all frequencies is the variance over rows.

    Args:
        fit: result of `hsnoise.fit`, of a stack with dark frames.

    Raises:
        ValueError: there are no dark frames, no row gain in the model, or no dark signal to show it.

    Reference: Wang et al., "Enhancing Low Light Videos by Exploring High Sensitivity Camera Noise", ICCV 2019, Fig. 3.
    """
    summary = fit.summary
    if not has_row_spectrum(fit):
        raise ValueError("fit: a row spectrum needs dark frames, row_gain in the model, and dark signal to show it")
    channels = len(summary.histograms)
    title = title_of("Spectrum of the row gain", fit) if fit.transfer is None else "Spectrum of the row gain"
    figure = new_figure(max(4.3 * channels, 6.4), 4.6, title)
    panels = figure.subplots(1, channels, squeeze=False, sharey=True)[0]
    for c, (axes, histograms) in enumerate(zip(panels, summary.histograms, strict=True)):
        _panel(axes, fit, c, histograms)
    lines = [line for one in panels for line in one.lines]
    low = min(float(np.min(line.get_ydata())) for line in lines if line.get_label() != ALONE)
    shown = [line for line in lines if line.get_label() != ALONE or np.max(line.get_ydata()) > FAINT * low]
    ends = np.concatenate([np.asarray(line.get_ydata(), float) for line in shown])
    panels[0].set_ylim(0.5 * ends.min(), 2 * ends.max())
    panels[0].set_ylabel("power of the row gain β (variance per row)")
    entries = dict(zip(*reversed(panels[0].get_legend_handles_labels()), strict=True))
    is_faint = all(line.get_label() != ALONE for line in shown)
    labels = [label for label in LEGEND if label != ALONE or not is_faint]
    order = [entries[label] for label in labels]
    figure.legend(order, labels, loc="outside lower center", ncols=min(len(labels), 2 * channels + 1), fontsize=9)
    return figure


def has_row_spectrum(fit) -> bool:
    """Whether the frames show the row gain; where pixels differ, only if it is large enough to show in darks."""
    if not fit.summary.histograms or "row_gain" not in fit.params:
        return False
    if fit.transfer is None:
        return True
    return bool(transfers_of(fit)) and bool(np.max(np.asarray(fit.params["row_gain"].sigma)) > SHOWN_IN_DARKS)


def _panel(axes: Axes, fit, c: int, histograms: RowHistograms) -> None:
    summary, row_gain = fit.summary, fit.params["row_gain"]
    slope, noise = (_response if fit.transfer is None else _of_pixels)(fit, c, histograms)
    e = int(np.argmax(slope**2 / noise))
    row_mean = _row_means(histograms, e)
    frames, n_rows = row_mean.shape
    if frames > 1:
        row_mean = (row_mean - row_mean.mean(0)) * np.sqrt(frames / (frames - 1))
    k = np.arange(1, n_rows // 2 + 1)
    power = (np.abs(np.fft.rfft(row_mean, axis=1)) ** 2).mean(0)[1:] / n_rows / slope[e] ** 2
    floor = noise[e] / slope[e] ** 2
    sigma = max(float(row_gain.sigma[c]), SMALLEST_SIGMA)
    fitted = sigma**2 * _shape(row_gain, summary, histograms)[k]
    colour, channel = COLOURS[histograms.channel], histograms.channel
    axes.loglog(k, power, ".", color=colour, alpha=0.35, markersize=4, label="measured")
    x, y, error = _bands(k, power, frames)
    axes.errorbar(
        x,
        y,
        error,
        fmt=MARKERS[channel],
        color=colour,
        markersize=7,
        mec="white",
        capsize=3,
        label="measured, in bands",
    )
    axes.plot(k, fitted + floor, color=FIT, linewidth=1.8, label="fitted: row gain + pixel noise")
    axes.plot(k, fitted, "--", color=FIT, linewidth=1.2, label="row gain alone")
    axes.plot(k, np.full(len(k), floor), ":", color="0.5", linewidth=1.8, label="pixel noise alone")
    axes.set_title(f"{NAMES[channel]}, {_count(frames)} of {seconds(summary.exposure_s[e])}", fontsize=10)
    axes.set_xlabel("row frequency / cycles per frame height")
    tidy(axes)


def _count(frames: int) -> str:
    return f"{frames} dark frame{'s' if frames > 1 else ''}"


def _response(fit, c: int, histograms: RowHistograms):
    """Change of a row's mean with its gain (DN), and variance of a row mean from its pixels (DN^2): [exposure]."""
    summary = fit.summary
    sigma = max(float(fit.params["row_gain"].sigma[c]), 1e-3)
    beta, weight = beta_rule(sigma)
    mean, variance = count_moments(fit.params, c, summary.exposure_s, beta, summary.white_level_dn)
    slope = mean @ (weight * (beta - 1)) / sigma**2
    return slope, variance @ weight / histograms.row_pixels.max((1, 2))


def _of_pixels(fit, c: int, histograms: RowHistograms):
    """As `_response`, where pixels differ: from their mean signal and their mean variance over time; [exposure]."""
    transfer = fit.transfer.channels[c].transfer
    classes, t = transfer.classes, fit.summary.exposure_s
    share = classes.pixels / classes.pixels.sum()
    variance = np.interp(t, classes.exposure_s, share @ classes.variance_dn2)
    signal = np.maximum(share @ classes.growth_dn_per_s, 1e-9) * np.maximum(t, 1e-3 * t.max())
    return signal, variance / histograms.row_pixels.max((1, 2))


def _row_means(histograms: RowHistograms, exposure: int) -> np.ndarray:
    pixels = histograms.row_pixels[exposure]
    used = pixels[:, 0] > 0
    return histograms.row_sum[exposure][used] / pixels[used]


def _shape(row_gain: RowGain, summary: Summary, histograms: RowHistograms) -> np.ndarray:
    """Spectrum of unit variance of the colour's rows, [row]."""
    n_rows = histograms.row_sum.shape[2]
    if summary.shutter == "global":
        return np.ones(n_rows)
    with jax.enable_x64(True):
        sensor_rows = n_rows * histograms.row_stride
        exponent, white_share = (np.asarray(x, np.float64) for x in (row_gain.exponent, row_gain.white_share))
        return np.asarray(rows.row_spectrum(exponent, sensor_rows, histograms.row_stride, white_share))


def _bands(k: np.ndarray, power: np.ndarray, frames: int):
    """Centre, mean power and its standard error in logarithmic bands; a periodogram is exponentially distributed."""
    band = np.round(BANDS_PER_OCTAVE * np.log2(k)).astype(int)
    _, band = np.unique(band, return_inverse=True)
    n = np.bincount(band)
    y = np.bincount(band, power) / n
    return np.exp(np.bincount(band, np.log(k)) / n), y, y / np.sqrt(n * frames)
