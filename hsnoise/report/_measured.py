"""A capture beside draws of the model, as numbers: frames, spectra of lines, histograms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hsnoise._frames import channel_pixels, channel_planes
from hsnoise._threads import in_threads
from hsnoise.draws import check_fits, darks_of, draw_capture
from hsnoise.model import NoiseModel
from hsnoise.stack import FrameStack

DRAWS = 4
SEED_APART = 9000  # the draws shown are none of those that the comparison was made with
MOST_FRAMES = 16  # of the exposure shown
BANDS_PER_OCTAVE = 4
CROP = (480, 640)
CORE, REACH = (2.0, 98.0), 3.0  # bins reach so many widths of the core to either side of it
MOST_BINS = 90


@dataclass(frozen=True)
class Shown:
    """One dark exposure: frames [frame, row, column] measured, and of each draw of the model."""

    exposure_s: float
    cfa: str
    channels: tuple[str, ...]
    measured: np.ndarray
    drawn: list[np.ndarray]


def shown(stack: FrameStack, model: NoiseModel, seed: int, *, shortest: bool = False) -> Shown:
    """The longest (shortest) dark exposure of `stack`, and as many draws of it as scatter needs.

    Raises:
        TypeError, ValueError: model and stack do not fit together, no darks.
    """
    check_fits(model, stack)
    darks = darks_of(stack).select(frames=slice(0, MOST_FRAMES))
    one_exposure = int(np.argmin(darks.exposure_s) if shortest else np.argmax(darks.exposure_s))
    seeds = [seed + SEED_APART + i for i in range(DRAWS)]
    # All exposures are drawn, because a stack of a single frame would be refused.
    drawn = in_threads(lambda one: _frames(draw_capture(one, model, darks), one_exposure), seeds)
    exposure_s = float(darks.exposure_s[one_exposure])
    return Shown(exposure_s, darks.cfa, darks.channels, _frames(darks, one_exposure), drawn)


def _frames(stack: FrameStack, exposure: int) -> np.ndarray:
    return np.stack(list(stack.frames(exposure)))


def crop(frame: np.ndarray) -> np.ndarray:
    """The middle of a frame [row, column], at most `CROP`, where its first pixel has the colour of the frame's."""
    parts = []
    for size, most in zip(frame.shape, CROP, strict=True):
        start = max(0, (size - most) // 4 * 2)
        parts.append(slice(start, start + most))
    return frame[tuple(parts)]


def line_spectrum(frames: np.ndarray, cfa: str, channel: str, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Frequency (cycles per frame) and power (DN^2) of the mean lines of a colour, in bands of equal ratio.

    Args:
        frames: [frame, row, column], DN; axis: 0 for rows, 1 for columns.

    Power is that of the periodogram, averaged over the frames; its mean over all frequencies is the variance of lines.
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
    """Edges of bins of whole counts around the core of what was measured and drawn; the outermost hold the rest."""
    pixels = np.concatenate([_pixels(frames[:1], at.cfa, channel) for frames in (at.measured, *at.drawn)])
    low, high = np.percentile(pixels, CORE)
    reach = REACH * max(high - low, 1.0)
    first, last = np.floor(max(low - reach, pixels.min())), np.ceil(min(high + reach, pixels.max()))
    step = max(1, int(np.ceil((last - first + 1) / MOST_BINS)))
    return np.arange(first - 0.5, last + step, step)


def frame_means(frames: np.ndarray, cfa: str, channel: str) -> np.ndarray:
    """Mean of each frame of a colour less the mean of all, DN [frame]."""
    means = np.array([channel_pixels(frame, cfa, channel).mean() for frame in frames])
    return means - means.mean()


def share(frames: np.ndarray, cfa: str, channel: str, edges: np.ndarray) -> np.ndarray:
    """Share of the pixels of a colour per DN in each bin."""
    pixels = np.clip(_pixels(frames, cfa, channel), edges[0] + 0.25, edges[-1] - 0.25)
    counts, _ = np.histogram(pixels, edges)
    return counts / pixels.size / np.diff(edges)


def _pixels(frames: np.ndarray, cfa: str, channel: str) -> np.ndarray:
    return np.concatenate([channel_pixels(frame, cfa, channel) for frame in frames])
