"""`improve`: fit, compare, diagnose, add, refit, until nothing is left; held-out frames guard against over-fitting."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from hsnoise._core.arguments import callback, seed_of
from hsnoise._core.events import Event
from hsnoise.criticism import sentences
from hsnoise.criticism.candidates import check_candidates, check_start
from hsnoise.criticism.closing import closed, repeated_darks
from hsnoise.criticism.held_out import Judge, frames_of_darks, split_frames, split_in_words
from hsnoise.criticism.limit import NO_LIMIT, Limit, TimeIsUp
from hsnoise.criticism.outcomes import Ended, Ending
from hsnoise.criticism.resume import read_story, steps_of
from hsnoise.criticism.story import Story
from hsnoise.criticism.work import Work, additions, stage_of
from hsnoise.frames.source import as_stack
from hsnoise.model import NoiseModel
from hsnoise.simulation.portion import Portion

log = logging.getLogger(__name__)


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
    classes = [one if isinstance(one, type) else type(one) for one in candidates]
    stored = None if resume is None else read_story(resume, seed, classes)
    fitted, held_out = split_frames(Portion.of(stack), stack)
    portion = Portion.of(fitted)
    check_start(model, candidates, portion, seed)
    limit = Limit.of(max_minutes, max_steps)
    judge = Judge(portion, False, seed) if held_out is None else Judge.of(fitted, held_out, seed)
    split = split_in_words(fitted, held_out)
    work = Work(fitted, portion, judge, seed, tell, limit, model is not None)
    if close:
        repeated_darks(fitted)  # an error now, not after all the work
    work.say(Event("Fitting the first model"))
    if stored is None:
        steps = replace(work, limit=NO_LIMIT).started(work.first(model))
    else:
        steps = steps_of(stored, work.first, model)
    while (ending := limit.reached(additions(steps))) is None:
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
        keep(story)
        work.say(stage_of("closing with measured components", steps))
        before = () if held_out is None else frames_of_darks(fitted)
        try:
            found = closed(story.fit, fitted, held_out=held_out, before=before, seed=seed)
        except (RuntimeError, ValueError) as error:  # the steps were minutes of work
            return replace(story, left_open=sentences.cannot_be_closed(error))
        if found.helps:
            return replace(story, closed=found)
        return replace(story, left_open=sentences.left_open(found.before.total, found.comparison.total))
    return story
