"""Normal laws of many statistics estimated from few draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # its parts are imported when they are used

HARDLY_VARIES = 0.25  # variance of z over draws


@dataclass(frozen=True)
class Gaussian:
    """Normal(mean, covariance) of statistics [statistic]."""

    mean: np.ndarray
    covariance: np.ndarray

    def factor(self) -> tuple[np.ndarray, bool]:
        return scipy.linalg.cholesky(self.covariance, lower=True), True

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log density, up to the constant that all share, of z [..., statistic]."""
        factor = self.factor()
        residual = np.atleast_2d(z) - self.mean
        square = (residual * scipy.linalg.cho_solve(factor, residual.T).T).sum(-1)
        log_determinant = 2 * np.log(np.diagonal(factor[0])).sum()
        out = -0.5 * (square + log_determinant)
        return out if np.ndim(z) > 1 else out[0]

    def standardised(self, z: np.ndarray) -> np.ndarray:
        """Each of z [statistic] less its mean, over its deviation."""
        return (z - self.mean) / np.sqrt(np.diagonal(self.covariance))

    def normal_scores(self, z: np.ndarray, groups: tuple[str, ...]) -> dict[str, float]:
        """How far z is off in each group of statistics: Wilson and Hilferty's normal score of its chi-square."""
        labels, scores = np.asarray(groups), {}
        for group in dict.fromkeys(groups):
            chosen = np.flatnonzero(labels == group)
            residual = z[chosen] - self.mean[chosen]
            part = self.covariance[np.ix_(chosen, chosen)]
            square, n = float(residual @ np.linalg.solve(part, residual)), len(chosen)
            scores[group] = float((np.cbrt(square / n) - (1 - 2 / (9 * n))) / np.sqrt(2 / (9 * n)))
        return scores


def shrunk(z: np.ndarray, slopes: np.ndarray) -> Gaussian:
    """Law of statistics whose own draws are z [draw, statistic], base parameters unknown along `slopes`.

    The covariance is shrunk to its diagonal as far as the draws are too few to tell (Ledoit and Wolf, "A
    well-conditioned estimator for large-dimensional covariance matrices", J. Multivariate Anal. 88, 2004).
    """
    n, d = z.shape
    centred = z - z.mean(0)
    sample = centred.T @ centred / n
    # Units of z are kept from vanishing: what hardly varies in the draws is not known to vary so little in captures.
    variance = np.diagonal(sample)
    sample = sample + np.diag(np.where(variance < HARDLY_VARIES, 1 - variance, 0.0))
    target = np.diag(np.diagonal(sample))
    distance = ((sample - target) ** 2).sum()
    squares = (centred**2).T @ (centred**2) / n - sample**2
    np.fill_diagonal(squares, 0.0)
    share = float(np.clip(squares.sum() / n / max(distance, 1e-30), 0.05, 1.0))
    covariance = (1 - share) * sample + share * target + 0.02 * np.eye(d) + slopes.T @ slopes
    return Gaussian(np.zeros(d), covariance)
