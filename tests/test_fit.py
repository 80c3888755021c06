"""Fits of simulated captures: recovered parameters and honest errors, what is not determined, bad input."""

from __future__ import annotations

import importlib
import json
from dataclasses import replace

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise._core.types import unit_in_words
from hsnoise.effects import ADC, BlackLevel, DarkCurrent, Gain, ReadNoise, RowGain, ShotNoise
from hsnoise.fitting import maximise as maximise_module
from hsnoise.fitting.notes import parameter_notes
from hsnoise.likelihood import summary as statistics
from hsnoise.likelihood.moments import start_model
from hsnoise.model import sample_dark

EXPOSURE_S = (0.02, 0.05, 0.1, 0.2)
FRAMES, SHAPE = 4, (96, 128)


def capture(model, *, seed=7, exposure_s=EXPOSURE_S, frames=FRAMES, shape=SHAPE, black_level="known", change=None):
    keys = jax.random.split(jax.random.key(seed), len(exposure_s))
    counts = [
        np.asarray(sample_dark(k, frames, shape, model, exposure_s=t)) for k, t in zip(keys, exposure_s, strict=True)
    ]
    if change is not None:
        counts = [change(c, t) for c, t in zip(counts, exposure_s, strict=True)]
    black = np.asarray(model["black_level"].value, float) if black_level == "known" else None
    return hsnoise.FrameStack(counts, exposure_s, black_level=black, cfa=model.cfa, shutter=model.shutter)


def pulls(result, model):
    """(estimate - truth) / standard error of all fitted parameters."""
    truth = {name: value for name, (value, _, _) in model.table.items()}
    return {name: (result.table[name][0] - truth[name]) / result.table[name][1] for name in result.names}


def assert_recovered(result, model, *, sigmas=4.5):
    assert result.method == "ml" and result.outcome.startswith("converged")
    found = pulls(result, model)
    assert max(map(abs, found.values())) < sigmas, found
    assert all(np.isfinite(value) for value, _, _ in result.table.values())


@pytest.fixture(scope="module")
def canon_fit():
    model = hsnoise.cameras.canon_5d3()
    return model, hsnoise.fit(capture(model))


@pytest.fixture(scope="module")
def small_fit():
    """Of a colour camera without a row gain, which takes a fifth of the time of one with it."""
    model = hsnoise.cameras.grasshopper3(black_level_dn=64).remove("row_gain")
    return hsnoise.fit(capture(model, exposure_s=(0.05, 0.2), shape=(48, 64)), model=model, pixels="alike")


@pytest.mark.slow
def test_canon_clipped_at_black_with_coloured_rows(canon_fit):
    model, result = canon_fit
    assert_recovered(result, model)
    assert result.notes == ()
    assert set(result.names) < set(result.table)
    # Each parameter is known to within a third: the errors are neither zero nor absurd.
    assert all(0 < result.table[name][1] < 0.34 * abs(result.table[name][0]) for name in result.names)


def test_printed_result_holds_every_parameter_with_its_error(small_fit):
    result, text = small_fit, str(small_fit)
    for name, (_, _, unit) in result.table.items():
        line = next(line for line in text.splitlines() if f" {name} " in line)
        assert unit_in_words(unit) in line
    assert "converged" in text and "held" in text


def test_fitted_model_samples_and_survives_its_file(small_fit, tmp_path):
    result = small_fit
    result.params.save(tmp_path / "camera.json", provenance={"method": result.method})
    assert json.loads((tmp_path / "camera.json").read_text())["provenance"] == {"method": "ml"}
    again = hsnoise.NoiseModel.load(tmp_path / "camera.json")
    assert again.table == result.params.table
    frames = hsnoise.sample(jax.random.key(0), np.full((3, 8, 8), 4.0), again)
    assert frames.shape == (3, 8, 8) and frames.dtype == np.uint32  # no white level is known


@pytest.mark.slow
def test_expected_histograms_match_the_measured_ones(canon_fit):
    _, result = canon_fit
    for h, expected in zip(result.summary.histograms, result.expected_histograms(), strict=True):
        measured = h.counts.sum((1, 2), dtype=float)
        np.testing.assert_allclose(expected.sum(1), measured.sum(1))
        misplaced = 0.5 * np.abs(measured - expected).sum(1) / measured.sum(1)
        assert misplaced.max() < 0.05  # rows of a few frames leave their mark on the red channel


@pytest.mark.slow
@pytest.mark.parametrize(
    ("camera", "black"),
    [
        ("canon_5d3", 2000.0),
        ("grasshopper3", 64.0),
        ("grasshopper3", 0.0),
    ],
    ids=str,
)
@pytest.mark.parametrize("black_level", ["known", "unknown"])
def test_cameras_and_black_levels(camera, black, black_level):
    if black == 0 and black_level == "unknown":
        black = 3.0  # estimated although part of the counts is clipped
    model = getattr(hsnoise.cameras, camera)(black_level_dn=black)
    assert_recovered(hsnoise.fit(capture(model, black_level=black_level)), model)


@pytest.mark.slow
@pytest.mark.parametrize(("exposures", "frames"), [(8, 2), (2, 12)])
def test_numbers_of_exposures_and_frames(exposures, frames):
    model = hsnoise.cameras.grasshopper3(black_level_dn=64)
    exposure_s = tuple(np.geomspace(0.01, 0.3, exposures))
    assert_recovered(hsnoise.fit(capture(model, exposure_s=exposure_s, frames=frames, shape=(64, 96))), model)


@pytest.mark.slow
def test_ragged_frames_and_single_ones():
    model = hsnoise.cameras.grasshopper3(black_level_dn=64)
    whole = capture(model)
    ragged = [c[:n] for c, n in zip(whole.counts, (4, 1, 3, 1), strict=True)]
    stack = hsnoise.FrameStack(ragged, EXPOSURE_S, black_level=64, cfa="RGGB", shutter="global")
    assert_recovered(hsnoise.fit(stack), model)


@pytest.mark.slow
def test_model_without_row_gain_is_fitted_without():
    model = hsnoise.cameras.grasshopper3(black_level_dn=64).remove("row_gain")
    result = hsnoise.fit(capture(model), model=model)
    assert_recovered(result, model)
    assert "row_gain.sigma.R" not in result.table and "row_gain" not in result.params


@pytest.mark.slow
@pytest.mark.parametrize("seed", [100, 102, 103])
def test_a_camera_without_row_gain_has_a_bound_for_it(seed):
    rng = np.random.default_rng(seed)
    exposure_s = (0.01, 0.1, 0.5, 2.0)
    signals = [rng.poisson(20 * t, (4, 96, 128)) + rng.normal(0, 4, (4, 96, 128)) for t in exposure_s]
    counts = [np.rint(64 + 0.5 * signal).astype(np.uint16) for signal in signals]
    result = hsnoise.fit(hsnoise.FrameStack(counts, exposure_s, black_level=64, shutter="global"))
    value, error, _ = result.table["row_gain.sigma"]
    # A row of 128 pixels of 40 + 16 e-^2 tells its gain to 4 %, 384 such rows the spread of gains to about 1 %.
    assert value < 4 * error and 0.001 < error < 0.02
    assert any("row_gain.sigma is compatible with zero" in note for note in result.notes)


@pytest.mark.parametrize(("change", "told"), [(0.3, True), (-0.2, True), (0.0, False)])
def test_a_sensor_that_warms_up_is_told(change, told, rng):
    exposure_s, light = (0.05, 0.5), 1 + change * np.linspace(0, 1, 6)[:, None, None]
    counts = [
        np.rint(64 + 1.5 * rng.poisson(120 * t * light, (6, 48, 64)) + rng.normal(0, 3, (6, 48, 64))).astype(np.uint16)
        for t in exposure_s
    ]
    stack = hsnoise.FrameStack(counts, exposure_s, black_level=64, shutter="global")
    notes = [note for note in hsnoise.fit(stack, method="line").notes if "from the first frame" in note]
    assert len(notes) == told
    assert not told or f"{'rises' if change > 0 else 'falls'} by" in notes[0]


def assert_gain_not_determined(model, exposure_s, black_level, seed):
    result = hsnoise.fit(capture(model, seed=seed, exposure_s=(exposure_s,), black_level=black_level))
    assert result.outcome.startswith("converged")
    found, gain = pulls(result, model), result.table["gain.R"]
    given = {name: pull for name, pull in found.items() if not np.isnan(result.table[name][0])}
    assert given and max(map(abs, given.values())) < 4, found
    assert np.isnan(gain[0]) or gain[1] > 0.3 * gain[0]  # withheld, or with an honest error
    assert not result.trustworthy
    assert any("gain.R is not determined" in said and "flats" in said for said in (*result.doubts, *result.notes))


@pytest.mark.slow
def test_one_exposure_says_what_it_does_not_determine():
    assert_gain_not_determined(hsnoise.cameras.grasshopper3(black_level_dn=64), 0.0005, "unknown", seed=7)


@pytest.mark.slow
@pytest.mark.parametrize("black_level", ["known", "unknown"])
@pytest.mark.parametrize("seed", [8, 9])
def test_one_short_exposure_keeps_honest_errors(seed, black_level):
    # The likelihood is a long, bent ridge here: its curvature alone gave errors ten times too small.
    assert_gain_not_determined(hsnoise.cameras.grasshopper3(black_level_dn=64), 0.0005, black_level, seed)
    assert_gain_not_determined(hsnoise.cameras.canon_5d3(black_level_dn=64), 0.0005, black_level, seed)


@pytest.mark.slow
def test_bias_frames_alone_do_not_determine_gain_or_dark_current():
    model = hsnoise.cameras.grasshopper3(black_level_dn=64)
    result = hsnoise.fit(capture(model, exposure_s=(0.0,)))
    text = " ".join(result.notes)
    assert "dark_current.rate is not determined" in text and "gain.G is not determined" in text
    assert result.table["dark_current.rate"][1] == np.inf
    assert "not determined" in str(result) and "nan" not in str(result).lower()


def test_flats_determine_the_gain_of_a_camera_without_dark_current(rng):
    gain, read, black, light = 0.5, 3.0, 100.0, (50.0, 400.0, 2000.0)
    pattern = 1 + 0.02 * rng.standard_normal(SHAPE)

    def frames(mean_e):
        electrons = rng.poisson(mean_e * pattern, (4, *SHAPE)) + read * rng.standard_normal((4, *SHAPE))
        return np.rint(gain * electrons + black).astype(np.uint16)

    stack = hsnoise.FrameStack(
        [frames(0.0), frames(0.0), *map(frames, light)],
        [0.001, 0.1, *(x / 1000 for x in light)],
        kind=["dark", "dark", "flat", "flat", "flat"],
        shutter="global",
    )
    result = hsnoise.fit(stack)
    for name, truth in (("gain", gain), ("read_noise.sigma", read), ("black_level", black)):
        value, error, _ = result.table[name]
        assert abs(value - truth) < 4.5 * error and error < 0.05 * truth
    rate, error, _ = result.table["dark_current.rate"]
    assert rate < 4 * error and 0.02 < error < 2.0
    assert any("dark_current.rate is compatible with zero" in note for note in result.notes)
    assert any("row_gain.sigma is compatible with zero" in note for note in result.notes)


@pytest.mark.slow
def test_hot_pixels_are_set_apart_and_told(rng):
    model = hsnoise.cameras.grasshopper3(black_level_dn=64)
    hot = rng.random(SHAPE) < 0.004
    extra = rng.exponential(4000, SHAPE) * hot

    def add(counts, exposure_s):
        return np.clip(counts + extra * exposure_s * 3, 0, 65535).astype(np.uint16)

    result = hsnoise.fit(capture(model, change=add))
    assert_recovered(result, model, sigmas=6)
    assert any("do not follow this model" in note for note in result.notes)


@pytest.mark.slow
def test_frames_that_saw_light_are_called_flats():
    model = hsnoise.cameras.grasshopper3(black_level_dn=64)
    bright = capture(model, exposure_s=(0.001, 0.002))
    light = [
        np.asarray(hsnoise.sample(jax.random.key(i), np.full((4, *SHAPE), x), model))
        for i, x in enumerate((300.0, 600.0))
    ]
    stack = hsnoise.FrameStack(light, bright.exposure_s, black_level=64, cfa="RGGB", shutter="global")
    assert any("pass kind='flat'" in note for note in hsnoise.fit(stack).notes)


@pytest.mark.slow
def test_a_row_gain_that_starts_at_zero_leaves_it(canon_fit, monkeypatch):
    # A row gain of zero is a stationary point, whatever the frames say.
    def start_at_zero(summary, with_row_gain, with_clamp):
        start = start_model(summary, with_row_gain, with_clamp)
        return start.with_value("row_gain", "sigma", start["row_gain"].sigma * np.array([1.0, 1.0, 1e-6]))

    model, usual = canon_fit
    monkeypatch.setattr(importlib.import_module("hsnoise.fit"), "start_model", start_at_zero)
    result = hsnoise.fit(usual.summary)
    assert_recovered(result, model)
    assert abs(result.log_likelihood - usual.log_likelihood) < 0.05


def not_converged(coordinates, summary):
    end = maximise_module.maximise(coordinates, summary)
    return end._replace(converged=False, outcome="stopped by the test")


@pytest.mark.slow
def test_auto_falls_back_to_the_line_loudly_and_ml_refuses(canon_fit, monkeypatch):
    summary = canon_fit[1].summary
    monkeypatch.setattr(importlib.import_module("hsnoise.fit"), "maximise", not_converged)
    result = hsnoise.fit(summary)
    assert result.method == "line" and "MAXIMUM LIKELIHOOD DID NOT CONVERGE" in result.outcome
    assert "MAXIMUM LIKELIHOOD DID NOT CONVERGE" in str(result).replace("\n", " ")
    with pytest.raises(RuntimeError, match="stopped by the test"):
        hsnoise.fit(summary, method="ml")


@pytest.mark.slow
def test_line_method_and_likelihood_agree(canon_fit):
    model, result = canon_fit
    line = hsnoise.fit(result.summary, method="line")
    assert line.method == "line" and line.names == result.names
    for name in ("gain.G", "dark_current.rate", "read_noise.sigma"):
        difference = line.table[name][0] - result.table[name][0]
        assert abs(difference) < 5 * np.hypot(line.table[name][1], result.table[name][1])


def assert_pilot_ends_where(whole, monkeypatch):
    monkeypatch.setattr(maximise_module, "MANY_ROWS", 1500)  # two of the four frames
    monkeypatch.setattr(maximise_module, "PILOT_ROWS", 400)  # every second row of them
    piloted = hsnoise.fit(whole.summary)
    assert piloted.outcome.startswith("converged")
    for name in whole.names:
        value, error, _ = whole.table[name]
        assert abs(piloted.table[name][0] - value) < 0.1 * error
        assert 0.7 < piloted.table[name][1] / error < 1.4


@pytest.fixture
def little_memory(monkeypatch, canon_fit):
    """Enough for half of the capture."""
    histograms = canon_fit[1].summary.histograms
    monkeypatch.setattr(statistics, "MOST_MIB", sum(h.counts.nbytes for h in histograms) / 2**20 / 2)


@pytest.mark.slow
def test_a_capture_larger_than_memory_is_fitted_on_a_part_of_it_and_told(little_memory, canon_fit):
    model, _ = canon_fit
    part = hsnoise.fit(capture(model), method="line")
    assert max(map(abs, pulls(part, model).values())) < 4.5
    assert "this fit uses 8 of 16 dark frames" in part.notes[0]


@pytest.mark.slow
def test_errors_of_a_part_are_those_of_its_frames(little_memory, canon_fit):
    model, whole = canon_fit
    part = hsnoise.fit(capture(model))
    assert_recovered(part, model)
    assert "this fit uses 8 of 16 dark frames" in part.notes[0]
    # Of half the frames, or somewhat more where their histograms have fewer bins.
    for name in ("read_noise.sigma", "dark_current.rate"):
        assert 1.05 < part.table[name][1] / whole.table[name][1] < 1.5


@pytest.mark.slow
def test_pilot_of_a_large_capture_ends_where_the_whole_does(monkeypatch, canon_fit):
    assert_pilot_ends_where(canon_fit[1], monkeypatch)


@pytest.mark.slow
def test_pilot_of_a_large_capture_with_flats_ends_where_the_whole_does(monkeypatch):
    model = hsnoise.cameras.grasshopper3(black_level_dn=64)
    darks = capture(model)
    lights = [
        np.asarray(hsnoise.sample(jax.random.key(i), np.full((2, *SHAPE), x), model))
        for i, x in enumerate((200.0, 800.0))
    ]
    flats = hsnoise.FrameStack(lights, (0.01, 0.04), black_level=64, cfa="RGGB", shutter="global", kind="flat")
    stack = hsnoise.FrameStack.join(
        hsnoise.FrameStack(darks.counts, EXPOSURE_S, black_level=64, cfa="RGGB", shutter="global"), flats
    )
    assert_pilot_ends_where(hsnoise.fit(stack), monkeypatch)


@pytest.mark.slow
def test_a_large_capture_that_hardly_tells_the_gain_is_fitted(monkeypatch):
    # One exposure of a few electrons: gain, read noise and dark current lie on a bent ridge, and full steps overshoot.
    monkeypatch.setattr(maximise_module, "MANY_ROWS", 1500)
    monkeypatch.setattr(maximise_module, "PILOT_ROWS", 400)
    effects = [ShotNoise(), DarkCurrent(40.0), ReadNoise(3.0), RowGain(0.02, 0.0), Gain(2.0), BlackLevel(512.0), ADC()]
    model = hsnoise.NoiseModel(effects, cfa="mono", shutter="rolling", exposure_s=0.1)
    result = hsnoise.fit(capture(model, seed=1, exposure_s=(0.1,), frames=60, shape=(128, 24)))
    assert result.method == "ml"
    found = pulls(result, model)
    assert max(abs(found[name]) for name in ("gain", "read_noise.sigma", "dark_current.rate")) < 4
    assert result.table["gain"][1] < 0.1 * result.table["gain"][0]


@pytest.mark.parametrize(
    ("share", "words"), [(0.05, None), (0.2, "gain.R is known only to 20%"), (0.4, "not determined")]
)
def test_a_gain_that_is_weakly_known_asks_for_flats(small_fit, share, words):
    result = small_fit
    error = share * result.table["gain.R"][0]
    covariance = result.covariance.copy()
    covariance[0, 0] = error**2
    notes = [note for note in parameter_notes(replace(result, covariance=covariance)) if note.startswith("gain.R")]
    assert notes == [] if words is None else words in notes[0] and "add flats" in notes[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"method": "fast"}, "method"),
        ({"model": hsnoise.cameras.canon_5d3()}, "model"),
        ({"model": hsnoise.cameras.grasshopper3().remove("gain")}, "gain"),
    ],
)
def test_bad_arguments_are_refused(change, message):
    stack = capture(hsnoise.cameras.grasshopper3(black_level_dn=64), frames=1, shape=(8, 8))
    with pytest.raises(ValueError, match=message):
        hsnoise.fit(stack, **change)


@pytest.mark.slow
def test_wrong_exposures_are_told():
    model = hsnoise.cameras.grasshopper3(black_level_dn=64)
    right = capture(model)
    reversed_ = hsnoise.FrameStack(right.counts, EXPOSURE_S[::-1], black_level=64, cfa="RGGB", shutter="global")
    fitted = hsnoise.fit(reversed_)
    assert not fitted.trustworthy
    assert any("are the exposures right?" in doubt for doubt in fitted.doubts)


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["canon_5d3", "grasshopper3"])
def test_intervals_cover(camera):
    """24 captures: root mean square pull of each parameter within what 24 unit normals allow."""
    model = getattr(hsnoise.cameras, camera)(black_level_dn=64 if camera == "grasshopper3" else 0)
    found = [pulls(hsnoise.fit(capture(model, seed=100 + seed), method="ml"), model) for seed in range(24)]
    for name in found[0]:
        rms = np.sqrt(np.mean([f[name] ** 2 for f in found]))
        assert 0.6 < rms < 1.5, (name, rms)
