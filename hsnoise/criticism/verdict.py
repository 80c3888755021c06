"""What is said of a ranking: nothing missing, named, ambiguous or unexplained, and what remains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hsnoise.criticism import rules, sentences
from hsnoise.criticism.finding import WORST, Diagnosis, Unexplained
from hsnoise.criticism.outcomes import Verdict
from hsnoise.criticism.ranking import Candidate, Evidence, Pair
from hsnoise.simulation.gaussian import Gaussian

FAR = 3.0  # deviations from which a statistic is listed among what remains


def verdict_of(
    ranking: list[Candidate], pair: Pair | None, evidence: Evidence, with_each: dict[str, Gaussian]
) -> Diagnosis:
    """The diagnosis of a ranking; with_each: distribution of the statistics with each candidate in the sensor."""
    worst = evidence.misfit(evidence.null)
    allowed = min(max(rules.MISFIT_LEFT, rules.SHARE_LEFT * worst), rules.MOST_LEFT)
    first, second = ranking[0], ranking[1] if len(ranking) > 1 else None
    names: tuple[str, ...] = (first.name,)
    left, explained = first.misfit, with_each.get(first.name, evidence.null)
    # A second effect is named if the first leaves more than it may, or if the two leave nothing.
    limit = min(left, allowed if left > allowed else rules.MISFIT_LEFT)
    if pair is not None and pair.score > first.score + evidence.least and pair.misfit < limit:
        left, names, explained = pair.misfit, pair.names, pair.distribution
        found = dict(zip(names, pair.effects, strict=True))
        ranking = [replace(c, effect=found.get(c.name, c.effect)) for c in ranking]
        ranking = sorted(ranking, key=lambda c: names.index(c.name) if c.name in names else len(names))
        first = ranking[0]
    verdict = Verdict.NAMED
    if first.score <= evidence.limit and worst <= rules.MISFIT:
        verdict = Verdict.NOTHING_MISSING
    elif first.score <= evidence.limit or left > allowed:
        verdict = Verdict.UNEXPLAINED
    elif first.effect.confounded_with and not evidence.has_flats:
        verdict, names = Verdict.AMBIGUOUS, (first.name, first.effect.confounded_with)
    elif len(names) == 1 and second is not None and first.score - second.score < rules.AMBIGUOUS:
        verdict, names = Verdict.AMBIGUOUS, (first.name, second.name)
    partly = first.score > evidence.limit and left < rules.HALF * worst
    if verdict == Verdict.NOTHING_MISSING or (verdict == Verdict.UNEXPLAINED and not partly):
        explained = evidence.null
    blamed, remaining = what_remains(evidence, evidence.null).group, what_remains(evidence, explained)
    partner = names if partly else ()
    if verdict in (Verdict.NOTHING_MISSING, Verdict.UNEXPLAINED):
        names = ()
    return Diagnosis(
        ranking=tuple(ranking),
        verdict=verdict,
        best=first if names else None,
        names=names,
        advice=_advice(verdict, names or partner, first, blamed, remaining.group),
        unexplained=remaining,
    )


def what_remains(evidence: Evidence, explained: Gaussian) -> Unexplained:
    """The worst group and the statistics that are far off, where the statistics are distributed like `explained`."""
    scores, z = explained.normal_scores(evidence.z, evidence.groups), explained.standardised(evidence.z)
    worst = max(scores, key=scores.__getitem__)
    order = [i for i in np.argsort(-np.abs(z)) if abs(z[i]) > FAR][:WORST]
    statistics = tuple(f"{evidence.names[i]} (z = {z[i]:+.1f})" for i in order)
    return Unexplained(scores[worst], worst, statistics)


def _advice(verdict: Verdict, names: tuple[str, ...], first: Candidate, blamed: str, left: str) -> str:
    """blamed, left: the groups of statistics that are worst before and after what comes nearest."""
    if verdict == Verdict.AMBIGUOUS:
        return first.effect.decided_by or sentences.more_frames(names)
    if verdict == Verdict.UNEXPLAINED:
        return sentences.partly_explained(names, blamed, left) if names else sentences.not_explained(blamed)
    return ""
