"""Figures of fits where pixels differ, and of the noise budget: their data are checked, not their pixels."""

from __future__ import annotations

import dataclasses
import io
from functools import cache
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise import plots
from hsnoise.plots._pixel_transfer import signal_of, transfers_of
from hsnoise.plots._sampled import edges_of
from hsnoise.statistics.pixels.flags import FLAGS
from hsnoise.statistics.pixels.maps import PixelMaps

TIMES, FRAMES, SHAPE = (0.0, 4.0), 6, (96, 128)
GAIN, RATE = 2.0, 60.0


def sensor(cfa):
    e = hsnoise.effects
    effects = [
        e.ShotNoise(),
        e.DarkCurrent(RATE),
        e.DarkCurrentNonuniformity(0.3),
        e.HotPixels(0.01, 1000.0, 0.0),
        e.ReadNoise(3.0),
        e.RowGain(0.01, 0.0),
        e.Gain(GAIN),
        e.BlackLevel(200.0),
        e.ADC(16383),
    ]
    return hsnoise.NoiseModel(effects, cfa=cfa, shutter="global", exposure_s=1.0)


@cache
def captured(cfa="mono", times=TIMES, flats=False):
    key, sensor_key = jax.random.split(jax.random.key(4))
    levels = [(t, 0.0) for t in times] + [(0.0, light) for light in (200.0, 2000.0) if flats]
    counts = [
        np.asarray(
            hsnoise.sample(
                jax.random.fold_in(key, i),
                np.full((FRAMES, *SHAPE), light),
                sensor(cfa),
                exposure_s=t,
                sensor_key=sensor_key,
            )
        )
        for i, (t, light) in enumerate(levels)
    ]
    return hsnoise.FrameStack(
        counts,
        [t for t, _ in levels],
        kind=["flat" if light else "dark" for _, light in levels],
        cfa=cfa,
        shutter="global",
        white_level=16383,
    )


@cache
def fitted(*args):
    fit = hsnoise.fit(captured(*args))
    assert fit.transfer is not None
    return fit


def drawn(figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


@pytest.mark.parametrize(
    "options",
    [
        pytest.param((), id="mono", marks=pytest.mark.slow),
        pytest.param(("RGGB",), id="bayer", marks=pytest.mark.slow),
        pytest.param(("mono", TIMES, True), id="flats", marks=pytest.mark.slow),
    ],
)
def test_every_figure_of_a_fit_can_be_drawn_and_names_its_axes(options):
    figures = plots.of_fit(fitted(*options))
    assert {"photon_transfer", "histograms", "row_spectrum", "pixel_transfer", "dark_current", "pixel_map"} == set(
        figures
    )
    for name, figure in figures.items():
        assert drawn(figure).startswith(b"\x89PNG"), name
        panels = [axes for axes in figure.axes if axes.get_subplotspec() and axes.get_label() != "<colorbar>"]
        assert all(axes.get_xlabel() for axes in panels if axes.get_subplotspec().is_last_row()), name
        assert figure.axes[0].get_ylabel(), name
        assert "without" not in figure.get_suptitle(), name


@pytest.mark.slow
def test_one_dark_exposure_has_no_transfer():
    fit = hsnoise.fit(captured("mono", (4.0,)), pixels="differ")
    assert set(plots.of_fit(fit)) == {"histograms", "pixel_map"}
    for draw in (plots.pixel_transfer, plots.photon_transfer, plots.dark_current):
        with pytest.raises(ValueError, match="two exposures"):
            draw(fit)


@pytest.mark.slow
def test_small_frames_have_figures():
    fit = hsnoise.fit(captured().select(rows=(0, 24), columns=(0, 96)), pixels="differ")
    assert {"histograms", "dark_current", "pixel_map"} <= set(plots.of_fit(fit))


@pytest.mark.slow
def test_pixel_transfer_shows_the_line_and_the_gain_of_the_fit():
    fit = fitted()
    (_, transfer), *_ = transfers_of(fit)
    top, gains, residuals = plots.pixel_transfer(fit).axes
    line = top.lines[[one.get_label().startswith("ordinary") for one in top.lines].index(True)]
    slope, offset = np.polyfit(line.get_xdata(), line.get_ydata(), 1)
    np.testing.assert_allclose([slope, offset], [transfer.ordinary_gain, transfer.values[1]], rtol=1e-9)
    level = next(one for one in gains.lines if one.get_label().startswith("gain of the fit"))
    assert level.get_ydata()[0] == fit.table["gain"][0]
    shown = np.concatenate([one.lines[0].get_ydata() for one in residuals.containers])
    assert len(shown) == np.isfinite(transfer.fitted_dn2).sum()
    assert np.abs(shown).max() <= residuals.get_ylim()[1]


def test_signals_are_those_of_the_growth():
    (_, transfer), *_ = transfers_of(fitted())
    signal = signal_of(transfer)
    expected = transfer.classes.growth_dn_per_s[:, None] * np.array(TIMES)
    ordinary = ~transfer.classes.hot
    np.testing.assert_allclose(signal[ordinary], expected[ordinary], atol=4.0)


def test_a_gain_that_is_withheld_is_called_so():
    fit = fitted()
    names = tuple(name for name in fit.table if name.startswith("gain"))
    figure = plots.pixel_transfer(dataclasses.replace(fit, withheld=names))
    assert "the gain is not determined" in [text.get_text() for text in figure.axes[1].texts]
    unit = plots.dark_current(dataclasses.replace(fit, withheld=names)).axes[-1].get_xlabel()
    assert unit == "dark current / (DN/s)"


def test_dark_current_of_the_model_is_that_of_the_sensor():
    figure = plots.dark_current(fitted())
    top, below = figure.axes
    steps = {one.get_label(): one.get_data() for one in top.patches if hasattr(one, "get_data")}
    pixels = SHAPE[0] * SHAPE[1]
    means = {}
    for name in ("measured", "sampled"):
        density, edges, _ = steps[name]
        number = density * np.diff(edges)
        assert number.sum() == pytest.approx(pixels, rel=1e-9)
        core = edges[1:] < 200  # e-/s: without the hot pixels
        means[name] = number[core] @ (0.5 * (edges[1:] + edges[:-1]))[core] / number[core].sum()
    assert means["measured"] == pytest.approx(RATE, rel=0.05)
    assert means["sampled"] == pytest.approx(means["measured"], rel=0.05)
    for line in below.lines:
        assert np.all(np.diff(line.get_xdata()) >= 0) and np.all(np.diff(line.get_ydata()) <= 0)


def test_sampled_histograms_hold_all_counts():
    figure = plots.histograms(fitted())
    for axes in figure.axes[::2]:
        steps = {one.get_label(): one.get_data() for one in axes.patches if hasattr(one, "get_data")}
        for name in ("measured", "sampled"):
            density, edges, _ = steps[name]
            assert density @ np.diff(edges) == pytest.approx(FRAMES * SHAPE[0] * SHAPE[1], rel=1e-9)
    ratios = np.concatenate([axes.containers[0].lines[0].get_ydata() for axes in figure.axes[1:2]])
    assert 0.8 < np.median(ratios) < 1.25


def test_bins_widen_beyond_the_core_and_lie_between_counts():
    rng = np.random.default_rng(1)
    counts = np.rint(np.append(rng.normal(100, 5, 10_000), [90_000.0, 3.0]))
    edges = edges_of(counts - 99.3, counts - 99.3, 99.3)
    assert edges[0] < counts.min() - 99.3 and edges[-1] > counts.max() - 99.3
    np.testing.assert_allclose((edges + 99.3) % 1, 0.5, atol=1e-6)
    widths = np.diff(edges)
    assert len(edges) < 150 and widths.min() == pytest.approx(1.0)
    beyond = edges[:-1] > np.quantile(counts - 99.3, 0.98)
    assert np.all(np.diff(widths[beyond]) >= -1e-6)


def maps(flags):
    blank = np.zeros(flags.shape, np.float32)
    summary = SimpleNamespace(flats=None)
    return SimpleNamespace(pixels=PixelMaps(blank, blank, blank, flags, "e-/s"), summary=summary)


def test_few_pixels_are_dots_and_many_a_density():
    rng = np.random.default_rng(2)
    flags = np.zeros((600, 900), np.uint8)
    flags[rng.random(flags.shape) < 0.01] = FLAGS["hot"]
    stuck = [(10, 20), (300, 700), (599, 899)]
    for place in stuck:
        flags[place] |= FLAGS["stuck"]
    figure = plots.pixel_map(maps(flags))
    drawn(figure)
    mesh, dots = figure.axes[0].collections
    np.testing.assert_allclose(dots.get_offsets(), [(c, r) for r, c in stuck])
    shares = np.asarray(mesh.get_array())
    assert shares.size < 96 * 96 and 0.5 < np.median(shares) < 1.5
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert f"hot: {np.count_nonzero(flags & FLAGS['hot']):,}, 0.99 % (shaded)" in labels
    assert "dead: flats would show them" in labels


def test_a_sensor_without_odd_pixels_has_an_empty_map():
    figure = plots.pixel_map(maps(np.zeros((40, 60), np.uint8)))
    drawn(figure)
    assert not figure.axes[0].collections


@pytest.mark.parametrize("cfa", ["mono", pytest.param("RGGB", marks=pytest.mark.slow)])
def test_budget_shows_components_and_shares_beside_those_of_the_model(cfa):
    found = hsnoise.budget(captured(cfa))
    figure = found.plot(sensor(cfa))
    drawn(figure)
    columns = 1 if cfa == "mono" else 3
    components, shares = figure.axes[0], figure.axes[columns]
    row = next(row for row in found.rows if row.exposure_s == 4.0)
    clear = components.collections
    places = np.concatenate([np.asarray(one.get_offsets()) for one in clear if len(one.get_offsets())])
    for name in ("temporal", "pixel"):
        assert np.isclose(places[:, 0], row.components[name].variance_dn2).any(), name
    bars = np.array([(bar.get_y(), bar.get_width()) for bar in shares.patches])
    assert len(bars) == 7 * 2 * len(TIMES)
    totals = [bars[np.isclose(bars[:, 0], y), 1].sum() for y in np.unique(bars[:, 0].round(6))]
    np.testing.assert_allclose(totals, 100, rtol=1e-6)


def test_budget_of_single_frames_is_refused():
    counts = [captured().frame(i, 0)[None] for i in (0, 1)]
    with pytest.raises(ValueError, match="two frames or more"):
        plots.budget(hsnoise.budget(counts, exposure_s=TIMES[:2]))


def test_hot_pixels_do_not_enter_the_row_spectrum():
    """A fixed pattern of rows is no row gain: the spectrum stays that of the fit."""
    fit = fitted()
    figure = plots.row_spectrum(fit)
    lines = {line.get_label(): np.asarray(line.get_ydata()) for line in figure.axes[0].lines}
    measured, expected = lines["measured"].mean(), lines["fitted: row gain + pixel noise"].mean()
    # 48 frequencies of 6 frames, one of which went into the means of the rows.
    assert measured == pytest.approx(expected, rel=4 / np.sqrt(48 * 5) + 0.1)
