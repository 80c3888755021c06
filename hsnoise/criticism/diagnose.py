"""`diagnose`: which physical effect is missing, by the statistics that it would move.

Every candidate is drawn on top of the fitted model: its fingerprint is how it shifts and spreads the statistics. What
another choice of the base parameters could absorb is projected out. Candidates are ranked by a Gaussian synthetic
log-likelihood ratio against "nothing missing" (Wood, "Statistical inference for noisy nonlinear ecological dynamic
systems", Nature 466, 2010), and a verdict is given only if the winner also explains what is left.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from hsnoise._core.arguments import callback, listed, seed_of, whole_number
from hsnoise.criticism.candidates import Suspect, built_in, can_be_proposed, facts_of, given, made, proposed
from hsnoise.criticism.clamp import CLAMP, clamp_by_likelihood
from hsnoise.criticism.finding import MISFIT_LEFT, WORST, Diagnosis, Unexplained
from hsnoise.criticism.fingerprint import Bench
from hsnoise.criticism.gaussian import Gaussian, shrunk
from hsnoise.criticism.nearest import nearest
from hsnoise.criticism.ranking import (
    CLOSE,
    EVIDENCE,
    LEADERS,
    Candidate,
    Evidence,
    Judged,
    Pair,
    best_pairs,
    closest,
    judge,
    limit_by_chance,
)
from hsnoise.criticism.reference import measure, reference
from hsnoise.criticism.refine import refined, refined_pair, with_base
from hsnoise.effects import AbstractEffect, CaptureFacts, Maker
from hsnoise.fitting.result import FitResult
from hsnoise.frames.source import as_stack
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import check_effects, check_fits, part_of

log = logging.getLogger(__name__)

DRAWS = 64
GLANCE, GLANCE_DETAILS = (1.0,), 2  # amplitudes and details at which all candidates are drawn,
AMPLITUDES, DETAILS, MOST_LIKELY = (0.35, 1.0, 2.5), 4, 10  # and those that are most likely
MOST_PAIRS = 3  # that are refined, two effects at once
NEAR = 0.8  # share of the best score that makes a candidate a leader
MANY_DETAILS = 16  # of which the leaders' best are taken
AROUND, CLOSE_DETAILS = (0.6, 1.0, 1.6), 10  # amplitudes, relative, at which the leaders are drawn again
SURE = 40.0  # nats that need no comparison with what chance gives
CHANCE_SEEDS = 50_000  # of the draws for that, beyond the seed
MISFIT = 4.5  # normal score of the worst group from which something is there
# What the winner may leave of it: fingerprints of strong effects are known to some percent only.
SHARE_LEFT, MOST_LEFT = 0.05, 10.0
NEAR_ENOUGH = 0.5  # share of the misfit that an effect may leave to be called a part of the explanation
AMBIGUOUS = 3.0  # log-likelihood ratio between two names
FEW = 2  # effects that a fit put in, of which one alone may be all that there is
LIKE_A_CLAMP = {CLAMP, "nonlinearity"}  # what a clamp looks like from a fit that does not know of it


def diagnose(
    fit: FitResult, stack, *, candidates: Any = (), draws: int = DRAWS, seed: int = 0, progress=None, **keywords
) -> Diagnosis:
    """Name the physical effect that a fitted model lacks.

    A fit where pixels differ has put in by itself what it measured of them, of rows, columns and frames. If one of
    these effects explains all that the paper's model lacks, it is the one that is named; else the whole model is asked
    what it lacks still.

    Args:
        fit: result of `hsnoise.fit` on this capture, or one like it (a NoiseModel is taken, too).
        stack: a path or a list of paths, with the keywords of `hsnoise.load`; a FrameStack; or an array of counts with
            FrameStack's keywords. Darks, and flats if there are any.
        candidates: effects of your own that take part beside the built-in ones: classes with a `propose`, which know
            their sizes, or ready-made instances, which are tried at several sizes around their own.
        draws: captures drawn from the fitted model; seed: of all draws.
        progress: called with no argument after each capture that is drawn.

    Raises:
        FileNotFoundError, TypeError, ValueError: what `load` or `FrameStack` refuse; fit and stack do not belong
            together; a candidate is no effect, is in the model, or returns what is no signal of a sensor (another
            shape, NaN, numbers of another unit).
    """
    tick = callback("progress", progress)
    draws, seed = whole_number("draws", draws, MANY_DETAILS), seed_of("seed", seed)
    stack = as_stack(stack, **keywords)
    if isinstance(fit, FitResult) and fit.added:
        options = {"candidates": candidates, "draws": draws, "seed": seed, "progress": progress}
        if len(fit.added) <= FEW:
            found = diagnose(fit.without(fit.added), stack, **options)
            if found.best is not None and found.best.name in fit.added:
                return found
        return diagnose(replace(fit, added=()), stack, **options)
    model = fit.params if isinstance(fit, FitResult) else fit
    if not isinstance(model, NoiseModel):
        raise TypeError(f"fit: expected a result of hsnoise.fit or a NoiseModel, got {type(fit).__name__}")
    check_fits(model, stack, "fit")
    candidates = not_in(model, check_candidates(candidates))
    part = part_of(stack)
    check_effects(model, part)
    facts = facts_of(model, part)
    own = check_makers(candidates, model, part, facts)
    unseen = [one.name for one in candidates if one.name not in own]
    if unseen:
        warnings.warn(f"candidates: {', '.join(unseen)} not tried: this capture cannot show it", stacklevel=2)
    makers = {name: maker for name, maker in built_in(facts).items() if name not in own}
    log.info(
        "Drawing %d captures from the model, and each of %d candidates on top of it", draws, len(makers) + len(own)
    )
    bench = Bench(model, part, reference(model, part, draws, seed, tick), seed, tick)
    slopes = bench.slopes()
    null = shrunk(bench.base.own_z(), slopes)
    z = bench.base.z(measure(part, model).values)
    evidence = Evidence(z, null, bench.base.names, bench.base.groups, len(makers) + len(own))
    judged = _looked_at(_glance(makers, own, bench, evidence), MOST_LIKELY, bench, evidence)
    log.info("Most likely at first: %s", _scores(judged[:WORST]))
    log.debug("All candidates: %s", _scores(judged))
    pair = None
    if EVIDENCE < judged[0].score < SURE:
        evidence = replace(evidence, limit=_limit(judged, draws, bench, evidence))
    if judged[0].score > EVIDENCE and judged[0].misfit > MISFIT_LEFT:
        judged = _partners_looked_at(judged, bench, evidence)
        judged = _closer(judged, bench, evidence)
    judged, estimate = _on_its_side(judged, bench, evidence)
    if judged[0].score > EVIDENCE and judged[0].misfit > MISFIT_LEFT:
        pair = _best_pair(judged, {**makers, **own}, bench, evidence)
    ranking = [one.candidate(evidence) for one in judged]
    if estimate is not None:
        ranking[0] = replace(ranking[0], effect=estimate)
    laws = {one.of.name: one.of.law(one.amplitude, evidence.null) for one in judged}
    found = _verdict(ranking, pair, evidence, laws)
    if _may_be_a_clamp(found, bench, evidence):
        clamp = clamp_by_likelihood(fit, bench, evidence)
        if clamp is not None:
            candidate, left, law = clamp
            others = [c for c in ranking if c.name != CLAMP]
            found = _verdict(sorted([candidate, *others], key=lambda c: -c.score), None, evidence, laws)
            if found.best is candidate:
                found = replace(found, unexplained=_what_remains(left, law))
    log.info("Diagnosis: %s", found.conclusion)
    log.debug("%s", found)
    if found.verdict != "unexplained":
        return found
    prints = [one.of for one in judged]
    return replace(
        found, nearest=nearest(prints, found.ranking, evidence, slopes, np.diagonal(bench.base.law.covariance))
    )


def _scores(judged: Iterable[Judged]) -> str:
    return ", ".join(f"{one.of.name} {one.score:.1f} nats" for one in judged)


def _limit(judged: list[Judged], draws: int, bench: Bench, evidence: Evidence) -> float:
    """Score that chance gives in hardly any capture like this one, from as many fresh draws of the model."""
    fresh = reference(bench.model, bench.part, draws, bench.seed + CHANCE_SEEDS, bench.tick)
    return limit_by_chance([one.of for one in judged], evidence.null, bench.base.z(fresh.draws))


def _may_be_a_clamp(found: Diagnosis, bench: Bench, evidence: Evidence) -> bool:
    """Whether it is worth a second fit. A clamp of which nothing is known leads the fit to another gain, dark current
    and read noise, so far off that draws from there tell of it badly, or not at all: "nothing missing".
    """
    if found.verdict == "nothing missing":
        return evidence.misfit(bench.base.law) > MISFIT
    leaders = [c.name for c in found.ranking[:2] if c.score > EVIDENCE]
    return found.verdict == "unexplained" or not LIKE_A_CLAMP.isdisjoint(leaders)


def _best_first(judged: Iterable[Judged]) -> list[Judged]:
    return sorted(judged, key=lambda one: -one.score)


def _glance(makers: dict[str, Maker], own: dict[str, Maker], bench: Bench, evidence: Evidence) -> list[Judged]:
    """All candidates, judged by a few draws, the user's own by many; best first."""
    prints = bench.fingerprints({name: (maker, AMPLITUDES) for name, maker in own.items()}, DETAILS)
    for one in prints:
        if not one.shifts.any():
            drawn = one.shifts[..., 0].size
            raise ValueError(f"candidates: {one.name} changed no count of {drawn} captures that were drawn")
    prints += bench.fingerprints({name: (maker, GLANCE) for name, maker in makers.items()}, GLANCE_DETAILS)
    return _best_first(judge(of, evidence) for of in prints)


def _looked_at(judged: list[Judged], at_least: int, bench: Bench, evidence: Evidence) -> list[Judged]:
    """Candidates, the first of them (`at_least` so many) judged by draws at several amplitudes; best first."""
    while True:
        glanced = [one for one in judged[:at_least] if one.of.amplitudes == GLANCE]
        if not glanced:
            return judged
        judged = _at_amplitudes(glanced, judged, bench, evidence)
        at_least = 1


def _partners_looked_at(judged: list[Judged], bench: Bench, evidence: Evidence) -> list[Judged]:
    """Candidates, those that may be one of two effects judged by draws at several amplitudes; best first."""
    likely = {name for pair in best_pairs(judged, evidence, MOST_LIKELY) for name in pair.names}
    glanced = [one for one in judged if one.of.name in likely and one.of.amplitudes == GLANCE]
    return _looked_at(_at_amplitudes(glanced, judged, bench, evidence), 1, bench, evidence)


def _at_amplitudes(some: list[Judged], judged: list[Judged], bench: Bench, evidence: Evidence) -> list[Judged]:
    """Candidates, some of them judged again by draws at several amplitudes; best first."""
    prints = bench.fingerprints({one.of.name: (one.of.maker, AMPLITUDES) for one in some}, DETAILS)
    again = {of.name: judge(of, evidence) for of in prints}
    return _best_first(again.get(one.of.name, one) for one in judged)


def _closer(judged: list[Judged], bench: Bench, evidence: Evidence) -> list[Judged]:
    """The leading candidates with parameters closer to the capture: fingerprints bend, and strong effects show it."""
    leaders = [one for one in judged[:LEADERS] if one.score > NEAR * judged[0].score]
    wanted = {one.of.name: (one.of.maker, (one.amplitude,)) for one in leaders}
    varied = [judge(of, evidence, np.array(of.amplitudes)) for of in bench.fingerprints(wanted, MANY_DETAILS)]
    again = [_drawn_close(one.candidate(evidence).effect, bench, evidence) for one in varied]
    # Not against the leaders as they were: of few draws, rare counts seem to scatter less than they do.
    better = [max(pair, key=lambda one: one.score) for pair in zip(varied, again, strict=True)]
    return _best_first([*better, *judged[len(leaders) :]])


def _drawn_close(effect: AbstractEffect, bench: Bench, evidence: Evidence) -> Judged:
    """An effect with parameters brought closer to the capture, judged by many draws around them."""
    maker = given(*refined([effect], bench, evidence))
    (of,) = bench.fingerprints({effect.name: (maker, AROUND)}, CLOSE_DETAILS)
    return judge(of, evidence, CLOSE)


def _on_its_side(judged: list[Judged], bench: Bench, evidence: Evidence) -> tuple[list[Judged], AbstractEffect | None]:
    """The first candidate before or behind the gain, where it describes the capture better, the base fitted to it.

    Among random details the side goes with what else was drawn; on a base that the effect has bent, they differ little.
    The base took a part of the effect for noise of its own: the estimate with another base is the better one, too.
    """
    first = judged[0]
    effect = first.candidate(evidence).effect
    if first.score <= EVIDENCE or not hasattr(effect, "after_gain"):
        return judged, None
    sides = [replace(effect, **{"after_gain": side}) for side in (False, True)]
    found = [(*with_base(one, bench, evidence), one) for one in sides]
    _, estimate, start = max(found, key=lambda one: one[0])
    closer = _drawn_close(start, bench, evidence)
    # Scores of many draws are lower: rare counts seem to scatter less in few. Far lower, the search has gone astray.
    if closer.score <= NEAR * first.score:
        return judged, None
    again = _best_first([closer, *judged[1:]])
    return again, estimate if again[0] is closer else None


def _best_pair(judged: list[Judged], makers: dict[str, Maker], bench: Bench, evidence: Evidence) -> Pair | None:
    """Two effects that explain the capture together: of those that come nearest, refined one after the other."""
    refined_ones: list[Pair] = []
    for pair in best_pairs(judged, evidence, MOST_PAIRS):
        if pair.score > judged[0].score + EVIDENCE:
            # Details that were chosen for one alone are those that made up for the other: chosen again.
            prints = bench.fingerprints({name: (makers[name], GLANCE) for name in pair.names}, MANY_DETAILS)
            start = [closest(of, evidence, other) for of, other in zip(prints, pair.shifts[::-1], strict=True)]
            refined_ones.append(refined_pair(pair, start, bench, evidence))
            if refined_ones[-1].misfit < MISFIT_LEFT:
                break
    return max(refined_ones, key=lambda one: one.score, default=None)


def check_candidates(candidates: Any) -> tuple[Suspect, ...]:
    """The candidates of a user. Raises TypeError unless they are effects, ValueError for two of one name."""
    if isinstance(candidates, AbstractEffect) or _is_effect_class(candidates):
        raise TypeError(f"candidates: expected a list of effects, got one effect, {candidates.name}")
    candidates = listed("candidates", candidates, "a list of effects")
    for effect in candidates:
        if _is_effect_class(effect) and not can_be_proposed(effect):
            raise TypeError(
                f"candidates: expected effects that are instances, or classes with a propose; {effect.__name__} is a"
                " class without one"
            )
        if not isinstance(effect, AbstractEffect) and not _is_effect_class(effect):
            raise TypeError(f"candidates: expected effects (of AbstractEffect), got {effect!r}")
    names = [effect.name for effect in candidates]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise ValueError(f"candidates: {', '.join(sorted(twice))} given more than once")
    return candidates


def _is_effect_class(candidate: Any) -> bool:
    return isinstance(candidate, type) and issubclass(candidate, AbstractEffect)


def check_makers(
    candidates: tuple[Suspect, ...], model: NoiseModel, part: FrameStack, facts: CaptureFacts
) -> dict[str, Maker]:
    """Makers of a user's candidates, by name, less what the capture cannot show.

    Raises TypeError for a `propose` that gives no such effect, ValueError for draws that are no signal of a sensor.
    """
    makers = proposed(candidates, facts)
    for one in candidates:
        if one.name in makers:
            effect = made(makers[one.name], 1.0, 0)
            if getattr(effect, "name", None) != one.name:
                raise TypeError(f"candidates: expected {one.name}.propose to make {one.name} effects, got {effect!r}")
            check_effects(model.add(effect), part)
    return makers


def not_in(model, candidates: tuple[Suspect, ...]) -> tuple[Suspect, ...]:
    """The candidates. Raises ValueError for one that the model has."""
    for effect in candidates:
        if effect.name in model:
            raise ValueError(f"candidates: {effect.name} is in the model already")
    return candidates


def _verdict(ranking: list[Candidate], pair: Pair | None, evidence: Evidence, laws: dict[str, Gaussian]) -> Diagnosis:
    """laws: of the statistics with each candidate in the sensor."""
    worst = evidence.misfit(evidence.null)
    allowed = min(max(MISFIT_LEFT, SHARE_LEFT * worst), MOST_LEFT)
    first, second = ranking[0], ranking[1] if len(ranking) > 1 else None
    names: tuple[str, ...] = (first.name,)
    left, law = first.misfit, laws.get(first.name, evidence.null)
    # A second effect is told if the first leaves more than it may, or if the two leave nothing.
    limit = min(left, allowed if left > allowed else MISFIT_LEFT)
    if pair is not None and pair.score > first.score + EVIDENCE and pair.misfit < limit:
        left, names, law = pair.misfit, pair.names, pair.law
        found = dict(zip(names, pair.effects, strict=True))
        ranking = [replace(c, effect=found.get(c.name, c.effect)) for c in ranking]
        ranking = sorted(ranking, key=lambda c: names.index(c.name) if c.name in names else len(names))
        first = ranking[0]
    verdict = "named"
    if first.score <= evidence.limit and worst <= MISFIT:
        verdict = "nothing missing"
    elif first.score <= evidence.limit or left > allowed:
        verdict = "unexplained"
    elif first.effect.confounded_with and not evidence.has_flats:
        verdict, names = "ambiguous", (first.name, first.effect.confounded_with)
    elif len(names) == 1 and second is not None and first.score - second.score < AMBIGUOUS:
        verdict, names = "ambiguous", (first.name, second.name)
    partly = first.score > evidence.limit and left < NEAR_ENOUGH * worst
    if verdict == "nothing missing" or (verdict == "unexplained" and not partly):
        law = evidence.null
    blamed, remaining = _what_remains(evidence, evidence.null).group, _what_remains(evidence, law)
    partner = names if partly else ()
    if verdict in ("nothing missing", "unexplained"):
        names = ()
    return Diagnosis(
        ranking=tuple(ranking),
        verdict=verdict,
        best=first if names else None,
        names=names,
        advice=_advice(verdict, names or partner, first, blamed, remaining.group),
        unexplained=remaining,
    )


def _what_remains(evidence: Evidence, law: Gaussian) -> Unexplained:
    scores, z = law.normal_scores(evidence.z, evidence.groups), law.standardised(evidence.z)
    worst = max(scores, key=scores.__getitem__)
    order = [i for i in np.argsort(-np.abs(z)) if abs(z[i]) > 3][:WORST]
    statistics = tuple(f"{evidence.names[i]} (z = {z[i]:+.1f})" for i in order)
    return Unexplained(scores[worst], worst, statistics)


def _advice(verdict: str, names: tuple[str, ...], first: Candidate, blamed: str, left: str) -> str:
    """blamed, left: the groups of statistics that are worst before and after what comes nearest."""
    if verdict == "ambiguous":
        return first.effect.decided_by or f"more frames would tell {names[0]} from {names[1]}"
    if verdict == "unexplained" and names:
        told = f"{' and '.join(names)} would explain part of the {blamed} statistics"
        beside = "what is left of them" if left == blamed else f"the {left} statistics that are left"
        return f"{told}; no effect in the library explains {beside}"
    if verdict == "unexplained":
        return f"none of the effects in the library explains the {blamed} statistics, and none comes near"
    return ""
