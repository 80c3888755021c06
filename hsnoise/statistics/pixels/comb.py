"""Codes of unequal width: a pattern that comes back in the histogram of counts, whatever the level."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline

from hsnoise.frames.stack import FrameStack

PERIODS = (2, 4, 8, 16, 32, 64)  # a converter halves its range: what its steps get wrong repeats after such numbers
CENTRAL = (0.02, 0.98)  # of the counts: what lies further out need not be smooth
MOST_CODES = 8192
FEWEST_PER_CODE = 100.0
FEWEST_PERIODS = 2  # in each half of the codes
FEWEST_LEFT = 3  # degrees of freedom of a half, which say how well the law is smooth
MOST_WORSE = 0.2  # of the nats that exposures gain by the pattern of the others: what some may lose
MOST_LEFT = 0.3  # of the roughness of histograms beyond chance
KNOTS, MOST_KNOTS = 1.5, 24  # periods between two knots of the smooth law, and how many it has in a half
DEGREE = 3
LEAST_WIDTH = 0.1  # of a code that is narrow; others are left out, by a digital gain
LEAST_NATS = 20.0  # by which the halves of the codes predict each other
MOST_OF_ANY = 8  # exposures in which other periods are tried
MOST_PIXELS = 1 << 22  # of an exposure


class Histogram(NamedTuple):
    """How often the codes from `first` on occur in one exposure."""

    first: int
    number: np.ndarray


class Comb(NamedTuple):
    """Errors of the widths of codes, DN: code k has `errors[k % len(errors)]`, of mean 0; rms sigma and its error."""

    errors: np.ndarray
    sigma: float
    error: float


class _Half(NamedTuple):
    """Of log widths [code of a period], under a smooth law of any shape: information and score, and chi2 that is left.

    root: over the standard errors of the log numbers `seen`, by which they and the basis of the law, `smooth`, are
    multiplied.
    """

    information: np.ndarray
    score: np.ndarray
    chi2: float
    dof: int
    codes: np.ndarray
    root: np.ndarray
    smooth: np.ndarray
    seen: np.ndarray


def histogram_of(counts: np.ndarray, white: float) -> Histogram | None:
    """The central codes of an exposure that are neither 0 nor `white`; None where they are few, sparse or left out."""
    counts = counts.ravel()[:: -(-counts.size // MOST_PIXELS)]
    low = int(counts.min())
    if not 0 <= low <= int(counts.max()) < 1 << 16:
        return None
    number = np.bincount(counts)
    within = np.cumsum(number) / counts.size
    first, last = (int(np.searchsorted(within, share)) for share in CENTRAL)
    first, last = max(first, 1), min(last, int(min(white, len(number))) - 1)
    some = number[first : last + 1].astype(np.float64)
    if not 4 * FEWEST_PERIODS <= len(some) <= MOST_CODES or some.mean() < FEWEST_PER_CODE or not some.all():
        return None
    return Histogram(first, some)


def comb_of(histograms: Sequence[Histogram]) -> Comb | None:
    """The pattern of code widths that all exposures share; None if none is certain.

    The lower and the upper half of the codes of each exposure have smooth laws of their own. A pattern counts if either
    half predicts the other: a law that is not smooth enough does not repeat.
    """
    found: int | None = None
    for period in PERIODS:
        pairs = [of for one in histograms if (of := _halves(one, period)) is not None]
        if not pairs:
            break
        nats = _held_out(pairs, period)
        if found is not None:  # of which the shorter period is a special case
            nats -= _held_out(pairs, found)
        if nats > LEAST_NATS:
            found = period
    return None if found is None else _comb(histograms, found)


def comb_in(stack: FrameStack) -> Comb | None:
    """The pattern of code widths in the first frame of each exposure of a stack."""
    white = np.inf if stack.white_level is None else stack.white_level
    frames = (next(iter(stack.frames(i))) for i in range(stack.n_exposures))
    return comb_of([of for frame in frames if (of := histogram_of(frame, white)) is not None])


def _halves(one: Histogram, period: int) -> tuple[_Half, _Half] | None:
    """The two halves of the codes of an exposure; None where they are too few for the period."""
    middle = int(np.searchsorted(np.cumsum(one.number), one.number.sum() / 2))
    if min(middle, len(one.number) - middle) < FEWEST_PERIODS * max(period, DEGREE):
        return None
    lower = _half(Histogram(one.first, one.number[:middle]), period)
    upper = _half(Histogram(one.first + middle, one.number[middle:]), period)
    return None if min(lower.dof, upper.dof) < FEWEST_LEFT else (lower, upper)


def _half(one: Histogram, period: int) -> _Half:
    codes = one.first + np.arange(len(one.number))
    pieces = int(np.clip(len(codes) / (KNOTS * period), 1, MOST_KNOTS))
    ends = codes[0] - 0.5, codes[-1] + 0.5
    knots = np.concatenate([[ends[0]] * DEGREE, np.linspace(*ends, pieces + 1), [ends[1]] * DEGREE])
    root = np.sqrt(one.number)[:, None]  # over the standard error of the log of a number
    smooth, _ = np.linalg.qr(BSpline.design_matrix(codes, knots, DEGREE).toarray() * root)
    phases = (codes[:, None] % period == np.arange(period)) * root
    seen = np.log(one.number + 0.5) * root[:, 0]
    phases, seen = phases - smooth @ (smooth.T @ phases), seen - smooth @ (smooth.T @ seen)
    information, score = phases.T @ phases, phases.T @ seen
    chi2 = float(seen @ seen - score @ _solved(information, score))
    return _Half(information, score, chi2, len(codes) - smooth.shape[1] - (period - 1), codes, root, smooth, seen)


def _held_out(pairs: Sequence[tuple[_Half, _Half]], period: int) -> float:
    """By how many nats patterns of this period, from one half of the codes each, predict the other half."""
    fold = np.arange(len(pairs[0][0].score))[:, None] % period == np.arange(period)
    information = [fold.T @ sum(of[side].information for of in pairs) @ fold for side in (0, 1)]
    score = [fold.T @ sum(of[side].score for of in pairs) for side in (0, 1)]
    return float(_predicted(np.stack(information), np.stack(score))) / _worse(pairs)


def _predicted(information: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Nats by which what each half says [half, ..., parameter] predicts the other."""
    pattern = _solved(information, score)[::-1]
    return (np.sum(pattern * score, -1) - np.einsum("...i,...ij,...j", pattern, information, pattern) / 2).sum(0)


def _is_of_some(pairs: Sequence[tuple[_Half, _Half]]) -> bool:
    """Whether only some exposures have the pattern: that of the others makes their prediction worse."""
    if len(pairs) < 2:
        return False
    information = np.array([pair[0].information + pair[1].information for pair in pairs])
    score = np.array([pair[0].score + pair[1].score for pair in pairs])
    pattern = _solved(information.sum(0) - information, score.sum(0) - score)
    nats = np.sum(pattern * score, -1) - np.einsum("ni,nij,nj->n", pattern, information, pattern) / 2
    return bool(-nats[nats < 0].sum() > MOST_WORSE * nats[nats > 0].sum())


def _is_of_another_period(pairs: Sequence[tuple[_Half, _Half]], period: int) -> bool:
    """Whether a sinusoid of some period predicts better: single electrons or a digital gain are no pattern of codes."""
    narrow = sorted(pairs, key=lambda pair: len(pair[0].codes))[:MOST_OF_ANY]
    points = min(max(len(half.codes) for pair in narrow for half in pair), MOST_CODES // 8)
    turns = np.linspace(0, 0.5, 2 * points + 1)[1:]
    information, score = np.zeros((2, len(turns), 2, 2)), np.zeros((2, len(turns), 2))
    for pair in narrow:
        for side, half in enumerate(pair):
            waves = np.exp(2j * np.pi * half.codes[:, None] * turns) * half.root
            waves = np.stack([waves.real, waves.imag], -1).reshape(len(half.codes), -1)
            waves -= half.smooth @ (half.smooth.T @ waves)
            waves = waves.reshape(len(half.codes), -1, 2)
            information[side] += np.einsum("cti,ctj->tij", waves, waves)
            score[side] += np.einsum("cti,c->ti", waves, half.seen)
    return bool(_predicted(information, score).max() / _worse(narrow) > _held_out(narrow, period) + LEAST_NATS / 2)


def _worse(pairs: Sequence[tuple[_Half, _Half]]) -> float:
    """Chi2 per degree of freedom, by which errors are larger where the law is not smooth; at least 1."""
    halves = [half for pair in pairs for half in pair]
    return max(sum(half.chi2 for half in halves) / sum(half.dof for half in halves), 1.0)


def _solved(information: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Log widths, of mean 0: a factor common to all is part of the smooth law."""
    return np.einsum("...ij,...j", np.linalg.pinv(information, 1e-6, hermitian=True), score)


def _comb(histograms: Sequence[Histogram], period: int) -> Comb | None:
    """The pattern of this period; None if it leaves codes out, hardly explains roughness, or is not that of all."""
    pairs = [of for one in histograms if (of := _halves(one, period)) is not None]
    halves = [half for pair in pairs for half in pair]
    before = sum(half.chi2 + half.score @ _solved(half.information, half.score) for half in halves)
    rough = before / sum(half.dof + period - 1 for half in halves) - 1
    if _worse(pairs) - 1 > MOST_LEFT * rough or _is_of_some(pairs) or _is_of_another_period(pairs, period):
        return None
    information = sum(half.information for half in halves)
    covariance = np.linalg.pinv(information, 1e-6, hermitian=True) * _worse(pairs)
    widths = np.exp(_solved(information, sum(half.score for half in halves)))
    errors = widths / widths.mean() - 1
    variance = float(errors @ errors - np.trace(covariance)) / period
    if widths.min() < LEAST_WIDTH * widths.mean() or variance <= 0:
        return None
    sigma = np.sqrt(variance)
    return Comb(errors, float(sigma), float(np.sqrt(errors @ covariance @ errors) / (period * sigma)))
