"""Training of the enhancer: examples, runs that are interrupted, bad input."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

import hsnoise
from benchmarks import _checkpoints, evaluate, noise_ablation, train
from benchmarks._clips import Clip, crops, held_out, moving_stills, read_clips
from benchmarks._noisy import OPTICS, Camera, camera_of, jittered, matched, noise_of
from benchmarks._rivals import denoised, rivals, tuned
from benchmarks._training import Recipe, Trainer, batch_rng, examples
from benchmarks._validation import Validation
from benchmarks._vgg import LAYERS, features_of, name_of, read_weights
from hsnoise._types import cfa_tile
from hsnoise.effects import ADC, BlackLevel, Gain, ReadNoise, ShotNoise
from hsnoise.photometry import display_from_linear
from hsnoise.weights import load_network, save_network

TINY = train.Preset(6, 2, 3, 8, 3, Recipe(maps=2, kernels=(3,)))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of five tiny clips, and a preset of their size."""
    monkeypatch.setitem(train.PRESETS, "smoke", TINY)
    clips = tmp_path / "clips"
    clips.mkdir()
    rng = np.random.default_rng(0)
    for name in "abcde":
        np.savez(clips / f"{name}.npz", frames=rng.integers(0, 256, (4, 12, 14, 3), dtype=np.uint8))
    return clips


def arguments(folder, out, *more):
    return ["--clips", str(folder), "--out", str(out), *more]


def leaves(path):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(load_network(path)[0])]


def test_an_interrupted_run_ends_with_the_same_weights(folder, tmp_path, monkeypatch):
    train.main(arguments(folder, tmp_path / "whole"))
    step, monkeypatch_s = Trainer.step, 0.0
    monkeypatch.setattr(train, "CHECKPOINT_S", monkeypatch_s)

    def killed(self, state, batch, seed, number):
        if number == 4:
            raise KeyboardInterrupt
        return step(self, state, batch, seed, number)

    monkeypatch.setattr(Trainer, "step", killed)
    with pytest.raises(SystemExit):
        train.main(arguments(folder, tmp_path / "cut"))
    monkeypatch.setattr(Trainer, "step", step)
    # The newest checkpoint is cut off in the middle: the one before is taken.
    newest = _checkpoints.checkpoints(tmp_path / "cut")[0]
    newest.write_bytes(newest.read_bytes()[:-100])
    train.main(arguments(folder, tmp_path / "cut"))
    for one, other in zip(
        leaves(tmp_path / "whole" / train.ENDED), leaves(tmp_path / "cut" / train.ENDED), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    logs = [(tmp_path / run / "log.csv").read_text() for run in ("whole", "cut")]
    assert logs[0] == logs[1] and logs[0].count("\n") == 3
    assert len(_checkpoints.checkpoints(tmp_path / "cut")) == 2
    assert (tmp_path / "cut" / "validation-00000006.png").stat().st_size > 100


def test_a_full_disk_is_told_and_the_last_checkpoint_stays(folder, tmp_path, monkeypatch, capsys):
    train.main(arguments(folder, tmp_path / "run"))
    kept = [path.read_bytes() for path in _checkpoints.checkpoints(tmp_path / "run")]

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("benchmarks._checkpoints.write_arrays", full)
    with pytest.raises(OSError, match="the last one is intact"):
        _checkpoints.write(tmp_path / "run", 7, {}, {})
    assert [path.read_bytes() for path in _checkpoints.checkpoints(tmp_path / "run")] == kept


def test_another_run_in_the_same_folder_is_refused(folder, tmp_path, capsys):
    train.main(arguments(folder, tmp_path / "run"))
    with pytest.raises(SystemExit):
        train.main(arguments(folder, tmp_path / "run", "--seed", "1"))
    assert "another run (seed differ" in capsys.readouterr().err
    assert json.loads((tmp_path / "run" / "run.json").read_text())["seed"] == 0


def test_another_model_of_the_same_name_is_another_run(folder, tmp_path, capsys):
    path = tmp_path / "model.json"
    for black_level_dn in (0, 64):
        hsnoise.cameras.canon_5d3(black_level_dn=black_level_dn).save(path)
        run = arguments(folder, tmp_path / "run", "--camera", str(path), "--white-e", "2,10")
        if black_level_dn == 0:
            train.main(run)
    with pytest.raises(SystemExit):
        train.main(run)
    assert "another run (digests differ" in capsys.readouterr().err


def test_damaged_checkpoints_do_not_push_out_good_ones(tmp_path):
    tree = {"weight": jnp.arange(3.0)}
    for step in (100, 200):
        _checkpoints.write(tmp_path, step, tree, {})
    cut = _checkpoints.checkpoints(tmp_path)[0]
    cut.write_bytes(cut.read_bytes()[:-4])
    said = []
    assert _checkpoints.read_newest(tmp_path, tree, said.append)[1]["step"] == 100
    assert "taking the one before" in said[0]
    for step in (150, 160):
        _checkpoints.write(tmp_path, step, tree, {})
    assert [path.name[11:19] for path in _checkpoints.checkpoints(tmp_path)] == ["00000160", "00000150"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--camera", "nikon"], "--camera: expected"),
        (["--noise", "salt"], "--noise: expected"),
        (["--lux", "0"], "above 0"),
        (["--clips", "nowhere"], "--clips: expected a folder"),
        (["--vgg", "nowhere.pth"], "--vgg: there is no file"),
        (["--preset", "cpu"], "expected 12 frames"),
    ],
)
def test_bad_input_is_named(folder, tmp_path, capsys, more, words):
    with pytest.raises(SystemExit):
        train.main(arguments(folder, tmp_path / "run", *more))
    assert words in capsys.readouterr().err


def test_the_same_step_is_the_same_whatever_came_before(folder):
    camera = camera_of("canon_5d3", None, None)
    clips, _ = held_out(read_clips(folder))
    trainer = Trainer(TINY.recipe, 6, camera, camera.model)
    batch = crops(clips, batch_rng(3, 5), 2, 3, 8)
    np.testing.assert_array_equal(batch, crops(clips, batch_rng(3, 5), 2, 3, 8))
    (one, _), first = trainer.step(trainer.start(3), batch, 3, 5)
    (other, _), second = trainer.step(trainer.start(3), batch, 3, 5)
    assert float(first) == float(second)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_short_clip_is_played_forth_and_back():
    frames = np.broadcast_to(np.arange(4, dtype=np.uint8)[:, None, None, None], (4, 8, 8, 3))
    batch = crops([Clip("short", frames)], batch_rng(0, 0), 64, 7, 8)[:, :, 0, 0, 0].astype(int)
    assert set(np.unique(np.abs(np.diff(batch)))) == {1}  # no jump, no frame twice
    assert {0, 3} == set(batch.min(1)) | set(batch.max(1)) and len(np.unique(batch[:, 0])) == 4


def test_validation_takes_clips_of_different_lengths(tmp_path):
    frames = np.random.default_rng(0).integers(0, 256, (9, 16, 16, 3), dtype=np.uint8)
    clips = [Clip("short", frames[:4]), Clip("long", frames)]
    validation = Validation(clips, camera_of("canon_5d3", None, None), 6, tmp_path)
    assert validation.clean.shape == validation.noisy.shape == (4, 2, 16, 16, 3)


def test_examples_have_the_light_of_the_clip_as_their_mean():
    camera = camera_of("grasshopper3", None, (30.0, 30.0))
    model = camera.model.with_value("black_level", "value", 200.0)
    batch = np.full((2, 4, 24, 24, 3), 188, np.uint8)  # half of white in linear light
    clean, noisy = examples(batch, jax.random.key(0), model, model, np.float32([30, 30]))
    assert clean.shape == noisy.shape == batch.shape
    np.testing.assert_allclose(clean, 188 / 255, atol=1e-5)
    # Cameras are 10 % off, which the conversion does not know.
    assert float(noisy.mean()) == pytest.approx(0.503, rel=0.15)


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
    scene = evaluate.Scene("ramp", 10.0, clean, clean + 0.1 * rng.standard_normal(clean.shape))

    def net(noisy):  # less what it knows of the ramp, so that only its noise is left
        seen = np.arange(1, len(noisy) + 1).reshape(-1, 1, 1, 1, 1)
        ramp = (clean[1] - clean[0]).max() * (seen - 1) / 2
        return np.cumsum(noisy, 0) / seen + ramp

    found = evaluate.while_memory_fills(net, scene)
    np.testing.assert_allclose(found, 20 + 10 * np.log10(np.arange(1, 5)), atol=0.3)


def test_stills_move_smoothly():
    clips = moving_stills()
    assert len(clips) >= 6
    for clip in clips:
        assert clip.frames.ndim == 4 and clip.frames.shape[3] == 3 and clip.frames.std() > 5


def test_jitter_changes_what_may_not_be_negative_by_a_tenth():
    model = hsnoise.cameras.canon_5d3(black_level_dn=64)
    drawn = [jittered(jax.random.key(i), model).table() for i in range(30)]
    for name, (value, _) in model.table().items():
        ratio = np.array([table[name][0] for table in drawn]) / max(value, 1e-12)
        if name.startswith("black_level") or name == "row_gain.exponent":
            assert np.all(ratio == 1), name
        else:
            assert 0.06 < np.log(ratio).std() < 0.15, name


@pytest.mark.parametrize("kind", ["gaussian", "poisson-gaussian"])
def test_simpler_noise_is_as_strong_before_it_is_clipped(kind):
    """At a black level of 0 half of the noise is cut off, of the camera and of what stands for it."""
    models = [hsnoise.cameras.grasshopper3(black_level_dn=black) for black in (0, 200)]
    numbers = [{n: value for n, (value, _) in matched(m, kind, 4.0).table().items()} for m in models]
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


def test_light_of_the_paper():
    # 0.1 lux on white at f/5.6: 400 electrons that the lens passes 1 in 125 of.
    assert float(OPTICS["canon_5d3"].white_e(0.1)) == pytest.approx(3.1, rel=0.05)


def test_noise_of_another_sensor_is_refused(tmp_path):
    path = tmp_path / "mono.json"
    hsnoise.NoiseModel([ReadNoise(2.0), Gain(1.0)], cfa="mono", shutter="global", exposure_s=0.1).save(path)
    with pytest.raises(ValueError, match="cfa mono"):
        noise_of(str(path), camera_of("canon_5d3", None, None))
    with pytest.raises(ValueError, match="--white-e: needed"):
        camera_of(str(path), None, None)


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


def test_other_weights_are_refused(tmp_path):
    safetensors = pytest.importorskip("safetensors.numpy")
    path = tmp_path / "vgg.safetensors"
    safetensors.save_file(vgg_state(**{"features.2.bias": np.zeros(3, np.float32)}), path)
    with pytest.raises(ValueError, match=r"features.2.bias of shape \(64,\), got \(3,\)"):
        read_weights(path)
    path.write_bytes(b"cut off")
    with pytest.raises(ValueError, match="cannot be read"):
        read_weights(path)


def test_rivals_make_noisy_frames_better():
    rng = np.random.default_rng(0)
    clean = np.asarray(display_from_linear(np.full((3, 32, 32, 3), 0.3)))
    noisy = (0.3 + 0.1 * rng.standard_normal((3, 32, 32, 3))).astype(np.float32)
    before = np.mean((np.asarray(display_from_linear(noisy)) - clean) ** 2)
    for name, denoise in rivals().items():
        if name.startswith("BM"):
            continue
        choice = tuned(denoise, noisy, clean, 0.1)
        after = np.mean((denoised(denoise, noisy, 0.1, *choice) - clean) ** 2)
        assert after < 0.2 * before, name


def test_an_evaluation_is_written(folder, tmp_path, capsys):
    train.main(arguments(folder, tmp_path / "run"))
    weights = tmp_path / "run" / train.ENDED
    evaluate.main(
        [str(weights), "--clips", str(folder), "--crop", "8", "--no-rivals", "--out", str(tmp_path / "found")]
    )
    text = (tmp_path / "found" / "evaluation.md").read_text()
    assert "scaled input" in text and "hsnoise ST-LSTM" in text and "| d |" in text
    assert (tmp_path / "found" / "curves.png").exists() and (tmp_path / "found" / "frames-d.png").exists()
    with pytest.raises(SystemExit):
        evaluate.main([str(weights.with_name("run.json")), "--clips", str(folder)])
    assert "not a file of weights" in capsys.readouterr().err


def test_clips_that_were_trained_on_are_not_scored(folder, tmp_path, capsys):
    train.main(arguments(folder, tmp_path / "run"))
    net, about = load_network(tmp_path / "run" / train.ENDED)
    save_network(tmp_path / "other.eqx", net, {**about, "clips": [*about["clips"], *about["held_out"]]})
    with pytest.raises(SystemExit):
        evaluate.main([str(tmp_path / "other.eqx"), "--clips", str(folder), "--crop", "8", "--no-rivals"])
    assert "was trained on them" in capsys.readouterr().err


def mono_camera(white_e=(20.0, 20.0)):
    model = hsnoise.NoiseModel(
        [ShotNoise(), ReadNoise(2.0), Gain(0.5), BlackLevel(10.0), ADC(4095)],
        cfa="mono",
        shutter="global",
        exposure_s=0.1,
    )
    return Camera("sensor", model, white_e)


def test_light_is_added_to_real_dark_frames():
    camera = mono_camera()
    unseen = np.asarray(hsnoise.sample_dark(jax.random.key(0), 6, (40, 50), camera.model))
    sensor = noise_ablation.Sensor("sensor", None, unseen, 0.1)
    clip = Clip("even", np.full((9, 36, 36, 3), 188, np.uint8))
    clean, noisy = noise_ablation.real_scene(sensor, clip, camera, 3)
    assert clean.shape == noisy.shape == (6, 36, 36, 1)  # as many frames as there are dark ones
    assert noisy.mean() == pytest.approx(0.503, abs=0.02)
    electrons = 20 * 0.503
    assert noisy.std() * 20 == pytest.approx(np.sqrt(electrons + 4 + (1 / 12 / 0.25) * 2), rel=0.05)


@pytest.mark.parametrize("sigma_dn", [0.7, 1.5, 20.0])
def test_noise_of_darks_is_told_before_rounding_and_without_cosmic_hits(rng, sigma_dn):
    darks = np.rint(100 + sigma_dn * rng.standard_normal((6, 200, 200)))
    darks[rng.random(darks.shape) < 2e-5] = 50_000
    sensor = noise_ablation.Sensor("sensor", hsnoise.FrameStack(darks.astype(np.uint16), 0.1), darks, 0.1)
    assert sensor.dark_sigma_dn == pytest.approx(sigma_dn, rel=0.01)


def test_the_ablation_is_told_with_an_error_over_clips_and_seeds():
    base = [{"a": 20.0, "b": 22.0}, {"c": 24.0, "d": 26.0}]
    apart = [{"a": 0.9, "b": 1.3}, {"c": 1.1, "d": 1.5}]

    def moved(by):
        return [{clip: value + by * apart[i][clip] for clip, value in of.items()} for i, of in enumerate(base)]

    of = {"gaussian": moved(-1), "poisson-gaussian": base, "paper": moved(1), "improved": moved(2)}
    text = noise_ablation.table_of({"imx541": of}).markdown()
    over_clips = np.std([0.9, 1.3, 1.1, 1.5], ddof=1) / 2
    assert f"| +1.20 +- {over_clips:.2f} dB |" in text and "| 23.00 | 24.20 |" in text
    # Trainings that differ by more than clips do count; a clip that two of them saw counts once.
    mean, error = noise_ablation.gain_of([{"a": 1.0, "b": 1.2}, {"a": 2.0, "b": 2.2}])
    assert (mean, error) == pytest.approx((1.6, 0.5))
    assert noise_ablation.gain_of([{"a": 1.0, "b": 1.4}])[1] == pytest.approx(0.2)
