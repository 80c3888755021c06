"""A model closed with measured components reproduces a sensor whose pixels differ wildly, on frames it has not seen."""

from __future__ import annotations

import importlib
from functools import lru_cache

import dask.array as da
import jax
import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.cli.main import main
from hsnoise.criticism.closing import closed
from hsnoise.criticism.measured_curve import with_response
from hsnoise.criticism.shares import Share, in_words
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import draw_capture

FEW = ("row_noise",)
EXPOSURES_S = (0.0, 2.0)
BASE = [fx.ShotNoise(), fx.DarkCurrent(30.0), fx.ReadNoise(4.0), fx.Gain(1.5), fx.BlackLevel(100.0), fx.ADC()]
WILD = [
    fx.DarkCurrentNonuniformity(0.8),
    fx.HotPixels(0.01, 400.0),
    fx.DarkSignalNonuniformity(2.0),
    fx.ColumnFixedPattern(1.5),
    fx.RowFixedPattern(0.5),
    fx.ReadNoiseNonuniformity(0.3),
    fx.RandomTelegraphNoise(0.02, 25.0),
    fx.RowNoise(1.0, 1.0),
    fx.ColumnNoise(0.8, 0.5),
    fx.FrameOffset(0.5),
]


def model_of(*effects, cfa="mono"):
    return NoiseModel(effects, cfa=cfa, shutter="global", exposure_s=1.0)


@lru_cache
def wild_sensor(cfa="mono", frames=12, shape=(128, 160), most=None):
    """Every second frame of a sensor with so many of the WILD effects, and the others."""
    blank = [(np.arange(frames * shape[0] * shape[1]) % 50021).astype(np.uint16).reshape(frames, *shape)] * len(
        EXPOSURES_S
    )
    like = hsnoise.FrameStack(blank, EXPOSURES_S, cfa=cfa, shutter="global")
    whole = draw_capture(77, model_of(*BASE, *WILD[:most], cfa=cfa), like)
    return tuple(whole.with_counts([of[half::2] for of in whole.counts], None) for half in (0, 1))


@pytest.fixture(scope="module")
def wild():
    seen, held_out = wild_sensor()
    return closed(model_of(*BASE, fx.RowGain(0.05, 0.0), fx.DarkSignalNonuniformity(9.0)), seen, held_out=held_out)


def test_the_budget_of_held_out_frames_is_reproduced(wild):
    for share in wild.shares:
        off = abs(share.measured_dn2 - share.closed_dn2)
        # Six frames and some hundred lines say little of what is common to many pixels.
        allowed = {"frame": 0.6, "row": 0.25, "column": 0.12}.get(share.component, 0.02)
        assert off < 4 * share.error_dn2 + allowed * share.measured_dn2, share
    left = wild.largest_unexplained
    assert left is None or left.unexplained_of_total < 0.02


def test_the_maps_are_those_of_the_sensor(wild):
    seen, held_out = wild_sensor()
    bias, long = (of.mean(0) for of in held_out.counts)
    whole = wild.params["measured_map"]
    assert (
        np.corrcoef(np.log(np.maximum(long - bias, 1)).ravel(), np.log(whole.dark_current + 0.01).ravel())[0, 1] > 0.9
    )
    assert np.corrcoef(bias.ravel(), np.asarray(whole.offset).ravel())[0, 1] > 0.55
    # The levels tell it within 2 %, and what is noise of it and what is pedestal the noise of six frames.
    assert float(wild.params["dark_current"].rate) == pytest.approx((long - bias).mean() / (2 * 1.5), rel=0.04)


def test_patterns_of_any_sensor_go_and_false_effects_too(wild):
    assert wild.replaced == ("dark_signal_nonuniformity",) and wild.overshot == ("row_gain",)
    assert "dark_signal_nonuniformity" not in wild.params and wild.named["row_gain"].sigma == 0.05
    assert "Measured whole, because the named effect does not match: row_gain" in str(wild)
    assert "dark_signal_nonuniformity is all of the static variance" not in wild.static
    assert f"({wild.before.error:.3g} with the names alone)" in wild.summary and "pixel" in str(wild)


def test_it_saves_loads_and_compares(wild, tmp_path):
    wild.params.save(tmp_path / "model.json")
    again = NoiseModel.load(tmp_path / "model.json")
    _, held_out = wild_sensor()
    assert hsnoise.compare(again, held_out, draws=8).error < 20 < hsnoise.compare(wild.named, held_out, draws=8).error


def drawn_darks(model, frames, shape, exposures_s, key=5):
    """Darks of this model."""
    blank = [np.arange(frames * shape[0] * shape[1], dtype=np.uint16).reshape(frames, *shape) % 251] * len(exposures_s)
    like = hsnoise.FrameStack(blank, exposures_s, cfa=model.cfa, shutter=model.shutter)
    return draw_capture(key, model, like)


def test_noisy_rows_stay_noisy_and_pixels_differ_no_more_than_they_do():
    """A row is known far better than its pixels, which a draw of each pixel by itself would hide."""
    own = fx.ReadNoiseNonuniformity(0.1, row_spread=0.15)
    darks = drawn_darks(model_of(*BASE, own), 6, (96, 160), (0.0,))
    found = np.log(closed(model_of(*BASE, own), darks).params["measured_map"].read_noise)
    seen = np.log(darks.counts[0].astype(float).var(0, ddof=1)).mean(1) / 2
    assert np.corrcoef(found.mean(1), seen)[0, 1] > 0.9
    assert found.mean(1).std() == pytest.approx(0.15, abs=0.03)
    assert (found - found.mean(1, keepdims=True)).std() == pytest.approx(0.1, abs=0.04)


@pytest.mark.slow
def test_rows_that_are_read_together_are_no_spectrum():
    """Named 20 % too strong, they are kept: a spectrum has their power, but rows of a group would part."""
    groups = fx.RowGroupNoise(2.0, rows=8, start=3)
    darks = drawn_darks(model_of(*BASE, groups), 8, (128, 160), (0.0,))
    found = closed(model_of(*BASE, fx.RowGroupNoise(2.4, rows=8, start=3)), darks)
    assert found.overshot == () and "row_group_noise" in found.params
    assert found.comparison.groups["row x frame"] < 12


@pytest.mark.parametrize("charge", [pytest.param(0.0, marks=pytest.mark.slow), 20.0])
def test_a_level_that_rises_is_as_noisy_as_its_charge(charge):
    """Pixels gain 30 e-/s by what makes shot noise, or by a pedestal that moves with the exposure."""
    base = [fx.ShotNoise(), fx.DarkCurrent(charge), fx.ReadNoise(4.0), fx.Gain(1.5), fx.BlackLevel(100.0), fx.ADC()]
    rising = fx.MeasuredMap(growth=np.full((96, 160), 1.5 * (30.0 - charge), np.float32))
    darks = drawn_darks(model_of(*base, rising), 8, (96, 160), (0.0, 4.0))
    named = [fx.DarkCurrent(30.0) if effect.name == "dark_current" else effect for effect in base]
    found = closed(model_of(*named), darks).params
    again = drawn_darks(found, 8, (96, 160), (0.0, 4.0), key=9)
    for one, other in zip(darks.counts, again.counts, strict=True):
        one, other = one.astype(float), other.astype(float)
        assert other.var(0, ddof=1).mean() == pytest.approx(one.var(0, ddof=1).mean(), rel=0.02)
        assert other.mean() == pytest.approx(one.mean(), abs=0.15)


@pytest.mark.slow
def test_a_bayer_sensor_of_one_exposure():
    seen, held_out = (half.select(exposures=[1]) for half in wild_sensor("RGGB", 8, (96, 128)))
    found = closed(model_of(*BASE, cfa="RGGB"), seen, held_out=held_out)
    assert "measured_map" in found.params and found.params["measured_map"].dark_current is None
    for share in found.shares:
        if share.component in ("pixel", "temporal"):
            off = abs(share.measured_dn2 - share.closed_dn2)
            assert off < 4 * share.error_dn2 + 0.1 * share.measured_dn2, share
    drawn = draw_capture(3, found.params, held_out)
    assert drawn.counts[0].mean() == pytest.approx(held_out.counts[0].mean(), abs=1.0)


@pytest.mark.parametrize("call", [hsnoise.fit, hsnoise.improve])
def test_a_closed_model_is_no_start_of_a_fit(wild, call):
    seen, _ = wild_sensor()
    with pytest.raises(
        ValueError, match=r"model: expected effects with numbers to fit, got .*measured_map.*named.json"
    ):
        call(seen, model=wild.params)


def test_what_cannot_be_closed_is_named():
    seen, _ = wild_sensor()
    with pytest.raises(ValueError, match="stack: expected two frames or more of a dark exposure"):
        closed(model_of(*BASE), seen.select(frames=slice(0, 1)))
    with pytest.raises(ValueError, match="model: expected a model with gain and read_noise, this one lacks gain"):
        closed(model_of(*BASE).remove("gain"), seen)


@pytest.mark.parametrize(("loss", "is_bent"), [(6e-6, True), (0.0, False)])
def test_flats_of_several_levels_show_the_response(loss, is_bent):
    exposures_s = np.array([1.0, 2.0, 4.0, 6.0, 8.0, 10.0])
    light = [np.full((4, 64, 64), 1000.0 * t) for t in exposures_s]
    truth = model_of(*BASE, fx.Nonlinearity(loss))
    counts = [np.asarray(hsnoise.sample(i, of, truth, exposure_s=0.0)) for i, of in enumerate(light)]
    flats = hsnoise.FrameStack(counts, exposures_s, kind="flat", shutter="global")
    model = with_response(model_of(*BASE), flats)
    assert ("measured_response" in model) is is_bent
    if not is_bent:
        return
    curve = model["measured_response"]
    np.testing.assert_allclose((curve.level + curve.excess)[1:], [of.mean() for of in counts], rtol=1e-6)
    assert 50 < np.abs(curve.excess).max() < 450 and curve.excess[3] > 0 > curve.excess[-1]
    level = np.linspace(150.0, 14000.0, 50)
    np.testing.assert_allclose(curve.before(level + np.interp(level, curve.level, curve.excess)), level, rtol=1e-6)


UNDER_LIGHT = fx.PhotoResponseNonuniformity(0.01, row_sigma=0.002, column_sigma=0.004, column_parity=0.01)


@lru_cache
def lit_sensor(cfa="mono", drawn=UNDER_LIGHT, shape=(96, 128), levels=(2000.0, 6000.0)):
    """Darks, and flats in light that falls towards a corner, of one frame at the first level."""
    rows, columns = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    light = 1 - 0.2 * rows**2 - 0.3 * columns
    truth = model_of(*BASE, fx.DarkSignalNonuniformity(2.0), drawn, cfa=cfa)
    frames = (8, 1, *[4] * len(levels))
    clean = [
        np.broadcast_to(level * light, (n, *shape)) for level, n in zip((0.0, 500.0, *levels), frames, strict=True)
    ]
    sensor = jax.random.key(5)
    counts = [np.asarray(hsnoise.sample(i, of, truth, sensor_key=sensor)) for i, of in enumerate(clean)]
    kinds = ["dark", *["flat"] * (len(levels) + 1)]
    return hsnoise.FrameStack(counts, np.ones(len(counts)), kind=kinds, cfa=cfa, shutter="global")


def response_of(cfa, shape=(96, 128)):
    """The response of `lit_sensor`, from light without noise."""
    model = NoiseModel([UNDER_LIGHT], cfa=cfa, shutter="global", exposure_s=1.0)
    return np.asarray(hsnoise.sample(0, np.ones((1, *shape)), model, sensor_key=jax.random.key(5)))[0]


@pytest.mark.parametrize("cfa", [pytest.param("mono", marks=pytest.mark.slow), "RGGB"])
@pytest.mark.slow
def test_flats_give_the_response_of_each_pixel(cfa):
    stack = lit_sensor(cfa)
    found = closed(model_of(*BASE, fx.PhotoResponseNonuniformity(0.02), cfa=cfa), stack)
    assert "photo_response_nonuniformity" in found.replaced and "photo_response_nonuniformity" not in found.params
    measured, truth = np.asarray(found.params["measured_map"].photo_response), response_of(cfa)
    # Light tells 1 % to 0.7 %: the posterior is 0.57 % wide, about its mean as about the truth.
    assert np.std(measured - truth) < 0.0085 and np.std(measured) == pytest.approx(np.std(truth), rel=0.05)
    width = 1 if cfa == "mono" else 2
    odd = np.arange(128) // width % 2 == 1
    parity, of_truth = (one[:, odd].mean() - one[:, ~odd].mean() for one in (measured, truth))
    assert parity == pytest.approx(of_truth, abs=4 * 0.007 * np.sqrt(4 / measured.size))
    # Of a column's response a seventh goes with the smooth light.
    assert np.std(measured.mean(0) - truth.mean(0)) < 0.002 < 0.006 < np.std(truth.mean(0))
    after, before = ({g: x for g, x in one.groups.items() if "flats" in g} for one in (found.comparison, found.before))
    assert max(after.values()) < 4 < 20 < max(before.values()) and "flats, column responses" in after


def test_dead_pixels_do_not_count_against_a_closed_model():
    """Neighbours stand in for them where frames are compared; the closed model draws them as they are."""
    whole = lit_sensor()
    counts = [of.copy() for of in whole.counts]
    for lit, dark in zip(counts[1:], (0, 0, 4), strict=True):
        lit[:, 20:90:10, 30:120:20] = counts[0][dark : dark + len(lit), 20:90:10, 30:120:20]
    found = closed(model_of(*BASE, fx.PhotoResponseNonuniformity(0.02)), whole.with_counts(counts, None))
    assert found.params["measured_map"].photo_response[20, 30] < 0.05
    assert found.comparison.groups["flats, static pixels"] < 10


def test_flats_of_one_frame_leave_the_response_to_its_law():
    stack = lit_sensor().select(exposures=[0, 1])
    found = closed(model_of(*BASE, fx.PhotoResponseNonuniformity(0.01)), stack)
    assert found.params["measured_map"].photo_response is None and "photo_response_nonuniformity" in found.params
    assert "flats, noise" not in found.comparison.groups


@pytest.mark.slow
@pytest.mark.parametrize(("bends", "loss"), [("sensor", 6e-6), ("lamp", 0.0)])
def test_a_bent_response_is_the_sensors_if_the_noise_of_flats_bends_too(bends, loss):
    exposures_s, shape = np.array([1.0, 2.0, 4.0, 6.0, 8.0, 10.0]), (64, 96)
    truth = model_of(*BASE, fx.Nonlinearity(loss))
    light = 1000 * exposures_s * (1.0 if bends == "sensor" else 1 - 6e-6 * 1000 * exposures_s)
    counts = [np.asarray(hsnoise.sample(i, np.full((4, *shape), of), truth)) for i, of in enumerate(light)]
    darks = np.asarray(hsnoise.sample(9, np.zeros((8, *shape)), truth))
    kinds = ["dark", *["flat"] * len(exposures_s)]
    stack = hsnoise.FrameStack([darks, *counts], [1.0, *exposures_s], kind=kinds, shutter="global")
    found = closed(model_of(*BASE[:1], *BASE[2:]), stack)
    assert ("measured_response" in found.params) is (bends == "sensor")


def test_saturated_levels_say_nothing_about_the_response():
    """Their second frame may have more saturated pixels than a frame may have."""
    rng, exposures_s = np.random.default_rng(1), [1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0]
    straight = [100 + rng.poisson(20 * of, (2, 32, 32)) for of in exposures_s]
    straight[-1] = np.minimum(100 + rng.poisson([[[154]], [[156]]], (2, 32, 32)), 255)
    known = {"kind": ["dark", *["flat"] * 7], "white_level": 255, "shutter": "global"}
    counts = [of.astype(np.uint16) for of in (100 + rng.poisson(4, (2, 32, 32)), *straight)]
    stack = hsnoise.FrameStack([da.from_array(of) for of in counts], [1.0, *exposures_s], **known)  # checked when read
    with pytest.raises(ValueError, match="reach white_level"):
        list(stack.frames(7))
    model = model_of(*BASE)
    assert with_response(model, stack) is with_response(model, stack.select(exposures=range(7))) is model


@pytest.mark.usefixtures("few_candidates")
def test_a_story_is_kept_if_its_model_cannot_be_closed(monkeypatch):
    def fails(*of, **keywords):
        raise ValueError("this sensor has no maps")

    monkeypatch.setattr(importlib.import_module("hsnoise.criticism.improve"), "closed", fails)
    seen, _ = wild_sensor(most=1)
    kept = []
    story = hsnoise.improve(seen, max_steps=0, close=True, keep=kept.append)
    assert kept[-1].ending == story.ending  # before it is closed, which takes minutes
    assert story.closed is None and story.steps
    assert story.left_open == "Not closed with measured components: this sensor has no maps."


def test_shares_add_up():
    one = Share(1.0, "mono", "pixel", 10.0, 0.1, 9.5, 6.0, 20.0)
    assert (one.named, one.only_measured) == pytest.approx((0.6, 0.35)) and one.unexplained == pytest.approx(0.05)
    assert one.unexplained_of_total == pytest.approx(0.025)
    assert one._replace(error_dn2=1.0).unexplained == 0
    assert one._replace(named_dn2=30.0).only_measured == 0
    absent = one._replace(measured_dn2=0.0, closed_dn2=4.0)  # drawn, but not there
    assert (absent.of_total, absent.unexplained_of_total, absent.unexplained_dn) == pytest.approx((0, 0.2, 2.0))


def test_the_sentence_names_what_holds_most():
    parts = {"hot_pixels": 90.0, "column_fixed_pattern": 7.0, "row_fixed_pattern": 0.5}
    assert in_words(parts, 100.0) == "hot_pixels and column_fixed_pattern are 97 % of the static variance."
    assert in_words({"hot_pixels": 120.0}, 100.0).endswith("all of the static variance, and draw 20 % more.")
    assert in_words({"hot_pixels": 120.0}, 8.0).endswith(
        "draws 1.2e+02 DN^2 of static variance; 8 DN^2 are measured in these frames."
    )
    assert in_words({}, 100.0) == "No named effect explains static variance."


@pytest.mark.slow
@pytest.mark.usefixtures("few_candidates")
def test_improve_ends_with_a_closed_model(tmp_path, monkeypatch, capsys):
    seen, _ = wild_sensor(shape=(64, 80))
    monkeypatch.chdir(tmp_path)
    np.savez("darks.npz", counts=np.stack(seen.counts), exposure_s=EXPOSURES_S, shutter="global")
    assert main(["improve", "darks.npz", "--close", "--max-steps", "0", "--out", "better"]) == 0
    told = capsys.readouterr().out
    assert "closed with measured components" in told and "only measured" in told
    model, named = (NoiseModel.load(f"better/{name}.json") for name in ("model", "named"))
    assert "measured_map" in model and "measured_map" not in named
    assert main(["sample", "better/model.json", "--shape", "64x80", "--out", "drawn.npz"]) == 0


def test_a_dark_signal_that_the_camera_subtracts_is_not_subtracted_twice():
    """What grows in counts is what the camera left of the dark signal."""
    counts = np.random.default_rng(0).integers(80, 120, (2, 8, 64, 96)).astype(np.uint16)
    like = hsnoise.FrameStack(counts, [0.0, 2.0], black_level=100.0, shutter="global")
    model = model_of(*BASE, fx.BlackClamp(40.0))
    frames = draw_capture(5, model, like)
    found = closed(model, frames)
    drawn = draw_capture(6, found.params, frames)
    for measured, again in zip(frames.counts, drawn.counts, strict=True):
        assert again.mean() == pytest.approx(measured.mean(), abs=0.5)
