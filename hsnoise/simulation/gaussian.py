"""Normal distributions of many statistics, estimated from few draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # its parts are imported when they are used

HARDLY_VARIES = 0.25  # variance of z over draws
LEAST_SHRINKAGE = 0.05  # of a covariance toward its diagonal
JITTER = 0.02  # variance added to each z, so that no combination of statistics has none
FLOOR_DRAWS = 6.0  # the analytic error counts as this many draws
FAR_OFF = 5.0  # deviations from which a statistic counts less


@dataclass(frozen=True)
class Gaussian:
    """Normal(mean, covariance) of statistics [statistic]."""

    mean: np.ndarray
    covariance: np.ndarray

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log density, up to the constant that all share, of z [..., statistic]."""
        factor = np.linalg.cholesky(self.covariance)  # unlike SciPy's, it lets other threads work
        residual = np.atleast_2d(z) - self.mean
        white = scipy.linalg.solve_triangular(factor, residual.T, lower=True, check_finite=False)
        out = -0.5 * (white**2).sum(0) - np.log(np.diagonal(factor)).sum()
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
    """Distribution of statistics whose draws are z [draw, statistic], base parameters unknown along `slopes`."""
    return Gaussian(np.zeros(z.shape[1]), shrunk_covariance(z) + slopes.T @ slopes)


def kept_variance(z: np.ndarray) -> np.ndarray:
    """Variance [statistic] of draws z [draw, statistic], kept from vanishing.

    What hardly varies in the draws is not known to vary so little in captures.
    """
    variance = z.var(0)
    return np.where(variance < HARDLY_VARIES, 1.0, variance)


def shrunk_covariance(z: np.ndarray) -> np.ndarray:
    """Covariance [statistic, statistic] of draws z [draw, statistic], shrunk toward its diagonal.

    The fewer the draws, the more it is shrunk (Ledoit and Wolf, "A well-conditioned estimator for large-dimensional
    covariance matrices", J. Multivariate Anal. 88, 2004), by LEAST_SHRINKAGE at least.
    """
    n, d = z.shape
    centred = z - z.mean(0)
    sample = centred.T @ centred / n
    np.fill_diagonal(sample, kept_variance(z))
    target = np.diag(np.diagonal(sample))
    distance = ((sample - target) ** 2).sum()
    squares = (centred**2).T @ (centred**2) / n - sample**2
    np.fill_diagonal(squares, 0.0)
    share = float(np.clip(squares.sum() / n / max(distance, 1e-30), LEAST_SHRINKAGE, 1.0))
    return (1 - share) * sample + share * target + JITTER * np.eye(d)


def share_of_far(z: np.ndarray) -> np.ndarray:
    """Square roots of Huber's weights of deviations z: what is far off counts less."""
    return np.sqrt(np.minimum(1.0, FAR_OFF / np.maximum(np.abs(z), 1e-12)))


def floored_variance(variance: np.ndarray, dof: int, floor: np.ndarray) -> np.ndarray:
    """Variance of statistics over draws, `dof` degrees of freedom, kept from vanishing by an analytic one, `floor`."""
    return (dof * variance + FLOOR_DRAWS * floor) / (dof + FLOOR_DRAWS)
