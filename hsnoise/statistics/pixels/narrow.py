"""Levels and noise of pixels whose noise is below a count, from how often they hold each count.

Such a pixel holds one count most of the time: the mean of its counts is not its level, nor their variance that of its
noise. All pixels together tell how levels and noise are distributed; what one of them may have follows by Bayes' rule
(nonparametric maximum likelihood, Kiefer and Wolfowitz 1956, by expectation and maximisation).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hsnoise.statistics.narrow_noise import SIGMAS_DN, law_of_counts, narrow_read_noise

NARROW_DN = 0.4  # of noise, below which counts do not average to levels
STEP_DN = 0.04  # of the grid of levels, and of what lines add to them
SIGMAS = 12  # of the grid of noise
ITERATIONS = 100  # of the distribution; few, so that it stays smooth
SPREAD = 0.3  # of the logarithms of the pixels' noise, before anything is learnt
LEARNT_FROM = 200_000  # pixels
AT_ONCE = 2000  # patterns
FAR = 1e-4  # quantile of the counts beyond which a pixel is not like the others
UNLIKELY = 1e-6  # probability of a count, at least: tails are longer than normal ones
LINES = 2  # times that what rows and columns add is measured


@dataclass(frozen=True)
class Narrow:
    """Level and noise of each pixel [row, column], DN, drawn from their posterior.

    slope: by how much the mean of the counts moves with the levels.
    """

    level: np.ndarray
    sigma: np.ndarray
    slope: float


def is_narrow(counts: np.ndarray) -> bool:
    """Whether the noise of darks [frame, row, column] is below a count."""
    estimate, _ = narrow_read_noise(counts)
    return bool(estimate < NARROW_DN)


def narrow_from_posterior(counts: np.ndarray, rng: np.random.Generator) -> Narrow:
    """Levels and noise of the pixels of darks of one exposure and colour [frame, row, column]."""
    shape, mean = counts.shape[1:], counts.mean(0, dtype=np.float64)
    low, high = np.quantile(mean, (FAR, 1 - FAR))
    codes = np.arange(np.floor(low) - 1, np.ceil(high) + 2)
    held = _histograms(counts, codes)
    grid = _Grid.of(codes, low, high)
    usual, _ = narrow_read_noise(counts)
    lines, slope = np.zeros(shape), 1.0
    for _ in range(LINES):  # rows and columns shift the levels of a thousand pixels: they are known far better
        off = mean - mean.mean()
        lines = (off.mean(1, keepdims=True) + off.mean(0, keepdims=True)) / slope
        shift = np.rint(lines / STEP_DN).astype(int).ravel()
        share = grid.learnt(usual, *_sample(held, shift, rng))
        slope = grid.slope(share)
    level, sigma = grid.drawn(share, held, shift, rng)
    level = level.reshape(shape) + lines - STEP_DN * shift.reshape(shape)
    far = (mean < codes[0] + 1) | (mean > codes[-1] - 1)
    own = np.sqrt(np.maximum(counts.var(0, ddof=1), STEP_DN**2))
    return Narrow(np.where(far, mean, level), np.where(far, own, sigma.reshape(shape)), slope)


def _histograms(counts: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """How often each pixel holds each count [pixel, code]; counts beyond the codes count as the last of them."""
    place = (np.clip(counts, codes[0], codes[-1]) - codes[0]).astype(np.int64).reshape(len(counts), -1)
    n = place.shape[1]
    return np.bincount((place + len(codes) * np.arange(n)).ravel(), minlength=n * len(codes)).reshape(n, -1)


def _sample(held: np.ndarray, shift: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Patterns of some pixels, what lines add to them, and how many pixels have each."""
    some = rng.permutation(len(held))[:LEARNT_FROM]
    first, _, times = _patterns(held[some], shift[some])
    return held[some][first], shift[some][first], times


def _patterns(held: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A pixel of each pattern, the pattern of each pixel, and how many pixels have each."""
    mark = np.random.default_rng(0).integers(1 << 62, size=held.shape[1] + 1)  # different patterns, different sums
    with np.errstate(over="ignore"):
        key = held @ mark[:-1] + shift * mark[-1]
    _, first, which, times = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    return first, which, times


@dataclass(frozen=True)
class _Grid:
    """Levels and noise that a pixel may have [place], DN, and the counts."""

    codes: np.ndarray
    level: np.ndarray
    sigma: np.ndarray

    @staticmethod
    def of(codes: np.ndarray, low: float, high: float) -> _Grid:
        levels = np.arange(low - 0.5, high + 0.5, STEP_DN)
        sigmas = np.geomspace(2 * SIGMAS_DN[0], SIGMAS_DN[-1], SIGMAS)
        return _Grid(codes, np.tile(levels, SIGMAS), np.repeat(sigmas, len(levels)))

    def likelihood(self, held: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Of each place for patterns [pattern, place], up to a factor."""
        found = np.empty((len(held), len(self.level)))
        for number in np.unique(shift):
            of = shift == number
            law = law_of_counts(self.codes, self.level + STEP_DN * number, self.sigma)
            found[of] = held[of] @ np.log(law + UNLIKELY)
        return np.exp(found - found.max(1, keepdims=True))

    def learnt(self, usual: float, held: np.ndarray, shift: np.ndarray, times: np.ndarray) -> np.ndarray:
        """The share of the pixels at each place: from their usual noise, patterns, and how many pixels have each."""
        likelihood = self.likelihood(held, shift)
        share = np.exp(-0.5 * (np.log(self.sigma / usual) / SPREAD) ** 2)
        for _ in range(ITERATIONS):
            share = share * (likelihood.T @ (times / (likelihood @ share))) / times.sum()
        return share

    def slope(self, share: np.ndarray) -> float:
        """How much the mean of the counts of all pixels moves with their levels."""
        low, high = (
            self.codes @ law_of_counts(self.codes, self.level + step, self.sigma) @ share
            for step in (-STEP_DN / 2, STEP_DN / 2)
        )
        return float(high - low) / STEP_DN

    def drawn(self, share: np.ndarray, held: np.ndarray, shift: np.ndarray, rng: np.random.Generator):
        """Level and noise of each pixel, drawn from what its pattern allows."""
        first, which, times = _patterns(held, shift)
        order, ends = np.argsort(which, kind="stable"), np.cumsum(times)
        place = np.empty(len(held), int)
        for start in range(0, len(first), AT_ONCE):
            some = first[start : start + AT_ONCE]
            sums = np.cumsum(self.likelihood(held[some], shift[some]) * share, 1)
            for number, total in enumerate(sums, start):
                pixels = order[ends[number] - times[number] : ends[number]]
                at = np.searchsorted(total, rng.random(len(pixels)) * total[-1], side="right")
                place[pixels] = np.minimum(at, len(total) - 1)
        level = self.level[place] + STEP_DN * (shift + rng.uniform(-0.5, 0.5, len(held)))
        return level, self.sigma[place]
