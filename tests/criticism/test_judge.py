"""Tests of the score by which `improve` judges an addition."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import hsnoise
import hsnoise.effects as fx
from hsnoise.criticism import held_out as of_frames
from hsnoise.criticism.acceptance import judged, those_that_hold
from hsnoise.criticism.held_out import LEAST_DRAWS, Judge, split_frames, with_flats
from hsnoise.criticism.outcomes import Improvement, Refused
from hsnoise.frames.joining import replaced
from hsnoise.simulation.draws import draw_capture
from hsnoise.simulation.portion import Portion
from hsnoise.simulation.reference import Reference

BASE = (fx.ShotNoise(), fx.DarkCurrent(20.0), fx.ReadNoise(4.0), fx.Gain(2.0), fx.BlackLevel(64.0), fx.ADC())
MODEL = hsnoise.NoiseModel(BASE, cfa="mono", shutter="global", exposure_s=0.1)
ROWS = MODEL.add(fx.RowNoise(1.5))
DRIFT = MODEL.add(fx.DarkCurrentDrift(4.0))


@pytest.fixture(autouse=True)
def few_draws(monkeypatch):
    monkeypatch.setattr(of_frames, "DRAWS", of_frames.LEAST_DRAWS)


def empty_stack(frames: int, shape: tuple[int, int] = (48, 64)) -> hsnoise.FrameStack:
    """A stack that only says how a capture is taken."""
    counts = [np.random.default_rng(i).integers(60, 80, (frames, *shape), np.uint16) for i in range(4)]
    return hsnoise.FrameStack(counts, (0.02, 0.05, 0.1, 0.2), shutter="global")


def capture(model: hsnoise.NoiseModel, frames: int = 8, seed: int = 5):
    return draw_capture(seed, model, empty_stack(frames))


def split(stack, kept: int):
    return stack.select(frames=slice(kept)), stack.select(frames=slice(kept, None))


@pytest.mark.parametrize(("truth", "other"), [(ROWS, MODEL), (MODEL, ROWS)])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_true_model_predicts_better(truth, other, seed):
    judge = Judge.of(*split(capture(truth), 6), seed)
    gain = judge.improvement(other, truth, 1)
    assert gain.holds and gain.cost == 0
    back = judge.improvement(truth, other, 1)
    assert not back.holds and back.nats == pytest.approx(-gain.nats, abs=1e-6)
    assert judge.score(truth) > judge.score(other)


def test_what_changes_nothing_is_no_better():
    judge = Judge.of(*split(capture(MODEL), 6), 0)
    assert not judge.improvement(MODEL, MODEL.add(fx.RowNoise(1e-3)), 1).holds
    assert judge.improvement(MODEL, MODEL, 0) == Improvement(0.0, 0.0, 0)


def test_a_series_goes_on_in_the_frames_held_out():
    """As if they were the first frames, a drift would not be there."""
    fitted, held_out = split(capture(DRIFT, 16), 12)
    judge = Judge.of(fitted, held_out, 0)
    assert judge.portion.before == (12, 12, 12, 12)
    assert judge.improvement(MODEL, DRIFT, 1).holds
    begun_anew = Judge(Portion.of(held_out), True, 0)
    assert begun_anew.improvement(MODEL, DRIFT, 1).nats < judge.improvement(MODEL, DRIFT, 1).nats - 10


@pytest.mark.slow
def test_two_frames_do_not_show_what_passes_from_one_to_the_next():
    bright = MODEL.add(fx.DarkCurrent(400.0))
    lag = bright.add(fx.ImageLag(0.1))
    fitted, held_out = split(capture(lag), 6)
    judge = Judge.of(fitted, held_out, 0)
    of_fitted = judge.of_effect(lag["image_lag"], Portion.of(fitted))
    assert judge.unseen and not of_fitted.unseen and of_fitted.portion.frames.n_frames == (6,) * 4
    assert of_fitted.improvement(bright, lag, 1).nats > judge.improvement(bright, lag, 1).nats + 10
    assert of_fitted.improvement(bright, lag, 1).holds
    assert judge.of_effect(fx.RowNoise(1.0), Portion.of(fitted)) is judge
    four = Judge.of(*split(capture(lag, 12), 8), 0)
    assert four.of_effect(lag["image_lag"], Portion.of(fitted)) is four


def test_later_frames_of_a_series_are_those_of_the_whole():
    whole = capture(DRIFT, 8)
    later = draw_capture(5, DRIFT, empty_stack(3), before=(5,) * 4)
    for some, all_of_them in zip(later.counts, whole.counts, strict=True):
        np.testing.assert_array_equal(some, all_of_them[5:])


def test_frames_that_a_fit_has_seen_cost_a_nat_for_each_number():
    seen = Judge(Portion.of(capture(ROWS)), False, 0)
    assert seen.improvement(MODEL, ROWS, 3).cost == 3 and not seen.unseen
    assert not Improvement(5.0, 0.1, 3).holds and Improvement(5.0, 0.1, 0).holds
    assert not Improvement(5.0, 2.0, 0).holds  # within the scatter of its simulation


def test_an_effect_must_be_better_than_the_model_and_than_itself_without_it():
    judge, ticks = Judge.of(*split(capture(ROWS), 6), 0), []

    def told(before, after, added):
        fits = (SimpleNamespace(params=model, names=()) for model in (before, after))
        return judged(judge, *fits, added, lambda: ticks.append(1))

    found = told(MODEL, ROWS, "row_noise")
    assert isinstance(found, Improvement) and len(ticks) == 2 * LEAST_DRAWS  # without it, it is the model before
    assert told(ROWS, ROWS.add(fx.FrameOffset(1e-3)), "frame_offset").why == Refused.NO_BETTER
    only_refitted = ROWS.add(fx.FrameOffset(1e-3))
    assert told(MODEL, only_refitted, "frame_offset").why == Refused.NO_CHANGE


TWO = ROWS.add(fx.FrameOffset(3.0))


def fits_of(*models):
    """A fit for each set of effects that is asked for, and what was asked for."""
    asked = []

    def fitted(effects):
        asked.append([effect.name for effect in effects])
        names = set(asked[-1])
        return next(
            SimpleNamespace(params=one, names=(*BASE_NAMES, *names)) for one in models if names < set(one.names)
        )

    return fitted, asked


BASE_NAMES = tuple(MODEL.names)


def test_of_effects_that_were_fitted_at_once_those_stay_that_hold_beside_the_others():
    judge = Judge.of(*split(capture(TWO), 6), 0)
    nothing = fx.ColumnNoise(1e-3)
    fitted, asked = fits_of(TWO, TWO.add(nothing))
    before, ticks = SimpleNamespace(params=MODEL, names=BASE_NAMES), []
    effects, told = [nothing, TWO["frame_offset"], TWO["row_noise"]], {}
    held = those_that_hold(judge, before, effects, fitted, told.__setitem__, lambda: ticks.append(1))
    assert list(told) == ["column_noise"] and told["column_noise"].why == Refused.NO_CHANGE
    assert asked == [["column_noise", "frame_offset", "row_noise"], ["frame_offset", "row_noise"]] and ticks
    assert held.fit.params is TWO and set(held.names) == {"frame_offset", "row_noise"} and held.gain.holds
    alone = {name: judge.improvement(TWO.remove(name), TWO, 1).nats for name in held.names}
    assert held.names == tuple(sorted(alone, key=alone.__getitem__, reverse=True))


def test_effects_that_only_make_up_for_one_another_do_not_stay():
    """Each holds beside the other, but both together are no better than neither."""
    judge = SimpleNamespace(improvement=lambda before, after, numbers, tick: Improvement(worth(after, before), 0.1, 0))
    before = SimpleNamespace(params=MODEL, names=BASE_NAMES)

    def worth(*models):
        after, of_before = ({"row_noise", "frame_offset"} & set(one.names) for one in models)
        return 50.0 * ((len(after) != 1) - (len(of_before) != 1))

    fitted, asked = fits_of(TWO)
    assert those_that_hold(judge, before, [TWO["row_noise"], TWO["frame_offset"]], fitted, None, lambda: None) is None
    assert len(asked) == 1
    assert those_that_hold(judge, before, [TWO["row_noise"]], lambda effects: None, None, lambda: None) is None


def test_flats_are_judged_beside_the_darks_held_out():
    lit = hsnoise.FrameStack(
        [np.random.default_rng(0).poisson(900, (3, 48, 64)).astype(np.uint16)], [0.1], kind="flat", shutter="global"
    )
    dark = capture(MODEL)
    stack = hsnoise.FrameStack.join(lit, dark)
    fitted, held_out = stack.select(frames=[slice(None), *[slice(6)] * 4]), dark.select(frames=slice(6, None))
    judge = Judge.of(fitted, held_out, 0)
    assert judge.portion.frames.kind == ("dark",) * 4 + ("flat",) and judge.portion.before == (6, 6, 6, 6, 0)
    assert judge.improvement(MODEL, ROWS, 1).cost == 1
    darks = judge.without_flats
    assert darks.portion.frames.kind == ("dark",) * 4 and darks.portion.before == (6, 6, 6, 6)
    assert darks.improvement(MODEL, ROWS, 1).cost == 0


def test_flats_are_judged_on_the_part_of_the_sensor_that_was_held_out():
    """Of large captures some columns are held out; flats of the whole sensor would count as taken elsewhere."""
    rng = np.random.default_rng(0)
    counts = [rng.integers(90, 110, (n, 64, 160)).astype(np.uint16) for n in (8, 2)]
    whole = hsnoise.FrameStack(counts, [1.0, 1.0], kind=["dark", "flat"], shutter="global")
    placed = replaced(whole, window=(0, 0, 64, 160))
    darks = placed.select(exposures=[0], columns=(40, 120))
    for of in (whole, placed):
        joined = with_flats(darks, of.select(exposures=[1]))
        assert joined.kind == ("dark", "flat") and joined.window == (0, 40, 64, 160) and joined.elsewhere is None
        np.testing.assert_array_equal(joined.counts[1], counts[1][:, :, 40:120])
    assert with_flats(whole.select(exposures=[0]), whole.select(exposures=[1])).shape == (64, 160)
    fitted, held_out = split_frames(Portion(darks, (), chosen=(0,)), whole)
    assert Judge.of(fitted, held_out, 0).portion.frames.kind == ("dark", "flat")


@pytest.mark.parametrize(
    ("nats", "error", "draws"),
    [(2.0, 9.0, [40]), (60.0, 9.0, [40]), (15.0, 9.0, [40, 80]), (9.0, 9.0, [40, 80, 160]), (-5.0, 9.0, [40])],
)
def test_more_is_drawn_only_where_draws_do_not_tell(nats, error, draws, monkeypatch):
    made = []

    def improvement(simulator, before, after, number, cost):
        made.append(number)
        return Improvement(nats, error * 40 / number, cost)

    monkeypatch.setattr(of_frames, "_improvement", improvement)
    Judge.of(*split(capture(MODEL), 6), 0).improvement(MODEL, ROWS, 1)
    assert made == draws


def reference_of(draws):
    names = tuple(map(str, range(draws.shape[1])))
    return Reference.of(names, names, draws, np.full(draws.shape[1], 0.01))


def test_statistics_that_are_copies_count_once_and_others_each():
    rng = np.random.default_rng(1)
    alone, shared = rng.normal(size=(400, 5)), rng.normal(size=(400, 1))
    of = reference_of(np.hstack([alone, np.repeat(shared, 4, 1) + 1e-3 * rng.normal(size=(400, 4))]))
    np.testing.assert_allclose(of_frames.own_shares(of), [1.0] * 5 + [0.25] * 4, atol=0.05)
    # As a likelihood of the independent ones, and one copy.
    values, weight = np.array([1.0, -2.0, 0.5, 0.0, 3.0, 1.5, 1.5, 1.5, 1.5]), of_frames.own_shares(of)
    one = reference_of(of.draws[:, :6])
    difference = of_frames.weighted_score(of, values, weight) - of_frames.weighted_score(
        one, values[:6], of_frames.own_shares(one)
    )
    assert abs(difference) < 0.5


def test_chance_makes_a_gain_of_three_nats_in_five_percent_at_most():
    """Of two models that are as near, by draws alone: a likelihood ratio beyond c nats has probability exp(-c)."""
    rng, beyond = np.random.default_rng(2), 0
    mixing = np.linalg.cholesky(0.4 + 0.6 * np.eye(30))
    for _ in range(400):
        old, new = (reference_of(rng.normal(size=(200, 30)) @ mixing.T + of) for of in (0.0, 0.15))
        values, weight = mixing @ rng.normal(size=30), of_frames.own_shares(old, new)
        scores = [of_frames.weighted_score(one, values, weight) for one in (old, new)]
        beyond += scores[1] - scores[0] > np.log(20)
    assert beyond <= 0.05 * 400
