"""`improve`: fit, compare, diagnose, add, refit, until nothing is left; held-out frames guard against over-fitting."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hsnoise._core.arguments import callback, seed_of, whole_number
from hsnoise._core.events import Event, counter
from hsnoise.criticism import sentences
from hsnoise.criticism.compare import DRAWS, Comparison, compare
from hsnoise.criticism.diagnose import EVIDENCE, Diagnosis, check_candidates, diagnose, not_in
from hsnoise.criticism.held_out import log_likelihood, split_frames, split_in_words
from hsnoise.criticism.outcomes import (
    Ended,
    Ending,
    Refusal,
    Refused,
    Side,
    Verdict,
    has_sides,
    on_side,
    side_of,
)
from hsnoise.criticism.ranking import Candidate
from hsnoise.criticism.story import CHANCE_ERROR, Step, Story
from hsnoise.effects import ADC, AbstractEffect, DarkCurrent, Gain, ReadNoise, ShotNoise
from hsnoise.fit import fit, rechecked
from hsnoise.fitting.result import FitResult, Method, number
from hsnoise.fitting.simulated import fit_synthetic
from hsnoise.frames.source import as_stack
from hsnoise.frames.stack import FrameStack
from hsnoise.likelihood.physics import WITH_LIKELIHOOD
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import check_effects, check_fits, darks_of

log = logging.getLogger(__name__)

MOST_STEPS = 8
MOST_TRIED = 4  # effects, where none explains all
THERE_SIGMA = 2.0  # standard errors from 0, at least, of an effect that is added
LATE_EVIDENCE = 12.0  # nats, of an effect beside others: banding had 7 in a capture without any, its frequency chosen
NEEDED = 0.1  # share of the misfit of some group, at least, that comes back without an effect
WORSE = -2.0  # nats of held-out likelihood from which a step is taken back
CLEARLY_LESS = 0.95  # of the misfit of all groups together, where that of the worst one grows
CHANGE_OF_OTHERS = 1.25  # factor by which the worst group may grow where all groups together fit better
MOVED_SIGMA = 2.0


def improve(
    stack,
    *,
    model: NoiseModel | None = None,
    candidates: Any = (),
    max_minutes: float | None = None,
    max_steps: int | None = None,
    seed: int = 0,
    progress=None,
    keep=None,
    **keywords,
) -> Story:
    """Fit a capture, find what the model lacks, add it and refit, until nothing significant is left.

    Where no effect explains all that is missing, as in most real sensors, the one that comes nearest is added and the
    story goes on; it is told as finished only if nothing significant is left.

    Args:
        stack: a path or a list of paths, with the keywords of `hsnoise.load`; a FrameStack; or an array of counts with
            FrameStack's keywords.
        model: where to start, the model of a story that was broken off, say; default: all effects of the paper.
        candidates: effects of your own that may be added, too.
        max_minutes: after which the story ends at the next draw, with the models that were kept until then (the first
            fit is finished in any case); None: as long as it takes.
        max_steps: additions at most, beside those that the first fit measured; None: MOST_STEPS.
        seed: of all draws. progress: called with a sentence at each stage, "Step 1: adding row_noise; error 26.3", and
            again after each capture that is drawn, with a colon, its number, and "of 40" if it is known how many there
            will be. keep: called with the story so far, after each model that is kept, so that nothing is lost.

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
        seed=seed,
        keep=keep,
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
    seed: int = 0,
    keep=None,
    **keywords,
) -> Story:
    """`improve`, telling what is being done as events instead of sentences."""
    keep, seed = callback("keep", keep), seed_of("seed", seed)
    stack, candidates = as_stack(stack, **keywords), check_candidates(candidates)
    fitted, held_out = split_frames(darks_of(stack), stack)
    _check_start(model, candidates, fitted)
    limit = _Limit.of(max_minutes, max_steps)
    work, split = _Work(fitted, held_out, seed, tell, limit), split_in_words(fitted, held_out)
    work.say(Event("Fitting the first model"))
    steps = replace(work, limit=NO_LIMIT).begun(fit(fitted, model=model))
    measured = len(steps)
    while (ending := limit.reached(len(steps) - measured)) is None:
        keep(Story(tuple(steps), Ending(Ended.UNFINISHED), split))
        own = [c for c in candidates if c.name not in steps[-1].fit.params]
        try:
            ending = work.turn(steps, own)
        except _TimeIsUp:
            continue
        if ending is not None:
            break
    story = Story(tuple(steps), ending, split)
    log.info("Improved: %s", story.ended)
    return story


class _TimeIsUp(Exception):
    """The minutes of a limit are over, in the middle of a step."""


@dataclass(frozen=True)
class _Limit:
    """When the loop ends whatever is left: the time, s, and the number of additions."""

    began_s: float
    minutes: float
    steps: int

    @staticmethod
    def of(max_minutes: float | None, max_steps: int | None) -> _Limit:
        """Raises ValueError for limits that are none."""
        minutes = np.inf if max_minutes is None else float(max_minutes)
        if not minutes > 0:
            raise ValueError(f"max_minutes: expected minutes above 0, got {max_minutes}")
        steps = MOST_STEPS if max_steps is None else whole_number("max_steps", max_steps, 0)
        return _Limit(time.monotonic(), minutes, steps)

    @property
    def is_over(self) -> bool:
        """Whether the minutes have passed."""
        return time.monotonic() - self.began_s > 60 * self.minutes

    def reached(self, additions: int) -> Ending | None:
        """How the story ends where a limit is reached; None if none is."""
        if additions >= self.steps:
            return Ending(Ended.STEPS, additions)
        return Ending(Ended.MINUTES, self.minutes) if self.is_over else None


NO_LIMIT = _Limit(0.0, np.inf, MOST_STEPS)


@dataclass(frozen=True)
class _Work:
    """What every step is made of: frames to fit, frames held out, the seed, whom to tell, and when to end."""

    fitted: FrameStack
    held_out: FrameStack | None
    seed: int
    tell: Callable[[Event], Any]
    limit: _Limit = NO_LIMIT

    def say(self, event: Event) -> None:
        """Tell of a stage, and log it."""
        log.info("%s", event)
        self.tell(event)

    def turn(self, steps: list[Step], own: Sequence[AbstractEffect]) -> Ending | None:
        """Diagnose the last step, and append one more; if there is none, how the story ends.

        Raises _TimeIsUp at the first draw after the limit: `steps` are as they were then, but for a diagnosis.
        """
        last = steps[-1]
        tick = self.counter(_stage("looking for what is missing", steps))
        found = diagnose(last.fit, self.fitted, candidates=own, seed=self.seed + 1000, progress=tick)
        steps[-1] = last = replace(last, diagnosis=found)
        nearest = _nearest(found)
        if not nearest:
            return _ending(found, last.comparison)
        if _is_too_little(nearest, steps):
            return Ending(Ended.FINISHED, following=(nearest[0].name, nearest[0].score))
        step, refused = self.first_that_holds(nearest, steps)
        if step is None:
            return _ending(found, last.comparison, refused)
        steps.append(step)
        return None

    def counter(self, of: Event, total: int | None = None) -> Callable[[], None]:
        """Says the number of each draw, and raises _TimeIsUp at the first one after the limit."""
        count = counter(self.tell, of, total)

        def tick() -> None:
            if self.limit.is_over:
                raise _TimeIsUp
            count()

        return tick

    def step(self, result: FitResult, added: str | None, steps: Sequence[Step]) -> Step:
        """The step after `steps`."""
        tick = self.counter(_stage("comparing with the model's samples", steps), DRAWS)
        comparison = compare(result.params, self.fitted, seed=self.seed, progress=tick)
        log.info("Error %s with %s", number(comparison.error), added or "the first model")
        unseen = float("nan") if self.held_out is None else log_likelihood(result.params, self.held_out, self.seed)
        return Step(result, comparison, None, added, unseen, _moved(steps[-1].fit, result) if steps else ())

    def begun(self, first: FitResult) -> list[Step]:
        """The first steps: the paper's model, then one by one what its fit measured beyond it."""
        steps = [self.step(first.without(first.added), None, [])]
        for i, name in enumerate(first.added):
            self.say(_stage(f"adding {name}, as measured", steps))
            steps.append(self.step(first.without(first.added[i + 1 :]), name, steps))
        return [*steps[:-1], replace(steps[-1], fit=replace(first, added=()))]

    def first_that_holds(
        self, candidates: Sequence[Candidate], steps: list[Step]
    ) -> tuple[Step | None, dict[str, Refusal]]:
        """The first candidate with which the model is better, as a step, and why those before it were left out."""
        refused: dict[str, Refusal] = {}
        for candidate in candidates:
            step = self.with_one_more(steps, candidate)
            refusal = None if step is None else self.refusal(candidate.effect, step, steps[-1])
            if step is not None and refusal is None:
                return replace(step, fit=rechecked(step.fit, self.fitted)), refused
            refused[candidate.name] = refusal or Refusal(Refused.NOT_FITTED)
            self.say(Event(f"{candidate.name} is left out, {sentences.refusal(refused[candidate.name])}"))
        return None, refused

    def refusal(self, effect: AbstractEffect, step: Step, before: Step) -> Refusal | None:
        """Why the step with the effect is not kept; None if it is."""
        worse = _why_worse(step, before)
        if worse is not None:
            return worse
        if not _is_there(effect, step.fit):
            return Refusal(Refused.ZERO)
        return None if self.needs(effect.name, step) else Refusal(Refused.NO_CHANGE)

    def needs(self, name: str, step: Step) -> bool:
        """Whether some group fits worse without the effect: if not, what helped was that the others were refitted."""
        without = compare(step.fit.params.remove(name), self.fitted, seed=self.seed).groups
        return any(without[g] - misfit > NEEDED * max(misfit, 1.0) for g, misfit in step.comparison.groups.items())

    def with_one_more(self, steps: list[Step], candidate: Candidate) -> Step | None:
        """The model with the candidate, on the side of the gain where it fits better; None if it cannot be fitted.

        `diagnose` judges the side from a base fit that the effect has bent.
        """
        fits: list[FitResult] = []
        for effect in _sides(candidate.effect):
            is_first = effect is candidate.effect
            stage = _stage(f"adding {effect.name}" if is_first else "the same on the other side of the gain", steps)
            self.say(stage)
            try:
                fits.append(_fit_with(effect, steps, self.fitted, self.counter(stage)))
            except (RuntimeError, ValueError) as error:
                self.say(Event(f"{effect.name} cannot be fitted here: {error}"))
        if not fits:
            return None
        if len(fits) == 1:
            return self.step(fits[0], candidate.name, steps)
        values = [log_likelihood(one.params, self.fitted, self.seed) for one in fits]
        step = self.step(fits[int(np.argmax(values))], candidate.name, steps)
        return replace(step, ahead=abs(values[0] - values[1]))


def _stage(what: str, steps: Sequence[Step]) -> Event:
    """What is being done for the step after `steps`, and what became of the error until now."""
    errors = sentences.errors_so_far([step.comparison.error for step in steps])
    return Event(f"Step {len(steps)}: {what}", errors)


def _check_start(model: NoiseModel | None, candidates: tuple[AbstractEffect, ...], stack: FrameStack) -> None:
    """Raise ValueError or TypeError for a model or candidates that cannot be drawn."""
    if not candidates:
        return
    typical = [ShotNoise(), DarkCurrent(50.0), ReadNoise(3.0), Gain(1.0), ADC()]
    base = NoiseModel(typical, cfa=stack.cfa, shutter=stack.shutter, exposure_s=0.1) if model is None else model
    check_fits(base, stack, "model")
    for effect in not_in(base, candidates):
        check_effects(base.add(effect), stack)


def _why_worse(step: Step, before: Step) -> Refusal | None:
    """In which way statistics, or frames that no fit has seen, fit worse with what was added; None if they do not."""
    # Held-out frames are the last ones: effects that change from frame to frame are drawn as if they were the first.
    unseen = not (np.isnan(step.held_out) or any(effect.in_series for effect in step.fit.params))
    after, until_now = step.comparison, before.comparison
    errors = until_now.error, after.error
    if not step.fit.converged and after.error * CHANGE_OF_OTHERS > until_now.error > CHANCE_ERROR:
        return Refusal(Refused.NOT_CONVERGED, *errors)
    allowed = WORSE
    if after.error > until_now.error:
        # The worst group may be that of another effect, which is still missing and does not stand quite still.
        less = sum(after.groups.values()) < CLEARLY_LESS * sum(until_now.groups.values())
        if not less or after.error > CHANGE_OF_OTHERS * until_now.error:
            return Refusal(Refused.STATISTICS_WORSE, *errors)
        allowed = 0.0
    if unseen and step.held_out - before.held_out <= allowed:
        return Refusal(Refused.HELD_OUT_WORSE, before.held_out, step.held_out)
    return None


def _is_there(effect: AbstractEffect, result: FitResult) -> bool:
    """Whether some size of the effect is beyond chance in a fit with it.

    Sizes may be 0 and have no upper bound, unlike places and shares; of an effect without any, numbers of either sign
    count, or shares.
    """
    found = effect.parameters(result.params.channels)
    kinds = (
        [p.name for p in found if p.spec.low == 0 and p.spec.high is None],
        [p.name for p in found if p.spec.low is None],
        [p.name for p in found if p.spec.low == 0],
    )
    sizes = next((names for names in kinds if names), [])
    rows = [result.table[name] for name in sizes if name in result.names]
    return not rows or any(abs(value) > THERE_SIGMA * error for value, error, _ in rows)


def _nearest(found: Diagnosis) -> tuple[Candidate, ...]:
    """What to try: the effect that is named, or else those that explain most of what none explains alone."""
    if found.best is not None:
        alike = [one for one in found.ranking if one.name in found.names]
        return tuple(alike) if found.verdict == Verdict.AMBIGUOUS else (found.best,)
    if found.verdict == Verdict.NOTHING_MISSING:
        return ()
    names = [one.name for one in found.nearest]
    others = [one for one in found.ranking if one.score > EVIDENCE and one.name not in names]
    return (*found.nearest, *others)[:MOST_TRIED]


def _sides(effect: AbstractEffect) -> tuple[AbstractEffect, ...]:
    """The effect, and if it may arise before or after the gain, the same on the other side."""
    if not has_sides(effect):
        return (effect,)
    return effect, *(on_side(effect, side) for side in Side if side != side_of(effect))


def _is_too_little(nearest: tuple[Candidate, ...], steps: list[Step]) -> bool:
    """Whether a further effect is too weak, beside those that were chosen from the same frames, where all fits."""
    return len(steps) > 1 and steps[-1].comparison.error <= CHANCE_ERROR and nearest[0].score < LATE_EVIDENCE


def _fit_with(effect: AbstractEffect, steps: list[Step], fitted: FrameStack, tick: Callable[[], None]) -> FitResult:
    """A fit of the last model and one effect more; it goes on from the last fit by likelihood if that holds."""
    model = steps[-1].fit.params.add(effect)
    base = next((step.fit for step in reversed(steps) if step.fit.method != Method.SYNTHETIC), None)
    if base is None or any(name in WITH_LIKELIHOOD and name not in base.params for name in model.names):
        return fit(fitted, model=model)
    return fit_synthetic(base, fitted, model, progress=tick)


def _moved(before: FitResult, after: FitResult) -> tuple[str, ...]:
    moved = []
    for name in before.names:
        (old, error, unit), (new, new_error, _) = before.table[name], after.table[name]
        if abs(new - old) > MOVED_SIGMA * max(error, new_error) > 0:
            moved.append(sentences.moved(name, (old, error), (new, new_error), unit))
    return tuple(moved)


def _ending(found: Diagnosis, comparison: Comparison, refused: Mapping[str, Refusal] | None = None) -> Ending:
    """How the story ends where no step follows; refused: what was tried for one, None if nothing was."""
    as_chance = comparison.error <= CHANCE_ERROR
    if refused is not None and as_chance:
        why = Ended.AS_CHANCE
    elif found.verdict == Verdict.NOTHING_MISSING:
        why = Ended.FINISHED if as_chance else Ended.WEAK_LEFT
    else:
        why = Ended.NOT_HELD if found.names else Ended.UNEXPLAINED
    return Ending(why, refused=refused or {})
