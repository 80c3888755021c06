"""The likelihood of flats: temporal variance against mean (photon transfer), row power, known photons."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from hsnoise.likelihood.flats import FlatMoments

ROUNDING_VARIANCE = 1 / 12  # of rounding to whole counts, DN^2
LEAST_SIGNAL_DN = 1e-3


class FlatLaw(NamedTuple):
    """What the moments of flats stand on: gain [channel] DN/e-, black [level, channel] DN, dark signal [level] e-,
    read noise e-, variance of the gain of rows [channel]."""

    gain: jax.Array
    black_dn: jax.Array
    dark_e: jax.Array
    read_noise_e: jax.Array
    row_variance: jax.Array


def flat_variance(law: FlatLaw, flats: FlatMoments) -> jax.Array:
    """Expected temporal variance within rows [level, channel], DN^2: the photon transfer line, or the curve.

    Above that of darks measured likewise, if there are any: what darks and flats share beside shot noise (interference
    in columns, clipping of wide tails) then cannot enter the gain.
    """
    shot = law.gain[None, :] * jnp.asarray(flats.curve) * (1 + law.row_variance[None, :])
    black, read = without_light(law, flats)
    return read + shot * jnp.maximum(jnp.asarray(flats.mean_dn) - black, LEAST_SIGNAL_DN)


def without_light(law: FlatLaw, flats: FlatMoments) -> tuple[jax.Array, jax.Array]:
    """Mean count, DN, and temporal variance, DN^2, without this light [level, channel]: of darks, else by the model."""
    row = 1 + law.row_variance[None, :]
    read = ((law.gain * law.read_noise_e) ** 2)[None, :] * row + ROUNDING_VARIANCE
    measured = jnp.isfinite(jnp.asarray(flats.dark_dn))
    black = jnp.where(measured, jnp.nan_to_num(jnp.asarray(flats.dark_dn)), law.black_dn)
    return black, jnp.where(measured, jnp.nan_to_num(jnp.asarray(flats.dark_variance_dn2)), read)


def flat_log_likelihood(law: FlatLaw, flats: FlatMoments) -> jax.Array:
    """Log-likelihood (nats, up to a constant) of the photon transfer of flats. Light levels are profiled out.

    The light of a level is what its mean says, and where the photons are known the mean itself counts (EMVA 1288
    release 4, section 6).
    """
    used = jnp.asarray(flats.weight) > 0
    variance = flat_variance(law, flats)
    total = _gamma_log_density(flats.variance_dn2, flats.weight, variance).sum()
    signal = jnp.maximum(jnp.asarray(flats.mean_dn) - law.black_dn, LEAST_SIGNAL_DN)
    # Of the variance that was measured: neighbours that are correlated would pull the gain through their rows.
    row_power = law.row_variance[None, :] * signal**2 + jnp.asarray(flats.variance_dn2 / flats.row_pixels)
    total += jnp.where(used, _gamma_log_density(flats.row_power_dn2, flats.row_dof, row_power), 0.0).sum()
    if flats.photons_e is not None:
        photons = jnp.nan_to_num(jnp.asarray(flats.photons_e))[:, None]
        expected = law.black_dn + law.gain[None, :] * (photons + law.dark_e[:, None])
        residual = jnp.asarray(flats.mean_dn) - expected
        mean_variance = row_power / (jnp.asarray(flats.row_dof) + 1)
        known = used & jnp.isfinite(jnp.asarray(flats.photons_e))[:, None]
        total += jnp.where(known, -0.5 * residual**2 / mean_variance - 0.5 * jnp.log(mean_variance), 0.0).sum()
    return total


def _gamma_log_density(measured, dof, expected) -> jax.Array:
    """Log density of a mean square with `dof` degrees of freedom, up to a constant."""
    return -0.5 * jnp.asarray(dof) * (jnp.log(expected) + jnp.asarray(measured) / expected)
