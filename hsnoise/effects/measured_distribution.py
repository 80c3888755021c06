"""Noise of pixels over time with a measured distribution, beside the normal read noise."""

from __future__ import annotations

from typing import ClassVar

import jax
import numpy as np

from hsnoise._core.poisson import by_quantiles, pixel_words
from hsnoise._core.types import Frames, RandomKey, Scalar
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._parameters import measured, param

LARGEST_LOGIT = 16.0  # of the outermost knots: one draw in nine million lies beyond
NORMALISED = 0.01  # deviation of mean and rms that is rounding
FINE = 64  # steps between knots, of integrals


def knots(n: int) -> np.ndarray:
    """Probabilities of `n` knots: equal steps of the logit, so that the tails are as fine as the middle."""
    return 1 / (1 + np.exp(-np.linspace(-LARGEST_LOGIT, LARGEST_LOGIT, n)))


def moments_of(quantiles: np.ndarray) -> tuple[float, float, float]:
    """Mean, rms and excess kurtosis of draws from quantiles at `knots`."""
    logit = np.linspace(-LARGEST_LOGIT, LARGEST_LOGIT, (len(quantiles) - 1) * FINE + 1)
    value = np.interp(logit, np.linspace(-LARGEST_LOGIT, LARGEST_LOGIT, len(quantiles)), quantiles)
    weight = 1 / (2 + 2 * np.cosh(logit))
    weight /= weight.sum()
    mean, square = weight @ value, weight @ value**2
    variance = square - mean**2
    kurtosis = weight @ (value - mean) ** 4 / variance**2 - 3 if variance > 0 else 0.0
    return float(mean), float(np.sqrt(square)), float(kurtosis)


def normalised(quantiles: np.ndarray) -> np.ndarray:
    """The quantiles of the same distribution with mean 0 and rms 1; zeros for one without width."""
    centred = quantiles - moments_of(quantiles)[0]
    rms = moments_of(centred)[1]
    return centred / rms if rms > 0 else centred


class MeasuredDistribution(AbstractEffect):
    """Independent noise of each pixel and frame, sigma times a variable whose distribution is given by quantiles.

    The normal part of the read noise is `read_noise`; this is the rest: heavy tails, skewness, jumps between levels.
    It has mean 0 and, like the read noise, the rms sigma of each pixel's scale (`read_noise_scale`), so the variances
    of the two add up.

    Attributes:
        quantiles: for sigma = 1, of mean 0 and rms 1, at probabilities whose logits are equally spaced from
            -16 to 16; between them it is linear in the logit.

    Reference: Zhang, Lin, Li, Dai, Liu, "Rethinking noise synthesis and modeling in raw denoising", ICCV 2021 (noise
    sampled from dark frames).
    """

    name: ClassVar[str] = "measured_distribution"
    stage: ClassVar[Stage] = Stage.READ
    scaled_by: ClassVar[tuple[str, ...]] = ("read_noise_scale",)
    measurable: ClassVar[bool] = True
    sigma: Scalar = param("e-", low=0, amplitude=True, doc="standard deviation beside that of the normal read noise")
    quantiles: jax.Array = measured(
        "1",
        ("knot",),
        summary=lambda q: moments_of(q)[2],
        summary_unit="1",
        optional=False,
        doc="quantiles for sigma = 1; in tables their excess kurtosis",
    )

    def check_arrays(self) -> None:
        quantiles = np.asarray(self.quantiles, float)
        if len(quantiles) < 2 or np.any(np.diff(quantiles) < 0):
            raise ValueError("measured_distribution.quantiles: expected two quantiles or more that do not fall.")
        mean, rms, _ = moments_of(quantiles)
        if abs(mean) > NORMALISED or abs(rms - 1) > NORMALISED:
            raise ValueError(
                f"measured_distribution.quantiles: expected a mean of 0 and an rms of 1, got {mean} and {rms}."
            )

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        noise = self.sigma * self._draw(key, signal)
        return signal + (noise if capture.read_noise_scale is None else noise * capture.read_noise_scale)

    def _draw(self, key: RandomKey, like: Frames) -> Frames:
        bits, _ = pixel_words(key, like.shape)
        return by_quantiles(bits, self.quantiles.astype(like.dtype), LARGEST_LOGIT)

    def components(self, capture: Capture) -> dict[str, float]:
        return {"temporal": capture.offset_variance(self.sigma**2)}
