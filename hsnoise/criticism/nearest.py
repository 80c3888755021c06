"""Which effects come nearest where none explains a capture: those that explain most of its statistics.

If no effect fits, the likelihood ratio of normal distributions favours the effect that scatters statistics most. With
Student's t, statistics left for other effects count equally however far off they are (Lange, Little, Taylor,
"Robust statistical modeling using the t distribution", J. Am. Stat. Assoc. 84, 1989).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hsnoise._core.threads import in_threads
from hsnoise.criticism import rules
from hsnoise.criticism.candidates import made
from hsnoise.criticism.fingerprint import Fingerprint
from hsnoise.criticism.ranking import GRID, Candidate, Evidence
from hsnoise.effects import AbstractEffect
from hsnoise.simulation.reference import misfits

FREEDOM = 4.0
ITERATIONS = 10
MOST_TOGETHER = 4  # effects that are added at once


def nearest(
    prints: Sequence[Fingerprint],
    ranking: Iterable[Candidate],
    evidence: Evidence,
    slopes: np.ndarray,
    variance: np.ndarray,
) -> tuple[Candidate, ...]:
    """Candidates of the ranking by what they gain, the best first, with parameters of that gain.

    In the second place is what takes most from the worst group of statistics, which is what `compare` calls the error.

    slopes [parameter, statistic]: shifts by wrong base parameters, which are free; variance [statistic]: of z if
    nothing is missing.
    """
    z = evidence.z
    nothing = _loss(z, slopes, variance)
    listed = {candidate.name: candidate for candidate in ranking}
    found = []
    for of in prints:
        loss, amplitude, detail = _best(of, lambda shift: _loss(z - shift, slopes, variance))
        if nothing - loss > evidence.least:
            found.append((loss, replace(listed[of.name], effect=made(of.maker, amplitude, detail))))
    ordered = [candidate for _, candidate in sorted(found, key=lambda pair: pair[0])]
    of_worst = _of_worst_group(prints, listed, evidence)
    if of_worst is None or of_worst.name in [one.name for one in ordered[:1]]:
        return tuple(ordered)
    return (*ordered[:1], of_worst, *(one for one in ordered[1:] if one.name != of_worst.name))


def together(
    prints: Iterable[Fingerprint],
    nearest: Sequence[Candidate],
    evidence: Evidence,
    slopes: np.ndarray,
    variance: np.ndarray,
) -> tuple[Candidate, ...]:
    """Of the nearest candidates, those that explain most together: each a part that the ones before it leave.

    Once another has joined them, those chosen before are fitted again to what is left for them.
    """
    drawn, listed = {of.name: of for of in prints}, {one.name: one for one in nearest}
    chosen: dict[str, _Part] = {}

    def part_of(name: str) -> _Part:
        """What is best left to one of them, whether it is chosen already or not."""
        left = evidence.z - sum(part.shift for other, part in chosen.items() if other != name)
        return _part(drawn[name], left, slopes, variance)

    while len(chosen) < min(MOST_TOGETHER, len(listed)):
        others = [name for name in listed if name not in chosen]
        best, name = min(zip(in_threads(part_of, others), others, strict=True), key=lambda pair: pair[0].loss)
        if best.before - best.loss < evidence.least:
            break
        chosen[name] = best
        if len(chosen) > 1:
            chosen |= {one: part_of(one) for one in chosen}
    return tuple(replace(listed[name], effect=part.effect) for name, part in chosen.items())


class _Part(NamedTuple):
    """One of several effects: the loss without and with it, its shift of the statistics [statistic], itself."""

    before: float
    loss: float
    shift: np.ndarray
    effect: AbstractEffect


def _part(of: Fingerprint, left: np.ndarray, slopes: np.ndarray, variance: np.ndarray) -> _Part:
    loss, amplitude, detail = _best(of, lambda shift: _loss(left - shift, slopes, variance))
    return _Part(_loss(left, slopes, variance), loss, of.at(amplitude)[detail], made(of.maker, amplitude, detail))


def _of_worst_group(
    prints: Iterable[Fingerprint], listed: dict[str, Candidate], evidence: Evidence
) -> Candidate | None:
    """The candidate that takes most from the misfit of the worst group; None if none takes half of it."""
    misfit = misfits(evidence.z, evidence.groups)
    worst = max(misfit, key=misfit.__getitem__)
    of_group = np.array(evidence.groups) == worst

    def misfit_with(shift: np.ndarray) -> float:
        return float(np.mean((evidence.z - shift)[of_group] ** 2))

    (left, amplitude, detail), of = min(((_best(of, misfit_with), of) for of in prints), key=lambda pair: pair[0])
    gain = misfit[worst] - left
    if gain < rules.HALF * misfit[worst] or gain * of_group.sum() / 2 < evidence.least:
        return None
    return replace(listed[of.name], effect=made(of.maker, amplitude, detail))


def _best(of: Fingerprint, loss: Callable[[np.ndarray], float]) -> tuple[float, float, int]:
    """Least loss of the shifts [statistic] at all amplitudes and details: (loss, amplitude, detail)."""
    return min(
        (loss(shift), float(amplitude), detail)
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
