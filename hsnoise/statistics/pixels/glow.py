"""Glow of an amplifier: a smooth part of the growth of pixels that fades from one spot."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from hsnoise._core.robust import OF_MEDIAN, robust_sigma
from hsnoise._core.types import cfa_tile
from hsnoise.statistics.pixels.classes import Levels, slope_over
from hsnoise.statistics.pixels.structure import covariance_terms
from hsnoise.statistics.pixels.survey import Survey

BLOCKS = 12  # of the frame, in each direction
FEWEST_PIXELS = 64  # of a block
SCALES = (0.05, 0.1, 0.2, 0.4)
ALIKE = 0.5  # of the logarithm by which blocks are brighter: by how much more their pixels may differ
EXPLAINED, MORE, THERE = 0.85, 0.3, 10.0  # share of the variance of blocks; peak over typical growth; standard errors
# Of rate, scale, row, column, aspect, power.
BOUNDS = ((0.0, 0.01, 0.0, 0.0, 0.2, 0.5), (np.inf, 2.0, 1.0, 1.0, 5.0, 3.0))

Number = tuple[float, float]


class Glow(NamedTuple):
    """As `amplifier_glow` has it, in DN/s, each value with its error."""

    rate_dn_per_s: Number
    scale: Number
    row: Number
    column: Number
    aspect: Number
    power: Number

    def at(self, places: np.ndarray) -> np.ndarray:
        """Growth at places [2, ...], rows and columns from 0 to 1 and the frame's sides, DN/s."""
        return _shape(places, *[value for value, _ in self])


def glow_of(found: Survey, channel: int) -> Glow | None:
    """The glow of a channel, from medians of blocks of pixels, which hot pixels do not move; None without any."""
    if not found.has_exposures or not found.is_whole:
        return None
    halves = slope_over(*_levels(found, channel))
    growth = halves.mean(0)
    places = _places(found, channel)
    numbers = np.minimum((places[:2] * BLOCKS).astype(int), BLOCKS - 1)
    order = np.argsort(numbers[0] * BLOCKS + numbers[1], kind="stable")
    cuts = np.searchsorted((numbers[0] * BLOCKS + numbers[1])[order], np.arange(1, BLOCKS**2))
    blocks = [of for of in np.split(order, cuts) if len(of) >= FEWEST_PIXELS]
    if len(blocks) < BLOCKS**2 // 2:
        return None
    typical = np.array([np.median(growth[of]) for of in blocks])
    scatter = np.array([OF_MEDIAN * robust_sigma(growth[of] - m) for of, m in zip(blocks, typical, strict=True)])
    error = scatter / np.sqrt([len(of) for of in blocks])
    glow = _fitted(np.array([places[:, of].mean(1) for of in blocks]).T, typical, np.maximum(error, 1e-9))
    if glow is None:
        return None
    left = halves - glow.at(places)
    return None if _multiplies(typical, np.array([_spread(left[:, of]) for of in blocks])) else glow


def _spread(halves: np.ndarray) -> float:
    """How much the growth of pixels of a block differs [half, pixel], outliers cut and noise taken off."""
    return float(np.sqrt(max(covariance_terms(halves).mean(), 0.0)))


def _multiplies(typical: np.ndarray, spread: np.ndarray) -> bool:
    """Whether pixels of bright blocks differ by more, as where dark current is larger: a glow adds the same to all."""
    order, third = np.argsort(typical), len(typical) // 3
    dark, bright = ((np.median(typical[of]), np.median(spread[of])) for of in (order[:third], order[-third:]))
    if min(dark) <= 0 or bright[0] <= dark[0]:
        return False
    return bool(np.log(max(bright[1], 1e-12) / dark[1]) > ALIKE * np.log(bright[0] / dark[0]))


def without_glow(pixels: Levels, glow_dn_per_s: np.ndarray) -> Levels:
    """Levels without what a glow adds; glow_dn_per_s [pixel]."""
    return pixels._replace(level=pixels.level - (pixels.exposure_s[:, None, None] * glow_dn_per_s).astype(np.float32))


def glow_of_pixels(glow: Glow, found: Survey, channel: int) -> np.ndarray:
    """Growth by a glow of each sampled pixel of a channel [pixel], DN/s."""
    return glow.at(_places(found, channel))


def _fitted(places: np.ndarray, growth: np.ndarray, error: np.ndarray) -> Glow | None:
    """The glow in the growth of blocks [block] with its error, if it explains it."""

    def off(x: np.ndarray) -> np.ndarray:
        return (growth - x[-1] - _shape(places, *x[:-1])) / error

    low, high = (np.array([*of, side]) for of, side in zip(BOUNDS, (-np.inf, np.inf), strict=True))
    found = None
    for row, column, scale in product((0.02, 0.5, 0.98), (0.02, 0.5, 0.98), SCALES):
        shape = _shape(places, 1.0, scale, row, column, 1.0, 1.0)
        design = np.stack([shape, np.ones_like(shape)], 1) / error[:, None]
        (rate, level), left, *_ = np.linalg.lstsq(design, growth / error, rcond=None)
        if rate > 0 and len(left) and (found is None or left[0] < found[0]):
            found = float(left[0]), np.array([rate, scale, row, column, 1.0, 1.2, level])
    if found is None:
        return None
    best = least_squares(off, found[1], bounds=(low, high), x_scale=np.abs(found[1]) + 0.01)
    x = best.x
    if 1 - np.var(off(x) * error) / np.var(growth) < EXPLAINED or x[0] < MORE * abs(float(np.median(growth))):
        return None
    worse = max(1.0, 2 * best.cost / (len(growth) - len(x)))
    inside = best.active_mask == 0
    errors = np.full(len(x), np.inf)
    jac = best.jac[:, inside]
    errors[inside] = np.sqrt(worse * np.diagonal(np.linalg.pinv(jac.T @ jac)))
    if not x[0] > THERE * errors[0] or not inside[4]:  # so long a spot is none
        return None
    return Glow(*[(float(value), float(one)) for value, one in zip(x[:-1], errors[:-1], strict=True)])


def _shape(
    places: np.ndarray, rate: float, scale: float, row: float, column: float, aspect: float, power: float
) -> np.ndarray:
    down, right = (places[0] - row) * places[2], (places[1] - column) * places[3] / aspect
    return rate * np.exp(-((np.sqrt(down**2 + right**2 + 1e-12) / scale) ** power))


def _levels(found: Survey, channel: int) -> tuple[np.ndarray, np.ndarray]:
    groups = found.repeated_darks
    return np.array([g.exposure_s for g in groups]), np.stack([g.pixels(channel, "level_dn") for g in groups])


def _places(found: Survey, channel: int) -> np.ndarray:
    """Row and column of each sampled pixel of a channel, 0 to 1, and the sides of the frame in diagonals [4, pixel]."""
    tile, (height, width) = cfa_tile(found.cfa), found.shape
    step, several = len(tile), []
    for p in np.flatnonzero(tile.ravel() == channel):
        rows = found.sampled_rows[p // step :: step] / max(height - 1, 1)
        columns = np.arange(p % step, width, step) / max(width - 1, 1)
        several.append(np.stack([np.repeat(rows, len(columns)), np.tile(columns, len(rows))]))
    places, diagonal = np.concatenate(several, axis=1), np.hypot(height - 1, width - 1)
    sides = np.array([[(height - 1) / diagonal], [(width - 1) / diagonal]])
    return np.concatenate([places, np.broadcast_to(sides, (2, places.shape[1]))])
