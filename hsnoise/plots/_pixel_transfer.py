"""Pixel transfer of a fit where pixels differ: variance over time against dark signal, by class of pixels."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from hsnoise.pixels.classes import slope_over
from hsnoise.pixels.transfer import Transfer
from hsnoise.plots._style import COLOURS, FIT, HOT, NAMES, new_figure, tidy
from hsnoise.result import rounded

CURVE_POINTS = 200
TELLING = 0.5  # relative error up to which the gain of one class is shown
NEAR = 0.2  # quantile of the signals below which the axis is linear
MOST_ERRORS = 3.0  # of the gain: beyond it a single class is out of the picture


def pixel_transfer(fit) -> Figure:
    """How the variance of single pixels over time grows with their dark signal, by class of pixels; one column a colour.

    Above: temporal variance of each class and exposure against its dark signal, with the lines of ordinary pixels and of
    hot ones (their Fano factor is below 1). Middle: growth of the variance over growth of the level of each class,
    which is its gain, with the gain of the fit. Below: what the fit leaves, in standard errors. Long darks are a flat
    field of many light levels: the axes are logarithmic, so that the brightest pixels do not squash the ordinary ones.

    Args:
        fit: result of `hsnoise.fit`, where pixels differ and darks have two exposures.

    Raises:
        ValueError: a fit that pooled its pixels, or of one exposure.

    Reference: Janesick, *Photon Transfer*, SPIE 2007.
    """
    channels = transfers_of(fit)
    if not channels:
        raise ValueError(
            "fit: pixel transfer needs a fit where pixels differ (fit.transfer) and darks of two exposures, which this"
            " one has not"
        )
    width = max(4.6 * len(channels), 7.0)
    figure = new_figure(width, 9.5, "Pixel transfer: variance of single pixels over time against their dark signal")
    grid = figure.subplots(3, len(channels), squeeze=False, sharex="col", gridspec_kw={"height_ratios": [3, 2, 1.2]})
    for i, (name, transfer) in enumerate(channels):
        draw_variances(grid[0, i], name, transfer)
        _gains(grid[1, i], name, transfer, _gain_of(fit, name))
        _residuals(grid[2, i], name, transfer)
        grid[0, i].set_title(
            f"{NAMES[name]}: χ² = {transfer.chi2:.1f} for {transfer.dof:.1f} degrees of freedom", fontsize=10
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
    """Dark signal of each class and exposure, moved pedestals taken off [class, exposure], DN."""
    classes, t = transfer.classes, transfer.classes.exposure_s
    level = classes.level_dn - transfer.pedestal_dn
    shortest = int(t.argmin())
    return level - level[:, [shortest]] + t.min() * slope_over(t, level.T)[:, None]


def draw_variances(axes: Axes, name: str, transfer: Transfer) -> None:
    """Variance against dark signal of all classes, and the two lines."""
    classes, x = transfer.classes, signal_of(transfer)
    floor, used = float(transfer.values[1]), _used(transfer)
    for hot, colour in ((False, COLOURS[name]), (True, HOT)):
        here = used & (classes.hot == hot)[:, None]
        if here.any():
            y, error = classes.variance_dn2[here], classes.error_dn2[here]
            axes.errorbar(
                x[here], y, error, fmt="D" if hot else "o", ms=5, color=colour, mec="white", mew=0.6, zorder=3
            )
    top = float(x[used].max(initial=1.0)) * 1.2
    s = np.append(0.0, np.geomspace(1e-3 * top, top, CURVE_POINTS))
    axes.plot(s, floor + transfer.ordinary_gain * s, color=FIT, linewidth=1.4, label=_of_ordinary(transfer))
    if np.isfinite(transfer.hot_gain):
        ordinary = float(transfer.values[2]) * classes.exposure_s.max()
        s = np.geomspace(max(classes.limit_dn_per_s * classes.exposure_s.max(), 1e-3 * top), top, CURVE_POINTS)
        line = floor + transfer.ordinary_gain * ordinary + transfer.hot_gain * (s - ordinary)
        axes.plot(s, line, "--", color=HOT, linewidth=1.6, label=_of_hot(transfer))
    signal_axis(axes, _near(x[used]), top)
    axes.set_yscale("log")
    low, high = classes.variance_dn2[used].min(initial=floor), classes.variance_dn2[used].max(initial=floor)
    axes.set_ylim(0.8 * low, 1.4 * high)
    axes.legend(fontsize=8.5, loc="upper left", framealpha=0.9)
    tidy(axes)


def signal_axis(axes: Axes, near: float, far: float) -> None:
    """Linear up to `near`, logarithmic beyond, with plain numbers that do not meet."""
    axes.set_xscale("symlog", linthresh=near, linscale=0.5)
    decades = 10.0 ** np.arange(np.ceil(np.log10(1.5 * near)), np.floor(np.log10(far)) + 1)
    axes.set_xticks([0.0, *decades], ["0", *(f"{x:,g}" for x in decades)])
    axes.xaxis.set_minor_locator(NullLocator())


def _used(transfer: Transfer) -> np.ndarray:
    return np.isfinite(transfer.fitted_dn2)


def _near(x: np.ndarray) -> float:
    """Signal below which the axis is linear."""
    return float(np.quantile(x[x > 0], NEAR)) if (x > 0).any() else 1.0


def _of_ordinary(transfer: Transfer) -> str:
    return f"ordinary pixels: {_with_error(transfer.ordinary_gain, transfer.ordinary_error)}"


def _of_hot(transfer: Transfer) -> str:
    fano = " ± ".join(rounded(transfer.fano, transfer.fano_error))
    return f"hot pixels: {_with_error(transfer.hot_gain, transfer.hot_error)}\n(Fano factor {fano})"


def _with_error(gain: float, error: float) -> str:
    return f"{' ± '.join(rounded(gain, error))} DN/e$^-$"


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
    for hot, colour in ((False, COLOURS[name]), (True, HOT)):
        here = shown & (classes.hot == hot)[:, None]
        if here.any():
            marker = "D" if hot else "o"
            axes.errorbar(x[here], own[here], error[here], fmt=marker, ms=5, color=colour, mec="white", mew=0.6)
    if np.isfinite(gain[0]):
        axes.axhspan(gain[0] - gain[1], gain[0] + gain[1], color="0.8", zorder=0)
        axes.axhline(
            gain[0], color=FIT, linewidth=1.4, label=f"gain of the fit: {gain[0]:.4g} ± {gain[1]:.1g} DN/e$^-$"
        )
    else:
        axes.plot([], [], " ", label="the gain is not determined")
    if np.isfinite(transfer.hot_gain):
        axes.axhline(transfer.hot_gain, color=HOT, linewidth=1.6, linestyle="--")
    if np.isfinite(middle):
        axes.set_ylim(0, max(1.6 * abs(middle), 1.1 * float(own[shown].max(initial=0.0))))
    axes.legend(fontsize=8.5, loc="lower left", framealpha=0.9)
    tidy(axes)


def _residuals(axes: Axes, name: str, transfer: Transfer) -> None:
    classes, x, used = transfer.classes, signal_of(transfer), _used(transfer)
    with np.errstate(invalid="ignore"):
        residual = (classes.variance_dn2 - transfer.fitted_dn2) / classes.error_dn2
    axes.axhspan(-2, 2, color="0.92")
    axes.axhline(0, color=FIT, linewidth=0.8)
    for hot, colour in ((False, COLOURS[name]), (True, HOT)):
        here = used & (classes.hot == hot)[:, None]
        axes.plot(x[here], residual[here], "D" if hot else "o", ms=4.5, color=colour, mec="white", mew=0.5)
    reach = 1.15 * max(3.0, float(np.abs(residual[used]).max(initial=0.0)))
    axes.set_ylim(-reach, reach)
    tidy(axes)
