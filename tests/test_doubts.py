"""Does a fit say so when the frames contradict it, or what was given with them? And is it silent when they do not?"""

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest

import hsnoise
from hsnoise._core.conclusion import Light
from hsnoise.fitting.doubts._drawn import disagreements
from hsnoise.fitting.doubts.checks import Evidence, checked
from hsnoise.statistics.pixels.probe import surveyed

EXPOSURES_S, FRAMES, SHAPE = (0.1, 0.4, 1.6), 6, (96, 128)
GAIN, BLACK, READ_E = 2.0, 100.0, 4.0


def pixels_that_differ(seed: int = 0, spread: float = 1.0, light: float = 0.0, exposures=EXPOSURES_S, ends_at=65535):
    """Counts [exposure, frame, row, column] of a sensor with log-normal dark currents, or lit evenly to 1 %."""
    random = np.random.default_rng(seed)
    rate = 60 * np.exp(spread * random.standard_normal(SHAPE) - spread**2 / 2)
    rate = rate + light * (1 + 0.01 * random.standard_normal(SHAPE))
    signal = np.array(exposures)[:, None, None, None] * rate
    electrons = random.poisson(np.broadcast_to(signal, (len(exposures), FRAMES, *SHAPE)))
    counts = BLACK + GAIN * (electrons + READ_E * random.standard_normal(electrons.shape))
    return np.clip(np.round(counts), 0, ends_at).astype(np.uint16)


@pytest.fixture(scope="module")
def good():
    return hsnoise.fit(pixels_that_differ(), exposure_s=EXPOSURES_S)


def test_a_right_fit_raises_no_doubt(good):
    assert good.doubts == ()
    assert good.trustworthy
    assert good.table["gain"][0] == pytest.approx(GAIN, rel=0.05)


@pytest.mark.parametrize(
    ("where", "value", "says"),
    [
        (lambda p: p["read_noise"].sigma, 6.0, "pixel noise"),
        (lambda p: p["gain"].value, 3.0, "pixel noise"),
        (lambda p: p["black_level"].value, 130.0, "level of the typical pixel"),
        (lambda p: p["dark_current"].rate, 200.0, "does not grow with exposure"),
        (lambda p: p["row_gain"].sigma, 0.2, "row noise within frames"),
    ],
)
def test_a_parameter_that_is_wrong_is_seen_in_the_drawn_frames(good, where, value, says):
    broken = replace(good, params=eqx.tree_at(where, good.params, jax.numpy.full_like(where(good.params), value)))
    found = surveyed(good.stack)
    sentences = list(disagreements(broken, found))
    assert any(says in sentence for sentence in sentences), sentences
    assert not checked(broken, Evidence(found, good.summary)).trustworthy


def test_a_white_level_below_the_counts_is_named():
    fit = hsnoise.fit(pixels_that_differ(), exposure_s=EXPOSURES_S, white_level=400)
    assert any("above the given white level" in doubt for doubt in fit.doubts), fit.doubts
    assert not fit.trustworthy


@pytest.mark.parametrize("given", [None, 4095])
def test_counts_that_end_below_the_white_level_are_named(given):
    counts = pixels_that_differ(exposures=(0.1, 0.4, 6.4), ends_at=1500)
    fit = hsnoise.fit(counts, exposure_s=(0.1, 0.4, 6.4), white_level=given)
    assert any("saturate at 1500 DN" in doubt for doubt in fit.doubts), fit.doubts


def test_the_right_white_level_is_no_doubt():
    counts = pixels_that_differ(exposures=(0.1, 0.4, 6.4), ends_at=1500)
    fit = hsnoise.fit(counts, exposure_s=(0.1, 0.4, 6.4), white_level=1500)
    assert not any("white" in doubt for doubt in fit.doubts), fit.doubts


def test_darks_that_are_lit_are_named_and_dark_currents_are_not(good):
    lit = hsnoise.fit(pixels_that_differ(light=400.0, spread=0.2), exposure_s=EXPOSURES_S)
    assert any("Did light get in" in doubt for doubt in lit.doubts), lit.doubts
    warm = hsnoise.fit(pixels_that_differ(exposures=(0.1, 1.6, 6.4)), exposure_s=(0.1, 1.6, 6.4))
    assert not any("light" in doubt for doubt in warm.doubts), warm.doubts


@pytest.mark.parametrize(("coloured", "shutter", "doubted"), [(True, "global", True), (False, "global", False)])
def test_rows_that_go_on_contradict_a_global_shutter(coloured, shutter, doubted):
    counts = pixels_that_differ().astype(float)
    random = np.random.default_rng(1)
    rows = random.standard_normal((*counts.shape[:2], SHAPE[0] + 7))
    rows = np.stack([rows[..., k : k + SHAPE[0]] for k in range(8)]).mean(0) * 8**0.5 if coloured else rows[..., 7:]
    counts = np.round(counts + 2.0 * rows[..., None]).astype(np.uint16)
    fit = hsnoise.fit(counts, exposure_s=EXPOSURES_S, shutter=shutter)
    assert any("continues in the next row" in doubt for doubt in fit.doubts) == doubted, fit.doubts


def test_frames_that_were_smoothed_are_named(good):
    assert all(abs(plane.neighbours_share) < 0.03 for group in surveyed(good.stack).groups for plane in group.planes)
    counts = pixels_that_differ().astype(float)
    fit = hsnoise.fit(np.round((counts + np.roll(counts, 1, 3)) / 2).astype(np.uint16), exposure_s=EXPOSURES_S)
    assert any("smoothed, denoised" in doubt for doubt in fit.doubts), fit.doubts
    assert not fit.trustworthy


def test_flats_of_unequal_light_are_not_taken_for_smoothed(good):
    random = np.random.default_rng(3)
    saddle = np.multiply.outer(*(np.linspace(-1, 1, size) for size in SHAPE))
    light = np.array([8000.0, 9500.0])[:, None, None] * (1 + 0.5 * saddle)
    counts = BLACK + GAIN * random.poisson(np.broadcast_to(light, (2, *SHAPE)))
    flats = hsnoise.FrameStack(counts.astype(np.uint16)[None], exposure_s=(1.0,), kind="flat")
    fit = hsnoise.fit(hsnoise.FrameStack.join(good.stack, flats))
    assert not any("smoothed" in doubt for doubt in fit.doubts), fit.doubts


def drawn_with(effects, jump_dn=0):
    """Counts of two exposures [frame, row, column] by a model with these effects; one frame of the first jumps."""
    base = [hsnoise.effects.ShotNoise(), hsnoise.effects.DarkCurrent(400.0), hsnoise.effects.ReadNoise(READ_E)]
    end = [hsnoise.effects.Gain(GAIN), hsnoise.effects.BlackLevel(BLACK), hsnoise.effects.ADC(65535)]
    model = hsnoise.NoiseModel([*base, *effects, *end], cfa="mono", shutter="global", exposure_s=0.1)
    drawn = [
        np.array(
            hsnoise.sample_dark(jax.random.key(i), FRAMES, SHAPE, model, exposure_s=t, sensor_key=jax.random.key(7))
        )
        for i, t in enumerate((0.1, 0.4))
    ]
    drawn[0][2] += jump_dn
    return [one.astype(np.uint16) for one in drawn]


@pytest.mark.parametrize(
    ("effect", "jump_dn", "says"),
    [
        (hsnoise.effects.FrameOffset(1.0), 4, "black level jumps"),
        pytest.param(hsnoise.effects.Crosstalk(0.02), 0, "the signal is coupled", marks=pytest.mark.slow),
        pytest.param(hsnoise.effects.RandomTelegraphNoise(0.05, 40.0), 0, "Pixels differ", marks=pytest.mark.slow),
    ],
    ids=["offsets", "crosstalk", "telegraph noise"],
)
def test_what_an_effect_of_the_model_draws_is_no_doubt(effect, jump_dn, says):
    fit = hsnoise.fit(drawn_with([] if jump_dn else [effect], jump_dn), exposure_s=(0.1, 0.4), pixels="alike")
    assert any(says in doubt for doubt in fit.doubts), fit.doubts
    found = surveyed(fit.stack)
    again = checked(replace(fit, params=fit.params.add(effect)), Evidence(found, fit.summary))
    assert not any(says in doubt for doubt in again.doubts), again.doubts


def test_a_frame_beyond_the_offsets_of_the_model_is_told():
    fit = hsnoise.fit(drawn_with([], 4), exposure_s=(0.1, 0.4), pixels="alike")
    small = replace(fit, params=fit.params.add(hsnoise.effects.FrameOffset(0.1)))
    assert any("jumps" in doubt for doubt in checked(small, Evidence(surveyed(fit.stack), fit.summary)).doubts)


@pytest.mark.slow
def test_a_gain_that_nothing_tells_is_withheld_by_the_likelihood_too(rng):
    """Bias frames alone: 1.0 ± 18.9 DN/e- had been printed with a green light."""
    counts = np.rint(500 + 6.0 * rng.normal(size=(12, 96, 128)) + 0.8 * rng.normal(size=(12, 96, 1))).astype(np.uint16)
    fit = hsnoise.fit(counts, exposure_s=[0.0])
    assert np.isnan(fit.table["gain"][0]) and not fit.has_gain and not fit.trustworthy
    assert fit.conclusion.light == "amber" and "The gain is not determined" in fit.conclusion.sentence
    assert "Read noise is 6." in fit.doubts[0]


@pytest.mark.parametrize(
    ("exposure_s", "light"), [(0.002, Light.RED), pytest.param(1.0, Light.AMBER, marks=pytest.mark.slow)]
)
def test_a_gain_from_one_exposure_is_doubted(exposure_s, light, rng):
    """Rows of a CCD that have an offset look like rows of another gain; a dark current of 1e5 e-/s is none."""
    noise = 3.0 * rng.standard_normal((2, 240, 320)) + 0.5 * rng.standard_normal((2, 240, 1))
    counts = np.clip(np.round(15.0 + noise), 0, None).astype(np.uint16)
    found = hsnoise.fit(counts, exposure_s=exposure_s, shutter="global", pixels="alike")
    assert found.has_gain and found.conclusion.light == light
    assert any("All darks have one exposure" in doubt for doubt in found.doubts)


def test_noise_of_counts_that_are_clipped_is_not_trusted():
    """Black at 0: half of the counts of the shortest darks are 0, and no gain shows."""
    rng = np.random.default_rng(4)
    level, noise = rng.normal(0, 0.5, (96, 128)), rng.lognormal(np.log(3), 0.25, (96, 128))
    counts = [
        np.maximum(np.rint(level + 5 * t + noise * rng.normal(size=(8, 96, 128))), 0).astype(np.uint16)
        for t in (0.1, 1, 4)
    ]
    found = hsnoise.fit(counts, exposure_s=(0.1, 1, 4), cfa="mono", shutter="rolling", white_level=4095)
    assert found.conclusion.light == Light.RED
    assert any("of the counts are clipped at 0" in doubt for doubt in found.doubts)


@pytest.mark.parametrize("second", [1.0, 1.1])
def test_greens_of_two_gains_are_told(second):
    rng, cell = np.random.default_rng(5), np.array([[1.0, 1.0], [second, 1.0]])
    gain, dark = np.tile(cell, (48, 64)), 20 * rng.lognormal(0, 0.4, (96, 128))
    counts = [
        np.rint(100 + gain * (rng.poisson(dark * t, (8, 96, 128)) + 2.5 * rng.normal(size=(8, 96, 128))))
        for t in (0.1, 1, 4)
    ]
    found = hsnoise.fit([c.astype(np.uint16) for c in counts], exposure_s=(0.1, 1, 4), cfa="RGGB", shutter="rolling")
    told = [doubt for doubt in found.doubts if "of both together" in doubt]
    assert len(told) == (second > 1) and all("channel G" in doubt for doubt in told)
