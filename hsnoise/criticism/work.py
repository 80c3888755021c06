"""One turn of the loop: what a model lacks is added, one effect or several at once, and kept if it holds."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, TypeVar

from hsnoise._core.events import Event, counter
from hsnoise.criticism import rules, sentences
from hsnoise.criticism.acceptance import Held, is_too_little, judged, those_that_hold
from hsnoise.criticism.candidates import Suspect
from hsnoise.criticism.compare import DRAWS, Comparison, compared, with_shares
from hsnoise.criticism.diagnose import diagnosed
from hsnoise.criticism.finding import Diagnosis
from hsnoise.criticism.held_out import Judge, score_of_side
from hsnoise.criticism.limit import NO_LIMIT, Limit, TimeIsUp
from hsnoise.criticism.outcomes import (
    Ended,
    Ending,
    Improvement,
    Refusal,
    Refused,
    Side,
    Verdict,
    has_sides,
    on_side,
    side_of,
    side_shows,
)
from hsnoise.criticism.ranking import Candidate
from hsnoise.criticism.story import Step, moved
from hsnoise.effects import AbstractEffect
from hsnoise.fit import fit, rechecked
from hsnoise.fitting.result import FitResult, Method, Status, number
from hsnoise.fitting.simulated import Draft, draft_synthetic
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.portion import Portion

log = logging.getLogger(__name__)

Fit = TypeVar("Fit", FitResult, FitResult | Draft)

MOST_TRIED = 4  # effects, where none explains all
PASSING = 12  # draws to judge a model that is far off, on which nothing depends


@dataclass(frozen=True)
class Work:
    """What every step needs.

    fitted: frames to fit, and the portion of them that is drawn; judge: of additions; tell: gets events; given: whether
    the user chose the effects of the first model.
    """

    fitted: FrameStack
    portion: Portion
    judge: Judge
    seed: int
    tell: Callable[[Event], Any]
    limit: Limit = NO_LIMIT
    given: bool = False

    def say(self, event: Event) -> None:
        """Report a stage, and log it."""
        log.info("%s", event)
        self.tell(event)

    def say_refused(self, name: str, why: Refusal) -> None:
        """Report an effect that is left out."""
        self.say(Event(f"{name} is left out: {sentences.refusal(why)}"))

    def first(self, model: NoiseModel | None, follow: bool = False) -> FitResult:
        """A fit of the effects of a model; follow: of each pixel over time, whatever the frames say."""
        return fit(self.fitted, pixels="differ") if follow else fit(self.fitted, model=model)

    def seeing(self, of: FitResult) -> Work:
        """The same work for steps of this fit: without flats if the gain is unknown."""
        if of.has_gain:
            return self
        portion = self.portion.without_flats("the gain is not determined, and flats need it")
        return replace(self, portion=portion, judge=self.judge.without_flats)

    def turn(self, steps: list[Step], own: Sequence[Suspect]) -> Ending | None:
        """Diagnose the last step, and append one more, or several at once; if there is none, how the story ends.

        TimeIsUp, at the first draw after the limit, leaves `steps` unchanged, except for a diagnosis.
        """
        last = steps[-1]
        tick = self.counter(stage_of("looking for what is missing", steps))
        found = diagnosed(last.fit, self.portion, tuple(own), seed=self.seed, tick=tick)
        steps[-1] = last = replace(last, diagnosis=found)
        # If the first fit had no gain, pixels were followed from the start, if that was any better.
        if found.verdict == Verdict.UNEXPLAINED and last.fit.has_gain:
            followed = self.pixels_followed(steps)
            if followed is not None:
                steps[:] = self.seeing(followed).begun(followed)
                return None
        nearest = _to_try(found)
        if not nearest:
            return _ending(found, last.comparison)
        if is_too_little(nearest, steps):
            return Ending(Ended.FINISHED, following=(nearest[0].name, nearest[0].score))
        several = self.several_that_hold(found.together, steps)
        if several:
            steps += several
            return None
        step, refused = self.first_that_holds(nearest, steps)
        if step is None:
            return _ending(found, last.comparison, refused)
        steps.append(step)
        return None

    def counter(self, of: Event, total: int | None = None) -> Callable[[], None]:
        """Says the number of each draw, and raises TimeIsUp at the first one after the limit."""
        count = counter(self.tell, of, total)

        def tick() -> None:
            if self.limit.is_over:
                raise TimeIsUp
            count()

        return tick

    def step(self, result: FitResult, added: str | None, steps: Sequence[Step], draws: int = DRAWS) -> Step:
        """The step after `steps`; what the judge says of it is left open."""
        tick = self.counter(stage_of("comparing with the model's samples", steps), draws)
        comparison = compared(result.params, self.portion, draws=draws, seed=self.seed, tick=tick)
        comparison = with_shares(comparison, result.params, self.portion, self.seed)
        log.info("Error %s with %s", number(comparison.error), added or "the first model")
        return Step(result, comparison, None, added, moved=moved(steps[-1].fit, result) if steps else ())

    def started(self, first: FitResult) -> list[Step]:
        """The first steps of a fit or, if it has no gain, of one that follows each pixel if that comes nearer."""
        seeing = self.seeing(first)
        steps = seeing.begun(first)
        followed = None if first.has_gain else seeing.pixels_followed(steps)
        return steps if followed is None else self.seeing(followed).begun(followed)

    def begun(self, first: FitResult) -> list[Step]:
        """The first steps: the paper's model, then one by one what its fit measured beyond it."""
        draws = [*[PASSING] * len(first.added), DRAWS]
        steps = [self.step(first.without(first.added), None, [], draws[0])]
        for i, name in enumerate(first.added):
            self.say(stage_of(f"adding {name}, as measured", steps))
            steps.append(self.step(first.without(first.added[i + 1 :]), name, steps, draws[i + 1]))
        if self.judge.unseen:
            for i in {0, len(steps) - 1}:  # nothing depends on those between
                steps[i] = replace(steps[i], held_out=self.judge.score(steps[i].fit.params))
        return [*steps[:-1], replace(steps[-1], fit=replace(first, added=()))]

    def pixels_followed(self, steps: Sequence[Step]) -> FitResult | None:
        """A fit that follows each pixel, if it comes much nearer than the pooled pixels of the only step.

        It measures what frames, rows and columns share, all at once, which no single effect explains. A gain
        without doubts is not given up for it.
        """
        pooled, before = steps[-1].fit, steps[-1].comparison.error
        if len(steps) > 1 or self.given or pooled.method not in (Method.ML, Method.LINE):
            return None
        stage = stage_of("following each pixel over time", steps)
        self.say(stage)
        try:
            result = self.first(None, follow=True)
        except (RuntimeError, ValueError) as error:
            self.say(Event(f"pixels cannot be followed here: {error}"))
            return None
        if not result.added or (pooled.has_gain and not result.has_gain and pooled.trustworthy):
            return None
        judged = self.seeing(result).portion
        if judged is not self.portion:
            before = compared(pooled.params, judged, seed=self.seed).error
        after = compared(result.params, judged, seed=self.seed, tick=self.counter(stage, DRAWS)).error
        # Without a gain, pooled pixels leave the size of every effect in e- undetermined.
        if after > (rules.HALF if pooled.has_gain else 1.0) * before:
            self.say(Event(f"pixels stay pooled: following them leaves an error of {number(after)}"))
            return None
        return replace(result, status=Status.NEARER, detail=number(before))

    def first_that_holds(
        self, candidates: Sequence[Candidate], steps: list[Step]
    ) -> tuple[Step | None, dict[str, Refusal]]:
        """The first candidate with which the model is better, as a step, and why those before it were left out."""
        refused: dict[str, Refusal] = {}
        for candidate in candidates:
            judge = self.judge.of_effect(candidate.effect, self.portion)
            found = self.with_one_more(steps, candidate.effect, judge)
            if isinstance(found, Refusal):
                refused[candidate.name] = found
                self.say_refused(candidate.name, found)
                continue
            result, gain, ahead = found
            step = replace(self.step(result, candidate.name, steps), ahead=ahead)
            if judge is self.judge:  # NaN if no frames are held out
                step = replace(step, held_out=steps[-1].held_out + gain.nats, held_out_error=gain.error)
            else:
                step = replace(step, held_out=self.judge.score(step.fit.params), gained=gain.nats)
            return replace(step, fit=rechecked(step.fit, self.fitted)), refused
        return None, refused

    def several_that_hold(self, together: Sequence[Candidate], steps: list[Step]) -> list[Step]:
        """Steps with effects that were fitted at once and each hold; none if there are not several to try.

        Left out are those that need a fit or frames of their own: a likelihood, both sides of the gain, long series.
        """
        last, cfa = steps[-1], self.fitted.cfa
        may = [one.effect for one in together if not (one.effect.in_likelihood or side_shows(one.effect, cfa))]
        may = [one for one in may if self.judge.of_effect(one, self.portion) is self.judge]
        may = may[: self.limit.steps - additions(steps)]
        if len(may) < 2:
            return []
        stage = stage_of(f"adding {sentences.all_of([one.name for one in may])} at once", steps)
        self.say(stage)
        tick = self.counter(stage)

        def fitted(effects: Sequence[AbstractEffect]) -> FitResult | Draft | None:
            return self.tried(
                lambda: _fit_with(effects, steps, self, tick), sentences.all_of([one.name for one in effects])
            )

        held = those_that_hold(self.judge, last.fit, may, fitted, self.say_refused, tick)
        if held is None:
            return []
        finished = self.finished(held, steps)
        return [] if finished is None else self.one_by_one(*finished, held.names, steps)

    def finished(self, held: Held, steps: list[Step]) -> tuple[FitResult, Improvement] | None:
        """A fit with several effects and what it gains; None if that fails, or no longer holds."""
        fit, gain = held.fit, held.gain
        result = self.tried(fit.finished, sentences.all_of(held.names)) if isinstance(fit, Draft) else fit
        if result is not None and isinstance(fit, Draft) and not fit.has_settled:  # its last step may lead elsewhere
            before = steps[-1].fit
            gain = self.judge.improvement(before.params, result.params, len(result.names) - len(before.names))
        return None if result is None or not gain.holds else (result, gain)

    def one_by_one(self, result: FitResult, gain: Improvement, names: Sequence[str], steps: list[Step]) -> list[Step]:
        """Steps with effects that were fitted at once, as if they had been added one after the other."""
        found: list[Step] = []
        for i, name in enumerate(names):
            part = result.without(tuple(names[i + 1 :]))
            ahead = 0.0 if has_sides(part.params[name]) else float("nan")
            beside = tuple(other for other in names if other != name)
            found.append(replace(self.step(part, name, [*steps, *found]), ahead=ahead, beside=beside))
        last = replace(found[-1], held_out=steps[-1].held_out + gain.nats, held_out_error=gain.error)
        return [*found[:-1], replace(last, fit=rechecked(last.fit, self.fitted))]

    def with_one_more(
        self, steps: list[Step], effect: AbstractEffect, judge: Judge
    ) -> tuple[FitResult, Improvement, float] | Refusal:
        """A fit with the effect, what it gains, and by how many nats its side of the gain is ahead; or why it is none.

        `diagnose` judges the side from a biased base fit: what holds is fitted on the other, too. One gain tells none.
        """
        found = self.fitted_with(steps, effect, f"adding {effect.name}")
        ahead = 0.0 if has_sides(effect) and not side_shows(effect, self.fitted.cfa) else float("nan")
        if found is None:
            return Refusal(Refused.NOT_FITTED)
        gain = self.judged(judge, steps, found, effect.name)
        if isinstance(gain, Refusal):
            return gain
        if side_shows(effect, self.fitted.cfa):
            side = next(side for side in Side if side != side_of(effect))
            other = self.fitted_with(steps, on_side(effect, side), "the same on the other side of the gain")
            if other is not None:
                scores = [score_of_side(one.params, self.portion, self.seed) for one in (found, other)]
                ahead = abs(scores[0] - scores[1])
                if scores[1] > scores[0]:
                    found, gain = other, self.judged(judge, steps, other, effect.name)
        if isinstance(gain, Refusal):
            return gain
        result = self.tried(found.finished, effect.name) if isinstance(found, Draft) else found
        if result is None:
            return Refusal(Refused.NOT_FITTED)
        if isinstance(found, Draft) and not found.has_settled:  # its last step may lead elsewhere
            gain = self.judged(judge, steps, result, effect.name)
        return gain if isinstance(gain, Refusal) else (result, gain, ahead)

    def fitted_with(self, steps: list[Step], effect: AbstractEffect, what: str) -> FitResult | Draft | None:
        """The last model refitted with one effect more, or nearly; None if it cannot be."""
        stage = stage_of(what, steps)
        self.say(stage)
        return self.tried(lambda: _fit_with([effect], steps, self, self.counter(stage)), effect.name)

    def tried(self, fitting: Callable[[], Fit], names: str) -> Fit | None:
        """A fit; None if it fails, which is told. names: what was added."""
        try:
            return fitting()
        except (RuntimeError, ValueError) as error:
            self.say(Event(f"{names} cannot be fitted here: {error}"))
            return None

    def judged(self, judge: Judge, steps: list[Step], result: FitResult | Draft, added: str) -> Improvement | Refusal:
        """What a judge says of a fit with one effect more."""
        stage = stage_of(f"judging {added} by frames {'held out' if judge.unseen else 'that were fitted'}", steps)
        self.say(stage)
        return judged(judge, steps[-1].fit, result, added, self.counter(stage))


def additions(steps: Sequence[Step]) -> int:
    """How many effects were added, besides those that the first fit measured: no step before its model is diagnosed."""
    first = next((i for i, step in enumerate(steps) if step.diagnosis is not None), len(steps) - 1)
    return len(steps) - 1 - first


def stage_of(what: str, steps: Sequence[Step]) -> Event:
    """What is being done for the step after `steps`, and how the error has changed so far."""
    errors = sentences.errors_so_far([step.comparison.error for step in steps])
    return Event(f"Step {len(steps)}: {what}", errors)


def _to_try(found: Diagnosis) -> tuple[Candidate, ...]:
    """What to try: the effect that is named, or else the nearest ones."""
    if found.best is not None:
        alike = [one for one in found.ranking if one.name in found.names]
        return tuple(alike) if found.verdict == Verdict.AMBIGUOUS else (found.best,)
    if found.verdict == Verdict.NOTHING_MISSING:
        return ()
    names = [one.name for one in found.nearest]
    others = [one for one in found.ranking if one.score > rules.evidence(len(found.ranking)) and one.name not in names]
    return (*found.nearest, *others)[:MOST_TRIED]


def _fit_with(
    effects: Sequence[AbstractEffect], steps: list[Step], work: Work, tick: Callable[[], None]
) -> FitResult | Draft:
    """A fit of the last model and some effects more; it starts from the last fit by likelihood if possible."""
    model = reduce(NoiseModel.add, effects, steps[-1].fit.params)
    base = next((step.fit for step in reversed(steps) if step.fit.method != Method.SYNTHETIC), None)
    if base is None or any(one.in_likelihood and one.name not in base.params for one in model):
        return fit(work.fitted, model=model)
    return draft_synthetic(base, work.portion, model, seed=work.seed, tick=tick)


def _ending(found: Diagnosis, comparison: Comparison, refused: Mapping[str, Refusal] | None = None) -> Ending:
    """How the story ends where no step follows; refused: the candidates that were tried, None if none was."""
    as_chance = comparison.fits
    if refused is not None and as_chance:
        why = Ended.AS_CHANCE
    elif found.verdict == Verdict.NOTHING_MISSING:
        why = Ended.FINISHED if as_chance else Ended.WEAK_LEFT
    else:
        why = Ended.NOT_HELD if found.names else Ended.UNEXPLAINED
    return Ending(why, refused=refused or {})
