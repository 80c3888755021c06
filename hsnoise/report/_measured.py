"""A capture beside draws of the models, as numbers: frames, spectra of rows and columns, histograms, budgets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hsnoise._core.threads import in_threads
from hsnoise.criticism.budget import NoiseBudget, budget
from hsnoise.frames.bayer import channel_pixels, channel_planes
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import check_fits, draw_capture
from hsnoise.simulation.portion import Portion, is_saturated, middle_of

DRAWS = 4
SEED_APART = 9000  # so that the draws shown differ from those of the comparison
MOST_FRAMES = 16  # of the exposure shown
BANDS_PER_OCTAVE = 4
CROP = (240, 320)
CORE, REACH = (2.0, 98.0), 3.0  # percentiles of the core; bins extend this many core widths to either side
MOST_BINS = 90


@dataclass(frozen=True)
class Shown:
    """One dark exposure: frames [frame, row, column], measured and of each draw of the model."""

    exposure_s: float
    cfa: str
    channels: tuple[str, ...]
    measured: np.ndarray
    drawn: list[np.ndarray]


@dataclass(frozen=True)
class Middle:
    """The middle of a few exposures, first the dark one shown, measured and drawn from each model."""

    measured: FrameStack
    drawn: tuple[FrameStack, ...]

    @property
    def frames(self) -> list[np.ndarray]:
        """The first dark frame [row, column], at most `CROP`: measured and of each model."""
        return [crop(stack.frame(0, 0)) for stack in (self.measured, *self.drawn)]

    @property
    def budgets(self) -> list[NoiseBudget]:
        """Noise budgets, measured and of each model; none if no exposure has two frames."""
        if max(self.measured.n_frames) < 2:
            return []
        return in_threads(budget, [self.measured, *self.drawn])


def shown(stack: FrameStack, model: NoiseModel, seed: int, *, shortest: bool = False) -> Shown:
    """The longest (shortest) dark exposure of `stack`, and enough draws of it to show their scatter.

    Raises:
        TypeError, ValueError: model and stack do not match, or there are no darks.
    """
    check_fits(model, stack)
    darks = _darks(stack)
    first = int(np.argmin(darks.exposure_s) if shortest else np.argmax(darks.exposure_s))
    # FrameStack rejects a single frame.
    chosen = [first] if darks.n_frames[first] > 1 else [first, *(i for i in range(darks.n_exposures) if i != first)]
    part = darks.select(exposures=chosen)
    seeds = [seed + SEED_APART + i for i in range(DRAWS)]
    drawn = in_threads(lambda number: _frames(draw_capture(number, model, part)), seeds)
    return Shown(float(part.exposure_s[0]), part.cfa, part.channels, _frames(part), drawn)


def middle(stack: FrameStack, models: Sequence[NoiseModel], seed: int, *, shortest: bool = False) -> Middle:
    """The dark exposure shown, the brightest flat below saturation and, of mono sensors, the other extreme dark."""
    measured = _middle(stack, shortest)
    return Middle(measured, tuple(in_threads(lambda model: draw_capture(seed + SEED_APART, model, measured), models)))


@lru_cache(maxsize=1)  # a story writes a page after each step, and reading files is slow
def _darks(stack: FrameStack) -> FrameStack:
    return Portion.of(stack).darks.frames.select(frames=slice(0, MOST_FRAMES))


@lru_cache(maxsize=2)
def _middle(stack: FrameStack, shortest: bool) -> FrameStack:
    """The part of `stack` that `middle` shows, in memory."""
    darks = [i for i, kind in enumerate(stack.kind) if kind == "dark"]
    repeated = [i for i, kind in enumerate(stack.kind) if kind == "flat" and stack.n_frames[i] > 1]
    flats = [i for i in repeated if not is_saturated(stack, i)]
    by_length = sorted(darks, key=lambda i: float(stack.exposure_s[i]), reverse=not shortest)
    chosen = [by_length[0], *sorted(flats, key=lambda i: -float(stack.frame(i, 0).mean()))[:1]]
    if by_length[-1] not in chosen and (stack.cfa == "mono" or stack.n_frames[chosen[0]] == 1):
        chosen.append(by_length[-1])
    part = middle_of(stack.select(exposures=chosen))
    return part.with_counts([_frames(part, i) for i in range(part.n_exposures)], part.window)


def _frames(stack: FrameStack, exposure: int = 0) -> np.ndarray:
    return np.stack(list(stack.frames(exposure)))


def crop(frame: np.ndarray) -> np.ndarray:
    """The middle of a frame [row, column], at most `CROP`, with the frame's Bayer order."""
    parts = []
    for size, most in zip(frame.shape, CROP, strict=True):
        start = max(0, (size - most) // 4 * 2)
        parts.append(slice(start, start + most))
    return frame[tuple(parts)]


def line_spectrum(frames: np.ndarray, cfa: str, channel: str, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Frequency (cycles per frame) and power (DN^2) of a colour's row or column means, in bands of equal ratio.

    Args:
        frames: [frame, row, column], DN; axis: 0 for rows, 1 for columns.

    Power is the periodogram averaged over frames; its mean over all frequencies is the variance of the means.
    """
    if axis == 1:
        frames = frames.transpose(0, 2, 1)
    offsets = channel_planes(cfa, channel)
    step = 1 if cfa == "mono" else 2
    lines: dict[int, np.ndarray] = {}
    for offset in offsets:
        first, across = offset if axis == 0 else offset[::-1]
        lines[first] = frames[:, first::step, across::step].mean(2)
    series = np.stack([lines[first] for first in sorted(lines)], axis=2).reshape(len(frames), -1)
    n = series.shape[1]
    power = (np.abs(np.fft.rfft(series - series.mean(1, keepdims=True), axis=1)) ** 2).mean(0)[1:] / n
    k = np.arange(1, len(power) + 1)
    _, starts = np.unique(np.round(BANDS_PER_OCTAVE * np.log2(k)), return_index=True)
    size = np.diff(np.append(starts, len(k)))
    return np.add.reduceat(k, starts) / size, np.add.reduceat(power, starts) / size


def histogram_edges(at: Shown, channel: str) -> np.ndarray:
    """Edges of bins of whole counts around the core of measured and drawn counts; the outermost hold the rest."""
    pixels = np.concatenate([_pixels(frames[:1], at.cfa, channel) for frames in (at.measured, *at.drawn)])
    low, high = np.percentile(pixels, CORE)
    reach = REACH * max(high - low, 1.0)
    first, last = np.floor(max(low - reach, pixels.min())), np.ceil(min(high + reach, pixels.max()))
    step = max(1, int(np.ceil((last - first + 1) / MOST_BINS)))
    return np.arange(first - 0.5, last + step, step)


def frame_means(frames: np.ndarray, cfa: str, channel: str) -> np.ndarray:
    """Mean of each frame of a colour minus the mean of all, DN [frame]."""
    means = np.array([channel_pixels(frame, cfa, channel).mean() for frame in frames])
    return means - means.mean()


def share(frames: np.ndarray, cfa: str, channel: str, edges: np.ndarray) -> np.ndarray:
    """Share of a colour's pixels per DN in each bin."""
    pixels = np.clip(_pixels(frames, cfa, channel), edges[0] + 0.25, edges[-1] - 0.25)
    counts, _ = np.histogram(pixels, edges)
    return counts / pixels.size / np.diff(edges)


def _pixels(frames: np.ndarray, cfa: str, channel: str) -> np.ndarray:
    return np.concatenate([channel_pixels(frame, cfa, channel) for frame in frames])
