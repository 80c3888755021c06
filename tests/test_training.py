"""Training of the enhancer: examples, runs that are interrupted, bad input."""

from __future__ import annotations

import json

import jax
import numpy as np
import pytest

import hsnoise
from benchmarks import _checkpoints, train
from benchmarks._clips import Clip, crops, held_out, moving_stills, read_clips
from benchmarks._noisy import OPTICS, camera_of, jittered, matched, noise_of
from benchmarks._training import Recipe, Trainer, batch_rng, examples
from hsnoise.mosaic import electrons_of
from hsnoise.weights import load_network

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


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--camera", "nikon"], "--camera: expected"),
        (["--noise", "salt"], "--noise: expected"),
        (["--lux", "0"], "above 0"),
        (["--clips", "nowhere"], "--clips: expected a folder"),
        (["--vgg", "nowhere.pth"], "--vgg: there is no file"),
        (["--preset", "cpu"], "training takes 8 frames"),
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
    with pytest.raises(ValueError, match="at least two"):
        held_out(clips[:1])


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
def test_simpler_noise_has_the_same_variance(kind):
    camera, light_e = hsnoise.cameras.grasshopper3(black_level_dn=200), 4.0
    simple = matched(camera, kind, light_e)
    dark = [
        np.asarray(electrons_of(hsnoise.sample_dark(jax.random.key(1), 8, (128, 128), m), camera))
        for m in (camera, simple)
    ]
    lit = [
        np.asarray(
            electrons_of(hsnoise.sample(jax.random.key(2), np.full((8, 128, 128), light_e, np.float32), m), camera)
        )
        for m in (camera, simple)
    ]
    assert lit[1].mean() == pytest.approx(lit[0].mean(), abs=0.1)
    assert dark[1].mean() == pytest.approx(dark[0].mean(), abs=0.1)
    same = dark if kind == "poisson-gaussian" else lit
    assert same[1].var() == pytest.approx(same[0].var(), rel=0.1)


def test_light_of_the_paper():
    # 0.1 lux on white at f/5.6: 400 electrons that the lens passes 1 in 125 of.
    assert float(OPTICS["canon_5d3"].white_e(0.1)) == pytest.approx(3.1, rel=0.05)


def test_noise_of_another_sensor_is_refused(tmp_path):
    path = tmp_path / "mono.json"
    from hsnoise.effects import Gain, ReadNoise

    hsnoise.NoiseModel([ReadNoise(2.0), Gain(1.0)], cfa="mono", shutter="global", exposure_s=0.1).save(path)
    with pytest.raises(ValueError, match="cfa mono"):
        noise_of(str(path), camera_of("canon_5d3", None, None))
    with pytest.raises(ValueError, match="--white-e: needed"):
        camera_of(str(path), None, None)
