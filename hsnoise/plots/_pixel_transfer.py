"""Pixel transfer of a fit: variance over time against dark signal, by class of pixels."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hsnoise.fitting.result import rounded
from hsnoise.plots._style import COLOURS, FIT, HOT, NAMES, bend_axis, new_figure, plain_log, tidy
from hsnoise.statistics.pixels.classes import slope_over
from hsnoise.statistics.pixels.transfer import Transfer

CURVE_POINTS = 200
FAR = 1.25  # times the largest signal: the end of the axis
TELLING = 0.5  # largest relative error at which the gain of a class is shown
CHANCE, NEAR = 0.1, 0.2  # quantiles of all signals, and of the positive ones, within which the axis is linear
MOST_ERRORS = 3.0  # of the gain, beyond which single classes are off the axis


def pixel_transfer(fit) -> Figure:
    """Variance of single pixels over time against their dark signal, by class of pixels; one column per colour.

    Above: temporal variance of each class and exposure, with the lines fitted to ordinary pixels (round) and hot pixels
    (diamonds), whose Fano factor is below 1. Middle: growth of the variance over growth of the level of each class,
    which is its gain, with the gain of the fit. Below: residuals in standard errors. Signals near 0 are on a linear
    scale, others on a logarithmic one, so that the brightest pixels do not squash the ordinary ones.

    Args:
        fit: result of `hsnoise.fit` in which pixels differ, with darks of two exposures.

    Raises:
        ValueError: a fit that pooled its pixels, or has one exposure.

    Reference: Janesick, *Photon Transfer*, SPIE 2007.
    """
    channels = transfers_of(fit)
    if not channels:
        raise ValueError(
            "fit: pixel transfer needs a fit where pixels differ (fit.transfer) and darks of two exposures; this one"
            " has no pixel transfer"
        )
    width = max(4.6 * len(channels), 7.0)
    figure = new_figure(width, 9.5, "Pixel transfer: variance of single pixels over time against their dark signal")
    grid = figure.subplots(3, len(channels), squeeze=False, sharex="col", gridspec_kw={"height_ratios": [3, 2, 1.2]})
    for i, (name, transfer) in enumerate(channels):
        draw_variances(grid[0, i], [(name, transfer)])
        _gains(grid[1, i], name, transfer, _gain_of(fit, name))
        _residuals(grid[2, i], name, transfer)
        grid[0, i].set_title(
            f"{NAMES[name]}: χ² = {transfer.chi2:.0f} for {transfer.dof:.0f} degrees of freedom", fontsize=10
        )
        grid[2, i].set_xlabel("dark signal / DN")
    for axes, label in zip(grid[:, 0], ("temporal variance / DN²", "gain / (DN/e$^-$)", "residual / σ"), strict=True):
        axes.set_ylabel(label)
    figure.align_ylabels(grid[:, 0])
    return figure


def transfers_of(fit) -> list[tuple[str, Transfer]]:
    """Name and pixel transfer of each colour that has one."""
    return [] if fit.transfer is None else [(c.name, c.transfer) for c in fit.transfer.channels if c.transfer]


def signal_of(transfer: Transfer) -> np.ndarray:
    """Dark signal of each class and exposure without moved pedestals [class, exposure], DN."""
    classes, t = transfer.classes, transfer.classes.exposure_s
    level = classes.level_dn - transfer.pedestal_dn
    shortest = int(t.argmin())
    return level - level[:, [shortest]] + t.min() * slope_over(t, level.T)[:, None]


def draw_variances(axes: Axes, channels: list[tuple[str, Transfer]]) -> None:
    """Variance against dark signal of all classes, and the fitted lines of ordinary and hot pixels, by colour."""
    several = len(channels) > 1
    for name, transfer in channels:
        _points(axes, name, transfer, signal_of(transfer), transfer.classes.variance_dn2)
        _lines(axes, transfer, COLOURS[name] if several else FIT, NAMES[name] if several else "ordinary pixels")
    x = np.concatenate([signal_of(t)[_used(t)] for _, t in channels])
    y = np.concatenate([t.classes.variance_dn2[_used(t)] for _, t in channels])
    near = _near(x)
    bend_axis(axes, near, min(-0.3 * near, 1.1 * float(x.min(initial=0.0))), FAR * float(x.max(initial=1e-6)))
    axes.set_yscale("log")
    axes.set_ylim(0.8 * y.min(), 1.4 * y.max())
    plain_log(axes.yaxis)
    axes.legend(fontsize=8.5, loc="upper left", framealpha=0.9)
    tidy(axes)


def _points(axes: Axes, name: str, transfer: Transfer, x: np.ndarray, y: np.ndarray, error=None, shown=None) -> None:
    """Classes [class, exposure]: ordinary ones in the colour of the channel, hot ones as diamonds."""
    error = transfer.classes.error_dn2 if error is None else error
    shown = _used(transfer) if shown is None else shown
    for hot, colour, marker in ((False, COLOURS[name], "o"), (True, HOT, "D")):
        here = shown & (transfer.classes.hot == hot)[:, None]
        if here.any():
            axes.errorbar(x[here], y[here], error[here], fmt=marker, ms=5, color=colour, mec="white", mew=0.6, zorder=3)


def _lines(axes: Axes, transfer: Transfer, colour: str, name: str) -> None:
    classes, floor = transfer.classes, float(transfer.values[1])
    top = FAR * float(signal_of(transfer)[_used(transfer)].max(initial=1e-6))
    s = np.append(0.0, np.geomspace(1e-3 * top, top, CURVE_POINTS))
    label = f"{name}: {_with_error(transfer.ordinary_gain, transfer.ordinary_error)}"
    axes.plot(s, floor + transfer.ordinary_gain * s, color=colour, linewidth=1.4, label=label)
    if np.isfinite(transfer.hot_gain):
        ordinary = float(transfer.values[2]) * classes.exposure_s.max()
        s = np.geomspace(max(classes.limit_dn_per_s * classes.exposure_s.max(), 1e-3 * top), top, CURVE_POINTS)
        line = floor + transfer.ordinary_gain * ordinary + transfer.hot_gain * (s - ordinary)
        fano = " ± ".join(rounded(transfer.fano, transfer.fano_error))
        label = f"hot pixels: {_with_error(transfer.hot_gain, transfer.hot_error)}\n(Fano factor {fano})"
        axes.plot(s, line, "--", color=HOT, linewidth=1.6, label=label)


def _with_error(gain: float, error: float) -> str:
    return f"{' ± '.join(rounded(gain, error))} DN/e$^-$"


def _near(x: np.ndarray) -> float:
    """Signal below which the axis is linear: small signals, and scatter around 0."""
    small = float(np.quantile(x[x > 0], NEAR)) if (x > 0).any() else 1.0
    return max(small, -2 * float(np.quantile(x, CHANCE)))


def _used(transfer: Transfer) -> np.ndarray:
    return np.isfinite(transfer.fitted_dn2)


def _gain_of(fit, name: str) -> tuple[float, float]:
    """Gain of the fit and its error, DN/e-; NaN where it is not determined."""
    return fit.table["gain" if name == "mono" else f"gain.{name}"][:2]


def _gains(axes: Axes, name: str, transfer: Transfer, gain: tuple[float, float]) -> None:
    """Gain of each class: growth of its variance over growth of its level, from the shortest exposure on."""
    classes, x, used = transfer.classes, signal_of(transfer), _used(transfer)
    shortest = int(classes.exposure_s.argmin())
    grown = x - x[:, [shortest]]
    with np.errstate(divide="ignore", invalid="ignore"):
        own = (classes.variance_dn2 - classes.variance_dn2[:, [shortest]]) / grown
        error = np.hypot(classes.error_dn2, classes.error_dn2[:, [shortest]]) / np.abs(grown)
    middle = gain[0] if np.isfinite(gain[0]) else transfer.hot_gain
    limit = MOST_ERRORS * abs(middle) if np.isfinite(middle) else np.inf
    shown = (
        used & used[:, [shortest]] & (grown > 0) & (error < max(TELLING * abs(middle), 1e-9)) & (np.abs(own) < limit)
    )
    _points(axes, name, transfer, x, own, error, shown)
    if np.isfinite(gain[0]):
        axes.axhspan(gain[0] - gain[1], gain[0] + gain[1], color="0.8", zorder=0)
        axes.axhline(gain[0], color=FIT, linewidth=1.4, label=f"gain of the fit: {_with_error(*gain)}")
    else:
        axes.set_yticks([])
        axes.text(0.5, 0.5, "the gain is not determined", transform=axes.transAxes, ha="center", fontsize=11)
    if np.isfinite(transfer.hot_gain):
        axes.axhline(transfer.hot_gain, color=HOT, linewidth=1.6, linestyle="--")
    if np.isfinite(middle):
        axes.set_ylim(0, max(1.6 * abs(middle), 1.1 * float(own[shown].max(initial=0.0))))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8.5, loc="lower left", framealpha=0.9)
    tidy(axes)


def _residuals(axes: Axes, name: str, transfer: Transfer) -> None:
    classes, x, used = transfer.classes, signal_of(transfer), _used(transfer)
    with np.errstate(invalid="ignore"):
        residual = (classes.variance_dn2 - transfer.fitted_dn2) / classes.error_dn2
    axes.axhspan(-2, 2, color="0.92")
    axes.axhline(0, color=FIT, linewidth=0.8)
    _points(axes, name, transfer, x, residual, np.zeros_like(x))
    reach = 1.15 * max(3.0, float(np.abs(residual[used]).max(initial=0.0)))
    axes.set_ylim(-reach, reach)
    tidy(axes)
