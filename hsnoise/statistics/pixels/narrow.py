"""Levels and noise of pixels whose noise is below a count, from how often they hold each count.

Such a pixel holds one count most of the time: the mean of its counts is not its level, nor their variance that of its
noise. All pixels together tell how levels and noise are distributed; what one of them may have follows by Bayes' rule
(maximum likelihood by expectation and maximisation; levels of any distribution, Kiefer and Wolfowitz 1956, and
log-normal noise).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hsnoise.statistics.narrow_noise import law_of_counts, narrow_read_noise

NARROW_DN = 0.4  # of noise, below which counts do not average to levels
STEP_DN = 0.04  # of the grid of levels, and of what lines add to them
SIGMAS, WIDEST = 21, 3.0  # of the grid of noise: how many, and how many times the usual one at most
ITERATIONS, FEWEST, WORK = 1500, 200, 1_500_000_000  # of the distribution; fewer the more patterns times places
SPREAD, WIDER = 0.3, 1e-3  # of the logarithms of the pixels' noise, and share of any level, before anything is learnt
LEARNT_FROM, MOST = 200_000, 5_000_000  # pixels at most, and patterns times places
AT_ONCE = 2000  # patterns
CORE, FAR, LEAST_DN = 0.05, 3.0, 0.2  # quantile of the means of pixels, and times its distance where others are far
UNLIKELY = 1e-6  # probability of a count, at least: tails are longer than normal ones
LINES, WIDEST_SHIFT_DN = 3, 3.0  # times that what rows and columns add is measured, and the most that they add
PARTS = 4  # of the rows, by whose scatter errors are told
COARSE, COARSEST = 0.01, 0.15  # relative error beside chance: noise is not quite normal, and the grid is coarse
USUAL_DN = 0.25  # of noise, for which that is so
NOT_NORMAL = 10.0  # times coarser where levels are far from normal
LEAST_SLOPE = 0.2  # below which counts hardly move with levels, and tell nothing of what shifts them
FEW_FRAMES, OF_NOISE = 0.2, 0.05  # the same for a single frame; less of it for the noise


@dataclass(frozen=True)
class Narrow:
    """Level and noise of each pixel [row, column], DN, drawn from their posterior.

    slope: by how much the mean of the counts moves with the levels.
    """

    level: np.ndarray
    sigma: np.ndarray
    slope: float


class NarrowLaw(NamedTuple):
    """How pixels whose noise is below a count are distributed: each a value and its standard error, DN.

    sigma: noise over time, rms, what frames, rows and columns share included. spread: of the logarithms of the pixels'
    noise. offset: standard deviation of levels beside those of rows and columns. raised: mean of the counts less that
    of the levels. slope: by how much the mean of the counts moves with the levels.
    """

    sigma: tuple[float, float]
    spread: tuple[float, float]
    offset: tuple[float, float]
    raised: tuple[float, float]
    slope: tuple[float, float]


def narrow_law(counts: np.ndarray) -> NarrowLaw | None:
    """How the pixels of darks of one exposure and colour [frame, row, column] are distributed.

    None where levels lie in the middle of a count, so that rounding hides them.
    """
    narrow = narrow_read_noise(counts)
    mean = np.array(_law_of(counts, usual_dn(narrow), ITERATIONS))
    if mean[-1] < LEAST_SLOPE:
        return None
    # In a part the means of columns are less certain, and what they lack passes for offsets: the whole counts.
    parts = np.array_split(counts, PARTS, axis=1)
    of_parts = [_law_of(part, usual_dn(narrow), ITERATIONS // 3) for part in parts]
    error = np.std(of_parts, axis=0, ddof=1) / np.sqrt(PARTS)
    few = np.full(len(mean), FEW_FRAMES)
    few[0] = OF_NOISE
    coarse = COARSE * max(1.0, USUAL_DN / float(mean[0])) ** 3  # the narrower, the coarser what counts tell
    coarse *= 1.0 if np.isfinite(narrow[0]) else NOT_NORMAL
    error = np.hypot(error, np.minimum(coarse + few / len(counts), COARSEST) * np.abs(mean))
    law = NarrowLaw(*zip(mean.tolist(), error.tolist(), strict=True))
    # What few frames do not tell of it stays as it was assumed.
    spread = law.spread[0], float(np.hypot(law.spread[1], SPREAD / len(counts)))
    offset = law.offset[0], float(np.hypot(law.offset[1], STEP_DN**2 / (2 * max(law.offset[0], STEP_DN))))
    return law._replace(spread=spread, offset=offset)


def _law_of(counts: np.ndarray, usual: float, iterations: int) -> tuple[float, ...]:
    learnt = _learnt(counts, usual, np.random.default_rng(0), iterations)
    level, sigma, share = learnt.grid.level, learnt.grid.sigma, learnt.share
    middle, log = share @ level, np.log(sigma)
    raised = learnt.mean[~learnt.far].mean() - middle - STEP_DN * float(learnt.shift[~learnt.far.ravel()].mean())
    offset = share @ (level - middle) ** 2 - STEP_DN**2 / 12  # of the steps of what lines add
    rms, spread = share @ sigma**2, share @ (log - share @ log) ** 2
    return (*(float(np.sqrt(max(of, 0.0))) for of in (rms, spread, offset)), float(raised), learnt.slope)


def usual_dn(narrow: tuple[float, float]) -> float:
    """The noise, DN, of its estimate and bound: the bound where levels are not normal; infinite for wide noise."""
    return narrow[0] if np.isfinite(narrow[0]) else narrow[1]


def is_narrow(counts: np.ndarray) -> bool:
    """Whether the noise of darks [frame, row, column] is below a count."""
    return usual_dn(narrow_read_noise(counts)) < NARROW_DN


def narrow_from_posterior(counts: np.ndarray, rng: np.random.Generator) -> Narrow:
    """Levels and noise of the pixels of darks of one exposure and colour [frame, row, column]."""
    usual = usual_dn(narrow_read_noise(counts))
    learnt, shape = _learnt(counts, usual, rng, ITERATIONS), counts.shape[1:]
    level, sigma = learnt.grid.drawn(learnt.share, learnt.held, learnt.shift, rng)
    level = level.reshape(shape) + learnt.lines - STEP_DN * learnt.shift.reshape(shape)
    own = np.sqrt(np.maximum(counts.var(0, ddof=1), STEP_DN**2))
    level = np.where(learnt.far, learnt.mean, level)
    return Narrow(level, np.where(learnt.far, own, sigma.reshape(shape)), learnt.slope)


@dataclass(frozen=True)
class _Learnt:
    """What all pixels together tell.

    mean: of the counts of each pixel [row, column]; far: whether they are beyond the others', as of hot pixels; held:
    how often each holds each count [pixel, code]; lines: what rows and columns add to levels [row, column], DN, and
    shift: the same in steps [pixel]; share: of the pixels at each place of the grid.
    """

    grid: _Grid
    mean: np.ndarray
    far: np.ndarray
    held: np.ndarray
    lines: np.ndarray
    shift: np.ndarray
    share: np.ndarray
    slope: float


def _learnt(counts: np.ndarray, usual: float, rng: np.random.Generator, iterations: int) -> _Learnt:
    """usual: noise of the pixels, DN, roughly."""
    mean = counts.mean(0, dtype=np.float64)
    below, middle, above = np.quantile(mean, (CORE, 0.5, 1 - CORE))
    low = max(mean.min(), middle - FAR * max(middle - below, LEAST_DN))
    high = min(mean.max(), middle + FAR * max(above - middle, LEAST_DN))
    # The first code holds all that is below it, as 0 does in counts that are clipped there.
    codes = np.arange(max(np.floor(low) - 1, min(float(counts.min()), 0.0)), np.ceil(high) + 2)
    far = (counts.min(0) < codes[0]) | (counts.max(0) > codes[-1])
    usual = min(usual, NARROW_DN)
    held, grid, near = _histograms(counts, codes), _Grid.of(codes, low, high, usual), ~far.ravel()
    clipped = np.clip(mean, low, high)
    of_axes = [clipped.mean(axis, keepdims=True) for axis in (1, 0)]
    lines, beside = sum(of - clipped.mean() for of in of_axes), clipped - sum(of_axes)
    for rounds in np.linspace(iterations // 3, iterations, LINES).astype(int):
        used, shift = lines, np.rint(lines / STEP_DN).astype(int).ravel()
        some = _sample(held[near], shift[near], MOST // len(grid.level), rng)
        share = grid.learnt(grid.first(beside, mean[~far].mean(), usual), *some, rounds)
        # Rows and columns shift the levels of a thousand pixels: they are known far better than any of these.
        shifts, means = grid.means(share)
        lines = sum(of - of.mean() for of in (np.interp(each, means, shifts) for each in of_axes))
    slope = max(grid.slope(share, shift), STEP_DN)
    return _Learnt(grid, mean, far, held, used, shift, share, slope)


def _histograms(counts: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """How often each pixel holds each count [pixel, code]; counts beyond the codes count as the last of them."""
    place = (np.clip(counts, codes[0], codes[-1]) - codes[0]).astype(np.int64).reshape(len(counts), -1)
    n = place.shape[1]
    return np.bincount((place + len(codes) * np.arange(n)).ravel(), minlength=n * len(codes)).reshape(n, -1)


def _sample(
    held: np.ndarray, shift: np.ndarray, most: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Patterns of some pixels, at most so many, what lines add to them, and how many of these pixels have each."""
    some = rng.permutation(len(held))[:LEARNT_FROM]
    first, _, times = _patterns(held[some], shift[some])
    while len(first) > most:
        some = some[: int(0.9 * len(some) * most / len(first))]
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
    def of(codes: np.ndarray, low: float, high: float, usual: float) -> _Grid:
        levels = np.arange(low - 0.5, high + 0.5, STEP_DN)
        sigmas = usual * np.geomspace(1 / WIDEST, WIDEST, SIGMAS)
        return _Grid(codes, np.tile(levels, SIGMAS), np.repeat(sigmas, len(levels)))

    def likelihood(self, held: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Of each place for patterns [pattern, place], up to a factor."""
        found = np.empty((len(held), len(self.level)))
        for number in np.unique(shift):
            of = shift == number
            law = law_of_counts(self.codes, self.level + STEP_DN * number, self.sigma)
            found[of] = held[of] @ np.log(law + UNLIKELY)
        return np.exp(found - found.max(1, keepdims=True))

    def first(self, beside: np.ndarray, level: float, usual: float) -> np.ndarray:
        """What is assumed before anything is learnt: normal levels as wide as the means of counts, and usual noise."""
        wide = np.exp(-0.5 * ((self.level - level) / max(float(beside.std()), STEP_DN)) ** 2)
        return (wide + WIDER) * np.exp(-0.5 * (np.log(self.sigma / usual) / SPREAD) ** 2)

    def learnt(
        self, share: np.ndarray, held: np.ndarray, shift: np.ndarray, times: np.ndarray, rounds: int
    ) -> np.ndarray:
        """The share of the pixels at each place: from what is assumed, patterns, and how many pixels have each.

        Levels may have any distribution; that of noise is log-normal, and the same at all levels.
        """
        likelihood, log = self.likelihood(held, shift), np.log(self.sigma.reshape(SIGMAS, -1)[:, 0])
        least = (log[1] - log[0]) / 2
        for _ in range(min(rounds, max(FEWEST, WORK // likelihood.size))):
            share = share * (likelihood.T @ (times / (likelihood @ share))) / times.sum()
            table = share.reshape(SIGMAS, -1)
            of_noise = table.sum(1)
            middle = of_noise @ log
            spread = max(float(np.sqrt(of_noise @ (log - middle) ** 2)), least)
            of_noise = np.exp(-0.5 * ((log - middle) / spread) ** 2)
            share = np.outer(of_noise / of_noise.sum(), table.sum(0)).ravel()
        return share

    def means(self, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shifts of all levels, DN, and the mean of the counts that each leads to."""
        shifts = np.arange(-WIDEST_SHIFT_DN, WIDEST_SHIFT_DN, STEP_DN)
        means = [self.codes @ law_of_counts(self.codes, self.level + of, self.sigma) @ share for of in shifts]
        return shifts, np.maximum.accumulate(means)

    def slope(self, share: np.ndarray, shift: np.ndarray) -> float:
        """How much the mean of the counts of all pixels moves with their levels."""
        moved, times = np.unique(shift, return_counts=True)
        low, high = (
            sum(
                n * (self.codes @ law_of_counts(self.codes, self.level + STEP_DN * at, self.sigma) @ share)
                for at, n in of
            )
            for of in (list(zip(moved + half, times, strict=True)) for half in (-0.5, 0.5))
        )
        return float(high - low) / (STEP_DN * times.sum())

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
