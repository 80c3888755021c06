"""Candidates in order of their log-likelihood ratio, one at a time and two together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hsnoise._core.threads import in_threads
from hsnoise.criticism import rules
from hsnoise.criticism.candidates import made
from hsnoise.criticism.fingerprint import Fingerprint, distribution_of
from hsnoise.effects import AbstractEffect
from hsnoise.simulation.gaussian import Gaussian

GRID = np.geomspace(0.15, 5.0, 18)  # amplitudes that are tried
CLOSE = np.geomspace(0.6, 1.6, 7)  # the same, relative, around the best
PAIR_FIRST, PAIR_SECOND = np.array([0.7, 1.0, 1.3]), np.geomspace(0.2, 4.0, 6)
LEAST_P = 1e-9
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
    """What candidates are judged by: z of the capture [statistic], its distribution if nothing is missing, groups."""

    z: np.ndarray
    null: Gaussian
    names: tuple[str, ...]
    groups: tuple[str, ...]
    candidates: int
    chance: float = 0.0  # score that draws of the model exceed in CHANCE_RATE of the cases; 0 if none were scored
    has_flats: bool = False  # whether the capture has flats

    @property
    def least(self) -> float:
        """Log-likelihood ratio, nats, from which one of the candidates may be there."""
        return rules.evidence(self.candidates)

    @property
    def limit(self) -> float:
        """Log-likelihood ratio, nats, from which one of them is present, allowing for chance in such a capture."""
        return max(self.least, self.chance)

    @cached_property
    def nothing(self) -> float:
        """Log density of the capture if nothing is missing."""
        return float(self.null.log_density(self.z))

    def score(self, distribution: Gaussian) -> float:
        """Log-likelihood ratio of a distribution against "nothing missing"."""
        return float(distribution.log_density(self.z)) - self.nothing

    def misfit(self, distribution: Gaussian) -> float:
        return max(distribution.normal_scores(self.z, self.groups).values())

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
        covariance = self.of.distribution(self.amplitude, evidence.null).covariance
        off = evidence.z - self.of.at(self.amplitude)
        closest = Gaussian(np.zeros(off.shape[1]), covariance).log_density(off)
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
    distribution: Gaussian


def judge_all(prints: Iterable[Fingerprint], evidence: Evidence, amplitudes: np.ndarray = GRID) -> list[Judged]:
    """Fingerprints at the best of some amplitudes each, best first."""
    found = in_threads(lambda of: judge(of, evidence, amplitudes), prints)
    return sorted(found, key=lambda one: -one.score)


def judge(of: Fingerprint, evidence: Evidence, amplitudes: np.ndarray = GRID) -> Judged:
    """A fingerprint at the best of some amplitudes."""
    tried = [of.distribution(float(amplitude), evidence.null) for amplitude in amplitudes]
    scores = [evidence.score(distribution) for distribution in tried]
    i = int(np.argmax(scores))
    score = scores[i] - made(of.maker, 1.0, 0).selection_nats
    return Judged(of, float(amplitudes[i]), score, evidence.misfit(tried[i]))


def limit_by_chance(prints: Iterable[Fingerprint], evidence: Evidence, z: np.ndarray) -> float:
    """Score that hardly any capture with nothing missing exceeds, from the z [draw, statistic] of such draws, nats.

    With distributions estimated from few draws, scores exceed Markov's bound. The best scores of the draws fall off
    exponentially.
    """

    def best_of(of: Fingerprint) -> np.ndarray:
        return np.max([of.distribution(float(amplitude), evidence.null).log_density(z) for amplitude in GRID[::2]], 0)

    best = np.max(in_threads(best_of, prints), 0) - evidence.null.log_density(z)
    start = float(np.quantile(best, 1 - rules.CHANCE_TAIL))
    beyond = float(np.mean(best[best > start] - start)) if (best > start).any() else 0.0
    return start + beyond * float(np.log(rules.CHANCE_TAIL / rules.CHANCE_RATE))


def best_pairs(judged: list[Judged], evidence: Evidence, number: int) -> list[Pair]:
    """The pairs that describe the capture best, of the leading candidates with all others; `judged` is best first."""
    alone = {
        first.of.name: {float(a): first.of.distribution(float(a), evidence.null) for a in PAIR_FIRST * first.amplitude}
        for first in judged[:LEADERS]
    }

    def best_of(both: tuple[Judged, Judged]):
        together = _together(alone[both[0].of.name], both[1], evidence.null)
        scored = [(evidence.score(distribution), amplitudes, distribution) for amplitudes, distribution in together]
        score, amplitudes, distribution = max(scored, key=lambda one: one[0])
        return score, amplitudes, distribution, both

    pairs = [(first, second) for i, first in enumerate(judged[:LEADERS]) for second in judged[i + 1 :]]
    best = sorted(in_threads(best_of, pairs), key=lambda one: -one[0])[:number]
    return [_pair(score, amplitudes, distribution, both, evidence) for score, amplitudes, distribution, both in best]


def _pair(score: float, amplitudes, distribution: Gaussian, both, evidence: Evidence) -> Pair:
    first, second = (replace(one, amplitude=a).candidate(evidence) for one, a in zip(both, amplitudes, strict=True))
    shifts = [one.of.at(a).mean(0) for one, a in zip(both, amplitudes, strict=True)]
    names, effects = (first.name, second.name), (first.effect, second.effect)
    return Pair(names, effects, (shifts[0], shifts[1]), score, evidence.misfit(distribution), distribution)


def closest(of: Fingerprint, evidence: Evidence, beside: np.ndarray) -> AbstractEffect:
    """The effect with the amplitude and details that describe the capture best, with `beside` shifting it, too."""

    def best_at(amplitude: float) -> tuple[float, float, int]:
        shifts = of.at(amplitude)
        covariance = distribution_of(shifts, evidence.null, of_details=False).covariance
        densities = Gaussian(np.zeros(len(beside)), covariance).log_density(evidence.z - beside - shifts)
        return float(densities.max()), amplitude, int(densities.argmax())

    _, amplitude, detail = max(in_threads(best_at, map(float, GRID)), key=lambda one: one[0])
    return made(of.maker, amplitude, detail)


def _together(alone: dict[float, Gaussian], second: Judged, null: Gaussian):
    """Amplitudes and distributions with both effects in the sensor, `alone` those of the first: all of it adds."""
    for b in PAIR_SECOND:
        other = second.of.distribution(float(b), null)
        for a, one in alone.items():
            yield (a, float(b)), Gaussian(one.mean + other.mean, one.covariance + other.covariance - null.covariance)
