"""The noise budget: its components and their shares, beside those of a model."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hsnoise._core.types import seconds
from hsnoise.plots._style import FIT, NAMES, new_figure, tidy
from hsnoise.statistics.decomposition import COMPONENTS

ORDER = ("temporal", "row_x_frame", "column_x_frame", "frame", "pixel", "column", "row")  # temporal, then static
LABELS = {name: name.replace("_x_", " x ") for name in COMPONENTS}
SHADES = {
    "temporal": "#0072B2",
    "row_x_frame": "#56B4E9",
    "column_x_frame": "#009E73",
    "frame": "#CC79A7",
    "pixel": "#D55E00",
    "column": "#E69F00",
    "row": "#F0E442",
}
CLEAR = 2.0  # standard errors below which a component is an upper limit
BAND = 0.7  # of a component's height, shared by its exposures
MOST_EXPOSURES = 8
DECADES = 9.0  # at most, below the largest component


def budget(found, model=None) -> Figure:
    """Components of the noise of each exposure on a log axis, and their shares; one column of panels per colour.

    Above: variance of each component, one point per exposure, from the shortest (top) to the longest. Arrows: upper
    limits of components within two standard errors of 0. Below: shares of the total, which a log axis does not show.
    With `model`, hollow squares and hatched bars are the budget of frames drawn from it.

    Args:
        found: result of `hsnoise.budget`.
        model: NoiseModel of the same sensor, such as `fit.params`.

    Raises:
        TypeError, ValueError: a model of another sensor.
        ValueError: no exposure has two frames.
    """
    sides = [found] if model is None else [found, found.under(model)]
    chosen = _chosen(found)
    channels = list(dict.fromkeys(found.rows[i].channel for i in chosen))
    of = {name: [i for i in chosen if found.rows[i].channel == name] for name in channels}
    exposures = max(len(rows) for rows in of.values())
    width, heights = max(4.8 * len(channels), 7.5), (0.35 * 7 + 0.3 * exposures + 1.2, 0.42 * exposures + 0.9)
    title = "Noise budget" if model is None else "Noise budget: measurement and model"
    figure = new_figure(width, sum(heights) + 1.0, title)
    grid = figure.subplots(2, len(channels), squeeze=False, gridspec_kw={"height_ratios": heights})
    for c, name in enumerate(channels):
        rows = [[side.rows[i] for i in of[name]] for side in sides]
        _components(grid[0, c], rows)
        _shares(grid[1, c], rows)
        grid[0, c].set_title(NAMES[name], fontsize=10)
        if c:
            for axes in grid[:, c]:
                axes.tick_params(labelleft=False)
    _common_limits(grid[0])
    handles = [Patch(color=SHADES[name], label=LABELS[name]) for name in ORDER]
    handles.append(Line2D([], [], marker="<", mfc="0.7", mec="0.25", linestyle="", label="upper limit"))
    if model is not None:
        handles.append(Line2D([], [], marker="s", mfc="none", mec=FIT, linestyle="", label="model (bars: hatched)"))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=9)
    return figure


def _chosen(found) -> list[int]:
    """Indices of the rows to draw: exposures of two or more frames, evenly chosen if they are many."""
    told = [i for i, row in enumerate(found.rows) if row.n_frames > 1]
    if not told:
        raise ValueError("found: expected an exposure of two frames or more, got none")
    first = found.rows[told[0]].channel
    groups = [i for i in told if found.rows[i].channel == first]
    spread = np.unique(np.linspace(0, len(groups) - 1, min(len(groups), MOST_EXPOSURES)).round().astype(int))
    channels = len(dict.fromkeys(row.channel for row in found.rows))
    return [groups[g] + c for g in spread for c in range(channels)]


def _components(axes: Axes, sides: list[list]) -> None:
    n = len(sides[0])
    offsets = BAND * ((np.arange(n) - (n - 1) / 2) / max(n, 2))
    for y, name in enumerate(ORDER):
        value, error = _numbers(sides[0], name)
        clear, shade = value > CLEAR * error, SHADES[name]
        bars = np.stack([np.minimum(error, 0.9 * np.abs(value)), error])
        axes.plot(np.where(clear, value, np.nan), y + offsets, color=shade, linewidth=1.0, alpha=0.6, zorder=1)
        axes.errorbar(
            value[clear], (y + offsets)[clear], xerr=bars[:, clear], fmt="none", ecolor="0.25", elinewidth=1.0
        )
        axes.scatter(value[clear], (y + offsets)[clear], s=34, c=shade, edgecolors="0.25", linewidths=0.7, zorder=3)
        _limits(axes, value, error, y + offsets, ~clear, shade, "0.25")
        if len(sides) > 1:
            value, error = _numbers(sides[1], name)
            there = value > CLEAR * error
            axes.scatter(value[there], (y + offsets)[there], s=46, marker="s", c="none", edgecolors=FIT, zorder=4)
            _limits(axes, value, error, y + offsets, ~there & clear, "white", FIT)
    axes.axhline(3.5, color="0.6", linewidth=0.8, linestyle=":")
    axes.set_yticks(range(len(ORDER)), [LABELS[name] for name in ORDER])
    axes.set_ylim(len(ORDER) - 0.45, -0.55)
    axes.set_xscale("log")
    axes.set_xlabel("variance / DN²; exposures from top to bottom as below")
    tidy(axes)
    axes.grid(False, axis="y")


def _numbers(rows: list, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Variances of a component and their errors [exposure], DN^2."""
    parts = [row.components[name] for row in rows]
    return np.array([c.variance_dn2 for c in parts]), np.array([c.standard_error_dn2 for c in parts])


def _limits(axes: Axes, value, error, y, shown, face: str, edge: str) -> None:
    """Arrows at the upper limits."""
    most = np.maximum(value, 0) + CLEAR * error
    axes.scatter(most[shown], y[shown], s=30, marker="<", c=face, edgecolors=edge, linewidths=0.8, zorder=3)


def _common_limits(panels) -> None:
    """One scale for all colours: down to the smallest value shown, at most DECADES below the largest."""
    points = [
        np.asarray(one.get_offsets())[:, 0] for axes in panels for one in axes.collections if len(one.get_offsets())
    ]
    shown = np.concatenate(points)
    shown = shown[np.isfinite(shown) & (shown > 0)]
    for axes in panels:
        axes.set_xlim(max(0.5 * shown.min(), shown.max() * 10**-DECADES), 2.5 * shown.max())


def _shares(axes: Axes, sides: list[list]) -> None:
    """Stacked bars of shares, one per exposure, the model's below the measured one; with the total."""
    thick = 0.78 / len(sides)
    for of_model, rows in enumerate(sides):
        y = np.arange(len(rows)) + (of_model - (len(sides) - 1) / 2) * thick
        left = np.zeros(len(rows))
        for name in ORDER:
            share = 100 * np.array([row.components[name].share for row in rows])
            hatch = "///" if of_model else None
            axes.barh(
                y, share, 0.92 * thick, left=left, color=SHADES[name], hatch=hatch, edgecolor="white", linewidth=0.4
            )
            left += share
        for at, row in zip(y, rows, strict=True):
            axes.annotate(f" σ {np.sqrt(row.total_dn2):.3g} DN", (100, at), va="center", fontsize=8.5)
    axes.set_yticks(range(len(sides[0])), [_exposure(row) for row in sides[0]])
    axes.set_ylim(len(sides[0]) - 0.4, -0.6)
    axes.set_xlim(0, 122)
    axes.set_xticks([0, 25, 50, 75, 100])
    axes.set_xlabel("share of the total variance / %")
    tidy(axes)
    axes.grid(False)


def _exposure(row) -> str:
    return f"flat of {row.mean_dn:.5g} DN" if row.kind == "flat" else seconds(row.exposure_s)
