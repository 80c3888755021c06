"""Where `improve` ends by its limits, and what it says on the way."""

from __future__ import annotations

import importlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import hsnoise
from hsnoise._core.events import Event
from hsnoise.criticism import limit, rules
from hsnoise.criticism.outcomes import Ended, Ending
from hsnoise.criticism.story import Step
from hsnoise.criticism.work import Work, additions, stage_of

work = importlib.import_module("hsnoise.criticism.work")


def step(error: float) -> Step:
    fit = SimpleNamespace(params=hsnoise.cameras.grasshopper3(), has_gain=True)
    return Step(fit, SimpleNamespace(error=error, fits=error < rules.FITS), None, None, float("nan"), ())


@pytest.fixture
def clock(monkeypatch):
    """Time, s, that passes when it is told to."""
    now = SimpleNamespace(s=1000.0)
    monkeypatch.setattr(limit.time, "monotonic", lambda: now.s)
    monkeypatch.setattr(Work, "begun", lambda self, first: [step(26.34)])
    monkeypatch.setattr(work, "fit", lambda *_, **__: SimpleNamespace(has_gain=True))
    return now


@pytest.fixture
def stack(rng):
    counts = rng.poisson(80, (2, 4, 32, 32)).astype(np.uint16)
    return hsnoise.FrameStack(counts, [0.1, 0.2], cfa="RGGB")


def test_the_time_ends_a_diagnosis_at_the_next_draw(clock, stack, monkeypatch):
    drawn, said = [], []

    def diagnosed(*_, tick, **__):
        for i in range(100):
            drawn.append(i)
            clock.s += 30
            tick()

    monkeypatch.setattr(work, "diagnosed", diagnosed)
    story = hsnoise.improve(stack, max_minutes=2, progress=said.append)
    assert len(drawn) == 5  # the first draw beyond two minutes
    assert story.ended == "It stopped after 2 minutes; something may be left."
    assert story.errors == (26.34,) and not story.finished
    assert said[1:3] == [f"Step 1: looking for what is missing; error 26.3: {i}" for i in (1, 2)]


def test_the_time_ends_a_fit_at_the_next_draw(clock, stack, monkeypatch):
    tried = []

    def first_that_holds(self, nearest, steps):
        tried.append(nearest)
        clock.s += 121
        self.counter(Event("Step 1: adding row_noise"), 40)()

    nearest = (SimpleNamespace(name="row_noise", score=99.0),)
    found = SimpleNamespace(verdict="named", headline="", advice="", ranking=nearest, together=())
    monkeypatch.setattr(work, "diagnosed", lambda *_, **__: found)
    monkeypatch.setattr(work, "_to_try", lambda found: nearest)
    monkeypatch.setattr(Work, "first_that_holds", first_that_holds)
    story = hsnoise.improve(stack, max_minutes=2)
    assert tried == [nearest] and story.errors == (26.34,)
    assert story.steps[0].diagnosis is found and story.ending == Ending(Ended.MINUTES, 2)


def test_without_a_limit_nothing_is_ended(clock, stack, monkeypatch):
    def diagnosed(*_, tick, **__):
        clock.s += 1e9
        tick()
        return SimpleNamespace(verdict="nothing missing", best=None, headline="", advice="")

    monkeypatch.setattr(work, "diagnosed", diagnosed)
    story = hsnoise.improve(stack)
    assert story.ending.why == Ended.WEAK_LEFT and "No effect stands out" in story.ended


@pytest.mark.parametrize("minutes", [0, -1, float("nan")])
def test_a_limit_that_is_none_is_refused(minutes, stack):
    with pytest.raises(ValueError, match="max_minutes: expected minutes above 0, got"):
        hsnoise.improve(stack, max_minutes=minutes)


def test_a_stage_tells_its_step_and_the_error_until_now():
    assert str(stage_of("comparing", [])) == "Step 0: comparing"
    assert str(stage_of("looking", [step(26.34)])) == "Step 1: looking; error 26.3"
    assert str(stage_of("looking", [step(26.34), step(9.0), step(1.59)])) == "Step 3: looking; error 26.3 -> 1.59"


def test_a_limit_of_additions_counts_each_effect_but_not_what_the_first_fit_measured():
    found = SimpleNamespace()
    measured, diagnosed, later = step(26.0), replace(step(9.0), diagnosis=found), step(3.0)
    assert additions([measured]) == additions([measured, diagnosed]) == 0
    assert additions([measured, diagnosed, later]) == 1
    assert additions([measured, diagnosed, later, later, replace(later, diagnosis=found)]) == 3  # three at once


def test_flats_are_compared_if_the_fit_that_the_story_starts_from_has_a_gain(monkeypatch):
    """Pooled pixels may leave it unknown where each pixel over time, and the flats, give it."""
    without, told = object(), []
    portion = SimpleNamespace(without_flats=lambda why: without)
    followed, judge = SimpleNamespace(has_gain=True), SimpleNamespace(without_flats=None)
    monkeypatch.setattr(Work, "begun", lambda self, first: told.append((first, self.portion)) or [first])
    monkeypatch.setattr(Work, "pixels_followed", lambda self, steps: followed)
    pooled = SimpleNamespace(has_gain=False)
    assert Work(None, portion, judge, 0, print).started(pooled) == [followed]
    assert told == [(pooled, without), (followed, portion)]
