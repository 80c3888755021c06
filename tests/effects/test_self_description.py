"""What every effect says about itself, checked over the one list of effects: amplitudes, proposals, components."""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.chain.effect_json import effect_from_json, effect_to_json
from hsnoise.criticism import rules
from hsnoise.criticism.candidates import built_in, can_be_proposed, facts_of, given, made
from hsnoise.effects import EFFECTS, AbstractEffect, Capture, CaptureFacts, Places
from hsnoise.likelihood.parameters import IN_LIKELIHOOD
from hsnoise.simulation.draws import draw_capture
from hsnoise.simulation.portion import Portion
from hsnoise.statistics.decomposition import COMPONENTS, STATIC, PlaneSums

SENSORS, FRAMES, SHAPE = 24, 8, (24, 32)
GAIN = (1500.0, 1200.0, 1300.0)  # DN/e-: rounding does not matter
CAPTURE = Capture(jnp.asarray(0.1), SHAPE, "RGGB", "rolling", jax.random.key(9), gain=jnp.array(GAIN))
NEARLY_NORMAL = 3e5  # degrees of freedom, for infinity: a table of quantiles takes longer, the more there are
# The photons and the rounding have no numbers.
WITH_LIKELIHOOD = {"shot_noise", "adc", *(effect for effect, _ in IN_LIKELIHOOD)}

MEASURED = ("measured_map", "measured_spectrum", "measured_distribution", "measured_hits", "measured_response")

# Why an effect has no `propose`.
NOT_PROPOSED = dict.fromkeys(
    ("shot_noise", "dark_current", "read_noise", "row_gain", "gain", "black_level", "adc"), "of the paper's model"
) | {name: "measured by `closed`" for name in MEASURED}
# A capture that shows everything.
RICH = CaptureFacts(
    effects=tuple(name for name in NOT_PROPOSED if name not in MEASURED),
    cfa="RGGB",
    shutter="rolling",
    read_noise_e=2.4,
    dark_e_per_s=118.0,
    gain=np.array([3.5, 3.1, 4.0]),
    frames=8,
    longest_s=0.2,
    has_exposure=True,
    has_bias=True,
    exposures_differ=True,
    levels=5,
    light_e=1500.0,
    line=("row", 0.13),
    waves=((1.0, -0.13, 0.37), (0.5, 0.2, 0.4)),
    places=Places(("column", "last", True, 0.3), (1.0, 0.5), -1, 1),
    code_step=None,
    comb=(0.1, (1.0, -1.0)),
    may_be_outputs=True,
    row_groups=(8, 4, 2, 2),
)
POOR = dataclasses.replace(
    RICH,
    frames=1,
    longest_s=1e-9,
    has_exposure=False,
    has_bias=False,
    exposures_differ=False,
    levels=1,
    light_e=0.0,
)
PROPOSED = [effect for effect in EFFECTS if can_be_proposed(effect)]
each_proposed = pytest.mark.parametrize("effect", PROPOSED, ids=lambda effect: effect.name)

DECLARED = [
    fx.DarkCurrent(50.0),
    fx.ReadNoise(3.5),
    fx.RowNoise(2.0),
    fx.RowNoise(2.0, 1.0, after_gain=True),
    fx.RowNoise(2.0, 0.5),
    fx.RowBankNoise(2.0, 0.5, 0.4),
    fx.RowBankNoise(2.0, 1.2, after_gain=True),
    fx.RowGroupNoise(2.0, 0.4, 4, 2, 2, 2),
    fx.RowGroupNoise(2.0, rows=6, after_gain=True),
    fx.ColumnNoise(2.0, 1.0),
    fx.RowFixedPattern(2.0, after_gain=True),
    fx.ColumnFixedPattern(2.0),
    fx.FrameOffset(1.0),
    fx.FrameTilt(4.0),
    fx.FrameTilt(4.0, "column", after_gain=True),
    fx.DarkSignalNonuniformity(2.0),
    fx.HotPixels(0.2, 500.0),
    fx.RandomTelegraphNoise(0.5, 8.0, 0.4),
    fx.RandomTelegraphNoise(0.5, 8.0, 0.4, 0.7),
    fx.RandomTelegraphNoise(0.5, 8.0, 0.4, 1.0, double_sampling=True),
    fx.PeriodicBanding(2.0, 0.01),
    fx.PeriodicBanding(2.0, 0.13, "column", after_gain=True),
    fx.Interference(2.0, -0.13, 0.37),
    fx.Interference(2.0, 0.21, 0.5, after_gain=True),
    fx.CosmicRays(5e6, 300.0),
    fx.MeasuredSpectrum(row=[0.0, 2e6, 6e6], column=[3e6, 1e6]),
    fx.MeasuredSpectrum(frame=[2e6], pixel=[1e6, 0.0, 4e6]),
    fx.MeasuredDistribution(2.0, [-5.94, -2.97, 2.97, 5.94]),
    fx.MeasuredHits(0.02, 0.1, [5.0, 10.0, 40.0]),
]


def estimated(counts: np.ndarray) -> list[float]:
    """The components of counts [frame, row, column], the mean over the four planes, DN^2."""
    planes = []
    for r, c in np.ndindex(2, 2):
        sums = PlaneSums((SHAPE[0] // 2, SHAPE[1] // 2))
        for frame in np.rint(counts[:, r::2, c::2]).astype(np.int64):
            sums.add(frame)
        planes.append([sums.components()[name].variance_dn2 for name in COMPONENTS])
    return list(np.mean(planes, 0))


@pytest.mark.parametrize("effect", DECLARED, ids=repr)
def test_draws_have_the_declared_components(effect):
    @jax.jit
    @jax.vmap
    def draw(key):
        own, sensor = jax.random.split(key)
        capture = dataclasses.replace(CAPTURE, sensor_key=sensor)
        electrons = effect.sample(jnp.zeros((FRAMES, *SHAPE)), capture, key=own)
        after_gain = effect.acts_at == fx.Stage.BLACK
        return electrons if after_gain else electrons * capture.per_pixel(capture.gain)

    found = np.array([estimated(one) for one in np.asarray(draw(jax.random.split(jax.random.key(3), SENSORS)))])
    declared = effect.components(CAPTURE)
    assert declared and set(declared) <= set(COMPONENTS)
    expected = np.array([declared.get(name, 0.0) for name in COMPONENTS])
    error = np.hypot(found.std(0, ddof=1) / np.sqrt(SENSORS), 1e-3 * expected.max())
    off = (found.mean(0) - expected) / error
    assert np.all(np.abs(off) < 4.5), dict(zip(COMPONENTS, off, strict=True))


def test_every_effect_that_declares_components_is_drawn():
    declaring = {effect for effect in EFFECTS if effect.components is not AbstractEffect.components}
    assert declaring == {type(effect) for effect in DECLARED}
    assert fx.HotPixels(0.2, 500.0, fano=0.8).components(CAPTURE) == {}


@pytest.mark.parametrize("effect", DECLARED, ids=repr)
def test_what_only_stays_from_frame_to_frame_can_be_measured(effect):
    """A closed model draws this sensor's map; beside it, a pattern of any sensor would count twice."""
    if set(effect.components(CAPTURE)) <= set(STATIC):
        assert effect.measurable


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
def test_it_is_proposed_or_says_why_not(effect):
    assert can_be_proposed(effect) != (effect.name in NOT_PROPOSED)
    assert effect.in_likelihood == (effect.name in WITH_LIKELIHOOD)
    assert bool(effect.confounded_with) == bool(effect.decided_by)
    assert any(spec.amplitude for spec in effect.specs().values()) or not can_be_proposed(effect)


@each_proposed
def test_what_is_proposed_is_the_effect(effect):
    maker = effect.propose(RICH)
    for size in (0.15, 1.0, 5.0):
        one, again = made(maker, size, 7), made(maker, size, 7)
        assert type(one) is effect and repr(one) == repr(again)
    assert repr(made(maker, 0.3, 7)) != repr(made(maker, 1.0, 7))


def test_a_poor_capture_is_offered_little():
    offered = built_in(POOR)
    several_frames = {effect.name for effect in PROPOSED if effect.least_frames > 1}
    assert several_frames == {
        "image_lag",
        "dark_current_drift",
        "dark_current_instability",
        "frame_offset",
        "frame_settling",
        "black_shading",
    }
    assert not several_frames & set(offered)
    assert not {"amplifier_glow", "dark_current_nonuniformity", "black_clamp", "nonlinearity"} & set(offered)
    assert {"row_noise", "hot_pixels", "cosmic_rays"} <= set(offered)
    hot, rays = (made(offered[name], 1.0, 0) for name in ("hot_pixels", "cosmic_rays"))
    assert hot.rate == rays.rate == 0 and hot.at_readout > 0 and rays.at_readout > 0
    assert set(built_in(RICH)) == {effect.name for effect in PROPOSED}
    assert "electron_multiplication" not in built_in(dataclasses.replace(RICH, read_noise_e=3.5))
    assert "electron_multiplication" not in built_in(dataclasses.replace(RICH, pixels_followed=True))
    assert "brighter_fatter" not in built_in(dataclasses.replace(RICH, light_e=500.0))
    coupling = {"readout_bandwidth", "readout_overshoot", "crosstalk", "brighter_fatter"}
    for along, down, left in (
        ((-0.005, 0.005), (-0.1, 0.1), set()),
        ((-0.005, 0.05), (-0.005, 0.005), {"readout_bandwidth"}),
        ((0.02, 0.05), (0.01, 0.03), coupling - {"readout_overshoot"}),
        ((-0.05, -0.02), (-0.1, 0.1), {"readout_overshoot"}),
    ):
        assert coupling & set(built_in(dataclasses.replace(RICH, coupled=(along, down)))) == left
    assert "row_noise" not in built_in(dataclasses.replace(RICH, effects=("row_noise",)))
    assert "shared_row_gain" not in built_in(dataclasses.replace(RICH, cfa="mono"))


@pytest.mark.parametrize("effect", PROPOSED + [fx.DarkCurrent, fx.ReadNoise, fx.RowGain], ids=lambda e: e.name)
def test_absent_is_absent(effect):
    if effect in PROPOSED:
        one = made(effect.propose(RICH), 1.0, 0)
    else:
        one = effect(**{name: np.ones(3) if spec.per_channel else 1.0 for name, spec in effect.specs().items()})
    absent = {name: spec.absent for name, spec in effect.specs().items() if spec.amplitude}
    absent = {name: NEARLY_NORMAL if math.isinf(value) else value for name, value in absent.items()}
    none = dataclasses.replace(one, **{name: jnp.full_like(getattr(one, name), x) for name, x in absent.items()})
    signal = jnp.asarray(np.rint(np.linspace(0, 40, 2 * np.prod(SHAPE))).reshape(2, *SHAPE))

    @jax.jit  # one program, not one for each operation
    def draw(effect, key):
        scales = (effect.read_noise_scale, effect.dark_current_scale)
        return effect.sample(signal, CAPTURE, key=key), [scale(CAPTURE, signal.shape, key=key) for scale in scales]

    drawn, scales = draw(none, jax.random.key(1))
    np.testing.assert_allclose(drawn, signal, atol=1e-9)
    assert all(scale is None or np.allclose(scale, 1, atol=0.01) for scale in scales)


@each_proposed
def test_it_comes_back_from_json(effect):
    one = made(effect.propose(RICH), 1.0, 0)
    channels = ("R", "G", "B")
    whole = {name: np.broadcast_to(getattr(one, name), 3) for name, spec in effect.specs().items() if spec.per_channel}
    one = dataclasses.replace(one, **whole)
    again = effect_from_json(json.loads(json.dumps(effect_to_json(one, channels))), {effect.name: effect}, channels)
    assert repr(again) == repr(one) and again.settings() == one.settings()


def test_an_amplitude_is_scaled_from_where_it_is_absent():
    dof, gain = fx.HeavyTailedReadNoise.specs()["dof"], fx.MissingCodes.specs()["gain"]
    assert gain.scaled(np.array(1.5), 2.0) == 2.0
    assert dof.scaled(np.array(20.0), 2.0) == 10.0 and dof.scaled(np.array(4.0), 4.0) == 2.05
    assert fx.Crosstalk.specs()["fraction"].scaled(np.array(0.1), 5.0) == 0.25


class Unmarked(AbstractEffect):
    """A user's effect that marks no amplitude."""

    name: ClassVar[str] = "unmarked"
    stage: ClassVar[fx.Stage] = fx.Stage.READ
    sigma: jax.Array = fx.param("e-", low=0)
    share: jax.Array = fx.param("1", low=0, high=1)

    def sample(self, signal, capture, *, key):
        return signal + self.sigma


def test_a_ready_effect_is_scaled_by_its_amplitudes():
    rng = np.random.default_rng(0)
    assert repr(given(Unmarked(2.0, 0.5))(3.0, rng)) == repr(Unmarked(6.0, 0.5))
    assert repr(given(fx.OddEvenPattern(-2.0, 0.3))(2.0, rng)) == repr(fx.OddEvenPattern(-4.0, 0.6))
    assert repr(given(fx.HeavyTailedReadNoise(6.0))(0.5, rng)) == repr(fx.HeavyTailedReadNoise(12.0))
    assert repr(given(fx.HotPixels(0.1, 50.0))(2.0, rng)) == repr(fx.HotPixels(0.1, 100.0))
    assert repr(given(fx.MissingCodes(1.5))(2.0, rng)) == repr(fx.MissingCodes(1.5))  # held


class Beating(Unmarked):
    """A user's effect with a statistic of its own: how far odd frames lie above even ones."""

    name: ClassVar[str] = "beating"

    @classmethod
    def statistics(cls, frames):
        return {"odd over even frames": float(frames[1::2].mean() - frames[::2].mean())}


def test_an_effect_may_have_a_statistic_of_its_own():
    frames = np.arange(4.0)[:, None, None] * np.ones((1, 2, 2))
    assert Beating.statistics(frames) == {"odd over even frames": 1.0}
    assert all(effect.statistics(frames) == {} for effect in EFFECTS)


@pytest.mark.slow
@each_proposed
def test_it_is_found_in_a_capture_that_has_it(effect, monkeypatch):
    """Among a few others, which all captures are offered."""
    camera = hsnoise.cameras.grasshopper3(black_level_dn=64)
    size = (
        8.0 if effect.name == "correlated_read_noise" else 3.0
    )  # this one swings so fast that neighbours hardly show it
    truth = camera.add(made(effect.propose(RICH), size, 1))
    rng = np.random.default_rng(0)
    lit = [1500, 4500] if effect.name == "brighter_fatter" else [300, 500]
    exposure_s, kinds, means = (0.02, 0.05, 0.1, 0.2, 0.05, 0.05), ["dark"] * 4 + ["flat"] * 2, [70] * 4 + lit
    counts = [rng.integers(mean - 9, mean + 9, (8, 96, 128)).astype(np.uint16) for mean in means]
    like = hsnoise.FrameStack(counts, exposure_s, kind=kinds, cfa="RGGB", shutter="global")
    stack = draw_capture(900, truth, like)
    facts = facts_of(camera, Portion.of(stack), 0)
    few = {effect.name, "row_noise", "dark_signal_nonuniformity", "crosstalk"}
    offered = {name: maker for name, maker in built_in(facts).items() if name in few}
    module = importlib.import_module("hsnoise.criticism.diagnose")  # the package has a function of that name
    monkeypatch.setattr(module, "built_in", lambda facts: offered)
    found = hsnoise.diagnose(camera, stack, draws=40)
    assert found.ranking[0].name == effect.name and found.ranking[0].score > rules.evidence(len(found.ranking))
