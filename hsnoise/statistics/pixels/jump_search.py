"""Which jumping pixels have the measured variances and shapes: they are drawn, as no formula has what a cut leaves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

DRAWN = 6000  # pixels
STEP, FEWEST_IN_BIN = 1.25, 30  # ratio of the variances that bound a bin; pixels above the last
ALIKE = 0.05  # relative error of a statistic: no two traps are alike
STARTS = (2.5, 5.0)  # amplitudes in units of the noise, beyond a count
STEPS = np.array([0.2, 0.2, 0.04])  # of ln fraction, ln amplitude and duty: slopes of noisy functions
# Less than the noise would explain the few by jumps of most pixels that nobody sees.
LOW, HIGH = np.array([-14.0, 0.0, 0.01]), np.array([0.0, 4.5, 0.99])
TRIES = 12  # steps of a search

Number = tuple[float, float]


class Jumps(NamedTuple):
    """Jumping pixels as `random_telegraph_noise` has them, each number with its error; the amplitude in DN.

    exponential: whether amplitudes are exponential over pixels (a spread of 1), or all alike (0); between the two,
    only the product of fraction and amplitude would show. noise_dn2: variance of an ordinary pixel, rounding included.
    """

    fraction: Number
    amplitude_dn: Number
    duty: Number
    double_sampling: bool
    exponential: bool
    noise_dn2: float

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
        return (self.halves > limits[:2, None]).all(0) & (self.variance > limits[2])

    def noisy(self, limits: np.ndarray) -> Moments:
        """The noisy ones."""
        kept = self.is_noisy(limits)
        return Moments(self.variance[kept], self.halves[:, kept], self.skewness[kept], self.kurtosis[kept])

    def by_chance(self, limits: np.ndarray) -> float:
        """How many would be noisy in both halves if one did not tell of the other."""
        return float(np.prod((self.halves > limits[:2, None]).sum(1))) / len(self.variance)

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
class Search:
    """What is to be reproduced, and the random numbers that all tries share.

    edges: of bins of the variance; shares [bin] of all pixels, shapes [bin, shape], with their errors; limits: of noisy
    pixels; noise, states: by exposure, [frame, pixel] and [2, frame, pixel]; depth [pixel].
    """

    edges: np.ndarray
    shares: tuple[np.ndarray, np.ndarray]
    shapes: tuple[np.ndarray, np.ndarray]
    limits: np.ndarray
    noise_dn2: float
    noise: list[np.ndarray]
    states: list[np.ndarray]
    depth: np.ndarray

    @classmethod
    def of(cls, measured: Moments, limits: np.ndarray, frames: Sequence[int], noise_dn2: float) -> Search:
        """Of pixels over so many frames of each exposure."""
        noisy, pixels = measured.noisy(limits), len(measured.variance)
        ordered, rng = np.sort(noisy.variance), np.random.default_rng(0)
        low, top = ordered[0], ordered[-min(FEWEST_IN_BIN, len(ordered))]
        edges = np.append(low * STEP ** np.arange(max(int(np.log(top / low) / np.log(STEP)), 1)), np.inf)
        counts, shapes, errors = noisy.in_bins(edges)
        return cls(
            edges=edges,
            shares=(counts / pixels, np.hypot(np.sqrt(counts + 1), ALIKE * counts) / pixels),
            shapes=(shapes, np.hypot(errors, ALIKE * np.abs(shapes))),
            limits=limits,
            noise_dn2=noise_dn2,
            noise=[rng.standard_normal((n, DRAWN), np.float32) for n in frames],
            states=[rng.random((2, n, DRAWN), np.float32) for n in frames],
            depth=-np.log((rng.permutation(DRAWN) + 0.5) / DRAWN),  # evenly over the distribution
        )

    def drawn(self, of: Jumps | None) -> Moments:
        """Moments of pixels that all have a trap, or of normal noise of any strength."""
        step = 1 / np.sqrt(self.noise_dn2)
        own, offset = np.sqrt(max(1 - step**2 / 12, 0.1)), np.linspace(0, step, DRAWN, endpoint=False)
        parts = []
        for noise, states in zip(self.noise, self.states, strict=True):
            beside = noise * np.expm1(self.depth / 2) if of is None else of.of_traps(states, self.depth)
            values = own * noise + offset + beside.astype(np.float32)
            values = (step * np.round(values / step)).astype(np.float32)
            off = values - values.mean(0)
            square = off * off
            halves = [values[half::2] for half in (0, 1)]
            parts.append(
                (
                    [len(one) for one in halves],
                    square.sum(0) / (len(values) - 1),
                    np.stack([one.var(0, ddof=1) for one in halves]),
                    (square * off).mean(0),
                    (square * square).mean(0),
                )
            )
        return Moments.of(parts)

    def off(self, of: Jumps) -> np.ndarray:
        """Shares and shapes of jumps, less the measured ones, in units of their errors."""
        counts, shapes, errors = self.drawn(of).noisy(self.limits).in_bins(self.edges)
        share, fraction = counts / DRAWN, of.fraction[0]
        chance = np.hypot(self.shares[1], fraction * np.sqrt((share + 1 / DRAWN) / DRAWN))
        return np.concatenate([(fraction * share - self.shares[0]) / chance, self._shapes_off(shapes, errors)])

    def _shapes_off(self, shapes: np.ndarray, errors: np.ndarray) -> np.ndarray:
        return ((shapes - self.shapes[0]) / np.hypot(self.shapes[1], errors)).ravel()

    def misfit(self, of: Jumps | None) -> float:
        """Chi-square of the shapes, of jumps or of normal noise of any strength."""
        _, shapes, errors = self.drawn(of).noisy(self.limits).in_bins(self.edges)
        return float(np.sum(self._shapes_off(shapes, errors) ** 2))

    def best(self) -> Jumps:
        """The nearest jumps, with the errors of least squares: larger where the model does not describe the pixels."""
        both = (False, True)
        found = [self._nearest(double, tailed, start) for double, tailed, start in product(both, both, STARTS)]
        return min(found, key=lambda one: one[0])[1]

    def _nearest(self, double: bool, exponential: bool, amplitude: float) -> tuple[float, Jumps]:
        """Of one kind, and their chi-square."""

        def off(x: np.ndarray) -> np.ndarray:
            return self.off(self._at(x, np.zeros(3), double, exponential))

        def slopes(x: np.ndarray) -> np.ndarray:
            ends = [[np.clip(x + way * step, LOW, HIGH) for way in (1, -1)] for step in np.diag(STEPS)]
            return np.stack([(off(up) - off(down)) / np.sum(up - down) for up, down in ends], 1)

        visible = min(3 * float(self.shares[0].sum()), 0.5)
        start = np.array([np.log(visible), np.log(amplitude + 1 / np.sqrt(self.noise_dn2)), 0.2])
        found = least_squares(off, start, slopes, (LOW, HIGH), x_scale=STEPS, max_nfev=TRIES)
        worse = max(1.0, 2 * found.cost / max(len(found.fun) - len(start), 1))
        covariance = worse * np.linalg.inv(found.jac.T @ found.jac + 1e-6 * np.eye(len(start)))
        return float(found.cost), self._at(found.x, np.sqrt(np.diagonal(covariance)), double, exponential)

    def _at(self, x: np.ndarray, errors: np.ndarray, double: bool, exponential: bool) -> Jumps:
        """Jumps of ln fraction, ln amplitude (in units of the noise) and duty."""
        (fraction, size), scale = np.exp(x[:2]), float(np.sqrt(self.noise_dn2))
        return Jumps(
            fraction=(float(fraction), float(fraction * errors[0])),
            amplitude_dn=(float(scale * size), float(scale * size * errors[1])),
            duty=(float(x[2]), float(errors[2])),
            double_sampling=double,
            exponential=exponential,
            noise_dn2=self.noise_dn2,
        )
