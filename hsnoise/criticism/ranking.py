"""Candidates in order of their log-likelihood ratio, one at a time and two together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hsnoise.criticism.candidates import made
from hsnoise.criticism.fingerprint import Fingerprint, law_of
from hsnoise.criticism.gaussian import Gaussian
from hsnoise.effects import AbstractEffect

GRID = np.geomspace(0.15, 5.0, 18)  # amplitudes that are tried
CLOSE = np.geomspace(0.6, 1.6, 7)  # the same, relative, around the best
PAIR_FIRST, PAIR_SECOND = np.array([0.7, 1.0, 1.3]), np.geomspace(0.2, 4.0, 6)
LEAST_P = 1e-9
EVIDENCE = 8.0  # least log-likelihood ratio from which an effect is there: Markov's inequality, of 27 candidates
FALSE_ALARMS, TAIL = 0.001, 0.1  # probability of one; share of the draws that tell how the scores of chance fall off
LEADERS = 3  # candidates that are paired with all others


@dataclass(frozen=True)
class Candidate:
    """An effect that may be missing.

    Attributes:
        name: of the effect; effect: ready to add, with a first estimate of its parameters.
        score: log-likelihood ratio against "nothing missing", nats.
        p_value: chance of such a score if nothing is missing, over the whole ranking.
        misfit: normal score of the group of statistics that fits worst with this effect in the model.
    """

    name: str
    effect: AbstractEffect
    score: float
    p_value: float
    misfit: float

    @property
    def chance(self) -> str:
        """The p-value as tables show it: below LEAST_P, tails of the statistics are not known well enough."""
        return f"< {LEAST_P:.0e}".replace("e-0", "e-") if self.p_value < LEAST_P else f"{self.p_value:.2g}"


@dataclass(frozen=True)
class Evidence:
    """What the candidates are judged by: z [statistic] of the capture, its law if nothing is missing, names, groups."""

    z: np.ndarray
    null: Gaussian
    names: tuple[str, ...]
    groups: tuple[str, ...]
    candidates: int
    limit: float = EVIDENCE  # log-likelihood ratio from which an effect is there

    @property
    def has_flats(self) -> bool:
        return any(group.startswith("flats") for group in self.groups)

    @cached_property
    def nothing(self) -> float:
        """Log density of the capture if nothing is missing."""
        return float(self.null.log_density(self.z))

    def score(self, law: Gaussian) -> float:
        """Log-likelihood ratio of a law against "nothing missing"."""
        return float(law.log_density(self.z)) - self.nothing

    def misfit(self, law: Gaussian) -> float:
        return max(law.normal_scores(self.z, self.groups).values())

    def p_value(self, score: float) -> float:
        # A likelihood ratio exceeds c by chance at most once in exp(c) (Markov), in any of the candidates.
        return float(min(1.0, self.candidates * np.exp(-max(score, 0.0))))


@dataclass(frozen=True)
class Judged:
    """A fingerprint at the amplitude that describes the capture best."""

    of: Fingerprint
    amplitude: float
    score: float
    misfit: float

    def candidate(self, evidence: Evidence) -> Candidate:
        covariance = self.of.law(self.amplitude, evidence.null).covariance
        closest = [Gaussian(shift, covariance).log_density(evidence.z) for shift in self.of.at(self.amplitude)]
        effect = made(self.of.maker, self.amplitude, int(np.argmax(closest)))
        return Candidate(self.of.name, effect, self.score, evidence.p_value(self.score), self.misfit)


@dataclass(frozen=True)
class Pair:
    """Two candidates that explain the capture together, the one with more evidence of its own first.

    effects: both, ready to add; shifts: of the statistics [statistic], by each.
    """

    names: tuple[str, str]
    effects: tuple[AbstractEffect, AbstractEffect]
    shifts: tuple[np.ndarray, np.ndarray]
    score: float
    misfit: float
    law: Gaussian


def judge(of: Fingerprint, evidence: Evidence, amplitudes: np.ndarray = GRID) -> Judged:
    """A fingerprint at the best of some amplitudes."""
    laws = [of.law(float(amplitude), evidence.null) for amplitude in amplitudes]
    scores = [evidence.score(law) for law in laws]
    i = int(np.argmax(scores))
    score = scores[i] - made(of.maker, 1.0, 0).selection_nats
    return Judged(of, float(amplitudes[i]), score, evidence.misfit(laws[i]))


def limit_by_chance(prints: Iterable[Fingerprint], null: Gaussian, z: np.ndarray) -> float:
    """Score that hardly any capture with nothing missing exceeds, from the z [draw, statistic] of such draws, nats.

    Laws that are estimated from few draws give more by chance than Markov's inequality allows. The best scores of the
    draws fall off exponentially.
    """
    nothing = null.log_density(z)
    laws = [of.law(float(amplitude), null) for of in prints for amplitude in GRID[::2]]
    best = np.max([law.log_density(z) for law in laws], 0) - nothing
    start = float(np.quantile(best, 1 - TAIL))
    beyond = float(np.mean(best[best > start] - start)) if (best > start).any() else 0.0
    return max(EVIDENCE, start + beyond * float(np.log(TAIL / FALSE_ALARMS)))


def best_pairs(judged: list[Judged], evidence: Evidence, number: int) -> list[Pair]:
    """The pairs that describe the capture best, of the leading candidates with all others; `judged` is best first."""
    found = []
    for i, first in enumerate(judged[:LEADERS]):
        alone = {float(a): first.of.law(float(a), evidence.null) for a in PAIR_FIRST * first.amplitude}
        for second in judged[i + 1 :]:
            laws = _laws_together(alone, second, evidence.null)
            scored = [(evidence.score(law), amplitudes, law) for amplitudes, law in laws]
            found.append((*max(scored, key=lambda one: one[0]), (first, second)))
    best = sorted(found, key=lambda one: -one[0])[:number]
    return [_pair(score, amplitudes, law, both, evidence) for score, amplitudes, law, both in best]


def _pair(score: float, amplitudes, law: Gaussian, both, evidence: Evidence) -> Pair:
    first, second = (replace(one, amplitude=a).candidate(evidence) for one, a in zip(both, amplitudes, strict=True))
    shifts = [one.of.at(a).mean(0) for one, a in zip(both, amplitudes, strict=True)]
    names, effects = (first.name, second.name), (first.effect, second.effect)
    return Pair(names, effects, (shifts[0], shifts[1]), score, evidence.misfit(law), law)


def closest(of: Fingerprint, evidence: Evidence, beside: np.ndarray) -> AbstractEffect:
    """The effect with the amplitude and details that describe the capture best, with `beside` shifting it, too."""
    scored = []
    for amplitude in map(float, GRID):
        shifts = of.at(amplitude)
        covariance = law_of(shifts, evidence.null, of_details=False).covariance
        densities = [Gaussian(one + beside, covariance).log_density(evidence.z) for one in shifts]
        scored += [(float(density), amplitude, detail) for detail, density in enumerate(densities)]
    _, amplitude, detail = max(scored, key=lambda one: one[0])
    return made(of.maker, amplitude, detail)


def _laws_together(alone: dict[float, Gaussian], second: Judged, null: Gaussian):
    """Amplitudes and laws with both effects in the sensor, `alone` those of the first: shifts and scatters add."""
    for b in PAIR_SECOND:
        other = second.of.law(float(b), null)
        for a, one in alone.items():
            yield (a, float(b)), Gaussian(one.mean + other.mean, one.covariance + other.covariance - null.covariance)
