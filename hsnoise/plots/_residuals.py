"""Where on the sensor, and in which frames, a model differs from what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hsnoise._core.threads import in_threads
from hsnoise._core.types import cfa_tile, seconds
from hsnoise.fitting.result import FitResult, number
from hsnoise.frames.source import as_stack
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.plots._style import COLOURS, new_figure, tidy
from hsnoise.simulation.draws import check_effects, check_fits, draw_capture
from hsnoise.simulation.portion import Portion

DRAWS, MOST_FRAMES = 6, 24
BLOCKS = 48  # along the longer side of a map
CHANCE = 3.0  # standard deviations of blocks by chance, at least, at the ends of the colours
HIGHEST = 0.98  # quantile of the blocks there
LEAST_DN2 = 1e-6  # of the variance of a block that hardly varies
MEASURED, MODEL = "black", COLOURS["B"]
MAP_IN, HEIGHTS_IN, SERIES_IN = 5.0, (2.0, 6.5), 2.6  # width of a map and limits of its height; height of a series


@dataclass(frozen=True)
class Apart:
    """What stays and what changes in the frames of one exposure, in blocks of pixels and frame by frame.

    mean, variance [block row, block column]: medians over the pixels of a block, so that a hot pixel does not hide the
    rest, of the mean over frames, DN, less the median of all pixels of its colour, and of the variance over frames,
    DN^2; levels, noise [frame]: mean of each frame less that of all, and rms of its pixels about their own mean, DN.
    """

    mean: np.ndarray
    variance: np.ndarray
    levels: np.ndarray
    noise: np.ndarray

    @staticmethod
    def of(frames: np.ndarray, side: int, cfa: str) -> Apart:
        """frames: [frame, row, column], DN; side: of the blocks, pixels."""
        frames = frames.astype(np.float64)
        mean, n, step = frames.mean(0), len(frames), len(cfa_tile(cfa))
        away = frames - mean
        levels = away.mean((1, 2))
        noise = np.sqrt((away**2).mean((1, 2)) * n / (n - 1))
        for r, c in np.ndindex(step, step):
            mean[r::step, c::step] -= np.median(mean[r::step, c::step])
        return Apart(_blocks(mean, side), _blocks((away**2).sum(0) / (n - 1), side), levels, noise)


def residuals(params: NoiseModel | FitResult, stack, *, seed: int = 0, **keywords) -> Figure:
    """Where and when the frames differ from a model, in the dark exposure where that stands out most.

    Maps of the mean and of the noise over frames, in blocks, less those of the model's own draws; level and noise of
    each frame beside draws. What the maps show by chance is said below them.

    Args:
        params: a NoiseModel, or a fit, whose `params` it stands for.
        stack: as `hsnoise.compare` takes it, with two frames or more of a dark exposure.
        seed: of the draws.

    Raises:
        FileNotFoundError, TypeError, ValueError: as `compare` raises; also no dark exposure of two frames.
    """
    model = params.params if isinstance(params, FitResult) else params
    stack = as_stack(stack, **keywords)
    check_fits(model, stack)
    if not stack.repeated_darks:
        raise ValueError("stack: residuals need a dark exposure of two frames or more")
    ends = {end(stack.repeated_darks, key=lambda i: stack.exposure_s[i]) for end in (min, max)}
    part = Portion.of(stack.select(exposures=sorted(ends), frames=slice(0, MOST_FRAMES))).frames
    check_effects(model, part)
    side = max(4, 2 * round(max(part.shape) / BLOCKS / 2))
    captures = [part, *in_threads(lambda i: draw_capture(seed + i, model, part), range(DRAWS))]
    found = [
        [Apart.of(np.stack(list(one.frames(e))), side, part.cfa) for one in captures] for e in range(part.n_exposures)
    ]
    chosen = int(np.argmax([_stands_out(of) for of in found]))
    return _drawn(found[chosen], part, chosen, side)


def _blocks(pixels: np.ndarray, side: int) -> np.ndarray:
    """Medians of blocks of side x side pixels [row, column]; those at the ends may be smaller."""
    short = [(0, -size % side) for size in pixels.shape]
    whole = np.pad(pixels, short, constant_values=np.nan)
    rows, columns = (size // side for size in whole.shape)
    return np.nanmedian(whole.reshape(rows, side, columns, side), axis=(1, 3))


def _maps(of: list[Apart]) -> list[tuple[np.ndarray, float]]:
    """Mean, DN, and noise, per cent, of the first of these less those of the others, and what both are by chance."""
    means, variances = (np.stack([getattr(one, name) for one in of]) for name in ("mean", "variance"))

    def less_others(values: np.ndarray, others: np.ndarray) -> np.ndarray:
        return values - others

    def relative(values: np.ndarray, others: np.ndarray) -> np.ndarray:
        return 50.0 * (values / np.maximum(others, LEAST_DN2) - 1)  # of the noise: half that of its variance

    found = []
    for values, apart in ((means, less_others), (variances, relative)):
        drawn = values[1:]
        others = (drawn.sum(0) - drawn) / (len(drawn) - 1)
        found.append((apart(values[0], drawn.mean(0)), float(apart(drawn, others).std())))
    return found


def _stands_out(of: list[Apart]) -> float:
    """How far the frames differ from the model, in what that is by chance."""
    maps = [float(np.sqrt(np.mean(shown**2)) / max(chance, 1e-12)) for shown, chance in _maps(of)]
    series = []
    for name in ("levels", "noise"):
        values = np.stack([getattr(one, name) for one in of])
        off = np.abs(values[0] - values[1:].mean(0)).max()
        series.append(float(off / max(np.abs(values[1:] - values[1:].mean(0)).max(), 1e-12)))
    return max(*maps, *series)


def _drawn(of: list[Apart], part: FrameStack, exposure: int, side: int) -> Figure:
    rows, columns = part.shape
    height = float(np.clip(MAP_IN * rows / columns, *HEIGHTS_IN))
    title = f"Where and when the frames differ from the model: darks of {seconds(float(part.exposure_s[exposure]))}"
    figure = new_figure(11.0, height + 1.5 + SERIES_IN, title)
    panels = figure.subplots(2, 2, height_ratios=[height + 1.0, SERIES_IN])
    names = (("mean", "DN"), ("noise", "%"))
    for axes, (shown, chance), (name, unit) in zip(panels[0], _maps(of), names, strict=True):
        axes.set_title(f"{name} over frames, medians of blocks of {side} x {side} pixels", fontsize=10)
        _map(figure, axes, shown, chance, unit, part, side)
    for axes, name, label in zip(panels[1], ("levels", "noise"), ("frame mean - mean of all", "noise"), strict=True):
        _series(axes, [getattr(one, name) for one in of], f"{label} / DN")
    panels[1, 0].legend(fontsize=9, loc="best", frameon=False)
    return figure


def _map(figure: Figure, axes: Axes, shown: np.ndarray, chance: float, unit: str, part: FrameStack, side: int) -> None:
    """Differences in blocks, where these lie on the sensor."""
    row, column = (0, 0) if part.window is None else part.window[:2]
    rows, columns = (side * size for size in shown.shape)
    extent = (column - 0.5, column + columns - 0.5, row + rows - 0.5, row - 0.5)
    most = max(float(np.quantile(np.abs(shown), HIGHEST)), CHANCE * chance, 1e-9)
    style = {"cmap": "RdBu_r", "aspect": "auto", "interpolation": "nearest"}
    image = axes.imshow(shown, vmin=-most, vmax=most, extent=extent, **style)
    extend = "both" if np.abs(shown).max() > most else "neither"
    bar = figure.colorbar(image, ax=axes, location="bottom", extend=extend, shrink=0.8, aspect=40, format="%.3g")
    bar.set_label(f"measured - model / {unit} (rms {number(_rms(shown))}; by chance {number(chance)})", fontsize=9)
    bar.ax.tick_params(labelsize=9)
    axes.set_xlim(column - 0.5, column + part.shape[1] - 0.5)  # the last blocks may be smaller
    axes.set_ylim(row + part.shape[0] - 0.5, row - 0.5)
    axes.set_xlabel("column")
    axes.set_ylabel("row")
    axes.tick_params(labelsize=9)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _series(axes: Axes, series: list[np.ndarray], label: str) -> None:
    """What was measured of each frame (points) beside draws of the model (lines)."""
    for i, drawn in enumerate(series[1:]):
        axes.plot(drawn, color=MODEL, linewidth=0.9, alpha=0.6, label="draws of the model" if i == 0 else None)
    axes.plot(series[0], "o", color=MEASURED, markersize=4.5, label="measured")
    axes.set_xlabel("frame")
    axes.set_ylabel(label)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    tidy(axes)
