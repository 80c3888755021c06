"""What the command line takes, and how it refuses the rest: in one line that names what may have been meant."""

from __future__ import annotations

import pytest

from hsnoise._core.parsing import seconds
from hsnoise.cli.main import main
from hsnoise.cli.options import parser


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.5", 0.5),
        ("0.5s", 0.5),
        ("1/30", 1 / 30),
        ("1/30s", 1 / 30),
        ("1/30 s", 1 / 30),
        ("20ms", 0.02),
        ("25us", 25e-6),
        ("25\u00b5s", 25e-6),
        ("25\u03bcs", 25e-6),
        ("1e-3", 1e-3),
        ("1E-3s", 1e-3),
        (".5", 0.5),
        ("2.", 2.0),
        ("0", 0.0),
    ],
)
def test_seconds(text, value):
    assert seconds(text) == pytest.approx(value, rel=1e-12)


def test_lists_of_seconds_are_taken_wherever_seconds_are():
    arguments = ["fit", "x", "--exposure", "1/30,20ms,0.5s", "--flats-exposure", "25us"]
    args = parser().parse_args(arguments)
    assert args.exposure == pytest.approx([1 / 30, 0.02, 0.5]) and args.flats_exposure == pytest.approx([25e-6])
    assert parser().parse_args(["sample", "x", "--out", "y", "--exposure", "1/4"]).exposure == [0.25]
    assert parser().parse_args(["train", "--exposure", "40ms"]).exposure == pytest.approx(0.04)


def refusal(arguments, capsys) -> str:
    """What is said of arguments, which is one line."""
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    shown = capsys.readouterr()
    assert stopped.value.code == 2 and not shown.out
    assert shown.err.startswith("hsnoise: ") and shown.err.count("\n") == 1
    return shown.err


@pytest.mark.parametrize("text", ["0/0", "1/0", "-1", "nan", "inf", "fast", "", "1,", "1//2", "1/2/3", "5min", "1e999"])
@pytest.mark.parametrize("option", ["--exposure", "--flats-exposure"])
def test_what_is_no_exposure_is_refused(option, text, capsys):
    said = refusal(["fit", "x", f"{option}={text}"], capsys)
    assert said.startswith(f"hsnoise: {option}: expected seconds, such as 0.5, 1/30, 20ms or 25us, got ")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["fit", "x", "--exposur", "1"], "unknown option --exposur; did you mean --exposure?"),
        (["fit", "x", "--exposur=1"], "unknown option --exposur; did you mean --exposure?"),
        (["fit", "--blak-level", "3"], "unknown option --blak-level; did you mean --black-level?"),
        (["fit", "x", "--zzzz"], "unknown option --zzzz\n"),
        (["fit", "x", "-q"], "unknown option -q\n"),
        (["--verson"], "unknown option --verson; did you mean --version?"),
        (["train", "--step", "3"], "unknown option --step; did you mean --steps?"),  # no abbreviations
        (["fti", "x"], "unknown command fti; did you mean fit?"),
        (
            ["fit", "x", "--method", "mle"],
            "--method: expected one of auto, ml, line, transfer, got 'mle'; did you mean ml?",
        ),
        (["fit", "x", "--cfa", "RGBG"], "--cfa: expected mono or one of RGGB"),
        (["fit", "x", "--row-axis", "2"], "--row-axis: expected 0 or 1, got 2"),
        (["fit", "x", "--white-level", "max"], "--white-level: expected a number, got 'max'"),
        (["fit"], "required: PATH (hsnoise fit --help"),
        (["improve", "x", "--max-minutes", "0"], "--max-minutes: expected minutes above 0, got '0'"),
        (["improve", "x", "--max-minutes", "nan"], "--max-minutes: expected minutes above 0, got 'nan'"),
        (["improve", "x", "--max-steps", "-1"], "--max-steps: expected a whole number, 0 or more, got '-1'"),
        (["improve", "x", "--max-steps", "1.5"], "--max-steps: expected a whole number, 0 or more, got '1.5'"),
        (["enhance", "x", "y.mp4", "--look-ahead", "-1"], "--look-ahead: expected a whole number, 0 or more, got '-1'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_wrong_word_is_refused_with_the_near_one(arguments, said, capsys):
    assert said in refusal(arguments, capsys)


def test_a_value_may_look_like_an_option_of_another_command():
    args = parser().parse_args(["fit", "--out", "steps", "--", "--exposur"])
    assert args.paths == ["--exposur"]


def test_an_unknown_camera_is_refused_with_the_near_one(capsys):
    assert main(["sample", "canon5d3", "--out", "x.npz"]) == 2
    assert "there is no canon5d3; did you mean canon_5d3?" in capsys.readouterr().err
