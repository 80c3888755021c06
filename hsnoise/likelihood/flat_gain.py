"""The gain from flats alone: photon transfer with a response that may bend.

Variance over signal is the gain where the response is straight. Where it bends it is a smooth curve of the signal,

    V(S) = V_read + K0 S (1 + a1 x + a2 x^2),   x = S / full scale.

A response g(e) with differential gain K = dg/de has the variance K^2 e, so that the gain enters twice: a response that
falls 2 % short at full scale takes 6 % off V / S there. `local_gain` turns the curve of the variance into that of the
differential gain: K^2 e = r S with r = V / S is a differential equation for e(S), solved by a quadrature,
sqrt(e) = 1/2 integral of dS / sqrt(r S).

Real sensors often deviate from any smooth curve by more than chance (steps between gain stages, processing in the
camera). If no curve describes the levels, none is extrapolated: the gain is then that of EMVA 1288's line through all
levels up to 70 % of saturation, weighted by signal, and its error is the disagreement of the levels.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy  # its parts are imported when they are used

from hsnoise.likelihood.flats import FlatMoments

MOST_DEGREES = 2  # of the curve
SIGNIFICANT = 0.002  # p-value below which the curve has one more degree
UNSEEN_SIGMAS = 2.0  # likewise, from which it adds to the error of the gain
ADEQUATE = 3.0  # chi2 per degree of freedom up to which a curve describes the levels,
RARE = 0.02  # or, of few degrees of freedom, the chance of more
LEAST_RANGE = 0.5  # share of the signal range that levels must span after the highest are left out
FEWEST_LEVELS = 4  # likewise
LINE_RANGE = 0.7  # of saturation: EMVA 1288, release 4, section 6.6
NARROW_DN2 = 0.25  # variance, rounding included, below which rounding depends on where the mean lies between counts
PAST_PEAK, STEEP = 0.05, 0.1  # saturation: the variance falls by more than this, from its peak or anywhere
LEAST_SIGMAS = 3.0  # by which a level's variance must exceed that of the darks


class FlatGain(NamedTuple):
    """Gain of flats, DN/e-, and the curve of their variance. Arrays are [channel] unless stated.

    gain: at low signal if `described`, that is if a straight line or a curve describes the levels, else that of EMVA
    1288's line. standard_error includes the scatter of levels beyond chance, and a bend that is not quite significant.
    bend, bend_error [channel, 2]: a1 and a2, 0 if not significant; full_scale_dn: the signal where x is 1. chi2, dof:
    of the curve, with chance errors.
    used [level, channel]: the levels that determine the gain. level_gain, level_error [level, channel]: variance over
    signal and its chance error, NaN without signal. signal_dn [level, channel].
    weight [level, channel]: degrees of freedom with which the levels' variances give this gain with this error.
    """

    gain: np.ndarray
    standard_error: np.ndarray
    bend: np.ndarray
    bend_error: np.ndarray
    full_scale_dn: np.ndarray
    chi2: np.ndarray
    dof: np.ndarray
    described: np.ndarray
    used: np.ndarray
    level_gain: np.ndarray
    level_error: np.ndarray
    signal_dn: np.ndarray
    weight: np.ndarray


OF_LEVELS = ("used", "level_gain", "level_error", "signal_dn", "weight")  # [level, channel]


class _Levels(NamedTuple):
    """One channel, sorted by signal: signal, variance above that of the darks and its chance error; all [level]."""

    signal: np.ndarray
    excess: np.ndarray
    error: np.ndarray


class _Curve(NamedTuple):
    """Coefficients K0, K0 a1, ... [degree + 1], their covariance by chance, chi2 and its degrees of freedom."""

    coefficients: np.ndarray
    covariance: np.ndarray
    chi2: float
    dof: int

    @property
    def scale(self) -> float:
        """Factor on errors: the scatter beyond chance, never below 1."""
        return float(np.sqrt(max(self.chi2 / max(self.dof, 1), 1.0)))

    @property
    def described(self) -> bool:
        by_chance = scipy.stats.chi2.isf(RARE, self.dof) if self.dof else 0.0
        return self.chi2 <= max(ADEQUATE * max(self.dof, 1), by_chance)


def flat_gain(flats, black_dn=None, read_variance_dn2=None, read_variance_error_dn2=0.0) -> FlatGain:
    """Gain from the photon transfer of flats.

    Args:
        flats: FlatMoments, or a Summary that holds them.
        black_dn: mean count without light, [channel], or [level, channel] of darks of the levels' own exposures; None:
            as `flats` measured it on darks.
        read_variance_dn2: temporal variance of those darks as measured, rounding included; same shapes; None likewise.
        read_variance_error_dn2: its standard error, where it is given.

    The gain is NaN and its error infinite if no level has more variance than the darks, or the darks are unknown.
    """
    flats = flats if isinstance(flats, FlatMoments) else flats.flats
    shape = flats.mean_dn.shape
    black_dn = flats.dark_dn if black_dn is None else black_dn
    if read_variance_dn2 is None:
        read_variance_dn2, read_variance_error_dn2 = flats.dark_variance_dn2, flats.dark_error_dn2
    black, read, read_error = (
        np.broadcast_to(x, shape) for x in (black_dn, read_variance_dn2, read_variance_error_dn2)
    )
    channels = [_of_channel(flats, c, black[:, c], read[:, c], read_error[:, c]) for c in range(shape[1])]
    columns = dict(zip(FlatGain._fields, zip(*channels, strict=True), strict=True))
    return FlatGain(**{name: np.stack(x, axis=-1 if name in OF_LEVELS else 0) for name, x in columns.items()})


def _of_channel(flats: FlatMoments, c: int, black, read, read_error):
    """The fields of FlatGain for one channel."""
    signal = flats.mean_dn[:, c] - black
    excess, error = _excess(flats, c, signal, read, read_error)
    order, levels = _usable(signal, excess, error, flats.variance_dn2[:, c])
    none, nothing = np.zeros(len(signal), bool), np.full(len(signal), np.nan)
    if not len(order):
        zeros = np.zeros(MOST_DEGREES)
        return np.nan, np.inf, zeros, zeros, np.nan, 0.0, 0, False, none, nothing, nothing, signal, 1.0 * none
    full_scale = float(levels.signal[-1])
    n, curve = _longest(levels, full_scale)
    if curve.described:
        gain, standard_error = curve.coefficients[0], np.sqrt(curve.covariance[0, 0]) * curve.scale
        standard_error = np.hypot(standard_error, _unseen_bend(_Levels(*(x[:n] for x in levels)), full_scale, curve))
        share = (levels.signal[:n] / levels.error[:n]) ** 2
    else:
        n = max(int((levels.signal <= LINE_RANGE * full_scale).sum()), min(len(order), 2))
        gain, standard_error = _line(levels, n)
        by_chance = 1 / np.sqrt(np.sum((levels.signal[:n] / levels.error[:n]) ** 2))
        standard_error = np.hypot(standard_error, by_chance)  # two levels may agree by chance
        curve = curve._replace(coefficients=curve.coefficients[:1])
        share = levels.signal[:n] ** 2
    bend, bend_error = np.zeros(MOST_DEGREES), np.zeros(MOST_DEGREES)
    degree = len(curve.coefficients) - 1
    bend[:degree] = curve.coefficients[1:] / gain
    bend_error[:degree] = np.sqrt(np.diagonal(curve.covariance)[1 : degree + 1]) * curve.scale / gain
    used, weight = none, 0 * signal
    used[order[:n]] = True
    lit = np.where(signal > 0, signal, np.nan)
    # With `weight` degrees of freedom a level adds weight / 2 (K S / V)^2 to the information on log K.
    variance = flats.variance_dn2[order[:n], c]
    above = variance / (variance - read[order[:n]])
    weight[order[:n]] = 2 * (above * gain / standard_error) ** 2 * share / share.sum()
    fit = gain, standard_error, bend, bend_error, full_scale, curve.chi2, curve.dof, curve.described
    return *fit, used, excess / lit, error / lit, signal, weight


def _excess(flats: FlatMoments, c: int, signal, read, read_error) -> tuple[np.ndarray, np.ndarray]:
    """Variance above that of the darks at a row gain of 1 [level], DN^2, and its chance error."""
    variance = flats.variance_dn2[:, c]
    excess = (variance - read) / (1 + row_gain_variance(flats, signal, c))
    return excess, np.hypot(variance * np.sqrt(2 / flats.dof[:, c]), read_error)


def _usable(signal, excess, error, variance) -> tuple[np.ndarray, _Levels]:
    """Indices of the levels below saturation with a significant variance, by rising signal, and these levels."""
    lit = (signal > 0) & (excess > LEAST_SIGMAS * error) & (variance > NARROW_DN2)
    order = np.flatnonzero(lit)[np.argsort(signal[lit], kind="stable")]
    order = order[: _saturation(excess[order]) + 1] if len(order) else order
    return order, _Levels(signal[order], excess[order], error[order])


def row_gain_variance(flats: FlatMoments, signal, c: int) -> float:
    """Variance of the row gain, which scales the variance within rows; 0 if within chance."""
    mean, error = row_gain_of(flats, signal, c)
    return mean if mean > 5 * error else 0.0


def row_gain_of(flats: FlatMoments, signal, c: int) -> tuple[float, float]:
    """Variance of the row gain, from the scatter of row means beyond pixel noise, and its standard error.

    Of the levels below saturation: in full pixels rows hardly scatter, whatever their gain.
    """
    lit = np.flatnonzero(signal > 0)
    if not lit.size:
        return 0.0, np.inf
    lit = lit[np.argsort(signal[lit], kind="stable")]
    lit = lit[: _saturation(flats.variance_dn2[lit, c]) + 1]
    chance = flats.variance_dn2[lit, c] / flats.row_pixels[lit, c]
    relative = (flats.row_power_dn2[lit, c] - chance) / signal[lit] ** 2
    error = flats.row_power_dn2[lit, c] * np.sqrt(2 / flats.row_dof[lit, c]) / signal[lit] ** 2
    w = 1 / np.maximum(error, 1e-30) ** 2
    return float((w * relative).sum() / w.sum()), float(1 / np.sqrt(w.sum()))


def _saturation(excess: np.ndarray) -> int:
    """The last level before the variance falls: where pixels saturate, it goes to 0."""
    falls = np.flatnonzero(excess < (1 - STEEP) * np.maximum.accumulate(excess))
    end = int(falls[0]) if falls.size else len(excess)
    peak = int(excess[:end].argmax())
    return peak if (excess[peak + 1 :] < (1 - PAST_PEAK) * excess[peak]).any() else end - 1


def _longest(levels: _Levels, full_scale: float) -> tuple[int, _Curve]:
    """The largest number of levels, from the lowest up, that a curve describes, and that curve; else that of all."""
    whole = _curve(levels, full_scale)
    for n in range(len(levels.signal), 0, -1):
        if n < len(levels.signal) and (n < FEWEST_LEVELS or levels.signal[n - 1] < LEAST_RANGE * full_scale):
            break
        curve = _curve(_Levels(*(x[:n] for x in levels)), full_scale)
        if curve.described:
            return n, curve
    return len(levels.signal), whole


def _curve(levels: _Levels, full_scale: float) -> _Curve:
    """The curve of the lowest degree on which no higher one improves significantly, given the scatter."""
    curves = [
        _least_squares(levels, full_scale, d) for d in range(min(MOST_DEGREES, (len(levels.signal) - 1) // 2) + 1)
    ]
    best = curves[0]
    for curve in curves[1:]:
        gained = (best.chi2 - curve.chi2) / curve.scale**2
        if scipy.stats.chi2.sf(gained, best.dof - curve.dof) < SIGNIFICANT:
            best = curve
    return best


def _unseen_bend(levels: _Levels, full_scale: float, curve: _Curve) -> float:
    """By how much one more degree would change the gain beyond chance: a bend may be there, but not be significant."""
    degree = len(curve.coefficients)
    if degree > min(MOST_DEGREES, (len(levels.signal) - 1) // 2):
        return 0.0
    other = _least_squares(levels, full_scale, degree)
    change = other.coefficients[0] - curve.coefficients[0]
    chance = (other.covariance[0, 0] - curve.covariance[0, 0]) * curve.scale**2
    return float(np.sqrt(change**2 - chance)) if change**2 > UNSEEN_SIGMAS**2 * chance else 0.0


def _least_squares(levels: _Levels, full_scale: float, degree: int) -> _Curve:
    x = levels.signal / full_scale
    design = levels.signal[:, None] * x[:, None] ** np.arange(degree + 1) / levels.error[:, None]
    measured = levels.excess / levels.error
    covariance = np.linalg.inv(design.T @ design)
    coefficients = covariance @ (design.T @ measured)
    chi2 = float(((measured - design @ coefficients) ** 2).sum())
    return _Curve(coefficients, covariance, chi2, len(x) - degree - 1)


def _line(levels: _Levels, n: int) -> tuple[float, float]:
    """EMVA 1288's gain of the n lowest levels and its standard error.

    Its parts are the scatter of the levels about the line, and half the difference between lower and upper levels,
    because a deviation that is smooth in the signal is not chance.
    """

    def slope(signal, excess):
        return float(signal @ excess / (signal @ signal))

    signal, excess = levels.signal[:n], levels.excess[:n]
    gain = slope(signal, excess)
    leverage = signal**2 / (signal @ signal)
    left_out = (excess - gain * signal) / np.maximum(1 - leverage, 1e-3)  # about the line of all other levels
    scatter = np.sqrt(((left_out * signal) ** 2).sum()) / (signal @ signal)
    half = n // 2
    differ = abs(slope(signal[:half], excess[:half]) - slope(signal[half:], excess[half:])) / 2 if half else 0.0
    return gain, float(np.hypot(scatter, differ))


def judged(flats: FlatMoments, found: FlatGain) -> FlatMoments:
    """The flats with the curve of their variance, and the weight of each level in the likelihood."""
    channels = range(flats.mean_dn.shape[1])
    curve = np.stack([variance_curve(found, c, np.nan_to_num(found.signal_dn[:, c])) for c in channels], axis=1)
    return replace(flats, curve=np.where(found.used, curve, 1.0), weight=found.weight)


def variance_curve(found: FlatGain, c: int, signal_dn) -> np.ndarray:
    """Variance over signal of channel c relative to the gain at low signal, at these signals, DN; any shape."""
    x = np.asarray(signal_dn) / found.full_scale_dn[c]
    return 1 + found.bend[c, 0] * x + found.bend[c, 1] * x**2


def local_gain(found: FlatGain, c: int, signal_dn) -> np.ndarray:
    """Differential gain of channel c at these signals, DN/e- [signal], if its response bends the variance curve."""
    # With S = u^2 the integral of dS / sqrt(r S) is that of 2 du / sqrt(r), which has no pole.
    nodes, weights = np.polynomial.legendre.leggauss(12)
    signal = np.asarray(signal_dn, np.float64)
    u = np.sqrt(signal)[..., None] * (nodes + 1) / 2
    rate = found.gain[c] * variance_curve(found, c, u**2)
    root_e = np.sqrt(signal) / 2 * (weights / np.sqrt(rate)).sum(-1)
    return np.sqrt(found.gain[c] * variance_curve(found, c, signal) * signal) / np.maximum(root_e, 1e-300)


def relative_slope(found: FlatGain, c: int, signal_dn) -> np.ndarray:
    """By how much pixels of more light read more, relative to both [signal]: 1 where the response is straight."""
    return found.gain[c] * variance_curve(found, c, signal_dn) / local_gain(found, c, signal_dn)
