"""Histograms of a fit."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from hsnoise._core.types import seconds
from hsnoise.likelihood.summary import RowHistograms
from hsnoise.plots._sampled import sampled_histograms
from hsnoise.plots._style import COLOURS, FIT, NAMES, new_figure, tidy, title_of

MOST_BINS = 90  # that a panel can resolve
ENOUGH = 10.0  # expected counts; with fewer no residual is shown
MOST_EXPOSURES = 6


def histograms(fit) -> Figure:
    """Counts of the dark frames, measured (steps) and fitted (line), with residuals; a panel per exposure and colour.

    Logarithmic, so that the tails show. Residuals are in standard deviations of a measured bin, estimated from its
    scatter between frames (between rows for a single frame): all pixels of a row share a gain, so a bin scatters more
    than its square root. The outermost bins hold everything beyond. At most six exposures are shown. Where pixels
    differ, no single distribution holds for all of them, so counts are sampled from the model.

    Args:
        fit: result of `hsnoise.fit`, of a stack with dark frames.

    Raises:
        ValueError: there are no dark frames.
    """
    summary = fit.summary
    if not summary.histograms:
        raise ValueError("fit: expected dark frames in the stack, got none")
    if fit.transfer is not None:
        return sampled_histograms(fit)
    exposures = len(summary.exposure_s)
    shown = np.unique(np.linspace(0, exposures - 1, min(exposures, MOST_EXPOSURES)).round().astype(int))
    columns = len(summary.histograms)
    width, height = max(4.3 * columns, 6.4), 3.1 * len(shown) + 0.5
    figure = new_figure(width, height, title_of("Counts of the dark frames: measured and fitted", fit))
    expected = fit.expected_histograms()
    grid = figure.subplots(2 * len(shown), columns, squeeze=False, gridspec_kw={"height_ratios": [3, 1] * len(shown)})
    for i, e in enumerate(shown):
        for c, measured in enumerate(summary.histograms):
            top, strip = grid[2 * i, c], grid[2 * i + 1, c]
            top.sharex(strip)
            top.tick_params(labelbottom=False)
            _panel(top, strip, measured, np.asarray(expected[c][e], np.float64), e)
            top.set_title(f"{NAMES[measured.channel]}, {seconds(summary.exposure_s[e])}", fontsize=10)
            if c == 0:
                top.set_ylabel("pixels per DN")
                strip.set_ylabel("residual / σ")
            if i == len(shown) - 1:
                strip.set_xlabel("count / DN")
    grid[0, 0].legend(fontsize=9, loc="best")
    figure.align_ylabels(grid[:, 0])
    return figure


def _panel(top: Axes, strip: Axes, histograms: RowHistograms, expected: np.ndarray, e: int) -> None:
    used = histograms.row_pixels[e, :, 0] > 0
    counts = histograms.counts[e][used].astype(np.float64)
    measured, sigma, expected, edges = _visible(*_coarse(counts, expected, histograms.edges_dn[e]))
    width = np.diff(edges)
    colour = COLOURS[histograms.channel]
    top.stairs(measured / width, edges, color=colour, fill=True, alpha=0.3, label="measured")
    top.stairs(measured / width, edges, color=colour, linewidth=1.0)
    top.stairs(expected / width, edges, baseline=None, color=FIT, linewidth=1.4, label="fitted")
    top.set_yscale("log")
    highest = max(measured.max(), expected.max()) / width.min()
    top.set_ylim(max(0.5 / width.max(), 1e-7 * highest), 2.5 * highest)
    enough = expected >= ENOUGH
    middle = 0.5 * (edges[1:] + edges[:-1])
    residual = (measured - expected) / sigma
    strip.axhspan(-2, 2, color="0.92")
    strip.axhline(0, color=FIT, linewidth=0.8)
    strip.plot(middle[enough], residual[enough], ".", color=colour, markersize=4.5)
    reach = 1.15 * max(4.0, float(np.abs(residual[enough]).max(initial=0.0)))
    strip.set_ylim(-reach, reach)
    strip.xaxis.set_major_locator(MaxNLocator(nbins=7, integer=True))
    strip.yaxis.set_major_locator(MaxNLocator(nbins=4, integer=True, symmetric=True))
    top.yaxis.set_minor_locator(NullLocator())
    tidy(top)
    tidy(strip)


def _coarse(counts: np.ndarray, expected: np.ndarray, edges_dn: np.ndarray):
    """Merge neighbouring bins until a panel can resolve them.

    counts [frame, row, bin], expected [bin], inner edges_dn [bin - 1]. Returns measured, its standard deviation and
    expected [coarse bin], and all edges [coarse bin + 1]; the outermost bins are drawn as wide as their neighbours.
    """
    filled = np.flatnonzero((counts.sum((0, 1)) > 0) | (expected > 0.5))
    step = max(1, -(-(filled[-1] - filled[0]) // MOST_BINS))
    starts = np.concatenate([[0], np.arange(1, counts.shape[-1] - 1, step), [counts.shape[-1] - 1]]).astype(int)
    counts, expected = np.add.reduceat(counts, starts, axis=-1), np.add.reduceat(expected, starts)
    inner = edges_dn[starts[1:] - 1]
    outer = step * (edges_dn[1] - edges_dn[0]) if len(edges_dn) > 1 else 1.0
    edges = np.concatenate([[inner[0] - outer], inner, [inner[-1] + outer]])
    units = counts.sum(1) if len(counts) > 1 else counts[0]
    scatter = np.sqrt(len(units)) * units.std(0, ddof=1)
    return counts.sum((0, 1)), np.maximum(scatter, np.sqrt(np.maximum(expected, 1.0))), expected, edges


def _visible(measured, sigma, expected, edges):
    """Drop empty bins at either end, and bins of zero width (codes beyond the white level)."""
    filled = np.flatnonzero((measured > 0) | (expected > 0.5))
    part = np.arange(filled[0], filled[-1] + 1)
    part = part[np.diff(edges)[part] > 0]
    return measured[part], sigma[part], expected[part], edges[np.append(part, part[-1] + 1)]
