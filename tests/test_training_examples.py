"""What the enhancer is trained on: clips, light and noise; features of the perceptual term."""

from __future__ import annotations

import re
import sys

import jax
import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

import hsnoise
from hsnoise._core.types import cfa_tile
from hsnoise.effects import BlackClamp, BlackLevel, DarkCurrent, Gain, ReadNoise, ShotNoise, TapOffsets
from hsnoise.enhance.training import evaluate
from hsnoise.enhance.training.clips import Batch, Clip, crops, held_out, moving_stills, read_clips
from hsnoise.enhance.training.noisy import camera_of, jittered, matched, noise_of
from hsnoise.enhance.training.presets import Recipe
from hsnoise.enhance.training.scenes import Scene
from hsnoise.enhance.training.steps import Trainer, batch_rng, examples
from hsnoise.enhance.training.validation import Validation
from hsnoise.enhance.training.vgg import LAYERS, features_of, name_of, read_weights


def test_a_short_clip_is_played_forth_and_back():
    frames = np.broadcast_to(np.arange(4, dtype=np.uint8)[:, None, None, None], (4, 8, 8, 3)).copy()
    batch = crops([Clip("short", frames)], batch_rng(0, 0), 64, 7, 8).frames[:, :, 0, 0, 0].astype(int)
    assert set(np.unique(np.abs(np.diff(batch)))) == {1}  # no jump, no frame twice
    assert {0, 3} == set(batch.min(1)) | set(batch.max(1)) and len(np.unique(batch[:, 0])) == 4


def test_half_of_the_examples_have_seen_the_frames_before():
    """Of these the first half has an empty memory: what it has not seen does not change the step."""
    camera = camera_of("canon_5d3", None, None)
    trainer = Trainer(Recipe(maps=2, kernels=(3,), warm_up=2), 10, camera, camera.model)
    rng = np.random.default_rng(0)
    clean, noisy = (rng.random((2, 5, 8, 8, 3)).astype(np.float32) for _ in range(2))

    def loss_of(change):
        frames = noisy.copy()
        change(frames)
        return float(trainer.learn(trainer.start(0), clean, frames)[1])

    as_it_is = loss_of(lambda frames: None)
    assert loss_of(lambda frames: frames[0, :2].fill(9.0)) == as_it_is
    assert loss_of(lambda frames: frames[1, :2].fill(9.0)) != as_it_is


@pytest.mark.slow
def test_validation_takes_clips_of_different_lengths(tmp_path):
    frames = np.random.default_rng(0).integers(0, 256, (9, 16, 16, 3), dtype=np.uint8)
    clips = [Clip("short", frames[:4]), Clip("long", frames)]
    validation = Validation(clips, camera_of("canon_5d3", None, None), 6, tmp_path)
    assert validation.clean.shape == validation.noisy.shape == (4, 2, 16, 16, 3)


@pytest.mark.slow
def test_examples_have_the_light_of_their_clip_in_units_of_the_camera():
    camera = camera_of("grasshopper3", None, (30.0, 30.0))
    model = camera.model.with_value("black_level", "value", 200.0)
    frames = np.full((2, 4, 24, 24, 3), 188, np.uint8)  # half of white in linear light
    # Pieces of clips that average as much as the piece, and twice as much.
    batch = Batch(frames, np.float32([0.503, 1.006]))
    clean, noisy = examples(batch, jax.random.key(0), model, model, np.float32([30, 30]), 0.0)
    assert clean.shape == noisy.shape == frames.shape
    np.testing.assert_allclose(clean, 188 / 255, atol=1e-5)
    assert camera.unit_e == pytest.approx(150)
    np.testing.assert_allclose(noisy.mean((1, 2, 3, 4)), [30 / 150, 15 / 150], rtol=0.03)


def test_pieces_lie_anywhere_on_the_sensor():
    """Taps of 16 columns: a piece of 24 colour pixels has at most three of them, not eight."""
    effects = [Gain(1.0), TapOffsets(1000.0, taps=8), BlackLevel(0.0)]
    model = hsnoise.NoiseModel(effects, cfa="mono", shutter="global", exposure_s=0.1)
    batch = Batch(np.zeros((16, 1, 24, 24, 3), np.uint8), np.ones(16, np.float32))
    light = np.float32([1, 1])
    _, noisy = examples(batch, jax.random.key(0), model, model, light, 0.0, (64, 128))
    rows = np.asarray(noisy)[:, 0, 0, :, 0]
    edges = [np.flatnonzero(np.diff(row)) for row in rows]
    assert all(0 < len(one) <= 2 and set(np.diff(one)) <= {16} for one in edges)
    assert len({one[0] for one in edges}) > 4
    _, whole = examples(batch, jax.random.key(0), model, model, light, 0.0)
    assert {len(np.flatnonzero(np.diff(row))) for row in np.asarray(whole)[:, 0, 0, :, 0]} == {7}
    with pytest.raises(ValueError, match="--sensor: expected at least the 24 x 24 pixels"):
        examples(batch, jax.random.key(0), model, model, light, 0.0, (16, 128))


def test_held_out_videos_are_held_out_with_their_long_cuts():
    frames = np.zeros((4, 8, 8, 3), np.uint8)
    clips = [Clip(name, frames) for name in ("a", "b", "b_long", "c", "d", "d_long", "e")]
    trained, kept = held_out(clips)
    assert [clip.name for clip in trained] == ["a", "b", "c", "e"]
    assert [clip.name for clip in kept] == ["d", "d_long"]
    folds = [{clip.source for clip in held_out(clips, fold)[1]} for fold in range(5)]
    assert folds == [{"d"}, {"c"}, {"b"}, {"a", "e"}, {"d"}]
    with pytest.raises(ValueError, match="at least two"):
        held_out(clips[:1])


def test_frames_seen_count_whatever_the_frames_show(rng):
    """A network that takes the mean of the frames so far: white noise of 0.1 falls with their root."""
    clean = np.broadcast_to(np.linspace(0.3, 0.7, 7)[:, None, None, None], (7, 40, 40, 1))
    noisy = clean + 0.1 * rng.standard_normal(clean.shape)
    scene = Scene("ramp", camera_of("canon_5d3", None, None), 10.0, 20.0, clean, noisy)

    def net(noisy):  # less what it knows of the ramp, so that only its noise is left
        seen = np.arange(1, len(noisy) + 1).reshape(-1, 1, 1, 1, 1)
        ramp = (clean[1] - clean[0]).max() * (seen - 1) / 2
        return np.cumsum(noisy, 0) / seen + ramp

    found = evaluate.while_memory_fills(net, scene)
    assert list(found) == ["ramp", "ramp, scaled"]
    for values in found.values():
        np.testing.assert_allclose(values, 20 + 10 * np.log10(np.arange(1, 5)), atol=0.3)


def test_folders_of_images_are_named_whole_and_hidden_files_are_left_out(tmp_path):
    for name in ("night.0", "night.1"):
        (tmp_path / name).mkdir()
        for i in range(2):
            Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / name / f"{i}.png")
    (tmp_path / "._a.mp4").write_bytes(b"not a video")
    assert [clip.name for clip in read_clips(tmp_path)] == ["night.0", "night.1"]


def test_stills_move_smoothly():
    clips = moving_stills()
    assert len(clips) >= 6
    for clip in clips:
        assert clip.frames.ndim == 4 and clip.frames.shape[3] == 3 and clip.frames.std() > 5


def test_jitter_changes_what_may_not_be_negative_by_a_tenth():
    model = hsnoise.cameras.canon_5d3(black_level_dn=64)
    drawn = [jittered(jax.random.key(i), model).table for i in range(30)]
    for name, (value, _, _) in model.table.items():
        ratio = np.array([table[name][0] for table in drawn]) / max(value, 1e-12)
        if name.startswith("black_level") or name == "row_gain.exponent":
            assert np.all(ratio == 1), name
        elif value == 0:
            assert np.all(ratio == 0), name
        else:
            assert 0.06 < np.log(ratio).std() < 0.15, name


@pytest.mark.parametrize("kind", ["gaussian", "poisson-gaussian"])
def test_simpler_noise_is_as_strong_before_it_is_clipped(kind):
    """At a black level of 0 half of the noise is cut off, of the camera and of what stands for it."""
    models = [hsnoise.cameras.grasshopper3(black_level_dn=black) for black in (0, 200)]
    numbers = [{n: value for n, (value, _, _) in matched(m, kind, 4.0).table.items()} for m in models]
    assert numbers[0]["read_noise.sigma"] == pytest.approx(numbers[1]["read_noise.sigma"], rel=0.02)


@pytest.mark.parametrize("kind", ["gaussian", "poisson-gaussian"])
def test_simpler_noise_has_the_same_variance(kind):
    camera, light_e = hsnoise.cameras.grasshopper3(black_level_dn=200), 4.0
    simple = matched(camera, kind, light_e)
    gain = np.tile(np.asarray(camera["gain"].value)[cfa_tile("RGGB")], (64, 64))

    def electrons(model, light):
        frames = np.full((16, 128, 128), light, np.float32)
        return (np.asarray(hsnoise.sample(jax.random.key(1), frames, model), float) - 200) / gain

    for light in (0.0, light_e):
        own, other = electrons(camera, light), electrons(simple, light)
        assert other.mean() == pytest.approx(own.mean(), abs=0.1)
        if (light == 0) == (kind == "poisson-gaussian"):
            assert other.var() == pytest.approx(own.var(), rel=0.05)


@pytest.mark.parametrize("kind", ["gaussian", "poisson-gaussian"])
def test_simpler_noise_has_the_mean_of_clamped_darks(kind):
    effects = [ShotNoise(), DarkCurrent(50.0), BlackClamp(60.0), ReadNoise(3.0), Gain(2.0), BlackLevel(100.0)]
    model = hsnoise.NoiseModel(effects, cfa="mono", shutter="global", exposure_s=0.5)
    means = [
        np.mean(hsnoise.sample_dark(jax.random.key(0), 4, (64, 64), m)) for m in (model, matched(model, kind, 2.0))
    ]
    assert means[1] == pytest.approx(means[0], abs=0.5)


def test_noise_of_another_sensor_is_refused(tmp_path):
    path = tmp_path / "mono.json"
    hsnoise.NoiseModel([ReadNoise(2.0), Gain(1.0)], cfa="mono", shutter="global", exposure_s=0.1).save(path)
    with pytest.raises(ValueError, match="cfa mono"):
        noise_of(str(path), camera_of("canon_5d3", None, None))
    with pytest.raises(ValueError, match="--mean-e: needed"):
        camera_of(str(path), None, None)


def test_all_noise_is_drawn_at_the_exposure_of_the_video(tmp_path):
    path = tmp_path / "model.json"
    hsnoise.cameras.canon_5d3(exposure_s=10.0).save(path)
    assert noise_of(str(path), camera_of("canon_5d3", None, None)).exposure_s == 0.05
    assert camera_of(str(path), None, (2.0, 10.0)).model.exposure_s == 10.0
    camera = camera_of(str(path), None, (2.0, 10.0), 0.02)
    assert camera.model.exposure_s == noise_of("poisson-gaussian", camera).exposure_s == 0.02
    with pytest.raises(ValueError, match="--exposure: expected"):
        camera_of(str(path), None, (2.0, 10.0), -1.0)


def vgg_state(seed=0, **changed):
    rng = np.random.default_rng(seed)
    state = {}
    for place, inputs, outputs in LAYERS:
        state[f"features.{place}.weight"] = rng.normal(0, 0.05, (outputs, inputs, 3, 3)).astype(np.float32)
        state[f"features.{place}.bias"] = rng.normal(0, 0.05, outputs).astype(np.float32)
    return {**state, **changed}


def test_perceptual_features_are_those_of_the_file(tmp_path):
    safetensors = pytest.importorskip("safetensors.numpy")
    path = tmp_path / "vgg.safetensors"
    safetensors.save_file(vgg_state(), path)
    state, digest = read_weights(path)
    frames = np.random.default_rng(1).uniform(0, 1, (2, 8, 8, 3)).astype(np.float32)
    found = np.asarray(features_of(state)(frames))
    assert found.shape == (2, 4, 4, 128) and "unknown origin" in name_of(digest)
    # The first place by hand: two convolutions of 3 x 3, the pool, two more; mono frames stand for grey ones.
    grey = np.repeat(frames[..., :1], 3, -1)
    np.testing.assert_allclose(features_of(state)(frames[..., :1]), features_of(state)(grey), atol=1e-6)
    np.testing.assert_allclose(found, by_scipy(state, frames), rtol=1e-3, atol=1e-4)


def by_scipy(state, frames):
    """The same in SciPy's correlation."""
    x = (frames - np.array([0.485, 0.456, 0.406])) / np.array([0.229, 0.224, 0.225])
    for i, (place, inputs, outputs) in enumerate(LAYERS):
        weight, bias = state[f"features.{place}.weight"], state[f"features.{place}.bias"]
        if i == 2:
            x = x.reshape(len(x), x.shape[1] // 2, 2, x.shape[2] // 2, 2, -1).max((2, 4))
        y = np.zeros((*x.shape[:3], outputs))
        for n in range(len(x)):
            for o in range(outputs):
                for c in range(inputs):
                    y[n, :, :, o] += ndimage.correlate(x[n, :, :, c], weight[o, c], mode="constant")
        x = np.maximum(y + bias, 0)
    return x


@pytest.mark.parametrize(
    ("suffix", "package", "words"),
    [("safetensors", "safetensors.numpy", "hsnoise[vgg]"), ("pth", "torch", "pip install torch")],
)
def test_a_library_that_is_missing_is_named(tmp_path, monkeypatch, suffix, package, words):
    path = tmp_path / f"vgg.{suffix}"
    path.write_bytes(b"weights")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=re.escape(words)):
        read_weights(path)


def test_other_weights_are_refused(tmp_path):
    safetensors = pytest.importorskip("safetensors.numpy")
    path = tmp_path / "vgg.safetensors"
    safetensors.save_file(vgg_state(**{"features.2.bias": np.zeros(3, np.float32)}), path)
    with pytest.raises(ValueError, match=r"features.2.bias of shape \(64,\), got \(3,\)"):
        read_weights(path)
    path.write_bytes(b"cut off")
    with pytest.raises(ValueError, match="cannot be read"):
        read_weights(path)


def test_weights_that_are_none_are_refused_before_training(tmp_path):
    torch, save_file = pytest.importorskip("torch"), pytest.importorskip("safetensors.numpy").save_file
    path = tmp_path / "vgg.pth"
    for content in (b"", b"garbage", b"PK\x03\x04"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="cannot be read"):
            read_weights(path)
    torch.save([1, 2], path)
    with pytest.raises(ValueError, match="cannot be read"):
        read_weights(path)
    half = {name: torch.tensor(value).half().requires_grad_() for name, value in vgg_state().items()}
    torch.save({**half, 3: torch.zeros(1)}, path)
    state, _ = read_weights(path)
    assert {value.dtype for value in state.values()} == {np.dtype(np.float32)}
    bias = np.full(64, np.nan, np.float32)
    save_file(vgg_state() | {"features.0.bias": bias}, tmp_path / "vgg.safetensors")
    with pytest.raises(ValueError, match="features.0.bias"):
        read_weights(tmp_path / "vgg.safetensors")
