"""Several effects that `improve` adds at once: what is tried, and the steps that it makes of them."""

from __future__ import annotations

import importlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import hsnoise
import hsnoise.effects as fx
from hsnoise.criticism import held_out as of_frames
from hsnoise.criticism import rules
from hsnoise.criticism.acceptance import Held
from hsnoise.criticism.held_out import Judge, split_frames
from hsnoise.criticism.limit import Limit
from hsnoise.criticism.outcomes import Improvement
from hsnoise.criticism.story import Step, Story
from hsnoise.criticism.work import Work
from hsnoise.fitting.simulated import Draft
from hsnoise.report._context import steps as page_steps
from hsnoise.simulation.draws import draw_capture
from hsnoise.simulation.portion import Portion

of = importlib.import_module("hsnoise.criticism.work")

BASE = (fx.ShotNoise(), fx.DarkCurrent(20.0), fx.ReadNoise(4.0), fx.Gain(2.0), fx.BlackLevel(64.0), fx.ADC())
MODEL = hsnoise.NoiseModel(BASE, cfa="mono", shutter="global", exposure_s=0.1)
HOT, ROWS, TAILS = fx.HotPixels(0.01, 50.0), fx.RowNoise(1.5), fx.HeavyTailedReadNoise(4.0)
CLAMP, LAG = fx.BlackClamp(0.5), fx.ImageLag(0.04)
TWO = MODEL.add(HOT).add(TAILS)


def candidates(*effects):
    return [SimpleNamespace(name=effect.name, effect=effect) for effect in effects]


def comparison(error):
    return SimpleNamespace(error=error, fits=error < rules.FITS, table=(), total=error, unexplained="")


@pytest.fixture
def tried(monkeypatch):
    """What was tried at once; the steps made of it have errors that fall by a third each."""
    found = SimpleNamespace(effects=[])

    def those_that_hold(judge, before, effects, fitted, tell, tick):
        found.effects.append([effect.name for effect in effects])
        fit = fitted(effects)
        held = tuple(effect.name for effect in effects)
        return None if fit is None else Held(fit, held, Improvement(30.0, 2.0, 1))

    def step(self, result, added, steps):
        return Step(result, comparison(steps[-1].comparison.error * 2 / 3), None, added)

    def fit_with(effects, steps, work, tick):
        model = MODEL
        for effect in effects:
            model = model.add(effect)
        return SimpleNamespace(params=model, names=tuple(model.names))

    monkeypatch.setattr(of, "those_that_hold", those_that_hold)
    monkeypatch.setattr(of, "_fit_with", fit_with)
    monkeypatch.setattr(of, "rechecked", lambda fit, frames: fit)
    monkeypatch.setattr(Work, "step", step)
    monkeypatch.setattr(Work, "finished", lambda self, held, steps: _finished(held))
    return found


def _finished(held):
    def without(names):
        model = held.fit.params
        for name in names:
            model = model.remove(name)
        return SimpleNamespace(params=model, without=without, in_dn=lambda name: {}, doubts=())

    return without(()), held.gain


def work(cfa="mono", most=8):
    judge = SimpleNamespace(unseen=True, of_effect=lambda effect, portion: object() if effect.in_series else judge)
    return Work(SimpleNamespace(cfa=cfa), None, judge, 0, lambda event: None, Limit(0.0, float("inf"), most))


def first():
    return [Step(SimpleNamespace(params=MODEL, doubts=()), comparison(27.0), None, None, held_out=-20.0)]


def test_each_effect_is_a_step_of_its_own(tried):
    steps = work().several_that_hold(candidates(HOT, ROWS, TAILS), first())
    assert [step.added for step in steps] == ["hot_pixels", "row_noise", "heavy_tailed_read_noise"]
    assert [len(step.fit.params.names) - len(MODEL.names) for step in steps] == [1, 2, 3]
    assert steps[0].beside == ("row_noise", "heavy_tailed_read_noise")
    # Only the last model is judged by the frames held out.
    assert [step.held_out for step in steps[:2]] == pytest.approx([float("nan")] * 2, nan_ok=True)
    assert (steps[2].held_out, steps[2].held_out_error) == (10.0, 2.0)
    # Of one gain, the side of an offset is open.
    assert [step.ahead for step in steps] == pytest.approx([float("nan"), 0.0, float("nan")], nan_ok=True)


def test_the_story_says_what_was_fitted_together(tried):
    steps = [*first(), *work().several_that_hold(candidates(HOT, ROWS, TAILS), first())]
    story = Story(tuple(steps), of.Ending(of.Ended.UNFINISHED))
    assert page_steps(story)[0]["why"] == ["it was fitted together with row_noise and heavy_tailed_read_noise"]
    told = " ".join(story.details)
    assert "added hot_pixels, because frames are predicted worse without it" in told and "error 27 -> 18" in told
    assert "(fitted together with hot_pixels and row_noise)" in told


def test_what_needs_a_fit_or_frames_of_its_own_is_not_tried_at_once(tried):
    assert work().several_that_hold(candidates(CLAMP, LAG, HOT), first()) == []  # one alone is left
    assert work("RGGB").several_that_hold(candidates(ROWS, HOT), first()) == []  # colours tell the side
    assert not tried.effects
    work("RGGB").several_that_hold(candidates(CLAMP, HOT, LAG, ROWS, TAILS), first())
    assert tried.effects == [["hot_pixels", "heavy_tailed_read_noise"]]


def test_no_more_are_tried_at_once_than_may_be_added(tried):
    work(most=2).several_that_hold(candidates(HOT, ROWS, TAILS), first())
    assert tried.effects == [["hot_pixels", "row_noise"]]
    assert work(most=1).several_that_hold(candidates(HOT, ROWS, TAILS), first()) == []


def test_those_that_cannot_be_fitted_at_once_are_told_and_left(tried, monkeypatch):
    def fails(*_):
        raise RuntimeError("statistics of draws are not finite")

    told, like = [], work()
    monkeypatch.setattr(of, "_fit_with", fails)
    telling = Work(like.fitted, None, like.judge, 0, lambda event: told.append(str(event)))
    assert telling.several_that_hold(candidates(HOT, TAILS), first()) == []
    assert told[-1] == (
        "hot_pixels and heavy_tailed_read_noise cannot be fitted here: statistics of draws are not finite"
    )


@pytest.mark.parametrize(("last_step", "holds"), [(0.1, True), (3.0, True), (3.0, False)])
def test_a_fit_of_several_that_has_not_settled_is_judged_again(last_step, holds, monkeypatch):
    before, whole = (
        SimpleNamespace(params=MODEL, names=("gain",)),
        SimpleNamespace(params=TWO, names=("gain", "a", "b")),
    )
    gain, again, asked = Improvement(30.0, 2.0, 1), Improvement(20.0 if holds else 1.0, 2.0, 1), []
    judge = SimpleNamespace(improvement=lambda *of: asked.append(of) or again)
    monkeypatch.setattr(Draft, "finished", lambda self: whole)
    held = Held(Draft(None, None, None, None, None, last_step, 5), ("a", "b"), gain)
    found = Work(None, None, judge, 0, print).finished(held, [Step(before, None, None, None)])
    assert asked == ([] if last_step < 1 else [(MODEL, TWO, 2)])
    assert found == ((whole, again if asked else gain) if holds else None)


@pytest.mark.slow
def test_what_is_missing_is_added_at_once_and_what_is_not_is_left_out(monkeypatch):
    monkeypatch.setattr(of_frames, "DRAWS", of_frames.LEAST_DRAWS)
    true = {"row_noise": 1.5, "frame_offset": 3.0}
    bright = MODEL.add(fx.DarkCurrent(400.0))  # darks tell the gain
    truth = bright.add(fx.RowNoise(true["row_noise"])).add(fx.FrameOffset(true["frame_offset"]))
    counts = [np.random.default_rng(i).integers(60, 80, (12, 48, 64), np.uint16) for i in range(3)]
    whole = draw_capture(7, truth, hsnoise.FrameStack(counts, (0.02, 0.1, 0.2), shutter="global"))
    fitted, held_out = split_frames(Portion.of(whole), whole)
    judge, told = Judge.of(fitted, held_out, 0), []
    start = hsnoise.fit(fitted, model=bright)
    working = Work(fitted, Portion.of(fitted), judge, 0, lambda event: told.append(str(event)))
    first = replace(working.step(start, None, []), held_out=judge.score(start.params))
    tried = candidates(fx.RowNoise(2.5), fx.ColumnNoise(0.5), fx.FrameOffset(2.0))
    steps = working.several_that_hold(tried, [first])
    assert {step.added for step in steps} == true.keys()
    assert any("adding row_noise, column_noise and frame_offset at once" in stage for stage in told)
    assert any(stage.startswith("column_noise is left out: made no difference by itself") for stage in told)
    last = steps[-1]
    for name, size in true.items():
        value, error, _ = last.fit.table[f"{name}.sigma"]
        assert abs(value - size) < 3 * error < size
    assert first.comparison.error > 10 > 2 > last.comparison.error and last.held_out > first.held_out
