"""Measured components: their draws have the spectra, quantiles and maps that were given, in frames of any size."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import hsnoise
from hsnoise.effects import (
    DarkCurrent,
    MeasuredDistribution,
    MeasuredHits,
    MeasuredMap,
    MeasuredResponse,
    MeasuredSpectrum,
    ReadNoise,
    ShotNoise,
)
from hsnoise.effects.measured_distribution import knots, moments_of, normalised
from hsnoise.effects.measured_spectrum import bins_of
from hsnoise.model import NoiseModel, sample, sample_by_effect, sample_dark

KEY = jax.random.key(31)
SIGMAS = 5.0


def darks(*effects, frames=4, shape=(32, 32), cfa="mono", exposure_s=1.0):
    model = NoiseModel(effects, cfa=cfa, shutter="global", exposure_s=1.0)
    return np.asarray(sample_dark(KEY, frames, shape, model, exposure_s=exposure_s))


@pytest.mark.parametrize(
    ("axis", "frames", "shape"), [("row", 600, (64, 2)), ("column", 600, (2, 64)), ("pixel", 20, (50, 64))]
)
def test_series_have_their_spectrum(axis, frames, shape):
    power = np.linspace(1.0, 9.0, 33) + 20 * (np.arange(33) == 10)
    drawn = darks(MeasuredSpectrum(**{axis: power}), frames=frames, shape=shape)
    series = {"row": drawn[:, :, 0], "column": drawn[:, 0], "pixel": drawn.reshape(-1, 64)}[axis]
    found = (np.abs(np.fft.rfft(series, axis=1)) ** 2).mean(0) / 64
    # A periodogram bin is exponential; those at 0 and 0.5 have one degree of freedom.
    assert np.all(np.abs(found / power - 1) < SIGMAS * np.sqrt(2 / len(series)))
    other = {"row": 2, "column": 1}.get(axis)
    assert other is None or np.ptp(drawn, axis=other).max() == 0


def test_frames_have_their_variance_and_are_no_series():
    effect = MeasuredSpectrum(frame=[4.0])
    drawn = darks(effect, frames=4000, shape=(1, 1)).ravel()
    assert abs(drawn.var() / 4 - 1) < SIGMAS * np.sqrt(2 / 4000) and not effect.in_series
    coloured = MeasuredSpectrum(frame=[0.0, 0.0, 8.0])
    slow = darks(coloured, frames=4000, shape=(1, 1)).ravel()
    assert coloured.in_series and np.mean(slow[1:] * slow[:-1]) < -0.5 * slow.var()


@pytest.mark.parametrize("n", [8, 31, 200])
def test_a_spectrum_keeps_its_variance_in_series_of_any_length(n):
    power = np.linspace(1.0, 3.0, 33) + 50 * (np.arange(33) == 32)  # a line at the highest frequency
    same = np.asarray(bins_of(power, 64))
    np.testing.assert_allclose(same[:33], power, rtol=1e-6)
    np.testing.assert_allclose(np.mean(bins_of(power, n)), np.mean(same), rtol=2 / n)


def test_the_distribution_has_its_quantiles():
    law = stats.gamma(2.0)
    quantiles = normalised(law.ppf(knots(512)))
    drawn = darks(MeasuredDistribution(3.0, quantiles), frames=20, shape=(100, 100)).ravel()
    assert stats.kstest(drawn / 3 * law.std() + law.mean(), law.cdf).pvalue > 1e-4
    assert abs(drawn.mean()) < SIGMAS * 3 / np.sqrt(drawn.size)
    assert abs(drawn.var() / 9 - 1) < SIGMAS * np.sqrt((law.stats("k") + 2) / drawn.size)
    assert moments_of(quantiles)[2] == pytest.approx(3.0, rel=0.02)


def test_the_scale_of_read_noise_holds_for_both_its_parts():
    scale = np.where(np.arange(64) < 32, 0.5, np.sqrt(1.75)) * np.ones((64, 1))
    effects = ReadNoise(3.0), MeasuredDistribution(4.0, normalised(stats.t(5).ppf(knots(512))))
    drawn = darks(*effects, MeasuredMap(read_noise=scale), frames=100, shape=(64, 64))
    assert abs(drawn[..., :32].var() / (25 * 0.25) - 1) < 0.03 and abs(drawn[..., 32:].var() / (25 * 1.75) - 1) < 0.03


def test_hits_have_their_share_and_amplitudes():
    drawn = darks(MeasuredHits(0.01, 0.02, [10.0, 20.0, 60.0]), frames=40, shape=(100, 100), exposure_s=2.0)
    hits = drawn[drawn != 0]
    assert abs(len(hits) - 0.05 * drawn.size) < SIGMAS * np.sqrt(0.05 * drawn.size)
    assert stats.kstest(hits, lambda x: np.interp(x, [10.0, 20.0, 60.0], [0, 0.5, 1])).pvalue > 1e-4


def test_maps_give_each_pixel_its_own():
    rng = np.random.default_rng(1)
    dark = rng.lognormal(0, 1, (16, 16))
    whole = MeasuredMap(rng.normal(0, 5, (16, 16)), dark / dark.mean(), growth=np.full((16, 16), -2.0))
    drawn = darks(ShotNoise(), DarkCurrent(100.0), ReadNoise(1.0), whole, frames=400, shape=(16, 16), exposure_s=3.0)
    expected = np.asarray(whole.offset) - 6 + 300 * np.asarray(whole.dark_current)
    error = np.sqrt((300 * np.asarray(whole.dark_current) + 1) / 400)
    assert np.abs((drawn.mean(0) - expected) / error).max() < SIGMAS
    changing = MeasuredMap(dark_current=dark / dark.mean(), dark_fluctuation=np.full((16, 16), 0.2))
    other = darks(ShotNoise(), DarkCurrent(1e5), changing, frames=400, shape=(16, 16))
    np.testing.assert_allclose(np.median(other.std(0) / other.mean(0)), 0.2, rtol=0.05)


def test_light_falls_on_each_pixel_by_its_response_and_dark_current_does_not():
    response = np.random.default_rng(2).uniform(0.5, 1.5, (16, 16))
    response /= response.mean()
    effects = ShotNoise(), DarkCurrent(20.0), ReadNoise(1.0), MeasuredMap(photo_response=response)
    model = NoiseModel(effects, cfa="mono", shutter="global", exposure_s=1.0)
    expected = 100 * response + 20
    lit = np.full((400, 16, 16), 100.0)
    (by_effect,) = sample_by_effect(KEY[None], lit[:1], 400, model, exposures_s=[1.0], sensor_key=KEY)
    for drawn in (sample(KEY, lit, model), by_effect):
        drawn = np.asarray(drawn)
        assert np.abs((drawn.mean(0) - expected) / np.sqrt((expected + 1) / 400)).max() < SIGMAS
        np.testing.assert_allclose(drawn.var(0).mean(), expected.mean() + 1, rtol=0.02)
    assert np.asarray(sample(KEY, np.zeros((400, 16, 16)), model)).mean() == pytest.approx(20.0, rel=0.01)


@pytest.mark.parametrize("cfa", ["mono", "RGGB"])
def test_beyond_the_map_come_mirrored_copies_of_the_same_colours(cfa):
    offset = np.arange(24.0).reshape(4, 6)
    with pytest.warns(UserWarning, match="measured_map: frames of 8 x 12 pixels reach beyond the map of 4 x 6"):
        drawn = darks(MeasuredMap(offset), frames=1, shape=(8, 12), cfa=cfa)[0]
    np.testing.assert_array_equal(drawn[:4, :6], offset)
    if cfa == "mono":
        np.testing.assert_array_equal(drawn[:4, 6:], offset[:, ::-1])
        np.testing.assert_array_equal(drawn[4:], drawn[3::-1])
    else:
        np.testing.assert_array_equal(drawn[:4, 6:], offset[:, [4, 5, 2, 3, 0, 1]])
        np.testing.assert_array_equal(drawn[4:, :6], offset[[2, 3, 0, 1]])


def test_a_window_takes_the_part_of_a_map_that_begins_inside_the_sensor():
    model = NoiseModel([MeasuredMap(np.arange(64.0).reshape(8, 8), first=(10, 20))], **KEYWORDS)
    drawn = sample(KEY, np.zeros((1, 2, 3)), model, window=(12, 21, 40, 40))[0]
    np.testing.assert_array_equal(drawn, np.arange(64.0).reshape(8, 8)[2:4, 1:4])


KEYWORDS = {"cfa": "mono", "shutter": "global", "exposure_s": 1.0}


def test_the_response_bends_and_has_a_gradient():
    model = NoiseModel([MeasuredResponse([0.0, 100.0, 200.0], [0.0, -4.0, 0.0])], **KEYWORDS)
    light = np.array([[-10.0, 50.0, 100.0, 150.0, 300.0]]).clip(0)
    np.testing.assert_allclose(sample(KEY, light, model), [[0.0, 48.0, 96.0, 148.0, 300.0]])
    slope = jax.grad(lambda x: sample(KEY, x, model, differentiable=True).sum())(jnp.asarray(light[:, 1:4:2]))
    np.testing.assert_allclose(slope, [[0.96, 1.04]])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MeasuredMap(np.zeros((4, 4)), np.ones((4, 5))), "expected maps of one shape"),
        (lambda: MeasuredMap(dark_current=np.full((4, 4), 2.0)), "dark_current: expected a mean of 1, got 2"),
        (lambda: MeasuredMap(photo_response=np.full((4, 4), 0.5)), "photo_response: expected a mean of 1, got 0.5"),
        (lambda: MeasuredMap(read_noise=np.full((4, 4), 2.0)), "read_noise: expected a mean square of 1, got 4"),
        (lambda: MeasuredMap(dark_current=-np.ones((4, 4))), "dark_current: expected finite numbers >= 0"),
        (lambda: MeasuredSpectrum(row=[-1.0, 3.0]), "row: expected finite numbers >= 0"),
        (lambda: MeasuredDistribution(1.0, [1.0, -1.0]), "two quantiles or more that do not fall"),
        (lambda: MeasuredDistribution(1.0, [-1.0, 3.0]), "a mean of 0 and an rms of 1"),
        (lambda: MeasuredHits(0.1, 0.0, [3.0, 1.0]), "quantiles or more that do not fall"),
        (lambda: MeasuredResponse([0.0, 1.0], [0.0]), "as many excesses as levels, got 1, 2"),
        (lambda: MeasuredResponse([0.0, 0.0], [0.0, 1.0]), "levels that rise"),
        (lambda: MeasuredResponse([0.0, 1.0], [0.0, -2.0]), "a response that does not fall"),
    ],
)
def test_what_cannot_be_measured_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def model_with_arrays():
    rng = np.random.default_rng(0)
    whole = MeasuredMap(rng.normal(0, 1, (4, 6)).astype(np.float32), read_noise=np.ones((4, 6)))
    return hsnoise.cameras.grasshopper3(black_level_dn=64).add(whole).add(MeasuredSpectrum(row=[0.0, 1.0, 0.1]))


def test_a_model_with_arrays_comes_back_bit_by_bit(tmp_path):
    model = model_with_arrays()
    model.save(tmp_path / "model.json")
    again = NoiseModel.load(tmp_path / "model.json")
    for one, other in zip(jax.tree.leaves(model), jax.tree.leaves(again), strict=True):
        assert one.dtype == other.dtype and np.array_equal(one, other)
    drawn, also = (np.asarray(sample_dark(KEY, 2, (4, 6), one)) for one in (model, again))
    np.testing.assert_array_equal(drawn, also)
    assert again.table == model.table and again.table["measured_map.offset"][2] == "DN"
    assert len((tmp_path / "model.json").read_text()) < 5000
    model.save(tmp_path / "model.json")  # over its own files


def test_a_model_without_arrays_writes_one_file(tmp_path):
    hsnoise.cameras.grasshopper3().save(tmp_path / "model.json")
    assert [path.name for path in tmp_path.iterdir()] == ["model.json"]


def test_bad_files_of_arrays_are_named(tmp_path):
    path, beside = tmp_path / "model.json", tmp_path / "model.npz"
    model_with_arrays().save(path)
    whole = beside.read_bytes()
    beside.write_bytes(whole[:-10])
    with pytest.raises(ValueError, match=r"model.npz is damaged, or belongs to another model"):
        NoiseModel.load(path)
    beside.unlink()
    with pytest.raises(ValueError, match=r"model.json: its measured arrays are in model.npz, which is not beside it"):
        NoiseModel.load(path)
    np.savez(beside, counts=np.zeros(3))
    with pytest.raises(ValueError, match=r"model.npz, which holds something else"):
        model_with_arrays().save(path)
    assert np.load(beside)["counts"].shape == (3,)
    beside.write_bytes(whole)
    stated = json.loads(path.read_text())
    for wrong in ("model.npz", {"file": 3, "sha256": "0"}, {"file": "model.npz"}):
        other = tmp_path / "other.json"
        other.write_text(json.dumps({**stated, "arrays": wrong}))
        with pytest.raises(ValueError, match=r"other.json: arrays: expected"):
            NoiseModel.load(other)
    stated["effects"][-1]["arrays"] = ["row"]
    other.write_text(json.dumps(stated))
    with pytest.raises(ValueError, match=r"other.json: "):
        NoiseModel.load(other)
    path.write_text(path.read_text().replace('"DN^2"', '"DN"'))
    with pytest.raises(ValueError, match=r"measured_spectrum.row: expected unit 'DN\^2', got 'DN'"):
        NoiseModel.load(path)
