"""What `compare` says of the noise budget, and of a single statistic that is off."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise._core.conclusion import Light
from hsnoise.criticism import rules
from hsnoise.criticism.compare import Comparison
from hsnoise.criticism.shares import Share, largest_unexplained, shares_of
from hsnoise.statistics.decomposition import COMPONENTS

EXPOSURES_S = (0.02, 0.2)
CAMERA = hsnoise.cameras.grasshopper3(black_level_dn=64)


def capture(model: hsnoise.NoiseModel, exposures_s=EXPOSURES_S, frames: int = 6) -> hsnoise.FrameStack:
    key = jax.random.key(7)
    counts = [
        np.asarray(hsnoise.sample_dark(jax.random.fold_in(key, i), frames, (64, 96), model, exposure_s=t, sensor_key=3))
        for i, t in enumerate(exposures_s)
    ]
    return hsnoise.FrameStack(counts, exposures_s, black_level=64, white_level=65535, cfa="RGGB", shutter="global")


@pytest.mark.slow
def test_the_true_model_leaves_no_component_unexplained():
    found = hsnoise.compare(CAMERA, capture(CAMERA), draws=16)
    assert found.largest_unexplained is None and "beyond chance" in found.unexplained and found.fits
    assert len(found.shares) == len(EXPOSURES_S) * 3 * len(COMPONENTS)
    of_all = [one.of_total for one in found.shares if one.exposure_s == 0.2 and one.channel == "G"]
    assert sum(of_all) == pytest.approx(1)
    assert 0 < found.max_z < rules.MAX_Z and 1 / 17 <= found.max_z_p_value <= 1


@pytest.mark.parametrize(
    ("effect", "component", "size_e"),
    [
        pytest.param(fx.FrameOffset(2.0), "frame", 2.0, marks=pytest.mark.slow),
        (fx.DarkSignalNonuniformity(3.0), "pixel", 3.0),
    ],
)
def test_a_missing_effect_shows_in_its_component_at_its_size(effect, component, size_e):
    gain = CAMERA.table["gain.G"][0]
    found = hsnoise.compare(CAMERA, capture(CAMERA.add(effect), frames=24), draws=16)
    worst = found.largest_unexplained
    assert worst.component == component and worst.closed_dn2 < worst.measured_dn2
    green = [one for one in found.shares if one.component == component and one.channel == "G"]
    assert np.mean([one.unexplained_dn for one in green]) == pytest.approx(size_e * gain, rel=0.35)
    assert f"{worst.in_words} (" in found.unexplained and "the model lacks" in found.unexplained
    assert worst.off == f"-{worst.unexplained_dn:.2g}"


@pytest.mark.parametrize("seed", range(3))
def test_a_band_of_random_phases_leaves_no_pattern_beyond_chance(seed):
    """Its mean over few frames is no pattern of columns, however far the capture's phases and the draws' lie apart."""
    model = CAMERA.add(fx.PeriodicBanding(20.0, 0.31, axis="column"))
    stack = hsnoise.sample_dark(seed, 6, (64, 96), model, exposure_s=0.02)
    frames = hsnoise.FrameStack(np.asarray(stack), [0.02], cfa="RGGB", shutter="global")
    of = [one for one in shares_of(model, frames, jax.random.key(seed)) if one.component == "column"]
    assert max(abs(one.measured_dn2 - one.closed_dn2) / one.error_dn2 for one in of) < 4
    assert largest_unexplained(of) is None


@pytest.mark.parametrize("seed", range(4))
def test_two_frames_in_which_a_band_has_one_phase_are_chance(seed):
    """Of ten exposures, some pairs have: four draws do not tell how far that moves noise into the static pattern."""
    exposures_s = tuple(np.linspace(0.01, 0.02, 10))
    base = [fx.ShotNoise(), fx.DarkCurrent(10.0), fx.ReadNoise(4.0), fx.Gain(2.0), fx.BlackLevel(64.0), fx.ADC()]
    model = hsnoise.NoiseModel(base, cfa="mono", shutter="global", exposure_s=0.02)
    model = model.add(fx.PeriodicBanding(4.0, 0.31, axis="column"))
    of = [
        np.asarray(hsnoise.sample_dark(100 * seed + i, 2, (64, 96), model, exposure_s=t))
        for i, t in enumerate(exposures_s)
    ]
    found = shares_of(model, hsnoise.FrameStack(of, exposures_s, shutter="global"), jax.random.key(seed))
    assert largest_unexplained(found) is None


def test_noise_that_is_not_there_is_too_much():
    found = hsnoise.compare(CAMERA.add(fx.FrameOffset(4.0)), capture(CAMERA, frames=24), draws=16)
    assert found.largest_unexplained.component == "frame" and "the model adds" in found.unexplained
    assert found.largest_unexplained.off.startswith("+")


@pytest.mark.slow
def test_single_frames_have_no_shares():
    frames = [np.asarray(hsnoise.sample_dark(i, 1, (64, 96), CAMERA, exposure_s=t)) for i, t in enumerate(EXPOSURES_S)]
    stack = hsnoise.FrameStack(frames, EXPOSURES_S, black_level=64, cfa="RGGB", shutter="global")
    found = hsnoise.compare(CAMERA, stack, draws=8)
    assert found.shares == () and found.unexplained == "" and found.largest_unexplained is None
    with pytest.raises(ValueError, match="stack: expected two frames or more of each exposure, got one of 20 ms"):
        shares_of(CAMERA, stack, jax.random.key(0))


@pytest.mark.slow
def test_exposures_of_one_frame_are_left_out_of_the_budget_and_named():
    pair, single = capture(CAMERA, (0.02,)), capture(CAMERA.add(fx.RowNoise(8.0)), (0.2,), frames=2)
    counts = [np.stack(list(pair.frames(0))), np.stack(list(single.frames(0)))[:1]]
    stack = hsnoise.FrameStack(counts, EXPOSURES_S, black_level=64, white_level=65535, cfa="RGGB", shutter="global")
    found = hsnoise.compare(CAMERA, stack, draws=16)
    assert {one.exposure_s for one in found.shares} == {0.02} and not found.whole_budget
    assert any("noise budget leaves out" in one for one in found.skipped)
    assert not found.fits and "variance of each component" not in found.conclusion.sentence


def test_a_level_that_is_off_is_no_matter_of_structure():
    found = hsnoise.compare(hsnoise.cameras.grasshopper3(black_level_dn=80), capture(CAMERA), draws=16)
    assert found.worst_group == "level" and "structure" not in found.conclusion.sentence


def test_of_many_components_one_is_off_by_chance():
    just = Share(1.0, "mono", "pixel", 10.0, 1.0, 13.0, 13.0, 20.0)  # three standard errors
    assert largest_unexplained([just]) is just
    assert largest_unexplained([just] * 100) is None
    assert largest_unexplained([]) is None


def test_one_statistic_far_off_does_not_fit_however_small_the_error():
    row = ("static rows: strongest frequency", "static rows", 3.0, 1.0, 9.0)
    found = Comparison(1.4, {"static rows": 1.4}, (row,), ("strongest frequency: measured 3",), 0.5, -1.0, ())
    assert not found.fits and found.max_z == 9.0 and found.conclusion.light == Light.AMBER
    assert "fits but for one statistic, 9 deviations off" in found.conclusion.sentence
