"""Map of the flagged pixels on the sensor."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hsnoise.plots._style import new_figure, tidy
from hsnoise.statistics.pixels.flags import FLAGS

MOST_DOTS = 1500  # of one kind; more are drawn as a density
BLOCKS = 96  # along the longer side of a density
COLOURS = {"stuck": "#0072B2", "dead": "black", "hot": "#D55E00", "telegraph": "#009E73"}
MARKERS = {"stuck": "s", "dead": "x", "hot": "o", "telegraph": "^"}
MEANINGS = {"stuck": "stuck", "dead": "dead", "hot": "hot", "telegraph": "telegraph-like"}
PER_BLOCK = 6.0  # pixels in a block of the density, so that it shows more than chance
HIGHEST = 0.995  # quantile of the blocks at the end of the colour scale


def pixel_map(fit) -> Figure:
    """Map of the pixels that are stuck, dead, hot or telegraph-like: dots where they are few, a density where many.

    Args:
        fit: result of `hsnoise.fit`, of frames with a dark exposure of two frames or more.

    Raises:
        ValueError: as `fit.pixels` raises.
    """
    flags = fit.pixels.flags
    rows, columns = flags.shape
    found = {name: np.argwhere(flags & bit > 0) for name, bit in FLAGS.items()}
    many = [name for name, places in found.items() if len(places) > MOST_DOTS]
    width = 7.0 * max(len(many), 1)
    height = float(np.clip(6.8 * rows / columns, 1.7, 7.5)) + (2.1 if many else 1.3)
    figure = new_figure(width, height, f"Pixels set apart, of {rows} rows x {columns} columns")
    panels = figure.subplots(1, max(len(many), 1), squeeze=False, sharex=True, sharey=True)[0]
    for axes, name in zip(panels, many, strict=False):
        _density(figure, axes, name, found[name], (rows, columns))
    for name, places in found.items():
        if name not in many and len(places):
            panels[0].scatter(
                places[:, 1], places[:, 0], s=16, marker=MARKERS[name], color=COLOURS[name], linewidths=0.8, zorder=3
            )
    for axes in panels:
        axes.set_xlim(-0.5, columns - 0.5)
        axes.set_ylim(rows - 0.5, -0.5)
        axes.set_aspect("equal")
        axes.set_xlabel("column")
        tidy(axes)
        axes.grid(False)
    panels[0].set_ylabel("row")
    _legend(figure, found, many, flags.size, fit.summary.flats is not None)
    return figure


def _density(figure: Figure, axes: Axes, name: str, places: np.ndarray, shape: tuple[int, int]) -> None:
    """Share of the pixels of each block."""
    rows, columns = shape
    block = int(np.ceil(max(max(shape) / BLOCKS, np.sqrt(PER_BLOCK * rows * columns / len(places)))))
    edges = [np.append(np.arange(0, size, block), size) - 0.5 for size in shape]
    counts = np.histogram2d(places[:, 0], places[:, 1], edges)[0]
    percent = 100 * counts / np.outer(np.diff(edges[0]), np.diff(edges[1]))
    most = float(np.quantile(percent, HIGHEST))
    image = axes.pcolormesh(edges[1], edges[0], percent, cmap="viridis", vmin=0, vmax=most, rasterized=True)
    extend = "max" if percent.max() > most else "neither"
    bar = figure.colorbar(image, ax=axes, location="bottom", format="%g", extend=extend, shrink=0.8, aspect=40)
    bar.set_label(f"{MEANINGS[name]} pixels in blocks of {block} x {block} / %", fontsize=9)
    bar.ax.tick_params(labelsize=9)
    axes.set_title(f"{MEANINGS[name]} pixels", fontsize=10)


def _legend(figure: Figure, found: dict[str, np.ndarray], many: list[str], pixels: int, lit: bool) -> None:
    """Numbers and shares of all kinds; densities have no marker."""
    handles = []
    for name, places in found.items():
        label = (
            f"{MEANINGS[name]}: {len(places):,}, {100 * len(places) / pixels:.2g} %"
            if len(places)
            else f"{MEANINGS[name]}: none"
        )
        label += " (shaded)" if name in many else ""
        if name == "dead" and not lit:
            label = "dead: flats would show them"
        marker = "" if name in many or not len(places) else MARKERS[name]
        handles += figure.axes[0].plot([], [], marker=marker, linestyle="", color=COLOURS[name], label=label)
    figure.legend(handles=handles, loc="outside lower center", ncols=2 if len(many) < 2 else 4, fontsize=9)
