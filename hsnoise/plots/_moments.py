"""Mean and variance of counts expected by the fitted model, including clipping and rounding."""

from __future__ import annotations

import jax
import numpy as np

from hsnoise._core.quadrature import normal_nodes
from hsnoise.likelihood.darks import black_level_at, dark_current
from hsnoise.lut import clipped_moments
from hsnoise.model import NoiseModel

BETA_NODES = 32
LEAST_BETA = 1e-6


def beta_rule(sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights [beta] of the row gain Normal(1, sigma^2)."""
    z, weight = normal_nodes(BETA_NODES)
    return 1 + sigma * z, weight


def black_levels(model: NoiseModel, exposure_s) -> np.ndarray:
    """Where counts without electrons lie, DN [exposure, channel]."""
    with jax.enable_x64(True):  # the numbers of a fit are of double precision
        return np.asarray(black_level_at(model, np.asarray(exposure_s)))


def count_moments(model: NoiseModel, c: int, exposure_s, beta, white_level_dn: float | None):
    """Mean above black (DN) and variance (DN^2) of a pixel's count, [exposure, beta], for channel number `c`.

    exposure_s [exposure] in s; beta [beta], gains below zero count as zero. Counts are rounded, and clipped at 0
    and at the white level.
    """
    gain = float(model["gain"].value[c]) * np.maximum(np.asarray(beta)[None, :], LEAST_BETA)
    mean_e = float(dark_current(model)) * np.asarray(exposure_s)[:, None]
    black = black_levels(model, exposure_s)[:, c, None]
    mean, variance = clipped_moments(
        gain * mean_e,
        gain**2 * (mean_e + float(model["read_noise"].sigma) ** 2),
        gain=gain + 0 * mean_e,
        black_level_dn=black + 0 * gain,
        white_level_dn=white_level_dn,
    )
    return np.asarray(mean), np.asarray(variance)
