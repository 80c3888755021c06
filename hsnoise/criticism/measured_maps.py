"""The maps of one sensor, measured: offset, dark current and noise of each pixel, without the noise of estimation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh
from scipy.stats import chi2

from hsnoise._core.types import Window, cfa_tile, channel_index
from hsnoise.effects import MeasuredMap
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import black_level_of
from hsnoise.statistics.apart import CORE_SIGMAS, ORDINARY, Apart, core_sigma
from hsnoise.statistics.pixels.narrow import Narrow
from hsnoise.statistics.pixels.shrinking import NEAR, surroundings, values_from_posterior, variances_from_posterior
from hsnoise.statistics.spectra import periodogram, series_from_posterior

ROUNDING = 1 / 12  # variance of rounding, DN^2
LEAST_READ_DN2 = 0.01  # read noise that is lost in rounding
LEAST_SHARE = 0.05  # of the usual read noise, of the quietest pixel
SHORT = 0.25  # of the longest exposure: below, noise is read noise
HOT_TIMES = 3.0  # times the usual dark current, beyond which a pixel is hot
LINES_DIFFER = 5.0  # errors by chance beyond which lines differ in noise
LOWEST = 0.02  # share of the pixels with the least dark current, which counts as none where it comes out negative


@dataclass(frozen=True)
class Sensor:
    """Dark exposures of one sensor taken apart, and the random numbers of its posterior.

    window: as in FrameStack; narrow: levels and noise of the pixels, where their noise is below a count.
    """

    seen: Sequence[Apart]
    rng: np.random.Generator
    window: Window | None
    narrow: Narrow | None = None

    @property
    def exposure_s(self) -> np.ndarray:
        return np.array([one.exposure_s for one in self.seen])

    @property
    def grows(self) -> bool:
        """Whether there are several exposures."""
        return len(set(self.exposure_s)) > 1

    @property
    def is_short(self) -> np.ndarray:
        """Which exposures are short enough for read noise to dominate [exposure]."""
        return self.exposure_s <= max(SHORT * self.exposure_s.max(), self.exposure_s.min())

    @property
    def short(self) -> list[Apart]:
        return [one for one, is_short in zip(self.seen, self.is_short, strict=True) if is_short]

    @property
    def long(self) -> list[Apart]:
        return [one for one, is_short in zip(self.seen, self.is_short, strict=True) if not is_short]

    def with_map(self, model: NoiseModel) -> NoiseModel:
        """The model with the maps of this sensor; the rate of the dark current is their mean."""
        return self._with_averages(model) if self.narrow is None else self._with_narrow(model, self.narrow)

    def _with_narrow(self, model: NoiseModel, narrow: Narrow) -> NoiseModel:
        """The same where counts do not average to levels: offset and noise; the dark current of the fit stays."""
        one, channel = max(self.seen, key=lambda one: one.n_frames), channel_index(model.cfa, narrow.level.shape)
        gain = np.asarray(model["gain"].value)[channel]
        dark = gain * float(model["dark_current"].rate) * one.exposure_s if "dark_current" in model else 0.0
        shared = sum(float(np.mean(of**2)) for of in (one.frame, one.row, one.column)) / (one.freedom * narrow.slope**2)
        read = np.sqrt(np.maximum(narrow.sigma**2 - shared, LEAST_READ_DN2)) / gain
        model = model.with_value("read_noise", "sigma", np.sqrt(np.mean(read**2)))
        maps = {"offset": narrow.level - dark - black_level_of(model)[channel], "read_noise": of_mean_square_one(read)}
        return self._added(model, maps)

    def _with_averages(self, model: NoiseModel) -> NoiseModel:
        step, shape = len(cfa_tile(model.cfa)), self.seen[0].mean.shape
        channel = channel_index(model.cfa, shape)
        gain = np.asarray(model["gain"].value)[channel]
        offset, growth = np.empty(shape), np.zeros(shape)
        for p in range(step * step):
            at = (slice(p // step, None, step), slice(p % step, None, step))
            offset[at], growth[at] = self.levels(at)
        if self.grows and "black_clamp" in model:  # stays in the model, and subtracts from what grows
            growth += np.asarray(model["black_clamp"].rate)[channel]
        charge = self._charge(growth, gain) if self.grows and "dark_current" in model else np.zeros(shape)
        read, fluctuation = self._noise(charge, gain)
        if not self.grows and "dark_current" in model:  # the fit's dark current stays, and is in the level
            offset -= gain * float(model["dark_current"].rate) * self.exposure_s[0]
        maps = {"offset": offset - black_level_of(model)[channel], "read_noise": of_mean_square_one(read / gain)}
        if self.grows and "dark_current" in model:
            rate = charge / gain
            model = model.with_value("dark_current", "rate", rate.mean())
            maps |= {"growth": growth - charge} if np.any(growth != charge) else {}
            if rate.any():
                maps |= {"dark_current": rate / rate.mean(), "dark_fluctuation": fluctuation}
        return self._added(model, maps)

    def _added(self, model: NoiseModel, maps: dict[str, np.ndarray]) -> NoiseModel:
        first = (0, 0) if self.window is None else self.window[:2]
        return model.add(MeasuredMap(**{name: x.astype(np.float32) for name, x in maps.items()}, first=first))

    def levels(self, at: tuple[slice, slice]) -> tuple[np.ndarray, np.ndarray]:
        """Offset, DN, and growth, DN/s, of each pixel of a plane, drawn from the posterior."""
        n, t = np.array([one.n_frames for one in self.seen]), self.exposure_s
        noise = np.array([one.ordinary_variance(at) for one in self.seen]) / n
        design = np.stack([np.ones_like(t), t], 1) if self.grows else np.ones((len(t), 1))
        weighted = design / noise[:, None]
        solve = np.linalg.inv(design.T @ weighted) @ weighted.T  # [quantity, exposure]
        estimate = np.tensordot(solve, np.stack([one.mean[at] for one in self.seen]).astype(float), 1)
        halves = np.stack([np.tensordot(solve, np.stack([x.halves[h][at] for x in self.seen]), 1) for h in (0, 1)])
        lines = np.zeros_like(estimate)
        for axis in ("row", "column"):
            own, drawn = self._lines(axis, at, solve, estimate)
            estimate, halves, lines = estimate - own, halves - own, lines + drawn
        covariance = solve @ np.diag(noise) @ solve.T
        drawn = _jointly(estimate, halves, covariance, self.rng) + lines
        if not self.grows:
            return drawn[0], np.zeros_like(drawn[0])
        return drawn[0], drawn[1]

    def _charge(self, growth: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """The part of each pixel's growth, DN/s, that is dark current.

        Where pedestals fall as fast as dark current rises, only their sum is measured. It shows by pixels that seem to
        lose charge; then the growth of the temporal variance says how much charge the usual pixel has.
        """
        if np.quantile(growth, LOWEST) >= 0:
            return np.maximum(growth, 0)
        variance = np.array([one.ordinary_variance() for one in self.seen])
        shot = max(float(np.polyfit(self.exposure_s, variance, 1)[0]), 0.0) / float(gain.mean())
        return np.maximum(growth - float(np.median(growth)) + shot, 0)

    def _lines(self, axis: str, at, solve: np.ndarray, estimate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means of rows or columns of each quantity, measured and drawn from the posterior [quantity, ...]."""
        over, place = (2, at[0]) if axis == "row" else (1, at[1])
        series = [getattr(one, axis)[:, place] for one in self.seen]
        # Half of the frames have half of the lines' own noise, which the halves of the maps lack.
        apart = np.stack([np.tensordot(solve, np.stack([x[h::2].mean(0) for x in series]), 1) for h in (0, 1)])
        power = np.stack([periodogram(x) / (one.freedom * len(x)) for x, one in zip(series, self.seen, strict=True)])
        measured = np.stack([_line_means(one, over) for one in estimate])
        drawn = [
            series_from_posterior(mean, mean + apart[:, q], solve[q] ** 2 @ power, self.rng)
            for q, mean in enumerate(measured)
        ]
        return np.expand_dims(measured, over), np.expand_dims(np.stack(drawn), over)

    def _noise(self, growth: np.ndarray, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Read noise of each pixel, DN, and the relative change of its dark current from frame to frame."""
        variance, exposure_s, dof = pooled(self.short)
        shot = gain * growth * exposure_s
        usual = max(float(np.median(variance - shot)) * dof / chi2.median(dof) - ROUNDING, LEAST_READ_DN2)
        expected = usual + shot + ROUNDING
        expected = expected * _noise_of_lines(variance / expected)
        own = expected * variances_from_posterior(variance / expected, dof, self.rng) - shot - ROUNDING
        own = np.maximum(own, LEAST_SHARE * usual)
        if not self.long:
            return np.sqrt(own), np.zeros_like(own)
        variance, exposure_s, dof = pooled(self.long)
        dark = growth * exposure_s
        expected = own + gain * dark + ROUNDING
        beyond = expected * (variances_from_posterior(variance / expected, dof, self.rng) - 1)
        is_hot = dark > np.maximum(np.sqrt(expected), HOT_TIMES * np.median(dark))
        return np.sqrt(own), np.where(is_hot, np.sqrt(np.maximum(beyond, 0)) / np.where(is_hot, dark, 1), 0).clip(0, 1)


def _noise_of_lines(ratio: np.ndarray) -> np.ndarray:
    """How much noisier rows and columns are than usual [row, column], by the variances of their pixels.

    A line has a thousand pixels: what they share is known far better than any of them, and would be lost in a draw of
    each pixel by itself.
    """
    usual = np.minimum(ratio, np.quantile(ratio, ORDINARY))
    found = np.ones_like(ratio)
    for axis in (0, 1):
        across = usual.mean(1 - axis, keepdims=True)
        error = float(np.mean(usual.var(1 - axis))) / usual.shape[1 - axis]
        beyond = float(across.var()) - error
        if beyond > LINES_DIFFER * error * np.sqrt(2 / usual.shape[axis]):
            share = beyond / (beyond + error)
            found = found * (1 + share * (across / across.mean() - 1))
    return found


def of_mean_square_one(values: np.ndarray) -> np.ndarray:
    return values / np.sqrt(np.mean(values**2))


def pooled(parts: Sequence[Apart]) -> tuple[np.ndarray, float, int]:
    """Temporal variance of each pixel over some exposures, their mean exposure, and its degrees of freedom."""
    dof = np.array([one.n_frames - 1 for one in parts])
    variance = sum(d * one.variance for d, one in zip(dof, parts, strict=True)) / dof.sum()
    return variance, float(dof @ [one.exposure_s for one in parts] / dof.sum()), int(dof.sum())


def _line_means(values: np.ndarray, over: int) -> np.ndarray:
    """Means of rows (over 2) or columns (over 1) of a map [row, column] from its core, about their mean."""
    local = values - np.median(values)
    width = CORE_SIGMAS * core_sigma(local)
    mean = np.clip(local, -width, width).mean(over - 1)
    return mean - mean.mean()


def _jointly(estimate: np.ndarray, halves: np.ndarray, covariance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Quantities of the pixels [quantity, row, column], offset and perhaps growth, drawn from their posterior.

    Drawn are the mixtures of them whose errors, of this covariance, are independent and whose true values are
    uncorrelated: so what pixels have in common stays, such as charge that they gather while they are read.
    """
    mix = eigh(_true_covariance(estimate, halves), covariance)[1].T  # errors of the mixtures are 1
    values, parts = np.tensordot(mix, estimate, 1), np.einsum("ij,hj...->ih...", mix, halves)
    drawn = [values_from_posterior(one, of, 1.0, rng) for one, of in zip(values, parts, strict=True)]
    return np.tensordot(np.linalg.inv(mix), np.stack(drawn), 1)


def _true_covariance(estimate: np.ndarray, halves: np.ndarray) -> np.ndarray:
    """Covariance of quantities over ordinary pixels, free of the noise of estimation: one half with the other."""
    even = np.stack([surroundings(one) for one in estimate])
    ordinary = [np.abs(one) < NEAR * core_sigma(one) for one in estimate - even]
    a, b = ((half - even)[:, np.all(ordinary, 0)] for half in halves)
    return (a @ b.T + b @ a.T) / (2 * max(a.shape[1], 1))
