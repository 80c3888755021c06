"""Training of the enhancer: examples, runs that are interrupted, bad input."""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hsnoise
from benchmarks import _ablation_tables, noise_ablation
from benchmarks._ablation_networks import NETWORKS
from benchmarks.evaluate import main as run_evaluate
from benchmarks.train import main as run_train
from hsnoise.chain.photometry import display_from_linear, light_of_frames
from hsnoise.effects import ADC, BlackLevel, DarkCurrent, Gain, ReadNoise, ShotNoise
from hsnoise.enhance.mosaic import electrons_of
from hsnoise.enhance.training import checkpoints, evaluate, train
from hsnoise.enhance.training.clips import Batch, Clip, crops, held_out, read_clips
from hsnoise.enhance.training.noisy import Camera, camera_of
from hsnoise.enhance.training.presets import Preset, Recipe
from hsnoise.enhance.training.protocol import scaled_to
from hsnoise.enhance.training.rivals import denoised, rivals, tuned
from hsnoise.enhance.training.scenes import Scene
from hsnoise.enhance.training.steps import Trainer, batch_rng
from hsnoise.enhance.weights import load_network, save_network

TINY = Preset(6, 2, 3, 8, 3, Recipe(maps=2, kernels=(3,)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of five tiny clips, and a preset of their size."""
    clips = tmp_path_factory.mktemp("clips")
    rng = np.random.default_rng(0)
    for name in "abcde":
        np.savez(clips / f"{name}.npz", frames=rng.integers(0, 256, (4, 12, 14, 3), dtype=np.uint8))
    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(train.PRESETS, "smoke", TINY)
        yield clips


@pytest.fixture(scope="module")
def whole(folder, tmp_path_factory) -> Path:
    """A run that has ended."""
    run = tmp_path_factory.mktemp("whole") / "run"
    run_train(arguments(folder, run))
    return run


@pytest.fixture
def ended(whole, tmp_path) -> Path:
    """A copy of it, for a test that writes into it."""
    return shutil.copytree(whole, tmp_path / "run")


def arguments(folder, out, *more):
    return ["--clips", str(folder), "--out", str(out), *more]


def leaves(path):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(load_network(path)[0])]


@pytest.mark.slow
def test_an_interrupted_run_ends_with_the_same_weights(folder, whole, tmp_path, monkeypatch):
    step, monkeypatch_s = Trainer.step, 0.0
    monkeypatch.setattr(train, "CHECKPOINT_S", monkeypatch_s)

    def killed(self, state, batch, seed, number):
        if number == 4:
            raise KeyboardInterrupt
        return step(self, state, batch, seed, number)

    monkeypatch.setattr(Trainer, "step", killed)
    with pytest.raises(SystemExit):
        run_train(arguments(folder, tmp_path / "cut"))
    monkeypatch.setattr(Trainer, "step", step)
    # The newest checkpoint is cut off in the middle: the one before is taken.
    newest = checkpoints.checkpoints(tmp_path / "cut")[0]
    newest.write_bytes(newest.read_bytes()[:-100])
    run_train(arguments(folder, tmp_path / "cut"))
    for one, other in zip(leaves(whole / train.ENDED), leaves(tmp_path / "cut" / train.ENDED), strict=True):
        np.testing.assert_array_equal(one, other)
    logs = [(run / "log.csv").read_text() for run in (whole, tmp_path / "cut")]
    assert logs[0] == logs[1] and logs[0].count("\n") == 3
    assert len(checkpoints.checkpoints(tmp_path / "cut")) == 2
    assert (tmp_path / "cut" / "validation-00000006.png").stat().st_size > 100


def test_a_full_disk_is_told_and_the_last_checkpoint_stays(ended, monkeypatch):
    kept = [path.read_bytes() for path in checkpoints.checkpoints(ended)]

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hsnoise.enhance.training.checkpoints.write_arrays", full)
    with pytest.raises(OSError, match="the last one is intact"):
        checkpoints.write(ended, 7, {}, {})
    assert [path.read_bytes() for path in checkpoints.checkpoints(ended)] == kept


def test_another_run_in_the_same_folder_is_refused(folder, ended, capsys):
    with pytest.raises(SystemExit):
        run_train(arguments(folder, ended, "--seed", "1"))
    assert "another run (seed differ" in capsys.readouterr().err
    assert json.loads((ended / "run.json").read_text())["seed"] == 0


@pytest.mark.slow
def test_another_model_of_the_same_name_is_another_run(folder, tmp_path, capsys):
    path = tmp_path / "model.json"
    for black_level_dn in (0, 64):
        hsnoise.cameras.canon_5d3(black_level_dn=black_level_dn).save(path)
        run = arguments(folder, tmp_path / "run", "--camera", str(path), "--mean-e", "2,10")
        if black_level_dn == 0:
            run_train(run)
    with pytest.raises(SystemExit):
        run_train(run)
    assert "another run (digests differ" in capsys.readouterr().err


def interrupted(monkeypatch, number):
    """Make the step of this number end as Ctrl-C does."""
    step = Trainer.step

    def killed(self, state, batch, seed, n):
        if n == number:
            raise KeyboardInterrupt
        return step(self, state, batch, seed, n)

    monkeypatch.setattr(Trainer, "step", killed)


def test_an_interrupt_keeps_the_steps_until_then(folder, whole, tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as patched:
        interrupted(patched, 4)
        with pytest.raises(SystemExit):
            run_train(arguments(folder, tmp_path / "run"))
    assert [path.name for path in checkpoints.checkpoints(tmp_path / "run")] == ["checkpoint-00000004.eqx"]
    assert "the same command resumes here" in capsys.readouterr().err
    run_train(arguments(folder, tmp_path / "run"))
    assert "Resuming from step 4" in capsys.readouterr().err
    for one, other in zip(leaves(whole / train.ENDED), leaves(tmp_path / "run" / train.ENDED), strict=True):
        np.testing.assert_array_equal(one, other)
    run_train(arguments(folder, tmp_path / "run"))
    assert "Already finished" in capsys.readouterr().out


def test_checkpoints_of_another_run_are_told_without_its_description(folder, tmp_path, monkeypatch, capsys):
    run = tmp_path / "run"
    interrupted(monkeypatch, 4)
    with pytest.raises(SystemExit):
        run_train(arguments(folder, run))
    (run / train.DESCRIBED).write_text('{"preset": ')
    with pytest.raises(SystemExit):
        run_train(arguments(folder, run))
    assert "run.json: damaged" in capsys.readouterr().err
    (run / train.DESCRIBED).unlink()
    with pytest.raises(SystemExit):
        run_train(arguments(folder, run, "--seed", "7"))
    assert "another run (seed differ" in capsys.readouterr().err


@pytest.mark.parametrize("damage", [b"\n\n", b"3,0.1", b"x,1,2,3\n", bytes(range(128, 256))])
def test_a_damaged_log_does_not_stop_a_run(tmp_path, damage):
    path = tmp_path / "log.csv"
    train.append_log(path, 2, 0.5, 10.0, 5.0)
    path.write_bytes(path.read_bytes() + damage)
    train.append_log(path, 4, 0.25, 11.0, 5.0)
    assert path.read_text().split() == [
        ",".join(train.LOGGED),
        "2,0.500000,10.0000,5.0000",
        "4,0.250000,11.0000,5.0000",
    ]


def test_a_loss_that_is_no_number_ends_the_run(folder, tmp_path, monkeypatch, capsys):
    step = Trainer.step
    monkeypatch.setattr(Trainer, "step", lambda self, *args: (step(self, *args)[0], jnp.float32(np.nan)))
    with pytest.raises(SystemExit):
        run_train(arguments(folder, tmp_path / "run"))
    assert "the loss is nan" in capsys.readouterr().err
    assert not (tmp_path / "run" / train.ENDED).exists() and not checkpoints.checkpoints(tmp_path / "run")


def test_a_first_checkpoint_that_was_cut_off_begins_anew(tmp_path):
    tree, said = {"weight": jnp.arange(3.0)}, []
    path = checkpoints.write(tmp_path, 100, tree, {})
    path.write_bytes(path.read_bytes()[:-4])
    assert checkpoints.read_newest(tmp_path, tree, said.append) is None
    assert "none before it" in said[0] and not checkpoints.checkpoints(tmp_path)
    for step in (200, 300):
        path = checkpoints.write(tmp_path, step, tree, {})
        path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(ValueError, match="none of its 2 checkpoints"):
        checkpoints.read_newest(tmp_path, tree, said.append)


def test_damaged_checkpoints_do_not_push_out_good_ones(tmp_path):
    tree = {"weight": jnp.arange(3.0)}
    for step in (100, 200):
        checkpoints.write(tmp_path, step, tree, {})
    cut = checkpoints.checkpoints(tmp_path)[0]
    cut.write_bytes(cut.read_bytes()[:-4])
    said = []
    assert checkpoints.read_newest(tmp_path, tree, said.append)[1]["step"] == 100
    assert "using the one before" in said[0]
    for step in (150, 160):
        checkpoints.write(tmp_path, step, tree, {})
    assert [path.name[11:19] for path in checkpoints.checkpoints(tmp_path)] == ["00000160", "00000150"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--camera", "nikon"], "--camera: expected"),
        (["--noise", "salt"], "--noise: expected"),
        (["--lux", "0"], "--lux: expected low,high"),
        (["--lux", "nan"], "--lux: expected low,high"),
        (["--lux", "0.1", "--mean-e", "3,4"], "both say how much light"),
        (["--mean-e", "1,inf"], "--mean-e: expected low,high"),
        (["--mean-e", "4,3"], "--mean-e: expected low,high"),
        (["--exposure", "0.1"], "--exposure: goes with a model.json"),
        (["--steps", "0"], "--steps: expected at least 1"),
        (["--seed", "-1"], "--seed: expected 0 to"),
        (["--seed", str(2**70)], "--seed: expected 0 to"),
        (["--clips", "nowhere"], "--clips: expected a folder"),
        (["--vgg", "nowhere.pth"], "--vgg: there is no file"),
        (["--preset", "cpu"], "expected 12 frames"),
    ],
)
def test_bad_input_is_named(folder, tmp_path, capsys, more, words):
    with pytest.raises(SystemExit):
        run_train(arguments(folder, tmp_path / "run", *more))
    assert words in capsys.readouterr().err


def test_the_same_step_is_the_same_whatever_came_before(folder):
    camera = camera_of("canon_5d3", None, None)
    clips, _ = held_out(read_clips(folder))
    trainer = Trainer(TINY.recipe, 6, camera, camera.model)
    batch = crops(clips, batch_rng(3, 5), 2, 3, 8)
    np.testing.assert_array_equal(batch.frames, crops(clips, batch_rng(3, 5), 2, 3, 8).frames)
    (one, _), first = trainer.step(trainer.start(3), batch, 3, 5)
    (other, _), second = trainer.step(trainer.start(3), batch, 3, 5)
    assert float(first) == float(second)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


def test_rivals_that_are_not_installed_are_named_with_their_extra(monkeypatch, capsys):
    monkeypatch.setattr("hsnoise.enhance.training.rivals.find_spec", lambda name: None)
    monkeypatch.setattr(evaluate, "rivals", dict)  # the others take minutes
    evaluate.methods_of(None, None, untrained=True)
    assert "BM3D and BM4D over frames are left out: pip install 'hsnoise[peers]'" in capsys.readouterr().err


def test_rivals_make_noisy_frames_better():
    rng = np.random.default_rng(0)
    clean = np.asarray(display_from_linear(np.full((3, 32, 32, 3), 0.3)))
    camera = camera_of("canon_5d3", None, (20.0, 20.0))
    noisy = ((rng.poisson(30.0, clean.shape) + 3.5 * rng.standard_normal(clean.shape)) / camera.unit_e).astype(
        np.float32
    )
    scene = Scene("even", camera, 30.0, 100.0, clean, noisy)

    def error_of(found):
        return np.mean((scaled_to(found, clean) - clean) ** 2)

    for name, denoise in rivals().items():
        if not name.startswith("BM"):
            choice = tuned(denoise, scene)
            assert error_of(denoised(denoise, scene, *choice)) < 0.2 * error_of(display_from_linear(noisy)), name


@pytest.mark.slow
def test_an_evaluation_is_written(folder, whole, tmp_path, capsys):
    weights = whole / train.ENDED
    run_evaluate([str(weights), "--clips", str(folder), "--crop", "8", "--no-rivals", "--out", str(tmp_path / "found")])
    text = (tmp_path / "found" / "evaluation.md").read_text()
    assert "scaled input" in text and "hsnoise ST-LSTM" in text and "| d |" in text
    assert "canon_5d3, 0.05 lux to 0.2 lux" in text
    assert len((tmp_path / "found" / "frames.csv").read_text().splitlines()) == 1 + 3 * 3 * 4  # methods, levels, frames
    assert (tmp_path / "found" / "curves.png").exists() and (tmp_path / "found" / "frames-d.png").exists()
    with pytest.raises(SystemExit):
        run_evaluate([str(weights.with_name("run.json")), "--clips", str(folder)])
    assert "not a file of weights" in capsys.readouterr().err


def test_clips_that_were_trained_on_are_not_scored(folder, whole, tmp_path, capsys):
    net, about = load_network(whole / train.ENDED)
    save_network(tmp_path / "other.eqx", net, {**about, "clips": [*about["clips"], *about["held_out"]]})
    with pytest.raises(SystemExit):
        run_evaluate([str(tmp_path / "other.eqx"), "--clips", str(folder), "--crop", "8", "--no-rivals"])
    assert "was not trained on, got" in capsys.readouterr().err
    renamed = shutil.copytree(folder, tmp_path / "clips")
    (renamed / "a.npz").rename(renamed / "d2.npz")  # the fourth by name now
    with pytest.raises(SystemExit):
        run_evaluate([str(whole / train.ENDED), "--clips", str(renamed), "--crop", "8", "--no-rivals"])
    assert "was not trained on, got d2" in capsys.readouterr().err


def test_weights_are_judged_with_the_camera_and_light_of_their_training(folder, tmp_path, capsys):
    model, other = tmp_path / "model.json", tmp_path / "other" / "model.json"
    other.parent.mkdir()
    hsnoise.cameras.canon_5d3(black_level_dn=64).save(model)
    hsnoise.cameras.canon_5d3(black_level_dn=128).save(other)
    run_train(arguments(folder, tmp_path / "run", "--camera", str(model), "--mean-e", "2,10"))
    judge = [str(tmp_path / "run" / train.ENDED), "--clips", str(folder), "--crop", "8", "--no-rivals"]
    judge += ["--out", str(tmp_path / "found")]
    with pytest.raises(SystemExit):
        run_evaluate(judge)
    assert "--camera: the weights were trained for model" in capsys.readouterr().err
    run_evaluate([*judge, "--camera", str(model)])
    assert "other noise" not in capsys.readouterr().err
    assert "2 e- to 10 e-" in (tmp_path / "found" / "evaluation.md").read_text()
    run_evaluate([*judge, "--camera", str(other)])
    assert "other noise" in capsys.readouterr().err


def mono_camera(mean_e=(20.0, 20.0)):
    model = hsnoise.NoiseModel(
        [ShotNoise(), ReadNoise(2.0), Gain(0.5), BlackLevel(10.0), ADC(4095)],
        cfa="mono",
        shutter="global",
        exposure_s=0.1,
    )
    return Camera("sensor", model, mean_e)


def test_real_darks_train_as_drawn_ones_do(rng):
    camera = mono_camera()
    darks = np.asarray(hsnoise.sample_dark(jax.random.key(0), 3, (40, 50), camera.model), float)
    darks += 4 * rng.standard_normal((40, 50))  # pixels differ
    pieces = np.full((4, 8, 32, 32, 3), 188, np.uint8)
    batch = Batch(pieces, np.full(4, 0.5))
    clean, noisy = noise_ablation.real_examples(batch, darks, camera, rng)
    light = np.asarray(light_of_frames(pieces, 1))
    assert clean.shape == noisy.shape == light.shape
    assert noisy.mean() * camera.unit_e == pytest.approx(20 * float(light.mean()) / 0.5, rel=0.02)
    mixed = noise_ablation.shuffled(darks)
    np.testing.assert_array_equal(np.sort(mixed.reshape(3, -1)), np.sort(darks.reshape(3, -1)))
    np.testing.assert_allclose(np.sort(mixed.var(0), axis=None), np.sort(darks.var(0), axis=None))  # pixels stay whole
    assert not np.array_equal(mixed, darks)


def test_dim_light_on_real_darks_stays_linear(rng):
    """Where the gain is below 0.5 DN/e-, light that is rounded by itself would lose single photoelectrons."""
    camera = mono_camera((1.0, 1.0))
    darks = np.rint(10 + 0.3 * rng.standard_normal((2, 60, 60)))
    gain, mean_e = float(camera.model["gain"].value[0]), 0.3
    noisy = noise_ablation.on_darks(np.ones((2, 60, 60, 1)), mean_e, darks, camera, rng)
    expected = mean_e + (darks.mean() - 10) / gain
    assert float(noisy.mean()) * camera.unit_e == pytest.approx(expected, abs=4 * np.sqrt(mean_e / noisy.size))


@pytest.mark.slow
def test_light_is_added_to_real_dark_frames():
    camera = mono_camera()
    unseen = np.asarray(hsnoise.sample_dark(jax.random.key(0), 6, (40, 50), camera.model))
    sensor = noise_ablation.Sensor("sensor", None, unseen, 0.1)
    clip = Clip("even", np.full((9, 36, 36, 3), 188, np.uint8))
    clean, noisy = noise_ablation.real_scene(sensor, clip, camera, 3)
    assert clean.shape == noisy.shape == (6, 36, 36, 1)  # as many frames as there are dark ones
    assert camera.unit_e == pytest.approx(100) and noisy.mean() * 100 == pytest.approx(20, rel=0.02)
    assert noisy.std() * 100 == pytest.approx(np.sqrt(20 + 4 + (1 / 12 / 0.25) * 2), rel=0.05)


def test_the_level_of_darks_is_taken_off_whatever_the_fit_says(rng):
    # A fit whose level is off by 30 DN, in frames with hot pixels.
    effects = [ShotNoise(), DarkCurrent(40.0), ReadNoise(3.0), Gain(2.0), BlackLevel(100.0), ADC(4095)]
    model = hsnoise.NoiseModel(effects, cfa="mono", shutter="global", exposure_s=0.5)
    darks = np.asarray(hsnoise.sample_dark(jax.random.key(0), 4, (64, 64), model), float)
    hot = np.where(rng.random(darks.shape) < 0.01, 4000.0, darks)
    assert noise_ablation.level_of(hot) == pytest.approx(140, abs=0.6)
    camera = Camera("sensor", model.with_value("black_level", "value", 130.0), (20.0, 20.0))
    camera = noise_ablation.levelled(camera, noise_ablation.level_of(hot))
    assert float(electrons_of(darks, camera.model).mean()) == pytest.approx(0, abs=0.3)


@pytest.mark.parametrize("sigma_dn", [0.7, 1.5, 20.0])
def test_noise_of_darks_is_told_before_rounding_and_without_cosmic_hits(rng, sigma_dn):
    darks = np.rint(100 + sigma_dn * rng.standard_normal((6, 200, 200)))
    darks[rng.random(darks.shape) < 2e-5] = 50_000
    sensor = noise_ablation.Sensor("sensor", hsnoise.FrameStack(darks.astype(np.uint16), 0.1), darks, 0.1)
    assert sensor.dark_sigma_dn == pytest.approx(sigma_dn, rel=0.01)


@pytest.mark.slow
def test_the_ablation_is_told_with_an_error_over_clips_and_seeds():
    base = [{"a": 20.0, "b": 22.0}, {"c": 24.0, "d": 26.0}]
    apart = [{"a": 0.9, "b": 1.3}, {"c": 1.1, "d": 1.5}]

    def moved(by):
        return [{clip: value + by * apart[i][clip] for clip, value in of.items()} for i, of in enumerate(base)]

    of = {"gaussian": moved(-1), "poisson-gaussian": base, "paper": moved(1), "improved": moved(2)}
    of |= {noise_ablation.REAL: moved(4), noise_ablation.SHUFFLED: base}

    def told(of):
        return _ablation_tables.table_of({"imx541": of}, "psnr_db", "st-lstm").markdown()

    text = told(of)
    over_clips = np.std([0.9, 1.3, 1.1, 1.5], ddof=1) / 2
    assert f"| +1.20 +- {over_clips:.2f} |" in text and "| 23.00 | 24.20 |" in text
    assert "| 50 +- 0 % |" in text
    assert "no gap beyond chance" in told(of | {noise_ablation.REAL: base})
    # Trainings that differ by more than clips do count; a clip that two of them saw counts once.
    mean, error = _ablation_tables.gain_of([{"a": 1.0, "b": 1.2}, {"a": 2.0, "b": 2.2}])
    assert (mean, error) == pytest.approx((1.6, np.hypot(0.1, 0.5)))
    assert _ablation_tables.gain_of([{"a": 1.0, "b": 1.4}])[1] == pytest.approx(0.2)


@pytest.mark.slow
@pytest.mark.parametrize("network", NETWORKS)
def test_both_networks_of_the_ablation_learn_from_drawn_and_real_darks(tmp_path, rng, network):
    kind, camera = NETWORKS[network], mono_camera((4.0, 40.0))
    camera = replace(camera, model=camera.model.add(DarkCurrent(1.0)))
    options = argparse.Namespace(steps=3, maps=2, stride=4, side=32, jitter=0.0, out=tmp_path)
    clips = [Clip("even", rng.integers(90, 190, (8, 40, 40, 3)).astype(np.uint8))]
    darks = np.asarray(hsnoise.sample_dark(jax.random.key(0), 8, (40, 50), camera.model), float)
    sensor = noise_ablation.Sensor("sensor", None, darks, 0.1)
    for name, noise in (("paper", camera.model), (noise_ablation.REAL, darks)):
        path = noise_ablation.trained(kind, camera, name, noise, clips, 0, options)
        assert path == noise_ablation.trained(kind, camera, name, noise, clips, 0, options)  # kept
        scores = noise_ablation.measured(sensor, kind.video(path, camera), camera, clips, 1)["even"]
        assert scores["psnr_scaled_db"] >= scores["psnr_db"] - 0.01 and 0 < scores["ssim_scaled"] < 1
