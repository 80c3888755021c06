"""`improve`: fit, compare, diagnose, add, refit, until nothing is left; held-out frames guard against over-fitting."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hsnoise._core.arguments import callback, counter, seed_of, whole_number
from hsnoise._core.types import unit_in_words
from hsnoise.criticism.candidates import Suspect, facts_of
from hsnoise.criticism.compare import DRAWS, Comparison, compare
from hsnoise.criticism.diagnose import EVIDENCE, Diagnosis, check_candidates, check_makers, diagnose, not_in
from hsnoise.criticism.held_out import log_likelihood, split_frames, told_of
from hsnoise.criticism.ranking import Candidate
from hsnoise.criticism.story import CHANCE_ERROR, FINISHED, Step, Story
from hsnoise.effects import ADC, AbstractEffect, DarkCurrent, Gain, ReadNoise, ShotNoise
from hsnoise.fit import fit, rechecked
from hsnoise.fitting.result import FitResult, number, rounded
from hsnoise.fitting.simulated import fit_synthetic
from hsnoise.frames.source import as_stack
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import check_fits, darks_of

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
UNFINISHED = "Not finished: whether something is missing was being looked for."


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
        candidates: effects of your own that may be added, too, classes or instances as `diagnose` takes them.
        max_minutes: after which the story ends at the next draw, with the models that were kept until then (the first
            fit is finished in any case); None: as long as it takes.
        max_steps: additions at most, beside those that the first fit measured; None: MOST_STEPS.
        seed: of all draws. progress: called with a sentence at each stage, "Step 1: adding row_noise; error 26.3", and
            again after each capture that is drawn, with a colon, its number, and "of 40" if it is known how many there
            will be. keep: called with the story so far, after each model that is kept, so that nothing is lost.

    Raises:
        FileNotFoundError, TypeError, ValueError: bad input, before any long work.
    """
    tell, keep, seed = callback("progress", progress), callback("keep", keep), seed_of("seed", seed)
    stack, candidates = as_stack(stack, **keywords), check_candidates(candidates)
    fitted, held_out = split_frames(darks_of(stack), stack)
    _check_start(model, candidates, fitted)
    limit = _Limit.of(max_minutes, max_steps)
    work, split = _Work(fitted, held_out, seed, tell, limit), told_of(fitted, held_out)
    work.say("Fitting the first model")
    steps = replace(work, limit=NO_LIMIT).begun(fit(fitted, model=model))
    measured = len(steps)
    while not (ended := limit.reached(len(steps) - measured)):
        keep(Story(tuple(steps), UNFINISHED, split))
        own = [c for c in candidates if c.name not in steps[-1].fit.params]
        try:
            ended = work.turn(steps, own)
        except _TimeIsUp:
            continue
        if ended:
            break
    log.info("Improved: %s", ended)
    return Story(tuple(steps), ended, split)


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

    def reached(self, additions: int) -> str:
        """How the story ends where a limit is reached; empty if none is."""
        if additions < self.steps and not self.is_over:
            return ""
        limit, what = (additions, "addition") if additions >= self.steps else (self.minutes, "minute")
        return f"It stopped after {limit:g} {what}{'' if limit == 1 else 's'}; something may be left."


NO_LIMIT = _Limit(0.0, np.inf, MOST_STEPS)


@dataclass(frozen=True)
class _Work:
    """What every step is made of: frames to fit, frames held out, the seed, whom to tell, and when to end."""

    fitted: FrameStack
    held_out: FrameStack | None
    seed: int
    tell: Callable[[str], None]
    limit: _Limit = NO_LIMIT

    def say(self, text: str) -> None:
        """Tell of a stage, and log it."""
        log.info("%s", text)
        self.tell(text)

    def turn(self, steps: list[Step], own: Sequence[Suspect]) -> str:
        """Diagnose the last step, and append one more; if there is none, why the story ends.

        Raises _TimeIsUp at the first draw after the limit: `steps` are as they were then, but for a diagnosis.
        """
        last = steps[-1]
        tick = self.counter(_stage("looking for what is missing", steps))
        found = diagnose(last.fit, self.fitted, candidates=own, seed=self.seed + 1000, progress=tick)
        steps[-1] = last = replace(last, diagnosis=found)
        nearest = _nearest(found)
        if not nearest:
            return _end(found, last.comparison)
        if _is_too_little(nearest, steps):
            return _would_be_next(nearest[0], last.comparison)
        step, refused = self.first_that_holds(nearest, steps)
        if step is None:
            return _left_out(refused, found, last.comparison)
        steps.append(step)
        return ""

    def counter(self, text: str, total: int | None = None) -> Callable[[], None]:
        """Says the number of each draw, and raises _TimeIsUp at the first one after the limit."""
        count = counter(self.tell, text, total)

        def tick() -> None:
            if self.limit.is_over:
                raise _TimeIsUp
            count()

        return tick

    def step(self, result: FitResult, added: str | None, steps: Sequence[Step]) -> Step:
        """The step behind `steps`."""
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
    ) -> tuple[Step | None, dict[str, str]]:
        """The first candidate with which the model is better, as a step, and why those before it were left out."""
        refused: dict[str, str] = {}
        for candidate in candidates:
            step = self.with_one_more(steps, candidate)
            reason = "could not be fitted" if step is None else self.refusal(candidate.effect, step, steps[-1])
            if not reason:
                return replace(step, fit=rechecked(step.fit, self.fitted)), refused
            refused[candidate.name] = reason
            self.say(f"{candidate.name} is left out, {reason}")
        return None, refused

    def refusal(self, effect: AbstractEffect, step: Step, before: Step) -> str:
        """Why the step with the effect is not kept, in words; empty if it is."""
        worse = _why_worse(step, before)
        if worse:
            return worse
        if not _is_there(effect, step.fit):
            return "came out compatible with zero"
        return "" if self.needs(effect.name, step) else "changed nothing by itself"

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
            text = _stage(f"adding {effect.name}" if is_first else "the same on the other side of the gain", steps)
            self.say(text)
            try:
                fits.append(_fit_with(effect, steps, self.fitted, self.counter(text)))
            except (RuntimeError, ValueError) as error:
                self.say(f"{effect.name} cannot be fitted here: {error}")
        if not fits:
            return None
        if len(fits) == 1:
            return self.step(fits[0], candidate.name, steps)
        values = [log_likelihood(one.params, self.fitted, self.seed) for one in fits]
        step = self.step(fits[int(np.argmax(values))], candidate.name, steps)
        return replace(step, ahead=abs(values[0] - values[1]))


def _stage(what: str, steps: Sequence[Step]) -> str:
    """What is being done for the step behind `steps`, and what became of the error until now."""
    errors = [number(step.comparison.error) for step in steps]
    return f"Step {len(steps)}: {what}" + (
        f"; error {' -> '.join(dict.fromkeys([errors[0], errors[-1]]))}" if errors else ""
    )


def _check_start(model: NoiseModel | None, candidates: tuple[Suspect, ...], stack: FrameStack) -> None:
    """Raise ValueError or TypeError for a model or candidates that cannot be drawn."""
    if not candidates:
        return
    typical = [ShotNoise(), DarkCurrent(50.0), ReadNoise(3.0), Gain(1.0), ADC()]
    base = NoiseModel(typical, cfa=stack.cfa, shutter=stack.shutter, exposure_s=0.1) if model is None else model
    check_fits(base, stack, "model")
    check_makers(not_in(base, candidates), base, stack, facts_of(base, stack))


def _why_worse(step: Step, before: Step) -> str:
    """In which way statistics, or frames that no fit has seen, fit worse with what was added; empty if they do not."""
    # Held-out frames are the last ones: effects that change from frame to frame are drawn as if they were the first.
    unseen = not (np.isnan(step.held_out) or any(effect.in_series for effect in step.fit.params))
    gained, after, until_now = step.held_out - before.held_out, step.comparison, before.comparison
    went = f"{number(until_now.error)} -> {number(after.error)}"
    if not step.fit.converged and after.error * CHANGE_OF_OTHERS > until_now.error > CHANCE_ERROR:
        return f"no fit with it converged, and the error hardly fell ({went})"
    allowed = WORSE
    if after.error > until_now.error:
        # The worst group may be that of another effect, which is still missing and does not stand quite still.
        less = sum(after.groups.values()) < CLEARLY_LESS * sum(until_now.groups.values())
        if not less or after.error > CHANGE_OF_OTHERS * until_now.error:
            return f"statistics fit worse with it (error {went})"
        allowed = 0.0
    return f"held-out frames fit worse with it, by {-gained:.1f} nats" if unseen and gained <= allowed else ""


def _is_there(effect: AbstractEffect, result: FitResult) -> bool:
    """Whether some amplitude of the effect is beyond chance in a fit with it; one that fits hold, whether it is set.

    Of an effect that marks none, numbers that may be 0 and have no upper bound count, or else those of either sign, or
    shares.
    """
    found = effect.parameters(result.params.channels)
    kinds = (
        [p for p in found if p.spec.amplitude],
        [p for p in found if p.spec.low == 0 and p.spec.high is None],
        [p for p in found if p.spec.low is None],
        [p for p in found if p.spec.low == 0],
    )
    amplitudes = next((some for some in kinds if some), [])
    fitted = [p.spec.from_absent(*result.table[p.name][:2]) for p in amplitudes if p.name in result.names]
    if not fitted:
        return not amplitudes or any(p.spec.from_absent(p.value)[0] != 0 for p in amplitudes)
    return any(abs(off) > THERE_SIGMA * error for off, error in fitted)


def _left_out(refused: dict[str, str], found: Diagnosis, comparison: Comparison) -> str:
    tried = "; ".join(f"{name} {reason}" for name, reason in refused.items())
    said = f"What was tried is left out: {tried}."
    if comparison.error <= CHANCE_ERROR:
        return f"Nothing more could be added, and the error is {comparison.error:.2f}, as chance gives. {said}"
    return f"{_end(found, comparison)} {said}"


def _nearest(found: Diagnosis) -> tuple[Candidate, ...]:
    """What to try: the effect that is named, or else those that explain most of what none explains alone."""
    if found.best is not None:
        alike = [one for one in found.ranking if one.name in found.names]
        return tuple(alike) if found.verdict == "ambiguous" else (found.best,)
    if found.verdict == "nothing missing":
        return ()
    names = [one.name for one in found.nearest]
    others = [one for one in found.ranking if one.score > EVIDENCE and one.name not in names]
    return (*found.nearest, *others)[:MOST_TRIED]


def _sides(effect: AbstractEffect) -> tuple[AbstractEffect, ...]:
    """The effect, and if it may arise before or behind the gain, the same on the other side."""
    if not hasattr(effect, "after_gain"):
        return (effect,)
    return effect, replace(effect, **{"after_gain": not effect.after_gain})


def _is_too_little(nearest: tuple[Candidate, ...], steps: list[Step]) -> bool:
    """Whether a further effect is too weak, beside those that were chosen from the same frames, where all fits."""
    return len(steps) > 1 and steps[-1].comparison.error <= CHANCE_ERROR and nearest[0].score < LATE_EVIDENCE


def _would_be_next(candidate: Candidate, comparison: Comparison) -> str:
    return (
        f"{FINISHED} (error {comparison.error:.2f}): {candidate.name} would be next, by {candidate.score:.0f} nats, as"
        " chance gives among so many."
    )


def _fit_with(effect: AbstractEffect, steps: list[Step], fitted: FrameStack, tick: Callable[[], None]) -> FitResult:
    """A fit of the last model and one effect more; it goes on from the last fit by likelihood if that holds."""
    model = steps[-1].fit.params.add(effect)
    base = next((step.fit for step in reversed(steps) if step.fit.method != "synthetic"), None)
    if base is None or any(one.in_likelihood and one.name not in base.params for one in model):
        return fit(fitted, model=model)
    return fit_synthetic(base, fitted, model, progress=tick)


def _moved(before: FitResult, after: FitResult) -> tuple[str, ...]:
    moved = []
    for name in before.names:
        (old, error, unit), (new, new_error, _) = before.table[name], after.table[name]
        if abs(new - old) > MOVED_SIGMA * max(error, new_error) > 0:
            words = f"{name} moved from {rounded(old, error)[0]} to {rounded(new, new_error)[0]}"
            moved.append(f"{words} {unit_in_words(unit)}".rstrip() + ".")
    return tuple(moved)


def _end(found: Diagnosis, comparison: Comparison) -> str:
    if found.verdict == "nothing missing":
        if comparison.error > CHANCE_ERROR:
            return f"No effect stands out, but something weak may be left: the error is {comparison.error:.2f}."
        return f"{FINISHED} (error {comparison.error:.2f})."
    if found.names:
        return f"Still {found.headline}, but no refit with it held (error {comparison.error:.2f})."
    advice = f": {found.advice}" if found.advice else ""
    return f"Something is left that no effect of the library explains (error {comparison.error:.2f}){advice}."
