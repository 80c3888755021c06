"""Clip-correction tables: the paper's Fig. 4."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import Locator, LogLocator, MaxNLocator

from hsnoise.lut import make_clip_tables
from hsnoise.plots._style import new_figure

CONTOURS, SUBDIVISIONS = 10, (1, 1.5, 2, 3, 4, 5, 7)


class ClipTableFigure(NamedTuple):
    """The paper's Fig. 4: true moments [variance, mean] on a grid of clipped ones, DN above black and DN^2."""

    clipped_mean_dn: np.ndarray
    clipped_variance_dn2: np.ndarray
    true_mean_dn: np.ndarray
    true_variance_dn2: np.ndarray
    solved: np.ndarray


def clip_table_figure(
    gain: float = 1.53,
    *,
    black_level_dn: float = 0.0,
    white_level_dn: float | None = None,
    mean_dn: tuple[float, float] = (0.5, 20.0),
    variance_dn2: tuple[float, float] = (2.0, 60.0),
    points: int = 240,
) -> ClipTableFigure:
    """Both tables over the clipped moments of darks; by default for the Canon's red pixels at black 0.

    Args:
        gain: DN/e-; black_level_dn, white_level_dn as in `make_clip_tables`.
        mean_dn: range of clipped means, DN above black.
        variance_dn2: range of clipped variances, DN^2.
        points: along each axis.

    Where `solved` is false, no Poisson + normal distribution of this gain has the pair, and true moments are NaN.
    """
    mean, variance = np.linspace(*mean_dn, points), np.linspace(*variance_dn2, points)
    tables = make_clip_tables(
        gain, black_level_dn=black_level_dn, white_level_dn=white_level_dn, variance_dn2=variance_dn2
    )
    with jax.enable_x64(True):
        true_mean, true_variance, solved = map(np.asarray, tables(mean[None, :], variance[:, None]))
    true_mean, true_variance = np.where(solved, true_mean, np.nan), np.where(solved, true_variance, np.nan)
    return ClipTableFigure(mean, variance, true_mean, true_variance, solved)


def clip_tables(gain_dn_per_e: float = 1.53, **keywords) -> Figure:
    """True mean and variance of noise against those of its clipped counts: two panels.

    A pair of clipped mean and variance is a point; colour and contours show the unclipped moments. Far to the right
    nothing is clipped and the contours are straight. Hatched: no Poisson plus normal noise of this gain has these
    moments, because the mean is below that of noise around black (left), or the variance below that of shot noise
    (right).

    Args:
        gain_dn_per_e: gain, DN/e-; by default that of the red pixels of the paper's Canon.
        **keywords: black level, ranges, ... of `clip_table_figure`.

    Reference: Wang et al., "Enhancing Low Light Videos by Exploring High Sensitivity Camera Noise", ICCV 2019, Fig. 4.
    """
    data = clip_table_figure(gain_dn_per_e, **keywords)
    figure = new_figure(11.5, 4.8, f"Clip correction at a gain of {gain_dn_per_e:g} DN/e-")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    _panel(figure, left, data, data.true_mean_dn, "true mean above black / DN", "linear", MaxNLocator(CONTOURS))
    _panel(figure, right, data, data.true_variance_dn2, "true variance / DN²", "log", LogLocator(subs=SUBDIVISIONS))
    left.set_ylabel("variance of clipped counts / DN²")
    return figure


def _panel(
    figure: Figure, axes: Axes, data: ClipTableFigure, values: np.ndarray, title: str, norm: str, locator: Locator
) -> None:
    x, y = data.clipped_mean_dn, data.clipped_variance_dn2
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("mean of clipped counts above black / DN")
    axes.tick_params(labelsize=9)
    # Drawn below the colours, so that it shows only where there are none.
    axes.patch.set(facecolor="0.93", edgecolor="0.6", hatch="///")
    shading = axes.pcolormesh(x, y, values, cmap="viridis", shading="nearest", norm=norm, rasterized=True)
    lines = axes.contour(x, y, values, locator=locator, colors="white", linewidths=0.8)
    axes.clabel(lines, fontsize=8, fmt="%g")
    bar = figure.colorbar(shading, ax=axes, ticks=locator, format="%g")
    bar.ax.tick_params(labelsize=9)
    bar.ax.minorticks_off()
    axes.legend(
        handles=[Patch(facecolor="0.93", edgecolor="0.6", hatch="///", label="no such noise")],
        fontsize=9,
        loc="lower right",
        framealpha=0.9,
    )
