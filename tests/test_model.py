"""The composed model: its law, its keys, its file, its errors."""

from __future__ import annotations

import json
import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from hsnoise._core.keys import named_key
from hsnoise._core.types import Scalar
from hsnoise.effects import (
    ADC,
    AbstractEffect,
    BlackLevel,
    Crosstalk,
    DarkCurrent,
    DarkCurrentNonuniformity,
    Gain,
    HeavyTailedReadNoise,
    HotPixels,
    ReadNoise,
    RowGain,
    RowNoise,
    ShotNoise,
    Stage,
    param,
)
from hsnoise.enhance.mosaic import electrons_of, mosaic
from hsnoise.model import NoiseModel, sample, sample_by_effect, sample_dark
from hsnoise.simulation.cameras import canon_5d3

pytestmark = pytest.mark.in_one
KEY = jax.random.key(19)
P_VALUE = 1e-5


class LampRipple(AbstractEffect):
    """A user's own effect: the lamp's power changes from frame to frame."""

    name: ClassVar[str] = "lamp_ripple"
    stage: ClassVar[Stage] = Stage.LIGHT
    sigma: Scalar = param("1", low=0, doc="relative standard deviation over frames")
    kind: str = eqx.field(static=True, default="normal")

    def sample(self, signal, capture, *, key):
        ripple = jax.random.normal(key, (len(signal), 1, 1), signal.dtype)
        return signal * jnp.maximum(1 + self.sigma * ripple, 0)


@pytest.mark.slow
@pytest.mark.parametrize("light", [0.0, 30.0])
def test_effects_in_one_program_draw_what_each_draws(light):
    model = canon_5d3(black_level_dn=100)
    for effect in (RowNoise(0.7), HotPixels(0.02, 90.0), Crosstalk(0.02), HeavyTailedReadNoise(5.0)):
        model = model.add(effect)
    model = model.add(DarkCurrentNonuniformity(0.4))
    clean = jnp.full((3, 32, 48), light)
    whole = sample(KEY, clean, model, exposure_s=0.05, sensor_key=1)
    one_by_one = sample_by_effect(KEY[None], clean[:1], 3, model, exposures_s=[0.05], sensor_key=jax.random.key(1))[0]
    off = np.abs(np.asarray(whole, int) - np.asarray(one_by_one, int))
    assert off.max() <= 1 and np.mean(off > 0) < 1e-3  # where rounding decides


def mono(*, row_sigma=0.0, black=0.0, white=None, gain=1.7, rate=60.0, read=1.8):
    effects = [
        ADC(white),
        BlackLevel(black),
        RowGain(row_sigma, 0.0),
        Gain(gain),
        ReadNoise(read),
        DarkCurrent(rate),
        ShotNoise(),
    ]
    return NoiseModel(effects, cfa="mono", shutter="global", exposure_s=0.05)


# Law


def count_probabilities(counts, mean_e, *, gain, read, black):
    """P(y) of Poisson(mean_e) + Normal(0, read^2), times gain, rounded; the tails in the outer counts."""
    electrons = np.arange(200)
    edges = np.concatenate([[-np.inf], counts[:-1] + 0.5, [np.inf]])
    cdf = stats.norm.cdf((edges[:, None] - black) / gain, electrons[None, :], read)
    return np.diff(cdf, axis=0) @ stats.poisson.pmf(electrons, mean_e)


@pytest.mark.parametrize(("black", "white"), [(0.0, None), (64.0, 4095), (20.0, 35)])
def test_counts_follow_the_exact_law(black, white):
    drawn = np.asarray(sample(KEY, np.full((1, 300, 300), 4.0), mono(black=black, white=white))).ravel()
    counts = np.arange(int(black) + 40 if white is None or white > 100 else white + 1)
    expected = drawn.size * count_probabilities(counts, 4.0 + 3.0, gain=1.7, read=1.8, black=black)
    observed = np.bincount(np.minimum(drawn, counts[-1]), minlength=len(counts))
    keep = expected >= 10
    observed = np.append(observed[keep], observed[~keep].sum())
    expected = np.append(expected[keep], expected[~keep].sum())
    statistic = np.sum((observed - expected) ** 2 / np.maximum(expected, 1e-12))
    assert stats.chi2.sf(statistic, len(observed) - 1) > P_VALUE


def test_mean_and_variance_of_the_composed_model():
    # y = b + K beta (S + D + R) rounded; beta = 1 +- 0.1 stays positive, the black level prevents clipping.
    frames, rows, columns, light = 60, 40, 100, 20.0
    gain, read, beta2, mean_e = 1.7, 1.8, 0.01, light + 60 * 0.05
    model = mono(row_sigma=0.1, black=100.0)
    drawn = np.asarray(sample(KEY, np.full((frames, rows, columns), light), model)).astype(float)
    within = gain**2 * (1 + beta2) * (mean_e + read**2) + 1 / 12
    between = gain**2 * beta2 * mean_e**2 + within / columns
    row_means = drawn.mean(2).ravel()
    row_variances = drawn.var(axis=2, ddof=1).ravel()
    n = frames * rows
    assert abs(row_means.mean() - 100 - gain * mean_e) < 5 * np.sqrt(between / n)
    assert abs(row_variances.mean() - within) < 5 * row_variances.std() / np.sqrt(n)
    squares = (row_means - 100 - gain * mean_e) ** 2
    assert abs(squares.mean() - between) < 5 * squares.std() / np.sqrt(n)


def test_rows_of_negative_gain_read_the_black_level():
    # A gain below zero counts as zero, so the whole row is exactly at black, a share Phi(-1 / sigma) of rows.
    drawn = np.asarray(sample(KEY, np.full((100, 200, 4), 5.0), mono(row_sigma=0.6, black=50.0)))
    dark = np.all(drawn == 50, axis=2)
    expected = stats.norm.cdf(-1 / 0.6)
    by_chance = 0.01  # rows of tiny positive gain that round to black in all four columns
    assert expected - 5 * np.sqrt(expected / dark.size) < dark.mean() < expected + by_chance


# Keys and frames


def test_adding_an_effect_leaves_the_other_draws_as_they_were():
    effects = [ReadNoise(2.0), Gain(1.5)]
    small = NoiseModel(effects, cfa="mono", shutter="rolling", exposure_s=0.05)
    dark = sample_dark(KEY, 2, (8, 8), small)
    more = small.add(DarkCurrent(100.0))
    dark_electrons = sample_dark(KEY, 2, (8, 8), more.remove("read_noise").remove("gain"))
    np.testing.assert_allclose(sample_dark(KEY, 2, (8, 8), more), dark + 1.5 * dark_electrons, rtol=1e-12)


def test_keys_are_named_and_stable():
    def bits(key):
        return tuple(np.asarray(jax.random.key_data(key)))

    assert len({bits(named_key(KEY, name)) for name in ("shot_noise", "dark_current", "read_noise", "")}) == 4
    # The check value in CRC-32's definition: keys are the same in every process and release.
    assert bits(named_key(KEY, "123456789")) == bits(jax.random.fold_in(KEY, np.uint32(0xCBF43926)))


def test_leading_indices_are_frames():
    clean = np.random.default_rng(0).uniform(0, 20, (2, 3, 8, 6))
    model = canon_5d3().remove("shot_noise").remove("dark_current")
    stacked = sample(KEY, clean, model)
    assert stacked.shape == clean.shape
    np.testing.assert_array_equal(stacked.reshape(6, 8, 6), sample(KEY, clean.reshape(6, 8, 6), model))
    assert sample(KEY, clean[0, 0], model).shape == (8, 6)
    uniform = np.asarray(sample(KEY, np.full((4, 8, 6), 9.0), model.remove("adc")))
    assert len({frame.tobytes() for frame in uniform}) == 4


def test_dark_frames_are_samples_of_no_light():
    model = canon_5d3(black_level_dn=64)
    np.testing.assert_array_equal(
        sample_dark(KEY, 2, (8, 6), model, exposure_s=1.0),
        sample(KEY, np.zeros((2, 8, 6)), model, exposure_s=1.0),
    )


@pytest.mark.slow
def test_parameters_and_exposure_may_be_traced():
    clean = np.full((1, 8, 6), 9.0)
    model = canon_5d3(black_level_dn=64)
    traced = jax.jit(lambda model, t: sample(KEY, clean, model, exposure_s=t))(model, 0.2)
    np.testing.assert_array_equal(traced, sample(KEY, clean, model, exposure_s=0.2))
    outside, exposure_s = jnp.asarray(clean), jnp.asarray(0.2)
    closed_over = jax.jit(lambda: sample(KEY, outside, model, exposure_s=exposure_s))()
    np.testing.assert_array_equal(closed_over, traced)
    times = jnp.array([0.1, 0.3])
    batch = jax.vmap(lambda t: sample(KEY, clean, model, exposure_s=t))(times)
    np.testing.assert_array_equal(batch, [sample(KEY, clean, model, exposure_s=t) for t in (0.1, 0.3)])


# Effects in a model


def test_effects_act_by_stage_then_insertion():
    names = ("shot_noise", "dark_current", "read_noise", "row_gain", "gain", "black_level", "adc")
    assert mono().names == names
    changed = mono().remove("row_gain").add(LampRipple(0.1)).add(RowGain(0.1, 0.0))
    assert changed.names == ("lamp_ripple", *names[:3], "gain", "row_gain", *names[5:])
    assert "row_gain" in changed and "row_noise" not in changed
    assert [effect.name for effect in changed] == list(changed.names)
    assert changed["gain"].value.shape == (1,)


def test_a_users_effect_takes_part(tmp_path):
    model = NoiseModel([ShotNoise()], cfa="mono", shutter="rolling", exposure_s=0.05).add(LampRipple(0.2, "other"))
    means = np.asarray(sample(KEY, np.full((400, 4, 4), 50.0), model)).mean((1, 2))
    squares = (means - 50) ** 2
    assert abs(squares.mean() - (10**2 + 50 / 16)) < 5 * squares.std() / np.sqrt(400)
    assert model.table == {"lamp_ripple.sigma": (0.2, math.nan, "1")}
    model.save(tmp_path / "model.json")
    with pytest.raises(ValueError, match=r"effect 'lamp_ripple' is not built into hsnoise; pass its class"):
        NoiseModel.load(tmp_path / "model.json")
    loaded = NoiseModel.load(tmp_path / "model.json", effects=[LampRipple])
    assert eqx.tree_equal(loaded, model)
    assert loaded["lamp_ripple"].kind == "other"


def test_table_names_values_and_units():
    assert canon_5d3().table == {
        "dark_current.rate": (51.7, math.nan, "e-/s"),
        "read_noise.sigma": (12.5**0.5, math.nan, "e-"),
        "row_gain.sigma.R": (0.197**0.5, math.nan, "1"),
        "row_gain.sigma.G": (0.039**0.5, math.nan, "1"),
        "row_gain.sigma.B": (0.013**0.5, math.nan, "1"),
        "row_gain.exponent": (1.0, math.nan, "1"),
        "row_gain.white_share": (0.0, math.nan, "1"),
        "gain.R": (1.53, math.nan, "DN/e-"),
        "gain.G": (1.23, math.nan, "DN/e-"),
        "gain.B": (1.31, math.nan, "DN/e-"),
        "black_level.R": (0.0, math.nan, "DN"),
        "black_level.G": (0.0, math.nan, "DN"),
        "black_level.B": (0.0, math.nan, "DN"),
    }
    names = "dark_current.rate read_noise.sigma row_gain.sigma row_gain.exponent row_gain.white_share gain black_level"
    assert list(mono().table) == names.split()


# File


@pytest.mark.parametrize("saved_in_x64", [True, False])
@pytest.mark.parametrize("loaded_in_x64", [True, False])
def test_save_and_load_are_exact(tmp_path, saved_in_x64, loaded_in_x64):
    path = tmp_path / "canon.json"
    with jax.enable_x64(saved_in_x64):
        model = canon_5d3(black_level_dn=[1 / 3, 2 / 3, np.pi], white_level_dn=16383)
    model.save(path, provenance={"camera": "Canon 5D Mark III", "iso": 25600})
    with jax.enable_x64(loaded_in_x64):
        loaded = NoiseModel.load(path)
    assert eqx.tree_equal(loaded, model)
    assert list(tmp_path.iterdir()) == [path]


def test_file_is_readable(tmp_path):
    path = tmp_path / "canon.json"
    with jax.enable_x64(False):
        canon_5d3().save(path, provenance={"iso": 25600})
    content = json.loads(path.read_text())
    assert content["provenance"] == {"iso": 25600}
    assert content["hsnoise_version"]
    effects = {effect["name"]: effect for effect in content["effects"]}
    assert effects["gain"]["parameters"]["value"] == {
        "value": {"R": 1.53, "G": 1.23, "B": 1.31},
        "unit": "DN/e-",
    }
    assert effects["adc"]["settings"] == {"white_level_dn": None}


def test_a_failed_save_leaves_the_old_file(tmp_path):
    path = tmp_path / "canon.json"
    canon_5d3().save(path)
    before = path.read_text()
    with pytest.raises(TypeError):
        canon_5d3().save(path, provenance={"when": object()})
    assert path.read_text() == before
    assert list(tmp_path.iterdir()) == [path]


def damaged(content, where, value):
    for step in where[:-1]:
        content = content[step]
    if value is None:
        del content[where[-1]]
    else:
        content[where[-1]] = value


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        (("format",), "other", "not a noise model"),
        (("format_version",), 99, "file format 99"),
        (("cfa",), "XYZW", "cfa: expected"),
        (("shutter",), None, "'shutter' is missing"),
        (("effects", 1, "parameters", "rate", "unit"), "e-/ms", "dark_current.rate: expected unit 'e-/s'"),
        (("effects", 1, "parameters", "rate", "value"), -1.0, "dark_current.rate: expected finite"),
        (("effects", 1, "parameters", "rate"), 118.0, "dark_current.rate: expected an object with value"),
        (("effects", 1, "parameters", "rate"), {"value": 118.0}, "expected an object with value and unit"),
        (("effects", 1, "parameters"), {"rates": 1}, "dark_current: expected parameters"),
        (("effects", 6, "settings"), {"white": 1}, "white"),
    ],
)
def test_a_damaged_file_says_what_is_wrong(tmp_path, where, value, message):
    path = tmp_path / "canon.json"
    canon_5d3().save(path)
    content = json.loads(path.read_text())
    damaged(content, where, value)
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message) as error:
        NoiseModel.load(path)
    assert str(path) in str(error.value)


def test_a_file_that_is_no_json_is_refused(tmp_path):
    path = tmp_path / "model.json"
    path.write_text("{")
    with pytest.raises(ValueError, match="not a JSON file"):
        NoiseModel.load(path)


# Errors


@pytest.mark.parametrize(
    ("clean", "message"),
    [
        (np.full((1, 4, 4), -1.0), "clean: expected finite photoelectrons >= 0"),
        (np.full((1, 4, 4), np.nan), "clean: expected finite photoelectrons >= 0"),
        (np.full((1, 4, 4), np.inf), "clean: expected finite photoelectrons >= 0"),
        (np.full((1, 4, 4), 1e39), "clean: expected finite photoelectrons >= 0"),  # infinite in float32
        (np.ones(4), r"clean: expected photoelectrons \[..., row, column\]"),
        (np.ones((0, 4, 4)), r"clean: expected photoelectrons \[..., row, column\]"),
        (np.ones((3, 4)), "clean: expected even rows and columns"),
        (np.ones((4, 3)), "clean: expected even rows and columns"),
    ],
)
def test_wrong_clean_images_are_named(clean, message):
    with pytest.raises(ValueError, match=message):
        sample(KEY, clean, canon_5d3())


@pytest.mark.parametrize("exposure_s", [-0.1, np.nan, np.inf, np.ones(2)])
def test_wrong_exposures_are_named(exposure_s):
    with pytest.raises(ValueError, match="exposure_s: expected"):
        sample_dark(KEY, 1, (4, 4), canon_5d3(), exposure_s=exposure_s)
    with pytest.raises(ValueError, match="exposure_s: expected"):
        canon_5d3(exposure_s=exposure_s)


def test_wrong_types_are_named():
    with pytest.raises(TypeError, match="params: expected a NoiseModel"):
        sample(KEY, np.ones((4, 4)), {"gain": 1.0})
    with pytest.raises(TypeError, match="clean: expected real numbers"):
        sample(KEY, np.ones((4, 4), complex), canon_5d3())
    with pytest.raises(TypeError, match="effects: expected instances of AbstractEffect"):
        NoiseModel([Gain], cfa="mono", shutter="rolling", exposure_s=0.05)


def test_wrong_models_are_refused():
    another = type("OtherGain", (Gain,), {"__doc__": "Another effect of the same name."})
    with pytest.raises(ValueError, match="gain given twice"):
        canon_5d3().add(another(1.0))
    with pytest.raises(KeyError, match="no effect 'glow' in this model, which has shot_noise"):
        canon_5d3().remove("glow")
    with pytest.raises(ValueError, match="gain.value: expected a scalar or one value per channel, R, G, B"):
        NoiseModel([Gain([1.0, 2.0])], cfa="RGGB", shutter="rolling", exposure_s=0.05)
    with pytest.raises(ValueError, match="read_noise.sigma: expected a scalar, got shape"):
        NoiseModel([ReadNoise([1.0, 2.0])], cfa="RGGB", shutter="rolling", exposure_s=0.05)
    with pytest.raises(ValueError, match="cfa: expected"):
        canon_5d3(cfa="RGB")
    with pytest.raises(ValueError, match="shutter: expected"):
        canon_5d3(shutter="slow")


@pytest.mark.parametrize(
    ("name", "field", "value", "error", "message"),
    [
        ("gain", "value", -1.0, ValueError, r"gain\.value: expected finite values in \[0"),
        ("gain", "value", np.nan, ValueError, r"gain\.value: expected finite"),
        ("gain", "value", [1.0, 2.0], ValueError, r"gain\.value: expected a scalar or one value per channel"),
        ("read_noise", "sigma", "loud", TypeError, r"read_noise\.sigma: expected a number"),
        ("read_noise", "sigmaa", 1.0, ValueError, r"field: expected a parameter of read_noise \(sigma\)"),
        ("row_noise", "sigma", 1.0, KeyError, "row_noise"),
    ],
)
def test_a_value_that_a_parameter_cannot_have_is_refused(name, field, value, error, message):
    with pytest.raises(error, match=message):
        canon_5d3().with_value(name, field, value)


@pytest.mark.parametrize(
    "key", [0.0, "0", np.zeros(2), jax.random.split(jax.random.key(0), 3)], ids=["float", "text", "floats", "several"]
)
@pytest.mark.parametrize("name", ["key", "sensor_key"])
def test_what_is_no_random_key_is_named(name, key):
    keys = {"key": jax.random.key(0), "sensor_key": jax.random.key(1), name: key}
    with pytest.raises(TypeError, match=f"^{name}: expected a whole number from 0 to 4294967295 or one random key"):
        sample(keys["key"], np.zeros((1, 4, 4)), canon_5d3(), sensor_key=keys["sensor_key"])


@pytest.mark.slow
def test_draws_within_a_larger_program_are_the_same_and_stay_whole():
    """XLA would compute them anew for each of the colours that are taken from them."""
    camera, light = canon_5d3(), jnp.linspace(0.0, 30.0, 2 * 16 * 24 * 3).reshape(2, 16, 24, 3)

    def planes(key, light):
        return electrons_of(sample(key, mosaic(light, camera.cfa), camera), camera)

    compiled = jax.jit(planes).lower(jax.random.key(3), light).compile()
    assert jax.default_backend() != "cpu" or "conditional" in compiled.as_text()
    np.testing.assert_allclose(compiled(jax.random.key(3), light), planes(jax.random.key(3), light), rtol=1e-6)
    keys = jax.random.split(jax.random.key(4), 2)
    batch = jax.jit(jax.vmap(planes, (0, None)))(keys, light)
    np.testing.assert_allclose(batch, [planes(key, light) for key in keys], rtol=1e-6)


@pytest.mark.parametrize(
    ("n_frames", "shape", "error", "message"),
    [
        ((6, 96, 128), 0.1, TypeError, "n_frames: expected a whole number"),
        (6, (6, 96, 128), ValueError, r"shape: expected \(rows, columns\)"),
        (6, 96, ValueError, r"shape: expected \(rows, columns\)"),
        (0, (4, 4), ValueError, "n_frames: expected at least 1"),
        (1, (4, -4), ValueError, "shape: expected at least 1"),
    ],
)
def test_sizes_of_dark_frames_are_checked(n_frames, shape, error, message):
    with pytest.raises(error, match=message):
        sample_dark(jax.random.key(0), n_frames, shape, canon_5d3())
