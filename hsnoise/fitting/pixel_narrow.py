"""Noise narrower than a count: what rounding hides of it, and what the counts of all pixels together tell."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol, TypeVar

import numpy as np

from hsnoise.fitting.pixel_lines import Lines
from hsnoise.fitting.pixel_patterns import shortest_of
from hsnoise.statistics.pixels.narrow import NarrowLaw
from hsnoise.statistics.pixels.read_noise import NoiseSpread
from hsnoise.statistics.pixels.survey import Survey
from hsnoise.statistics.pixels.transfer import ROUNDING

LEAST_DN2 = 1e-4
MOVING = ("frame_offset", "row_noise", "column_noise")


class Channel(Protocol):
    """A colour as `pixel_fit.Channel` has it."""

    values: np.ndarray
    covariance: np.ndarray
    black_dn: tuple[float, float]
    patterns: Mapping[str, tuple[float, float, float]]
    lines: Mapping[str, Lines]


C = TypeVar("C", bound=Channel)


def narrow_of(found: Survey, c: int) -> tuple[float, float] | None:
    """Estimate and bound of the noise of the shortest exposure, DN, if it is narrower than a count."""
    return next((p.narrow_dn for p in shortest_of(found, c)), None)


def law_of(found: Survey, c: int) -> NarrowLaw | None:
    """How the pixels of a colour are distributed in the darks of most frames, if all its planes tell: their mean."""
    laws = [p.narrow_law for group in found.darks for p in group.of(c) if p.narrow_law is not None]
    if not laws or len(laws) < len(found.darks[0].of(c)):
        return None
    values, errors = np.moveaxis(np.array(laws), -1, 0)
    together = zip(values.mean(0).tolist(), np.sqrt((errors**2).mean(0)).tolist(), strict=True)
    return NarrowLaw(*together)


def variance_of(narrow: tuple[float, float]) -> tuple[float, float]:
    """Variance of narrow noise, rounding included, DN^2, and its error: the bound is two errors away."""
    estimate, bound = narrow
    middle = estimate if np.isfinite(estimate) else bound / 2
    return middle**2 + ROUNDING, max((bound**2 - middle**2) / 2, 1e-6)


def with_law(one: C, law: NarrowLaw | None, narrow: tuple[float, float] | None) -> C:
    """The colour with what the counts of its pixels tell, in levels instead of counts.

    Means of counts move by `slope` of what the levels do: so do offsets of frames, rows and columns.
    """
    if law is None or narrow is None:
        return one
    slope, of_slope = law.slope
    patterns = {name: _in_levels(of, slope, of_slope) for name, of in one.patterns.items()}
    shared = sum(max(patterns[name][0], 0.0) for name in MOVING if name in patterns)
    sigma, error = law.sigma
    alone = max(sigma**2 - shared, LEAST_DN2)
    values, covariance = one.values.copy(), one.covariance.copy()
    values[1] += alone + ROUNDING - variance_of(narrow)[0]
    covariance[1, 1] = (2 * sigma * error) ** 2
    changed: dict[str, Any] = {
        "values": values,
        "covariance": covariance,
        "temporal_dn2": alone + ROUNDING,
        "patterns": patterns,
        "lines": {axis: _parity_in_levels(of, slope, of_slope) for axis, of in one.lines.items()},
        "offset_dn": law.offset,
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
