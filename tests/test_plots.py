"""Figures show what was measured beside what was fitted: their data are checked, not their pixels."""

from __future__ import annotations

import dataclasses
import io
import subprocess
import sys
from functools import cache
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise import plots
from hsnoise.likelihood.summary import summarise
from hsnoise.plots._histograms import _coarse
from hsnoise.plots._moments import beta_rule, count_moments
from hsnoise.plots._photon_transfer import clipped_fraction
from hsnoise.plots._row_spectrum import _bands
from hsnoise.plots._style import new_figure

EXPOSURES_S = (0.1, 0.4)
GAIN, RATE, READ, SIGMA = 1.5, 60.0, 3.0, 0.2


def model(black_level_dn, shutter="rolling"):
    camera = hsnoise.cameras.canon_5d3(black_level_dn=black_level_dn, shutter=shutter)
    return hsnoise.NoiseModel(
        [
            hsnoise.effects.ShotNoise(),
            hsnoise.effects.DarkCurrent(RATE),
            hsnoise.effects.ReadNoise(READ),
            hsnoise.effects.RowGain(SIGMA, camera["row_gain"].exponent),
            hsnoise.effects.Gain(GAIN),
            hsnoise.effects.BlackLevel(black_level_dn),
            hsnoise.effects.ADC(),
        ],
        cfa="mono",
        shutter=shutter,
        exposure_s=0.1,
    )


@cache
def fitted(black_level_dn=0.0, shutter="rolling", flats=False):
    truth = model(black_level_dn, shutter)
    key = jax.random.key(7)
    darks = [hsnoise.sample_dark(key, 4, (48, 96), truth, exposure_s=t) for t in EXPOSURES_S]
    lit = [hsnoise.sample(key, np.full((4, 48, 96), e), truth, exposure_s=0.1) for e in (50.0, 500.0)] if flats else []
    stack = hsnoise.FrameStack(
        darks + lit,
        [*EXPOSURES_S, *[0.1] * len(lit)],
        kind=["dark"] * len(darks) + ["flat"] * len(lit),
        black_level=black_level_dn,
        shutter=shutter,
    )
    return hsnoise.fit(stack)


def drawn(figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize("draw", [plots.histograms, plots.photon_transfer, plots.row_spectrum])
@pytest.mark.parametrize("options", [{}, {"black_level_dn": 100.0, "shutter": "global", "flats": True}], ids=str)
def test_every_figure_can_be_drawn_and_names_its_axes(draw, options):
    figure = draw(fitted(**options))
    assert drawn(figure).startswith(b"\x89PNG")
    bottom = [axes for axes in figure.axes if axes.get_subplotspec().is_last_row()]
    assert all(axes.get_xlabel() for axes in bottom)
    assert figure.axes[0].get_ylabel()


@pytest.mark.slow
@pytest.mark.parametrize("draw", [plots.histograms, plots.photon_transfer, plots.row_spectrum])
def test_figures_name_the_effects_that_they_lack(draw):
    fit = fitted()
    more = dataclasses.replace(fit, params=fit.params.add(hsnoise.effects.RowNoise(1.0)))
    assert "without" not in draw(fit).get_suptitle()
    assert draw(more).get_suptitle().endswith("; model without row_noise")


def test_figures_of_a_pooled_fit_are_those_of_its_likelihood():
    fit = fitted()
    assert set(plots.of_fit(fit)) == {"photon_transfer", "histograms", "row_spectrum"}
    assert plots.of_fit(dataclasses.replace(fit, method="synthetic")) == {}
    with pytest.raises(ValueError, match=r"pixel transfer needs a fit where pixels differ"):
        plots.pixel_transfer(fit)


def test_histograms_show_all_pixels_and_the_expected_ones():
    fit = fitted()
    figure = plots.histograms(fit)
    for e, axes in enumerate(figure.axes[::2]):
        measured, _, expected = axes.patches
        for steps, total in ((measured, 4 * 48 * 96), (expected, fit.expected_histograms()[0][e].sum())):
            values, edges, _ = steps.get_data()
            np.testing.assert_allclose((values * np.diff(edges)).sum(), total, rtol=2e-3)


@pytest.mark.slow
def test_residuals_of_a_true_model_are_of_order_one():
    figure = plots.histograms(fitted(100.0, "global", True))
    residuals = np.concatenate([strip.lines[-1].get_ydata() for strip in figure.axes[1::2]])
    assert 0.5 < np.sqrt(np.mean(residuals**2)) < 1.6
    assert np.abs(residuals).max() < 6


def test_bins_that_are_put_together_keep_their_pixels():
    rng = np.random.default_rng(0)
    counts = rng.poisson(3.0, (2, 5, 1000)).astype(float)
    measured, sigma, expected, edges = _coarse(counts, counts.sum((0, 1)), np.arange(999) - 0.5)
    assert measured.size == expected.size == sigma.size == edges.size - 1 < 120
    np.testing.assert_allclose([measured.sum(), expected.sum()], counts.sum(), rtol=1e-12)
    assert np.all(np.diff(edges) > 0)


@pytest.mark.parametrize("black_level_dn", [0.0, pytest.param(100.0, marks=pytest.mark.slow)])
def test_photon_transfer_lies_on_the_curve_of_the_fit(black_level_dn):
    fit = fitted(black_level_dn)
    axes = plots.photon_transfer(fit).axes[0]
    points = axes.collections[-1].get_offsets()
    curve = next(line for line in axes.lines if len(line.get_xdata()) > 10)
    on_curve = np.interp(points[:, 0], curve.get_xdata(), curve.get_ydata())
    np.testing.assert_allclose(points[:, 1], on_curve, rtol=0.05)


def test_photon_transfer_line_before_clipping_is_that_of_the_fit():
    fit = fitted(0.0)
    axes = plots.photon_transfer(fit).axes[0]
    line = next(line for line in axes.lines if line.get_linestyle() == "--" and len(line.get_xdata()) > 10)
    slope, offset = np.polyfit(line.get_xdata(), line.get_ydata(), 1)
    gain, read, sigma = (fit.table[name][0] for name in ("gain", "read_noise.sigma", "row_gain.sigma"))
    np.testing.assert_allclose(slope, gain * (1 + sigma**2), rtol=1e-9)
    np.testing.assert_allclose(offset, (gain * read) ** 2 * (1 + sigma**2) + 1 / 12, rtol=1e-9)


@pytest.mark.slow
def test_clipped_points_are_hollow():
    for black_level_dn, hollow in ((0.0, True), (100.0, False)):
        fit = fitted(black_level_dn)
        fraction = clipped_fraction(fit.summary.histograms[0], None)
        counts = fit.summary.histograms[0]
        assert (fraction[0] > 1e-3) == hollow
        if hollow:
            np.testing.assert_allclose(fraction, counts.counts[..., 0].sum((1, 2)) / (4 * 48 * 96), rtol=1e-12)
        faces = plots.photon_transfer(fit).axes[0].collections[-1].get_facecolors()
        assert bool(np.all(faces[0] == 1.0)) == hollow


def test_moments_of_counts_are_those_of_samples():
    params = fitted().params
    rng = np.random.default_rng(5)
    n, t, beta, white = 400_000, 0.05, 1.3, 12.0
    gain, rate, read = (params.table[name][0] for name in ("gain", "dark_current.rate", "read_noise.sigma"))
    electrons = rng.poisson(rate * t, n) + read * rng.standard_normal(n)
    counts = np.clip(np.rint(gain * beta * electrons), 0, white)
    mean, variance = count_moments(params, 0, [t], [beta], white)
    assert abs(counts.mean() - mean[0, 0]) < 5 * counts.std() / np.sqrt(n)
    fourth = ((counts - counts.mean()) ** 4).mean()
    assert abs(counts.var() - variance[0, 0]) < 5 * np.sqrt((fourth - counts.var() ** 2) / n)


@pytest.mark.slow
def test_row_spectrum_has_the_power_of_the_row_gain():
    fit = fitted(100.0, "global", True)
    axes = plots.row_spectrum(fit).axes[0]
    lines = {line.get_label(): line.get_ydata() for line in axes.lines}
    sigma = fit.table["row_gain.sigma"][0]
    np.testing.assert_allclose(lines["row gain alone"], sigma**2, rtol=1e-9)
    total = lines["fitted: row gain + pixel noise"]
    np.testing.assert_allclose(total, lines["row gain alone"] + lines["pixel noise alone"], rtol=1e-9)
    # 24 frequencies of 4 frames: a standard error of 10 %.
    assert abs(lines["measured"].mean() / total.mean() - 1) < 0.4


def test_bands_average_a_periodogram():
    rng = np.random.default_rng(3)
    k = np.arange(1, 401)
    power = rng.gamma(4, 0.25, 400)
    x, y, error = _bands(k, power, 4)
    assert np.all(np.diff(x) > 0)
    pulls = (y - 1) / (error / y)
    assert np.abs(pulls).max() < 5
    assert 0.4 < pulls.std() < 1.8


def test_row_spectrum_needs_a_row_gain():
    fit = fitted()
    fit = dataclasses.replace(fit, params=fit.params.remove("row_gain"))
    with pytest.raises(ValueError, match="row_gain in the model"):
        plots.row_spectrum(fit)
    drawn(plots.photon_transfer(fit))
    drawn(plots.histograms(fit))


def test_beta_rule_integrates_a_normal():
    beta, weight = beta_rule(0.3)
    np.testing.assert_allclose([weight.sum(), weight @ beta, weight @ (beta - 1) ** 2], [1, 1, 0.09], rtol=1e-12)


@pytest.mark.slow
def test_drawing_leaves_pyplot_alone():
    code = "import sys, hsnoise; hsnoise.plots.histograms; assert 'matplotlib.pyplot' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_flats_alone_have_a_photon_transfer():
    truth = model(100.0, "global")
    key = jax.random.key(2)
    lit = [hsnoise.sample(key, np.full((3, 32, 64), e), truth, exposure_s=0.1) for e in (20.0, 100.0, 500.0)]
    summary = summarise(hsnoise.FrameStack(lit, [0.1] * 3, kind="flat", black_level=100, shutter="global"))
    fit = SimpleNamespace(summary=summary, params=truth, transfer=None)
    axes, gains = plots.photon_transfer(fit).axes
    assert "gain against signal" in gains.get_title()
    signal = axes.collections[-1].get_offsets()[:, 0]
    # Means of 3 frames of 64 x 32 pixels whose 32 rows have gains of their own.
    np.testing.assert_allclose(signal, GAIN * (np.array([20, 100, 500]) + RATE * 0.1), rtol=5 * SIGMA / np.sqrt(3 * 32))
    with pytest.raises(ValueError, match="dark frames"):
        plots.histograms(fit)


def test_a_notebook_shows_a_figure_that_is_returned():
    figure = new_figure(3, 2, "title")
    assert figure._repr_png_().startswith(b"\x89PNG")
