"""Flats beside darks: drawn in the light that was measured, and effects that only light shows."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.criticism.candidates import built_in, facts_of
from hsnoise.frames.stack import FrameStack
from hsnoise.simulation.draws import draw_capture, light_of
from hsnoise.simulation.portion import Portion
from hsnoise.simulation.simulator import Purpose, Simulator, key_for

CAMERA = hsnoise.cameras.grasshopper3(black_level_dn=64)
SHAPE, FRAMES = (64, 96), 8


def capture(model, seed=0):
    """Two exposures of darks and two brightnesses of flats that fall off toward the edges."""
    row, column = np.meshgrid(*(np.linspace(-1, 1, n) for n in SHAPE), indexing="ij")
    falls = 1 - 0.3 * (row**2 + column**2) / 2
    key = jax.random.key(seed)
    light = [0.0, 0.0, 300.0, 1500.0]
    exposure_s = [0.02, 0.1, 0.02, 0.1]
    counts = [
        hsnoise.sample(
            jax.random.fold_in(key, i),
            np.broadcast_to((level * falls).astype(np.float32), (FRAMES, *SHAPE)),
            model,
            exposure_s=t,
            sensor_key=key,
        )
        for i, (level, t) in enumerate(zip(light, exposure_s, strict=True))
    ]
    kinds = ["dark", "dark", "flat", "flat"]
    return FrameStack(
        [np.asarray(c) for c in counts], exposure_s, kind=kinds, black_level=64, cfa="RGGB", shutter="global"
    )


@pytest.fixture(scope="module")
def portion():
    return Portion.of(capture(CAMERA))


@pytest.fixture(scope="module")
def plain(portion):
    return portion.frames


@pytest.fixture(scope="module")
def measured(portion):
    return Simulator(CAMERA, portion, key_for(0, Purpose.COMPARE)).measured


def test_light_is_that_of_the_flats(plain):
    assert not light_of(CAMERA, plain, 0).any()
    light = light_of(CAMERA, plain, 3)
    assert light.mean() == pytest.approx(1500 * 0.9, rel=0.01)
    assert light[32, 48] == pytest.approx(1500, rel=0.05) and light[0, 0] == pytest.approx(1050, rel=0.08)


def test_what_dust_does_to_the_light_is_no_noise(measured):
    names = measured.names
    of_maps = [name for name in names if name.startswith("flats, static pixels")]
    assert any("pixel / residual" in name for name in of_maps)
    assert not [name for name in of_maps if "kurtosis" in name or "sigma" in name or "away" in name]
    assert any(name.startswith("static pixels: log kurtosis") for name in names)


def test_a_curve_is_no_candidate_where_two_levels_tell_of_a_line_only(portion):
    whole = built_in(facts_of(CAMERA, portion, 0))
    one_dark_one_flat = Portion.of(portion.frames.select(exposures=[1, 3]))
    assert "nonlinearity" in whole
    assert whole.keys() - built_in(facts_of(CAMERA, one_dark_one_flat, 0)).keys() >= {"nonlinearity"}


def test_draws_are_as_bright_as_the_capture(plain):
    drawn = draw_capture(3, CAMERA, plain)
    assert drawn.kind == plain.kind
    for i in range(4):
        ours, theirs = (np.mean(list(stack.frames(i)), axis=0) for stack in (drawn, plain))
        assert ours.mean() == pytest.approx(theirs.mean(), rel=0.01)
        assert ours[:8].mean() == pytest.approx(theirs[:8].mean(), rel=0.02)


def test_statistics_of_flats_have_their_own_groups(measured):
    assert {"static pixels", "flats, static pixels", "flats, noise"} <= set(measured.groups)
    assert "flats, level" not in measured.groups and "flats, blocks" not in measured.groups
    assert np.isfinite(measured.values).all()


@pytest.mark.slow
def test_model_of_the_flats_has_error_one(plain):
    assert hsnoise.compare(CAMERA, plain, draws=24).fits


@pytest.mark.slow
def test_photo_response_is_named_and_fitted():
    stack = capture(CAMERA.add(fx.PhotoResponseNonuniformity(0.02)), seed=4)
    fitted = hsnoise.fit(stack)
    found = hsnoise.diagnose(fitted, stack)
    assert found.names == ("photo_response_nonuniformity",), found
    assert found.best.effect.sigma == pytest.approx(0.02, rel=0.2)
    again = hsnoise.fit(stack, model=fitted.params.add(found.best.effect))
    value, error, _ = again.table["photo_response_nonuniformity.sigma"]
    assert abs(value - 0.02) < 4 * error and error < 0.002
    assert hsnoise.compare(again.params, stack).fits
