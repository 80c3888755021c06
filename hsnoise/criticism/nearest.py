"""Which effects come nearest where none explains a capture: those that explain most of its statistics.

Far off, the likelihood ratio of normal laws goes to whatever makes statistics scatter most. By Student's t instead,
statistics that others will have to explain count alike however far off they are (Lange, Little, Taylor, "Robust
statistical modeling using the t distribution", J. Am. Stat. Assoc. 84, 1989).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from hsnoise.criticism.candidates import made
from hsnoise.criticism.fingerprint import Fingerprint
from hsnoise.criticism.ranking import GRID, Candidate

FREEDOM = 4.0
ITERATIONS = 10
LEAST_GAIN = 8.0  # nats


def nearest(
    prints: Iterable[Fingerprint], ranking: Iterable[Candidate], z: np.ndarray, slopes: np.ndarray, variance: np.ndarray
) -> tuple[Candidate, ...]:
    """Candidates of the ranking by what they gain, the best first, with parameters of that gain.

    z [statistic]: the capture's; slopes [parameter, statistic]: shifts by wrong base parameters, which are free;
    variance [statistic]: of z if nothing is missing.
    """
    nothing = _loss(z, slopes, variance)
    listed = {candidate.name: candidate for candidate in ranking}
    found = []
    for of in prints:
        loss, amplitude, detail = _best(of, z, slopes, variance)
        if nothing - loss > LEAST_GAIN:
            found.append((loss, replace(listed[of.name], effect=made(of.maker, amplitude, detail))))
    return tuple(candidate for _, candidate in sorted(found, key=lambda pair: pair[0]))


def _best(of: Fingerprint, z: np.ndarray, slopes: np.ndarray, variance: np.ndarray) -> tuple[float, float, int]:
    """Least loss over amplitudes and details: (loss, amplitude, detail)."""
    return min(
        (_loss(z - shift, slopes, variance), float(amplitude), detail)
        for amplitude in GRID[::2]
        for detail, shift in enumerate(of.at(float(amplitude)))
    )


def _loss(off: np.ndarray, slopes: np.ndarray, variance: np.ndarray) -> float:
    """Minus the log-likelihood of Student's t at the best base parameters, up to a constant, nats."""
    left = off
    for _ in range(ITERATIONS):
        weight = 1 / np.sqrt(variance * (FREEDOM + left**2 / variance))
        left = off - np.linalg.lstsq((slopes * weight).T, weight * off, rcond=None)[0] @ slopes
    return float((FREEDOM + 1) / 2 * np.log1p(left**2 / (FREEDOM * variance)).sum())
