"""What every effect promises, checked over the one list of effects."""

from __future__ import annotations

import ast
import inspect
import json
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hsnoise.effects
from hsnoise._core.compiling import lean_options
from hsnoise.effects import (
    ADC,
    EFFECTS,
    AbstractEffect,
    AdcNonuniformity,
    AmplifierGlow,
    BlackClamp,
    BlackLevel,
    BlackShading,
    BrighterFatter,
    Capture,
    ColumnFixedPattern,
    ColumnNoise,
    CorrelatedReadNoise,
    CosmicRays,
    Crosstalk,
    DarkCurrent,
    DarkCurrentDrift,
    DarkCurrentInstability,
    DarkCurrentNonuniformity,
    DarkSignalNonuniformity,
    ElectronMultiplication,
    FrameOffset,
    FrameSettling,
    FrameTilt,
    Gain,
    HeavyTailedReadNoise,
    HotPixels,
    ImageLag,
    Interference,
    MeasuredDistribution,
    MeasuredHits,
    MeasuredMap,
    MeasuredResponse,
    MeasuredSpectrum,
    MissingCodes,
    Nonlinearity,
    OddEvenPattern,
    PeriodicBanding,
    PhotoResponseNonuniformity,
    RandomTelegraphNoise,
    ReadNoise,
    ReadNoiseNonuniformity,
    ReadoutBandwidth,
    ReadoutOvershoot,
    RowBankNoise,
    RowFixedPattern,
    RowGain,
    RowGroupNoise,
    RowNoise,
    SharedRowGain,
    ShotNoise,
    Stage,
    TapGains,
    TapOffsets,
)
from hsnoise.model import NoiseModel, sample, sample_by_effect

KEY = jax.random.key(7)
SHAPE = (2, 4, 6)
SCALES = np.array([1.0, 0.5], np.float32)
FOLDER = Path(hsnoise.effects.__file__).parent

# One instance of each effect, for a Bayer sensor.
EXAMPLES = [
    ShotNoise(),
    DarkCurrent(51.7),
    ReadNoise(3.5),
    RowGain([0.2, 0.1, 0.05], 1.0),
    Gain([1.5, 1.2, 1.3]),
    BlackLevel([64.0, 65.0, 66.0]),
    ADC(4095),
    SharedRowGain(0.1, 1.0),
    RowNoise(2.0, 1.0),
    RowBankNoise(2.0, 1.0, 0.4),
    RowGroupNoise(2.0, 0.4, 2, 1, 2, 2),
    ColumnNoise(2.0, 1.0),
    RowFixedPattern(2.0),
    ColumnFixedPattern(2.0),
    FrameOffset(1.0),
    FrameTilt(2.0),
    FrameSettling(-3.0, 2.0),
    DarkSignalNonuniformity(2.0),
    PhotoResponseNonuniformity(0.1),
    HotPixels(0.2, 500.0),
    AmplifierGlow(200.0, 0.3),
    DarkCurrentDrift(60.0),
    DarkCurrentInstability(0.3),
    DarkCurrentNonuniformity(0.3, 0.5),
    RandomTelegraphNoise(0.5, 8.0, 0.4),
    HeavyTailedReadNoise(6.0),
    ReadNoiseNonuniformity(0.4),
    CorrelatedReadNoise(0.3, 0.5, 0.4),
    PeriodicBanding(2.0, 0.13),
    Interference(2.0, -0.13, 0.37),
    Crosstalk(0.03),
    BrighterFatter(1e-4),
    ReadoutBandwidth(0.1),
    ReadoutOvershoot(0.1),
    ImageLag(0.1),
    OddEvenPattern(1.0, 0.02),
    TapOffsets(2.0, taps=3),
    TapGains(0.1, taps=3),
    BlackShading(2.0, 0.4),
    AdcNonuniformity(0.4, 8),
    MissingCodes(2.6),
    CosmicRays(5e6, 300.0),
    ElectronMultiplication(0.9, 0.5),
    BlackClamp([70.0, 60.0, 65.0]),
    Nonlinearity(1e-3),
    MeasuredMap(
        np.arange(24.0).reshape(4, 6),
        np.linspace(0.5, 1.5, 24).reshape(4, 6),
        np.ones((4, 6)),
        growth=np.ones((4, 6)),
        photo_response=np.linspace(1.5, 0.5, 24).reshape(4, 6),
    ),
    MeasuredSpectrum([1.0, 2.0, 1.0], [0.5, 0.5], [1.0], [0.0, 1.0, 2.0]),
    MeasuredDistribution(2.0, [-5.94, -2.97, 2.97, 5.94]),
    MeasuredHits(0.3, 1.0, [20.0, 30.0, 80.0]),
    MeasuredResponse([0.0, 20.0, 40.0], [0.0, 1.0, -2.0]),
]
# Effects that draw nothing, and those that act through what another effect draws.
DETERMINISTIC = (
    Gain
    | BlackLevel
    | ADC
    | BrighterFatter
    | Crosstalk
    | ReadoutBandwidth
    | ReadoutOvershoot
    | ImageLag
    | OddEvenPattern
    | BlackShading
    | FrameSettling
    | MissingCodes
    | BlackClamp
    | Nonlinearity
    | MeasuredMap
    | MeasuredResponse
)
SHAPE_READ_NOISE = HeavyTailedReadNoise | ReadNoiseNonuniformity | CorrelatedReadNoise
each_effect = pytest.mark.parametrize("effect", EXAMPLES, ids=lambda effect: effect.name)


def model_of(effect):
    shaped = [ReadNoise(3.5)] if isinstance(effect, SHAPE_READ_NOISE) else []
    shaped += [DarkCurrent(500.0)] if isinstance(effect, DarkCurrentInstability | DarkCurrentNonuniformity) else []
    return NoiseModel([effect, *shaped], cfa="RGGB", shutter="rolling", exposure_s=0.1)


def scaled(model, scale):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32) * scale, model)


def arguments(effect):
    """What makes the same effect again."""
    return {name: getattr(effect, name) for name in effect.specs()} | effect.arrays() | effect.settings()


@pytest.fixture
def single_precision():
    """As users draw, and the same for all tests that draw: each effect is compiled once for them."""
    with jax.enable_x64(False):
        yield


def signal():
    return np.linspace(0.0, 40.0, np.prod(SHAPE)).reshape(SHAPE)


@pytest.mark.parametrize("effect", [e for e in EXAMPLES if e.arrays()], ids=lambda effect: effect.name)
def test_a_measured_array_is_checked_and_named(effect):
    for name, value in effect.arrays().items():
        for wrong, error, message in (
            ("loud", TypeError, r"expected an array \[.* got 'loud'"),
            (np.zeros((1, 1, 1)), ValueError, r"expected an array \[.* got shape \(1, 1, 1\)"),
            (np.where(np.arange(value.size).reshape(value.shape) == 0, np.nan, value), ValueError, "expected finite"),
        ):
            with pytest.raises(error, match=rf"{effect.name}\.{name}: {message}"):
                type(effect)(**{**arguments(effect), name: wrong})


def test_every_effect_has_an_example():
    assert [type(effect) for effect in EXAMPLES] == list(EFFECTS)


def test_catalogue_is_complete():
    modules = sorted(path.stem for path in FOLDER.glob("*.py") if not path.stem.startswith("_"))
    assert sorted(effect.name for effect in EFFECTS) == modules
    assert [effect.__module__ for effect in EFFECTS] == [f"hsnoise.effects.{effect.name}" for effect in EFFECTS]


def test_no_effect_imports_another():
    for path in FOLDER.glob("[a-z]*.py"):
        imports = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
        own = {node.module for node in imports if node.module.startswith("hsnoise")}
        base = {f"hsnoise.effects.{name}" for name in ("_base", "_facts", "_parameters", "_taps")}
        numbers = {f"hsnoise._core.{name}" for name in ("types", "coloured", "gamma", "poisson")}
        assert own <= numbers | base, path


@each_effect
def test_frames_depend_on_those_before_only_in_series(effect, single_precision):
    light = signal()
    brighter = np.concatenate([light[:1] + 30.0, light[1:]])
    draws = [np.asarray(sample(KEY, clean, model_of(effect))) for clean in (light, brighter)]
    assert effect.in_series or np.array_equal(draws[0][1], draws[1][1])
    if isinstance(effect, ImageLag):
        assert not np.array_equal(draws[0][1], draws[1][1])


@pytest.mark.parametrize("effect", [e for e in EXAMPLES if hasattr(e, "after_gain")], ids=lambda effect: effect.name)
def test_an_offset_behind_the_gain_is_alike_in_all_colours(effect):
    gain, rows = [1.5, 1.2, 1.3], RowGain([0.4, 0.2, 0.1], 1.0)
    behind = type(effect)(
        **{name: getattr(effect, name) for name in effect.specs()}, **{**effect.settings(), "after_gain": True}
    )
    models = [
        NoiseModel(effects, cfa="RGGB", shutter="rolling", exposure_s=0.1)
        for effects in ([effect], [behind, rows, Gain(gain)])
    ]
    electrons, counts = (np.asarray(sample(KEY, 0.0 * signal(), model)) for model in models)
    assert np.ptp(electrons) > 0
    np.testing.assert_allclose(counts, electrons * np.mean([1.5, 1.2, 1.2, 1.3]), rtol=1e-6, atol=1e-9)
    with pytest.raises(ValueError, match=rf"{effect.name}\.after_gain: expected True or False, got 'no'"):
        type(effect)(**{name: getattr(effect, name) for name in effect.specs()}, after_gain="no")


@each_effect
def test_a_parameter_that_is_no_number_is_named(effect):
    for name in effect.specs():
        with pytest.raises(TypeError, match=rf"{effect.name}\.{name}: expected a number.* got 'loud'"):
            type(effect)(**{**arguments(effect), name: "loud"})


@each_effect
def test_effect_is_final(effect):
    assert type(effect).__mro__[1] is AbstractEffect
    assert not inspect.isabstract(type(effect))
    assert isinstance(effect.stage, Stage)
    assert type(effect).__doc__


@each_effect
def test_parameters_are_declared(effect):
    leaves = jax.tree.leaves(effect)
    specs = effect.specs()
    assert len(leaves) == len(specs) + len(effect.arrays())
    assert all(spec.unit and spec.doc for spec in (*specs.values(), *effect.array_specs().values()))
    json.dumps(effect.settings())
    named = effect.parameters(("R", "G", "B"))
    assert len(named) == sum(3 if spec.per_channel else 1 for spec in specs.values())
    assert all(p.name == effect.name or p.name.startswith(f"{effect.name}.") for p in named)


@each_effect
def test_bounds_are_enforced(effect):
    for field, spec in effect.specs().items():
        outside = [np.nan, np.inf]
        outside += [] if spec.low is None else [spec.low - 1]
        outside += [] if spec.high is None else [spec.high + 1]
        for value in outside:
            with pytest.raises(ValueError, match=rf"{effect.name}\.{field}: expected finite values"):
                type(effect)(**{**arguments(effect), field: value})


@each_effect
def test_same_key_same_draw(effect, single_precision):
    model = model_of(effect)
    first, again = sample(KEY, signal(), model), sample(KEY, signal(), model)
    other = sample(jax.random.key(8), signal(), model)
    assert first.shape == SHAPE
    np.testing.assert_array_equal(first, again)
    assert np.array_equal(first, other) == isinstance(effect, DETERMINISTIC)


@pytest.mark.gpu
@each_effect
def test_an_accelerator_draws_as_the_processor(effect, single_precision):
    here = np.asarray(sample(KEY, signal(), model_of(effect)), float)
    with jax.default_device(jax.devices("cpu")[0]):
        there = np.asarray(sample(KEY, signal(), model_of(effect)), float)
    # A quantile next to a step of a Poisson number may fall on its other side.
    assert np.mean(~np.isclose(here, there, rtol=1e-4, atol=1e-4 * np.ptp(there))) < 0.05


@pytest.mark.slow  # operations one by one, each compiled by itself; models draw by compiled effects
@each_effect
def test_jit_is_eager(effect):
    model = model_of(effect)
    capture = Capture(jnp.asarray(0.1), SHAPE[1:], "RGGB", "rolling", jax.random.key(9))

    def draw(effect):
        return effect.sample(jnp.asarray(signal()), capture, key=KEY)

    eager = draw(model.effects[0])
    # XLA's other emitter for CPUs, which `make test` takes, contracts products and sums: another last bit of float32.
    jitted = jax.jit(draw, compiler_options=dict.fromkeys(lean_options(), True))
    np.testing.assert_allclose(jitted(model.effects[0]), eager, rtol=1e-12)


@cache
def batched(name):
    """Draws of two keys and scales, and their gradients by model and exposure: one program for two statements."""
    (model,) = (model_of(effect) for effect in EXAMPLES if effect.name == name)

    def smooth(model, exposure_s, key, scale):
        drawn = sample(key, signal(), scaled(model, scale), exposure_s=exposure_s * scale, differentiable=True)
        return jnp.tanh(drawn / 100).sum(), drawn

    gradient = jax.grad(smooth, argnums=(0, 1), has_aux=True)
    return jax.jit(jax.vmap(gradient, in_axes=(None, None, 0, 0)))(model, 0.1, jax.random.split(KEY, 2), SCALES)


@each_effect
def test_vmap_is_a_loop(effect, single_precision):
    _, drawn = batched(effect.name)
    for key, scale, one in zip(jax.random.split(KEY, 2), SCALES, drawn, strict=True):
        alone = sample(key, signal(), scaled(model_of(effect), scale), exposure_s=0.1 * scale)
        # Programs that are compiled apart contract products and sums differently: another last bit.
        np.testing.assert_allclose(one, alone, rtol=1e-6)


@each_effect
def test_exposures_drawn_together_are_each_as_alone(effect, single_precision):
    keys, exposures_s, light = jax.random.split(KEY, 2), (0.1, 0.3), signal()
    drawn = sample_by_effect(keys, light, 3, model_of(effect), exposures_s=exposures_s, sensor_key=KEY)
    for key, exposure_s, lit, one in zip(keys, exposures_s, light, drawn, strict=True):
        clean = np.broadcast_to(lit, (3, *SHAPE[1:]))
        alone = sample(key, clean, model_of(effect), exposure_s=exposure_s, sensor_key=KEY)
        np.testing.assert_allclose(one, alone, rtol=1e-5, atol=1e-5 * np.abs(alone).max())


@each_effect
def test_precision_follows_the_session(effect, single_precision):
    drawn = sample(KEY, signal(), model_of(effect))  # the example's own parameters are float64
    assert drawn.dtype == (jnp.uint16 if isinstance(effect, ADC) else jnp.float32)
    assert np.all(np.isfinite(drawn))
    with jax.enable_x64(True):
        drawn = jax.eval_shape(lambda: sample(KEY, signal(), model_of(effect)))
    assert drawn.dtype == (jnp.uint16 if isinstance(effect, ADC) else jnp.float64)


@each_effect
def test_gradients_are_finite(effect, single_precision):
    gradient, _ = batched(effect.name)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


@each_effect
def test_it_prints_as_it_is_written(effect):
    again = eval(repr(effect), dict(vars(hsnoise.effects)))
    assert again.settings() == effect.settings()
    for name in (*effect.specs(), *effect.arrays()):
        np.testing.assert_allclose(getattr(again, name), getattr(effect, name), rtol=1e-5)
    shown = str(model_of(effect))
    assert all(f"{effect.name}.{name} = {value}" in shown for name, value in effect.settings().items() if value)
