"""Codes of unequal width: measured from the histogram of counts, drawn, and told from what resembles them."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
import hsnoise.effects as fx
from hsnoise.statistics.pixels.comb import comb_of, histogram_of

SHAPE, FRAMES, READ_E, GAIN = (160, 200), 8, 4.0, 2.0


def pattern(rng, period, sigma):
    errors = rng.standard_normal(period)
    return sigma * (errors - errors.mean()) / errors.std()


def converted(signal, errors):
    """Counts of a converter whose code k is 1 + errors[k % period] wide."""
    ends, turns = np.cumsum(1 + errors), np.floor(signal / len(errors))
    code = np.searchsorted(ends[:-1], signal - turns * len(errors), side="right")
    return (turns * len(errors) + code).astype(np.uint16)


def found_in(*captures):
    return comb_of([of for counts in captures if (of := histogram_of(counts, np.inf)) is not None])


@pytest.mark.parametrize(("period", "sigma", "noise"), [(4, 0.05, 6), (4, 0.05, 40), (8, 0.05, 20), (32, 0.1, 100)])
def test_widths_are_measured_within_their_errors(period, sigma, noise):
    pulls = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        errors = pattern(rng, period, sigma)
        found = found_in(converted(rng.normal(500.3, noise, 1_000_000), errors))
        assert len(found.errors) == period
        assert np.corrcoef(found.errors, errors)[0, 1] > 0.95
        pulls.append((found.sigma - sigma) / found.error)
    assert 0.3 < np.sqrt(np.mean(np.square(pulls))) < 1.8


def draws(scale=1.0):
    return scale * np.random.default_rng(3).standard_normal((FRAMES, *SHAPE))


def of_pixels(kind):
    rng = np.random.default_rng(4)
    return {
        "log-normal": 8 * rng.lognormal(0, 1, SHAPE),
        "two kinds": np.where(rng.random(SHAPE) < 0.3, 50, 0),
        "whole offsets": np.rint(30 * rng.standard_normal(SHAPE)),
        "hot": np.where(rng.random(SHAPE) < 0.02, 300 * rng.random(SHAPE), 0),
    }[kind]


@pytest.mark.parametrize(
    "counts",
    [
        300 + draws(8),
        *(300 + draws(8) + of_pixels(kind) for kind in ("log-normal", "two kinds", "whole offsets", "hot")),
        np.maximum(draws(20), 0),
        4 * np.rint(300 + draws(8)),  # shifted
        1.3 * np.rint(300 + draws(8)),  # stretched: codes are left out
        0.75 * np.rint(300 + draws(8)),  # squeezed: a period of three codes
        50 + 1.9 * np.random.default_rng(0).poisson(8, (FRAMES, *SHAPE)) + draws(0.5),  # single electrons
        50 + draws(0.6),  # a few codes
    ],
)
def test_nothing_else_is_taken_for_one(counts):
    assert found_in(np.rint(counts).astype(np.uint16)) is None


@pytest.fixture(scope="module")
def capture():
    """Darks of pixels that all differ, of a simulator of NumPy alone, and the errors of its codes."""
    rng = np.random.default_rng(0)
    errors, exposures_s = pattern(rng, 4, 0.08), (0.01, 1.0, 4.0)
    rate = 30 * rng.lognormal(0, 0.4, SHAPE)
    counts = []
    for t in exposures_s:
        electrons = rng.poisson(rate * t, (FRAMES, *SHAPE)) + READ_E * rng.standard_normal((FRAMES, *SHAPE))
        counts.append(converted(200.5 + GAIN * electrons, errors))
    return hsnoise.FrameStack(counts, exposures_s, shutter="global"), errors


def test_a_fit_measures_them_and_draws_them(capture, tmp_path):
    stack, errors = capture
    fit = hsnoise.fit(stack)
    effect = fit.params["adc_nonuniformity"]
    assert effect.period == 4 and np.corrcoef(effect.pattern, errors)[0, 1] > 0.99
    assert abs(float(effect.sigma) - 0.08) < 4 * fit.table["adc_nonuniformity.sigma"][1]
    with_them, without = (
        hsnoise.compare(of, stack, seed=1) for of in (fit.params, fit.params.remove("adc_nonuniformity"))
    )
    assert with_them.groups["codes"] < 2 < without.groups["codes"]
    fit.params.save(tmp_path / "model.json")
    assert hsnoise.NoiseModel.load(tmp_path / "model.json")["adc_nonuniformity"].pattern == effect.pattern


def test_the_pattern_is_what_is_drawn():
    errors = np.array([0.3, -0.1, -0.4, 0.2])
    model = hsnoise.NoiseModel(
        [fx.ReadNoise(30.0), fx.Gain(1.0), fx.BlackLevel(1000.0), fx.AdcNonuniformity(0.25, 4, errors), fx.ADC()],
        cfa="mono",
        shutter="global",
        exposure_s=1.0,
    )
    counts = np.asarray(hsnoise.sample(0, np.zeros((400, 500)), model))
    share = np.bincount(counts.ravel() % 4) / counts.size * 4 - 1
    np.testing.assert_allclose(share, 0.25 * errors / errors.std(), atol=5 * 2 / np.sqrt(counts.size))


@pytest.mark.parametrize(
    "wrong", [(1.0, 2.0), (1.0, 1.0, 1.0, 1.0), (1.0, float("nan"), 2.0, 3.0), "abcd", (True, 2, 3, 4)]
)
def test_a_wrong_pattern_is_named(wrong):
    with pytest.raises(ValueError, match=r"adc_nonuniformity.pattern: expected 4 finite numbers"):
        fx.AdcNonuniformity(0.1, 4, wrong)


def test_a_pattern_of_one_exposure_is_not_the_converters():
    """Half counts of a level that was scaled by a tenth round to even codes."""
    rng = np.random.default_rng(8)
    levels = [rng.normal(level, 12, (4, *SHAPE)) for level in (300, 800, 1500)]
    scaled = 9000 + 0.1 * np.rint(rng.normal(0, 60, (4, *SHAPE)))
    assert found_in(np.rint(scaled).astype(np.uint16)) is not None
    assert found_in(*(np.rint(level).astype(np.uint16) for level in levels), np.rint(scaled).astype(np.uint16)) is None
