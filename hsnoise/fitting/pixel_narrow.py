"""Noise narrower than a count: what rounding hides of it, and what the counts of all pixels together tell."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol, TypeVar

import numpy as np

from hsnoise.fitting.pixel_joint import UNKNOWN
from hsnoise.fitting.pixel_lines import Lines
from hsnoise.fitting.pixel_patterns import shortest_of
from hsnoise.statistics.pixels.narrow import NarrowLaw
from hsnoise.statistics.pixels.population import Population
from hsnoise.statistics.pixels.read_noise import NoiseSpread
from hsnoise.statistics.pixels.survey import Survey
from hsnoise.statistics.pixels.transfer import ROUNDING

LEAST_DN2 = 1e-4
SHOT_NOISE = 0.3  # relative error of what pixels' dark currents, which differ, add to their noise
MOVING = ("frame_offset", "row_noise", "column_noise")


class Channel(Protocol):
    """A colour as `pixel_fit.Channel` has it."""

    population: Population | None
    offset_dn: tuple[float, float]
    values: np.ndarray
    covariance: np.ndarray
    black_dn: tuple[float, float]
    patterns: Mapping[str, tuple[float, float, float]]
    lines: Mapping[str, Lines]


C = TypeVar("C", bound=Channel)


def narrow_of(found: Survey, c: int) -> tuple[float, float] | None:
    """Estimate and bound of the noise of the shortest exposure, DN, if it is narrower than a count."""
    return next((p.narrow_dn for p in shortest_of(found, c)), None)


def law_of(found: Survey, c: int) -> tuple[NarrowLaw, float] | None:
    """How the pixels of a colour are distributed in the darks of most frames, if all its planes tell: their mean, and
    the exposure, s."""
    told = [(p.narrow_law, group.exposure_s) for group in found.darks for p in group.of(c) if p.narrow_law is not None]
    if not told or len(told) < len(found.darks[0].of(c)):
        return None
    laws = [law for law, _ in told]
    values, errors = np.moveaxis(np.array(laws), -1, 0)
    together = zip(values.mean(0).tolist(), np.sqrt((errors**2).mean(0)).tolist(), strict=True)
    return NarrowLaw(*together), told[0][1]


def variance_of(narrow: tuple[float, float]) -> tuple[float, float]:
    """Variance of narrow noise, rounding included, DN^2, and its error: the bound is two errors away."""
    estimate, bound = narrow
    middle = estimate if np.isfinite(estimate) else bound / 2
    return middle**2 + ROUNDING, max((bound**2 - middle**2) / 2, 1e-6)


def with_law(one: C, told: tuple[NarrowLaw, float] | None, narrow: tuple[float, float] | None) -> C:
    """The colour with what the counts of its pixels tell, in levels instead of counts.

    Means of counts move by `slope` of what the levels do: so do offsets of frames, rows and columns.
    """
    if told is None or narrow is None:
        return one
    (law, exposure_s), (slope, of_slope) = told, told[0].slope
    patterns = {name: _in_levels(of, slope, of_slope) for name, of in one.patterns.items()}
    shared = sum(max(patterns[name][0], 0.0) for name in MOVING if name in patterns)
    sigma, error = law.sigma
    alone = max(sigma**2 - shared, LEAST_DN2)
    values, covariance = one.values.copy(), one.covariance.copy()
    by_counts, of_counts = alone + ROUNDING - variance_of(narrow)[0], (2 * sigma * error) ** 2
    if covariance[0, 0] < UNKNOWN**2:  # the gain is told by longer exposures: so is the shot noise of these
        shot = values[0] * max(values[2], 0.0) * exposure_s
        by_counts, of_counts = alone + ROUNDING - shot - values[1], of_counts + (SHOT_NOISE * shot) ** 2
    if covariance[0, 0] >= UNKNOWN**2 or of_counts < covariance[1, 1]:
        values[1] += by_counts
        covariance[1], covariance[:, 1] = 0.0, 0.0
        covariance[1, 1] = of_counts
    changed: dict[str, Any] = {
        "values": values,
        "covariance": covariance,
        "temporal_dn2": alone + ROUNDING,
        "patterns": patterns,
        "lines": {axis: _parity_in_levels(of, slope, of_slope) for axis, of in one.lines.items()},
        # Over exposures that grow, offsets are told from dark currents, which a single one holds, too.
        "offset_dn": law.offset if one.population is None else one.offset_dn,
        "black_dn": (one.black_dn[0] - law.raised[0], float(np.hypot(one.black_dn[1], law.raised[1]))),
        "noise_spread": NoiseSpread(law.spread),
        "is_narrow": False,
    }
    return replace(one, **changed)


def _in_levels(of: tuple[float, float, float], slope: float, of_slope: float) -> tuple[float, float, float]:
    """Variance, error and chance of levels, DN^2, from those of the means of counts."""
    variance, error, chance = (float(each) / slope**2 for each in of)
    return variance, float(np.hypot(error, 2 * variance * of_slope / slope)), chance


def _parity_in_levels(lines: Lines, slope: float, of_slope: float) -> Lines:
    if lines.parity_dn is None:
        return lines
    value, error = (each / slope for each in lines.parity_dn)
    return lines._replace(parity_dn=(value, float(np.hypot(error, value * of_slope / slope))))
