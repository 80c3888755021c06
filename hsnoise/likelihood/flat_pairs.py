"""Pairs among single flats in different light, such as a sky at twilight."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from hsnoise.frames.bayer import channel_rows
from hsnoise.frames.stack import FrameStack

SIMILAR = 1.7  # ratio of light up to which two levels are a pair
SAMPLE_ROWS = 64  # from which the partner is chosen
WORSE_SIGMAS = 5.0  # by which the difference of a pair must exceed that of a better one to be no pair


class Shot(NamedTuple):
    """One frame of a stack: its exposure group and its number there."""

    group: int
    number: int


class _Pair(NamedTuple):
    """Two singles, the ratio of their light, and the variance of their difference over signal, with its error."""

    one: int
    other: int
    ratio: float
    noise: float
    error: float


def pairs_of_singles(
    stack: FrameStack, singles: list[Shot], black: dict[int, np.ndarray]
) -> tuple[list[list[Shot]], list[Shot]]:
    """Pairs of single flats of similar light whose fixed patterns agree, each in one pair at most; and who is left.

    Flats through another filter have another pattern, which shows as a variance far above that of other pairs.
    """
    if not singles:
        return [], []
    samples = [_sample(stack, shot, black[shot.group]) for shot in singles]
    pairs = [pair for i, j in combinations(range(len(singles)), 2) if (pair := _pair(samples, i, j)) is not None]
    best = {i: min((p for p in pairs if i in p[:2]), key=lambda p: p.noise, default=None) for i in range(len(singles))}
    chosen, free = [], set(range(len(singles)))
    for pair in sorted(pairs, key=lambda p: p.ratio):
        agree = all(pair.noise <= best[i].noise + WORSE_SIGMAS * np.hypot(pair.error, best[i].error) for i in pair[:2])
        if agree and {pair.one, pair.other} <= free:
            chosen.append([singles[pair.one], singles[pair.other]])
            free -= {pair.one, pair.other}
    return chosen, [singles[i] for i in sorted(free)]


def _sample(stack: FrameStack, shot: Shot, black: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean above black of the frame's first channel, DN, and counts relative to it in its middle rows."""
    frame = stack.frame(*shot)
    light = float(channel_rows(frame, stack.cfa, stack.channels[0]).mean(dtype=np.float64) - black[0])
    start = max(len(frame) - SAMPLE_ROWS, 0) // 4 * 2
    rows = channel_rows(frame[start : start + SAMPLE_ROWS], stack.cfa, stack.channels[0])
    return light, (rows - np.float32(black[0])) / np.float32(max(light, 1e-6))


def _pair(samples: list[tuple[float, np.ndarray]], i: int, j: int) -> _Pair | None:
    (light, one), (other_light, other) = samples[i], samples[j]
    low, high = sorted((light, other_light))
    if low <= 0 or high > SIMILAR * low:
        return None
    left = one - other
    left = left - left.mean(1, keepdims=True)
    left -= left.mean(0)
    limit = 25 * np.median(left**2)  # cosmic rays
    kept = left[left**2 <= max(limit, 1e-12)]
    noise = float((kept**2).mean() / (1 / light + 1 / other_light))
    return _Pair(i, j, high / low, noise, noise * np.sqrt(2 / kept.size))
