"""Offsets of pixels (DSNU): what the halves of the shortest exposure share, unless other exposures do not."""

from __future__ import annotations

import numpy as np

from hsnoise.fitting.pixel_patterns import shortest_of
from hsnoise.statistics.pixels.classes import slope_over
from hsnoise.statistics.pixels.population import Patterns, Population, offset_sigma, root_of, winsorised
from hsnoise.statistics.pixels.structure import beside_neighbours, low_side_sigma, plane_rows
from hsnoise.statistics.pixels.survey import Plane, Survey

FEWEST_EXPOSURES, MOST_EXPOSURES = 4, 10
NOT_SHARED = 3.0  # standard errors


def offset_of(found: Survey, c: int, population: Population | None) -> tuple[float, float]:
    """Standard deviation of the offsets of pixels, DN, and its error.

    Interference and slow noise look alike in the frames of one exposure by chance, far beyond the chance of independent
    pixels. Offsets are the same in all exposures: if these have less in common than the halves of the shortest
    one, that is what counts, with the scatter that it shows.
    """
    if population is not None:
        sigma, error = population.offset_sigma
    elif found.shortest is None:
        return 0.0, np.inf
    else:
        patterns = offset_patterns(found, c)
        sigma, error = offset_sigma(patterns.shortest, 0.0, patterns.low_side_dn)
    across = _across(found, c) if sigma > 0 else None
    if across is not None and sigma**2 - across[0] > NOT_SHARED * np.hypot(across[1], 2 * sigma * error):
        return root_of(*across)
    by_waves = _by_waves(found, c)
    if by_waves > 0 and np.isfinite(error):
        error = float(np.hypot(error, min(by_waves / max(2 * sigma, 1e-12), np.sqrt(by_waves))))
    return sigma, error


def _by_waves(found: Survey, c: int) -> float:
    """Standard deviation of what two halves of the shortest frames share of waves, whose phases are random, DN^2."""
    first, second = shortest_of(found, c)[0].halves.n_frames
    return sum(wave.variance_dn2 for wave in found.waves) / np.sqrt(2 * first * second)


def offset_patterns(found: Survey, c: int) -> Patterns:
    """Pixels beside their neighbours, without stuck pixels."""
    planes, rows, kept = shortest_of(found, c), _rows(found), ~found.stuck(c)
    halves = [plane.halves for plane in planes]
    low_side = float(np.mean([low_side_sigma(of.level_dn, rows, of.n_frames[1]) for of in halves]))
    shortest, unexposed = _beside(planes, rows)[:, kept], None
    if found.has_exposures and found.shortest.exposure_s > 0:
        darks = found.repeated_darks
        t = np.array([group.exposure_s for group in darks])
        several = np.array([_beside(group.of(c), rows)[:, kept] for group in darks])
        unexposed = several.mean(0) - slope_over(t, several) * t.mean()
    return Patterns(shortest, unexposed, low_side)


def _rows(found: Survey) -> float:
    """Sampled rows of a plane."""
    return len(found.sampled_rows) * plane_rows(found)


def _beside(planes: list[Plane], rows: float) -> np.ndarray:
    """Pixels of planes beside their neighbours [half, pixel], DN."""
    return np.concatenate([beside_neighbours(of.halves.level_dn, rows) for of in planes], axis=1)


def _across(found: Survey, c: int) -> tuple[float, float] | None:
    """Covariance over pixels of the shorter exposures with one another, DN^2, and its error, by the jackknife.

    Dark current that differs between pixels adds to it, never takes from it. None with too few exposures.
    """
    darks = sorted(found.repeated_darks, key=lambda g: g.exposure_s)[:MOST_EXPOSURES]
    if len(darks) < FEWEST_EXPOSURES:
        return None
    kept = ~found.stuck(c)
    maps = np.array([winsorised(_beside(g.of(c), _rows(found))[:, kept].mean(0)) for g in darks])
    mean = _covariance(maps)
    without = np.array([_covariance(np.delete(maps, i, axis=0)) for i in range(len(maps))])
    return mean, float(np.sqrt((1 - 1 / len(maps)) * ((without - without.mean()) ** 2).sum()))


def _covariance(maps: np.ndarray) -> float:
    """Mean over all pairs of maps [exposure, pixel] of the mean of their product."""
    n = len(maps)
    return float(np.mean(maps.sum(0) ** 2) - (maps**2).mean(1).sum()) / (n * (n - 1))
