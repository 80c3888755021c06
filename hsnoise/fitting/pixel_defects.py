"""Pixels that stand out, in electrons: hot ones, hits of single frames, jumps of levels; means over the colours."""

from __future__ import annotations

import numpy as np

from hsnoise.fitting.pixel_fit import PixelFit
from hsnoise.fitting.pixel_flats import of_colours, weighted_mean
from hsnoise.statistics.pixels.population import Population

FANO_SIGMAS = 3.0  # standard errors below 1 at which hot pixels count as sub-Poisson
GROWS = 3.0  # standard errors from which the charge of warm pixels grows with exposure, and has a part that does not


def hot_of(pixel: PixelFit, many: list[tuple[Population, float]]) -> dict[str, dict[str, tuple[float, float]]]:
    """Hot pixels, if most colours have more than by chance: means over those colours."""
    hot = [(p, g) for p, g in many if p.hot_fraction[0] > 0 and p.hot_rate[0] > 0]
    if 2 * len(hot) <= len(many):
        return {}
    found = {
        "fraction": of_colours([p.hot_fraction for p, _ in hot]),
        "rate": of_colours([(p.hot_rate[0] / g, p.hot_rate[1] / g) for p, g in hot]),
        "at_readout": of_colours([(p.at_readout[0] / g, p.at_readout[1] / g) for p, g in hot]),
    }
    found |= of_most("spread", [p.hot_spread for p, _ in hot])
    fano = _fano(pixel)
    return {"hot_pixels": found if fano is None else found | {"fano": fano}}


def of_most(name: str, pairs: list[tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """A shape of the distribution by its name, if most colours have one: mean over those colours."""
    heavy = [pair for pair in pairs if pair[0] != 0]
    return {name: of_colours(heavy)} if 2 * len(heavy) > len(pairs) else {}


def warm_of(pixel: PixelFit, gain: np.ndarray, exposure_s: float) -> dict[str, dict[str, tuple[float, float]]]:
    """Hot pixels from repeated darks of one exposure.

    Flats may tell how much of their charge is that of the readout; else it is all of it in darks of 0 s, and none in
    others.
    """
    many = [(c.warm, g) for c, g in zip(pixel.channels, gain, strict=True) if c.warm is not None]
    if not many:
        return {}
    fraction = of_colours([warm.fraction for warm, _ in many])
    charge = of_colours([(warm.extra_dn[0] / g, warm.extra_dn[1] / g) for warm, g in many])
    tail = of_colours([warm.spread for warm, _ in many])
    hot = {"fraction": fraction} | ({"spread": tail} if tail[0] > 0 else {})
    told = [warm.growth for warm, _ in many if np.isfinite(warm.growth[1])]
    growth, error = weighted_mean(told) if told else (0.0, np.inf)
    at_readout = 1 - growth * exposure_s
    if growth > GROWS * error and (at_readout > GROWS * error * exposure_s or exposure_s == 0):
        rate = charge[0] * growth, float(np.hypot(charge[1] * growth, charge[0] * error))
        of_readout = float(np.hypot(charge[1] * at_readout, charge[0] * error * exposure_s))
        return {"hot_pixels": {**hot, "rate": rate, "at_readout": (charge[0] * at_readout, of_readout)}}
    if exposure_s > 0:
        return {"hot_pixels": {**hot, "rate": (charge[0] / exposure_s, charge[1] / exposure_s)}}
    return {"hot_pixels": {**hot, "rate": (0.0, np.inf), "at_readout": charge}}


def rays_of(pixel: PixelFit, gain: np.ndarray) -> dict[str, dict[str, tuple[float, float]]]:
    """Cosmic rays, if all colours have hits of single frames: means over the colours."""
    told = [(c.rays, g) for c, g in zip(pixel.channels, gain, strict=True) if c.rays is not None]
    if len(told) < len(pixel.channels):
        return {}
    charge = of_colours([(rays.charge_dn[0] / g, rays.charge_dn[1] / g) for rays, g in told])
    rate, at_readout = (of_colours([of[i] for of, _ in told]) for i in (0, 2))
    return {"cosmic_rays": {"rate": rate, "charge": charge, "at_readout": at_readout}}


def jumps_of(pixel: PixelFit, gain: np.ndarray) -> dict[str, dict[str, tuple[float, float]]]:
    """Pixels that jump, if all colours have them, of one kind: means over the colours."""
    told = [(c.jumps, g) for c, g in zip(pixel.channels, gain, strict=True) if c.jumps is not None]
    if len(told) < len(pixel.channels) or len({jumps[3:5] for jumps, _ in told}) > 1:
        return {}
    amplitude = of_colours([(jumps.amplitude_dn[0] / g, jumps.amplitude_dn[1] / g) for jumps, g in told])
    fraction, duty = (of_colours([getattr(jumps, name) for jumps, _ in told]) for name in ("fraction", "duty"))
    spread = float(told[0][0].exponential), np.inf
    return {"random_telegraph_noise": {"fraction": fraction, "amplitude": amplitude, "duty": duty, "spread": spread}}


def _fano(pixel: PixelFit) -> tuple[float, float] | None:
    """Fano factor of the hot pixels, if significantly below 1; flats give it more precisely than ordinary pixels."""
    told = []
    for c, channel in enumerate(pixel.channels):
        t = channel.transfer
        if t is None or not np.isfinite(t.hot_gain) or not pixel.determined:
            continue
        gain, error = pixel.estimate[c], np.sqrt(pixel.covariance[c, c])
        ratio = t.hot_gain / gain
        told.append((ratio, ratio * np.hypot(t.hot_error / t.hot_gain, error / gain)))
    if not told:
        return None
    value, error = weighted_mean(told)
    return (float(np.clip(value, 0.5, 1.0)), error) if value < 1 - FANO_SIGMAS * error else None
