"""The command that enhances a video."""

from __future__ import annotations

import os
import signal

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise.chain.photometry import display_from_linear, frames_of_display
from hsnoise.cli.main import main
from hsnoise.enhance.mosaic import mosaic
from hsnoise.enhance.video import frames_of
from hsnoise.enhance.weights import save_network
from hsnoise.stlstm import STLSTM

pytest.importorskip("av")
FRAMES = np.random.default_rng(0).integers(0, 256, (3, 16, 24, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("enhance")
    np.savez(folder / "clip.npz", frames=FRAMES)
    for channels in (1, 2, 3):
        net = STLSTM(jax.random.key(0), maps=2, kernels=(3,), channels=channels)
        save_network(folder / f"weights{channels}.eqx", net, {"camera": "any"})
    (folder / "link.mp4").symlink_to(folder / "video.mp4")
    (folder / "video.mp4").write_bytes(b"of the user")
    (folder / "raw").mkdir()
    np.savez(folder / "raw" / "0.npz", counts=FRAMES[..., 0][None], exposure_s=[0.05])
    np.savez(folder / "counts.npz", counts=FRAMES[..., 0][None], exposure_s=[0.05])
    return folder


@pytest.fixture
def seen(monkeypatch):
    """The light that comes to the network."""
    frames = []

    def keep(net, light, **how):
        frames.extend(light)
        return iter(frames)

    monkeypatch.setattr("hsnoise.cli.enhance.enhance", keep)
    return frames


@pytest.mark.parametrize("more", [[], ["--tile", "8", "--brighten", "2"], ["--look-ahead", "2", "--mirrored"]])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_video_is_enhanced(place, capsys, channels, more):
    out = place / "out.mp4"
    assert (
        main(["enhance", str(place / "clip.npz"), str(out), "--weights", str(place / f"weights{channels}.eqx"), *more])
        == 0
    )
    assert "3 frames at 25 a second" in capsys.readouterr().out
    assert np.stack(list(frames_of(out))).shape == FRAMES.shape


def test_without_weights_those_that_come_with_hsnoise_are_taken(place, capsys):
    assert main(["enhance", str(place / "clip.npz"), str(place / "shipped.mp4")]) == 0
    assert (
        "Using the weights that come with hsnoise, trained for canon_5d3, scenes that average 1.6 to 6.2"
        in capsys.readouterr().err
    )
    assert np.stack(list(frames_of(place / "shipped.mp4"))).shape == FRAMES.shape


def test_a_built_in_camera_has_its_own_weights(place, capsys, monkeypatch):
    monkeypatch.setattr("hsnoise.cli.enhance.enhance", lambda net, frames, **how: iter([]))
    model = hsnoise.cameras.grasshopper3()
    counts = np.asarray(hsnoise.sample(0, np.full((2, 16, 24), 2.0, np.float32), model))
    np.savez(place / "g.npz", counts=counts[None], exposure_s=[0.03], cfa=model.cfa)
    main(["enhance", str(place / "g.npz"), str(place / "g.mp4"), "--camera", "grasshopper3"])
    assert "trained for grasshopper3, scenes that average 0.68 to 2" in capsys.readouterr().err


def test_raw_frames_keep_their_own_exposure_and_colours(place, seen):
    """A model is fitted to darks of other exposures, and perhaps to a region with another first pixel."""
    model = hsnoise.cameras.canon_5d3(black_level_dn=64).with_value("dark_current", "rate", 100.0)
    camera = hsnoise.NoiseModel(model.effects, cfa="BGGR", shutter=model.shutter, exposure_s=0.05)
    light = np.broadcast_to(np.float32([60, 30, 10]), (2, 16, 24, 3))
    counts = hsnoise.sample(jax.random.key(0), mosaic(light, "BGGR"), camera)
    np.savez(place / "bggr.npz", counts=np.asarray(counts)[None], exposure_s=[0.05], cfa="BGGR")
    hsnoise.NoiseModel(model.effects, cfa="RGGB", shutter=model.shutter, exposure_s=2.0).save(place / "fitted.json")
    arguments = ["--weights", str(place / "weights3.eqx"), "--camera", str(place / "fitted.json")]
    assert main(["enhance", str(place / "bggr.npz"), str(place / "bggr.mp4"), *arguments]) == 0
    red, green, blue = np.mean(seen, axis=(0, 1, 2))
    assert red / blue == pytest.approx(6, rel=0.2) and green / blue == pytest.approx(3, rel=0.2)


@pytest.mark.parametrize("black_level", [128.0, [128.0, 129.0, 130.0]])
def test_raw_frames_keep_their_own_black_level(place, seen, black_level):
    camera = hsnoise.cameras.canon_5d3().with_value("black_level", "value", np.float32(black_level))
    light = np.broadcast_to(np.float32([60, 30, 10]), (2, 16, 24, 3))
    counts = np.asarray(hsnoise.sample(jax.random.key(0), mosaic(light, "RGGB"), camera))
    np.savez(place / "black.npz", counts=counts[None], exposure_s=[0.05], cfa="RGGB", black_level=black_level)
    arguments = ["--weights", str(place / "weights3.eqx"), "--camera", "canon_5d3"]  # the model's is 0
    assert main(["enhance", str(place / "black.npz"), str(place / "black.mp4"), *arguments]) == 0
    red, green, blue = np.mean(seen, axis=(0, 1, 2))
    assert red / blue == pytest.approx(6, rel=0.2) and green / blue == pytest.approx(3, rel=0.2)


@pytest.mark.parametrize("more", [[], ["--camera", "canon_5d3"]])
def test_brighten_acts_before_the_network(place, seen, more):
    counts = np.random.default_rng(0).integers(0, 200, (1, 2, 16, 24), dtype=np.uint16)
    np.savez(place / "even.npz", counts=counts, exposure_s=[0.05], frames=FRAMES[:2])
    means = []
    for factor in ("1", "4"):
        seen.clear()
        arguments = ["--weights", str(place / "weights3.eqx"), "--brighten", factor, *more]
        assert main(["enhance", str(place / "even.npz"), str(place / "even.mp4"), *arguments]) == 0
        means.append(np.mean(seen[0]))
    assert means[1] == pytest.approx(4 * means[0], rel=1e-5)
    assert not more or means[0] == pytest.approx(0.2, rel=1e-5)


def test_raw_frames_are_divided_by_the_unit_of_the_weights(place, seen):
    camera = hsnoise.cameras.grasshopper3(black_level_dn=64)
    counts = hsnoise.sample(jax.random.key(0), mosaic(np.full((2, 48, 64, 3), 15.0, np.float32), "RGGB"), camera)
    np.savez(place / "lit.npz", counts=np.asarray(counts)[None], exposure_s=[0.03])
    camera.save(place / "lit.json")
    about = {"camera": "grasshopper3", "mean_e": [20.0, 45.0], "unit_e": 150.0}
    save_network(place / "unit.eqx", STLSTM(jax.random.key(0), maps=2, kernels=(3,)), about)
    arguments = ["--weights", str(place / "unit.eqx"), "--camera", str(place / "lit.json"), "--brighten", "2"]
    assert main(["enhance", str(place / "lit.npz"), str(place / "lit.mp4"), *arguments]) == 0
    assert np.mean(seen[0]) == pytest.approx(2 * 15 / 150, rel=0.03)


def test_nothing_is_left_of_a_run_that_is_terminated(place, monkeypatch):
    def ended(net, light, **how):
        yield next(light)
        os.kill(os.getpid(), signal.SIGTERM)
        yield next(light)

    monkeypatch.setattr("hsnoise.cli.enhance.enhance", ended)
    before, files = signal.signal(signal.SIGTERM, signal.SIG_IGN), set(place.iterdir())
    try:
        with pytest.raises(SystemExit, match="143"):
            main(["enhance", str(place / "clip.npz"), str(place / "end.mp4"), "--weights", str(place / "weights3.eqx")])
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_IGN and set(place.iterdir()) == files
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("dim", [1.0, 0.1])
def test_video_that_is_far_cleaner_than_in_training_is_told(place, capsys, dim):
    save_network(
        place / "dark.eqx", STLSTM(jax.random.key(0), maps=2, kernels=(3,)), {"mean_e": [1.5, 6.0], "unit_e": 6.0}
    )
    picture = dim * np.linspace(0, 1, 48 * 64 * 3).reshape(48, 64, 3)
    noisy = np.random.default_rng(0).poisson(6 * picture) / 6  # shot noise alone, at the most light that was trained on
    for light, told in ((picture, True), (noisy, False)):
        np.savez(place / "light.npz", frames=frames_of_display(display_from_linear(light))[None])
        arguments = [str(place / "light.npz"), str(place / "light.mp4"), "--weights", str(place / "dark.eqx")]
        assert main(["enhance", *arguments]) == 0
        assert ("IN: has far less noise" in capsys.readouterr().err) == told


def test_frames_without_light_are_refused(place, capsys):
    camera = hsnoise.cameras.canon_5d3(black_level_dn=64)
    counts = hsnoise.sample_dark(jax.random.key(0), 2, (32, 48), camera, exposure_s=0.001)
    np.savez(place / "dark.npz", counts=np.asarray(counts)[None], exposure_s=[5.0])
    arguments = ["--weights", str(place / "weights3.eqx"), "--camera", "canon_5d3"]
    assert main(["enhance", str(place / "dark.npz"), str(place / "dark.mp4"), *arguments]) == 2
    assert "e- from black" in capsys.readouterr().err


def test_raw_frames_are_enhanced(place):
    camera = hsnoise.cameras.canon_5d3(black_level_dn=64)
    counts = hsnoise.sample(jax.random.key(0), mosaic(np.full((4, 16, 24, 3), 20.0, np.float32), "RGGB"), camera)
    np.savez(place / "raw.npz", counts=np.asarray(counts)[None], exposure_s=[0.05])
    camera.save(place / "camera.json")
    arguments = ["--weights", str(place / "weights3.eqx"), "--camera", str(place / "camera.json")]
    assert main(["enhance", str(place / "raw.npz"), str(place / "raw.mp4"), *arguments]) == 0
    assert np.stack(list(frames_of(place / "raw.mp4"))).shape == (4, 16, 24, 3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["clip.npz", "out.gif", "--weights", "weights3.eqx"], "expected a video file"),
        (["clip.npz", "out.webm", "--weights", "weights3.eqx"], "expected a video file"),
        (["clip.npz", "out.mp4", "--weights", "weights3.eqx", "--rate", "0"], "--rate: expected"),
        (["clip.npz", "out.mp4", "--weights", "weights3.eqx", "--rate", "1e-9"], "--rate: expected 0.01 to 1000"),
        (["clip.npz", "out.mp4", "--weights", "weights3.eqx", "--rate", "1e9"], "--rate: expected 0.01 to 1000"),
        (["video.mp4", "video.mp4", "--weights", "weights3.eqx"], "OUT: expected another file than IN"),
        (["video.mp4", "link.mp4", "--weights", "weights3.eqx"], "OUT: expected another file than IN"),
        (["link.mp4", "video.mp4", "--weights", "weights3.eqx"], "OUT: expected another file than IN"),
        (["raw", "out.mp4", "--weights", "weights3.eqx"], "raw: holds no frames; if these are raw frames, give"),
        (["counts.npz", "out.mp4", "--weights", "weights3.eqx"], "if these are raw frames, give --camera"),
        (["clip.npz", "out.mp4", "--weights", "weights3.eqx", "--cfa", "RGGB"], "--cfa: goes with --camera"),
        (["clip.npz", "out.mp4", "--weights", "weights3.eqx", "--exposure", "1"], "--exposure: goes with --camera"),
        (["clip.npz", "out.mp4", "--weights", "weights3.eqx", "--camera", "nikon"], "--camera: expected a model.json"),
        (
            ["counts.npz", "out.mp4", "--weights", "weights3.eqx", "--camera", "canon_5d3", "--cfa", "mono"],
            "--camera: a model of RGGB, but the frames of counts.npz are mono",
        ),
        (["clip.npz", "nowhere/out.mp4", "--weights", "weights3.eqx"], "no folder"),
        (["none.mp4", "out.mp4", "--weights", "weights3.eqx"], "no such file"),
        (["clip.npz", "out.mp4", "--weights", "clip.npz"], "not a file of weights"),
        (["clip.npz", "out.mp4", "--weights", "none.eqx"], "No such file"),
        (["clip.npz", "out.mp4", "--weights", "weights3.eqx", "--brighten", "0"], "--brighten: expected"),
        (["clip.npz", "out.mp4", "--weights", "weights3.eqx", "--brighten", "inf"], "--brighten: expected"),
        (["clip.npz", "out.mp4", "--weights", "weights3.eqx", "--brighten", "1e300"], "--brighten: expected"),
        (["clip.npz", "out.mp4", "--weights", "weights3.eqx", "--tile", "7"], "--tile: expected a multiple of 2"),
        (["clip.npz", "out.mp4", "--weights", "weights1.eqx", "--camera", "canon_5d3"], "trained for 1 channels"),
        (["clip.npz", "out.mp4", "--weights", "weights2.eqx"], "trained for 2 channels (camera any), a video has 1 or"),
    ],
)
def test_bad_input_is_one_sentence(place, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(place)
    assert main(["enhance", *arguments]) == 2
    assert words in capsys.readouterr().err
    assert (place / "video.mp4").read_bytes() == b"of the user"
