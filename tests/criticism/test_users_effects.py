"""A user's effect that is wrong is told so by name, before any long work."""

import importlib
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hsnoise
from hsnoise.simulation.draws import draw_capture

CAMERA = hsnoise.cameras.grasshopper3(black_level_dn=64)
COUNTS = np.asarray(hsnoise.sample_dark(jax.random.key(0), 8, (32, 48), CAMERA)).reshape(2, 4, 32, 48)
CAPTURE: dict[str, Any] = {"exposure_s": [0.03, 0.06], "black_level": 64, "cfa": "RGGB", "shutter": "global"}


class Mine(hsnoise.AbstractEffect):
    """Does what `change` does."""

    name: ClassVar[str] = "my_effect"
    stage: ClassVar[hsnoise.Stage] = hsnoise.Stage.READ
    change: Callable = eqx.field(static=True)

    def sample(self, signal, capture, *, key):
        return self.change(signal)


class Proposing(hsnoise.AbstractEffect):
    """Does what `change` does, as strongly as `propose` says."""

    name: ClassVar[str] = "proposing"
    stage: ClassVar[hsnoise.Stage] = hsnoise.Stage.READ
    least_frames: ClassVar[int] = 3
    sigma: jax.Array = hsnoise.param("e-", low=0, amplitude=True, doc="standard deviation over frames")
    change: ClassVar[Callable] = staticmethod(lambda signal: signal)
    proposal: ClassVar[Callable | None] = staticmethod(lambda size, rng: Proposing(size * rng.uniform(1, 2)))

    def sample(self, signal, capture, *, key):
        return type(self).change(signal) + self.sigma * jax.random.normal(key, (len(signal), 1, 1), signal.dtype)

    @classmethod
    def propose(cls, facts):
        return cls.proposal


FAULTS = {
    "shape": (lambda signal: signal[:, 1:], r"my_effect: .* returned shape \(\d+, 31, 48\), expected \(\d+, 32, 48\)"),
    "one frame": (lambda signal: signal[0], r"my_effect: .* returned shape \(32, 48\)"),
    "two": (lambda signal: (signal, signal), "my_effect: .* returned a tuple, expected one array"),
    "nothing": (lambda signal: None, "my_effect: .* returned None, .* is a return missing"),
    "boolean": (lambda signal: signal > 1.0, "my_effect: .* returned booleans, expected real numbers"),
    "complex": (lambda signal: signal + 1j, "my_effect: .* complex numbers"),
    "nan": (lambda signal: jnp.sqrt(signal - 4.0), "my_effect: .* NaN or infinity in .* % of the pixels"),
    "infinity": (lambda signal: signal.at[:, 3].divide(0.0), "my_effect: .* NaN or infinity"),
    "unit": (lambda signal: signal + 1e9, r"my_effect: .* signal of 1e\+09 e- .* units that it declares"),
}
CALLS = {
    "compare": lambda effect: hsnoise.compare(CAMERA.add(effect), COUNTS, **CAPTURE),
    "diagnose": lambda effect: hsnoise.diagnose(CAMERA, COUNTS, candidates=[effect], **CAPTURE),
    "fit": lambda effect: hsnoise.fit(COUNTS, model=CAMERA.add(effect), **CAPTURE),
    "improve": lambda effect: hsnoise.improve(COUNTS, candidates=[effect], **CAPTURE),
}


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("fault", FAULTS)
def test_wrong_effect_is_named(call, fault):
    change, message = FAULTS[fault]
    with pytest.raises(ValueError, match=message):
        CALLS[call](Mine(change))


def test_sample_names_effect_of_wrong_shape():
    with pytest.raises(ValueError, match="my_effect: .* returned shape"):
        hsnoise.sample_dark(jax.random.key(1), 2, (32, 48), CAMERA.add(Mine(FAULTS["shape"][0])))


def test_a_wrong_shape_is_told_without_the_axis_of_exposures():
    like = hsnoise.FrameStack([*COUNTS, COUNTS[1]], **{**CAPTURE, "exposure_s": [0.03, 0.06, 0.09]})
    with pytest.raises(ValueError, match=r"my_effect: .* returned shape \(4, 31, 48\), expected \(4, 32, 48\)"):
        draw_capture(1, CAMERA.add(Mine(FAULTS["shape"][0])), like)


def test_fault_in_the_code_of_an_effect_is_told_with_its_name():
    def fail(signal):
        raise KeyError("table")

    with pytest.raises(KeyError) as raised:
        CALLS["diagnose"](Mine(fail))
    assert "in the sample of the effect my_effect" in raised.value.__notes__


@pytest.mark.parametrize(
    "change", [lambda signal: np.sort(signal), lambda signal: signal if signal[0, 0, 0] > 1 else 0]
)
def test_an_effect_that_jax_cannot_compile_is_named(change):
    with pytest.raises(TypeError, match="my_effect: JAX cannot compile its sample; use jax.numpy"):
        CALLS["compare"](Mine(change))


class OwnReadNoise(hsnoise.AbstractEffect):
    """Read noise that says which scale it takes, or does not."""

    name: ClassVar[str] = "own_read_noise"
    stage: ClassVar[hsnoise.Stage] = hsnoise.Stage.READ
    sigma: jax.Array = hsnoise.param("e-", low=0, doc="standard deviation")

    def sample(self, signal, capture, *, key):
        noise = self.sigma * jax.random.normal(key, signal.shape, signal.dtype)
        return signal + (noise if capture.read_noise_scale is None else noise * capture.read_noise_scale)


class DeclaredReadNoise(OwnReadNoise):
    scaled_by: ClassVar[tuple[str, ...]] = ("read_noise_scale",)


def test_a_scale_that_is_used_must_be_declared():
    """Unscaled noise would be wrong without a word."""
    differ = CAMERA.remove("read_noise").add(hsnoise.effects.ReadNoiseNonuniformity(0.5))
    with pytest.raises(TypeError, match=r'capture.read_noise_scale: .* scaled_by = \("read_noise_scale",\)'):
        hsnoise.sample_dark(jax.random.key(1), 2, (32, 48), differ.add(OwnReadNoise(30.0)))
    drawn = hsnoise.sample_dark(jax.random.key(1), 400, (32, 48), differ.add(DeclaredReadNoise(30.0)), exposure_s=0.0)
    noise = np.log(np.std(np.asarray(drawn, float), axis=0))
    assert noise.std() > 0.3  # 0.04 by chance


@pytest.mark.parametrize(
    ("attribute", "value", "message"),
    [
        ("name", "", "name: expected that of an effect .* got ''"),
        ("name", "a.b c", "name: expected that of an effect .* got 'a.b c'"),
        ("name", 3, "name: expected that of an effect .* got 3"),
        ("stage", "read", "my_effect.stage: expected one of Stage, such as Stage.READ, got 'read'"),
    ],
)
def test_a_wrong_name_or_stage_is_told_at_once(attribute, value, message, monkeypatch):
    monkeypatch.setattr(Mine, attribute, value)
    with pytest.raises((ValueError, TypeError), match=message):
        Mine(lambda signal: signal)


def test_candidates_of_one_name_or_in_the_model_are_refused():
    effect = Mine(lambda signal: signal + 1)
    for call in (hsnoise.diagnose, lambda model, *rest, **keywords: hsnoise.improve(*rest, model=model, **keywords)):
        with pytest.raises(ValueError, match="candidates: my_effect given more than once"):
            call(CAMERA, COUNTS, candidates=[effect, effect], **CAPTURE)
        with pytest.raises(ValueError, match="candidates: my_effect is in the model already"):
            call(CAMERA.add(effect), COUNTS, candidates=[effect], **CAPTURE)


@pytest.mark.parametrize("call", [hsnoise.compare, hsnoise.diagnose])
def test_arguments_are_named(call):
    with pytest.raises(TypeError, match="draws: expected a whole number, got 20.5"):
        call(CAMERA, COUNTS, draws=20.5, **CAPTURE)
    with pytest.raises(ValueError, match="draws: expected at least"):
        call(CAMERA, COUNTS, draws=3, **CAPTURE)
    with pytest.raises(TypeError, match="seed: expected a whole number, got 'x'"):
        call(CAMERA, COUNTS, seed="x", **CAPTURE)
    with pytest.raises(TypeError, match="stack: expected a path, a FrameStack or an array of counts, got NoiseModel"):
        call(COUNTS, CAMERA)
    with pytest.raises(ValueError, match="frames 0 and 1 of the 0.03 s exposure are identical"):
        call(CAMERA, np.repeat(COUNTS[:, :1], 4, axis=1), **CAPTURE)
    with pytest.raises(ValueError, match="stack: expected frames of at least 32 x 32 pixels, got 30 x 48"):
        call(CAMERA, COUNTS[:, :, :30], **CAPTURE)


def test_a_class_of_a_user_proposes_itself(monkeypatch):
    """Its details are drawn at random, as those of the built-in effects are."""
    module = importlib.import_module("hsnoise.criticism.diagnose")  # the package has the function of that name
    monkeypatch.setattr(module, "built_in", lambda facts: {})
    found = hsnoise.diagnose(CAMERA, COUNTS, candidates=[Proposing], draws=16, **CAPTURE)
    (one,) = found.ranking
    assert type(one.effect) is Proposing and one.name == "proposing"


@pytest.mark.parametrize("call", ["diagnose", "improve"])
@pytest.mark.parametrize(
    ("attribute", "value", "error", "message"),
    [
        ("change", lambda signal: signal[:, 1:], ValueError, r"proposing: .* returned shape \(\d+, 31, 48\)"),
        ("proposal", lambda size, rng: 3, TypeError, "expected proposing.propose to make proposing effects, got 3"),
        ("name", "", ValueError, "name: expected that of an effect .* got ''"),
    ],
)
def test_a_wrong_class_is_told_before_any_long_work(call, attribute, value, error, message, monkeypatch):
    monkeypatch.setattr(Proposing, attribute, staticmethod(value) if callable(value) else value)
    jax.clear_caches()  # of the class as it was
    with pytest.raises(error, match=message):
        CALLS[call](Proposing)


@pytest.mark.parametrize(("attribute", "value"), [("proposal", None), ("least_frames", 5)])
def test_a_class_that_the_capture_cannot_show_is_named(attribute, value, monkeypatch):
    module = importlib.import_module("hsnoise.criticism.diagnose")
    bench = SimpleNamespace(of=lambda *of: pytest.skip("the warning comes before the draws"))
    monkeypatch.setattr(module, "Bench", bench)
    monkeypatch.setattr(Proposing, attribute, value)
    with pytest.warns(UserWarning, match="candidates: proposing not tried: this capture cannot show it"):
        with pytest.raises(pytest.skip.Exception):
            CALLS["diagnose"](Proposing)


def test_a_class_without_a_proposal_is_refused():
    with pytest.raises(TypeError, match="instances, or classes with a propose; Mine is a class without one"):
        hsnoise.diagnose(CAMERA, COUNTS, candidates=[Mine], **CAPTURE)
    with pytest.raises(TypeError, match="candidates: expected a list of effects, got one effect, proposing"):
        hsnoise.diagnose(CAMERA, COUNTS, candidates=Proposing, **CAPTURE)


@pytest.mark.parametrize("candidate", ["row_noise", 3, int])
def test_candidate_that_is_no_effect(candidate):
    with pytest.raises(TypeError, match="candidates: expected effects"):
        hsnoise.diagnose(CAMERA, COUNTS, candidates=[candidate], **CAPTURE)


def test_candidate_that_does_nothing(monkeypatch):
    module = importlib.import_module("hsnoise.criticism.diagnose")  # the package has the function of that name
    monkeypatch.setattr(module, "built_in", lambda facts: {})
    with pytest.raises(ValueError, match="my_effect changed no count of 12 captures"):
        hsnoise.diagnose(CAMERA, COUNTS, candidates=[Mine(lambda signal: signal)], draws=16, **CAPTURE)
