"""Which jumping pixels have the measured variances and shapes: they are drawn, as no formula has what a cut leaves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

DRAWN, ORDINARY = 6000, 40_000  # pixels with a trap, and without
CORE, WIDTH = 16, 0.2  # bins of the variance of pixels that are not noisy; the last has no end
STEP, FEWEST_IN_BIN = 1.25, 30  # ratio of the variances that bound a bin; pixels above the last
ALIKE = 0.1  # relative error of a statistic: no two traps are alike
STARTS = (2.5, 5.0)  # amplitudes in units of the noise, beyond a count
STEPS = np.array([0.2, 0.2, 0.04, 0.04])  # of ln fraction, ln amplitude, duty, and spread of ln noise over pixels
# Less than the noise would explain the few by jumps of most pixels that nobody sees.
LOW, HIGH = np.array([-14.0, 0.0, 0.01, 0.0]), np.array([0.0, 4.5, 0.99, 0.8])
FEW, MANY = 3, 10  # steps of a search of each kind, and of the best two

Number = tuple[float, float]


class Jumps(NamedTuple):
    """Jumping pixels as `random_telegraph_noise` has them, each number with its error; the amplitude in DN.

    exponential: whether amplitudes are exponential over pixels (a spread of 1), or all alike (0); between the two,
    only the product of fraction and amplitude would show. noise_spread: standard deviation of the logarithm of the
    noise over pixels. noise_dn2: variance of an ordinary pixel, rounding included. cut: mean variance of all ordinary
    pixels over that of those that do not look in half of the frames as if they jumped.
    """

    fraction: Number
    amplitude_dn: Number
    duty: Number
    double_sampling: bool
    exponential: bool
    noise_spread: Number
    noise_dn2: float
    cut: float = 1.0

    def of_traps(self, states: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Jumps of pixels that all have a trap [frame, pixel], in units of the noise.

        states: uniform numbers [2, frame, pixel]; depth: exponential numbers [pixel].
        """
        size = self.amplitude_dn[0] / np.sqrt(self.noise_dn2) * (depth if self.exponential else np.ones_like(depth))
        high = (states < self.duty[0]).astype(np.float32)
        return size.astype(np.float32) * (high[0] - high[1] if self.double_sampling else high[0])

    def drawn(self, rng: np.random.Generator, frames: int, pixels: int) -> np.ndarray:
        """Jumps [frame, pixel] in units of the noise, of pixels of which `fraction` have a trap."""
        jumps = self.of_traps(rng.random((2, frames, pixels), np.float32), rng.exponential(size=pixels))
        return np.where(rng.random(pixels) < self.fraction[0], jumps, np.float32(0))

    def raises(self, what: Callable[[np.ndarray], float], n_frames: int) -> float:
        """By what factor jumping pixels raise a statistic of the variances over so many frames."""
        rng = np.random.default_rng(0)
        noise = rng.standard_normal((n_frames, 10 * DRAWN), np.float32)
        jumping = noise + self.drawn(rng, n_frames, noise.shape[1])
        return what(jumping.var(0, ddof=1)) / what(noise.var(0, ddof=1))


class Moments(NamedTuple):
    """Of pixels over time [pixel], in units of an ordinary pixel's: variance of all frames and halves; shapes."""

    variance: np.ndarray
    halves: np.ndarray
    skewness: np.ndarray
    kurtosis: np.ndarray

    @classmethod
    def of(cls, parts: Sequence[tuple[Sequence[int], np.ndarray, np.ndarray, np.ndarray, np.ndarray]]) -> Moments:
        """Over exposures: frames of both halves, variance, variances of halves, third and fourth central moments."""
        n = np.array([sum(frames) for frames, *_ in parts])
        frames, dof = n.sum(), (n - 1).sum()
        second, third, fourth = (
            sum(weight * part[i] for weight, part in zip(weights, parts, strict=True))
            for i, weights in ((1, n - 1), (3, n), (4, n))
        )
        of_halves = [np.array(frames)[:, None] - 1 for frames, *_ in parts]
        halves = sum(free * part[2] for free, part in zip(of_halves, parts, strict=True)) / sum(of_halves)
        variance = second / dof
        typical = np.maximum(variance, 1e-6)
        return cls(variance, halves, third / frames / typical**1.5, fourth / frames / typical**2)

    def is_noisy(self, limits: np.ndarray) -> np.ndarray:
        """Which pixels are noisier than others in both halves of the frames, and in all: `limits` of the three."""
        return self.look_noisy(limits).all(0) & (self.variance > limits[2])

    def look_noisy(self, limits: np.ndarray) -> np.ndarray:
        """Which pixels are noisier than most in each half of the frames [half, pixel]."""
        return self.halves > limits[:2, None]

    def noisy(self, limits: np.ndarray) -> Moments:
        """The noisy ones."""
        kept = self.is_noisy(limits)
        return Moments(self.variance[kept], self.halves[:, kept], self.skewness[kept], self.kurtosis[kept])

    def by_chance(self, limits: np.ndarray) -> float:
        """How many would be noisy in both halves if one did not tell of the other."""
        return float(np.prod(self.look_noisy(limits).sum(1))) / len(self.variance)

    def in_bins(self, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """By bin of the variance: number of pixels, mean shapes [bin, shape], and their errors (1e6 of too few)."""
        bins, shapes = len(edges) - 1, np.stack([self.kurtosis, np.abs(self.skewness), self.skewness], 1)
        number = np.digitize(self.variance, edges) - 1
        counts, means, errors = np.zeros(bins), np.zeros((bins, 3)), np.full((bins, 3), 1e6)
        for b in range(bins):
            inside = shapes[number == b]
            counts[b] = len(inside)
            if len(inside) > 5:
                means[b], errors[b] = inside.mean(0), inside.std(0) / np.sqrt(len(inside)) + 1e-3
        return counts, means, errors


@dataclass(frozen=True)
class Bins:
    """Shares of all pixels by bin of the variance, the noisy ones and the others, and mean shapes of the noisy ones.

    Errors of shares and shapes are those of chance.
    """

    noisy: np.ndarray
    others: np.ndarray
    shapes: np.ndarray
    share_errors: np.ndarray
    shape_errors: np.ndarray

    @classmethod
    def of(cls, pixels: Moments, limits: np.ndarray, edges: np.ndarray) -> Bins:
        number, is_noisy = len(pixels.variance), pixels.is_noisy(limits)
        counts, shapes, errors = pixels.noisy(limits).in_bins(edges)
        number_of = np.minimum((pixels.variance[~is_noisy] / WIDTH).astype(int), CORE - 1)
        others = np.bincount(np.maximum(number_of, 0), minlength=CORE)
        chance = np.sqrt(np.concatenate([counts, others]) + 1) / number
        return cls(counts / number, others / number, shapes, chance, errors)

    @property
    def shares(self) -> np.ndarray:
        return np.concatenate([self.noisy, self.others])


@dataclass(frozen=True)
class Chance:
    """Random numbers that all tries share.

    noise, states: of pixels with a trap, by exposure [frame, pixel] and [2, frame, pixel]; depth [pixel]; strength,
    squares: of ordinary pixels, normal [pixel], and relative variances of halves and between halves [3, pixel].
    """

    noise: list[np.ndarray]
    states: list[np.ndarray]
    depth: np.ndarray
    strength: np.ndarray
    squares: np.ndarray
    dof: np.ndarray

    @classmethod
    def of(cls, frames: Sequence[int]) -> Chance:
        rng = np.random.default_rng(0)
        dof = np.array([sum((n + 1 - half) // 2 - 1 for n in frames) for half in (0, 1)] + [len(frames)])
        return cls(
            noise=[rng.standard_normal((n, DRAWN), np.float32) for n in frames],
            states=[rng.random((2, n, DRAWN), np.float32) for n in frames],
            depth=-np.log((rng.permutation(DRAWN) + 0.5) / DRAWN),  # evenly over the distribution
            strength=rng.standard_normal(ORDINARY),
            squares=np.stack([rng.chisquare(n, ORDINARY) / n for n in dof]),
            dof=dof,
        )

    def of_ordinary(self, spread: float) -> tuple[np.ndarray, Moments]:
        """True and measured variances of pixels that do not jump; their shapes are left open."""
        noise = np.exp(2 * spread * self.strength)
        halves = noise * self.squares
        variance = self.dof @ halves / self.dof.sum()
        return noise, Moments(variance, halves[:2], *[np.zeros_like(variance)] * 2)


@dataclass(frozen=True)
class Search:
    """What is to be reproduced, and with what: edges of the bins of noisy pixels, and their limits."""

    measured: Bins
    edges: np.ndarray
    limits: np.ndarray
    noise_dn2: float
    chance: Chance
    normal: np.ndarray  # shapes of normal noise [bin, shape], and their errors: they are drawn, too
    normal_errors: np.ndarray
    ordinary: Callable[[float], Bins]  # of pixels that do not jump, by the spread of their noise

    @classmethod
    def of(cls, pixels: Moments, limits: np.ndarray, frames: Sequence[int], noise_dn2: float) -> Search:
        """Of pixels over so many frames of each exposure."""
        ordered = np.sort(pixels.noisy(limits).variance)
        low, top = ordered[0], ordered[-min(FEWEST_IN_BIN, len(ordered))]
        edges = np.append(low * STEP ** np.arange(max(int(np.log(top / low) / np.log(STEP)), 1)), np.inf)
        chance = Chance.of(frames)
        # Given its variance, the shape of normal noise does not depend on its strength.
        of_normal = _over_time(chance, noise_dn2, np.exp(chance.depth / 2), None)
        normal = Bins.of(of_normal, limits, edges)

        @lru_cache(maxsize=8)
        def ordinary(spread: float) -> Bins:
            return Bins.of(chance.of_ordinary(spread)[1], limits, edges)

        measured, shapes = Bins.of(pixels, limits, edges), (normal.shapes, normal.shape_errors)
        return cls(measured, edges, limits, noise_dn2, chance, *shapes, ordinary)

    def drawn(self, of: Jumps) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Shares and shapes of jumping and ordinary pixels whose noise differs, and their errors by chance."""
        spread = of.noise_spread[0]
        strength = np.exp(spread * self.chance.strength[:DRAWN])
        jumping = Bins.of(_over_time(self.chance, self.noise_dn2, strength, of), self.limits, self.edges)
        ordinary = self.ordinary(spread)
        fraction = of.fraction[0]
        several = fraction * jumping.noisy, (1 - fraction) * ordinary.noisy
        weight = (several[0] / np.maximum(sum(several), 1e-12))[:, None]
        shares = fraction * jumping.shares + (1 - fraction) * ordinary.shares
        errors = np.hypot(fraction * jumping.share_errors, (1 - fraction) * ordinary.share_errors)
        return shares, weight * jumping.shapes + (1 - weight) * self.normal, errors, jumping.shape_errors

    def off(self, of: Jumps) -> tuple[np.ndarray, np.ndarray]:
        """Shares and shapes of jumps, less the measured, in units of their errors."""
        shares, shapes, share_errors, shape_errors = self.drawn(of)
        one = self.measured
        chance = np.hypot(share_errors, np.hypot(one.share_errors, ALIKE * one.shares))
        return (shares - one.shares) / chance, self._shapes_off(shapes, shape_errors)

    def _shapes_off(self, shapes: np.ndarray, errors: np.ndarray) -> np.ndarray:
        one = self.measured
        error = np.sqrt(errors**2 + one.shape_errors**2 + (ALIKE * one.shapes) ** 2)
        return ((shapes - one.shapes) / error).ravel()

    def misfit_of_normal(self) -> float:
        """Chi-square of the shapes of normal noise, of any strength."""
        return float(np.sum(self._shapes_off(self.normal, self.normal_errors) ** 2))

    def best(self) -> tuple[Jumps, float]:
        """The nearest jumps, with the errors of least squares (larger where they do not describe the pixels), and the
        chi-square of the shapes."""
        visible = np.log(min(3 * float(self.measured.noisy.sum()), 0.5))
        starts = [[visible, np.log(size + 1 / np.sqrt(self.noise_dn2)), 0.2, 0.05] for size in STARTS]
        kinds = product((False, True), repeat=2)
        found = [self._nearest(kind, np.array(start), FEW) for kind, start in product(kinds, starts)]
        found.sort(key=lambda one: one[1].cost)
        kind, end = min((self._nearest(kind, end.x, MANY) for kind, end in found[:2]), key=lambda one: one[1].cost)
        worse = max(1.0, 2 * end.cost / max(len(end.fun) - len(end.x), 1))
        covariance = worse * np.linalg.inv(end.jac.T @ end.jac + 1e-6 * np.eye(len(end.x)))
        jumps = self._at(end.x, np.sqrt(np.diagonal(covariance)), kind)
        return jumps._replace(cut=self._cut(jumps)), float(np.sum(self.off(jumps)[1] ** 2))

    def _cut(self, of: Jumps) -> float:
        noise, pixels = self.chance.of_ordinary(of.noise_spread[0])
        return float(noise.mean() / noise[~pixels.look_noisy(self.limits)[0]].mean())

    def _nearest(self, kind: tuple[bool, bool], start: np.ndarray, tries: int):
        """The kind, and the end of a search."""

        def off(x: np.ndarray) -> np.ndarray:
            return np.concatenate(self.off(self._at(x, np.zeros(len(x)), kind)))

        def slopes(x: np.ndarray) -> np.ndarray:
            ends = [[np.clip(x + way * step, LOW, HIGH) for way in (1, -1)] for step in np.diag(STEPS)]
            return np.stack([(off(up) - off(down)) / np.sum(up - down) for up, down in ends], 1)

        return kind, least_squares(off, start, slopes, (LOW, HIGH), x_scale=STEPS, max_nfev=tries)

    def _at(self, x: np.ndarray, errors: np.ndarray, kind: tuple[bool, bool]) -> Jumps:
        """Jumps of ln fraction, ln amplitude (in units of the noise), duty and spread of the noise."""
        (fraction, size), scale = np.exp(x[:2]), float(np.sqrt(self.noise_dn2))
        return Jumps(
            fraction=(float(fraction), float(fraction * errors[0])),
            amplitude_dn=(float(scale * size), float(scale * size * errors[1])),
            duty=(float(x[2]), float(errors[2])),
            double_sampling=kind[0],
            exponential=kind[1],
            noise_spread=(float(x[3]), float(errors[3])),
            noise_dn2=self.noise_dn2,
        )


def _over_time(chance: Chance, noise_dn2: float, strength: np.ndarray, of: Jumps | None) -> Moments:
    """Moments of pixels whose noise has this strength, and who jump if `of` says how."""
    step = 1 / np.sqrt(noise_dn2)
    own, offset = np.sqrt(max(1 - step**2 / 12, 0.1)), np.linspace(0, step, DRAWN, endpoint=False)
    parts = []
    for noise, states in zip(chance.noise, chance.states, strict=True):
        values = own * strength * noise + offset
        values = values if of is None else values + of.of_traps(states, chance.depth)
        values = (step * np.round(values / step)).astype(np.float32)
        off = values - values.mean(0)
        square = off * off
        halves = [values[half::2] for half in (0, 1)]
        frames, variance = [len(one) for one in halves], square.sum(0) / (len(values) - 1)
        of_halves = np.stack([one.var(0, ddof=1) for one in halves])
        parts.append((frames, variance, of_halves, (square * off).mean(0), (square * square).mean(0)))
    return Moments.of(parts)
