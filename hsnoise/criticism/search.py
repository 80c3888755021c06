"""The candidates, examined ever more closely: a glance at all, many draws of the leaders, then pairs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from hsnoise.criticism import rules
from hsnoise.criticism.candidates import given
from hsnoise.criticism.fingerprint import DRAWN_ERROR, NEARBY_ERROR, RELATIVE_ERROR, Bench
from hsnoise.criticism.outcomes import Side, has_sides, on_side, side_shows
from hsnoise.criticism.ranking import (
    CLOSE,
    LEADERS,
    Evidence,
    Judged,
    Pair,
    best_pairs,
    closest,
    judge,
    judge_all,
)
from hsnoise.criticism.refine import WithBase, refined, refined_pair, with_base
from hsnoise.effects import AbstractEffect, Maker

GLANCE, GLANCE_DETAILS = (1.0,), 2  # amplitudes and details at which all candidates are drawn,
AMPLITUDES, DETAILS = (0.35, 1.0, 2.5), 4  # and those that are likely, the user's own at once;
LIKELY, MOST_LIKELY, LEAST_LIKELY = 0.25, 10, 3  # share of the best score, and how many of them
WEAK, STRONG = 0.7, 1.4  # amplitudes from which draws at the lower or the higher one are needed, too
MOST_PAIRS = 2  # that are refined, two effects at once
NEAR = 0.8  # share of the best score that makes a candidate a leader
MANY_DETAILS = 16  # of which the leaders' best are taken
AROUND_IT = np.linspace(0.85, 1.15, 7)  # between the amplitudes that were tried, relative to that which was drawn
AROUND, CLOSE_DETAILS = (1.0,), 12  # amplitude, relative, at which the leaders are drawn again


@dataclass(frozen=True)
class Search:
    """What the candidates are drawn on and judged by; makers: of the built-in ones and of a user's `own`, by name."""

    bench: Bench
    evidence: Evidence
    makers: dict[str, Maker]
    own: dict[str, Maker]

    def glance(self) -> list[Judged]:
        """All candidates, judged by a few draws, the user's own by many; best first.

        Raises ValueError for one of the user's that changes nothing.
        """
        prints = self.bench.fingerprints({name: (maker, AMPLITUDES) for name, maker in self.own.items()}, DETAILS)
        for one in prints:
            if not one.shifts.any():
                drawn = one.shifts[..., 0].size
                raise ValueError(f"candidates: {one.name} changed no count of {drawn} captures that were drawn")
        prints += self.bench.fingerprints(
            {name: (maker, GLANCE) for name, maker in self.makers.items()}, GLANCE_DETAILS
        )
        return judge_all(prints, self.evidence)

    def likely(self, judged: list[Judged]) -> list[Judged]:
        """Candidates, with the likely ones and the resulting first judged by more draws; best first."""
        enough = LIKELY * judged[0].score
        some = [one for i, one in enumerate(judged[:MOST_LIKELY]) if i < LEAST_LIKELY or one.score > enough]
        return self.first_known(self.with_more_draws(some, judged))

    def partners(self, judged: list[Judged]) -> list[Judged]:
        """Candidates, those that may be one of two effects judged by more draws; best first."""
        names = {name for pair in best_pairs(judged, self.evidence, MOST_LIKELY) for name in pair.names}
        return self.first_known(self.with_more_draws([one for one in judged if one.of.name in names], judged))

    def first_known(self, judged: list[Judged]) -> list[Judged]:
        """Candidates, the first of them judged by more than a glance."""
        while judged[0].of.amplitudes == GLANCE:
            judged = self.with_more_draws(judged[:1], judged)
        return judged

    def with_more_draws(self, some: Iterable[Judged], judged: list[Judged]) -> list[Judged]:
        """Candidates, those of `some` that were only glanced at judged by draws at the amplitudes around theirs."""
        wanted = {}
        for one in some:
            if one.of.amplitudes == GLANCE:
                low = AMPLITUDES[:1] if one.amplitude < WEAK else ()
                high = AMPLITUDES[2:] if one.amplitude > STRONG or not low else ()
                wanted[one.of.name] = (one.of.maker, (*low, *GLANCE, *high))
        again = {one.of.name: one for one in judge_all(self.bench.fingerprints(wanted, DETAILS), self.evidence)}
        return _best_first(again.get(one.of.name, one) for one in judged)

    def is_in_vain(self, judged: list[Judged]) -> bool:
        """Whether a closer look at one or two effects is in vain: neither a leader nor a pair takes half of the misfit.

        More than two are missing then, or none of the library. Shifts of the right effect are known within some 12 %.
        """
        limit = max(rules.HALF * self.evidence.misfit(self.evidence.null), rules.MOST_LEFT)
        if min(one.misfit for one in judged[:LEADERS]) <= limit:
            return False
        return min((pair.misfit for pair in best_pairs(judged, self.evidence, LEADERS)), default=limit) >= limit

    def closer(self, judged: list[Judged]) -> list[Judged]:
        """The leaders with parameters closer to the capture: fingerprints bend, and strong effects show it.

        Those that are close already stay as they are.
        """
        near = [one for one in judged[:LEADERS] if one.score > NEAR * judged[0].score]
        leaders = [one for one in near if one.of.error == RELATIVE_ERROR]
        wanted = {one.of.name: (one.of.maker, (one.amplitude,)) for one in leaders}
        prints = self.bench.fingerprints(wanted, MANY_DETAILS)
        varied = [judge(replace(of, error=DRAWN_ERROR), self.evidence, of.amplitudes[0] * AROUND_IT) for of in prints]
        again = [self.drawn_close(one.candidate(self.evidence).effect) for one in varied]
        # Not against the leaders as they were: in few draws, rare counts seem to scatter less than they do.
        better = [max(pair, key=lambda one: one.score) for pair in zip(varied, again, strict=True)]
        names = {one.of.name for one in leaders}
        return _best_first([*better, *(one for one in judged if one.of.name not in names)])

    def drawn_close(self, effect: AbstractEffect) -> Judged:
        """An effect with parameters brought closer to the capture, judged by many draws there."""
        maker = given(*refined([effect], self.bench, self.evidence))
        (of,) = self.bench.fingerprints({effect.name: (maker, AROUND)}, CLOSE_DETAILS)
        return judge(replace(of, error=NEARBY_ERROR), self.evidence, CLOSE)

    def with_its_base(self, judged: list[Judged]) -> tuple[list[Judged], WithBase | None]:
        """The first candidate with the base fitted to it: on its side of the gain, where it has sides.

        Random details confound the side, and the base fit has already absorbed part of the effect: with the base free,
        it leaves less of the statistics, and the estimate is better. Without sides, only where something is left.
        """
        first = judged[0]
        effect = first.candidate(self.evidence).effect
        if first.score <= self.evidence.least or not (has_sides(effect) or first.misfit > rules.MISFIT_LEFT):
            return judged, None
        sides = side_shows(effect, self.bench.model.cfa)
        variants = [on_side(effect, side) for side in Side] if sides else [effect]
        found = [with_base(one, self.bench, self.evidence) for one in variants]
        best = max(found, key=lambda one: one.score)
        closer = self.drawn_close(best.start) if has_sides(effect) else first
        # Scores of many draws are lower: in few, rare counts seem to scatter less. Far lower, the search went astray:
        # the effect stands for what no particular one of its kind comes near to.
        if closer.score <= NEAR * first.score:
            left = max(first.misfit, min(closer.misfit, best.misfit))
            return [replace(first, misfit=left), *judged[1:]], None
        closer = replace(closer, misfit=min(closer.misfit, best.misfit))
        again = _best_first([closer, *judged[1:]])
        return again, best if again[0] is closer else None

    def best_pair(self, judged: list[Judged]) -> Pair | None:
        """Two effects that explain the capture together: of those that come nearest, refined one after the other."""
        makers, refined_ones = {**self.makers, **self.own}, []
        for pair in best_pairs(judged, self.evidence, MOST_PAIRS):
            if pair.score > judged[0].score + self.evidence.least:
                # Details that were chosen for one alone made up for the other: chosen again.
                prints = self.bench.fingerprints({name: (makers[name], GLANCE) for name in pair.names}, MANY_DETAILS)
                shifts = zip(prints, pair.shifts[::-1], strict=True)
                start = [closest(of, self.evidence, other) for of, other in shifts]
                refined_ones.append(refined_pair(pair, start, self.bench, self.evidence))
                if refined_ones[-1].misfit < rules.MISFIT_LEFT:
                    break
        return max(refined_ones, key=lambda one: one.score, default=None)


def _best_first(judged: Iterable[Judged]) -> list[Judged]:
    return sorted(judged, key=lambda one: -one.score)
