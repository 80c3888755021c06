"""Defective pixels of a capture: they are no noise, and a neighbour takes their place before frames are compared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce

import numpy as np

from hsnoise._core.robust import robust_sigma
from hsnoise.statistics.pixels.flags import are_dim

MOST = 0.02  # of the pixels: more are no exception
BY_CHANCE = 0.01  # expected number of sound pixels that are taken for stuck ones
AGREE = math.sqrt(2)  # ratio of the largest probability of a count to the chance that two counts agree; normal noise
NEAR = (6, -6, 10, -10, 14, -14, 18, -18)  # columns to a pixel of the same colour, beyond the lags that are compared


def without_defects(counts: Sequence[np.ndarray], kind: Sequence[str], tile: int) -> tuple[list[np.ndarray], list[str]]:
    """The counts [frame, row, column] of each exposure with defective pixels replaced, and a sentence on what was.

    Stuck pixels have the same count in all frames, dead ones less than half of their neighbours' light. Each becomes
    the next sound pixel of its colour in its row.

    tile: side of a cell of the colour filter, pixels.
    """
    bad = defects(counts, kind, tile)
    share = bad.mean()
    if not share:
        return list(counts), []
    what = f"{bad.sum()} pixels ({100 * share:.2g} %) are stuck or dead"
    if share > MOST:
        return list(counts), [f"{what}: too many to be left out"]
    source = _sources(bad)
    rows, columns = np.nonzero(bad)
    out = [some.copy() for some in counts]
    for some in out:
        some[:, rows, columns] = some[:, rows, source[rows, columns]]
    return out, [f"{what}, and are no noise: neighbours stood in for them (pixel_map.png of hsnoise fit shows where)"]


def defects(counts: Sequence[np.ndarray], kind: Sequence[str], tile: int) -> np.ndarray:
    """Which pixels [row, column] are stuck or dead, from counts [frame, row, column] of each exposure."""
    bad = np.zeros(counts[0].shape[1:], bool)
    for row in range(tile):
        for column in range(tile):
            of_colour = [some[:, row::tile, column::tile] for some in counts]
            bad[row::tile, column::tile] = _stuck(of_colour) | _dead(of_colour, kind)
    return bad


def _stuck(counts: Sequence[np.ndarray]) -> np.ndarray:
    """Pixels [row, column] of one colour that never change, unless noise as narrow as theirs makes some."""
    still, chance = [], 1.0
    for some in counts:
        if len(some) > 1:
            still.append((some == some[0]).all(0))
            agree = float(np.mean(some[1] == some[0]))
            chance *= min(AGREE * agree, 1.0) ** (len(some) - 1)
    if not still or chance * still[0].size > BY_CHANCE:
        return np.zeros(counts[0].shape[1:], bool)
    return reduce(np.logical_and, still)


def _dead(counts: Sequence[np.ndarray], kind: Sequence[str]) -> np.ndarray:
    """Pixels [row, column] of one colour that respond to light by less than half as much as their neighbours."""
    dark = [some for some, of in zip(counts, kind, strict=True) if of == "dark"]
    lit = [some for some, of in zip(counts, kind, strict=True) if of == "flat" and len(some) > 1]
    none = np.zeros(counts[0].shape[1:], bool)
    if not dark or not lit:
        return none
    bright = max(lit, key=lambda some: float(np.median(some[0])))
    signal = bright.mean(0, dtype=np.float32) - dark[0].mean(0, dtype=np.float32)
    noise = robust_sigma(np.diff(bright[:2].astype(np.float32), axis=0)) / np.sqrt(2 * len(bright))
    return are_dim(signal, float(noise))


def _sources(bad: np.ndarray) -> np.ndarray:
    """The column of the pixel that stands in for each pixel [row, column]; its own if it is sound, or none near is."""
    columns = np.arange(bad.shape[1])
    source, left = np.broadcast_to(columns, bad.shape).copy(), bad.copy()
    for step in NEAR:
        there = np.clip(columns + step, 0, len(columns) - 1)
        usable = left & ~bad[:, there] & (there == columns + step)
        source = np.where(usable, there, source)
        left &= ~usable
    return source
