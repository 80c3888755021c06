"""Figures of how pixels differ: measured frames beside frames drawn from the fit."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from hsnoise._core.types import cfa_tile, seconds
from hsnoise.frames.stack import FrameStack
from hsnoise.likelihood.darks import black_level
from hsnoise.plots._style import COLOURS, FIT, NAMES, bend_axis, new_figure, tidy
from hsnoise.simulation.draws import draw_capture
from hsnoise.simulation.portion import middle_of
from hsnoise.statistics.pixels.classes import growth_noise, levels_of, slope_over
from hsnoise.statistics.pixels.survey import survey

CORE = (5e-4, 0.97)  # quantiles between which bins have equal width
CORE_BINS, WIDER = 60, 1.25  # bins of the core; factor by which each bin outside is wider than the last
FEWEST = 5  # counts in a bin that are enough to show a ratio
MOST_RATIO = 10.0
RATIOS = (0.1, 0.2, 0.5, 1, 2, 5, 10)
MOST_EXPOSURES = 6
WIDE = 3.0  # times the core; wider axes become logarithmic outside


def drawn_beside(fit) -> tuple[FrameStack, FrameStack]:
    """The middle of a fit's darks, and frames drawn from its model under the same conditions.

    Raises ValueError for a fit without frames or darks.
    """
    if fit.stack is None:
        raise ValueError("fit: expected a fit of frames, got one of a Summary")
    part = middle_of(fit.stack, ("dark",))
    return part, draw_capture(0, fit.params, part)


def dark_current(fit) -> Figure:
    """How dark current differs between pixels, measured beside sampled; one column per colour.

    The dark current of a pixel is the growth of its level with exposure, which noise also affects. As many frames are
    drawn from the fit and evaluated in the same way, so both distributions contain the same noise. Above: the
    distribution of dark current, and, shaded, the noise of one pixel's estimate. Below: the share of pixels above each
    dark current. Only the middle of large frames is shown.

    Args:
        fit: result of `hsnoise.fit`, of darks of two exposures with two frames each.

    Raises:
        ValueError: darks that do not show dark current, or a fit of a Summary.
    """
    part, drawn = drawn_beside(fit)
    measured, sampled = _growths(part), _growths(drawn)
    if not measured:
        raise ValueError("fit: expected darks of two exposures with two frames or more, got none")
    gain, unit = _unit(fit)
    width = max(4.6 * len(measured), 7.0)
    figure = new_figure(width, 7.2, "Dark current of single pixels: measured, and sampled from the fit")
    grid = figure.subplots(2, len(measured), squeeze=False, sharex="col", gridspec_kw={"height_ratios": [3, 2]})
    for c, name in enumerate(part.channels):
        halves, other = measured[c] / gain[c], sampled[c].mean(0) / gain[c]
        noise = growth_noise(halves) / np.sqrt(2)
        _population(grid[:, c], name, halves.mean(0), other, noise)
        grid[0, c].set_title(f"{NAMES[name]}: {halves.shape[1]:,} pixels", fontsize=10)
        grid[1, c].set_xlabel(f"dark current / ({unit})")
    grid[0, 0].set_ylabel(f"pixels per {unit}")
    grid[1, 0].set_ylabel("share of pixels above")
    figure.align_ylabels(grid[:, 0])
    return figure


def _growths(stack: FrameStack) -> list[np.ndarray]:
    """Growth of the sampled pixels in two halves of the frames [half, pixel], DN/s, for each colour."""
    found = survey(stack)
    levels = [levels_of(found, c) for c in range(len(found.channels))]
    return [slope_over(one.exposure_s, one.level) for one in levels if one is not None]


def _unit(fit) -> tuple[np.ndarray, str]:
    """The divisor [channel] and the unit: electrons if the gain is known."""
    gain = np.asarray(fit.params["gain"].value)
    known = fit.has_gain
    return (gain, "e$^-$/s") if known else (np.ones_like(gain), "DN/s")


def _population(panels, name: str, measured: np.ndarray, sampled: np.ndarray, noise: float) -> None:
    top, below = panels
    edges = edges_of(measured, sampled)
    top.axvspan(-noise, noise, color="0.92")
    _steps(top, name, measured, sampled, edges)
    top.legend(fontsize=9, loc="upper right", framealpha=0.9)
    lines = {"measured": (measured, COLOURS[name], "-"), "sampled": (sampled, FIT, "--")}
    for label, (values, colour, style) in lines.items():
        x = np.sort(values)
        share = 1 - np.arange(len(x)) / len(x)
        some = np.unique(np.append(np.linspace(0, len(x) - 1, 400), len(x) - np.geomspace(1, len(x), 400)).astype(int))
        below.plot(x[some], share[some], style, color=colour, linewidth=1.5, label=label)
    below.set_yscale("log")
    below.legend(fontsize=9, loc="upper right", framealpha=0.9)
    for axes in panels:
        wide_axis(axes, edges)
        tidy(axes)


def sampled_histograms(fit) -> Figure:
    """Counts of the dark frames where pixels differ, measured beside sampled; a panel per exposure and colour.

    No single distribution holds for all pixels here, so frames are drawn from the fit. The strips show the ratio of
    measured to sampled pixels. Errors assume that pixels keep their counts in all frames.
    """
    part, drawn = drawn_beside(fit)
    shown = np.unique(np.linspace(0, part.n_exposures - 1, min(part.n_exposures, MOST_EXPOSURES)).round().astype(int))
    columns = len(part.channels)
    title = "Counts of the dark frames: measured, and sampled from the fit"
    figure = new_figure(max(4.3 * columns, 6.4), 3.1 * len(shown) + 0.5, title)
    grid = figure.subplots(2 * len(shown), columns, squeeze=False, gridspec_kw={"height_ratios": [3, 1.2] * len(shown)})
    black = np.asarray(black_level(fit.params))
    for i, e in enumerate(shown):
        for c, name in enumerate(part.channels):
            top, strip = grid[2 * i, c], grid[2 * i + 1, c]
            measured, sampled = (_counts(stack, e, c) - black[c] for stack in (part, drawn))
            edges = edges_of(measured, sampled, black[c])
            _steps(top, name, measured, sampled, edges)
            _ratio(strip, name, measured, sampled, edges, part.n_frames[e])
            for axes in (top, strip):
                wide_axis(axes, edges)
                tidy(axes)
            top.tick_params(labelbottom=False)
            top.set_title(f"{NAMES[name]}, {seconds(part.exposure_s[e])}", fontsize=10)
            if i == len(shown) - 1:
                strip.set_xlabel("count above black level / DN")
        grid[2 * i, 0].set_ylabel("pixels per DN")
        grid[2 * i + 1, 0].set_ylabel("measured\n/ sampled")
    grid[0, 0].legend(fontsize=9)
    figure.align_ylabels(grid[:, 0])
    return figure


def _counts(stack: FrameStack, exposure: int, channel: int) -> np.ndarray:
    """All counts of a colour in an exposure [count], DN."""
    tile = cfa_tile(stack.cfa)
    step = len(tile)
    frames = np.stack(list(stack.frames(exposure)))
    return np.concatenate([frames[:, r::step, c::step].ravel() for r, c in np.argwhere(tile == channel)]).astype(float)


def edges_of(measured: np.ndarray, sampled: np.ndarray, black_dn: float | None = None) -> np.ndarray:
    """Edges of bins: equal bins for the core, ever wider bins for the tails.

    With `black_dn`, values are whole counts minus `black_dn`, and edges lie between counts.
    """
    both = np.concatenate([measured, sampled])
    low, high = np.quantile(both, CORE)
    step = max((high - low) / CORE_BINS, 1e-12)
    if black_dn is not None:
        step = max(np.ceil(step), 1.0)
        low = np.floor(low + black_dn) - 0.5 - black_dn
    core = low + step * np.arange(np.ceil((high - low) / step) + 1)
    tails = [core]
    for far, end, sign in ((both.max() - core[-1], core[-1], 1), (core[0] - both.min(), core[0], -1)):
        if far > step:
            tails.append(end + sign * _widening(step, far, black_dn is not None))
    return np.unique(np.concatenate(tails))


def _widening(step: float, far: float, whole: bool) -> np.ndarray:
    """Distances from the core to beyond `far`, each step wider than the one before."""
    bins = int(np.ceil(np.log1p(far / step * (WIDER - 1)) / np.log(WIDER))) + 1
    widths = step * WIDER ** np.arange(1, bins + 1)
    return np.cumsum(np.round(widths / step) * step if whole else widths)


def _steps(axes: Axes, name: str, measured: np.ndarray, sampled: np.ndarray, edges: np.ndarray) -> None:
    """Both distributions, per unit of the axis."""
    width = np.diff(edges)
    of_measured, of_sampled = (np.histogram(x, edges)[0] * len(measured) / len(x) for x in (measured, sampled))
    colour = COLOURS[name]
    axes.stairs(of_measured / width, edges, color=colour, fill=True, alpha=0.3, label="measured")
    axes.stairs(of_measured / width, edges, color=colour, linewidth=1.0)
    axes.stairs(of_sampled / width, edges, baseline=None, color=FIT, linewidth=1.4, label="sampled")
    axes.set_yscale("log")
    filled = np.concatenate([(x / width)[x > 0] for x in (of_measured, of_sampled)])
    axes.set_ylim(0.5 * filled.min(), 2.5 * filled.max())


def _ratio(axes: Axes, name: str, measured: np.ndarray, sampled: np.ndarray, edges: np.ndarray, frames: int) -> None:
    m, s = (np.histogram(x, edges)[0] for x in (measured, sampled))
    enough = (m >= FEWEST * frames) & (s >= FEWEST * frames)
    ratio = m[enough] / s[enough] * len(sampled) / len(measured)
    error = ratio * np.sqrt(frames * (1 / m[enough] + 1 / s[enough]))
    middle = (0.5 * (edges[1:] + edges[:-1]))[enough]
    axes.axhline(1, color=FIT, linewidth=0.8)
    axes.errorbar(middle, ratio, np.minimum(error, 0.9 * ratio), fmt=".", color=COLOURS[name], ms=4, elinewidth=0.8)
    axes.set_yscale("log")
    reach = float(np.clip(1.3 * np.exp(np.abs(np.log(ratio)).max(initial=0.0)), 2.0, MOST_RATIO))
    axes.set_ylim(1 / reach, reach)
    ticks = [x for x in (RATIOS if reach < MOST_RATIO / 2 else RATIOS[::3]) if 1 / reach <= x <= reach]
    axes.set_yticks(ticks, [f"{x:g}" for x in ticks])
    axes.yaxis.set_minor_locator(NullLocator())


def wide_axis(axes: Axes, edges: np.ndarray) -> None:
    """Linear over the core, logarithmic beyond."""
    widths = np.diff(edges)
    core = edges[:-1][widths < 1.01 * widths.min()]
    near = max(abs(core[0]), abs(core[-1]), 1e-9)
    if max(abs(edges[0]), abs(edges[-1])) > WIDE * near:
        bend_axis(axes, 0.5 * near, edges[0], edges[-1])
    axes.set_xlim(edges[0], edges[-1])
