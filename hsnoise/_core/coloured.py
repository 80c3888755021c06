"""Coloured noise series: the power spectra that draws and likelihood share, and the draws.

A spectrum holds the mean power of the n periodogram bins of a series of length n and variance 1: the bins average 1,
and white noise has 1 in each. Bin k stands for min(k, n - k) cycles per series.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are imported when they are used

from hsnoise._core.poisson import normal_of_bits, pixel_words
from hsnoise._core.types import RandomKey, Scalar

EXPONENTS = (-2.0, 3.0)  # of a series by its correlation


def power_law(n: int, exponent: Scalar, dc: Scalar | float = 0.0) -> jax.Array:
    """Spectrum [n] of power k^-exponent at k = 1 ... n/2 cycles, `dc` at k = 0, scaled to a mean of 1.

    The dtype is that of the exponent. A series of length 1 has only k = 0: power 0 without `dc`.
    """
    return _law(_cycles(n, exponent), exponent, dc)


def _cycles(n: int, exponent: Scalar) -> jax.Array:
    """Cycles per series of the bins [n], in the dtype of the exponent."""
    return jnp.abs(jnp.fft.fftfreq(n, 1 / n)).astype(exponent.dtype)


def _law(k: jax.Array, exponent: Scalar, dc: Scalar | float) -> jax.Array:
    """Power k^-exponent, `dc` where k is 0, scaled to a mean of 1."""
    power = jnp.where(k == 0, dc, jnp.exp(-exponent * jnp.log(jnp.maximum(k, 1.0))))
    total = power.sum()
    return power * (len(k) / jnp.where(total > 0, total, 1.0))


def fading_power(n: int, exponent: Scalar) -> jax.Array:
    """Power law [n] whose DC term is 1 for white noise and falls to 0 at an exponent of 1 or -1."""
    return power_law(n, exponent, _fading(exponent))


def _fading(exponent: Scalar) -> jax.Array:
    return jnp.maximum(1 - jnp.abs(exponent), 0.0) ** 2


def power_of_banks(n: int, exponent: Scalar, shared: Scalar | float = 0.0) -> jax.Array:
    """Spectrum [n] of two independent series of `fading_power` that take turns, and one more for a `shared` part.

    Each bank has every second place, so frequencies fold at a quarter of a cycle per place. An odd n has no half a
    cycle.
    """
    k = _cycles(n, exponent)
    own = _law(jnp.minimum(k, (n + 1) // 2 - k), exponent, _fading(exponent))
    return (1 - shared) * own + shared * fading_power(n, exponent)


def exponent_of(correlation: float, n: int, lag: int = 1) -> float:
    """Exponent at which series of `fading_power` [n], less their means, have this correlation `lag` apart.

    Between EXPONENTS: a series of whatever correlation is no redder or bluer. Two apart and more, blue series are
    alike and count as white.
    """

    def off(exponent: float) -> float:
        with jax.enable_x64(True):
            power = np.array(fading_power(n, jnp.float64(exponent)))
        power[0] = 0.0
        return float(power @ np.cos(2 * np.pi * lag * np.arange(n) / n)) / float(power.sum()) - correlation

    low, high = EXPONENTS if lag == 1 else (0.0, EXPONENTS[1])
    if off(low) >= 0 or off(high) <= 0:
        return low if off(low) >= 0 else high
    return float(scipy.optimize.brentq(off, low, high, xtol=1e-4))


def banks_of(next_row: float, next_but_one: float, n: int) -> tuple[float, float]:
    """Exponent, and the part of the variance that both banks share, of two banks with these correlations [n rows].

    Series as `power_of_banks` and `fading_power` have them, less their means. The exponent is from 0 to EXPONENTS; the
    part may lie beyond 0 and 1, as correlations do by chance.
    """
    at = np.cos(2 * np.pi * np.outer([0, 1, 2], np.arange(n)) / n)

    def covariances(exponent: float, shared: float) -> np.ndarray:
        """At lags of 0, 1 and 2 rows."""
        with jax.enable_x64(True):
            power = np.array(power_of_banks(n, jnp.float64(exponent), shared))
        power[0] = 0.0
        return at @ power

    def shared(exponent: float) -> float:
        own, common = (covariances(exponent, of) for of in (0.0, 1.0))
        apart, alike = next_row * own[0] - own[1], common[1] - next_row * common[0]
        return float(apart / max(apart + alike, 1e-12))

    def off(exponent: float) -> float:
        both = covariances(exponent, float(np.clip(shared(exponent), 0.0, 1.0)))
        return float(both[2] / both[0]) - next_but_one

    low, high = 0.0, EXPONENTS[1]
    if off(low) >= 0 or off(high) <= 0:
        exponent = low if off(low) >= 0 else high
    else:
        exponent = float(scipy.optimize.brentq(off, low, high, xtol=1e-4))
    return exponent, shared(exponent)


def row_gain_power(n: int, exponent: Scalar, white_share: Scalar | float | None = None) -> jax.Array:
    """Spectrum [n] of a row gain: a power law without DC term plus a share of white noise with one (None: no share).

    Without a share the mean over all rows is exactly 1 for any exponent.
    """
    coloured = power_law(n, exponent)
    return coloured if white_share is None else (1 - white_share) * coloured + white_share


def power_of_ringing(n: int, frequency: Scalar, memory: Scalar) -> jax.Array:
    """Spectrum [n] of a series whose correlation k apart is memory^k cos(2 pi frequency k), frequency in cycles/place.

    Scaled to a mean of 1: what wraps around a series that is shorter than its memory would add to the variance.
    """
    turn = 2 * jnp.pi * jnp.fft.fftfreq(n).astype(memory.dtype)
    both = sum(
        (1 - memory**2) / (1 - 2 * memory * jnp.cos(turn + sign * 2 * jnp.pi * frequency) + memory**2)
        for sign in (-1, 1)
    )
    return both / jnp.mean(both)


def coloured_normal(key: RandomKey, shape: tuple[int, int, int], power: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """Stationary periodic normal series along axis 1 of `shape`, with independent bins of mean `power` [shape[1]]."""
    series, n, channels = shape
    bins = n // 2 + 1
    frequency = jnp.arange(bins)
    # All bins but those of no and of half a cycle have a real and an imaginary part of half their power.
    parts = jnp.where((frequency == 0) | (2 * frequency == n), n, n / 2)
    half = power[:bins] * parts.astype(power.dtype)
    # The square root of a zero power has a NaN gradient.
    amplitude = jnp.where(half > 0, jnp.sqrt(jnp.where(half > 0, half, 1.0)), 0.0).astype(dtype)[None, :, None]
    real, imaginary = (normal_of_bits(word).astype(dtype) for word in pixel_words(key, (series, bins, channels)))
    return jnp.fft.irfft(jax.lax.complex(real * amplitude, imaginary * amplitude), n=n, axis=1)
