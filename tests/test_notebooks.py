"""What a notebook shows of each result, and what of it goes to pandas."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from typing import ClassVar

import equinox as eqx
import jax
import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise._core import html as _html
from hsnoise._core.conclusion import Light
from hsnoise.criticism import Candidate, Comparison, Diagnosis, Step, Story
from hsnoise.criticism.finding import Unexplained
from hsnoise.criticism.outcomes import Ended, Ending
from hsnoise.fitting.result import FitResult, Method, Status

NASTY = "<img src=x onerror=\"alert(1)\"> & 'quotes' </table></div>"
MODEL = hsnoise.NoiseModel(
    [fx.ShotNoise(), fx.DarkCurrent(400.0), fx.ReadNoise(3.0), fx.Gain(2.0), fx.BlackLevel(100.0), fx.ADC(4095)],
    cfa="mono",
    shutter="rolling",
    exposure_s=0.1,
)
EXPOSURE_S = (0.02, 0.1)
MOST_BYTES = 10_000


class LampRipple(fx.RowNoise):
    name: ClassVar[str] = "lamp_ripple"
    lamp: str = eqx.field(static=True, default=NASTY)


def comparison(error, worst=()):
    groups = {"row x frame": 1.5 * error, "noise": 0.9}
    table = (("row x frame: G", "row x frame", 4.0, 1.0, 30.5), ("noise: log", "noise", 1.0, 1.1, -0.2))
    return Comparison(error, groups, table, worst, 0.02 if error > 3 else 0.5, -3.0, (f"Skipped: {NASTY}.",))


def diagnosis(verdict="named"):
    ranking = (
        Candidate("lamp_ripple", LampRipple(1.5), 120.25, 1e-30, 2.0),
        Candidate("hot_pixels", fx.HotPixels(0.001, 500.0), 4.5, 0.3, 7.5),
    )
    named = verdict == "named"
    best, names = (ranking[0], (ranking[0].name,)) if named else (None, ())
    return Diagnosis(ranking, verdict, best, names, NASTY, Unexplained(9.0, "noise", (NASTY,)))


@pytest.fixture(scope="module")
def stack():
    counts = [np.asarray(hsnoise.sample_dark(i, 4, (32, 48), MODEL, exposure_s=t)) for i, t in enumerate(EXPOSURE_S)]
    return hsnoise.FrameStack(
        counts, EXPOSURE_S, black_level=100, temperature_c=[-5.0, np.nan], assumed=[f"4 frames: {NASTY}"]
    )


@pytest.fixture(scope="module")
def results(stack):
    """One of each kind, with a hostile text in all that takes text."""
    names, covariance = ("gain", "dark_current.rate"), np.diag([0.01, 25.0])
    fit = FitResult(
        MODEL, names, covariance, Method.ML, Status.CONVERGED, NASTY, 9, 0.0, (NASTY,), hsnoise.summarise(stack), None
    )
    fit = replace(fit, doubts=("Odd frames.", NASTY), withheld=("read_noise.sigma",))
    before = comparison(88.1, (f"row x frame: G: measured 4, {NASTY}",))
    steps = (
        Step(fit, before, diagnosis(), None, float("nan"), ()),
        Step(replace(fit, params=MODEL.add(LampRipple(4.0))), comparison(1.1), None, "lamp_ripple", -20.5, (NASTY,)),
    )
    return {
        "FrameStack": stack,
        "NoiseModel": MODEL.add(LampRipple(2.0)),
        "FitResult": fit,
        "NoiseBudget": hsnoise.budget(stack),
        "Inspection": replace(hsnoise.inspect(stack), findings=(NASTY,)),
        "Comparison": before,
        "Diagnosis": diagnosis(),
        "Story": Story(steps, Ending(Ended.FINISHED), NASTY),
    }


KINDS = ("FrameStack", "NoiseModel", "FitResult", "NoiseBudget", "Inspection", "Comparison", "Diagnosis", "Story")
WITH_CONCLUSION = [kind for kind in KINDS if kind not in ("FrameStack", "NoiseModel", "NoiseBudget")]


class Pieces(HTMLParser):
    """Elements of a fragment in order, as (tag, attributes, text); fails on tags that are not closed in order."""

    def __init__(self, html):
        super().__init__()
        self.open, self.found = [], []
        self.feed(html)
        self.close()
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.found.append([tag, dict(attrs), ""])
        if tag != "br":
            self.open.append(self.found[-1])

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        for piece in self.open:
            piece[2] += data

    def of(self, tag):
        return [text for name, _, text in self.found if name == tag]

    def place(self, tag):
        return next(i for i, (name, _, _) in enumerate(self.found) if name == tag)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_shown_is_small_whole_and_escaped(results, kind):
    html = results[kind]._repr_html_()
    pieces = Pieces(html)
    assert type(results[kind]).__name__ == kind and len(html) < MOST_BYTES
    allowed = {"div", "p", "br", "span", "strong", "ul", "li", "table", "thead", "tbody", "tr", "th", "td"}
    assert {tag for tag, _, _ in pieces.found} <= allowed | {"details", "summary"}
    assert pieces.found[0][0] == "div" and pieces.of("table")
    assert (NASTY in pieces.found[0][2]) == (kind != "NoiseBudget")  # which takes no text
    widths = {len(re.findall("<t[hd]", row)) for table in html.split("<table")[1:2] for row in table.split("<tr>")[1:]}
    assert len(widths) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_colours_are_those_of_the_notebook(results, kind):
    styles = [attributes.get("style", "") for _, attributes, _ in Pieces(results[kind]._repr_html_()).found]
    assert not any("background" in style for style in styles)
    coloured = [style for style in styles if re.search(r"(^|;)\s*color\s*:", style)]
    assert coloured == ([f"color:{_html.COLOURS[results[kind].conclusion.light]}"] if kind in WITH_CONCLUSION else [])


@pytest.mark.parametrize("kind", WITH_CONCLUSION)
def test_the_conclusion_comes_first(results, kind):
    found, conclusion = Pieces(results[kind]._repr_html_()).found, results[kind].conclusion
    (_, first, second, third) = found[:4]
    assert first[0] == "p" and second[:2] == ["span", second[1]] and second[1]["aria-label"] == conclusion.light
    assert second[2] == "●" and third[0] == "strong" and third[2] == conclusion.sentence


def test_doubts_stand_above_the_table_and_notes_below_it(results):
    fit = results["FitResult"]
    pieces = Pieces(fit._repr_html_())
    assert fit.conclusion.light == Light.AMBER and "Odd frames. (1 more below)" in fit.conclusion.sentence
    assert pieces.of("li") == [NASTY, NASTY]  # the doubt that the conclusion does not say already, and the note
    assert pieces.place("li") < pieces.place("table") < pieces.place("details")
    assert f"converged: {NASTY}; 9 iterations{NASTY}" in pieces.of("details")[0]  # how it ended, and the note
    assert pieces.of("th") == ["parameter", "value", "standard error", "unit"]
    cells = pieces.of("td")
    rows = {cells[i]: cells[i + 1 : i + 4] for i in range(0, len(cells), 4)}
    assert rows["gain"] == ["2.00", "0.10", "DN/e-"] and rows["read_noise.sigma"] == ["not determined", "", "e-"]
    assert rows["black_level"] == ["100", "held", "DN"] and list(rows) == list(fit.told)


def test_tables_show_what_is_printed(results):
    for kind, heads in {
        "Comparison": ["group of statistics", "misfit"],
        "Diagnosis": ["effect", "score / nats", "p", "z left"],
        "Story": ["step", "added", "error", "held-out / nats", "worst group"],
    }.items():
        pieces, text = Pieces(results[kind]._repr_html_()), str(results[kind])
        assert pieces.of("th") == heads and all(head in text for head in heads)
        assert pieces.of("td") and all(cell in text for cell in pieces.of("td"))
    pieces = Pieces(results["Inspection"]._repr_html_())
    line = next(line for line in str(results["Inspection"]).splitlines() if line.startswith("dark"))
    assert line.split() == pieces.of("td")[:7]
    budget = Pieces(results["NoiseBudget"]._repr_html_()).of("td")
    assert budget and all(cell in str(results["NoiseBudget"]) for cell in budget)


def test_a_stack_shows_its_groups_and_what_is_elsewhere(stack):
    flats = hsnoise.FrameStack(np.full((2, 8, 8), 900, np.uint16) + np.arange(8, dtype=np.uint16), 3.0, kind="flat")
    both = hsnoise.FrameStack(stack.counts, EXPOSURE_S, elsewhere=flats)
    pieces = Pieces(both._repr_html_())
    assert pieces.of("th") == ["kind", "exposure / s", "frames"] * 2
    assert pieces.of("td") == ["dark", "0.02", "4", "dark", "0.1", "4", "flat", "3", "2"]
    assert any("elsewhere on the sensor, 8 x 8 pixels" in text for text in pieces.of("p"))
    shown = Pieces(stack._repr_html_())
    assert shown.of("th")[3:] == ["degrees C"] and shown.of("td") == [
        "dark",
        "0.02",
        "4",
        "-5.0",
        "dark",
        "0.1",
        "4",
        "-",
    ]


def test_a_model_without_numbers_still_has_a_head():
    seen = []

    def traced(model):
        seen.append(model._repr_html_())
        return model["gain"].value

    jax.jit(traced)(MODEL)
    assert Pieces(seen[0]).of("p") == [repr(MODEL).splitlines()[0]] and "<table" not in seen[0]


def test_long_tables_are_cut_and_say_so():
    pieces = Pieces(_html.table(("a", "b"), [(i, NASTY) for i in range(_html.MOST_ROWS + 1)], words=("b",)))
    assert pieces.of("td")[:4] == ["0", NASTY, "1", NASTY] and len(pieces.of("td")) == 2 * _html.MOST_ROWS
    assert pieces.of("p") == [f"{_html.MOST_ROWS} of {_html.MOST_ROWS + 1} rows"]
    assert not Pieces(_html.table(("a",), [(i,) for i in range(_html.MOST_ROWS)])).of("p")


COLUMNS = {
    "FrameStack": "kind:str exposure_s frames:int photons_e temperature_c overscan_dn",
    "NoiseModel": "parameter:str value standard_error unit:str",
    "FitResult": "parameter:str value standard_error unit:str",
    "NoiseBudget": "exposure_s kind:str channel:str component:str variance_dn2 standard_error_dn2 share",
    "Inspection": "kind:str exposure_s frames:int temperature_c level_dn noise_dn hottest_dn",
    "Comparison": "statistic:str group:str measured model z",
    "Diagnosis": "effect:str score_nats p z_left",
    "Story": "step:int added:str error held_out_nats worst_group:str",
}


@pytest.mark.parametrize("kind", KINDS)
def test_columns_have_names_with_units_and_one_type(results, kind):
    types = pytest.importorskip("pandas").api.types
    data = results[kind].to_pandas()
    checks = {"str": types.is_string_dtype, "int": types.is_integer_dtype, "": types.is_float_dtype}
    wanted = [column.partition(":") for column in COLUMNS[kind].split()]
    assert list(data.columns) == [name for name, _, _ in wanted] and len(data) > 1
    for name, _, kind_of_column in wanted:
        assert checks[kind_of_column](data[name].dtype), name


def test_rows_are_those_of_the_result(results, stack):
    pytest.importorskip("pandas")

    def rows(kind):
        return list(results[kind].to_pandas().itertuples(index=False, name=None))

    for kind in ("FitResult", "NoiseModel"):
        for (name, *found), (wanted, row) in zip(rows(kind), results[kind].table.items(), strict=True):
            assert name == wanted and found[2] == row[2]
            np.testing.assert_array_equal(found[:2], row[:2])
    assert np.isnan(results["NoiseModel"].to_pandas().standard_error).all()
    assert rows("Comparison") == list(results["Comparison"].table)
    assert rows("Diagnosis") == [("lamp_ripple", 120.25, 1e-30, 2.0), ("hot_pixels", 4.5, 0.3, 7.5)]
    first, second = rows("Story")
    assert first[:3] == (0, "the paper's model", 88.1) and np.isnan(first[3]) and first[4] == "row x frame"
    assert second == (1, "lamp_ripple", 1.1, -20.5, "row x frame")
    assert rows("NoiseBudget") == [tuple(row) for row in results["NoiseBudget"].table]
    groups = results["Inspection"].groups
    assert [row[:3] for row in rows("Inspection")] == [("dark", t, 4) for t in EXPOSURE_S]
    assert [row[4:] for row in rows("Inspection")] == [(g.level_dn, g.temporal_dn, g.hot_dn) for g in groups]
    data = stack.to_pandas()
    assert data.temperature_c.tolist()[0] == -5 and np.isnan(data.temperature_c[1]) and np.isnan(data.photons_e).all()


@pytest.mark.parametrize("kind", KINDS)
def test_without_pandas_the_extra_is_named(results, kind, no_pandas):
    message = rf"^{kind}\.to_pandas: needs pandas: pip install 'hsnoise\[pandas\]'$"
    with pytest.raises(ImportError, match=message):
        results[kind].to_pandas()
