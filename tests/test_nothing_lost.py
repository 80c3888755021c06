"""Processes that are killed: nothing is lost but the time since the last step, and what they leave is cleared away."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from hsnoise._core.folders import LOCK, OLD_S, alone_in, sweep
from hsnoise._core.output import write_atomically
from hsnoise.cli.main import main
from hsnoise.enhance.training import train
from hsnoise.enhance.training.presets import Preset, Recipe

ROOT = Path(__file__).parents[1]
KILLS = 20
# `hsnoise improve` with few candidates.
IMPROVE = """
import importlib, sys
from hsnoise.cli.main import main
from hsnoise.criticism import candidates
diagnose, whole = importlib.import_module("hsnoise.criticism.diagnose"), candidates.built_in
few = ("row_noise", "frame_offset", "column_noise")
diagnose.built_in = lambda facts: {name: maker for name, maker in whole(facts).items() if name in few}
sys.exit(main(["improve", *sys.argv[1:]]))
"""
# `hsnoise train` with a network of two maps, and a checkpoint after each step.
TRAIN = """
import sys
from hsnoise.cli.main import main
from hsnoise.enhance.training import train
from hsnoise.enhance.training.presets import Preset, Recipe
train.PRESETS["smoke"] = Preset(60, 2, 3, 8, 20, Recipe(maps=2, kernels=(3,)))
train.CHECKPOINT_S = 0.0
sys.exit(main(["train", *sys.argv[1:]]))
"""

without_sigkill = pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")


def processes_of(folder: Path, *words: str):
    """Starts Python with these words and more; programs that were compiled before are kept in the folder."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(folder / "compiled"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}

    def start(*more: str) -> subprocess.Popen:
        return subprocess.Popen(
            [sys.executable, *words, *more],
            cwd=ROOT,
            env={**os.environ, **cache},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    return start


def ended(process: subprocess.Popen) -> tuple[int, str]:
    _, said = process.communicate(timeout=600)
    return process.returncode, said


def killed_again_and_again(start, out: Path, whole: Path, took_s: float, names: tuple[str, ...]) -> None:
    """Kill processes at a moment of the time that one takes undisturbed, until the last may end.

    Each that ends leaves the files of the undisturbed one; the next begins anew.
    """
    rng, kills = np.random.default_rng(3), 0
    while kills <= KILLS:
        process = start()
        try:
            _, said = process.communicate(timeout=rng.uniform(0.1, 1.0) * took_s if kills < KILLS else 600)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.communicate()
            kills += 1
            continue
        assert process.returncode in (0, 1), said
        for name in names:
            assert (out / name).read_bytes() == (whole / name).read_bytes(), (name, kills)
        shutil.rmtree(out)
        kills += kills == KILLS


def undisturbed_s(start) -> float:
    """How long a process takes, now that all that it needs is compiled."""
    began = time.monotonic()
    status, said = ended(start())
    assert status in (0, 1), said
    return time.monotonic() - began


@without_sigkill
@pytest.mark.slow
def test_improve_goes_on_to_the_same_model(tmp_path):
    rng = np.random.default_rng(1)
    exposures_s, counts = (0.05, 0.2, 0.8), []
    for exposure_s in exposures_s:
        electrons = rng.poisson(120 * exposure_s, (8, 32, 48)) + rng.normal(0, 3, (8, 32, 48))
        rows = rng.normal(0, 2, (8, 32, 1))
        counts.append(np.clip(np.rint(100 + 1.7 * (electrons + rows)), 0, 4095).astype(np.uint16))
    known = {"cfa": "mono", "shutter": "global", "black_level": 100, "white_level": 4095}
    np.savez(tmp_path / "darks.npz", counts=np.stack(counts), exposure_s=exposures_s, **known)
    start = processes_of(tmp_path, "-c", IMPROVE, str(tmp_path / "darks.npz"), "--max-steps", "1", "--out")
    whole, out = tmp_path / "whole", tmp_path / "killed"
    undisturbed_s(lambda: start(str(tmp_path / "first")))  # compiles
    took_s = undisturbed_s(lambda: start(str(whole)))
    files = ("model.json", "table.csv", "story.txt", "story.json")
    killed_again_and_again(lambda: start(str(out), "--resume"), out, whole, took_s, files)
    assert "row_noise" in (whole / "model.json").read_text()


@pytest.fixture
def clips(tmp_path) -> Path:
    (tmp_path / "clips").mkdir()
    rng = np.random.default_rng(0)
    for name in "abcde":
        frames = rng.integers(0, 256, (4, 12, 14, 3), dtype=np.uint8)
        np.savez(tmp_path / "clips" / f"{name}.npz", frames=frames)
    return tmp_path / "clips"


@without_sigkill
@pytest.mark.slow
def test_train_goes_on_to_the_same_weights(clips, tmp_path):
    start = processes_of(tmp_path, "-c", TRAIN, "--clips", str(clips), "--out")
    whole, out = tmp_path / "whole", tmp_path / "killed"
    undisturbed_s(lambda: start(str(tmp_path / "first")))  # compiles
    took_s = undisturbed_s(lambda: start(str(whole)))
    files = (train.ENDED, "log.csv", "validation-00000060.png")
    killed_again_and_again(lambda: start(str(out)), out, whole, took_s, files)


@without_sigkill
@pytest.mark.slow
def test_of_two_trainings_in_a_folder_one_is_refused_until_the_other_is_killed(clips, tmp_path):
    start = processes_of(tmp_path, "-c", TRAIN, "--clips", str(clips), "--out", str(tmp_path / "run"))
    first = start("--steps", "1000000")
    while not list(tmp_path.glob("run/checkpoint-*")):
        assert first.poll() is None, first.stderr.read()
        time.sleep(0.1)
    status, said = ended(start("--steps", "1000000"))
    assert status == 2 and "another process is at work" in said
    first.send_signal(signal.SIGKILL)
    first.communicate()
    again = start("--steps", "1000000")
    assert any("Resuming from step" in line for line in again.stderr)
    again.send_signal(signal.SIGKILL)
    again.communicate()


def test_a_folder_in_which_another_process_is_at_work_is_refused(clips, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(train.PRESETS, "smoke", Preset(1, 2, 3, 8, 1, Recipe(maps=2)))
    out = tmp_path / "run"
    out.mkdir()
    with alone_in(out):
        assert main(["train", "--clips", str(clips), "--out", str(out)]) == 2
    assert f"--out: another process is at work in {out}" in capsys.readouterr().err
    assert {path.name for path in out.iterdir()} == {LOCK}
    with alone_in(out):  # it is free again
        pass


def test_remains_are_swept_if_they_are_ours_and_old(tmp_path, monkeypatch):
    """Of a file that could not be moved to its place; its name is made by the code that writes files."""

    def remains(name: str) -> Path:
        with monkeypatch.context() as patched:
            patched.setattr("hsnoise._core.output.os.replace", lambda *_: None)
            patched.setattr("hsnoise._core.interrupting.os.unlink", lambda _: None)
            write_atomically(tmp_path / name, b"half")
        (found,) = (path for path in tmp_path.iterdir() if name in path.name)
        return found

    old, young = remains("model.json"), remains("table.csv")
    theirs = [
        tmp_path / name for name in (".notes.tmp", ".model.json.tmp", "model.json.tmp", ".x.0123456789abcdef.tmp")
    ]
    for path in theirs:
        path.write_bytes(b"theirs")
    for path in (old, *theirs):
        os.utime(path, (0, time.time() - 2 * OLD_S))
    sweep(tmp_path)
    assert set(tmp_path.iterdir()) == {young, *theirs}


def test_a_command_sweeps_where_it_writes(tmp_path):
    remains = tmp_path / f".model.json.{'0123456789abcdef' * 2}.tmp"
    remains.write_bytes(b"half")
    os.utime(remains, (0, time.time() - 2 * OLD_S))
    arguments = ["--frames", "2", "--shape", "16x16", "--out", str(tmp_path / "frames.npz")]
    assert main(["sample", "grasshopper3", *arguments]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["frames.npz"]
