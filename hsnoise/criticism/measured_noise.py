"""Noise over time, measured: spectra, a distribution and hits, each by the difference of measured and drawn frames."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from scipy.optimize import nnls

from hsnoise._core.types import channel_index
from hsnoise.criticism.measured_maps import LEAST_READ_DN2, Sensor, of_mean_square_one, pooled
from hsnoise.effects import AbstractEffect, Capture, MeasuredDistribution, MeasuredHits, MeasuredSpectrum
from hsnoise.effects.measured_distribution import knots, moments_of, normalised
from hsnoise.model import NoiseModel
from hsnoise.statistics.apart import Apart, core_sigma
from hsnoise.statistics.deconvolution import quantiles_beside_normal
from hsnoise.statistics.pixels.shrinking import CORE
from hsnoise.statistics.spectra import not_negative, smoothed

KNOTS = 512
BANDS = 8  # of a spectrum, in which a named effect must not overshoot
ALLOWED = 2.0  # by which a named effect's chi-square may exceed that of none
NORMAL_SHARE = 0.8  # of the variance of the core that stays normal: the smoother, the smaller
CORRELATED = 5.0  # errors by chance beyond which neighbours in a row are correlated
SPREAD_MOVES = (0.25, 4.0)  # least and most factor of the variance of a map's logarithms in a round
WIDTHS = 2.0  # of a map's logarithms, within which pixels move
MOST_OF_READ = 0.95  # of the read noise that need not be normal
ADDS_TO = {"row": "row_x_frame", "column": "column_x_frame", "frame": "frame"}
GAINS = ("row_gain", "shared_row_gain")  # of rows: they make rows differ in noise


def of_axis(effect: AbstractEffect, axis: str, like: Capture) -> bool:
    """Whether an effect makes rows, columns or frames differ, or the gain of rows."""
    if effect.name in GAINS:
        return axis in ("row", "gain")
    return ADDS_TO.get(axis) in effect.components(like)


def misfit(axis: str, measured: Sequence[Apart], drawn: Sequence[Apart]) -> float:
    """Chi-square of what drawn frames leave of a spectrum: it should be the same at all exposures, nowhere negative."""
    left, error = [], []
    for one, of in zip(measured, drawn, strict=True):
        a, b = one.powers[axis], of.powers[axis]
        bands = np.array_split(np.arange(len(a)), min(BANDS, len(a)))
        chance = np.sqrt((a**2 + b**2) / one.series_of(axis))
        left.append([np.mean((a - b)[band]) for band in bands])
        error.append([np.sqrt(np.sum(chance[band] ** 2)) / len(band) for band in bands])
    weight = 1 / np.maximum(np.array(error), 1e-12) ** 2
    mean = np.maximum((weight * left).sum(0) / weight.sum(0), 0)
    return float((weight * (np.array(left) - mean) ** 2).sum())


def with_hits(model: NoiseModel, sensor: Sensor) -> NoiseModel:
    """The model with the hits that were set aside; their share is a straight line of exposure."""
    hits = np.concatenate([one.hits for one in sensor.seen])
    if not len(hits):
        return model
    size = np.array([one.rest.size for one in sensor.seen])
    design = np.stack([np.ones(len(size)), sensor.exposure_s], 1)
    design[:, 0 if not sensor.grows and sensor.exposure_s[0] > 0 else 1] *= sensor.grows
    (chance, rate), _ = nnls(design * np.sqrt(size)[:, None], [len(one.hits) for one in sensor.seen] / np.sqrt(size))
    amplitude = np.quantile(hits / np.mean(model["gain"].value), np.linspace(0, 1, KNOTS))
    return model.add(MeasuredHits(chance, rate, amplitude.astype(np.float32)))


def with_spectra(model: NoiseModel, measured: Sequence[Apart], drawn: Sequence[Apart]) -> NoiseModel:
    """The model with spectra that differ from those it had by what was measured minus what was drawn."""
    had = model["measured_spectrum"] if "measured_spectrum" in model else MeasuredSpectrum()
    dof = np.array([one.n_frames - 1 for one in measured])
    fields = {}
    for axis in ("row", "column", "frame", "pixel"):
        seen, found = (np.average([one.powers[axis] for one in of], 0, dof) for of in (measured, drawn))
        before = getattr(had, axis)
        power = seen - found + (0.0 if before is None else np.asarray(before))
        chance = np.median(found) * np.sqrt(2 / sum(one.series_of(axis) for one in measured)) * np.ones_like(power)
        if axis == "frame":
            power = np.maximum(power, 0)
        elif axis == "pixel":
            power = _beyond_white(power, chance)
        else:
            power[0] = 0.0  # the mean of the rows or columns is the frame's
            power = not_negative(power, chance)
        fields[axis] = power.astype(np.float32) if power.any() else None
    return model.add(MeasuredSpectrum(**fields))


def _beyond_white(power: np.ndarray, chance: np.ndarray) -> np.ndarray:
    """A spectrum of pixels above its least value, which is that of independent pixels; zeros if it is flat."""
    angle = np.cos(2 * np.pi * np.linspace(0, 0.5, len(power)))
    # Correlation of neighbours is the first cosine of the spectrum.
    if abs(np.mean(power * angle)) < CORRELATED * float(np.mean(chance)) / np.sqrt(2 * len(power)):
        return np.zeros_like(power)
    even = smoothed(power, chance)
    return even - even.min()


def mean_power(model: NoiseModel) -> float:
    """Variance of the correlated noise of pixels, DN^2."""
    power = model["measured_spectrum"].pixel if "measured_spectrum" in model else None
    return 0.0 if power is None else float(np.mean(power))


def with_read_noise(model: NoiseModel, sensor: Sensor, drawn: Sequence[Apart], spared_dn2: float) -> NoiseModel:
    """The model with the read noise moved by what short exposures lack in variance.

    spared_dn2: what another effect has taken over since `drawn`.
    """
    lacking = [
        one.ordinary_variance() - of.ordinary_variance()
        for one, of, is_short in zip(sensor.seen, drawn, sensor.is_short, strict=True)
        if is_short
    ]
    square, read = float(np.mean(np.asarray(model["gain"].value) ** 2)), float(model["read_noise"].sigma) ** 2
    other = float(model["measured_distribution"].sigma) ** 2 if "measured_distribution" in model else 0.0
    total = max(read + other + (np.mean(lacking) - spared_dn2) / square, LEAST_READ_DN2 / square)
    share = other / (read + other) if read + other > 0 else 0.0
    return _divided(model, total, share)


def with_shot_noise(model: NoiseModel, sensor: Sensor, drawn: Sequence[Apart]) -> NoiseModel:
    """The model whose dark current makes long exposures as noisy as they are; the levels of its pixels stay.

    What the levels grow by need not be charge: the pedestal may move with the exposure, and hot pixels may be quieter
    than Poisson's law.
    """
    whole, long, t = model["measured_map"], ~sensor.is_short, sensor.exposure_s
    if whole.dark_current is None or not long.any():
        return model
    gain = np.asarray(model["gain"].value)
    pairs = zip(sensor.seen, drawn, strict=True)
    lacking = np.array([one.ordinary_variance() - of.ordinary_variance() for one, of in pairs])
    lacking -= lacking[~long].mean()  # which read noise makes up for
    charge = float(model["dark_current"].rate) * np.asarray(whole.dark_current, np.float64)
    found = np.maximum(charge + float(lacking[long] @ t[long] / (t[long] @ t[long])) / float(np.mean(gain**2)), 0)
    if not found.any():
        return model
    growth = (charge - found) * gain[channel_index(model.cfa, found.shape)]
    growth = growth + (0.0 if whole.growth is None else np.asarray(whole.growth))
    fields = (found / found.mean()).astype(np.float32), growth.astype(np.float32)
    whole = eqx.tree_at(lambda of: (of.dark_current, of.growth), whole, fields, is_leaf=lambda of: of is None)
    return model.with_value("dark_current", "rate", found.mean()).add(whole)


def with_spread(model: NoiseModel, sensor: Sensor, drawn: Sequence[Apart]) -> NoiseModel:
    """The model whose map of read noise differs between pixels by what measured variances do, and drawn ones do not."""
    short = [of for of, is_short in zip(drawn, sensor.is_short, strict=True) if is_short]
    read = np.log(np.asarray(model["measured_map"].read_noise, np.float64))
    seen, found = (_width(np.log(np.maximum(pooled(of)[0], LEAST_READ_DN2))) for of in (sensor.short, short))
    lacking = seen**2 - found**2
    own = _width(read)
    if own <= 0:
        return model
    factor = np.sqrt(np.clip(1 + lacking / (2 * own) ** 2, *SPREAD_MOVES))  # a variance is twice as wide
    # The noisiest and the quietest pixels are measured well, and keep their distance.
    off = read - np.median(read)
    core = off * np.exp(-0.5 * (off / (WIDTHS * own)) ** 2)
    read = of_mean_square_one(np.exp(read + (factor - 1) * core))
    return model.add(eqx.tree_at(lambda of: of.read_noise, model["measured_map"], read.astype(np.float32)))


def _width(values: np.ndarray) -> float:
    """Half of the distance of the quantiles at one standard deviation."""
    low, high = np.quantile(values, CORE[::2])
    return float(high - low) / 2


def _divided(model: NoiseModel, total_e2: float, share: float) -> NoiseModel:
    """The read noise, e-^2, divided between its normal part and the measured distribution."""
    model = model.with_value("read_noise", "sigma", np.sqrt((1 - share) * total_e2))
    if "measured_distribution" not in model:
        return model
    return model.with_value("measured_distribution", "sigma", np.sqrt(share * total_e2))


def with_distribution(model: NoiseModel, sensor: Sensor) -> NoiseModel:
    """The model with the distribution of what short exposures have beside normal noise, taken from the read noise."""
    whole = model["measured_map"]
    scale, gain = np.asarray(whole.read_noise), float(np.mean(model["gain"].value))
    values = []
    for one in sensor.short:
        standard = one.rest / (scale * np.sqrt(one.freedom))
        if whole.dark_current is not None:  # the shot noise of bright pixels is not read noise
            dark = np.asarray(whole.dark_current) * float(model["dark_current"].rate) * one.exposure_s * gain
            standard = standard[:, dark < core_sigma(one.rest)]
        values.append(standard[standard != 0])
    pooled = np.concatenate(values)
    if not len(pooled):
        return model
    normal = np.sqrt(NORMAL_SHARE) * core_sigma(pooled)
    quantiles = quantiles_beside_normal(pooled - pooled.mean(), normal, knots(KNOTS))
    mean, rms, _ = moments_of(quantiles)
    total = float(model["read_noise"].sigma) ** 2
    share = min((rms**2 - mean**2) / (gain**2 * total), MOST_OF_READ)
    return _divided(model.add(MeasuredDistribution(0.0, normalised(quantiles).astype(np.float32))), total, share)


def capture_like(model: NoiseModel, shape: tuple[int, int], exposure_s: float) -> Capture:
    """A capture of this model for the formulas of its effects."""
    return Capture(
        jax.numpy.asarray(exposure_s), shape, model.cfa, model.shutter, jax.random.key(0), gain=model["gain"].value
    )
