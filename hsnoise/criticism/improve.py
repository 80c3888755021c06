"""`improve`: fit, compare, diagnose, add, refit, until nothing is left; held-out frames guard against over-fitting."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from hsnoise._core.arguments import callback, seed_of
from hsnoise._core.events import Event, counter
from hsnoise.criticism import rules, sentences
from hsnoise.criticism.acceptance import is_too_little, judged
from hsnoise.criticism.candidates import Suspect, check_candidates, check_start
from hsnoise.criticism.closing import closed, repeated_darks
from hsnoise.criticism.compare import DRAWS, Comparison, compared, with_shares
from hsnoise.criticism.diagnose import diagnosed
from hsnoise.criticism.finding import Diagnosis
from hsnoise.criticism.held_out import Judge, frames_of_darks, score_of_side, split_frames, split_in_words
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
from hsnoise.criticism.resume import read_steps
from hsnoise.criticism.story import Step, Story, moved
from hsnoise.effects import AbstractEffect
from hsnoise.fit import fit, rechecked
from hsnoise.fitting.result import FitResult, Method, Status, number
from hsnoise.fitting.simulated import Draft, draft_synthetic
from hsnoise.frames.source import as_stack
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.portion import Portion

log = logging.getLogger(__name__)

Fit = TypeVar("Fit", FitResult, FitResult | Draft)

MOST_TRIED = 4  # effects, where none explains all
PASSING = 12  # draws to judge a model that is far off, on which nothing depends


def improve(
    stack,
    *,
    model: NoiseModel | None = None,
    candidates: Any = (),
    max_minutes: float | None = None,
    max_steps: int | None = None,
    close: bool = False,
    seed: int = 0,
    progress=None,
    keep=None,
    resume: str | os.PathLike | None = None,
    **keywords,
) -> Story:
    """Fit a capture, find what the model lacks, add it and refit, until nothing significant is left.

    If no effect explains all that is missing, as in most real sensors, the nearest one is added and the story goes on.
    It counts as finished only if nothing significant is left.

    Args:
        stack: a path or a list of paths, with the keywords of `hsnoise.load`; a FrameStack; or an array of counts with
            FrameStack's keywords.
        model: where to start, such as the model of an interrupted story; default: all effects of the paper.
        candidates: effects of your own that may be added, too, classes or instances as `diagnose` takes them.
        max_minutes: after which the story ends at the next draw, with the models kept until then (the first fit is
            always finished); None: as long as it takes.
        max_steps: most additions, besides those that the first fit measured; None: MOST_STEPS.
        close: whether to close the last model with measured components (`Story.closed`), judged by the frames held out;
            it takes a minute or two more, whatever max_minutes says.
        seed: of all draws. progress: called with a sentence at each stage, "Step 1: adding row_noise; error 26.3", and
            again after each capture that is drawn, with a colon, its number, and "of 40" if it is known how many there
            will be. keep: called with the story so far, after each model that is kept, so that nothing is lost.
        resume: file of a story (`hsnoise.criticism.write_story`) of these frames that goes on, with the same model and
            seed, to the end that it would have reached; max_steps then counts its additions, too.

    Raises:
        FileNotFoundError, TypeError, ValueError: bad input, before any long work.
    """
    say = callback("progress", progress)
    return improved(
        stack,
        lambda event: say(str(event)),
        model=model,
        candidates=candidates,
        max_minutes=max_minutes,
        max_steps=max_steps,
        close=close,
        seed=seed,
        keep=keep,
        resume=resume,
        **keywords,
    )


def improved(
    stack,
    tell: Callable[[Event], Any],
    *,
    model: NoiseModel | None = None,
    candidates: Any = (),
    max_minutes: float | None = None,
    max_steps: int | None = None,
    close: bool = False,
    seed: int = 0,
    keep=None,
    resume: str | os.PathLike | None = None,
    **keywords,
) -> Story:
    """`improve`, reporting progress as events instead of sentences."""
    keep, seed = callback("keep", keep), seed_of("seed", seed)
    stack, candidates = as_stack(stack, **keywords), check_candidates(candidates)
    darks = Portion.of(stack).darks.frames
    fitted, held_out = split_frames(darks, stack)
    portion = Portion.of(fitted)
    check_start(model, candidates, portion, seed)
    limit = Limit.of(max_minutes, max_steps)
    judge = Judge(portion, False, seed) if held_out is None else Judge.of(fitted, held_out, seed)
    split = split_in_words(fitted, held_out)
    work = _Work(fitted, portion, judge, seed, tell, limit, model is not None)
    if close:
        repeated_darks(fitted)  # an error now, not after all the work
    work.say(Event("Fitting the first model"))
    if resume is None:
        steps = replace(work, limit=NO_LIMIT).started(work.first(model))
    else:
        classes = [one if isinstance(one, type) else type(one) for one in candidates]
        steps = read_steps(resume, work.first, model, seed, classes)
    while (ending := limit.reached(sum(step.diagnosis is not None for step in steps[:-1]))) is None:
        keep(Story(tuple(steps), Ending(Ended.UNFINISHED), split, seed=seed))
        own = [c for c in candidates if c.name not in steps[-1].fit.params]
        try:
            ending = work.seeing(steps[-1].fit).turn(steps, own)
        except TimeIsUp:
            continue
        if ending is not None:
            break
    story = Story(tuple(steps), ending, split, seed=seed)
    log.info("Improved: %s", story.ended)
    if close:
        work.say(_stage("closing with measured components", steps))
        before = () if held_out is None else frames_of_darks(fitted)
        try:
            found = closed(story.fit, fitted, held_out=held_out, before=before, seed=seed)
        except (RuntimeError, ValueError) as error:  # the steps were minutes of work
            return replace(story, left_open=sentences.cannot_be_closed(error))
        if found.helps:
            return replace(story, closed=found)
        return replace(story, left_open=sentences.left_open(found.before.total, found.comparison.total))
    return story


@dataclass(frozen=True)
class _Work:
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

    def first(self, model: NoiseModel | None, follow: bool = False) -> FitResult:
        """A fit of the effects of a model; follow: of each pixel over time, whatever the frames say."""
        return fit(self.fitted, pixels="differ") if follow else fit(self.fitted, model=model)

    def seeing(self, of: FitResult) -> _Work:
        """The same work for steps of this fit: without flats if the gain is unknown."""
        if of.has_gain:
            return self
        portion = self.portion.without_flats("the gain is not determined, and flats need it")
        return replace(self, portion=portion, judge=self.judge.without_flats)

    def turn(self, steps: list[Step], own: Sequence[Suspect]) -> Ending | None:
        """Diagnose the last step, and append one more; if there is none, how the story ends.

        TimeIsUp, at the first draw after the limit, leaves `steps` unchanged, except for a diagnosis.
        """
        last = steps[-1]
        tick = self.counter(_stage("looking for what is missing", steps))
        found = diagnosed(last.fit, self.portion, tuple(own), seed=self.seed, tick=tick)
        steps[-1] = last = replace(last, diagnosis=found)
        # If the first fit had no gain, pixels were followed from the start, if that was any better.
        if found.verdict == Verdict.UNEXPLAINED and last.fit.has_gain:
            followed = self.pixels_followed(steps)
            if followed is not None:
                steps[:] = self.seeing(followed).begun(followed)
                return None
        nearest = _nearest(found)
        if not nearest:
            return _ending(found, last.comparison)
        if is_too_little(nearest, steps):
            return Ending(Ended.FINISHED, following=(nearest[0].name, nearest[0].score))
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
        tick = self.counter(_stage("comparing with the model's samples", steps), draws)
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
            self.say(_stage(f"adding {name}, as measured", steps))
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
        stage = _stage("following each pixel over time", steps)
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
                self.say(Event(f"{candidate.name} is left out: {sentences.refusal(found)}"))
                continue
            result, gain, ahead = found
            step = replace(self.step(result, candidate.name, steps), ahead=ahead)
            if judge is self.judge:  # NaN if no frames are held out
                step = replace(step, held_out=steps[-1].held_out + gain.nats, held_out_error=gain.error)
            else:
                step = replace(step, held_out=self.judge.score(step.fit.params), gained=gain.nats)
            return replace(step, fit=rechecked(step.fit, self.fitted)), refused
        return None, refused

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
        result = self.tried(found.finished, effect) if isinstance(found, Draft) else found
        if result is None:
            return Refusal(Refused.NOT_FITTED)
        if isinstance(found, Draft) and not found.has_settled:  # its last step may lead elsewhere
            gain = self.judged(judge, steps, result, effect.name)
        return gain if isinstance(gain, Refusal) else (result, gain, ahead)

    def fitted_with(self, steps: list[Step], effect: AbstractEffect, what: str) -> FitResult | Draft | None:
        """The last model refitted with one effect more, or nearly; None if it cannot be."""
        stage = _stage(what, steps)
        self.say(stage)
        return self.tried(lambda: _fit_with(effect, steps, self, self.counter(stage)), effect)

    def tried(self, fitting: Callable[[], Fit], effect: AbstractEffect) -> Fit | None:
        """A fit; None if it fails, which is told."""
        try:
            return fitting()
        except (RuntimeError, ValueError) as error:
            self.say(Event(f"{effect.name} cannot be fitted here: {error}"))
            return None

    def judged(self, judge: Judge, steps: list[Step], result: FitResult | Draft, added: str) -> Improvement | Refusal:
        """What a judge says of a fit with one effect more."""
        stage = _stage(f"judging {added} by frames {'held out' if judge.unseen else 'that were fitted'}", steps)
        self.say(stage)
        return judged(judge, steps[-1].fit, result, added, self.counter(stage))


def _stage(what: str, steps: Sequence[Step]) -> Event:
    """What is being done for the step after `steps`, and how the error has changed so far."""
    errors = sentences.errors_so_far([step.comparison.error for step in steps])
    return Event(f"Step {len(steps)}: {what}", errors)


def _nearest(found: Diagnosis) -> tuple[Candidate, ...]:
    """What to try: the effect that is named, or else the nearest ones."""
    if found.best is not None:
        alike = [one for one in found.ranking if one.name in found.names]
        return tuple(alike) if found.verdict == Verdict.AMBIGUOUS else (found.best,)
    if found.verdict == Verdict.NOTHING_MISSING:
        return ()
    names = [one.name for one in found.nearest]
    others = [one for one in found.ranking if one.score > rules.evidence(len(found.ranking)) and one.name not in names]
    return (*found.nearest, *others)[:MOST_TRIED]


def _fit_with(effect: AbstractEffect, steps: list[Step], work: _Work, tick: Callable[[], None]) -> FitResult | Draft:
    """A fit of the last model and one effect more; it starts from the last fit by likelihood if possible."""
    model = steps[-1].fit.params.add(effect)
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
