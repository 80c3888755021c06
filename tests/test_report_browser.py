"""A report in Chromium: it fills a desktop, fits a phone, and can be read in the light and in the dark."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise import report
from hsnoise.criticism import Candidate, Comparison, Diagnosis, Step, Story
from hsnoise.criticism.finding import Unexplained
from hsnoise.criticism.outcomes import Ended, Ending
from hsnoise.fitting.result import FitResult, Method, Status
from hsnoise.plots._groups import FAMILIES
from hsnoise.simulation.draws import draw_capture

pytestmark = pytest.mark.browser

WIDTHS = {390: 844, 1280: 800, 1920: 1080}  # a phone, a laptop, a desktop: widths and heights, px
QUIET = ("gpu", "quic", "background-networking", "component-update", "sync")
CLEAR = 4.5  # contrast of text
MODEL = hsnoise.cameras.grasshopper3(black_level_dn=64).remove("row_gain")
ADDED = (fx.RowNoise(4.0), fx.ColumnFixedPattern(2.0), fx.DarkCurrentNonuniformity(0.2))
PAGES = ("improve", "unfinished", "one step", "compare", "diagnose", "fit", "mono")

# Texts of a figure are outlines in groups of their own, as Matplotlib names them.
SVG_TEXT = """() => [...document.querySelectorAll("figure > svg")].flatMap(svg => {
  const outer = svg.getBoundingClientRect();
  const texts = [...svg.querySelectorAll("g[id*='text_']")].map(g => [g.id, g.getBoundingClientRect()]);
  const cut = texts.filter(([id, a]) =>
    a.left < outer.left - 1 || a.right > outer.right + 1 || a.top < outer.top - 1 || a.bottom > outer.bottom + 1);
  const over = texts.flatMap(([id, a], i) => texts.slice(i + 1).filter(([other, b]) =>
    Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1 &&
    Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1).map(([other]) => id + " on " + other));
  const bad = [...cut.map(([id]) => id + " is cut off"), ...over];
  return (texts.length ? bad : ["no text"]).map(what => svg.getAttribute("aria-label") + ": " + what);
})"""
CONTRASTS = """() => {
  const numbers = text => (text.match(/[\\d.]+/g) || [0, 0, 0, 0]).map(Number);
  const linear = v => v <= .04045 * 255 ? v / 255 / 12.92 : ((v / 255 + .055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => [r, g, b].map(linear)
    .reduce((sum, v, i) => sum + v * [.2126, .7152, .0722][i], 0);
  const behind = e => { for (; e; e = e.parentElement) {
    const of = numbers(getComputedStyle(e).backgroundColor); if (of.length < 4 || of[3] > 0) return of; } };
  const ratio = (a, b) => (Math.max(a, b) + .05) / (Math.min(a, b) + .05);
  const words = [...document.querySelectorAll("main *")].filter(e => parseFloat(getComputedStyle(e).fontSize) > 0 &&
    [...e.childNodes].some(n => n.nodeType === 3 && n.data.trim()));
  const outlines = [...document.querySelectorAll("g[id*='text_'] use")];
  return [...words.map(e => [e, getComputedStyle(e).color]), ...outlines.map(e => [e, getComputedStyle(e).fill])]
    .map(([e, colour]) => [ratio(light(numbers(colour)), light(behind(e))), e.outerHTML.slice(0, 90)]);
}"""
USED = """() => Math.max(...[...document.querySelectorAll("img, figure svg, .track, td")]
  .map(e => e.getBoundingClientRect().right))"""
PLACES = """() => [".disc", ".stack, .bars, .figures, table"].map(
  what => document.querySelector(what).getBoundingClientRect()).map(place => [place.top, place.bottom])"""
CUT_OFF = """() => [...document.querySelectorAll(".part")].filter(e => e.scrollWidth > e.clientWidth + 1)
  .map(e => e.textContent)"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    playwright = pytest.importorskip("playwright.sync_api", reason="needs Playwright: make test-browser")
    names = ("chromium", "chromium-browser", "google-chrome")
    found = next((path for path in map(shutil.which, names) if path), None)
    if found is None:
        pytest.skip(f"no browser: looked for {', '.join(names)}")
    # The pages are our own and ask no network, so the browser needs no sandbox, which containers lack.
    flags = ["--no-sandbox", "--no-first-run", *(f"--disable-{name}" for name in QUIET)]
    with playwright.sync_playwright() as running:
        folder = tmp_path_factory.mktemp("profile")
        context = running.chromium.launch_persistent_context(folder, executable_path=found, headless=True, args=flags)
        yield context
        context.close()


def capture(model, exposure_s):
    counts = np.random.default_rng(0).integers(60, 80, (len(exposure_s), 3, 64, 96)).astype(np.uint16)
    return draw_capture(5, model, hsnoise.FrameStack(counts, exposure_s, cfa=model.cfa, shutter=model.shutter))


def compared(error):
    """A comparison in which the groups are off by factors of all sizes up to `error`."""
    groups = {group: 1.6 * error ** (1 - i / 13) for i, group in enumerate([*FAMILIES][:14])}
    row = ("noise: log variance, G, short exposures", "noise", 3.1, 2.9, 44.0)
    worst = (f"{row[0]}: measured 3.1, the model gives 2.9 (44 standard deviations above)",)
    return Comparison(error, groups, (row,), worst, 0.02, -3.0, ("Curvature needs three exposures.",))


def diagnosis():
    names = ("dark_current_nonuniformity", "random_telegraph_noise", "photo_response_nonuniformity")
    ranking = tuple(Candidate(name, fx.RowNoise(1.0), 3e4 / 9**i, 1e-12, 40.0) for i, name in enumerate(names))
    left = Unexplained(7.2, "row x frame", ("row x frame: G (z = +44.0)",))
    return Diagnosis(ranking, "named", ranking[0], names[:1], "", left)


def told(errors, ending):
    """A story of as many steps as errors."""
    model, doubts = MODEL, ("The read noise of long exposures is higher than that of short ones by 4 %.",)
    steps = []
    for i, error in enumerate(errors):
        model = MODEL if i == 0 else model.add(ADDED[i - 1])
        fit = FitResult(
            model, ("gain.R",), np.diag([0.01]), Method.ML, Status.CONVERGED, "", 9, 0.0, ("A note.",), None, None
        )
        fit = replace(fit, doubts=doubts)
        added = ADDED[i - 1].name if i else None
        steps.append(Step(fit, compared(error), diagnosis(), added, -9.0, ("gain.R moved.",)))
    return Story(tuple(steps), ending)


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Pages by their names, as files."""
    truth = MODEL.add(ADDED[0])
    bayer, mono = capture(truth, (0.2,)), capture(replace_colours(truth), (0.05, 0.2))
    story = told((4e4, 531.0, 12.0, 1.2), Ending(Ended.FINISHED))
    fit = story.steps[0].fit
    found = {
        "improve": (story, bayer, {}),
        "unfinished": (
            told((4e4, 531.0), Ending(Ended.UNFINISHED)),
            bayer,
            {},
        ),
        "one step": (told((1.0,), Ending(Ended.FINISHED)), bayer, {}),
        "compare": (compared(88.0), bayer, {"fit": MODEL}),
        "diagnose": (diagnosis(), bayer, {"fit": fit, "comparison": compared(88.0)}),
        "fit": (fit, bayer, {}),
        "mono": (compared(2.0), mono, {"fit": replace_colours(MODEL)}),
    }
    folder = tmp_path_factory.mktemp("pages")
    for name, (one, stack, keywords) in found.items():
        (folder / f"{name}.html").write_text(report.page(one, stack, files=["darks/IMG_0001.CR2"] * 9, **keywords))
    return folder


def replace_colours(model):
    """The model as that of a sensor without colours."""
    parts = [fx.Gain(3.1) if e.name == "gain" else fx.BlackLevel(64.0) if e.name == "black_level" else e for e in model]
    return hsnoise.NoiseModel(parts, cfa="mono", shutter=model.shutter, exposure_s=model.exposure_s)


@pytest.fixture
def opened(browser, pages):
    """A page of the browser, and what it asked for and complained about."""
    page = browser.new_page()
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: asked.append(f"error: {error}"))

    def opened(name, width, scheme):
        page.set_viewport_size({"width": width, "height": WIDTHS[width]})
        page.emulate_media(color_scheme=scheme)
        page.goto((pages / f"{name}.html").as_uri())
        return page

    yield opened
    page.close()
    assert asked and all(url.startswith(("data:", "file:")) for url in asked)


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", PAGES)
def test_a_page_uses_its_width_and_no_more(name, width, opened):
    page = opened(name, width, "light")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(USED) >= 0.9 * width
    assert page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
    assert page.evaluate(CUT_OFF) == []
    for top, _ in page.evaluate(PLACES):
        assert 0 <= top < WIDTHS[width] - 100  # something of it is within the first screen
    if width > 390 and name in ("improve", "unfinished", "one step"):
        assert page.evaluate(PLACES)[1][1] < WIDTHS[width]  # the whole first picture


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("name", PAGES)
def test_no_text_of_a_figure_is_cut_off_or_hidden_by_another(name, width, opened):
    assert opened(name, width, "light").evaluate(SVG_TEXT) == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", PAGES)
def test_all_text_stands_out(name, scheme, opened):
    page = opened(name, 1280, scheme)
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert background == ("rgb(255, 255, 255)" if scheme == "light" else "rgb(20, 23, 26)")
    contrasts = page.evaluate(CONTRASTS)
    assert len(contrasts) > 300
    assert [found for found in contrasts if found[0] < CLEAR] == []


@pytest.mark.parametrize(("name", "word"), [("one step", "With doubts"), ("compare", "Does not fit")])
def test_the_light_is_a_disc_and_a_word(name, word, opened):
    page = opened(name, 1280, "light")
    assert page.inner_text("h1").startswith(word)
    colour = page.evaluate("getComputedStyle(document.querySelector('.disc circle')).fill")
    assert colour == page.evaluate("getComputedStyle(document.querySelector('h1 b')).color") != "rgb(28, 32, 36)"


def test_a_printed_page_has_dark_text_and_no_cut_figures(opened):
    page = opened("improve", 1280, "dark")
    page.emulate_media(media="print", color_scheme="dark")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    avoided = "[...document.querySelectorAll('figure, .stack, .bars')].map(e => getComputedStyle(e).breakInside)"
    assert set(page.evaluate(avoided)) == {"avoid"}
    assert page.pdf(format="A4").startswith(b"%PDF")
