"""Standard errors of joint refits by simulated statistics."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.effects import RowNoise
from hsnoise.fitting.covariances import as_scattered, not_surer_than
from hsnoise.fitting.problem import Problem
from hsnoise.fitting.simulated import LAST_DRAWS, MOST_ITERATIONS, SHORT_STEP, _search, draft_synthetic
from hsnoise.likelihood.parameters import parameters_of
from hsnoise.simulation.portion import Portion
from hsnoise.simulation.simulator import Simulator
from hsnoise.statistics.structure import Structure

STATISTICS, NUMBERS = 60, 3
SLOPES = np.random.default_rng(0).standard_normal((STATISTICS, NUMBERS))


def linear_fit(prior):
    """Covariance that equal weights claim beside a prior, the way from statistics to the score, and the prior."""
    return np.linalg.inv(SLOPES.T @ SLOPES + np.diag(prior)), SLOPES.T, prior


def draws(covariance, seed):
    z = np.random.default_rng(seed).multivariate_normal(np.zeros(STATISTICS), covariance, LAST_DRAWS)
    return z - z.mean(0)


def growth_of_errors(true, prior):
    """Standard errors as draws show them over those that equal weights claim [number], mean over many fits."""
    claimed, *rest = linear_fit(prior)
    scattered = np.mean([as_scattered(claimed, *rest, draws(true, s)) for s in range(40)], 0)
    return np.sqrt(np.diagonal(scattered) / np.diagonal(claimed))


@pytest.mark.parametrize("held", [0.0, 60.0, 1e6])
def test_errors_of_right_weights_stay(held):
    """However firmly a prior holds the first number: 60 is as much as the statistics tell of it."""
    assert growth_of_errors(np.eye(STATISTICS), np.array([held, 0.0, 0.0])) == pytest.approx(1.0, abs=0.1)


def test_errors_of_few_draws_cover():
    """Pulls of estimates that scatter as the draws do, with the mean of such draws for their expectation."""
    claimed, gain, prior = linear_fit(np.zeros(NUMBERS))
    within = []
    for seed in range(1000):
        few = np.random.default_rng(seed).standard_normal((10, STATISTICS))
        error = np.sqrt(np.diagonal(as_scattered(claimed, gain, prior, few - few.mean(0))))
        measured = np.random.default_rng(10_000 + seed).standard_normal(STATISTICS)
        within.append(np.abs(claimed @ gain @ (measured - few.mean(0))) < 1.96 * error)
    assert np.mean(within) == pytest.approx(0.95, abs=4 * np.sqrt(0.05 * 0.95 / 3000))


def test_errors_of_weights_that_hide_a_correlation_are_widened():
    together = SLOPES[:, 0] / np.linalg.norm(SLOPES[:, 0])
    true = np.eye(STATISTICS) + 8.0 * np.outer(together, together)  # the first number's own direction scatters thrice
    ratio = growth_of_errors(true, np.zeros(NUMBERS))
    assert 2.4 < ratio[0] < 3.2 and np.all(ratio > 0.95)


TRUTH = hsnoise.cameras.canon_5d3().add(RowNoise(1.5))


@pytest.fixture(scope="module")
def hidden():
    """Darks with row noise, and the paper's model fitted to them."""
    exposure_s = (0.05, 0.1, 0.2, 0.4)
    counts = [
        np.asarray(hsnoise.sample_dark(jax.random.key(i), 8, (96, 160), TRUTH, exposure_s=t))
        for i, t in enumerate(exposure_s)
    ]
    stack = hsnoise.FrameStack(counts, exposure_s, black_level=0, cfa="RGGB", shutter="rolling")
    return stack, hsnoise.fit(stack)


@pytest.mark.slow
def test_only_what_the_base_fit_does_not_know_is_held_in_place(hidden):
    stack, base = hidden
    model = base.params.add(RowNoise(1.4))
    problem = Problem(Portion.of(stack), base, model, ("row_noise",), model)
    # Parameters that are known to a few per cent, whatever coordinates stand for them.
    assert np.all(problem.prior[: len(base.names)] < 1e-3)
    steps = problem.slope(problem.centre)[:, None] * problem.whiten
    np.testing.assert_allclose(steps @ steps.T, base.covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.slow
def test_base_parameters_that_the_effect_had_moved_come_back(hidden):
    stack, base = hidden
    assert abs(base.table["row_gain.sigma.B"][0] - 0.114) > 0.03  # the row noise passes for row gain
    fit = draft_synthetic(base, Portion.of(stack), base.params.add(RowNoise(1.4))).finished()
    for name, (value, _, _) in TRUTH.table.items():
        found, error, _ = fit.table[name]
        assert abs(found - value) <= 4 * error, f"{name}: {found} +- {error}, truth {value}"


@pytest.mark.parametrize(
    ("effect", "label"),
    [
        (fx.Crosstalk(0.25), "crosstalk.fraction"),  # at its upper bound
        (fx.AmplifierGlow(10.0, 0.3, row=0.5), "amplifier_glow.row"),
        (fx.HotPixels(0.004, 300.0), "hot_pixels.fraction"),
        (fx.Nonlinearity(1e-5), "nonlinearity.curvature"),  # tiny in its unit
    ],
)
def test_a_step_of_a_number_moves_it_by_a_share_of_itself_or_its_range(effect, label):
    model = hsnoise.cameras.grasshopper3().add(effect)
    parameters = parameters_of(model, (effect.name,))
    x, i = parameters.read(model), parameters.names.index(label)
    start, ahead = (float(parameters.values(x + step)[i]) for step in (0.0, 0.2))
    assert 0.002 < (ahead - start) / (start or 1.0) < 0.3
    difference = (parameters.values(x + 1e-6) - parameters.values(x - 1e-6)) / 2e-6
    np.testing.assert_allclose(parameters.slope(x), difference, rtol=1e-3)


@pytest.mark.parametrize("start", [0.0, 0.004, 0.5])
def test_an_exponent_moves_as_far_from_any_start(start):
    model = hsnoise.cameras.canon_5d3().add(RowNoise(1.0, start))
    parameters = parameters_of(model, ("row_noise",))
    x, i = parameters.read(model), parameters.names.index("row_noise.exponent")
    assert float(parameters.values(x + 0.2)[i] - parameters.values(x)[i]) == pytest.approx(0.2)


def test_what_an_effect_holds_is_not_moved():
    model = hsnoise.cameras.grasshopper3().add(fx.PeriodicBanding(1.0, 0.2))
    assert parameters_of(model, ("periodic_banding",)).names == ("periodic_banding.amplitude",)
    edge = hsnoise.cameras.grasshopper3().add(fx.AmplifierGlow(10.0, 0.3, row=0.5, column=1.0))
    moved = tuple(f"amplifier_glow.{name}" for name in ("rate", "scale", "row", "aspect"))
    assert parameters_of(edge, ("amplifier_glow",)).names == moved


class Bent:
    """A problem whose statistics are arcs of the first number: Newton's steps from far away lead further away."""

    centre, other_start = np.zeros(0), None
    start, truth, prior = np.array([2.5, 0.3]), np.array([0.2, -0.1]), np.full(2, 1e-6)

    def at(self, y):
        return y

    def share_of(self, step):
        return 1.0


class Arcs(Simulator):
    """Draws of it: a model is y itself."""

    def _draw(self, y, number, shared=None):
        noise = np.random.default_rng(number).standard_normal(40)
        values = 30 * np.repeat([np.arctan(y[0]), y[1]], 20) + noise
        return Structure(("",) * 40, ("",) * 40, values, np.full(40, 0.3), ())

    @property
    def measured(self):
        return self._draw(Bent.truth, 999)


def test_a_step_that_leads_away_is_taken_back():
    problem = Bent()
    draft = _search(problem, Arcs(None, None, None))
    y, covariance = draft.after_last_step()
    assert draft.last_step < SHORT_STEP and draft.iterations < MOST_ITERATIONS
    assert np.all(np.abs(y - problem.truth) < 4 * np.sqrt(np.diagonal(covariance)))
    assert np.all(np.sqrt(np.diagonal(covariance)) < 0.05)


class Plain(Bent):
    """A problem of two numbers and 120 statistics, of which twenty depend on them."""

    start, truth = np.array([0.5, -0.5]), np.zeros(2)


class Rough(Simulator):
    """Draws of it, whose noise changes with the numbers: slopes between two draws are noisy."""

    def _draw(self, y, number, shared=None):
        one, other = np.random.default_rng(number).standard_normal((2, 120))
        angle = 3 * np.sum(y)
        values = np.repeat([3 * y[0], 3 * y[1], 0.0], [10, 10, 100]) + np.cos(angle) * one + np.sin(angle) * other
        return Structure(("",) * 120, ("",) * 120, values, np.full(120, 0.3), ())

    @property
    def measured(self):
        return self._draw(Plain.truth, self.key)


@pytest.mark.slow
def test_noise_of_slopes_is_not_taken_for_information():
    found = [_search(Plain(), Rough(None, None, 10_000 + number)).after_last_step() for number in range(100)]
    pulls = np.array([(y - Plain.truth) / np.sqrt(np.diagonal(covariance)) for y, covariance in found])
    assert 0.9 < np.sqrt(np.mean(pulls**2)) < 1.2  # 200 pulls: 1 +- 0.05, and their errors are from 32 draws


def test_what_a_line_fit_does_not_know_stays_unknown():
    covariance = not_surer_than(np.diag([4.0, np.inf]), np.eye(3))
    np.testing.assert_allclose(np.diagonal(covariance), [4.0, np.inf, 4.0])
    assert not np.isnan(covariance).any()
