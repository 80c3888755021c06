"""Photon transfer of flats measured on frames: what is no noise must not enter the gain, on drawn and real sensors."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise import FrameStack
from hsnoise._core.types import StatedGain
from hsnoise.fitting.flat_notes import gain_notes, stated_gain_note
from hsnoise.fitting.pixel_flats import between
from hsnoise.likelihood.flat_gain import flat_gain
from hsnoise.likelihood.flats import flat_moments

GAIN, READ_E, BLACK_DN, WHITE_DN, SHAPE = 0.5, 8.0, 200.0, 4095, (96, 128)
FULL_E = (WHITE_DN - BLACK_DN) / GAIN


class Sensor:
    """Pixels that differ in response by 1 %, under dust and a lamp that is brighter on one side."""

    def __init__(self, rng, short=0.0, shape=SHAPE):
        self.rng, self.short, self.shape = rng, short, shape
        column = np.linspace(-1, 1, shape[1])
        self.response = (1 + 0.01 * rng.standard_normal(shape)) * (1 + 0.05 * column)
        self.response[20:30, 20:30] *= 0.8

    def frames(self, light_e, n=1, gradient=0.0):
        column = np.linspace(-1, 1, self.shape[1])
        light = light_e * self.response * (1 + gradient * column)
        electrons = self.rng.poisson(light, (n, *self.shape))
        dn = GAIN * electrons * (1 - self.short * electrons / FULL_E) + GAIN * READ_E * self.rng.standard_normal(
            electrons.shape
        )
        return np.clip(np.rint(BLACK_DN + dn), 0, WHITE_DN).astype(np.uint16)

    def series(self, light_e, n=4):
        """A level of a lamp that flickers by 1 %, with cosmic rays."""
        out = np.concatenate([self.frames(light_e * (1 + 0.01 * self.rng.standard_normal())) for _ in range(n)])
        hits = tuple(self.rng.integers(0, size, 5) for size in out.shape)
        out[hits] = WHITE_DN
        return out


def stack_of(darks, flats, **options):
    stacks = [
        FrameStack(counts, times, kind=kind, shutter="global", **options)
        for kind, counts, times in (
            ("dark", [darks], [0.0]),
            ("flat", flats, [0.1 + 0.1 * i for i in range(len(flats))]),
        )
    ]
    return FrameStack.join(*stacks)


def measured(stack):
    flats = flat_moments(stack, lambda: None)
    return flat_gain(flats), flats


def pulls(found):
    return np.array([(one.gain[0] - GAIN) / one.standard_error[0] for one in found])


@pytest.mark.parametrize("short", [0.0, 0.02], ids=["straight", "bent"])
def test_flicker_dust_response_and_cosmic_rays_do_not_enter_the_gain(short):
    lights, found = FULL_E * np.array([0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8]), []
    for seed in range(10):
        sensor = Sensor(np.random.default_rng([seed, 7]), short)
        found.append(measured(stack_of(sensor.frames(0, 6), [sensor.series(e) for e in lights]))[0])
    pull = pulls(found)
    assert abs(pull.mean()) < 4 / np.sqrt(len(pull)) and 0.4 < pull.std() < 1.7
    assert all(one.described[0] and one.standard_error[0] < 0.02 * GAIN for one in found)


@pytest.mark.parametrize("white_level", [WHITE_DN, None])
def test_pixels_that_saturate_are_left_out_without_bias(rng, white_level):
    sensor = Sensor(rng)
    flats = [sensor.frames(FULL_E * share, 6) for share in (0.1, 0.5, 0.92)]  # 5 % more light on one side
    found, moments = measured(stack_of(sensor.frames(0, 6), flats, white_level=white_level))
    if white_level is not None:
        assert moments.dof[2, 0] < 0.95 * moments.dof[1, 0]
    assert abs(found.level_gain[2, 0] - GAIN) < 4 * found.level_error[2, 0]
    assert abs(found.gain[0] - GAIN) < 4 * found.standard_error[0]


def test_a_level_where_most_pixels_saturate_is_set_aside_and_named(rng):
    sensor = Sensor(rng)
    flats = [sensor.frames(FULL_E * share, 4) for share in (0.1, 0.5, 1.0)]
    found, moments = measured(stack_of(sensor.frames(0, 6), flats))
    assert len(moments.mean_dn) == 2 and "of the pixels clip" in moments.set_aside[0]
    assert abs(found.gain[0] - GAIN) < 4 * found.standard_error[0]


def test_singles_of_a_twilight_are_paired_and_a_lone_one_is_set_aside():
    found = []
    for seed in range(12):
        rng = np.random.default_rng([seed, 11])
        sensor, other = Sensor(rng), Sensor(rng)  # through another filter the pattern is another
        lights = FULL_E * 0.8 * 0.85 ** np.arange(7)
        flats = [sensor.frames(e, gradient=0.002 * i) for i, e in enumerate(lights)]
        flats += [other.frames(FULL_E * 0.6), other.frames(FULL_E * 0.5)]
        one, moments = measured(stack_of(sensor.frames(0, 6), flats))
        assert len(moments.mean_dn) == 4 and "a single frame" in moments.set_aside[0]
        found.append(one)
    pull = pulls(found)
    assert abs(pull.mean()) < 4 / np.sqrt(len(pull)) and 0.4 < pull.std() < 1.7
    assert all(one.standard_error[0] < 0.02 * GAIN for one in found)


@pytest.mark.slow
def test_flats_of_another_crop_join_the_fit_of_the_darks(rng):
    sensor, elsewhere = Sensor(rng), Sensor(rng, shape=(64, 160))
    flats = FrameStack([elsewhere.frames(e, 4) for e in (300, 3000)], [0.1, 0.2], kind="flat", shutter="global")
    darks = FrameStack([sensor.frames(0, 4)], [0.0], kind="dark", shutter="global")
    fit = hsnoise.fit(FrameStack.join(darks, flats))
    for name, truth in (("gain", GAIN), ("read_noise.sigma", READ_E), ("black_level", BLACK_DN)):
        value, error, _ = fit.table[name]
        assert abs(value - truth) < 4.5 * error and error < 0.03 * truth


@pytest.mark.slow
def test_a_bent_response_leaves_gain_and_read_noise_of_the_fit_alone(rng):
    sensor = Sensor(rng, short=0.02)
    flats = [sensor.frames(FULL_E * share, 8) for share in (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9)]
    fit = hsnoise.fit(stack_of(sensor.frames(0, 6), flats))
    for name, truth in (("gain", GAIN), ("read_noise.sigma", READ_E)):
        value, error, _ = fit.table[name]
        assert abs(value - truth) < 4.5 * error and error < 0.02 * truth
    assert any("The response bends" in note for note in fit.notes)


def test_what_lies_above_full_wells_is_neither_response_nor_compared(rng):
    """Charge that spills over evens out pixels: their response came out 6 times too small, with an error of 1 %."""
    sensor, lights = Sensor(rng), (500.0, 1500.0, 2500.0, 3500.0)
    sensor.response = 1 + 0.01 * rng.standard_normal(SHAPE)  # no dust, which the model does not have
    levels = [sensor.frames(light, 4) for light in lights]
    for light, left in ((6000.0, 0.3), (7000.0, 0.1)):
        full = BLACK_DN + GAIN * light
        levels.append(np.rint(full + left * (sensor.frames(light, 4) - full)).astype(np.uint16))
    stack = FrameStack([sensor.frames(0, 8), *levels], [0.01] * 7, kind=["dark"] + ["flat"] * 6, shutter="global")
    fit = hsnoise.fit(stack)
    value, error, _ = fit.table["photo_response_nonuniformity.sigma"]
    assert abs(value - 0.01) < 4 * error < 2e-3
    assert abs(fit.table["gain"][0] - GAIN) < 4 * fit.table["gain"][1]
    report = hsnoise.compare(fit, stack)
    assert report.error < 4
    assert "4 levels of flats not compared: above 70 %" in " ".join(str(report).split())


def test_flats_that_are_all_saturated_are_a_doubt(rng):
    """They gave the spread of the full wells as photo response, in green, and "gain from the flats"."""
    dark_e, wells = 20.0 * rng.lognormal(0, 0.5, SHAPE), 6000.0 * (1 + 0.03 * rng.standard_normal(SHAPE))

    def taken(electrons):
        return np.rint(BLACK_DN + GAIN * (electrons + READ_E * rng.standard_normal((8, *SHAPE)))).astype(np.uint16)

    darks = [taken(rng.poisson(dark_e * t, (8, *SHAPE))) for t in (0.0, 4.0, 16.0)]
    flats = [taken(np.minimum(rng.poisson(light, (8, *SHAPE)), wells)) for light in (8000.0, 9000.0)]
    kind, exposure_s = ["dark"] * 3 + ["flat"] * 2, [0.0, 4.0, 16.0, 0.01, 0.01]
    fit = hsnoise.fit(FrameStack([*darks, *flats], exposure_s, kind=kind, shutter="global"))
    assert abs(fit.table["gain"][0] - GAIN) < 4 * fit.table["gain"][1]
    assert "photo_response_nonuniformity.sigma" not in fit.table and "gain from the flats" not in str(fit)
    assert any("they are saturated, or the gain is wrong" in doubt for doubt in fit.doubts)


@pytest.mark.parametrize("lights", [(6000.0,), (3000.0, 6000.0)], ids=len)
def test_one_level_of_flats_beside_bias_frames_is_a_doubt(rng, lights):
    """Near a full well its gain was 24 % too small, in green: nothing shows that the response bends there."""
    sensor = Sensor(rng)
    frames = [sensor.frames(0, 8), *(sensor.frames(light, 4) for light in lights)]
    exposure_s, kind = [0.01] * len(frames), ["dark"] + ["flat"] * len(lights)
    fit = hsnoise.fit(FrameStack(frames, exposure_s, kind=kind, shutter="global", white_level=WHITE_DN))
    assert abs(fit.table["gain"][0] - GAIN) < 4 * fit.table["gain"][1]
    assert any("One level of flats determines the gain" in doubt for doubt in fit.doubts) == (len(lights) == 1)


def test_levels_that_disagree_show_it_in_the_error():
    same, apart = [(0.010, 1e-4), (0.0102, 1e-4)], [(0.010, 1e-5), (0.012, 1e-5), (0.011, 1e-3)]
    assert between(*np.array(same).T) == 0
    assert between(*np.array(apart).T) == pytest.approx(0.001, rel=0.01)


def test_a_stated_gain_that_is_wrong_is_named():
    right, wrong = StatedGain(1 / 2.62, "EGAIN 2.62 e-/DN", True), StatedGain(1 / 1.5, "GAIN 1.5", False)
    assert stated_gain_note(right, 0.372, 0.001) == stated_gain_note(None, 0.372, 0.001) == []
    assert "The header states GAIN 1.5, but these frames say 2.29 e-/DN" in stated_gain_note(wrong, 0.436, 0.001)[0]


def fits_of(folder, pattern):
    fits = pytest.importorskip("astropy.io.fits")
    return np.stack([fits.getdata(file) for file in sorted(folder.glob(pattern))])


def real_sensor(name, data):
    """Darks and flats of a set: [(exposure, frames)] of each, and overscan of the flats or None."""
    if name in ("imx541_mono_emva", "sbig_stl1001_ccd"):
        with np.load(data / f"{name}.npz") as arrays:
            if name == "sbig_stl1001_ccd":
                return [arrays["bias_m05C"]], [arrays["flat_m05C_023s"]], None
            return [arrays["dark_000025us"]], [arrays[k] for k in arrays.files if k.startswith("flat")], None
    if name == "sbig_st8_cc0":
        return [fits_of(data, f"{name}/darkflat3s/*")], [fits_of(data, f"{name}/flat3s/*")], None
    if name == "ccd_kaf_mit":
        return [fits_of(data, f"{name}/bias/*")], list(fits_of(data, f"{name}/flat/*")[:, None]), None
    if name == "site_2k_ccd":
        pairs = [fits_of(data, f"{name}/pairs_i/*_{i}_0*") for i in (1, 2)]
        flats = [
            fits_of(data, f"{name}/flat_v/*"),
            *np.stack(pairs, 1),
            *fits_of(data, f"{name}/linearity_v/*")[:, None],
        ]
        return (
            [fits_of(data, f"{name}/bias/*")[..., :268]],
            [f[..., :268] for f in flats],
            [f[..., 276:].mean() for f in flats],
        )
    image = pytest.importorskip("PIL.Image")
    folder = next((data / "emva1288").glob(f"{name}*")) / "images"

    def level(kind, i):
        return np.stack([np.asarray(image.open(file)) for file in sorted(folder.glob(f"{kind}_{i:03d}_snap_*.png"))])

    numbers = sorted({int(file.name[2:5]) for file in folder.glob("b_0*.png")})
    flats = [one for i in numbers if np.ptp(one := level("b", i)) > 0]
    return [level("d", numbers[0])], flats, None


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("imx541_mono_emva", 0.4221 * 0.99, 0.4221 * 1.01),
        ("sbig_stl1001_ccd", 0.515, 0.525),
        ("sbig_st8_cc0", 1 / 2.70, 1 / 2.68),
        ("ccd_kaf_mit", 1 / 2.35, 1 / 2.28),
        ("site_2k_ccd", 1 / 5.05, 1 / 4.85),
        ("001", 0.28035 * 0.995, 0.28035 * 1.005),
        ("002", 0.02063 * 0.99, 0.02063 * 1.01),
    ],
)
def test_the_gain_of_real_flats(shared_data, name, low, high):
    darks, flats, overscan = real_sensor(name, shared_data / "data")
    times = [0.1] * len(flats)
    stack = FrameStack.join(FrameStack(darks, [0.0]), FrameStack(flats, times, kind="flat", overscan_dn=overscan))
    found, moments = measured(stack)
    assert low <= found.gain[0] <= high
    assert found.standard_error[0] < 0.08 * found.gain[0]
    notes = " ".join(gain_notes(found, moments, ("mono",)))
    if name == "site_2k_ccd":
        assert "The black level falls with the signal" in notes and "near saturation" in notes


def test_pixels_that_differ_in_light_alone_are_measured(rng):
    """Nothing differed in the darks, so the photo response was left out: `compare` of a right gain ended at 9800."""
    response = 1 + 0.008 * rng.standard_normal((192, 256))

    def frames(light_e, seconds, n):
        electrons = rng.poisson(light_e * response + 20 * seconds, (n, *response.shape))
        return np.rint(BLACK_DN + GAIN * (electrons + READ_E * rng.standard_normal(electrons.shape))).astype(np.uint16)

    darks = [frames(0, t, 6) for t in (0.0, 5.0, 20.0)]
    flats = [frames(light, 0, 4) for light in (800, 1600, 2800, 4000, 5200)]
    kind, exposure_s = ["dark"] * 3 + ["flat"] * 5, [0.0, 5.0, 20.0, 0.01, 0.02, 0.035, 0.05, 0.065]
    stack = FrameStack([*darks, *flats], exposure_s, kind=kind, shutter="global")
    fit = hsnoise.fit(stack)
    value, error, _ = fit.table["photo_response_nonuniformity.sigma"]
    assert abs(value - 0.008) < 4 * error < 3e-4
    assert hsnoise.compare(fit, stack, draws=20).error < 3


def test_darks_narrower_than_a_count_leave_the_gain_of_the_flats_alone(rng):
    """Their variance, which rounding changes, bent the curve of the flats: gains 3 % too large, in green."""
    gain, read_e, offset = 0.05, 6.0, 64 + 0.05 * rng.standard_normal((192, 256))

    def frames(light_e, n):
        electrons = rng.poisson(light_e, (n, *offset.shape)) + read_e * rng.standard_normal((n, *offset.shape))
        return np.rint(offset + gain * electrons).astype(np.uint16)

    counts = [frames(0, 8), *(frames(light, 4) for light in np.linspace(0.05, 0.9, 8) * 19000)]
    stack = FrameStack(counts, [0.01] * 9, kind=["dark"] + ["flat"] * 8, shutter="global")
    fit = hsnoise.fit(stack)
    for name, truth, most in (("gain", gain, 0.05), ("read_noise.sigma", read_e, 0.08)):
        value, error, _ = fit.table[name]
        assert abs(value - truth) < 4 * error < most * truth
