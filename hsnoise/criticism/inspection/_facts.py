"""What is measured on the frames of a capture: one pass over the files, and a region of all frames kept in memory."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hsnoise.frames.io._overscan import Strip, find, without
from hsnoise.frames.lazy import LazyFrames, is_dask
from hsnoise.frames.mosaics import looks_like_a_mosaic
from hsnoise.frames.stack import FrameStack
from hsnoise.statistics.pixels.along_rows import neighbours_share
from hsnoise.statistics.pixels.memory import Memory, memory_of_region

MOST_COUNTS = 1 << 24  # kept in memory
MOST_SAMPLED = 1 << 18  # pixels of a frame that determine its level and noise
FEWEST_ROWS = 16  # kept of a frame, however many frames there are
READERS = 2  # frames decoded at a time
CORE = (0.01, 0.99)  # quantiles between which a level is the mean
FAR = 5.0  # deviations beyond which a difference is a cosmic ray
HOT = 0.999  # quantile above which pixels are called hot


@dataclass(frozen=True)
class FrameFacts:
    """One frame: its name, level (DN, mean of the core), noise against the other frames of its group (DN), shares
    of pixels at 0, at white and at its highest count (DN), mean of its overscan (DN, NaN: none), a fingerprint, and
    when it was taken (ISO 8601, None: unknown)."""

    name: str
    level_dn: float
    noise_dn: float
    clipped_share: float
    saturated_share: float
    highest_dn: int
    highest_share: float
    overscan_dn: float
    fingerprint: bytes
    taken: str | None


@dataclass(frozen=True)
class GroupFacts:
    """One exposure group and its frames.

    temporal_dn: noise of a pixel over time, DN; NaN for one frame. hot_dn: how far the hottest 0.1 % of the pixels lie
    above the median, DN. mosaic: whether the pixels of 2 x 2 blocks differ. step_dn: all counts are multiples of it,
    apart from an offset. memory: what pixels keep of the frame before; None of too few frames. neighbours_share: of the
    noise that neighbours in a row have in common; NaN for one frame.
    """

    kind: str
    exposure_s: float
    temperature_c: float
    frames: tuple[FrameFacts, ...]
    temporal_dn: float
    hot_dn: float
    mosaic: bool
    step_dn: int
    memory: Memory | None
    neighbours_share: float

    @property
    def name(self) -> str:
        return f"{self.kind}s of {self.exposure_s:g} s"

    @property
    def n_frames(self) -> int:
        return len(self.frames)

    @property
    def in_time(self) -> tuple[FrameFacts, ...]:
        """The frames in the order in which they were taken, as far as that is known."""
        if any(frame.taken is None for frame in self.frames):
            return self.frames
        return tuple(sorted(self.frames, key=lambda frame: str(frame.taken)))

    @property
    def levels_dn(self) -> np.ndarray:
        """Level of each frame [frame] in the order in which they were taken, DN."""
        return np.array([frame.level_dn for frame in self.in_time])

    @property
    def level_dn(self) -> float:
        return float(np.median(self.levels_dn))


@dataclass(frozen=True)
class Facts:
    """Facts of all groups, the frames of a region in memory as a stack, overscan, and frames that cannot be read."""

    groups: tuple[GroupFacts, ...]
    region: FrameStack | None
    strips: tuple[Strip, ...]
    unreadable: tuple[str, ...]


@dataclass(frozen=True)
class _Parts:
    """Parts of a frame: strips of overscan, the rest of the frame, and the region that is kept in memory."""

    strips: tuple[Strip, ...]
    lit: tuple[slice, slice]
    kept: tuple[slice, slice]


def facts_of(stack: FrameStack, tick: Callable[[], Any]) -> Facts:
    """Read each frame of a stack once; `tick` is called after each."""
    parts = _parts_of(stack)
    groups, kept, unreadable = [], {}, []
    for i in range(stack.n_exposures):
        facts, counts, broken = _group(stack, i, parts, tick)
        unreadable += broken
        if facts is not None:
            groups.append(facts)
            kept[i] = counts
    region = None
    if sum(len(counts) for counts in kept.values()) > 1:
        part = stack.select(rows=parts.kept[0], columns=parts.kept[1], exposures=list(kept))
        region = part.with_counts(list(kept.values()), None)
    return Facts(tuple(groups), region, parts.strips, tuple(unreadable))


def _parts_of(stack: FrameStack) -> _Parts:
    """The parts of each frame; all columns except overscan are kept, and as many central rows as fit."""
    try:
        strips = tuple(find(stack))
    except ValueError:  # unusable frames are reported once all are read
        strips = ()
    (first, end), (left, right) = without(stack.shape, strips)
    most = MOST_COUNTS // (sum(stack.n_frames) * (right - left)) // 2 * 2
    rows = min(end - first, max(most, FEWEST_ROWS))
    start = first + (end - first - rows) // 4 * 2
    columns = slice(left, right)
    return _Parts(strips, (slice(first, end), columns), (slice(start, start + rows), columns))


def _group(
    stack: FrameStack, i: int, parts: _Parts, tick: Callable[[], Any]
) -> tuple[GroupFacts | None, np.ndarray, list[str]]:
    """Facts of one group, its region [frame, row, column], and why frames cannot be used."""

    good, broken = [], []
    for number, one in enumerate(_looked_at(stack, i, partial(_seen, parts=parts, white_level=stack.white_level))):
        if isinstance(one, str):
            broken.append(one)
        else:
            good.append((one[0], {**one[1], **_named(stack, i, number)}))
        tick()
    if not good:
        return None, np.zeros((0, 0, 0)), broken
    counts = np.stack([region for region, _ in good])
    return _of_group(stack, i, counts, [facts for _, facts in good]), counts, broken


def _looked_at(stack: FrameStack, i: int, look: Callable[[np.ndarray], Any]) -> Iterator[Any]:
    """`look` at each frame of a group, or why it cannot be read."""

    def alone(number: int) -> Any:
        try:
            return next(stack.map_frames(i, look, chosen=[number]))
        except (ValueError, OSError) as error:
            return str(error)

    if is_dask(stack.counts[i]):
        with suppress(ValueError, OSError):  # which frame it was, the loop below tells
            yield from list(stack.map_frames(i, look))
            return
    with ThreadPoolExecutor(READERS) as pool:
        yield from pool.map(alone, range(stack.n_frames[i]))


def _seen(frame: np.ndarray, parts: _Parts, white_level: float | None) -> tuple[np.ndarray, dict[str, Any]]:
    """The region that is kept, and facts of a whole frame [row, column]; shares are those of all but overscan."""
    lit = frame[parts.lit]
    highest = int(lit.max())
    white = highest + 1 if white_level is None else white_level
    overscan = [strip.pixels(frame).mean() for strip in parts.strips]
    return frame[parts.kept].copy(), {
        "clipped_share": float(np.mean(lit == 0)),
        "saturated_share": float(np.mean(lit >= white)),
        "highest_dn": highest,
        "highest_share": float(np.mean(lit == highest)),
        "overscan_dn": float(np.mean(overscan)) if overscan else float("nan"),
        "fingerprint": hashlib.blake2b(frame).digest(),
    }


def _named(stack: FrameStack, i: int, number: int) -> dict[str, Any]:
    """The name of a frame and when it was taken."""
    counts = stack.counts[i]
    if isinstance(counts, LazyFrames):
        return {"name": Path(counts.names[number]).name, "taken": counts.taken[number]}
    return {"name": f"frame {number}", "taken": None}


def _of_group(stack: FrameStack, i: int, counts: np.ndarray, facts: list[dict[str, Any]]) -> GroupFacts:
    """Facts of the frames of a group, whose region is `counts` [frame, row, column]."""
    flat = counts.reshape(len(counts), -1)
    sample = flat[:, :: max(1, flat.shape[1] // MOST_SAMPLED) | 1].astype(np.float32)  # odd, to include all colours
    levels = _levels(sample)
    noise, temporal = _noise(sample, levels)
    codes, mean = np.unique(sample[0]).astype(np.int64), sample.mean(0)
    frames = [
        FrameFacts(level_dn=float(level), noise_dn=float(own), **of)
        for of, level, own in zip(facts, levels, noise, strict=True)
    ]
    return GroupFacts(
        kind=stack.kind[i],
        exposure_s=float(stack.exposure_s[i]),
        temperature_c=float("nan") if stack.temperature_c is None else float(stack.temperature_c[i]),
        frames=tuple(frames),
        temporal_dn=temporal,
        hot_dn=float(np.quantile(mean, HOT) - np.median(mean)),
        mosaic=stack.cfa == "mono" and looks_like_a_mosaic(counts[0]),
        step_dn=int(np.gcd.reduce(np.diff(codes))) if len(codes) > 2 else 1,
        memory=memory_of_region(counts),
        neighbours_share=neighbours_share(counts),
    )


def _levels(sample: np.ndarray) -> np.ndarray:
    """Level of each frame of [frame, pixel]: mean of the core, which hot pixels do not move."""
    low, high = np.quantile(sample, CORE, axis=1, keepdims=True)
    return np.clip(sample, low, high).mean(1, dtype=np.float64)


def _noise(sample: np.ndarray, levels_dn: np.ndarray) -> tuple[np.ndarray, float]:
    """Noise of each frame [frame] and of a pixel over time, DN; NaN for one frame.

    A frame is compared with the mean of the others, whose noise is subtracted; cosmic rays are clipped.
    """
    n = len(sample)
    if n < 2:
        return np.full(n, np.nan), float("nan")
    total = sample.sum(0, dtype=np.float64)
    squares = np.empty(n)
    for j, frame in enumerate(sample):
        rest = frame - (total - frame) / (n - 1)
        rest -= np.median(rest)
        limit = FAR * (np.quantile(np.abs(rest), 0.68) + 0.5)
        squares[j] = np.var(np.clip(rest, -limit, limit))
    usual = np.median(squares) * (n - 1) / n
    return np.sqrt(np.maximum(squares - usual / (n - 1), 0.0)), float(np.sqrt(usual))
