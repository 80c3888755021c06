"""Place and sign of patterns in the frame, and of a drift over frames; most other statistics have no sign."""

from __future__ import annotations

from itertools import product

import numpy as np

from hsnoise._core.types import cfa_tile
from hsnoise.effects import Places
from hsnoise.frames.stack import FrameStack

LENGTHS = (0.03, 0.1, 0.3, 1.0, 3.0)  # decay lengths of a black level, in widths or heights of the frame
SCALES, ASPECTS = (0.1, 0.2, 0.4), (0.7, 1.0, 1.5)  # of a glow
ENDS = (0.0, 0.5, 1.0)
SPOTS = [(row, column) for row in ENDS for column in ENDS if (row, column) != (0.5, 0.5)]
BLOCKS = 16  # of a map, in each direction
FEWEST_FRAMES = 2


def places(stack: FrameStack) -> Places:
    """The places of patterns in the dark frames of a stack."""
    step, width = len(cfa_tile(stack.cfa)), 1 if stack.cfa == "mono" else 2
    lines: dict[str, list[np.ndarray]] = {"row": [], "column": []}
    contrast, fall, maps = 0.0, 0.0, []
    darks = sorted((i for i, kind in enumerate(stack.kind) if kind == "dark"), key=lambda i: stack.exposure_s[i])
    for i in darks:
        total, level = np.zeros(stack.shape), []
        for frame in stack.frames(i):
            total += frame
            level.append(frame.mean(dtype=np.float64))
            for axis, along in (("row", 1), ("column", 0)):
                lines[axis].append(_colours_together(frame.mean(along, dtype=np.float64), step))
        maps.append(total / stack.n_frames[i])
        half = len(level) // 2
        fall += np.sum(level[:half]) - np.sum(level[len(level) - half :])
        column = maps[-1].mean(0)
        chain = np.arange(len(column)) // width % 2
        contrast += column[chain == 1].mean() - column[chain == 0].mean()
    longest = maps[-1] - maps[0] if stack.exposure_s[darks[-1]] > stack.exposure_s[darks[0]] else maps[-1]
    return Places(
        _shading({axis: np.stack(some) for axis, some in lines.items()}),
        _glow(longest),
        1 if contrast > 0 else -1,
        1 if fall > 0 else -1,
    )


def _colours_together(line: np.ndarray, step: int) -> np.ndarray:
    """Means of a profile over each `step` rows (columns) of a Bayer cell, minus their overall mean."""
    line = line[: len(line) // step * step].reshape(-1, step).mean(1)
    return line - line.mean()


def _shading(profiles: dict[str, np.ndarray]) -> tuple[str, str, bool, float]:
    """Shading from profiles [frame, n] by axis; it lies along the axis that bends most for its scatter over frames."""
    found = []
    for axis, lines in profiles.items():
        sides = product(("first", "last"), LENGTHS)
        shares = {(start, length): lines @ _decay(lines.shape[1], start, length) for start, length in sides}
        start, length = max(shares, key=lambda key: shares[key].mean() ** 2)
        share = shares[start, length]
        spread = share.std(ddof=1) / np.sqrt(len(share)) if len(share) >= FEWEST_FRAMES else 1.0
        found.append((abs(share.mean()) / max(spread, 1e-12), axis, start, bool(share.mean() > 0), length))
    _, axis, start, above, length = max(found)
    return axis, start, above, length


def _decay(n: int, start: str, length: float) -> np.ndarray:
    """exp(-distance / length) over n rows (columns), of mean 0 and unit norm."""
    shape = np.exp(-np.linspace(0, 1, n) / length)
    shape = shape - shape.mean()
    shape = shape / np.sqrt((shape**2).sum())
    return shape if start == "first" else shape[::-1]


def _glow(brightness: np.ndarray) -> tuple[float, float]:
    """The corner or middle of an edge from which a map [row, column] fades."""
    rows, columns = brightness.shape
    tall, wide = max(rows // BLOCKS // 2 * 2, 2), max(columns // BLOCKS // 2 * 2, 2)
    cut = brightness[: rows // tall * tall, : columns // wide * wide]
    # Medians: a hot pixel does not glow.
    block = np.median(cut.reshape(rows // tall, tall, columns // wide, wide), (1, 3))
    block = block - block.mean()
    down, right = (np.arange(n)[:, None] * size for n, size in zip(block.shape, (tall, wide), strict=True))

    def likeness(spot: tuple[float, float], scale: float, aspect: float) -> float:
        across = (right.T - spot[1] * right[-1]) / aspect
        fading = np.exp(-np.hypot(down - spot[0] * down[-1], across) / np.hypot(rows, columns) / scale)
        fading = fading - fading.mean()
        return float((block * fading).sum() / np.sqrt((fading**2).sum()))

    return max(product(SPOTS, SCALES, ASPECTS), key=lambda one: likeness(*one))[0]
