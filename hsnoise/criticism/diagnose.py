"""`diagnose`: which physical effect is missing, by the statistics that it would move.

Every candidate is drawn on top of the fitted model: its fingerprint is how it shifts and spreads the statistics. What
another choice of the base parameters could absorb is projected out. Candidates are ranked by a Gaussian synthetic
log-likelihood ratio against "nothing missing" (Wood, "Statistical inference for noisy nonlinear ecological dynamic
systems", Nature 466, 2010), and a verdict is given only if the winner also explains what is left.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from hsnoise._core.arguments import callback, seed_of, whole_number
from hsnoise._core.forking import check_not_forked
from hsnoise._core.keys import key_of, named_key
from hsnoise._core.types import RandomKey
from hsnoise.criticism import rules
from hsnoise.criticism.candidates import (
    Suspect,
    built_in,
    check_candidates,
    check_makers,
    facts_of,
    not_in,
    with_own_statistics,
)
from hsnoise.criticism.clamp import CLAMP, clamp_by_likelihood
from hsnoise.criticism.finding import WORST, Diagnosis
from hsnoise.criticism.fingerprint import Bench
from hsnoise.criticism.nearest import nearest, together
from hsnoise.criticism.outcomes import Verdict
from hsnoise.criticism.ranking import Evidence, Judged, Pair, limit_by_chance
from hsnoise.criticism.refine import WithBase
from hsnoise.criticism.search import MANY_DETAILS, Search
from hsnoise.criticism.verdict import verdict_of, what_remains
from hsnoise.fitting.result import FitResult
from hsnoise.frames.source import as_stack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import check_effects, check_fits
from hsnoise.simulation.gaussian import shrunk
from hsnoise.simulation.portion import Portion
from hsnoise.simulation.simulator import Purpose, Simulator, key_for

log = logging.getLogger(__name__)

DRAWS = 64
FEW = 2  # effects that a fit added, of which one alone may explain everything
LIKE_A_CLAMP = {CLAMP, "nonlinearity"}  # names under which a clamp appears if the fit has none


def diagnose(
    fit: FitResult, stack, *, candidates: Any = (), draws: int = DRAWS, seed: int = 0, progress=None, **keywords
) -> Diagnosis:
    """Name the physical effect that a fitted model lacks.

    A fit of differing pixels adds the effects that it measured on pixels, rows, columns and frames. If one of these
    alone explains all that the paper's model lacks, it is named; otherwise the diagnosis looks for what the whole model
    still lacks.

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
    check_not_forked()
    stack = as_stack(stack, **keywords)
    model = fit.params if isinstance(fit, FitResult) else fit
    if not isinstance(model, NoiseModel):
        raise TypeError(f"fit: expected a result of hsnoise.fit or a NoiseModel, got {type(fit).__name__}")
    check_fits(model, stack, "fit")
    candidates = not_in(model, check_candidates(candidates))
    portion = Portion.of(stack)
    check_effects(model, portion.frames)
    return diagnosed(fit, portion, candidates, draws=draws, seed=seed, tick=tick)


def diagnosed(
    fit: FitResult | NoiseModel,
    portion: Portion,
    candidates: tuple[Suspect, ...] = (),
    *,
    draws: int = DRAWS,
    seed: int,
    tick: Callable[[], None],
) -> Diagnosis:
    """What `diagnose` finds on a portion that is checked."""
    added = fit.added if isinstance(fit, FitResult) else ()
    if 0 < len(added) <= FEW:
        found = _diagnosed(fit.without(added), portion, candidates, draws, seed, tick)
        of_others = found.verdict == Verdict.NAMED and not set(found.names) <= set(added)
        if found.best is not None and found.best.name in added and not of_others:
            return found
    return _diagnosed(fit, portion, candidates, draws, seed, tick)


def _diagnosed(fit, portion: Portion, candidates, draws: int, seed: int, tick) -> Diagnosis:
    """What draws of the model show. What they show weakly, where the model fits, is judged by twice as many.

    From 64 draws, neither how statistics scatter together nor the limit of chance is known well. Where the fit measured
    pixels, lines and frames one by one, a weak finding is none: such captures are never quite the model's, so that
    scores of its draws are no limit, and what they hold beyond would show in a statistic.
    """
    found, evidence = _by_draws(fit, portion, candidates, draws, key_of("seed", seed), tick)
    if found.best is None or evidence.misfit(evidence.null) > rules.MISFIT or found.best.score > rules.MARKOV_UP_TO:
        return found
    if not isinstance(fit, FitResult) or fit.transfer is None:
        again, other = _by_draws(fit, portion, candidates, draws, named_key(key_of("seed", seed), "again"), tick)
        score = found.best.score + next((one.score for one in again.ranking if one.name == found.best.name), 0.0)
        if score > evidence.limit + other.limit:
            return found
    left = what_remains(evidence, evidence.null)
    return replace(found, verdict=Verdict.NOTHING_MISSING, best=None, names=(), advice="", unexplained=left)


def _by_draws(fit, portion: Portion, candidates, draws: int, seed: RandomKey, tick) -> tuple[Diagnosis, Evidence]:
    """A diagnosis, and what it was made from."""
    model = fit.params if isinstance(fit, FitResult) else fit
    facts = facts_of(model, portion, seed, fit.transfer if isinstance(fit, FitResult) else None)
    own = check_makers(candidates, model, portion.frames, facts)
    unseen = [one.name for one in candidates if one.name not in own]
    if unseen:
        warnings.warn(f"candidates: {', '.join(unseen)} not tried: this capture cannot show it", stacklevel=5)
    makers = {name: maker for name, maker in built_in(facts).items() if name not in own}
    log.info(
        "Drawing %d captures from the model, and each of %d candidates on top of it", draws, len(makers) + len(own)
    )
    measure = with_own_statistics(model, candidates)
    bench = Bench.of(Simulator(model, portion, key_for(seed, Purpose.DIAGNOSE), tick, measure), draws)
    slopes, base = bench.slopes(), bench.base
    has_flats = "flat" in portion.frames.kind
    null = shrunk(base.own_z(), slopes)
    evidence = Evidence(bench.z, null, base.names, base.groups, len(makers) + len(own), has_flats=has_flats)
    found, judged, evidence = _found(Search(bench, evidence, makers, own), fit, draws, seed)
    log.info("Diagnosis: %s", found.conclusion)
    log.debug("%s", found)
    if found.verdict != Verdict.UNEXPLAINED:
        return found, evidence
    prints, variance = [one.of for one in judged], np.diagonal(base.distribution.covariance)
    near = nearest(prints, found.ranking, evidence, slopes, variance)
    return replace(found, nearest=near, together=together(prints, near, evidence, slopes, variance)), evidence


def _found(search: Search, fit, draws: int, seed: RandomKey) -> tuple[Diagnosis, list[Judged], Evidence]:
    """The diagnosis, all candidates as they were judged, best first, and the evidence with its limit of chance."""
    evidence = search.evidence
    judged = search.likely(search.glance())
    log.info("Most likely at first: %s", _scores(judged[:WORST]))
    log.debug("All candidates: %s", _scores(judged))
    if evidence.least < judged[0].score < rules.MARKOV_UP_TO:
        evidence = replace(evidence, chance=_limit(judged, draws, seed, search))
        search = replace(search, evidence=evidence)
    judged, freed, pair = (judged, None, None) if search.is_in_vain(judged) else _closely(search, judged)
    ranking = [one.candidate(evidence) for one in judged]
    with_each = {one.of.name: one.of.distribution(one.amplitude, evidence.null) for one in judged[:1]}
    if freed is not None:
        ranking[0] = replace(ranking[0], effect=freed.effect)
        if freed.misfit <= judged[0].misfit:
            with_each[ranking[0].name] = freed.distribution
    found = verdict_of(ranking, pair, evidence, with_each)
    if _may_be_a_clamp(found, search.bench, evidence):
        clamp = clamp_by_likelihood(fit, search.bench, evidence)
        if clamp is not None and clamp[0].misfit < found.ranking[0].misfit:
            candidate, left, distribution = clamp
            others = [c for c in ranking if c.name != CLAMP]
            found = verdict_of(sorted([candidate, *others], key=lambda c: -c.score), None, evidence, with_each)
            if found.best is candidate:
                found = replace(found, unexplained=what_remains(left, distribution))
    return found, judged, evidence


def _closely(search: Search, judged: list[Judged]) -> tuple[list[Judged], WithBase | None, Pair | None]:
    """Candidates after a closer look at the likely ones, the first with the base fitted to it, and the best pair."""
    evidence = search.evidence
    if _leaves_something(judged[0], evidence):
        judged = search.closer(judged)
    if _leaves_something(judged[0], evidence):  # one effect alone does not do: which others could, and closer again
        judged = search.closer(search.partners(judged))
    judged, freed = search.with_its_base(judged)
    return judged, freed, search.best_pair(judged) if _leaves_something(judged[0], evidence) else None


def _leaves_something(first: Judged, evidence: Evidence) -> bool:
    """Whether the first candidate is present but does not explain everything."""
    return first.score > evidence.least and first.misfit > rules.MISFIT_LEFT


def _scores(judged: Iterable[Judged]) -> str:
    return ", ".join(f"{one.of.name} {one.score:.1f} nats" for one in judged)


def _limit(judged: list[Judged], draws: int, seed: RandomKey, search: Search) -> float:
    """Score that chance hardly ever exceeds in such a capture, from as many fresh draws of the model."""
    simulator = replace(search.bench.simulator, key=key_for(seed, Purpose.CHANCE), kept={})
    fresh = simulator.draws(simulator.model, draws)
    return limit_by_chance([one.of for one in judged], search.evidence, search.bench.base.z(fresh))


def _may_be_a_clamp(found: Diagnosis, bench: Bench, evidence: Evidence) -> bool:
    """Whether it is worth a second fit. A clamp of which nothing is known leads the fit to another gain, dark current
    and read noise, so far off that draws from there show it badly, or not at all: "nothing missing".
    """
    if found.verdict == Verdict.NOTHING_MISSING:
        return evidence.misfit(bench.base.distribution) > rules.MISFIT
    leaders = [c.name for c in found.ranking[:2] if c.score > evidence.least]
    return found.verdict == Verdict.UNEXPLAINED or not LIKE_A_CLAMP.isdisjoint(leaders)
