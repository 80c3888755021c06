"""Pixel transfer: the gain from darks whose pixels differ, from the variance of single pixels over time.

The mean level m[c, e] and the temporal variance v[c, e] of class c in exposure e obey

    v[c, e] = a[c] + K (m[c, e] - m0[c] - p[e]) + K (F - 1) x[c, e],

where m0[c] is the level without signal, a[c] the variance there, p[e] the shift of the exposure's pedestal (known as
well as its frames agree), x[c, e] the signal of hot pixels beyond that of ordinary ones (0 for these), and F the Fano
factor of hot pixels. A pedestal moves all classes alike, so pixels of different growth determine the gain whatever the
pedestal does. Weighted least squares: the equation is linear in a, K, K p and K F.

Hot pixels may be sub-Poisson (F from 1 to 0.5: a generation centre emits a hole, then an electron). The prior puts half
its weight on F = 1 and spreads the other half evenly over 0.5 to 1, so hot pixels count only as far as ordinary pixels
confirm them.

Reference: photon transfer, Janesick 2007; equations in docs/likelihood.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hsnoise.statistics.pixels.classes import Classes

ROUNDS = 12
ALIKE = (0.03, 0.1, 0.3, 1.0)  # of the variance without signal: how much classes may differ in it
OFF_LINE, NEARER = 1.3, 0.9  # chi2 per degree of freedom that is too large, and the share to which it must then fall
LOOSE_DN = 1e4  # standard deviation of an unknown pedestal
MOVED = 3.5  # standard errors beyond which a pedestal has moved
FANO = np.concatenate([[1.0], np.linspace(0.5, 1.0, 101)])
FANO_PRIOR = np.concatenate([[0.5], np.full(101, 0.5 / 101)])
ROUNDING = 1 / 12  # DN^2


@dataclass(frozen=True)
class Transfer:
    """Pixel transfer of one channel; standard errors are widened if chi2 exceeds its degrees of freedom.

    Attributes:
        values, covariance: gain (DN/e-), variance without signal (DN^2, pixels' mean, with rounding), and mean
            growth of ordinary pixels (DN/s).
        ordinary_gain, ordinary_error: DN/e-, from ordinary pixels alone.
        hot_gain, hot_error: K F from hot pixels alone, DN/e-; NaN without any.
        fano, fano_error: Fano factor of hot pixels, NaN without any.
        chi2, dof: of the fit.
        pedestal_dn, pedestal_error_dn [exposure]: shift of the pedestals.
        moved [exposure]: whether they moved by more than the scatter of their frames.
        fitted_dn2 [class, exposure]: the variance that the fit expects.
    """

    classes: Classes
    values: np.ndarray
    covariance: np.ndarray
    ordinary_gain: float
    ordinary_error: float
    hot_gain: float
    hot_error: float
    fano: float
    fano_error: float
    chi2: float
    dof: float
    pedestal_dn: np.ndarray
    pedestal_error_dn: np.ndarray
    moved: np.ndarray
    fitted_dn2: np.ndarray

    @property
    def gain(self) -> float:
        return float(self.values[0])

    @property
    def gain_error(self) -> float:
        return float(np.sqrt(self.covariance[0, 0]))


@dataclass(frozen=True)
class _Places:
    """Indices of the parameters: common variance, K, K F, each class's own share, K p [exposure]."""

    classes: int
    exposures: int
    common: int = 0
    gain: int = 1
    hot_gain: int = 2

    @property
    def number(self) -> int:
        return 3 + self.classes + self.exposures

    def own(self, c):
        return 3 + c

    def pedestal(self, e):
        return 3 + self.classes + e


@dataclass(frozen=True)
class _Line:
    """The least squares fit: parameters, their covariance, chi2, fitted variances [class, exposure]."""

    places: _Places
    theta: np.ndarray
    covariance: np.ndarray
    chi2: float
    dof: float
    fitted: np.ndarray
    has_hot: bool
    off: float


def pixel_transfer(classes: Classes) -> Transfer | None:
    """The gain of one channel; None where too few classes can be measured."""
    sigma, loose = classes.pedestal_sigma_dn.copy(), np.full(len(classes.exposure_s), LOOSE_DN)
    alike, line = ALIKE[0], _line(classes, sigma, ALIKE[0])
    if line is None:
        return None
    for wider in ALIKE[1:]:  # pixels also differ in read noise; allow as much as improves the fit
        other = _line(classes, sigma, wider)
        if line.chi2 < OFF_LINE * line.dof or other is None or other.chi2 > NEARER * line.chi2:
            break
        alike, line = wider, other
    free = _line(classes, loose, alike)
    if free is None:
        return None
    moved = np.zeros(len(sigma), bool)
    stays = np.arange(len(sigma)) == classes.exposure_s.argmin()  # shifts are relative to the shortest exposure
    chance = max(free.chi2 / free.dof, 1.0)
    while line.off - free.off > MOVED**2 * chance and not (moved | stays).all():
        shift = line.theta[line.places.pedestal(np.arange(len(sigma)))]
        worst = int(np.argmax(np.where(moved | stays, -1.0, np.abs(shift) / np.maximum(sigma, 1e-9))))
        moved[worst], sigma[worst] = True, LOOSE_DN
        line = _line(classes, sigma, alike)
    return _told(classes, line, moved)


def _signals(classes: Classes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Dark signal [class, exposure], the part that hot pixels have beyond ordinary ones, their extra offset [class].

    DN; the signal of the shortest exposure is extrapolated from the growth. Offsets of hot pixels may be charge.
    """
    weight = classes.pixels * ~classes.hot
    t = classes.exposure_s
    first = t.min() * classes.growth_dn_per_s
    signal = classes.level_dn - classes.level_dn[:, [int(t.argmin())]] + first[:, None]
    offset = classes.level_dn[:, int(t.argmin())] - first
    weight = weight / max(weight.sum(), 1)
    hot = np.where(classes.hot[:, None], signal - weight @ signal, 0.0)
    return signal, hot, np.where(classes.hot, np.abs(offset - weight @ offset), 0.0)


def _line(classes: Classes, sigma_dn: np.ndarray, alike: float) -> _Line | None:
    use = np.isfinite(classes.error_dn2)
    use &= use.sum(1, keepdims=True) > 1
    has_hot, has_ordinary = (bool((of & use.any(1)).any()) for of in (classes.hot, ~classes.hot))
    c, e = np.nonzero(use)
    free = 1 + has_hot + has_ordinary
    if not has_ordinary or len(c) <= free:
        return None
    places = _Places(*classes.level_dn.shape)
    signal, hot, offset = _signals(classes)
    design, at = np.zeros((len(c), places.number)), np.arange(len(c))
    design[:, places.common] = 1
    design[at, places.own(c)] = 1
    design[at, places.gain] = (signal - hot)[c, e]
    design[at, places.hot_gain] = hot[c, e]
    design[at, places.pedestal(e)] = -1
    design[:, places.pedestal(int(classes.exposure_s.argmin()))] += 1  # signals are relative to the shortest exposure
    y, relative = classes.variance_dn2[c, e], (classes.error_dn2 / classes.variance_dn2)[c, e]
    expected, gain, floor = y.copy(), 0.0, float(np.median(y))
    for _ in range(ROUNDS):
        weight = 1 / (relative * expected)
        deviation = np.full(places.number, np.inf)
        deviation[places.own(np.arange(len(use)))] = np.hypot(alike * floor, abs(gain) * offset)
        deviation[places.pedestal(np.arange(use.shape[1]))] = max(abs(gain), 1e-6) * np.maximum(sigma_dn, 1e-6)
        if not has_hot:
            deviation[places.hot_gain] = 1.0
        weighted = design * weight[:, None]
        normal = weighted.T @ weighted + np.diag(deviation**-2.0)
        theta = np.linalg.solve(normal, weighted.T @ (weight * y))
        expected = np.maximum(design @ theta, 0.2 * y)
        gain, floor = theta[places.gain], theta[places.common]
    covariance = np.linalg.inv(normal)
    dof = max(len(y) - float(np.einsum("ij,ji->", covariance, weighted.T @ weighted)), 1.0)
    chi2 = float((((y - design @ theta) * weight) ** 2).sum())
    fitted = np.full(use.shape, np.nan)
    fitted[c, e] = design @ theta
    return _Line(
        places,
        theta,
        covariance * max(chi2 / dof, 1.0),
        chi2,
        dof,
        fitted,
        has_hot,
        chi2 + float(((theta / deviation) ** 2).sum()),
    )


def _told(classes: Classes, line: _Line, moved: np.ndarray) -> Transfer:
    places, t, theta = line.places, classes.exposure_s, line.theta
    k, exposures = theta[places.gain], np.arange(len(t))
    slopes = (t - t.mean()) / ((t - t.mean()) @ (t - t.mean()))
    shift = theta[places.pedestal(exposures)] / k
    turn = np.zeros((3, places.number))
    turn[0, places.gain] = 1
    share = classes.pixels * np.isfinite(classes.error_dn2).any(1)
    turn[1, places.common] = 1
    turn[1, places.own(np.arange(len(share)))] = share / share.sum()
    turn[1, places.pedestal(exposures)] = t.min() * slopes  # the signal of the shortest exposure holds their slope
    turn[2, places.pedestal(exposures)] = -slopes / k
    turn[2, places.gain] = slopes @ shift / k
    ordinary = classes.pixels * ~classes.hot
    growth = float(ordinary / ordinary.sum() @ classes.growth_dn_per_s)
    values = np.array([k, turn[1] @ theta, growth - slopes @ shift])
    covariance, fano = turn @ line.covariance @ turn.T, (np.nan, np.nan)
    pair = np.ix_(*[[places.gain, places.hot_gain]] * 2)
    both = theta[[places.gain, places.hot_gain]], line.covariance[pair]
    if line.has_hot:
        values, covariance, fano = _with_fano(values, covariance, *both)
    errors = np.sqrt(np.diagonal(line.covariance))
    return Transfer(
        classes=classes,
        values=values,
        covariance=covariance,
        ordinary_gain=float(k),
        ordinary_error=float(errors[places.gain]),
        hot_gain=float(both[0][1]) if line.has_hot else np.nan,
        hot_error=float(errors[places.hot_gain]) if line.has_hot else np.nan,
        fano=fano[0],
        fano_error=fano[1],
        chi2=line.chi2,
        dof=line.dof,
        pedestal_dn=shift,
        pedestal_error_dn=errors[places.pedestal(exposures)] / abs(k),
        moved=moved,
        fitted_dn2=line.fitted,
    )


def _with_fano(values, covariance, pair, pair_covariance):
    """Values and covariance averaged over F in 0.5 to 1, and F with its standard deviation.

    pair, pair_covariance: K from ordinary pixels and K F from hot ones.
    """
    inverse = np.linalg.inv(pair_covariance)
    along = np.stack([np.ones_like(FANO), FANO], 1)
    information = np.einsum("fi,ij,fj->f", along, inverse, along)
    gain = along @ inverse @ pair / information
    log_evidence = 0.5 * information * gain**2 - 0.5 * np.log(information)
    weight = FANO_PRIOR * np.exp(log_evidence - log_evidence.max())
    weight /= weight.sum()
    mean = float(weight @ gain)
    variance = float(weight @ (1 / information + (gain - mean) ** 2))
    fano = float(weight @ FANO)
    # The other values follow the gain along their covariance with it.
    follow = covariance[:, 0] / covariance[0, 0]
    moved = values + follow * (mean - values[0])
    new = covariance + np.outer(follow, follow) * (variance - covariance[0, 0])
    return moved, new, (fano, float(np.sqrt(weight @ (FANO - fano) ** 2)))
