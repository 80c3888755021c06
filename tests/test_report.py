"""The report is one page that stands alone, says what was found, and can be read on a phone and in the dark."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise import plots, report
from hsnoise.cli import demo as _demo
from hsnoise.cli import results as _results
from hsnoise.cli.main import main
from hsnoise.criticism import Candidate, Comparison, Diagnosis, Step, Story
from hsnoise.criticism.finding import Unexplained
from hsnoise.criticism.outcomes import Ended, Ending
from hsnoise.fitting.result import FitResult, Method, Status
from hsnoise.plots._groups import family_of, parts_of
from hsnoise.report import _context, _figures, _measured, _pictures
from hsnoise.simulation.draws import draw_capture

MODEL = hsnoise.cameras.grasshopper3(black_level_dn=64)
PLAIN = MODEL.remove("row_gain")  # its likelihood takes less time
MONO = hsnoise.NoiseModel(
    [
        fx.ReadNoise(3.0),
        fx.Gain(2.0),
        fx.BlackLevel(64.0),
        fx.ADC(),
    ],
    cfa="mono",
    shutter="global",
    exposure_s=0.1,
)
NASTY = "<script>alert(1)</script>&.npz"


def capture(model=MODEL, shape=(64, 64), exposure_s=(0.05, 0.2)):
    counts = np.random.default_rng(0).integers(60, 80, (len(exposure_s), 3, *shape)).astype(np.uint16)
    like = hsnoise.FrameStack(counts, exposure_s, cfa=model.cfa, shutter=model.shutter)
    return draw_capture(5, model, like)


@pytest.fixture(scope="module")
def stack():
    return capture(PLAIN.add(fx.RowNoise(4.0)), exposure_s=(0.2,))


@pytest.fixture(scope="module")
def compared(stack):
    return hsnoise.compare(PLAIN, stack, draws=8)


def diagnosis(verdict="named", names=("row_noise",), advice="", misfit=1.2):
    ranking = (
        Candidate("row_noise", fx.RowNoise(4.0), 812.3, 1e-9, 1.2),
        Candidate("<i>own</i>", fx.RowNoise(1.0), 12.0, 0.01, 30.0),
    )
    left = Unexplained(misfit, "row x frame", ("row x frame: G (z = +44.0)",))
    return Diagnosis(ranking, verdict, ranking[0] if names else None, names, advice, left)


def comparison(error=1.1, p_value=0.5, worst=()):
    groups = {"row x frame": 1.5 * error, "noise": 0.9}
    return Comparison(error, groups, (), worst, p_value, -3.0, ("Curvature needs three exposures.",))


@pytest.fixture(scope="module")
def story(stack):
    covariance = np.diag([0.01, 25.0])
    fit = FitResult(
        PLAIN,
        ("gain.R", "dark_current.rate"),
        covariance,
        Method.ML,
        Status.CONVERGED,
        "",
        9,
        0.0,
        ("A note.",),
        None,
        None,
    )
    better = replace(fit, params=PLAIN.add(fx.RowNoise(4.0)))
    before = comparison(88.1, 0.02, ("row x frame: G: measured 4, the model gives 1",))
    moved = ("gain.R moved from 3.1 to 3.5 DN/e-.",)
    steps = (
        Step(fit, before, diagnosis(), None, -100.0, ()),
        Step(better, comparison(), diagnosis("nothing missing", ()), "row_noise", -20.0, moved),
    )
    return Story(steps, Ending(Ended.FINISHED))


@pytest.fixture(scope="module")
def pages(stack, compared, story):
    return {
        "compare": report.page(compared, stack, fit=PLAIN, files=[NASTY, "b", "c", "d", "e"]),
        "diagnose": report.page(diagnosis(), stack, fit=story.fit, comparison=compared),
        "improve": report.page(story, stack),
    }


class Elements(HTMLParser):
    """Tags and attributes of a page, and its text without style sheets."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.words, self.ids = [], [], []
        self.feed(page.replace("<wbr>", ""))
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_data(self, data):
        if self.tags and self.tags[-1][0] != "style":
            self.words.append(data)


@pytest.mark.parametrize("command", ["compare", "diagnose", "improve"])
def test_a_page_stands_alone(pages, command):
    page = pages[command]
    assert len(page.encode()) < 3_000_000
    assert "http:" not in page and "https:" not in page and "@import" not in page
    elements = Elements(page)
    assert not {"script", "link", "iframe", "object", "base"} & {tag for tag, _ in elements.tags}
    sources = [attributes["src"] for _, attributes in elements.tags if "src" in attributes]
    assert len(sources) == (3 if command == "improve" else 2) and all(
        source.startswith("data:image/png;base64,") for source in sources
    )
    links = [link for _, a in elements.tags for name, link in a.items() if name.endswith("href")]
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in links)
    assert all(target.startswith("#") for target in re.findall(r"url\(([^)]*)\)", page))
    ids = [attributes["id"] for _, attributes in elements.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert dict(elements.tags[[tag for tag, _ in elements.tags].index("html")][1]) == {"lang": "en"}
    assert any(a.get("name") == "viewport" for _, a in elements.tags) and "prefers-color-scheme: dark" in page


@pytest.mark.parametrize(
    ("names", "misfit", "words"),
    [
        pytest.param(
            ("row_noise",),
            1.2,
            "No group of statistics stands out with row_noise in the model. Single statistics",
            marks=pytest.mark.slow,
        ),
        (("row_noise",), 7.2, "Still off with row_noise at the first estimate (the worst group, row x frame, by"),
        pytest.param(
            (),
            1.2,
            "No group of statistics stands out. Single statistics that are off by more than 3",
            marks=pytest.mark.slow,
        ),
        pytest.param((), 7.2, "Far off (the worst group, row x frame, by 7.2 deviations)", marks=pytest.mark.slow),
    ],
)
def test_what_is_left_is_called_so_only_if_it_stands_out(names, misfit, words, stack, compared):
    verdict = "named" if names else "unexplained"
    page = report.page(diagnosis(verdict, names, misfit=misfit), stack, fit=PLAIN, comparison=compared)
    assert words in Elements(page).text


def test_a_page_says_what_was_found(pages, compared):
    said = {command: Elements(page).text for command, page in pages.items()}
    worst = max(compared.groups, key=compared.groups.__getitem__)
    error = _context.number(compared.error)
    assert f"{worst} is worst: error {error}, 1.0 would be" in said["compare"]
    assert f"Missing: row_noise. Error {error}, 1.0 would be as close" in said["diagnose"]
    assert "Fits Added row_noise, and the error fell from 88.1 to 1.1. Nothing significant is left" in said["improve"]
    assert "gain.R moved from 3.1 to 3.5 DN/e-." in said["improve"] and "+80.0 nats" in said["improve"]
    assert "gain.R 3.54 0.10 DN/e-" in said["improve"] and "black_level.R 64 held DN" in said["improve"]
    assert "standard error unit" in said["improve"] and "standard error unit" not in said["compare"]
    assert "812.3" in said["diagnose"] and "Curvature needs three exposures." in said["improve"]
    assert "b, c, and 2 more" in said["compare"]
    for group in compared.groups:
        assert group in said["compare"]


def test_text_of_users_is_escaped(pages):
    assert NASTY not in pages["compare"] and NASTY in Elements(pages["compare"]).text
    assert "<i>own" not in pages["diagnose"] and "<i>own</i>" in Elements(pages["diagnose"]).text


@pytest.mark.parametrize(
    ("found", "said", "light"),
    [
        (comparison(), "The model describes these frames: error 1.1", "green"),
        (comparison(5.0, 0.11), "The model comes close to these frames, but does not fit; row x frame is", "amber"),
        (
            comparison(50.0, 0.11),
            "The model does not describe these frames; row x frame is worst: error 50",
            "red",
        ),
        (diagnosis("nothing missing", ()), "Nothing significant is missing.", "green"),
        (diagnosis("ambiguous", ("a", "b")), "Missing: a or b.", "amber"),
        (diagnosis("unexplained", ()), "Something is left that no effect of the library explains.", "red"),
    ],
    ids=["good", "close, few draws", "bad", "nothing", "ambiguous", "unexplained"],
)
def test_conclusions(found, said, light):
    shown = _context.conclusion(found, found if isinstance(found, Comparison) else None)
    assert shown.sentence.startswith(said) and shown.light == light


def test_a_model_of_another_capture_is_no_good_news():
    """Base parameters that are off are projected out by a diagnosis; the error of the comparison tells."""
    shown = _context.conclusion(diagnosis("nothing missing", ()), comparison(300.0))
    assert "does not fit" in shown.sentence and shown.light == "red"


def test_bars_are_ordered_and_share_a_scale():
    bars = _context.bars(comparison(40.0))
    positions = [float(one["width"].rstrip("%")) for one in bars["groups"]]
    assert [one["name"] for one in bars["groups"]] == ["row x frame", "noise"]
    assert 100 > positions[0] > float(bars["own"].rstrip("%")) > float(bars["one"].rstrip("%")) > positions[1] > 0
    assert [one["alarm"] for one in bars["groups"]] == [True, False]


@pytest.mark.parametrize("axis", [0, 1], ids=["rows", "columns"])
@pytest.mark.parametrize("channel", ["R", "G", "B"])
def test_spectrum_of_white_lines_is_their_variance(channel, axis, rng):
    lines = rng.normal(0, 3.0, (200, 64))
    frames = lines[:, :, None] * np.ones(32) if axis == 0 else lines[:, None, :] * np.ones((32, 1))
    k, power = _measured.line_spectrum(frames, "GRBG", channel, axis)
    assert 0 < k[0] <= k[-1] <= (32 if channel == "G" else 16)
    np.testing.assert_allclose(power, 9.0, rtol=0.35)


def test_histogram_holds_every_pixel(stack):
    at = _measured.shown(stack, PLAIN, 0)
    at.measured[0, 0, 0] = 60000  # a hot pixel does not stretch the bins
    for channel in at.channels:
        edges = _measured.histogram_edges(at, channel)
        share = _measured.share(at.measured, at.cfa, channel, edges)
        assert len(share) <= _measured.MOST_BINS + 1
        assert (share * np.diff(edges)).sum() == pytest.approx(1.0)


@pytest.mark.parametrize("errors", [(1.0,), (1e5,), (88.1, 1.1), (1e5, 9e3, 1e3, 400, 90, 30, 9, 2, 1.0)])
def test_bars_of_a_story_are_as_long_as_its_errors(story, errors):
    steps = [replace(story.steps[i > 0], comparison=comparison(error)) for i, error in enumerate(errors)]
    told = replace(story, steps=tuple(steps))
    bars = _context.stacked(told)
    lengths = [sum(float(part["width"].rstrip("%")) for part in one["parts"]) for one in bars["steps"]]
    decade = float(bars["decade"].rstrip("%"))
    # One of the two groups of `comparison` is as far off as its error, the other one is not.
    np.testing.assert_allclose(lengths, decade * np.log10(errors), atol=2e-3)
    assert max(lengths) <= 100.1 and [one["error"] for one in bars["steps"]] == [_context.number(e) for e in errors]
    axes = plots.story(told).axes[0]
    assert [text.get_text() for text in axes.get_yticklabels()] == [one["name"] for one in bars["steps"]]
    drawn = sum(bar.get_width() for bar in axes.patches)
    assert drawn == pytest.approx(np.log10(errors).sum(), abs=1e-9) and len(axes.texts) >= len(errors)
    assert drawn == 0 or axes.get_xlim()[1] > max(np.log10(errors))


def test_parts_of_a_bar_are_the_groups_that_are_off_each_in_the_colour_of_its_component():
    groups = {"static rows": 8.0, "noise": 40.0, "flats, noise": 80.0, "tails": 1.0, "something new": 6.0}
    parts = parts_of(Comparison(20.0, groups, (), (), 0.5, -3.0, ()))  # the model's own samples: 80 / 20
    assert [part.group for part in parts] == ["flats, noise", "noise", "static rows", "something new"]
    assert [part.family for part in parts] == ["temporal", "temporal", "row", "other"]
    np.testing.assert_allclose([part.decades for part in parts], np.log10([20, 10, 2, 1.5]))


def test_every_group_of_statistics_has_a_colour(compared):
    assert {group for group in compared.groups if family_of(group) == "other"} <= {"codes"}


def test_pictures_share_a_stretch_and_their_curves_a_scale():
    row, column = np.indices((64, 96))
    flat = 100.0 + 50 * ((row + column) % 2)
    striped = flat + 8 * (row == 10) + 4 * (column == 20)
    found = _pictures.pictures([striped, flat], "GRBG", (64, 96))
    assert found["part"] == "All 64 x 96 pixels" and found["shown"][1]["scatter"] == "rows 0 DN, columns 0 DN"
    of_rows, of_columns = (
        np.array([[float(x) for x in point.split(",")] for point in re.search('points="([^"]*)"', strip)[1].split()])
        for strip in (found["shown"][0]["rows"], found["shown"][0]["columns"])
    )
    assert np.argmax(of_rows[:, 0]) == 10 and 90 < of_rows[10, 0] <= 100
    assert np.argmin(of_columns[:, 1]) == 20 and 0 <= of_columns[20, 1] < 10


def test_the_budget_shows_what_a_model_lacks(stack):
    near = _measured.middle(stack, [PLAIN, PLAIN.add(fx.RowNoise(4.0))], 0)
    measured, first, last = (np.sqrt(one.rows[1].components["row_x_frame"].variance_dn2) for one in near.budgets)
    assert measured == pytest.approx(last, rel=0.3) and measured > 5 * max(first, 0)
    panels = _figures.budget_panels(near, ["first model", "last model"])
    assert list(panels) == [f"{name}, dark of 200 ms, noise budget" for name in ("red", "green", "blue")]


@pytest.mark.slow
def test_a_page_of_a_fit_says_its_doubts(stack, story):
    fit = replace(story.fit, doubts=("One <b>doubt</b>.", "Another."), grave=True)
    text = Elements(report.page(fit, stack)).text
    assert text.index("Do not use this Do not use these numbers.") < text.index("One <b>doubt</b>. (1 more below)")
    assert "Doubts: One <b>doubt</b>. Another. A note." in text


@pytest.mark.slow
def test_a_page_of_an_unfinished_story_says_so(stack, story, pages):
    so_far = replace(story, steps=story.steps[:1], ending=Ending(Ended.UNFINISHED))
    text = Elements(report.page(so_far, stack)).text
    assert "Do not use this Not finished (error 88.1)" in text
    assert "The search was still running when this page was written." in text
    assert "The search was still running" not in Elements(pages["improve"]).text


@pytest.mark.slow
def test_a_page_of_a_large_sensor_is_small():
    rng = np.random.default_rng(3)
    counts = rng.normal(70, 6, (1, 2, 1000, 1500)).round().astype(np.uint16)
    large = hsnoise.FrameStack(counts, [0.2], cfa=PLAIN.cfa, shutter=PLAIN.shutter)
    page = report.page(comparison(), large, fit=PLAIN)
    assert len(page.encode()) < 3_000_000 and "The middle 240 x 320 pixels" in page


def test_crop_keeps_the_colour_of_the_first_pixel():
    row, column = np.indices((1001, 1303))
    part = _measured.crop(2 * (row % 2) + column % 2)
    assert part.shape == _measured.CROP and part[0, 0] == 0


def test_mono_and_a_single_frame_of_each_exposure():
    single = capture(MONO).select(frames=slice(0, 1))
    page = report.page(diagnosis("nothing missing", ()), single, fit=MONO)
    assert "all pixels, counts" in page and "Where the model fails" not in page and "Noise budget" not in page


def test_a_figure_is_the_same_every_time(stack):
    at = _measured.shown(stack, PLAIN, 0)
    one, two = (_figures.svg(_figures.spectrum(at, "G", 0), "f", "a") for _ in range(2))
    assert one == two


def test_a_report_needs_a_model(compared, stack):
    with pytest.raises(TypeError, match="fit"):
        report.page(compared, stack)


@pytest.mark.parametrize("path", ["page.pdf", "nowhere/page.html", "folder.html"])
@pytest.mark.parametrize("command", ["compare", "diagnose", "improve"])
def test_a_wrong_path_is_told_before_long_work(command, path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.html").mkdir()
    model = ["--model", "grasshopper3"] if command == "compare" else []
    # The capture does not exist: were it looked for first, the error would be another.
    assert main([command, "no-capture.npz", *model, "--report", path]) == 2
    assert capsys.readouterr().err.startswith("hsnoise: --report: ")
    assert [one.name for one in tmp_path.iterdir()] == ["folder.html"]


@pytest.mark.slow
def test_the_command_line_writes_it(tmp_path, monkeypatch, compared, capsys):
    MONO.save(tmp_path / "model.json")
    darks = tmp_path / "darks.npz"
    assert main(["sample", str(tmp_path / "model.json"), "--out", str(darks), "--frames", "3", "--shape", "32x64"]) == 0
    monkeypatch.setattr(hsnoise, "compare", lambda *_, **__: compared)
    out = tmp_path / "out"
    arguments = ["--model", str(tmp_path / "model.json"), "--out", str(out), "--report", str(out / "report.html")]
    assert main(["compare", str(darks), *arguments, "--debug"]) == 0
    assert f"Report: {out / 'report.html'}" in capsys.readouterr().out
    assert "darks.npz" in (out / "report.html").read_text()
    assert sorted(path.name for path in out.iterdir()) == ["comparison.png", "report.html"]


@pytest.mark.parametrize("command", [pytest.param("improve", marks=pytest.mark.slow), "demo"])
def test_a_story_that_is_broken_off_has_its_page(command, tmp_path, monkeypatch, story, capsys):
    MONO.save(tmp_path / "model.json")
    darks, out, pages = tmp_path / "darks.npz", tmp_path / "out", []
    assert main(["sample", str(tmp_path / "model.json"), "--out", str(darks), "--frames", "3", "--shape", "32x64"]) == 0
    bare = replace(story.fit, params=MONO)
    started = Story((replace(story.steps[0], fit=bare, diagnosis=None),), Ending(Ended.UNFINISHED))
    ended = replace(started, ending=Ending(Ended.FINISHED))

    def improve(stack, tell, *, keep, **_):
        keep(started)
        pages.append((out / "report.html").read_text())
        return ended

    monkeypatch.setattr(_results, "improved", improve)
    monkeypatch.setattr(_demo, "fit_with_progress", lambda *_: SimpleNamespace(has_gain=True))
    given = ["--data", str(darks)] if command == "demo" else [str(darks), "--report", str(out / "report.html")]
    assert main([command, *given, "--out", str(out), "--debug"]) == (0 if command == "demo" else 1)  # a red light
    assert "Not finished" in Elements(pages[0]).text and "darks.npz" in pages[0]
    assert "Not finished" not in Elements((out / "report.html").read_text()).text
    assert str(out / "report.html") in capsys.readouterr().out


def test_a_story_says_what_is_open(story):
    first, last = story.steps
    unmet = replace(last.fit, status=Status.NOT_MET)
    told = str(replace(story, steps=(first, replace(last, ahead=2.0, fit=unmet))))
    assert "row_noise fits equally well on the other side of the gain" in told
    assert "the last fit has NOT CONVERGED" in told
    assert "other side" not in str(replace(story, steps=(first, replace(last, ahead=20.0))))
    assert "NOT CONVERGED" not in str(story)
