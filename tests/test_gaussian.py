"""Normal distributions of statistics, estimated from few draws."""

from __future__ import annotations

import numpy as np
import pytest

from hsnoise.simulation.gaussian import JITTER, LEAST_SHRINKAGE, Gaussian, shrunk, shrunk_covariance

STATISTICS = 6
TRUE = 0.5 * np.eye(STATISTICS) + 0.5
OFF_DIAGONAL = ~np.eye(STATISTICS, dtype=bool)


def draws(number: int, seed: int = 3) -> np.ndarray:
    """Draws [draw, statistic] of unit variance, each two of correlation 0.5."""
    return np.random.default_rng(seed).standard_normal((number, STATISTICS)) @ np.linalg.cholesky(TRUE).T


def stated_share(z: np.ndarray) -> float:
    """Ledoit and Wolf's share of the target, term by term: sum of var(s_ij) over sum of s_ij^2, off the diagonal.

    The target is the diagonal: Schaefer and Strimmer, Stat. Appl. Genet. Mol. Biol. 4, 2005, target D.
    """
    n, centred = len(z), z - z.mean(0)
    variances = squares = 0.0
    for i in range(z.shape[1]):
        for j in range(z.shape[1]):
            if i != j:
                products = centred[:, i] * centred[:, j]
                variances += np.mean((products - products.mean()) ** 2) / n
                squares += products.mean() ** 2
    return variances / squares


def test_the_covariance_of_many_draws_is_theirs():
    z = draws(20_000)
    found = shrunk_covariance(z)
    assert stated_share(z) < LEAST_SHRINKAGE
    sample = np.cov(z.T, bias=True)
    np.testing.assert_allclose(found[OFF_DIAGONAL], (1 - LEAST_SHRINKAGE) * sample[OFF_DIAGONAL], rtol=1e-9)
    np.testing.assert_allclose(np.diagonal(found), np.diagonal(sample) + JITTER, rtol=1e-9)
    np.testing.assert_allclose(found, TRUE, atol=0.06)


@pytest.mark.parametrize("number", [12, 24, 40])
def test_the_covariance_of_few_draws_lies_between_it_and_its_diagonal(number):
    z = draws(number)
    share = stated_share(z)
    assert LEAST_SHRINKAGE < share < 1
    found, sample = shrunk_covariance(z), np.cov(z.T, bias=True)
    np.testing.assert_allclose(found[OFF_DIAGONAL], (1 - share) * sample[OFF_DIAGONAL], rtol=1e-9)
    np.testing.assert_allclose(np.diagonal(found), np.diagonal(sample) + JITTER, rtol=1e-9)
    assert np.linalg.eigvalsh(found).min() > 0


def test_draws_that_tell_nothing_of_correlations_leave_the_diagonal():
    z = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    np.testing.assert_allclose(shrunk_covariance(z), (1 + JITTER) * np.eye(2))


@pytest.mark.parametrize("number", [8, 24, 64])
def test_shrunk_is_closer_to_the_truth_than_draws_or_diagonal_alone(number):
    """Of many statistics, of which each goes with one other."""
    true = np.kron(np.eye(20), [[1.0, 0.8], [0.8, 1.0]])
    rng, errors = np.random.default_rng(number), np.zeros(3)
    for _ in range(10):
        z = rng.standard_normal((number, len(true))) @ np.linalg.cholesky(true).T
        sample = np.cov(z.T, bias=True)
        tried = (shrunk_covariance(z), sample, np.diag(np.diagonal(sample)))
        errors += [((one - true)[~np.eye(len(true), dtype=bool)] ** 2).sum() for one in tried]
    assert errors[0] < errors[1:].min()


def test_what_hardly_varies_in_the_draws_is_not_known_to():
    z = draws(64)
    z[:, 0] *= 0.1
    assert shrunk_covariance(z)[0, 0] == pytest.approx(1 + JITTER)


def test_base_parameters_that_are_unknown_widen_it_along_their_slopes():
    z, slopes = draws(64), np.arange(2.0 * STATISTICS).reshape(2, STATISTICS)
    found = shrunk(z, slopes)
    np.testing.assert_allclose(found.covariance, shrunk_covariance(z) + slopes.T @ slopes)
    assert not found.mean.any()


def test_densities_and_scores_of_a_normal_distribution():
    exact = Gaussian(np.zeros(6), np.eye(6))
    assert exact.log_density(np.ones(6)) == pytest.approx(-3.0)
    assert abs(exact.normal_scores(np.ones(6), ("a",) * 6)["a"]) < 1
