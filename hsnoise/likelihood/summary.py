"""Summaries of a stack in one pass over its pixels: row histograms of darks, photon transfer of flats.

Both are additive and their size does not depend on the width of the sensor. Given the row gain, the pixels of one row
and colour are independent draws from one distribution, so their histogram is sufficient (darks; flats: see flats.py).
If a series' histograms would exceed MOST_MIB, only as many frames as fit are used. If few tall frames have a wide range
of counts, rows are left out as well, where their number has a divisor.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import numpy as np

from hsnoise._core.arguments import callback
from hsnoise._core.types import cfa_tile, channels_of
from hsnoise.frames.bayer import channel_planes, channel_rows
from hsnoise.frames.source import as_stack
from hsnoise.frames.stack import FrameStack
from hsnoise.likelihood.counting import Bins, count_rows
from hsnoise.likelihood.flats import FlatMoments, flat_moments

BINS_PER_SIGMA = 6  # coarser codes lose less than 0.3 % of the information
RANGE_SIGMAS = 10.0
MOST_BINS = 4096  # rows may differ by far more than the pixels within one do (glow, strong row gains)
MOST_MIB = 112  # of row histograms; with the programs of a fit and what it makes of them, 1 GiB
FEWEST_FRAMES, FEWEST_ROWS = 2, 16  # of an exposure, of a colour: before memory is saved on the others
SMALL_SHARE = 0.25  # of MOST_MIB: up to here sharing a program is worth more than bins
OUTLIER_SCALE, NEAR_WIDTHS = 2.0, 6.0
SAMPLE_PIXELS = 60_000  # quantiles to half a percent of the noise


class RowHistograms(eqx.Module):
    """Histograms of one colour's rows in all dark exposures.

    counts [exposure, frame, row, bin], padded with empty frames; bin j holds the counts between
    edges_dn[exposure, j - 1] and edges_dn[exposure, j], the first and last bin all that lies outside.
    row_sum, row_sum_of_squares [exposure, frame, row] in DN, DN^2 are exact, not binned. outlier_law [exposure, bin]
    is how hot pixels and cosmic hits would spread over the bins: see `_outlier_law`.
    """

    counts: np.ndarray
    edges_dn: np.ndarray
    row_sum: np.ndarray
    row_sum_of_squares: np.ndarray
    outlier_law: np.ndarray
    channel: str = eqx.field(static=True)
    row_stride: int = eqx.field(static=True)

    @property
    def row_pixels(self) -> np.ndarray:
        """Pixels in each row [exposure, frame, row]; 0 in frames that are padding."""
        return self.counts.sum(-1, dtype=np.float64)


class Summary(eqx.Module):
    """All that the likelihood and the line fit need of a capture. Made by `summarise`.

    n_frames: frames of each dark exposure that are in the histograms; left_out: those that are not.
    """

    exposure_s: np.ndarray
    histograms: tuple[RowHistograms, ...]
    flats: FlatMoments | None
    black_level_dn: np.ndarray | None
    white_level_dn: float | None = eqx.field(static=True)
    cfa: str = eqx.field(static=True)
    shutter: str = eqx.field(static=True)
    shape: tuple[int, int] = eqx.field(static=True)
    n_frames: tuple[int, ...] = eqx.field(static=True)
    left_out: tuple[int, ...] = eqx.field(static=True)

    @property
    def channels(self) -> tuple[str, ...]:
        return channels_of(self.cfa)


def round_up(size: int, steps: int = 2) -> int:
    """The next of few sizes, `steps` per doubling (16, 24, 32, 48 ...), so that similar captures share programs."""
    power = 1 << max(size - 1, 31).bit_length() - 1
    return next(n for n in range(power, 2 * power + 1, power // steps) if n >= size)


def row_stride(cfa: str, channel: str) -> int:
    return 1 if cfa == "mono" or len(channel_planes(cfa, channel)) == 2 else 2


def row_pixels(shape: tuple[int, int], cfa: str) -> int:
    """Pixels in a row of one colour of frames (rows, columns)."""
    return shape[1] if cfa == "mono" else shape[1] // 2


def _count_type(pixels: int):
    return np.uint16 if pixels < 65536 else np.uint32


def some_frames(summary: Summary, start: int, stop: int) -> Summary:
    """The summary of frames start to stop of each dark exposure (and of all flats); empty frames fill it up."""

    def cut(h: RowHistograms) -> RowHistograms:
        def part(x):
            chosen = x[:, start:stop]
            missing = stop - start - chosen.shape[1]
            return np.pad(chosen, [(0, 0), (0, missing)] + [(0, 0)] * (x.ndim - 2)) if missing else chosen

        return replace(h, **{name: part(getattr(h, name)) for name in ("counts", "row_sum", "row_sum_of_squares")})

    n_frames = tuple(int(np.clip(n - start, 0, stop - start)) for n in summary.n_frames)
    return replace(summary, histograms=tuple(map(cut, summary.histograms)), n_frames=n_frames)


def every_nth_row(summary: Summary, n: int) -> Summary:
    """The summary of every n-th row of each colour: a coloured row gain keeps its distribution, its spectrum folded."""

    def thin(h: RowHistograms) -> RowHistograms:
        parts = {name: getattr(h, name)[:, :, ::n] for name in ("counts", "row_sum", "row_sum_of_squares")}
        return replace(h, **parts, row_stride=h.row_stride * n)

    return replace(summary, histograms=tuple(map(thin, summary.histograms)))


def without_counts(summary: Summary) -> Summary:
    """What the likelihood needs beside the sorted rows of its rules."""
    empty = {"counts": None, "row_sum": None, "row_sum_of_squares": None}
    return replace(summary, histograms=tuple(replace(h, **empty) for h in summary.histograms))


Coding = list[dict[str, tuple[int, int, int]]]


def coding_of(stack: FrameStack) -> Coding:
    """The bins that `summarise` chooses for the darks of a stack: for each exposure, `_coding` of each channel."""
    return [_codings(stack, i) for i, kind in enumerate(stack.kind) if kind == "dark"]


def summarise(stack, progress=None, coding: Coding | None = None, **keywords) -> Summary:
    """One pass over the pixels of `stack`: its row histograms (darks) and photon transfer (flats).

    stack: a path or a list of paths, with the keywords of `hsnoise.load`; a FrameStack; or an array of counts with
        FrameStack's keywords.
    progress: called with no argument after each frame. coding: bins of another stack, to compare with it.
    Raises what `load` and `FrameStack` refuse, and ValueError for frames that cannot be measured (NaN, constant, all
    zero, saturated) and where nothing is left to fit.
    """
    tick = callback("progress", progress)
    stack = as_stack(stack, **keywords)
    darks = [i for i, kind in enumerate(stack.kind) if kind == "dark"]
    coding = coding_of(stack) if coding is None else coding
    plan = _Plan.of(stack, darks, coding)
    return Summary(
        exposure_s=np.asarray([stack.exposure_s[i] for i in darks], np.float64),
        histograms=_row_histograms(stack, darks, tick, coding, plan) if darks else (),
        flats=flat_moments(stack, tick),
        black_level_dn=_black_per_channel(stack),
        white_level_dn=stack.white_level,
        cfa=stack.cfa,
        shutter=stack.shutter,
        shape=stack.shape,
        n_frames=tuple(len(frames) for frames in plan.frames),
        left_out=tuple(stack.n_frames[i] - len(frames) for i, frames in zip(darks, plan.frames, strict=True)),
    )


def _black_per_channel(stack: FrameStack) -> np.ndarray | None:
    if stack.black_level is None:
        return None
    return np.broadcast_to(np.asarray(stack.black_level, np.float64), (len(stack.channels),)).copy()


class _Plan(NamedTuple):
    """Which darks go into the histograms: frames of each exposure, every n-th row; and in how many bins."""

    frames: list[np.ndarray]
    row_step: int
    bins: int

    @staticmethod
    def of(stack: FrameStack, darks: list[int], coding: Coding) -> _Plan:
        """All, if the histograms take no more than MOST_MIB; else fewer frames, spread evenly, and in the end rows."""
        given = [stack.n_frames[i] for i in darks]
        rows = sum(stack.shape[0] // row_stride(stack.cfa, c) for c in stack.channels)
        item = np.dtype(_count_type(row_pixels(stack.shape, stack.cfa))).itemsize
        a_bin = max(len(darks), 1) * rows * item / 2**20  # MiB, of a frame of each exposure
        # One number of bins for all channels and exposures: they share compiled programs. Small captures share more.
        needed = 2 + max((n for of in coding for _, _, n in of.values()), default=0)
        small = a_bin * needed * max(given, default=0) < SMALL_SHARE * MOST_MIB
        bins = round_up(needed, steps=2 if small else 8)
        affordable = MOST_MIB / (a_bin * bins)  # frames of each exposure
        most = min(max(int(affordable), FEWEST_FRAMES), max(given, default=0))
        # Rows that are left must be evenly spaced around the frame, for the spectrum of their gains.
        of_colour = stack.shape[0] // max(row_stride(stack.cfa, c) for c in stack.channels)
        steps = [n for n in range(1, max(of_colour // FEWEST_ROWS, 1) + 1) if of_colour % n == 0]
        step = next((n for n in steps if most <= n * affordable), steps[-1])
        frames = [np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int)) for n in given]
        return _Plan(frames, step, bins)


def _row_histograms(
    stack: FrameStack, darks: list[int], tick, coding: Coding, plan: _Plan
) -> tuple[RowHistograms, ...]:
    channels, frames, bins = stack.channels, max(map(len, plan.frames)), plan.bins
    stride = {c: row_stride(stack.cfa, c) for c in channels}
    rows = {c: stack.shape[0] // stride[c] // plan.row_step for c in channels}
    dtype = _count_type(row_pixels(stack.shape, stack.cfa))
    counts = {c: np.zeros((len(darks), frames, rows[c], bins), dtype) for c in channels}
    moments = {c: np.zeros((2, len(darks), frames, rows[c])) for c in channels}
    for e, (i, chosen) in enumerate(zip(darks, plan.frames, strict=True)):
        reduced = partial(_reduced, cfa=stack.cfa, coding=coding[e], bins=bins, white_level=stack.white_level)
        for f, frame in enumerate(stack.map_frames(i, reduced, chosen=chosen)):
            for c in channels:
                of_rows, sums = frame[c]
                counts[c][e, f], moments[c][:, e, f] = of_rows[:: plan.row_step], sums[:, :: plan.row_step]
            tick()
        for _ in range(stack.n_frames[i] - len(chosen)):
            tick()
    edges = {c: np.stack([_edges(*of[c][:2], bins, stack.white_level) for of in coding]) for c in channels}
    return tuple(
        RowHistograms(
            counts=counts[c],
            edges_dn=edges[c],
            row_sum=moments[c][0],
            row_sum_of_squares=moments[c][1],
            outlier_law=_outlier_law(counts[c], edges[c]),
            channel=c,
            row_stride=stride[c] * plan.row_step,
        )
        for c in channels
    )


def _reduced(
    frame: np.ndarray, cfa: str, coding: dict[str, tuple[int, int, int]], bins: int, white_level: float | None
):
    """Of each channel of a frame: histograms [row, bin], and sums of counts and of their squares [2, row]."""
    counts, sums = count_rows(frame, _bins(coding, cfa, bins, white_level), bins)
    dtype, out = _count_type(row_pixels(frame.shape, cfa)), {}
    for c in coding:
        if cfa == "mono":
            out[c] = counts[:, 0].astype(dtype), sums[..., 0]
            continue
        planes, stride = channel_planes(cfa, c), row_stride(cfa, c)
        rows = len(frame) // stride
        out[c] = np.empty((rows, bins), dtype), np.empty((2, rows))
        for row, column in planes:
            at = slice(row if stride == 1 else 0, None, len(planes))
            out[c][0][at], out[c][1][:, at] = counts[row::2, column], sums[:, row::2, column]
    return out


def _bins(coding: dict[str, tuple[int, int, int]], cfa: str, number: int, white_level: float | None) -> Bins:
    """The bins of each place in the colour pattern. Codes at the white level are clipped: all are in the last bin."""
    tile = cfa_tile(cfa)
    low, width, _ = np.array([coding[c] for c in channels_of(cfa)]).T
    end = low + width * (number - 2)
    end = end if white_level is None else np.minimum(end, int(np.ceil(white_level)))
    return Bins(low[tile], width[tile], end[tile])


def _outlier_law(counts: np.ndarray, edges_dn: np.ndarray) -> np.ndarray:
    """Distribution of pixels with extra charge: above the median, half exponential near the others, half anywhere.

    Thermal generation in silicon leaves an exponential tail of warm pixels; its scale here is OUTLIER_SCALE times the
    half width of the counts below their median, which outliers do not reach. Outliers beyond all bins, of which the
    last one tells how many, have their own share, so that they do not stand for others nearby.
    """
    laws = []
    for pooled, edges in zip(counts.sum((1, 2), dtype=np.float64), edges_dn, strict=True):
        cumulative = np.cumsum(pooled)[:-1] / pooled.sum()
        median, low = (edges[min(np.searchsorted(cumulative, q), len(edges) - 1)] for q in (0.5, 0.1587))
        half_width = max(median - low, 1.0)
        survival = np.exp(-np.maximum(edges - median, 0.0) / (OUTLIER_SCALE * half_width))
        tail = -np.diff(np.concatenate([[1.0], survival, [0.0]]))
        anywhere = np.concatenate([[False], edges >= median]).astype(np.float64)
        near = pooled[:-1][edges > median + NEAR_WIDTHS * half_width].sum()
        far = pooled[-1] / max(pooled[-1] + near, 1.0) if pooled[-1] > near else 0.0
        laws.append((1 - far) * 0.5 * (tail + anywhere / anywhere.sum()))
        laws[-1][-1] += far
    return np.stack(laws)


def far_outliers(summary: Summary) -> np.ndarray:
    """Share of the pixels of each dark exposure in the last, open bin, where the bins before it are emptier."""
    far, total = np.zeros(len(summary.exposure_s)), np.zeros(len(summary.exposure_s))
    for h in summary.histograms:
        pooled = h.counts.sum((1, 2), dtype=np.float64)
        before = pooled[:, 3 * pooled.shape[1] // 4 : -1].sum(1)
        far += np.where(pooled[:, -1] > before, pooled[:, -1], 0.0)
        total += pooled.sum(1)
    return far / np.maximum(total, 1.0)


def _codings(stack: FrameStack, group: int) -> dict[str, tuple[int, int, int]]:
    """`_coding` of each channel of an exposure, from its first and last frame."""
    numbers = sorted({0, stack.n_frames[group] - 1})
    some = partial(_some_rows, step=len(cfa_tile(stack.cfa)), frames=len(numbers))
    thin = list(stack.map_frames(group, some, chosen=numbers))
    samples = (np.stack([channel_rows(rows, stack.cfa, c) for rows in thin]) for c in stack.channels)
    return {c: _coding(sample, stack.white_level) for c, sample in zip(stack.channels, samples, strict=True)}


def _some_rows(frame: np.ndarray, step: int, frames: int) -> np.ndarray:
    """Every n-th row (or pair of rows) of a frame, about SAMPLE_PIXELS of each place in the pattern in `frames`."""
    cells = frame.reshape(-1, step * frame.shape[1])
    return cells[:: max(1, frames * frame.size // (step**2 * SAMPLE_PIXELS))].reshape(-1, frame.shape[1])


def _coding(sample: np.ndarray, white_level: float | None) -> tuple[int, int, int]:
    """(first code, codes per bin, bins) for the distribution of a sample [frame, row, pixel] of one channel.

    The range is robust (quantiles), so that hot pixels do not stretch it: what lies outside is one open bin.
    """
    q05, q50, q95 = _quantiles(sample, np.array([0.05, 0.5, 0.95]))
    reach = RANGE_SIGMAS / 1.645
    # A row may hold outliers, too.
    core = np.clip(sample, q50 - 0.5 * reach * max(q50 - q05, 1.0), q50 + 0.5 * reach * max(q95 - q50, 1.0))
    sigma = max(float(np.sqrt(np.median(core.var(-1)))), 0.5)
    low = int(max(q50 - reach * max(q50 - q05, sigma), 1))  # code 0 is always in the first, open bin
    high = int(q50 + reach * max(q95 - q50, sigma)) + 2
    if white_level is not None:
        high = min(high, int(white_level))
        low = min(low, high - 1)
    width = max(1, int(sigma / BINS_PER_SIGMA), -(-(high - low) // (MOST_BINS - 2)))
    return low, width, max(1, -(-(high - low) // width))


def _quantiles(sample: np.ndarray, at: np.ndarray) -> np.ndarray:
    """As `np.quantile`, several times as fast for 16-bit counts, which a stable sort sorts by radix."""
    ordered = np.sort(sample, axis=None, kind="stable" if sample.dtype.itemsize <= 2 else None)
    place = at * (ordered.size - 1)
    below = place.astype(np.intp)  # the last place is never asked for
    ends = ordered[np.stack([below, below + 1])].astype(np.float64)
    return ends[0] + (ends[1] - ends[0]) * (place - below)


def _edges(low: int, width: int, bins: int, white_level: float | None) -> np.ndarray:
    edges = low - 0.5 + width * np.arange(bins - 1, dtype=np.float64)
    # Counts at the white level are clipped: they may hold everything above, so no edge lies beyond.
    return edges if white_level is None else np.minimum(edges, np.ceil(white_level) - 0.5)
