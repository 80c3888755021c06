"""The command that enhances a video."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise.cli import main
from hsnoise.mosaic import mosaic
from hsnoise.stlstm import STLSTM
from hsnoise.video import frames_of
from hsnoise.weights import save_network

pytest.importorskip("av")
FRAMES = np.random.default_rng(0).integers(0, 256, (3, 16, 24, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("enhance")
    np.savez(folder / "clip.npz", frames=FRAMES)
    for channels in (1, 3):
        net = STLSTM(jax.random.key(0), maps=2, kernels=(3,), channels=channels)
        save_network(folder / f"weights{channels}.eqx", net, {"camera": "any"})
    return folder


@pytest.mark.parametrize("more", [[], ["--tile", "8", "--brighten", "2"]])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_video_is_enhanced(place, capsys, channels, more):
    out = place / "out.mp4"
    assert (
        main(["enhance", str(place / "clip.npz"), str(out), "--weights", str(place / f"weights{channels}.eqx"), *more])
        == 0
    )
    assert "3 frames at 25 a second" in capsys.readouterr().out
    assert np.stack(list(frames_of(out))).shape == FRAMES.shape


def test_raw_frames_keep_their_own_exposure_and_colours(place, monkeypatch):
    """A model is fitted to darks of other exposures, and perhaps to a region with another first pixel."""
    model = hsnoise.cameras.canon_5d3(black_level_dn=64).with_value("dark_current", "rate", 100.0)
    camera = hsnoise.NoiseModel(model.effects, cfa="BGGR", shutter=model.shutter, exposure_s=0.05)
    light = np.broadcast_to(np.float32([60, 30, 10]), (2, 16, 24, 3))
    counts = hsnoise.sample(jax.random.key(0), mosaic(light, "BGGR"), camera)
    np.savez(place / "bggr.npz", counts=np.asarray(counts)[None], exposure_s=[0.05], cfa="BGGR")
    hsnoise.NoiseModel(model.effects, cfa="RGGB", shutter=model.shutter, exposure_s=2.0).save(place / "fitted.json")
    seen = []

    def keep(net, frames, tile):
        seen.extend(frames)
        return iter(seen)

    monkeypatch.setattr("hsnoise._enhance.enhance", keep)
    arguments = ["--weights", str(place / "weights3.eqx"), "--camera", str(place / "fitted.json")]
    assert main(["enhance", str(place / "bggr.npz"), str(place / "bggr.mp4"), *arguments]) == 0
    red, green, blue = np.mean(seen, axis=(0, 1, 2))
    assert red / blue == pytest.approx(6, rel=0.2) and green / blue == pytest.approx(3, rel=0.2)


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
        (["clip.npz", "nowhere/out.mp4", "--weights", "weights3.eqx"], "no folder"),
        (["none.mp4", "out.mp4", "--weights", "weights3.eqx"], "no such file"),
        (["clip.npz", "out.mp4", "--weights", "clip.npz"], "not a file of weights"),
        (["clip.npz", "out.mp4", "--weights", "none.eqx"], "No such file"),
        (["clip.npz", "out.mp4", "--weights", "weights3.eqx", "--brighten", "0"], "--brighten: expected"),
        (["clip.npz", "out.mp4", "--weights", "weights3.eqx", "--tile", "7"], "tile, margin: expected"),
        (["clip.npz", "out.mp4", "--weights", "weights1.eqx", "--camera", "canon_5d3"], "trained for 1 channels"),
    ],
)
def test_bad_input_is_one_sentence(place, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(place)
    assert main(["enhance", *arguments]) == 2
    assert words in capsys.readouterr().err
