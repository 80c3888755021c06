"""The command line, run in process on tiny captures."""

from __future__ import annotations

import csv
import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hsnoise
from hsnoise._core import output as _output
from hsnoise.cli import demo as _demo
from hsnoise.cli import options as _options
from hsnoise.cli import results as _results
from hsnoise.cli.loading import load_capture
from hsnoise.cli.main import main
from hsnoise.criticism import Comparison, Step, Story
from hsnoise.criticism.outcomes import Ended, Ending

COMMANDS = ("demo", "fit", "compare", "diagnose", "improve", "sample", "train", "evaluate")


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    """Darks of a mono camera with a global shutter, 2 exposures x 3 frames x 32 x 64."""
    folder = tmp_path_factory.mktemp("capture")
    camera = hsnoise.cameras.grasshopper3(black_level_dn=64.0)
    model = hsnoise.NoiseModel(
        [
            *(e for e in camera if e.name not in ("gain", "row_gain", "black_level")),
            hsnoise.effects.RowGain(0.1, 0.0),
            hsnoise.effects.Gain(3.0),
            hsnoise.effects.BlackLevel(64.0),
        ],
        cfa="mono",
        shutter="global",
        exposure_s=0.1,
    )
    model.save(folder / "true.json")
    arguments = ["--frames", "3", "--shape", "32x64", "--exposure", "0.1,0.4"]
    assert main(["sample", str(folder / "true.json"), "--out", str(folder / "darks.npz"), *arguments]) == 0
    return folder


@pytest.fixture(scope="module")
def fitted(capture) -> Path:
    out = capture / "result"
    assert main(["fit", str(capture / "darks.npz"), "--out", str(out), "--shutter", "global", "--debug"]) == 0
    return out


@pytest.mark.slow
def test_compare_prints_where_a_model_fails_and_draws_it(capture, fitted, tmp_path, capsys):
    arguments = [str(capture / "darks.npz"), "--shutter", "global", "--out", str(tmp_path / "loop")]
    assert main(["compare", *arguments, "--model", str(fitted / "model.json"), "--debug"]) == 0
    assert "as close as its own samples" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "loop").iterdir()} == {"comparison.png", "residuals.png"}
    assert main(["compare", *arguments, "--model", "canon_5d3"]) == 2
    assert "--model: made for RGGB" in capsys.readouterr().err


@pytest.mark.slow
def test_fit_fits_the_effects_of_a_model(capture, tmp_path, capsys):
    bare = hsnoise.NoiseModel.load(capture / "true.json").remove("row_gain")
    bare.save(tmp_path / "bare.json")
    arguments = [str(capture / "darks.npz"), "--shutter", "global", "--out", str(tmp_path / "fit")]
    # Without its row gain the model does not describe these frames.
    assert main(["fit", *arguments, "--model", str(tmp_path / "bare.json"), "--debug"]) == 1
    said = capsys.readouterr().out
    assert "Joint maximum likelihood: converged" in said and "row_gain.exponent" not in said
    assert hsnoise.NoiseModel.load(tmp_path / "fit" / "model.json").names == bare.names
    assert main(["fit", *arguments, "--model", "canon_5d3"]) == 2
    assert "--model: made for RGGB" in capsys.readouterr().err


def test_fit_writes_a_model_a_table_and_figures(fitted):
    assert sorted(path.name for path in fitted.iterdir()) == [
        "histograms.png",
        "model.json",
        "photon_transfer.png",
        "row_spectrum.png",
        "table.csv",
    ]
    model = hsnoise.NoiseModel.load(fitted / "model.json")
    rows = list(csv.DictReader((fitted / "table.csv").read_text().splitlines()))
    assert {row["parameter"]: float(row["value"]) for row in rows} == pytest.approx(
        {name: value for name, (value, _, _) in model.table.items()}, rel=1e-12
    )
    truth = hsnoise.NoiseModel.load(fitted.parent / "true.json").table
    for row in rows:
        error = float(row["standard_error"])
        if 0 < error < np.inf:
            assert abs(float(row["value"]) - truth[row["parameter"]][0]) < 5 * error
    provenance = json.loads((fitted / "model.json").read_text())["provenance"]
    assert provenance["method"] == "ml"
    assert provenance["files"] == [str(fitted.parent / "darks.npz")]


def test_fitted_model_can_be_sampled(fitted, tmp_path, capsys):
    out = tmp_path / "frames.npz"
    assert main(["sample", str(fitted / "model.json"), "--out", str(out), "--frames", "2", "--shape", "16x32"]) == 0
    assert "2 dark frames of 16 x 32 pixels" in capsys.readouterr().out
    stack = hsnoise.load(out)
    assert (stack.n_frames, stack.shape, stack.shutter, stack.black_level) == ((2,), (16, 32), "global", 64.0)


@pytest.fixture
def short_loop(monkeypatch):
    """The loop without its draws: the first fit, and an addition made up."""

    def improve(stack, tell, *, keep, **_):
        fit, groups = hsnoise.fit(stack, method="line"), {"noise": 1.0}
        errors = [Comparison(error, groups, (), (), 0.5, -3.0, ()) for error in (40.0, 1.2)]
        added = replace(fit, params=fit.params.add(hsnoise.effects.RowNoise(1.0)))
        steps = [Step(fit, errors[0], None, None, -9.0, ()), Step(added, errors[1], None, "row_noise", -9.0, ())]
        keep(Story((steps[0],), Ending(Ended.UNFINISHED)))
        return Story(tuple(steps), Ending(Ended.FINISHED))

    monkeypatch.setattr(_results, "improved", improve)


def test_demo_shows_the_truth_beside_the_fit(tmp_path, monkeypatch, capsys, short_loop):
    monkeypatch.setattr(_demo, "FRAMES", 2)
    monkeypatch.setattr(_demo, "SHAPE", (32, 64))
    monkeypatch.setattr(_demo, "EXPOSURES_S", (0.1, 0.4))
    pages = []  # tests/test_report.py writes them
    monkeypatch.setattr("hsnoise.report.write_report", lambda path, *_, **__: pages.append(path))
    out = tmp_path / "demo"
    assert main(["demo", "--out", str(out), "--debug"]) == 0
    assert set(pages) == {out / "report.html"}
    said = capsys.readouterr().out
    lines = {line.split()[0]: line.split() for line in said.splitlines() if line.split()}
    assert lines["gain.R"][3] == "DN/e-"
    assert float(lines["gain.R"][4]) == pytest.approx(1.53, abs=0.05)
    assert lines["black_level.R"][2] == "held"
    assert {path.name for path in out.iterdir()} >= {"capture.npz", "model.json", "table.csv", "story.png"}
    assert "truth" in said and "The hidden effect was row_noise" in said
    assert said.splitlines()[-1] == "Added: row_noise. Error before 40.0, after 1.2."


def test_improve_that_is_broken_off_at_once_says_what_there_is(capture, tmp_path, monkeypatch, capsys):
    def broken_off(*arguments, **keywords):
        raise KeyboardInterrupt

    monkeypatch.setattr(_results, "improved", broken_off)
    arguments = ["improve", str(capture / "darks.npz"), "--shutter", "global", "--out", str(tmp_path)]
    assert main(arguments) == 130
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == "hsnoise: interrupted; no model was kept yet, from which --resume could go on"
    (tmp_path / "story.json").write_text("of an earlier run")
    assert main([*arguments, "--resume"]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "hsnoise: interrupted"


def test_improve_that_is_broken_off_leaves_its_last_model(capture, tmp_path, monkeypatch, short_loop, capsys):
    whole = _results.improved

    def broken_off(*arguments, **keywords):
        whole(*arguments, **keywords)
        raise KeyboardInterrupt

    monkeypatch.setattr(_results, "improved", broken_off)
    arguments = ["improve", str(capture / "darks.npz"), "--shutter", "global", "--out", str(tmp_path)]
    assert main(arguments) == 130
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == f"hsnoise: interrupted; the model so far is in {tmp_path / 'model.json'}"
    assert "Not finished" in (tmp_path / "story.txt").read_text()
    assert "read_noise" in hsnoise.NoiseModel.load(tmp_path / "model.json")


@pytest.mark.slow
def test_demo_takes_data(capture, tmp_path, capsys, short_loop):
    arguments = ["--data", str(capture / "darks.npz"), "--shutter", "global", "--out", str(tmp_path / "out")]
    assert main(["demo", *arguments]) == 0
    said = "".join(capsys.readouterr())
    assert "truth" not in said and "6 frames of 32 rows x 64 columns" in said
    assert not (tmp_path / "out" / "capture.npz").exists()


@pytest.mark.parametrize("suffix", [".npz", ".npy", ".tif", ".fits"])
def test_every_format_reads_back(suffix, tmp_path):
    out, again = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    arguments = ["sample", "canon_5d3", "--frames", "3", "--shape", "16x24", "--exposure", "0.125", "--seed", "4"]
    assert main([*arguments, "--out", str(out)]) == main([*arguments, "--out", str(again)]) == 0
    given = {} if suffix != ".npy" else {"exposure_s": 0.125}
    stack = hsnoise.load(out, cfa=None if suffix in (".npz", ".fits") else "RGGB", **given)
    assert (stack.n_frames, stack.shape, stack.cfa, stack.exposure_s[0]) == ((3,), (16, 24), "RGGB", 0.125)
    frames = np.stack(list(stack.frames(0)))
    np.testing.assert_array_equal(frames, np.stack(list(hsnoise.load(again, cfa="RGGB", **given).frames(0))))
    assert not np.array_equal(frames[0], frames[1])


def test_frames_of_one_exposure_follow_each_other(tmp_path):
    model, out = tmp_path / "model.json", tmp_path / "darks.npz"
    hsnoise.cameras.grasshopper3().add(hsnoise.effects.DarkCurrentDrift(200.0)).save(model)
    arguments = ["--frames", "4", "--shape", "64x64", "--exposure", "0.1", "--out", str(out)]
    assert main(["sample", str(model), *arguments]) == 0
    means = [frame.mean() for frame in hsnoise.load(out).frames(0)]
    assert all(later > earlier + 10 for earlier, later in zip(means, means[1:], strict=False))


@pytest.mark.parametrize("colour", [False, True], ids=["mosaic", "R, G, B"])
def test_clean_image_is_scaled_and_keeps_its_colours(colour, tmp_path):
    rows, columns = 32, 48
    image = np.full((rows, columns), 7.0)
    if colour:
        image = np.stack([np.full((rows, columns), level) for level in (100.0, 300.0, 600.0)], axis=-1)
    np.save(tmp_path / "clean.npy", image)
    out = tmp_path / "noisy.npz"
    arguments = ["--clean", str(tmp_path / "clean.npy"), "--mean-e", "1000", "--frames", "20", "--out", str(out)]
    assert main(["sample", "grasshopper3", *arguments]) == 0
    stack = hsnoise.load(out)
    assert stack.kind == ("flat",)
    counts = np.stack(list(stack.frames(0))).astype(float)
    gain, dark_e = np.array([3.54, 3.11, 3.95]), 118.0 * 0.03
    # RGGB: the mosaic's mean level is (100 + 2 * 300 + 600) / 4 = 325, scaled to 1000.
    light_e = np.array([100, 300, 600]) * 1000 / 325 if colour else np.full(3, 1000.0)
    measured = np.array([counts[:, r::2, c::2].mean() for r, c in ((0, 0), (0, 1), (1, 1))])
    # Row gains of 9 %, 8 % and 16 % in 20 frames x 16 rows dominate; negative means that clipping adds are nil.
    error = np.sqrt([0.0081, 0.0069, 0.026]) / np.sqrt(20 * 16)
    assert np.all(np.abs(measured / (gain * (light_e + dark_e)) - 1) < 5 * error)


@pytest.mark.parametrize("withheld", [["gain.R", "gain.G", "gain.B"], ["row_gain.sigma.R"]], ids=["gain", "row gain"])
def test_light_without_a_gain_is_named(withheld, tmp_path, capsys):
    hsnoise.cameras.grasshopper3().save(tmp_path / "model.json", provenance={"withheld": withheld})
    np.save(tmp_path / "clean.npy", np.full((16, 24), 50.0))
    out = ["--out", str(tmp_path / "noisy.npz")]
    assert main(["sample", str(tmp_path / "model.json"), "--clean", str(tmp_path / "clean.npy"), *out]) == 0
    assert ("did not determine the gain" in capsys.readouterr().err) is ("gain.R" in withheld)


def test_darks_flats_and_options_reach_the_stack(tmp_path):
    rng = np.random.default_rng(0)
    for name, level in (("darks", 100), ("flats", 900)):
        (tmp_path / name).mkdir()
        for i in range(2):
            np.save(tmp_path / name / f"{i}.npy", rng.poisson(level, (24, 32)).astype(np.uint16))
    options = ["--exposure", "1,2", "--flats-exposure", "0.5", "--cfa", "rggb", "--black-level", "60,61,62"]
    options += [
        "--white-level",
        "4095",
        "--shutter",
        "global",
        "--roi",
        "1:21,0:30",
        "--flats",
        str(tmp_path / "flats"),
    ]
    args = _options.parser().parse_args(["fit", str(tmp_path / "darks"), *options])
    stack = load_capture(args.paths, args)
    assert (stack.kind, stack.n_frames, stack.shape) == (("dark", "dark", "flat"), (1, 1, 2), (20, 30))
    assert (stack.cfa, stack.shutter, stack.white_level) == ("GBRG", "global", 4095)
    np.testing.assert_array_equal(stack.exposure_s, [1, 2, 0.5])
    np.testing.assert_array_equal(stack.black_level, [60, 61, 62])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["fit", "nowhere/"], "nowhere"),
        (["fit", "text.txt"], "unknown format"),
        (["fit", "broken.fits"], "broken.fits"),
        (["fit", "zeros.npy", "--exposure", "1"], "all zero"),
        (["fit", "frames.npy"], "exposure"),
        (["fit", "frames.npy", "--exposure", "1", "--out", "text.txt"], "is a file"),
        (["fit", "frames.npy", "--exposure", "1", "--roi", "0:900,0:8"], "roi"),
        (["sample", "text.txt", "--out", "x.npz"], "text.txt"),
        (["sample", "no_camera", "--out", "x.npz"], "no_camera"),
        (["sample", "canon_5d3", "--out", "x.jpg"], ".jpg"),
        (["sample", "canon_5d3", "--out", "nowhere/x.npz"], "nowhere"),
        (["sample", "canon_5d3", "--out", "x.fits", "--exposure", "1,2"], "one exposure"),
        (["sample", "canon_5d3", "--out", "x.npz", "--shape", "15x15"], "even"),
        (["sample", "canon_5d3", "--out", "x.npz", "--mean-e", "3"], "--clean"),
        (["sample", "canon_5d3", "--out", "x.npz", "--clean", "text.txt"], "text.txt"),
        (["sample", "canon_5d3", "--out", "x.npz", "--clean", "text.txt", "--mean-e", "0"], "--mean-e"),
        (["sample", "canon_5d3", "--out", "x.npz", "--clean", "text.txt", "--shape", "8x8"], "--shape"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_an_error_is_one_sentence_and_writes_nothing(arguments, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("text.txt").write_text("no frames")
    Path("broken.fits").write_bytes(b"SIMPLE  =")
    np.save("zeros.npy", np.zeros((2, 8, 8), np.uint16))
    np.save("frames.npy", np.random.default_rng(0).poisson(50, (2, 8, 8)).astype(np.uint16))
    before = set(tmp_path.iterdir())
    assert main(arguments) == 2
    shown = capsys.readouterr()
    assert said in shown.err and shown.err.startswith("hsnoise: ")
    assert shown.err.count("\n") == 1 and "Traceback" not in shown.err
    assert set(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    "arguments",
    [
        ["fit"],
        ["fit", "x", "--roi", "1:2"],
        ["fit", "x", "--cfa", "XYZW"],
        ["fit", "x", "--exposure", "long"],
        ["sample", "canon_5d3"],
        ["sample", "canon_5d3", "--out", "x.npz", "--frames", "0"],
        ["sample", "canon_5d3", "--out", "x.npz", "--shape", "12"],
        ["unknown"],
    ],
    ids=" ".join,
)
def test_wrong_options_exit_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("hsnoise: ") and said.count("\n") == 1


@pytest.mark.parametrize("command", COMMANDS)
def test_help(command, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([command, "--help"])
    assert stopped.value.code == 0
    assert "usage: hsnoise " + command in capsys.readouterr().out


def test_without_a_command_the_help_is_shown(capsys):
    assert main([]) == 2
    said = capsys.readouterr().out
    assert all(command in said for command in COMMANDS)


def test_debug_shows_the_traceback():
    with pytest.raises(FileNotFoundError):
        main(["fit", "nowhere/", "--debug"])


def test_a_file_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "table.csv"
    _output.write_atomically(path, b"old")

    def full(*_):
        raise OSError("disk full")

    monkeypatch.setattr(_output.os, "fsync", full)
    with pytest.raises(OSError, match="disk full"):
        _output.write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert [one.name for one in tmp_path.iterdir()] == ["table.csv"]


def test_the_installed_command_is_main():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    assert project["scripts"] == {"hsnoise": "hsnoise.cli.main:main"}
    assert project["version"] == hsnoise.__version__
