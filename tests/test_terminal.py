"""What commands print: the light and the sentence, then what is doubtful, then a table, on one screen."""

from __future__ import annotations

import json
import re
import textwrap
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

import hsnoise
from hsnoise import plots
from hsnoise._core.conclusion import Conclusion, Light
from hsnoise._core.naming import as_options, named, setting
from hsnoise.cli import main as cli
from hsnoise.cli import results as _results
from hsnoise.cli.main import main
from hsnoise.cli.telling import Page, tell
from hsnoise.criticism import Candidate, Diagnosis, Step, Story
from hsnoise.criticism.finding import Unexplained
from hsnoise.criticism.outcomes import Ended, Ending

NOTES = tuple(f"note {i} says what the frames do not determine, at such length that it fills a line" for i in range(60))
COMMAND_LINE = Path(__file__).parents[1] / "docs" / "command-line.md"
DOUBTS = ("the first doubt is in the sentence", "another doubt is above the table")


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    """Darks of a colour camera."""
    out = tmp_path_factory.mktemp("capture") / "darks.npz"
    arguments = ["--frames", "4", "--shape", "32x64", "--exposure", "1/20,1/5,2/5", "--out", str(out)]
    assert main(["sample", "canon_5d3", *arguments]) == 0
    return out


@pytest.fixture(scope="module")
def found(capture):
    """A fit with more to say than a screen holds, and what the other commands would find, without their work."""
    stack = hsnoise.load(capture)
    fit = replace(hsnoise.fit(stack, method="line"), notes=NOTES, doubts=DOUBTS)
    effects = [hsnoise.effects.RowNoise(1.0), hsnoise.effects.ColumnNoise(1.0), hsnoise.effects.FrameOffset(1.0)]
    comparison = hsnoise.compare(fit.params.add(effects[0]), stack, draws=8)  # no likelihood is compiled with it
    ranking = tuple(Candidate(one.name, one, 90.0 - 9 * i, 1e-9, 3.0) for i, one in enumerate(effects))
    unexplained = Unexplained(9.0, "tails", ("tail of the first exposure (z = +9.0)",))
    diagnosis = Diagnosis(ranking, "named", ranking[0], ("row_noise",), "", unexplained)
    steps = [Step(fit, replace(comparison, error=40.0), diagnosis, None, -9.0, ())]
    for i, one in enumerate(effects):
        added = replace(fit, params=steps[-1].fit.params.add(one))
        steps.append(Step(added, replace(comparison, error=9.0 - i), None, one.name, -9.0, ("gain moved.",)))
    story = Story(tuple(steps), Ending(Ended.FINISHED), "All frames were fitted.")
    return {"fit": fit, "compare": comparison, "diagnose": diagnosis, "improve": story}


@pytest.fixture
def printed(found, capture, tmp_path, monkeypatch, capsys):
    """What a command prints, with options; of a fit's figures there is one, and it is empty."""
    monkeypatch.setattr(plots, "of_fit", lambda _: {"histograms": Figure()})
    monkeypatch.setattr(cli, "fit_with_progress", lambda *_: found["fit"])
    monkeypatch.setattr(hsnoise, "compare", lambda *_, **__: found["compare"])
    monkeypatch.setattr(hsnoise, "diagnose", lambda *_, **__: found["diagnose"])
    monkeypatch.setattr(_results, "improved", lambda *_, **__: found["improve"])

    def run(command: str, *options: str) -> str:
        judged = command in ("fit", "improve") and found[command].conclusion.light == Light.RED
        more = [] if command == "inspect" else ["--out", str(tmp_path / command)]
        more += ["--model", "canon_5d3"] if command == "compare" else []
        assert main([command, str(capture), *more, *options, "--debug"]) == int(judged)
        return capsys.readouterr().out

    return run


def lines_of_screen(text: str, columns: int = 100) -> int:
    return sum(max(1, len(textwrap.wrap(line, columns))) for line in text.splitlines())


HEADINGS = {
    "fit": "parameter",
    "compare": "group of statistics",
    "diagnose": "effect",
    "improve": "step",
    "inspect": "kind",
}


@pytest.mark.parametrize("command", HEADINGS)
def test_a_command_tells_the_light_then_the_table_on_one_screen(command, printed, found):
    said, everything = printed(command), printed(command, "--verbose")
    lines = said.splitlines()
    assert re.match(r"\[(green|amber|red)\] \w+", lines[0])
    if command in found:
        assert lines[0] == str(found[command].conclusion)
    table = next(i for i, line in enumerate(lines) if line.strip().startswith(HEADINGS[command]))
    assert 0 < table < 20 and not any(line.startswith("! ") for line in lines[table:])
    assert lines_of_screen(said) <= 40
    (left_out,) = [int(line.split()[0]) for line in lines if line.endswith(": --verbose")]
    assert left_out == lines_of_screen(everything) - lines_of_screen(said) + 1
    assert "--verbose" not in everything and everything.splitlines()[: table + 1] == lines[: table + 1]


def test_doubts_stay_above_the_table_and_are_said_once(printed):
    for command in ("fit", "improve"):
        lines = printed(command).splitlines()
        assert DOUBTS[0] in lines[0] and f"! {DOUBTS[1]}" in lines
        assert "\n".join(lines).count(DOUBTS[0]) == 1


def test_verbose_tells_all(printed, found):
    fit, story, compared = printed("fit", "--verbose"), printed("improve", "--verbose"), printed("compare", "--verbose")
    assert all(note in fit for note in NOTES) and "One electron adds `gain` DN" in fit and "4 frames" in fit
    assert all(detail in story for detail in found["improve"].details) and "gain moved." in story
    assert found["compare"].measure in compared
    assert "still off with row_noise" in printed("diagnose", "--verbose")
    assert "Noise budget" in printed("inspect", "--verbose") and "Noise budget" not in printed("inspect")


def test_files_are_there_before_anything_is_said(printed, tmp_path, monkeypatch):
    there = {}
    for command in ("fit", "compare", "diagnose", "improve"):
        page = str(tmp_path / f"{command}.html")
        options = [] if command == "fit" else ["--report", page]
        monkeypatch.setattr(cli.report, "write_report", lambda path, *_, **__: Path(path).write_text("page"))
        monkeypatch.setattr(
            cli, "tell", lambda *_, to=command: there.update({to: {one.name for one in tmp_path.rglob("*.*")}})
        )
        printed(command, *options)
    assert {"model.json", "table.csv", "histograms.png"} <= there["fit"]
    assert {"comparison.png", "residuals.png", "compare.html"} <= there["compare"]
    assert {"ranking.png", "diagnose.html"} <= there["diagnose"]
    assert {"model.json", "story.txt", "story.png", "residuals.png", "improve.html"} <= there["improve"]


@pytest.mark.parametrize(("light", "colour"), [(Light.GREEN, 32), (Light.AMBER, 33), (Light.RED, 31)])
def test_the_terminal_has_a_disc_in_the_colour(light, colour, monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("LINES", "24")
    tell(Page(Conclusion(light, "It fits."), notes=NOTES), ["Written"])
    lines = re.sub(r"\x1b\[[\d;]*m", "", said := capsys.readouterr().out).splitlines()
    assert lines[0] == "● It fits." and f"{colour}m● " in said
    assert len(lines) <= 23 and max(map(len, lines)) <= 60 and lines[-1] == "Written"
    monkeypatch.setenv("NO_COLOR", "1")
    tell(Page(Conclusion(light, "It fits.")))
    assert capsys.readouterr().out.splitlines()[0] == f"[{light}] It fits."


def test_sentences_are_whole_where_no_terminal_is(capsys):
    sentence = "word " * 60
    tell(Page(Conclusion(Light.RED, sentence), doubts=(sentence,), notes=(sentence,)))
    assert [line.split(" ", 1)[1].count("word") for line in capsys.readouterr().out.splitlines()] == [60, 60, 59]


def test_a_sentence_longer_than_the_screen_is_told(capsys):
    tell(Page(Conclusion(Light.RED, "word " * 1000), notes=("left out",)))
    said = capsys.readouterr().out
    assert said.count("word") == 1000 and "1 more line: --verbose" in said


def test_sentences_name_options_on_the_command_line():
    def said():
        return f"{named('cfa')}: give {setting('black_level', 512)}, {setting('cfa', 'RGGB')} or {setting('kind')}"

    with as_options(cli.OPTIONS):
        assert said() == "--cfa: give --black-level 512, --cfa 'RGGB' or --kind"
        with as_options({"cfa": "--colours"}):
            assert said() == "--colours: give --black-level 512, --colours 'RGGB' or --kind"
    assert said() == "cfa: give black_level=512, cfa='RGGB' or kind="


@pytest.mark.parametrize("suffix", [".npz", ".npy", ".tif", ".fits"])
@pytest.mark.parametrize("frames", [1, 3])
@pytest.mark.parametrize("clean", [False, True], ids=["dark", "clean"])
def test_sample_says_what_it_wrote_and_python_that_reads_it(suffix, frames, clean, tmp_path, capsys):
    out = tmp_path / f"it's night{suffix}"
    np.save(tmp_path / "clean.npy", np.full((16, 24), 300.0))
    more = ["--clean", str(tmp_path / "clean.npy")] if clean else ["--shape", "16x24"]
    assert main(["sample", "grasshopper3", "--frames", str(frames), "--exposure", "1/8", "--out", str(out), *more]) == 0
    said = capsys.readouterr().out
    kind = "flat" if clean else "dark"
    assert f"{frames} {kind} frame{'s' if frames > 1 else ''} of 16 x 24 pixels, exposed 0.125 s" in said
    assert "counts in DN, " in said and "uint16" in said and f"1 x {frames} x 16 x 24" in said
    assert ('kind "flat"' in said) is clean
    read: dict = {}
    exec(said.splitlines()[-1].removeprefix("In Python: "), read)
    if "stack" not in read:
        assert read["counts"].size == frames * 16 * 24
        return
    stack = read["stack"]
    assert (stack.kind, stack.n_frames, stack.shape, stack.cfa) == ((kind,), (frames,), (16, 24), "RGGB")
    assert (stack.shutter, float(np.max(stack.black_level)), stack.exposure_s[0]) == ("global", 0.0, 0.125)


def names_in_docs(command: str) -> set[str]:
    """The names that docs/command-line.md gives to what --json prints for a command."""
    rows = [line.split("|") for line in COMMAND_LINE.read_text().splitlines() if line.startswith("| ")]
    return {name for row in rows if row[1].strip() in ("all", command) for name in re.findall(r"`(\w+)`", row[2])}


@pytest.mark.parametrize("command", HEADINGS)
def test_json_is_alone_on_standard_output_and_as_documented(command, printed, found):
    said = printed(command, "--json")
    content = json.loads(said, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert said.count("\n") == 1 and set(content) == names_in_docs(command)
    assert content["command"] == command and content["light"] in set(Light)
    assert all(Path(one).is_file() for one in content["files"]) and bool(content["files"]) is (command != "inspect")
    if command in found:
        assert content["conclusion"] == found[command].conclusion.sentence


def test_json_says_what_is_held_and_what_is_not_known(printed, found):
    parameters = json.loads(printed("fit", "--json"))["parameters"]
    for name, (value, error, unit) in found["fit"].table.items():
        one = parameters[name]
        assert one["unit"] == unit and (one["value"] == value if np.isfinite(value) else one["value"] is None)
        known = "held" if error == 0 else "fitted"
        assert one["state"] == (known if np.isfinite(value) and np.isfinite(error) else "not determined")
    assert {one["state"] for one in parameters.values()} > {"fitted"}
    assert json.loads(printed("improve", "--json"))["steps"][1]["added"] == "row_noise"


@pytest.mark.parametrize("grave", [False, True])
def test_results_that_should_not_be_used_have_an_exit_status_of_their_own(grave, printed, found, monkeypatch):
    story, fit = found["improve"], replace(found["fit"], grave=grave)
    judged = {
        "fit": fit,
        "improve": replace(
            story, steps=(*story.steps[:-1], replace(story.steps[-1], fit=replace(story.fit, grave=grave)))
        ),
    }
    for command in judged:
        monkeypatch.setitem(found, command, judged[command])
        assert json.loads(printed(command, "--json"))["light"] == ("red" if grave else "amber")


def test_bad_input_says_nothing_on_standard_output(tmp_path, capsys):
    assert main(["fit", str(tmp_path / "none.npz"), "--json"]) == 2
    said = capsys.readouterr()
    assert said.out == "" and "none.npz" in said.err


@pytest.mark.parametrize("doubts", [(), DOUBTS])
def test_a_red_story_does_not_call_its_last_fit_usable(doubts, found):
    story, fit = found["improve"], replace(found["fit"], doubts=doubts, grave=False)
    far = replace(story.steps[-1], fit=fit, comparison=replace(story.steps[-1].comparison, error=40.0))
    said = replace(story, steps=(*story.steps[:-1], far)).conclusion
    assert said.light == Light.RED and fit.conclusion.light != Light.RED
    assert fit.conclusion.head not in said.sentence and (fit.conclusion.rest in said.sentence) is bool(doubts)


def test_a_closed_model_of_a_red_fit_says_what_may_be_used(found):
    story, fit = found["improve"], replace(found["fit"], doubts=DOUBTS, grave=True)
    closed = SimpleNamespace(comparison=story.steps[-1].comparison, largest_unexplained=None, summary="Closed.")
    said = replace(story, steps=(*story.steps[:-1], replace(story.steps[-1], fit=fit)), closed=closed).conclusion
    assert fit.conclusion.light == Light.RED and said.light == Light.AMBER
    assert "Do not use its numbers: " in said.rest and fit.conclusion.head not in said.sentence


@pytest.mark.parametrize(
    ("ending", "options"), [(Ending(Ended.MINUTES, 2.0), ""), (Ending(Ended.STEPS, 3), " --max-steps 11")]
)
def test_a_story_that_was_stopped_says_how_to_go_on(ending, options, printed, found, monkeypatch):
    assert "To go on" not in printed("improve")
    monkeypatch.setitem(found, "improve", replace(found["improve"], ending=ending))
    last_line = printed("improve").splitlines()[-1]
    assert last_line.startswith("To go on: hsnoise improve ") and last_line.endswith(f"/improve{options} --resume")
    assert printed("improve", "--close").splitlines()[-1].endswith(f"/improve{options} --close --resume")
    minutes = " --max-minutes 4" if ending.why == Ended.MINUTES else " --max-minutes 2"  # a search begins anew
    assert minutes in printed("improve", "--max-minutes", "2").splitlines()[-1]
