"""A pixel-conditional fit as a `FitResult`: model, table, errors, what is withheld."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise.effects import (
    ADC,
    AbstractEffect,
    BlackLevel,
    BlackShading,
    ColumnFixedPattern,
    ColumnNoise,
    DarkCurrent,
    DarkCurrentNonuniformity,
    DarkSignalNonuniformity,
    FrameOffset,
    Gain,
    HotPixels,
    ReadNoise,
    RowFixedPattern,
    RowGain,
    RowNoise,
    ShotNoise,
)
from hsnoise.fitting.pixel_fit import PATTERNS, ROW_GAIN_THERE, UNKNOWN, Channel, PixelFit
from hsnoise.fitting.result import FitResult, Method, Status
from hsnoise.likelihood.physics import Physics
from hsnoise.likelihood.summary import Summary
from hsnoise.model import NoiseModel
from hsnoise.statistics.pixels.shading import Shading
from hsnoise.statistics.pixels.transfer import ROUNDING

NOMINAL = 50.0  # relative deviation of a gain of which nothing is known
FANO_SIGMAS = 3.0  # standard errors below 1 from which hot pixels are below Poisson
THERE = 5.0  # standard errors from which an effect of the population is in the model
ROLLING_EXPONENT = 1.0  # of the paper; pixels over time do not tell it
IN_OTHER_UNITS = {"dark_current_nonuniformity", "black_shading"}
IN_ELECTRONS = ("gain", "dark_current.rate", "read_noise.sigma")
OF_PIXELS = (
    DarkCurrentNonuniformity,
    DarkSignalNonuniformity,
    HotPixels,
    FrameOffset,
    RowFixedPattern,
    ColumnFixedPattern,
    RowNoise,
    ColumnNoise,
    BlackShading,
)
POPULATION = tuple(effect.name for effect in OF_PIXELS)  # what a pixel-conditional fit measures beyond the paper
PATTERN_THERE, LEAST_PATTERN = 6.0, 1e-3  # deviations by chance, share of the temporal variance
BASE = ("shot_noise", "dark_current", "read_noise", "row_gain", "gain", "black_level", "adc")


def result_of(pixel: PixelFit, summary: Summary, model: NoiseModel | None, stack) -> FitResult:
    """The result; `model` says which effects are wanted (None: the paper's, and those of the population found)."""
    gain, read, rate = _electrons(pixel)
    population = _population(pixel, gain)
    wanted = [*BASE, *population] if model is None else list(model.names)
    added = tuple(name for name in population if model is None)
    black, row = _black(pixel, summary), _rows(pixel)
    with jax.enable_x64(True):
        physics = Physics(
            gain=jnp.asarray(gain),
            dark_current=jnp.asarray(max(rate, 0.0)),
            read_noise=jnp.asarray(read),
            row_sigma=jnp.asarray(row[0]) if "row_gain" in wanted else None,
            exponent=jnp.asarray(ROLLING_EXPONENT if summary.shutter == "rolling" else 0.0),
            black_level=jnp.asarray(black[0]),
        )
        params = _model(wanted, physics, population, summary, pixel)
    names, covariance = _covariance(pixel, params, population, black[1], row)
    withheld = () if pixel.determined else tuple(n for n in params.table if in_electrons(n))
    errors = dict(zip(names, np.sqrt(np.diagonal(covariance)), strict=True))
    unknown = [name for name, error in errors.items() if name.startswith("row_gain.sigma") and error > 1]
    if np.ptp(summary.exposure_s) == 0 and "dark_current" in params:
        unknown.append("dark_current.rate")
    withheld = tuple(dict.fromkeys((*withheld, *unknown)))
    return FitResult(
        params=params,
        physics=jax.tree.map(np.asarray, physics),
        names=names,
        covariance=covariance,
        method=Method.TRANSFER,
        status=Status.TRANSFER,
        detail=_detail(pixel),
        iterations=0,
        log_likelihood=float("nan"),
        notes=(),
        summary=summary,
        withheld=withheld,
        added=added,
        transfer=pixel,
        stack=stack,
    )


def in_electrons(name: str) -> bool:
    """Whether a parameter has no value without the gain."""
    effect = name.split(".")[0]
    return name.startswith(IN_ELECTRONS) or effect in set(POPULATION) - IN_OTHER_UNITS


def _detail(pixel: PixelFit) -> str:
    told = [c.transfer for c in pixel.channels if c.transfer is not None]
    if pixel.flats is not None and pixel.determined:
        return "gain from the flats, read noise from each pixel over time"
    if not told or not pixel.determined:
        return "each pixel over time, no gain"
    chi2 = ", ".join(f"{t.chi2 / max(t.dof, 1):.2f}" for t in told)
    return f"gain from {sum(len(t.classes.pixels) for t in told)} classes of pixels, chi2 per degree of freedom {chi2}"


def _electrons(pixel: PixelFit) -> tuple[np.ndarray, float, float]:
    """Gain [channel], read noise, dark current; with a gain of 1 where none is determined."""
    n = len(pixel.channels)
    if pixel.determined:
        return pixel.estimate[:n], abs(float(pixel.estimate[n])), float(pixel.estimate[n + 1])
    floor = float(np.mean([max(c.values[1] - ROUNDING, 0.0) for c in pixel.channels]))
    return np.ones(n), float(np.sqrt(floor)), float(np.mean([c.values[2] for c in pixel.channels]))


def _population(pixel: PixelFit, gain: np.ndarray) -> dict[str, dict[str, tuple[float, float]]]:
    """Effects of the population that are there: name to field to (value, error), means over the colours."""
    found: dict[str, dict[str, tuple[float, float]]] = {}
    drift = _shading(pixel)
    if drift is not None:
        _, one = drift
        found["black_shading"] = {"amplitude": (one.amplitude_dn, one.error_dn), "length": (one.length, 0.0)}
    for name in PATTERNS.values():
        many_of = [
            (c.patterns.get(name, (0.0, 0.0, 0.0)), g, c.temporal_dn2)
            for c, g in zip(pixel.channels, gain, strict=True)
        ]
        variance, error = _mean([(of[0] / g**2, of[1] / g**2) for of, g, _ in many_of])
        _, chance = _mean([(0.0, of[2] / g**2) for of, g, _ in many_of])
        noise = float(np.mean([t / g**2 for _, g, t in many_of]))
        if variance > max(PATTERN_THERE * chance, LEAST_PATTERN * noise):
            found[name] = {"sigma": (np.sqrt(variance), error / (2 * np.sqrt(variance)))}
    offset = _mean([(c.offset_dn[0] / g, c.offset_dn[1] / g) for c, g in zip(pixel.channels, gain, strict=True)])
    if offset[0] > THERE * offset[1]:
        found["dark_signal_nonuniformity"] = {"sigma": offset}
    many = [(c.population, g) for c, g in zip(pixel.channels, gain, strict=True) if c.population is not None]
    if not many:
        return found
    spread = _mean(
        [(p.spread[0], np.hypot(p.spread[1], p.spread[0] * _mean_error(c))) for (p, _), c in _with(pixel, many)]
    )
    hot = {
        "fraction": _mean([p.hot_fraction for p, _ in many]),
        "rate": _mean([(p.hot_rate[0] / g, p.hot_rate[1] / g) for p, g in many]),
        "at_readout": _mean([(p.at_readout[0] / g, p.at_readout[1] / g) for p, g in many]),
    }
    fano = _fano(pixel)
    if fano is not None:
        hot["fano"] = fano
    if spread[0] > THERE * spread[1]:
        found["dark_current_nonuniformity"] = {"spread": spread}
    if hot["fraction"][0] > THERE * hot["fraction"][1] and hot["rate"][0] > 0:
        found["hot_pixels"] = hot
    return found


def _shading(pixel: PixelFit) -> tuple[str, Shading] | None:
    """Axis and size of the strongest drift of the black level, of the first colour that has one."""
    many = [(axis, one) for c in pixel.channels[:1] for axis, one in c.shading.items()]
    return max(many, key=lambda pair: pair[1].amplitude_dn) if many else None


def _fano(pixel: PixelFit) -> tuple[float, float] | None:
    """Fano factor of the hot pixels, where it is below 1 beyond chance; flats tell it better than ordinary pixels."""
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
    weight = np.array([e**-2 for _, e in told])
    value, error = float(weight @ [v for v, _ in told] / weight.sum()), float(weight.sum() ** -0.5)
    return (float(np.clip(value, 0.5, 1.0)), error) if value < 1 - FANO_SIGMAS * error else None


def _with(pixel: PixelFit, many):
    return zip(many, [c for c in pixel.channels if c.population is not None], strict=True)


def _mean_error(channel: Channel) -> float:
    """Relative error of the mean dark current: spread is relative to it."""
    return float(np.sqrt(channel.covariance[2, 2]) / max(abs(channel.values[2]), 1e-12))


def _mean(pairs: list[tuple[float, float]]) -> tuple[float, float]:
    """Mean of values over the colours and its error; infinite errors are those of values of 0."""
    values, errors = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    return float(values.mean()), float(np.sqrt((errors**2).sum()) / len(pairs))


def _black(pixel: PixelFit, summary: Summary) -> tuple[np.ndarray, np.ndarray]:
    """Black level [channel] and its error: as given, or the level without signal."""
    if summary.black_level_dn is not None:
        return np.asarray(summary.black_level_dn, float), np.zeros(len(pixel.channels))
    return np.array([c.black_dn[0] for c in pixel.channels]), np.array([c.black_dn[1] for c in pixel.channels])


def _rows(pixel: PixelFit) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviation of the gain of rows [channel] and its error; 0 where it is not beyond chance."""
    sigma, error = [], []
    for c in pixel.channels:
        variance, of = c.row_gain
        there = variance > ROW_GAIN_THERE * of
        sigma.append(np.sqrt(variance) if there else 0.0)
        error.append(of / (2 * np.sqrt(variance)) if there else np.sqrt(max(variance, 0.0) + 2 * of))
    return np.array(sigma), np.array(error)


def _model(wanted: list[str], physics: Physics, population: Mapping, summary: Summary, pixel: PixelFit) -> NoiseModel:
    made = {
        "shot_noise": ShotNoise,
        "dark_current": lambda: DarkCurrent(physics.dark_current),
        "read_noise": lambda: ReadNoise(physics.read_noise),
        "row_gain": lambda: RowGain(physics.row_sigma, physics.exponent),
        "gain": lambda: Gain(physics.gain),
        "black_level": lambda: BlackLevel(physics.black_level),
        "adc": lambda: ADC(summary.white_level_dn),
    }
    effects: list[AbstractEffect] = [made[name]() for name in wanted if name in made]
    classes: dict[str, Any] = {cls.name: cls for cls in OF_PIXELS}
    for name in wanted:
        if name in classes:
            fields = {field: max(value, 0.0) for field, (value, _) in population.get(name, {}).items()}
            required = [f.name for f in dataclasses.fields(classes[name]) if f.default is dataclasses.MISSING]
            fields = fields or {field: classes[name].specs()[field].low or 0.0 for field in required}
            drift = _shading(pixel) if name == "black_shading" else None
            chosen = {} if drift is None else {"axis": drift[0], "start": drift[1].start, "above": drift[1].above}
            effects.append(classes[name](**fields, **chosen))
    t = np.sort(summary.exposure_s)
    return NoiseModel(effects, cfa=summary.cfa, shutter=summary.shutter, exposure_s=float(t[len(t) // 2]))


def _without_gain(pixel: PixelFit, params: NoiseModel) -> np.ndarray:
    """Covariance of gain, read noise and dark current where only their products, in DN, are known."""
    n = len(pixel.channels)
    read, rate = (
        float(params["read_noise"].sigma),
        float(params["dark_current"].rate) if "dark_current" in params else 0.0,
    )
    along = np.append(np.ones(n), [-read, -rate])
    floor, growth = (float(np.mean([c.covariance[i, i] for c in pixel.channels])) / n for i in (1, 2))
    known = np.append(np.full(n, 1e-6), [np.sqrt(floor) / max(2 * read, 1e-6), min(np.sqrt(growth), UNKNOWN)])
    return NOMINAL**2 * np.outer(along, along) + np.diag(known**2)


def _covariance(
    pixel: PixelFit, params: NoiseModel, population, black_error, row
) -> tuple[tuple[str, ...], np.ndarray]:
    """Names that were fitted and their covariance: gain, read noise, dark current together, others by themselves."""
    table, channels = params.table, params.channels
    suffix = [""] if channels == ("mono",) else [f".{c}" for c in channels]
    joint = [*(f"gain{s}" for s in suffix), "read_noise.sigma", "dark_current.rate"]
    errors: dict[str, float] = {}
    for c, s in enumerate(suffix):
        errors[f"row_gain.sigma{s}"] = float(row[1][c])
        if black_error[c] > 0:
            errors[f"black_level{s}"] = float(black_error[c])
    for effect, fields in population.items():
        errors |= {f"{effect}.{field}": error for field, (_, error) in fields.items() if np.isfinite(error)}
    names = [n for n in (*joint, *errors) if n in table]
    covariance = np.diag([errors.get(n, 0.0) ** 2 for n in names])
    places = [names.index(n) for n in joint if n in names]
    kept = [i for i, n in enumerate(joint) if n in names]
    whole = pixel.covariance if pixel.determined else _without_gain(pixel, params)
    covariance[np.ix_(places, places)] = whole[np.ix_(kept, kept)]
    return tuple(names), covariance
