"""Static structure of darks over the frame: panels with sharp edges, as outputs make them, or something else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hsnoise._core.robust import robust_sigma
from hsnoise._core.types import cfa_tile
from hsnoise.frames.stack import FrameStack

GRID = 16  # blocks along each side, whose means are compared
LAYOUTS = ((1, 2), (1, 4), (1, 8), (2, 1), (2, 2), (2, 4))  # outputs over the rows, over the columns
THERE = 2.0  # times the variance by chance, from which there is structure
MOST = 0.15  # of it that panels may leave
MARGIN = 30.0  # of chi2, by which a smooth surface must be better


def may_be_outputs(stack: FrameStack, drawn: Sequence[FrameStack]) -> bool:
    """Whether panels describe what is static in the darks beyond the model, or nothing of that size is.

    drawn: draws of the model as the stack was taken; their mean is what the model has. The shortest or the longest
    exposure is looked at, whichever shows more: gains show in dark signal, offsets everywhere.
    """
    darks = [i for i in range(stack.n_exposures) if stack.kind[i] == "dark" and stack.n_frames[i] > 1]
    if not darks or min(stack.shape) < 2 * GRID:
        return True
    by_time = sorted(darks, key=lambda i: stack.exposure_s[i])
    ends = {by_time[0], by_time[-1]}
    maps = [_halves(stack, i) - np.mean([_halves(one, i) for one in drawn], axis=(0, 1)) for i in ends]
    beside = [halves - halves.mean(2, keepdims=True) for halves in maps]
    # What rows share, their slow noise has, too: if columns show structure, that decides.
    of_columns, of_all = (max(some, key=_whole) for some in (beside, maps))
    return _are_panels(of_columns if _whole(of_columns) > THERE else of_all)


def _halves(stack: FrameStack, i: int) -> np.ndarray:
    """Block means of the even and the odd frames of an exposure [half, row, column], colours less their means, DN."""
    cell = len(cfa_tile(stack.cfa))
    rows, columns = (n // cell * cell for n in stack.shape)
    sums, numbers = np.zeros((2, rows, columns)), np.zeros(2)
    for f, frame in enumerate(stack.frames(i)):
        sums[f % 2] += frame[:rows, :columns]
        numbers[f % 2] += 1
    level = sums / numbers[:, None, None]
    for r in range(cell):
        for c in range(cell):
            colour = level[:, r::cell, c::cell]
            colour -= np.median(colour, axis=(1, 2), keepdims=True)
    middle = np.median(level)
    width = 5 * robust_sigma(level - middle) + 1e-9
    level = np.clip(level, middle - width, middle + width)  # hot pixels
    edges = [[n * of // GRID for of in range(GRID)] for n in (rows, columns)]
    sizes = [np.diff([*of, n]) for of, n in zip(edges, (rows, columns), strict=True)]
    blocks = np.add.reduceat(np.add.reduceat(level, edges[0], axis=1), edges[1], axis=2)
    return blocks / sizes[0][:, None] / sizes[1]


def _chance(halves: np.ndarray) -> float:
    """Variance by chance of the mean of two maps of block means."""
    return float(np.var(halves[0] - halves[1])) / 4 + 1e-12


def _whole(halves: np.ndarray) -> float:
    """Variance of block means over that by chance."""
    return float(np.var(halves.mean(0))) / _chance(halves)


def _are_panels(halves: np.ndarray) -> bool:
    """Whether panels explain two maps of block means, and not worse than a smooth surface."""
    seen, chance = halves.mean(0), _chance(halves)
    free = seen.size - 1
    whole = free * _whole(halves)
    panels = min(float(np.sum((seen - _panels(seen, *layout)) ** 2)) for layout in LAYOUTS) / chance
    surface = float(np.sum((seen - _surface(seen)) ** 2)) / chance
    if panels - surface > MARGIN:
        return False
    return whole < THERE * free or panels - free < MOST * (whole - free)


def _panels(seen: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """The mean of each of so many equal panels."""
    height, width = GRID // rows, GRID // columns
    means = seen.reshape(rows, height, columns, width).mean((1, 3))
    return means.repeat(height, 0).repeat(width, 1)


def _surface(seen: np.ndarray) -> np.ndarray:
    """The nearest surface of second order."""
    x = np.linspace(-1, 1, GRID)
    row, column = np.meshgrid(x, x, indexing="ij")
    terms = np.stack([np.ones_like(row), row, column, row**2, column**2, row * column], -1).reshape(-1, 6)
    return (terms @ np.linalg.lstsq(terms, seen.ravel(), rcond=None)[0]).reshape(seen.shape)
