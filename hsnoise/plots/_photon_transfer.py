"""Mean-variance relation of a fit."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hsnoise.likelihood.darks import dark_current, flat_gain_of
from hsnoise.likelihood.flat_gain import FlatGain, local_gain, variance_curve
from hsnoise.likelihood.flat_likelihood import ROUNDING_VARIANCE
from hsnoise.likelihood.moments import binned_moments
from hsnoise.likelihood.summary import RowHistograms, Summary, far_outliers
from hsnoise.model import NoiseModel
from hsnoise.plots._moments import beta_rule, black_levels, count_moments
from hsnoise.plots._pixel_transfer import draw_variances, transfers_of
from hsnoise.plots._style import COLOURS, MARKERS, NAMES, new_figure, plain_log, tidy, title_of

CLIPPED_FRACTION = 1e-3
CURVE_POINTS = 40


def photon_transfer(fit) -> Figure:
    """Variance against mean of the counts, measured and fitted: the photon transfer curve.

    Darks: one point per exposure and colour, with the variance within rows. Row offsets, the spread of row gains and
    pixels far hotter than all others do not enter. Where pixels differ, that variance is not noise, and classes of
    pixels over time are shown instead (`pixel_transfer`). Flats: one point per level and colour, temporal variance
    within rows above that of the darks; and that variance over signal, with the fitted curve and the local gain.
    Solid: the fitted model of the recorded counts. Dashed, where clipping matters: the model before clipping. Hollow
    points: more than 0.1 % of the pixels are clipped, or the level was left out.

    Args:
        fit: result of `hsnoise.fit`.

    Raises:
        ValueError: pixels differ, and there are neither darks of two exposures nor flats.

    Reference: Janesick, *Photon Transfer*, SPIE 2007.
    """
    panels = _panels(fit)
    if not panels:
        raise ValueError("fit: expected darks of two exposures, or flats, because pixels differ; got neither")
    title = "Photon transfer: variance against mean of the counts"
    title = title_of(title, fit) if fit.transfer is None else title
    figure = new_figure(6.4 * len(panels), 5.0, title)
    for axes, draw in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        axes.set_xlabel("mean above black level / DN")
        draw(axes)
        tidy(axes)
    return figure


def has_photon_transfer(fit) -> bool:
    """Whether `photon_transfer` has something to draw."""
    return bool(_panels(fit))


def _panels(fit) -> list[Callable[[Axes], None]]:
    summary, model = fit.summary, fit.params
    panels: list[Callable[[Axes], None]] = []
    if transfers_of(fit):
        panels.append(partial(_classes, fit=fit))
    elif fit.transfer is None and summary.histograms:
        panels.append(partial(_darks, model=model, summary=summary))
    if summary.flats is not None and summary.flats.mean_dn.size:
        panels += [partial(draw, model=model, summary=summary) for draw in (_flats, _gains)]
    return panels


def _classes(axes: Axes, fit) -> None:
    draw_variances(axes, transfers_of(fit))
    axes.set_title("dark frames, classes of pixels over time", fontsize=10)
    axes.set_ylabel("temporal variance / DN²")
    axes.set_xlabel("dark signal / DN")


def _darks(axes: Axes, model: NoiseModel, summary: Summary) -> None:
    axes.set_title("dark frames, one point per exposure", fontsize=10)
    axes.set_ylabel("variance within rows / DN²")
    far = far_outliers(summary) > 0
    t = np.linspace(0.0, summary.exposure_s.max() * 1.05, CURVE_POINTS)
    any_clipped = False
    for c, histograms in enumerate(summary.histograms):
        with jax.enable_x64(True):
            channel, black = histograms.channel, black_levels(model, summary.exposure_s)[:, c]
        colour = COLOURS[channel]
        mean, variance, error = _within_rows(histograms, far & ~_reaches_white(histograms, summary.white_level_dn))
        clipped = clipped_fraction(histograms, summary.white_level_dn) > CLIPPED_FRACTION
        _points(axes, channel, mean - black, variance, clipped, error)
        x, y = _expected(model, c, t, summary.white_level_dn)
        axes.plot(x, y, linewidth=1.6, color=colour)
        if clipped.any():
            any_clipped = True
            axes.plot(*_unclipped(model, c, t), "--", linewidth=1.2, color=colour)
    axes.plot([], [], "-", color="0.3", label="fitted model")
    if any_clipped:
        axes.plot([], [], "--", color="0.3", label="fitted, before clipping")
        axes.plot([], [], "o", mfc="white", mec="0.3", label="more than 0.1 % clipped")
    axes.set_ylim(0, 1.15 * axes.dataLim.y1)
    axes.legend(fontsize=9, framealpha=0.9)


def _flats(axes: Axes, model: NoiseModel, summary: Summary) -> None:
    axes.set_title("flat frames, one point per level", fontsize=10)
    axes.set_ylabel("variance above that of darks / DN²")
    found = flat_gain_of(model, summary.flats)
    for c, channel in enumerate(summary.channels):
        signal, shown = _levels(found, c)
        gain, error = found.level_gain[shown, c], found.level_error[shown, c]
        _points(axes, channel, signal, gain * signal, ~found.used[shown, c], error * signal)
        if len(signal):
            light_dn = np.geomspace(signal.min() / 2, signal.max() * 1.5, CURVE_POINTS)
            expected = float(model["gain"].value[c]) * light_dn * np.maximum(variance_curve(found, c, light_dn), 0)
            expected = expected * _excess_noise(model) * (1 + _row_sigma(model, c) ** 2)
            axes.plot(light_dn, expected, color=COLOURS[channel], linewidth=1.6)
    axes.plot([], [], "-", color="0.3", label="fitted model, before clipping")
    axes.set_xscale("log")
    axes.set_yscale("log")
    plain_log(axes.xaxis)
    plain_log(axes.yaxis)
    axes.legend(fontsize=9, framealpha=0.9)


def _gains(axes: Axes, model: NoiseModel, summary: Summary) -> None:
    """Variance over signal of the flats and the local gain: horizontal where the response is linear."""
    axes.set_title("flat frames: gain against signal", fontsize=10)
    multiplied = _excess_noise(model) > 1
    axes.set_ylabel(f"variance over signal, {'F² times the ' if multiplied else ''}gain / (DN/e$^-$)")
    found = flat_gain_of(model, summary.flats)
    for c, channel in enumerate(summary.channels):
        signal, shown = _levels(found, c)
        used = found.used[shown, c]
        _points(axes, channel, signal, found.level_gain[shown, c], ~used, found.level_error[shown, c])
        if used.any():
            light_dn = np.geomspace(signal[used].min() / 1.2, signal[used].max() * 1.2, CURVE_POINTS)
            axes.plot(
                light_dn, found.gain[c] * variance_curve(found, c, light_dn), color=COLOURS[channel], linewidth=1.6
            )
            if found.bend[c].any():
                axes.plot(light_dn, local_gain(found, c, light_dn), "--", color=COLOURS[channel], linewidth=1.2)
    axes.plot([], [], "-", color="0.3", label="curve of the variance")
    if found.bend.any():
        axes.plot([], [], "--", color="0.3", label="local gain")
    axes.set_xscale("log")
    plain_log(axes.xaxis)
    _gain_limits(axes, found)
    axes.legend(fontsize=9, framealpha=0.9)


def _excess_noise(model: NoiseModel) -> float:
    """Excess noise factor F^2 of a gain register; 1 without one."""
    return 1 + float(model["electron_multiplication"].excess) if "electron_multiplication" in model else 1.0


def _gain_limits(axes: Axes, found: FlatGain) -> None:
    """Limits from the levels that gave the gain: levels near saturation may fall far below."""
    shown = found.level_gain[found.used]
    if shown.size:
        low, high = min(shown.min(), found.gain.min()), max(shown.max(), found.gain.max())
        margin = max(0.5 * (high - low), 0.05 * high)
        axes.set_ylim(low - margin, high + margin)


def _levels(found: FlatGain, c: int) -> tuple[np.ndarray, np.ndarray]:
    """Signals, DN, of a channel's levels that can be drawn, and the mask that selects them [level]."""
    shown = np.isfinite(found.level_gain[:, c]) & (found.level_gain[:, c] > 0)
    return found.signal_dn[shown, c], shown


def _points(axes: Axes, channel: str, x, y, clipped, error) -> None:
    colour = COLOURS[channel]
    axes.errorbar(x, y, error, fmt="none", ecolor=colour, elinewidth=1.2, capsize=3, zorder=3)
    faces = ["white" if one else colour for one in clipped]
    axes.scatter(x, y, s=46, marker=MARKERS[channel], c=faces, edgecolors=colour, linewidths=1.5, zorder=4)
    axes.plot([], [], MARKERS[channel], color=colour, label=NAMES[channel])


def _within_rows(histograms: RowHistograms, far: np.ndarray):
    """Mean (DN), variance within rows (DN^2) and its standard error over frames, each [exposure].

    far [exposure]: whether to leave out pixels beyond all bins, far hotter than the others.
    """
    pixels = histograms.row_pixels  # [exposure, frame, row]; 0 in padding
    used = pixels[..., 0] > 0
    n = np.maximum(pixels, 2)
    row_mean = histograms.row_sum / n
    row_variance = (histograms.row_sum_of_squares - histograms.row_sum**2 / n) / (n - 1)
    if far.any():
        _, binned_mean, binned_variance = binned_moments(histograms)
        row_mean = np.where(far[:, None, None], binned_mean, row_mean)
        row_variance = np.where(far[:, None, None], binned_variance, row_variance)
    frames = used.sum(1)
    mean = (row_mean * pixels).sum((1, 2)) / pixels.sum((1, 2))
    of_frame = [row_variance[e][used[e]].mean(1) for e in range(len(used))]
    variance = np.array([one.mean() for one in of_frame])
    spread = [one.std(ddof=1) if len(one) > 1 else np.nan for one in of_frame]
    return mean, variance, np.array(spread) / np.sqrt(frames)


def _reaches_white(histograms: RowHistograms, white_level_dn: float | None) -> np.ndarray:
    """Whether the last bin begins at the white level [exposure]."""
    no = np.zeros(len(histograms.edges_dn), bool)
    return no if white_level_dn is None else histograms.edges_dn[:, -1] >= white_level_dn - 0.5


def clipped_fraction(histograms: RowHistograms, white_level_dn: float | None) -> np.ndarray:
    """Fraction [exposure] of pixels at 0 or at the white level."""
    counts = histograms.counts.sum((1, 2), dtype=np.float64)
    at_zero = np.where(histograms.edges_dn[:, 0] <= 0.5, counts[:, 0], 0.0)
    return (at_zero + np.where(_reaches_white(histograms, white_level_dn), counts[:, -1], 0.0)) / counts.sum(1)


def _expected(model: NoiseModel, c: int, exposure_s, white_level_dn: float | None):
    """Mean above black and variance within rows of the recorded counts, averaged over the row gain; [exposure]."""
    beta, weight = beta_rule(_row_sigma(model, c))
    mean, variance = count_moments(model, c, exposure_s, beta, white_level_dn)
    return mean @ weight, variance @ weight


def _unclipped(model: NoiseModel, c: int, exposure_s):
    """Mean above black and variance within rows of counts before clipping."""
    signal = float(model["gain"].value[c]) * float(dark_current(model)) * exposure_s
    return signal, _line(model, c, signal)


def _line(model: NoiseModel, c: int, signal_dn):
    gain, read_noise_e = float(model["gain"].value[c]), float(model["read_noise"].sigma)
    return (gain * signal_dn + (gain * read_noise_e) ** 2) * (1 + _row_sigma(model, c) ** 2) + ROUNDING_VARIANCE


def _row_sigma(model: NoiseModel, c: int) -> float:
    return float(model["row_gain"].sigma[c]) if "row_gain" in model else 0.0
