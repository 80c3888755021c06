"""What each command prints, writes and returns: docs/command-line.md has a table of it, and is held to it by row."""

from __future__ import annotations

import io
import json
import os
import re
import signal
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import hsnoise
from hsnoise.cli import demo as _demo
from hsnoise.cli import main as cli
from hsnoise.cli.main import main
from hsnoise.cli.options import parser
from hsnoise.effects import BlackLevel, Gain, RowGain
from hsnoise.enhance.training import train
from hsnoise.enhance.training.presets import Preset, Recipe

PAGE = Path(__file__).parents[1] / "docs" / "command-line.md"
HEADING = "| command | standard output |"
QUICK = ("inspect", "sample")
ENDED, UNUSABLE, BAD_INPUT, INTERRUPTED, READER_GONE = 0, 1, 2, 130, 141

pytestmark = pytest.mark.skipif(os.name == "nt", reason="no /dev/full")


class Row(NamedTuple):
    """A row of the table: a command, whether it has --json, the files that it writes, whether it may return 1."""

    command: str
    json: bool
    files: tuple[str, ...]
    judges: bool


def rows() -> list[Row]:
    """The table of the page."""
    lines = PAGE.read_text().splitlines()
    found = []
    for line in lines[lines.index(next(one for one in lines if one.startswith(HEADING))) + 2 :]:
        if not line.startswith("|"):
            break
        command, _, as_json, files, judges = (cell.strip() for cell in line.strip("|").split("|"))
        found.append(
            Row(command.strip("`"), as_json == "yes", tuple(re.findall(r"`(\w+\.\w+)`", files)), judges != "never")
        )
    return found


def of_each(quick: tuple[str, ...]):
    return pytest.mark.parametrize(
        "row",
        [pytest.param(row, id=row.command, marks=() if row.command in quick else pytest.mark.slow) for row in rows()],
    )


EACH, EACH_IN_WORK = of_each(tuple(row.command for row in rows())), of_each(QUICK)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    """A folder with darks, clips, and frames of light."""
    folder = tmp_path_factory.mktemp("inputs")
    rng = np.random.default_rng(0)
    counts = np.rint(100 + 1.5 * (rng.poisson(30, (2, 4, 48, 64)) + rng.normal(0, 3, (2, 4, 48, 64))))
    darks = {"cfa": "mono", "shutter": "global", "black_level": 100, "exposure_s": (0.1, 0.4)}
    counts[1] += np.rint(1.5 * rng.poisson(90, counts[1].shape))
    np.savez(folder / "darks.npz", counts=counts.astype(np.uint16), **darks)
    np.savez(folder / "single.npz", counts=counts[:, :1].astype(np.uint16), **darks)
    counts[:] += np.rint(40 * rng.standard_normal((2, 4, 48, 1)))
    np.savez(folder / "noisy_rows.npz", counts=np.clip(counts, 0, None).astype(np.uint16), **darks)
    (folder / "clips").mkdir()
    for name in "abcde":
        np.savez(folder / "clips" / f"{name}.npz", frames=rng.integers(0, 256, (4, 12, 14, 3), dtype=np.uint8))
    return folder


@pytest.fixture
def small(monkeypatch):
    """Long work in little."""
    monkeypatch.setitem(train.PRESETS, "smoke", Preset(2, 2, 3, 8, 2, Recipe(maps=2, kernels=(3,))))
    for name, value in {"FRAMES": 2, "SHAPE": (32, 64), "EXPOSURES_S": (0.1, 0.4)}.items():
        monkeypatch.setattr(_demo, name, value)


def words(command: str, inputs: Path, out: Path) -> list[str]:
    """A command line that ends well, with results in `out`."""
    darks, clips, to = str(inputs / "darks.npz"), ["--clips", str(inputs / "clips")], ["--out", str(out)]
    return {
        "inspect": ["inspect", darks],
        "fit": ["fit", darks, *to],
        "compare": ["compare", darks, "--model", "grasshopper3", "--cfa", "RGGB", *to],
        "diagnose": ["diagnose", darks, "--model", "grasshopper3", "--cfa", "RGGB", *to],
        "improve": ["improve", darks, "--max-steps", "0", *to],
        "sample": ["sample", "grasshopper3", "--frames", "2", "--shape", "8x8", "--out", str(out / "frames.npz")],
        "enhance": ["enhance", str(inputs / "dark.mp4"), str(out / "enhanced.mp4")],
        "train": ["train", *clips, *to],
        "evaluate": ["evaluate", str(inputs / "run" / "weights.eqx"), *clips, "--crop", "8", "--no-rivals", *to],
        "demo": ["demo", "--max-steps", "0", *to],
    }[command]


@pytest.fixture
def prepared(row, inputs, small, tmp_path, capsys) -> list[str]:
    """The words of a row's command; what other commands have to make first is made."""
    if row.command == "evaluate" and not (inputs / "run").exists():
        assert main(words("train", inputs, inputs / "run")) == ENDED
    if row.command == "enhance" and not (inputs / "dark.mp4").exists():
        av = pytest.importorskip("av")
        with av.open(str(inputs / "dark.mp4"), "w") as file:
            stream = file.add_stream("libx264", rate=25, options={"qp": "0"})
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            for frame in np.random.default_rng(0).integers(0, 90, (2, 48, 64, 3)).astype(np.uint8):
                file.mux(stream.encode(av.VideoFrame.from_ndarray(frame)))
            file.mux(stream.encode())
    (tmp_path / "out").mkdir()
    capsys.readouterr()
    return words(row.command, inputs, tmp_path / "out")


def test_the_table_has_all_commands():
    commands = next(action for action in parser()._actions if action.dest == "command").choices
    assert [row.command for row in rows()] == list(commands)
    for row in rows():
        has_json = "--json" in commands[row.command]._option_string_actions
        assert row.json is has_json, row.command


@EACH
@pytest.mark.parametrize("unheard", [False, True], ids=["heard", "unheard"])
def test_bad_input_is_2_and_a_sentence_on_standard_error(row, unheard, tmp_path, monkeypatch, capsys):
    """Also if nobody can read the sentence."""
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "out"
    wrong = {
        "compare": ["compare", "none.npz", "--model", "grasshopper3"],
        "sample": ["sample", "none.json", "--out", "frames.npz"],
        "enhance": ["enhance", "none.mp4", "enhanced.mp4"],
        "train": ["train", "--clips", "none"],
        "evaluate": ["evaluate", "none.eqx"],
        "demo": ["demo", "--data", "none.npz"],
    }.get(row.command, [row.command, "none.npz"])
    with open("/dev/full", "w") as full:
        if unheard:
            monkeypatch.setattr("sys.stderr", full)
        assert main([*wrong, *["--json"] * row.json]) == BAD_INPUT
    said = capsys.readouterr()
    assert said.out == "" and not out.exists() and list(tmp_path.iterdir()) == []
    if not unheard:
        assert said.err.splitlines()[-1].startswith("hsnoise: ") and "none" in said.err and "Traceback" not in said.err


@EACH
def test_an_interrupt_is_130(row, monkeypatch, capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setitem(cli.RUN, row.command, interrupted)
    assert main(words(row.command, Path("in"), Path("out"))) == INTERRUPTED == 128 + signal.SIGINT
    assert capsys.readouterr() == ("", "hsnoise: interrupted\n")


def assert_written(row: Row, out: Path) -> None:
    there = {path.name for path in out.iterdir()}
    assert set(row.files) <= there and bool(row.files) is bool(there)
    assert not any(name.endswith(".tmp") for name in there)


@EACH_IN_WORK
def test_results_are_on_standard_output_and_words_beside(row, prepared, tmp_path, capsys):
    assert main([*prepared, *["--json"] * row.json]) in ((ENDED, UNUSABLE) if row.judges else (ENDED,))
    said = capsys.readouterr()
    assert_written(row, tmp_path / "out")
    if row.json:
        assert said.out.count("\n") == 1 and json.loads(said.out)["command"] == row.command
        assert {Path(one).name for one in json.loads(said.out)["files"]} >= set(row.files)
    else:
        assert said.out.count("\n") <= 40
        for word in ("Note:", "Simulating", "Fitting", "step 2:", "Camera"):
            assert word not in said.out


@EACH_IN_WORK
def test_a_full_disk_under_the_output_is_2_and_the_files_are_there(row, prepared, tmp_path, monkeypatch, capsys):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr("sys.stdout", full)
        assert main(prepared) == BAD_INPUT
    assert capsys.readouterr().err.splitlines()[-1] == f"hsnoise: {os.strerror(28)}"
    assert_written(row, tmp_path / "out")


@EACH_IN_WORK
def test_a_reader_that_is_gone_is_141_and_the_files_are_there(row, prepared, tmp_path, monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    with io.TextIOWrapper(open(writer, "wb")) as gone:
        monkeypatch.setattr("sys.stdout", gone)
        assert main(prepared) == READER_GONE
    assert_written(row, tmp_path / "out")


@EACH_IN_WORK
def test_words_that_cannot_be_written_change_nothing(row, prepared, tmp_path, monkeypatch, capsys):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr("sys.stderr", full)
        assert main(prepared) in ((ENDED, UNUSABLE) if row.judges else (ENDED,))
    assert capsys.readouterr().out
    assert_written(row, tmp_path / "out")


@pytest.fixture
def without_row_gain(inputs) -> Path:
    """A model that lacks the row gain of row_gains.npz."""
    camera = hsnoise.cameras.grasshopper3(black_level_dn=64.0)
    kept = [one for one in camera if one.name not in ("gain", "row_gain", "black_level")]
    known = {"cfa": "mono", "shutter": "global", "exposure_s": 0.1}
    bare = hsnoise.NoiseModel([*kept, Gain(3.0), BlackLevel(64.0)], **known)
    drawn = hsnoise.NoiseModel([*kept, RowGain(0.1, 0.0), Gain(3.0), BlackLevel(64.0)], **known)
    bare.save(inputs / "bare.json")
    drawn.save(inputs / "drawn.json")
    arguments = ["--frames", "3", "--shape", "32x64", "--exposure", "0.1,0.4", "--out", str(inputs / "row_gains.npz")]
    assert main(["sample", str(inputs / "drawn.json"), *arguments]) == ENDED
    return inputs / "bare.json"


@pytest.mark.parametrize(
    "row",
    [
        pytest.param(row, id=row.command, marks=() if row.command in QUICK else pytest.mark.slow)
        for row in rows()
        if row.judges
    ],
)
def test_1_is_a_red_light(row, inputs, without_row_gain, tmp_path, capsys):
    """Single frames tell nothing of noise; others are fitted with a model that does not describe them."""
    capsys.readouterr()
    out = ["--out", str(tmp_path / "out")]
    given = {
        "inspect": ["inspect", str(inputs / "single.npz")],
        "fit": ["fit", str(inputs / "row_gains.npz"), "--model", str(without_row_gain), *out],
        "improve": ["improve", str(inputs / "noisy_rows.npz"), "--max-steps", "0", *out],
    }[row.command]
    assert main([*given, "--json"]) == UNUSABLE
    assert json.loads(capsys.readouterr().out)["light"] == "red"
