"""The score: as the likelihood's gradient, and centred with the information as covariance over draws of its model."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise.effects import ADC, BlackLevel, DarkCurrent, Gain, ReadNoise, RowGain, ShotNoise
from hsnoise.likelihood import score
from hsnoise.likelihood.coordinates import coordinates_for
from hsnoise.likelihood.gradients import likelihood_at
from hsnoise.likelihood.plan import plan_rules
from hsnoise.likelihood.score import Score
from hsnoise.likelihood.summary import coding_of, summarise, without_counts
from hsnoise.simulation.draws import draw_capture

EXPOSURE_S = (0.02, 0.1)


def mono(*rows, shutter="global"):
    effects = [ShotNoise(), DarkCurrent(60.0), ReadNoise(3.0), *rows, Gain(1.4), BlackLevel(20.0), ADC(4095)]
    return hsnoise.NoiseModel(effects, cfa="mono", shutter=shutter, exposure_s=0.05)


ALIKE = mono()
WHITE = mono(RowGain(0.2, 0.0))
COLOURED = mono(RowGain(0.2, 0.8), shutter="rolling")


def like(model, shape=(32, 48), frames=4, flat_e=None):
    """Darks, and flats of so many electrons."""
    counts = [np.asarray(hsnoise.sample_dark(i, frames, shape, model, exposure_s=t)) for i, t in enumerate(EXPOSURE_S)]
    darks = hsnoise.FrameStack(counts, EXPOSURE_S, cfa=model.cfa, shutter=model.shutter, white_level=4095)
    if flat_e is None:
        return darks
    flat = np.asarray(hsnoise.sample(3, np.full((2, *shape), flat_e), model, exposure_s=0.02))
    kind = ("dark", "dark", "flat")
    return hsnoise.FrameStack([*counts, flat], (*EXPOSURE_S, 0.02), kind=kind, cfa=model.cfa, white_level=4095)


def score_of(model, stack):
    summary = summarise(stack)
    with jax.enable_x64(True):
        coordinates = coordinates_for(summary, model)
        return Score.of(coordinates, np.asarray(coordinates.start()), summary), summary


def exact(found, summary, moved=0.0):
    """The gradient with a quadrature of the capture's own, at the centre or beside it."""
    with jax.enable_x64(True):
        at, light = found.centre + moved, without_counts(summary)
        parts = [
            likelihood_at(found.coordinates, at, replace(light, flats=None), (rule,))[1]
            for rule in plan_rules(found.coordinates.at(at)[0], summary)
        ]
        if summary.flats is not None:
            parts.append(likelihood_at(found.coordinates, at, replace(light, histograms=()), ())[1])
        return np.sum(parts, 0)


@pytest.mark.parametrize(
    ("model", "kept"),
    [
        pytest.param(ALIKE, True, marks=pytest.mark.slow),
        pytest.param(WHITE, True, marks=pytest.mark.slow),
        (WHITE, False),
        pytest.param(COLOURED, True, marks=pytest.mark.slow),
    ],
)
def test_is_the_gradient_of_the_likelihood(model, kept, monkeypatch):
    """Of the capture that it was made for, and nearly of others; whether or not derivatives of tables are kept."""
    if not kept:
        monkeypatch.setattr(score, "MOST_SLOPES", 0)
    stack = like(model)
    found, summary = score_of(model, stack)
    assert all((of.slopes is not None) == kept for of in found.kept)
    expected = exact(found, summary)
    np.testing.assert_allclose(found(summary), expected, rtol=2e-3, atol=2e-3 * np.abs(expected).max())
    others = [summarise(draw_capture(key, model, stack), coding=coding_of(stack)) for key in range(4)]
    own, expected = (np.array([of(one) for one in others]) for of in (found, partial(exact, found)))
    assert np.all(np.abs(own - expected) < 0.2 * np.sqrt((expected**2).mean(0)))


@pytest.mark.slow
def test_scatters_about_zero_with_the_information_as_covariance():
    """At the parameters of the draws: the two identities of any score, to the error of 200 draws."""
    model, draws = WHITE, 200
    stack = like(model)
    found, _ = score_of(model, stack)
    coding = coding_of(stack)

    scores = np.array([found(summarise(draw_capture(i, model, stack), coding=coding)) for i in range(1, draws + 1)])
    error = scores.std(0, ddof=1) / np.sqrt(draws)
    assert np.all(np.abs(scores.mean(0)) < 4 * error)
    # Minus the mean Hessian: differences of exact gradients of a few draws.
    summaries = [summarise(draw_capture(number, model, stack), coding=coding) for number in range(1, 9)]
    step = 1e-3
    information = [
        np.mean([(exact(found, one, -step * way) - exact(found, one, step * way)) / (2 * step) for one in summaries], 0)
        for way in np.eye(len(found.centre))
    ]
    ratio = np.diagonal(np.cov(scores.T)) / np.diagonal(information)
    np.testing.assert_allclose(ratio, 1.0, atol=4 * np.sqrt(2 / draws) + 0.15)


@pytest.mark.slow
def test_flats_have_a_share_in_it():
    (darks, of_darks), (both, summary) = (score_of(ALIKE, like(ALIKE, flat_e=e)) for e in (None, 400.0))
    np.testing.assert_allclose(both(summary), exact(both, summary), rtol=2e-3, atol=0.05)
    assert np.abs(both(summary) - darks(of_darks)).max() > 0.1
