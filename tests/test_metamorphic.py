"""What happens to a fit, or to a comparison, if the capture is changed in a known way: what physics says, and no more.

No truth is needed: the fit of the changed capture is compared with that of the capture as it was. Captures are drawn
in NumPy, one of pixels that are alike (Bayer, fitted by likelihood) and one whose pixels differ (mono, followed over
time).
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys

import numpy as np
import pytest

import hsnoise

EXPOSURE_S = np.array([0.02, 0.1, 0.4])
FRAMES, SHAPE = 6, (64, 96)
WHITE = 4095


def alike() -> dict:
    rng = np.random.default_rng(4)
    tile = np.tile(np.array([[2.0, 1.6], [1.6, 1.8]]), (SHAPE[0] // 2, SHAPE[1] // 2))
    counts = []
    for exposure_s in EXPOSURE_S:
        electrons = rng.poisson(80 * exposure_s, (FRAMES, *SHAPE)) + rng.normal(0, 3.0, (FRAMES, *SHAPE))
        rows = 1 + 0.15 * rng.standard_normal((FRAMES, SHAPE[0], 1))
        counts.append(np.clip(np.rint(100 + tile * rows * electrons), 0, WHITE).astype(np.uint16))
    return {"counts": counts, "cfa": "RGGB", "shutter": "global"}


def differing() -> dict:
    rng = np.random.default_rng(5)
    rate, offset = 300 * rng.lognormal(0, 0.6, SHAPE), rng.normal(0, 6.0, SHAPE)
    counts = []
    for exposure_s in EXPOSURE_S:
        electrons = rng.poisson(rate * exposure_s, (FRAMES, *SHAPE)) + rng.normal(0, 4.0, (FRAMES, *SHAPE))
        counts.append(np.clip(np.rint(100 + offset + 1.5 * electrons), 0, WHITE).astype(np.uint16))
    return {"counts": counts, "cfa": "mono", "shutter": "global"}


CAPTURES = {"alike": alike(), "differ": differing()}


def fitted(capture: dict, **changes) -> hsnoise.FitResult:
    """The fit of a capture with some fields changed."""
    fields = {"exposure_s": EXPOSURE_S, "black_level": 100.0, "white_level": WHITE, **capture, **changes}
    return hsnoise.fit(hsnoise.FrameStack(**fields))


@pytest.fixture(scope="module", params=[pytest.param("alike", marks=pytest.mark.slow), "differ"])
def case(request):
    """A capture and its fit."""
    capture = CAPTURES[request.param]
    fit = fitted(capture)
    assert fit.converged and fit.has_gain and (fit.transfer is not None) == (request.param == "differ")
    return capture, fit


def assert_same(fit, before, *, within, factors=None):
    """Each number of the table is what it was, times its factor, within so many of its standard errors."""
    assert fit.names == before.names
    for name, (value, error, unit) in before.table.items():
        factor = (factors or {}).get(name.split(".")[0], 1.0)
        again, again_error, again_unit = fit.table[name]
        assert again_unit == unit
        if name in before.names:
            assert abs(again - factor * value) <= within * factor * error + 1e-9, (name, again, factor * value, error)
            assert again_error == pytest.approx(factor * error, rel=0.02 + 0.2 * within)


def test_a_constant_added_to_counts_and_black_level(case):
    capture, before = case
    shifted = [one + np.uint16(300) for one in capture["counts"]]
    fit = fitted(capture, counts=shifted, black_level=400.0)
    assert_same(fit, before, within=0.02, factors={"black_level": 4.0})


def test_seconds_become_milliseconds(case):
    capture, before = case
    fit = fitted(capture, exposure_s=1000 * EXPOSURE_S)
    per_ms = dict.fromkeys(("dark_current",), 1e-3)
    assert_same(fit, before, within=0.02, factors=per_ms)


@pytest.mark.slow
def test_exposures_in_another_order(case):
    capture, before = case
    fit = fitted(capture, counts=capture["counts"][::-1], exposure_s=EXPOSURE_S[::-1])
    assert_same(fit, before, within=0.02)


@pytest.mark.slow
def test_frames_in_another_order(case):
    """Searches begin at other frames, and followed pixels are measured by the even and the odd frames."""
    capture, before = case
    order = np.random.default_rng(0).permutation(FRAMES)
    fit = fitted(capture, counts=[one[order] for one in capture["counts"]])
    assert_same(fit, before, within=0.2 if before.transfer is None else 1.0)


@pytest.mark.slow
def test_a_frame_stored_in_portrait(case):
    capture, before = case
    portrait = [one.swapaxes(1, 2).copy() for one in capture["counts"]]
    assert_same(fitted(capture, counts=portrait, row_axis=1), before, within=1e-6)


MOVED = {
    "upside down": (lambda frames: frames[:, ::-1], "GBRG"),
    "left to right": (lambda frames: frames[:, :, ::-1], "GRBG"),
    "both": (lambda frames: frames[:, ::-1, ::-1], "BGGR"),
    "a row further": (lambda frames: np.roll(frames, 1, axis=1), "GBRG"),
}


@pytest.mark.slow
@pytest.mark.parametrize("how", MOVED)
def test_an_image_that_is_mirrored_or_moved(case, how):
    """Colours are in another order then. Offsets are measured with random numbers, pixel by pixel."""
    capture, before = case
    moved, cfa = MOVED[how]
    counts = [moved(one).copy() for one in capture["counts"]]
    fit = fitted(capture, counts=counts, cfa="mono" if capture["cfa"] == "mono" else cfa)
    of_chance = "dark_signal_nonuniformity.sigma"
    assert_same(fit, before, within=0.5 if of_chance in before.names else 1e-3)
    for name in set(before.names) - {of_chance}:
        value, error, _ = before.table[name]
        assert abs(fit.table[name][0] - value) <= 1e-3 * error + 1e-9, name


@pytest.mark.slow
def test_a_part_of_the_frame_tells_the_same_less_surely(case):
    capture, before = case
    parts = [one[:, 16:, :64] for one in capture["counts"]]
    fit = fitted(capture, counts=parts)
    for name in set(fit.names) & set(before.names):
        (value, error, _), (whole, of_whole, _) = fit.table[name], before.table[name]
        assert abs(value - whole) < 4 * error and error > 0.9 * of_whole, name


@pytest.mark.slow
def test_a_bayer_sensor_without_its_first_row():
    capture = CAPTURES["alike"]
    before = fitted(capture)
    parts = [one[:, 1:-1] for one in capture["counts"]]
    fit = fitted(capture, counts=parts, cfa="GBRG")
    for name, (value, error, _) in before.table.items():
        if name in before.names:
            assert abs(fit.table[name][0] - value) < error, name


@pytest.mark.parametrize("factor", [2, pytest.param(16, marks=pytest.mark.slow)], ids=["doubled", "12 bits in 16"])
def test_counts_multiplied_are_a_gain_multiplied(case, factor):
    """Pooled fits do not know that codes are further apart than counts, and say so."""
    capture, before = case
    counts = [factor * one for one in capture["counts"]]
    fit = fitted(capture, counts=counts, black_level=100.0 * factor, white_level=factor * WHITE)
    within = 1.5 if before.transfer is None else 0.25
    assert_same(fit, before, within=within, factors={"gain": factor, "black_level": factor})
    said = (*fit.doubts, *fit.notes)
    assert any(f"multiples of {factor} DN" in one for one in said) and not any(
        "multiples of" in one for one in before.doubts
    )


@pytest.mark.slow
def test_draws_of_a_saved_model_are_the_same_in_another_process(case, tmp_path):
    _, fit = case
    fit.params.save(tmp_path / "model.json")
    drawn = np.asarray(hsnoise.sample_dark(7, 2, (16, 24), hsnoise.NoiseModel.load(tmp_path / "model.json")))
    code = (
        "import hashlib, json, sys, numpy as np, hsnoise\n"
        "counts = np.asarray(hsnoise.sample_dark(7, 2, (16, 24), hsnoise.NoiseModel.load(sys.argv[1])))\n"
        "print(json.dumps([hashlib.sha256(counts.tobytes()).hexdigest(), str(counts.dtype)]))"
    )
    run = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "model.json")],
        capture_output=True,
        check=True,
        env={**os.environ, "JAX_ENABLE_X64": "1"},  # as the tests have it
    )
    assert json.loads(run.stdout) == [hashlib.sha256(drawn.tobytes()).hexdigest(), str(drawn.dtype)]


def compared(capture: dict, model: hsnoise.NoiseModel, **changes) -> hsnoise.criticism.Comparison:
    """A comparison by few draws."""
    fields = {"exposure_s": EXPOSURE_S, "black_level": 100.0, "white_level": WHITE, **capture, **changes}
    return hsnoise.compare(model, hsnoise.FrameStack(**fields), draws=8)


def assert_as_close(found, before, rel: float) -> None:
    """Each statistic of the frames is as far from its draws."""
    for one, other in zip(found.table, before.table, strict=True):
        assert one[:2] == other[:2] and one[4] == pytest.approx(other[4], rel=rel, abs=rel), one[0]
    assert found.error == pytest.approx(before.error, rel=rel) and found.p_value == before.p_value


@pytest.fixture(scope="module")
def closeness(case):
    capture, fit = case
    return capture, fit.params, compared(capture, fit.params)


def test_compare_with_a_constant_added(closeness):
    capture, model, before = closeness
    counts = [one + np.uint16(300) for one in capture["counts"]]
    moved = model.with_value("black_level", "value", np.asarray(model["black_level"].value) + 300)
    assert_as_close(compared(capture, moved, counts=counts, black_level=400.0), before, 1e-6)


def test_compare_in_milliseconds(closeness):
    capture, model, before = closeness
    rate = np.asarray(model["dark_current"].rate)
    slower = model.with_value("dark_current", "rate", rate / 1000)
    assert_as_close(compared(capture, slower, exposure_s=1000 * EXPOSURE_S), before, 1e-6)


def test_compare_with_frames_in_another_order(closeness):
    """Only statistics of frames in their order see it."""
    capture, model, before = closeness
    order = np.random.default_rng(0).permutation(FRAMES)
    found = compared(capture, model, counts=[one[order] for one in capture["counts"]])
    changed = {
        (one[1], one[0]) for one, other in zip(found.table, before.table, strict=True) if differs(one[4], other[4])
    }
    assert changed and all(group == "frames over time" or "next frame" in name for group, name in changed), changed


def differs(one: float, other: float) -> bool:
    return abs(one - other) > 1e-3
