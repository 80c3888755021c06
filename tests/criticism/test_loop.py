"""Compare, diagnose and improve: quiet on what the model explains, loud and right on what it does not."""

from __future__ import annotations

import importlib
import re
from types import SimpleNamespace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.cli.demo import simulated
from hsnoise.criticism import candidates as library
from hsnoise.criticism import rules, sentences
from hsnoise.criticism.acceptance import is_too_little
from hsnoise.criticism.compare import Comparison, nearer
from hsnoise.criticism.held_out import Judge, split_frames
from hsnoise.criticism.outcomes import Ended, Ending, Improvement, Refusal, Refused, Side, side_of
from hsnoise.criticism.story import Step, Story, together
from hsnoise.criticism.work import Work, _ending
from hsnoise.fitting.simulated import Draft
from hsnoise.simulation.draws import draw_capture
from hsnoise.simulation.portion import Portion

MODEL = hsnoise.cameras.grasshopper3(black_level_dn=64)
EXPOSURE_S = (0.02, 0.05, 0.1, 0.2)
FEW = ("row_noise", "dark_signal_nonuniformity", "frame_offset", "hot_pixels", "crosstalk", "periodic_banding")


def empty_stack(frames=4, shape=(96, 128), model=MODEL, exposure_s=EXPOSURE_S):
    """A stack that only says how a capture is taken."""
    rng = np.random.default_rng(0)
    counts = [rng.integers(60, 80, (frames, *shape)).astype(np.uint16) for _ in exposure_s]
    return hsnoise.FrameStack(counts, exposure_s, cfa=model.cfa, shutter=model.shutter)


def capture(*effects, seed=900, **layout):
    model = MODEL
    for effect in effects:
        model = model.add(effect)
    return draw_capture(seed, model, empty_stack(**layout))


@pytest.mark.slow
def test_own_samples_have_error_one():
    errors = [hsnoise.compare(MODEL, capture(seed=900 + i), draws=24).error for i in range(3)]
    assert 0.5 < np.median(errors) < 1.8
    assert max(errors) < 4


@pytest.mark.parametrize(
    ("effect", "group"),
    [
        pytest.param(fx.RowNoise(1.0), {"row x frame", "row spectrum", "noise"}, marks=pytest.mark.slow),
        pytest.param(fx.DarkSignalNonuniformity(1.5), {"static pixels", "noise"}, marks=pytest.mark.slow),
        (fx.FrameOffset(1.0), {"frames over time"}),
        pytest.param(fx.ColumnFixedPattern(1.0), {"static columns"}, marks=pytest.mark.slow),
        pytest.param(fx.HotPixels(0.01, 600.0), {"tails", "pixels over time", "static pixels"}, marks=pytest.mark.slow),
    ],
    ids=lambda x: getattr(x, "name", ""),
)
def test_hidden_effect_shows_in_its_group(effect, group):
    found = hsnoise.compare(MODEL, capture(effect), draws=24)
    assert found.error > 4 and found.p_value < 0.05
    worst = sorted(found.groups, key=found.groups.__getitem__)[-3:]
    assert group & set(worst)
    assert found.worst and "standard deviations" in found.worst[0]
    assert f"{found.error:.2f}" in str(found)


def test_likelihood_per_pixel_prefers_the_truth():
    stack = capture()
    wrong = hsnoise.cameras.grasshopper3(black_level_dn=66)
    right = hsnoise.compare(MODEL, stack, draws=8).log_likelihood_per_pixel
    assert right > hsnoise.compare(wrong, stack, draws=8).log_likelihood_per_pixel
    assert np.isnan(hsnoise.compare(MODEL.add(fx.RowNoise(0.1)), stack, draws=8).log_likelihood_per_pixel)


@pytest.mark.parametrize(
    ("effect", "name"),
    [
        (fx.RowNoise(1.0), "row_noise"),
        pytest.param(fx.DarkSignalNonuniformity(1.2), "dark_signal_nonuniformity", marks=pytest.mark.slow),
        pytest.param(fx.HotPixels(0.004, 300.0), "hot_pixels", marks=pytest.mark.slow),
    ],
)
def test_hidden_effect_is_named(effect, name, few_candidates):
    found = hsnoise.diagnose(MODEL, capture(effect), draws=40)
    assert found.verdict == "named" and found.best.name == name and found.names == (name,)
    assert found.best.p_value < 0.01
    hsnoise.sample(jax.random.key(0), np.zeros((8, 8)), MODEL.add(found.best.effect))  # ready to add


def test_clean_capture_misses_nothing(few_candidates):
    found = hsnoise.diagnose(MODEL, capture(), draws=40)
    assert found.verdict == "nothing missing" and found.best is None and found.names == ()
    assert "Nothing significant is missing" in str(found)


@pytest.mark.slow
def test_effect_outside_the_library_is_unexplained(few_candidates):
    stack = capture()
    ramp = np.rint(8 * ((np.arange(96) % 37) / 37 - 0.5))[None, :, None]
    counts = [np.asarray(c + ramp, np.int32).astype(np.uint16) for c in stack.counts]
    odd = hsnoise.FrameStack(counts, EXPOSURE_S, cfa=MODEL.cfa, shutter=MODEL.shutter)
    found = hsnoise.diagnose(MODEL, odd, draws=40)
    assert found.verdict == "unexplained" and found.best is None
    assert found.unexplained.misfit > 3 and found.unexplained.statistics


class DiagonalStreaks(hsnoise.AbstractEffect):
    """An effect of a user's: pixels of one diagonal share an offset, new in each frame."""

    name: ClassVar[str] = "diagonal_streaks"
    stage: ClassVar[hsnoise.Stage] = hsnoise.Stage.READ
    sigma: jax.Array = hsnoise.param("e-", low=0, doc="standard deviation over diagonals")

    def sample(self, signal, capture, *, key):
        frames, rows, columns = signal.shape
        offsets = jax.random.normal(key, (frames, rows + columns), signal.dtype)
        diagonal = np.arange(rows)[:, None] + np.arange(columns)[None, :]
        return signal + self.sigma * jnp.take(offsets, diagonal, axis=1)


@pytest.mark.slow
def test_effect_of_a_user_is_named(few_candidates):
    found = hsnoise.diagnose(MODEL, capture(DiagonalStreaks(1.2)), candidates=[DiagonalStreaks(1.0)], draws=40)
    assert found.best is not None and found.best.name == "diagonal_streaks"


@pytest.mark.slow
def test_added_effect_is_fitted_with_the_base():
    stack = capture(fx.RowNoise(1.0), frames=6)
    result = hsnoise.fit(stack, model=MODEL.add(fx.RowNoise(0.5)))
    assert result.method == "synthetic"
    truth = {name: value for name, (value, _, _) in MODEL.add(fx.RowNoise(1.0)).table.items()}
    for name in (*[n for n in result.names if n.startswith(("gain", "dark", "read"))], "row_noise.sigma"):
        value, error, _ = result.table[name]
        assert abs(value - truth[name]) < 4.5 * error, name
    assert result.table["row_noise.sigma"][1] < 0.2


@pytest.mark.slow
def test_improve_finds_adds_and_ends(few_candidates):
    story = hsnoise.improve(capture(fx.DarkSignalNonuniformity(1.5), frames=8))
    assert [step.added for step in story.steps] == [None, "dark_signal_nonuniformity"]
    assert story.errors[0] > 4 and story.errors[1] < 2.5
    assert "dark_signal_nonuniformity" in str(story) and "->" in str(story)
    value, error, _ = story.fit.table["dark_signal_nonuniformity.sigma"]
    assert f"dark_signal_nonuniformity.sigma = {value:.2f}"[:-1] in str(story) and error > 0
    assert re.search(r"dark_signal_nonuniformity arises (before|after) the gain\.", str(story))


@pytest.mark.parametrize(
    ("steps", "error", "score", "too_little"),
    [(1, 0.9, 7, False), (2, 0.9, 7, True), (2, 0.9, 30, False), (2, 3.0, 7, False)],
)
def test_a_further_effect_needs_more_evidence(steps, error, score, too_little):
    comparison = SimpleNamespace(error=error, fits=error < rules.FITS)
    step = SimpleNamespace(comparison=comparison, diagnosis=SimpleNamespace(ranking=[None] * 24))
    assert is_too_little((SimpleNamespace(score=score),), [step] * steps) is too_little


@pytest.mark.slow
def test_a_large_capture_keeps_its_place_on_the_sensor():
    """A strip of the frames is drawn, and a glow or taps of the whole frames stay where they are."""
    truth = MODEL.add(fx.AmplifierGlow(60.0, 0.3)).add(fx.TapOffsets(2.0, taps=8))
    stack = draw_capture(4, truth, empty_stack(frames=8, shape=(480, 640), exposure_s=EXPOSURE_S[:2]))
    comparison = hsnoise.compare(truth, stack, draws=8)
    assert comparison.error < 3
    assert any("columns" in sentence for sentence in comparison.skipped)
    assert Portion.of(stack, ("dark",)).frames.window == Portion.of(stack).darks.frames.window is not None


def test_a_capture_of_one_exposure_is_offered_no_clamp():
    darks = Portion.of(empty_stack(exposure_s=(0.1,)))
    dim = hsnoise.cameras.canon_5d3().with_value("dark_current", "rate", 50.0)
    assert "black_clamp" not in library.built_in(library.facts_of(dim, darks, 0))
    bright = MODEL.with_value("dark_current", "rate", 500.0)
    assert "black_clamp" in library.built_in(library.facts_of(bright, Portion.of(empty_stack()), 0))


@pytest.mark.slow
@pytest.mark.parametrize("after_gain", [False, True])
def test_an_offset_is_found_on_its_side_of_the_gain(few_candidates, after_gain, tmp_path):
    camera = hsnoise.cameras.canon_5d3()
    like = empty_stack(frames=8, model=camera)
    behind = draw_capture(31, camera.add(fx.RowNoise(1.5, after_gain=True)), like)
    stack = behind if after_gain else simulated(tmp_path)[0]  # the demo's, with longer exposures
    found = hsnoise.diagnose(hsnoise.fit(stack), stack)
    assert found.names == ("row_noise",)
    assert found.best.effect.after_gain is after_gain


@pytest.mark.slow
def test_improve_decides_the_side_of_the_gain_by_refits(tmp_path):
    """Whatever side `diagnose` took."""
    stack, told = simulated(tmp_path)[0], []
    steps = [Step(hsnoise.fit(stack), SimpleNamespace(error=9.0), None, None, float("nan"), ())]
    judge = Judge(Portion.of(stack), False, 0)
    work = Work(stack, Portion.of(stack), judge, 0, lambda event: told.append(str(event)))
    fit, gain, ahead = work.with_one_more(steps, fx.RowNoise(1.4, after_gain=True), judge)
    assert fit.params["row_noise"].after_gain is False and ahead > 0 and hsnoise.compare(fit, stack).fits and gain.holds
    assert any("adding row_noise" in sentence for sentence in told)
    assert any("other side of the gain" in sentence and sentence[-1].isdigit() for sentence in told)


@pytest.mark.slow
def test_what_a_clamp_leaves_is_told_by_its_refit():
    """Against the model without it, the statistics of a clamped capture are far off in many groups."""
    whole = np.asarray(MODEL["gain"].value) * float(MODEL["dark_current"].rate)
    stack = draw_capture(5, MODEL.add(fx.BlackClamp(whole)), empty_stack(frames=8))
    fit = hsnoise.fit(stack)
    found = hsnoise.diagnose(fit, stack)
    assert hsnoise.compare(fit.params, stack).error > 5
    assert found.verdict == "ambiguous" and found.names == ("black_clamp", "gain")
    assert found.unexplained.misfit < 3.5 and len(found.unexplained.statistics) < 4  # of about 300, beyond 3 by chance


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda s: hsnoise.compare(hsnoise.cameras.canon_5d3(), s), ValueError, "shutter"),
        (lambda s: hsnoise.compare("camera.json", s), TypeError, "NoiseModel"),
        (lambda s: hsnoise.compare(MODEL, s, draws=2), ValueError, "draws"),
        (lambda s: hsnoise.diagnose(MODEL, s, candidates=[3]), TypeError, "candidates"),
        (lambda s: hsnoise.diagnose(MODEL, s, candidates=[fx.Gain(2.0)]), ValueError, "gain"),
        (lambda s: hsnoise.diagnose(3, s), TypeError, "fit"),
        (lambda s: hsnoise.diagnose(MODEL, s, draws=4), ValueError, "draws"),
        (lambda s: hsnoise.compare(MODEL.remove("adc"), s), ValueError, "adc"),
        (lambda s: hsnoise.compare(MODEL, s, progress=3), TypeError, "progress: expected a function"),
        (lambda s: hsnoise.diagnose(MODEL, s, seed=-1), ValueError, "seed: expected at least 0"),
        (lambda s: hsnoise.diagnose(hsnoise.cameras.canon_5d3(), s), ValueError, "fit: made for"),
        (lambda s: hsnoise.improve(s, keep=3), TypeError, "keep: expected a function"),
        (lambda s: hsnoise.improve(s, seed=1.5), TypeError, "seed: expected a whole number"),
        (lambda s: hsnoise.improve(s, candidates=fx.RowNoise(1.0)), TypeError, "candidates"),
        (lambda s: hsnoise.fit(hsnoise.summarise(s), model=MODEL.add(fx.RowNoise(0.1))), ValueError, "frames"),
    ],
)
def test_bad_input_is_refused(call, error, message):
    with pytest.raises(error, match=message):
        call(empty_stack(frames=2, shape=(32, 32)))


def test_candidates_are_tried_until_one_holds(monkeypatch):
    effects = {"row_noise": fx.RowNoise(1.0), "frame_offset": fx.FrameOffset(1.0), "column_noise": fx.ColumnNoise(1.0)}
    effects["hot_pixels"] = fx.HotPixels(0.01, 9.0)
    candidates, told = [SimpleNamespace(name=name, effect=effect) for name, effect in effects.items()], []
    before, fit, tried = Step(None, None, None, None, held_out=-20.0), SimpleNamespace(doubts=("before",)), []
    checked = SimpleNamespace(doubts=())
    reasons = {
        "row_noise": Refusal(Refused.NOT_FITTED),
        "frame_offset": Refusal(Refused.NO_CHANGE, Improvement(0.5, 0.2, 1)),
    }

    def with_one_more(self, steps, effect, judge):
        tried.append(effect.name)
        return reasons.get(effect.name, (fit, Improvement(30.0, 2.0, 1), 9.0))

    of = importlib.import_module("hsnoise.criticism.work")
    monkeypatch.setattr(Work, "with_one_more", with_one_more)
    monkeypatch.setattr(Work, "step", lambda self, fit, added, steps: Step(fit, None, None, added))
    monkeypatch.setattr(of, "rechecked", lambda *of: checked)
    judge = SimpleNamespace(of_effect=lambda effect, portion: judge)
    work = Work(None, None, judge, 0, lambda event: told.append(str(event)))
    kept = Step(checked, None, None, "column_noise", held_out=10.0, ahead=9.0, held_out_error=2.0)
    assert work.first_that_holds(candidates, [before]) == (kept, reasons)
    assert tried == ["row_noise", "frame_offset", "column_noise"]
    assert told == [
        "row_noise is left out: could not be fitted",
        "frame_offset is left out: made no difference by itself (+0.5 ± 0.2 nats, of which chance gives 1)",
    ]
    assert work.first_that_holds(candidates[:2], [before]) == (None, reasons)


def test_what_the_frames_of_the_fit_judged_is_told(monkeypatch):
    """Frames held out then say only how likely they are."""
    fit = SimpleNamespace(params={"image_lag": fx.ImageLag(0.04)}, in_dn=lambda name: {}, doubts=())
    of = importlib.import_module("hsnoise.criticism.work")
    monkeypatch.setattr(Work, "with_one_more", lambda *of: (fit, Improvement(30.0, 2.0, 1), float("nan")))
    monkeypatch.setattr(Work, "step", lambda self, fit, added, steps: Step(fit, None, None, added))
    monkeypatch.setattr(of, "rechecked", lambda fit, frames: fit)
    judge = SimpleNamespace(of_effect=lambda effect, portion: object(), score=lambda model: -25.0)
    candidate = SimpleNamespace(name="image_lag", effect=fx.ImageLag(0.04))
    work = Work(None, None, judge, 0, lambda event: None)
    step, _ = work.first_that_holds([candidate], [Step(fit, None, None, None, held_out=-20.0)])
    assert step.held_out == -25.0 and np.isnan(step.held_out_error) and step.gained == 30.0
    assert "those of the fit are predicted better by 30.0 nats" in step.sizes[-1]


@pytest.mark.parametrize(("scores", "side"), [((5.0, 3.0), Side.BEFORE), ((3.0, 5.0), Side.AFTER)])
def test_only_what_holds_is_tried_on_the_other_side(monkeypatch, scores, side):
    of = importlib.import_module("hsnoise.criticism.work")
    score, fitted = dict(zip(Side, scores, strict=True)), []

    def fitted_with(self, steps, effect, what):
        fitted.append(side_of(effect))
        return SimpleNamespace(params=side_of(effect))

    monkeypatch.setattr(Work, "fitted_with", fitted_with)
    monkeypatch.setattr(of, "score_of_side", lambda params, portion, seed: score[params])
    colours, gain, effect = SimpleNamespace(cfa="RGGB"), Improvement(30.0, 2.0, 1), fx.RowNoise(1.0)
    work = Work(colours, None, None, 0, print)
    monkeypatch.setattr(Work, "judged", lambda *of: gain)
    fit, same, ahead = work.with_one_more([], effect, None)
    assert (fit.params, same, ahead) == (side, gain, 2.0) and fitted == list(Side)
    refusal = Refusal(Refused.NO_BETTER, Improvement(1.0, 2.0, 1))
    monkeypatch.setattr(Work, "judged", lambda *of: refusal)
    assert work.with_one_more([], effect, None) is refusal and len(fitted) == 3


def test_one_gain_does_not_tell_the_side(monkeypatch):
    monkeypatch.setattr(Work, "fitted_with", lambda self, steps, effect, what: SimpleNamespace(params=side_of(effect)))
    monkeypatch.setattr(Work, "judged", lambda *of: Improvement(30.0, 2.0, 1))
    work = Work(SimpleNamespace(cfa="mono"), None, None, 0, print)
    assert work.with_one_more([], fx.RowNoise(1.0), None)[::2] == (SimpleNamespace(params=Side.BEFORE), 0.0)
    assert np.isnan(work.with_one_more([], fx.HotPixels(0.01, 100.0), None)[2])


def test_a_side_that_cannot_be_fitted_is_not_called_as_likely(monkeypatch):
    fits = iter([SimpleNamespace(params=Side.BEFORE), None])
    monkeypatch.setattr(Work, "fitted_with", lambda *of: next(fits))
    monkeypatch.setattr(Work, "judged", lambda *of: Improvement(30.0, 2.0, 1))
    work = Work(SimpleNamespace(cfa="RGGB"), None, None, 0, print)
    assert np.isnan(work.with_one_more([], fx.RowNoise(1.0), None)[2])


def draft_of(last_step):
    return Draft(None, None, None, None, None, last_step, 5)


def test_a_fit_is_finished_only_if_it_holds_so_far(monkeypatch):
    """Its standard errors take almost half of the draws."""
    draft, whole, seen = draft_of(0.1), SimpleNamespace(), []
    refusal, gain = Refusal(Refused.NO_BETTER, Improvement(1.0, 2.0, 1)), Improvement(30.0, 2.0, 1)
    of = {id(draft): refusal}
    monkeypatch.setattr(Work, "fitted_with", lambda *of: draft)
    monkeypatch.setattr(Work, "judged", lambda self, judge, steps, fit, name: of[id(fit)])
    monkeypatch.setattr(Draft, "finished", lambda self: seen.append(self) or whole)
    work, effect = Work(SimpleNamespace(cfa="RGGB"), None, None, 0, lambda event: None), fx.HotPixels(0.01, 9.0)
    assert work.with_one_more([], effect, None) is refusal and not seen
    of[id(draft)] = gain
    assert work.with_one_more([], effect, None)[:2] == (whole, gain) and seen == [draft]
    # One that has not settled is judged again when it is finished.
    draft = draft_of(2.0)
    of = {id(draft): gain, id(whole): refusal}
    assert work.with_one_more([], effect, None) is refusal
    of[id(whole)] = better = Improvement(31.0, 2.0, 1)
    assert work.with_one_more([], effect, None)[:2] == (whole, better)

    def fails(self):
        raise ValueError("singular matrix")

    monkeypatch.setattr(Draft, "finished", fails)
    assert work.with_one_more([], effect, None) == Refusal(Refused.NOT_FITTED)


def test_the_likelier_side_of_the_gain_is_judged_and_kept(monkeypatch):
    first, other = draft_of(0.1), draft_of(0.1)
    drafts, judged = iter([first, other, first, other]), []
    gain = Improvement(30.0, 2.0, 1)
    monkeypatch.setattr(Work, "fitted_with", lambda *of: next(drafts))
    monkeypatch.setattr(Work, "judged", lambda self, judge, steps, fit, name: judged.append(fit) or gain)
    monkeypatch.setattr(Draft, "finished", lambda self: self)
    monkeypatch.setattr(Draft, "params", None)
    scores = iter([5.0, 2.0, 2.0, 6.0])
    module = importlib.import_module("hsnoise.criticism.work")
    monkeypatch.setattr(module, "score_of_side", lambda *of: next(scores))
    work = Work(SimpleNamespace(cfa="RGGB"), None, None, 0, lambda event: None)
    assert work.with_one_more([], fx.FrameOffset(2.0), None) == (first, gain, 3.0) and judged == [first]
    assert work.with_one_more([], fx.FrameOffset(2.0), None) == (other, gain, 4.0) and judged[1:] == [first, other]


def test_what_was_tried_in_vain_is_told_with_the_reason():
    refused = {
        "row_noise": Refusal(Refused.NO_BETTER, Improvement(1.2, 0.5, 0)),
        "hot_pixels": Refusal(Refused.NOT_FITTED),
    }
    found = SimpleNamespace(verdict="unexplained", names=(), headline="unexplained", advice="look at the tails")

    def ended(error):
        comparison = SimpleNamespace(error=error, fits=error < rules.FITS)
        return Story((Step(None, comparison, found, None, 0.0, ()),), _ending(found, comparison, refused))

    far, near = ended(7.0), ended(1.2)
    assert far.ending.why == Ended.UNEXPLAINED and near.ending.why == Ended.AS_CHANCE
    assert (
        "rejected: row_noise predicts the frames no better (+1.2 ± 0.5 nats); hot_pixels could not be fitted."
        in far.ended
    )
    assert "no effect of the library explains (error 7.00): look at the tails. Tried and rejected" in far.ended
    assert "error is 1.20, within chance. Tried and rejected" in near.ended


@pytest.mark.parametrize(
    ("ending", "short", "whole"),
    [
        (Ending(Ended.FINISHED), "Nothing significant is left", "Nothing significant is left (error 1.20)."),
        (
            Ending(Ended.FINISHED, following=("row_noise", 9.4)),
            "Nothing significant is left",
            "Nothing significant is left (error 1.20): row_noise would be next, with 9 nats, within chance among so"
            " many candidates.",
        ),
        (
            Ending(Ended.NOT_HELD),
            "Still missing: a or b, but no refit with it was kept",
            "Still missing: a or b, but no refit with it was kept (error 1.20).",
        ),
        (
            Ending(Ended.STEPS, 1),
            "It stopped after 1 addition; something may be left",
            "It stopped after 1 addition; something may be left.",
        ),
        (
            Ending(Ended.UNFINISHED),
            "Not finished",
            "Not finished: the last diagnosis is still running.",
        ),
    ],
)
def test_how_a_story_ended_is_told_in_short_and_whole(ending, short, whole):
    assert sentences.ended_in_short(ending, "missing: a or b") == short
    assert sentences.ended(ending, 1.2, "missing: a or b", "") == whole


@pytest.mark.parametrize(
    ("frames", "fitted", "held_out"),
    [((8, 8), (6, 6), (2, 2)), ((16, 6), (12, 4), (4, 2)), ((8, 5), (8, 5), None)],
)
@pytest.mark.parametrize("flats", [0, 3])
def test_dark_frames_are_held_out_whatever_their_numbers(frames, fitted, held_out, flats):
    counts = [np.random.default_rng(i).integers(90, 110, (n, 32, 32), np.uint16) for i, n in enumerate(frames)]
    kinds, lit = ["dark"] * 2, np.random.default_rng(9).integers(500, 600, (3, 32, 32), np.uint16)
    if flats:  # between the darks
        counts, kinds = [counts[0], lit, counts[1]], ["dark", "flat", "dark"]
    stack = hsnoise.FrameStack(counts, np.arange(len(counts)), kind=kinds, shutter="global")
    kept, unseen = split_frames(Portion.of(stack), stack)
    numbers = (fitted[0], 3, fitted[1]) if flats else fitted
    assert kept.n_frames == numbers and kept.kind == stack.kind
    assert (unseen is None) if held_out is None else (unseen.n_frames == held_out)
    if unseen is not None:
        np.testing.assert_array_equal(unseen.frame(1, 0), stack.frame(len(counts) - 1, fitted[1]))


@pytest.mark.parametrize(
    ("groups", "told"),
    [((10.0, 14.0), ""), ((1.0, 16.0), ", total misfit of all groups 25 -> 17")],
)
def test_what_fell_is_told_where_the_error_did_not(groups, told):
    def step(*groups):
        comparison = SimpleNamespace(error=max(groups), total=sum(groups))
        return Step(None, comparison, None, None, 0.0, ())

    assert together(step(10.0, 15.0), step(*groups)) == told


def test_an_addition_is_explained_by_what_it_brought_nearer():
    def found(*rows):
        table = tuple((name, "tails", 3.0, model, z) for name, model, z in rows)
        return Comparison(1.0, {}, table, (), 1.0, 0.0, ())

    # Of the last, draws only scatter more.
    before = found(("worst", 1.0, 90.0), ("its own", 2.0, -30.0), ("as before", 2.5, 5.0), ("wider", 2.0, 80.0))
    after = found(("worst", 1.1, 89.5), ("its own", 2.9, -1.0), ("as before", 2.5, 5.2), ("wider", 2.01, 22.0))
    (words,) = nearer(before, after)
    assert (
        words
        == "its own: measured 3, the model gave 2 (30 standard deviations below), with the effect 2.9 (off by 1.0)"
    )
