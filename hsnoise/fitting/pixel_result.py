"""A pixel-conditional fit as a `FitResult`: model, table, errors, what is withheld."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from hsnoise.effects import (
    AbstractEffect,
    AdcNonuniformity,
    AmplifierGlow,
    BlackClamp,
    BlackShading,
    BrighterFatter,
    ColumnFixedPattern,
    ColumnNoise,
    CorrelatedReadNoise,
    CosmicRays,
    DarkCurrentNonuniformity,
    DarkSignalNonuniformity,
    ElectronMultiplication,
    FrameOffset,
    FrameSettling,
    FrameTilt,
    HotPixels,
    Interference,
    MissingCodes,
    Nonlinearity,
    OddEvenPattern,
    PeriodicBanding,
    PhotoResponseNonuniformity,
    RandomTelegraphNoise,
    ReadNoiseNonuniformity,
    RowBankNoise,
    RowFixedPattern,
    RowGroupNoise,
    RowNoise,
    TapGains,
    TapOffsets,
)
from hsnoise.fitting.covariances import with_gain
from hsnoise.fitting.pixel_defects import hot_of, jumps_of, of_most, rays_of, warm_of
from hsnoise.fitting.pixel_fit import Channel, PixelFit
from hsnoise.fitting.pixel_flats import LEAST_OF_LINES, LEAST_RESPONSE, Responses, bends_of, of_colours
from hsnoise.fitting.pixel_joint import ROW_GAIN_THERE, UNKNOWN
from hsnoise.fitting.pixel_patterns import PATTERNS
from hsnoise.fitting.pixel_register import effects_of, has_register
from hsnoise.fitting.pixel_response import FEWEST_LEVELS
from hsnoise.fitting.pixel_shared import Shared, of_glow, of_settling, of_taps, shared_of, with_parity
from hsnoise.fitting.pixel_tilt import AXES, tilted_in
from hsnoise.fitting.result import FitResult, Method, Status
from hsnoise.likelihood.moments import model_of
from hsnoise.likelihood.parameters import numbers_of
from hsnoise.likelihood.summary import Summary
from hsnoise.model import NoiseModel
from hsnoise.statistics.pixels.shading import Shading
from hsnoise.statistics.pixels.survey import Survey
from hsnoise.statistics.pixels.transfer import ROUNDING
from hsnoise.statistics.pixels.waves import over_first

NOMINAL = 50.0  # relative standard error of an unknown gain

THERE = 5.0  # standard errors above which a population effect enters the model
SUBTRACTED = 2.0  # the same of a dark signal that is subtracted, where pedestals or levels have moved beyond chance
ROLLING_EXPONENT = 1.0  # of the paper; pixels over time do not determine it
IN_ELECTRONS = (("gain", "value"), ("read_noise", "sigma"), ("dark_current", "rate"))
OF_PIXELS = (
    DarkCurrentNonuniformity,
    DarkSignalNonuniformity,
    HotPixels,
    ReadNoiseNonuniformity,
    PhotoResponseNonuniformity,
    Nonlinearity,
    BrighterFatter,
    FrameOffset,
    FrameSettling,
    FrameTilt,
    RowFixedPattern,
    ColumnFixedPattern,
    RowNoise,
    RowBankNoise,
    RowGroupNoise,
    ColumnNoise,
    TapOffsets,
    TapGains,
    OddEvenPattern,
    BlackShading,
    CorrelatedReadNoise,
    CosmicRays,
    RandomTelegraphNoise,
    PeriodicBanding,
    Interference,
    BlackClamp,
    AmplifierGlow,
    MissingCodes,
    AdcNonuniformity,
    ElectronMultiplication,
)
LEAST_NOISE_SPREAD = 0.05  # smaller ones hardly show
BASE = ("shot_noise", "dark_current", "read_noise", "row_gain", "gain", "black_level", "adc")


def followed(found: Survey) -> set[str]:
    """Names of the effects beyond the paper's that a fit of these frames measures when it follows each pixel."""
    few = len(found.repeated_flats) < FEWEST_LEVELS
    unseen = {ElectronMultiplication: not has_register(found), Nonlinearity: few, BrighterFatter: few}
    unseen[FrameTilt] = tilted_in(found) is None
    return {effect.name for effect in OF_PIXELS if not unseen.get(effect)}


def result_of(pixel: PixelFit, summary: Summary, model: NoiseModel | None, stack) -> FitResult:
    """The result; `model` says which effects are wanted (None: the paper's, and those of the population found)."""
    gain, read, rate = _electrons(pixel)
    shared = shared_of(pixel.channels, pixel.tilted, gain, stack)
    population = _with_banks(_population(pixel, gain, shared), pixel, model)
    wanted = [*BASE, *population] if model is None else list(model.names)
    added = tuple(name for name in population if model is None)
    black, row = _black(pixel, summary), _rows(pixel)
    paper = model_of(
        summary,
        gain=gain,
        dark_current=max(rate, 0.0),
        read_noise=read,
        row_gain=(row[0], ROLLING_EXPONENT if summary.shutter == "rolling" else 0.0),
        black_level=black[0],
    )
    with jax.enable_x64(True):
        params = _model(wanted, paper, population, pixel, shared)
    names, covariance = _covariance(pixel, params, population, black[1], row[1])
    errors = dict(zip(names, np.sqrt(np.diagonal(covariance)), strict=True))
    numbers = numbers_of(params)
    withheld = () if pixel.determined else tuple(number.name for number in numbers if number.is_in_electrons)
    unknown = [n.name for n in numbers if n.place == ("row_gain", "sigma") and errors.get(n.name, 0.0) > 1]
    if np.ptp(summary.exposure_s) == 0 and "dark_current" in params:
        unknown.append("dark_current.rate")
    withheld = tuple(dict.fromkeys((*withheld, *unknown)))
    return FitResult(
        params=params,
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


def _detail(pixel: PixelFit) -> str:
    if pixel.channels[0].register is not None:
        return "gain from single electrons that a register multiplied" + (" and the flats" if pixel.flats else "")
    told = [c.transfer for c in pixel.channels if c.transfer is not None]
    if pixel.flats is not None and np.isfinite(pixel.flats.gain).all() and pixel.determined:
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


def _population(
    pixel: PixelFit, gain: np.ndarray, shared: Mapping[str, Shared]
) -> dict[str, dict[str, tuple[float, float]]]:
    """The significant population effects: name to field to (value, error), means over the colours."""
    found: dict[str, dict[str, tuple[float, float]]] = {}
    drift = _shading(pixel)
    if drift is not None:
        _, one = drift
        found["black_shading"] = {"amplitude": (one.amplitude_dn, one.error_dn), "length": (one.length, 0.0)}
    found |= {name: {"sigma": of.sigma} for name, of in shared.items()}
    found |= {"missing_codes": {"gain": (float(pixel.code_step), np.inf)}} if pixel.code_step > 1 else {}
    if (comb := pixel.comb) is not None:
        found["adc_nonuniformity"] = {"sigma": (comb.sigma, comb.error)}
    found |= {} if pixel.taps is None else of_taps(pixel.taps, float(gain.mean()))
    found |= {} if pixel.settling is None else of_settling(pixel.settling, float(gain.mean()))
    falls, errors = np.array([c.subtracted for c in pixel.channels]).T
    if (falls > SUBTRACTED * errors).all():
        found["black_clamp"] = {"rate": (falls, errors)}
    found |= _waves_and_groups(pixel, gain)
    for name, spectra in (
        ("row_noise", [c.row_spectrum for c in pixel.channels]),
        ("column_noise", [c.column_spectrum for c in pixel.channels]),
    ):
        if name in found:
            sigma, error = found[name]["sigma"]
            found[name]["sigma"] = sigma, error * max(one.widened for one in spectra)
            if all(one.exponent[0] != 0 for one in spectra):
                found[name]["exponent"] = of_colours([one.exponent for one in spectra])
    for axis in AXES:
        of_lines = [c.lines[axis].exponent for c in pixel.channels if axis in c.lines]
        if PATTERNS[axis] in found and all(value != 0 for value, _ in of_lines):
            found[PATTERNS[axis]]["exponent"] = of_colours(of_lines)
    found = with_parity(found, pixel.channels, gain)
    found |= {**_noise_spread(pixel), **rays_of(pixel, gain), **jumps_of(pixel, gain), **of_glow(pixel.channels, gain)}
    if (register := pixel.channels[0].register) is not None:
        found |= effects_of(register)
    if pixel.ringing is not None:
        found["correlated_read_noise"] = pixel.ringing._asdict()
    found |= bends_of([c.bend for c in pixel.channels])
    found |= _responses(pixel)
    many = [(c.population, g) for c, g in zip(pixel.channels, gain, strict=True) if c.population is not None]
    if not many:
        return found | warm_of(pixel, gain, pixel.shortest_s)
    spread = of_colours(
        [(p.spread[0], np.hypot(p.spread[1], p.spread[0] * _mean_error(c))) for (p, _), c in _with(pixel, many)]
    )
    if spread[0] > THERE * spread[1]:
        found["dark_current_nonuniformity"] = {"spread": spread, **of_most("skew", [p.skew for p, _ in many])}
    return found | hot_of(pixel, many)


def _responses(pixel: PixelFit) -> dict[str, dict[str, tuple[float, float]]]:
    """How pixels, rows and columns respond to light: means over the colours, of lines what is significant."""
    by_name = zip(Responses._fields, zip(*(c.photo_response for c in pixel.channels), strict=True), strict=True)
    found = {name: of_colours(list(of)) for name, of in by_name}
    sigma = found.pop("sigma")
    lines = {name: of for name, of in found.items() if abs(of[0]) > max(THERE * of[1], LEAST_OF_LINES)}
    is_there = lines or sigma[0] > max(THERE * sigma[1], LEAST_RESPONSE)
    return {"photo_response_nonuniformity": {"sigma": sigma, **lines}} if is_there else {}


def _waves_and_groups(pixel: PixelFit, gain: np.ndarray) -> dict[str, dict[str, tuple[float, float]]]:
    """Sinusoids over rows or columns, or over both, and rows that are read together."""
    found = {}
    if pixel.waves:
        crossing, g = pixel.waves[0], float(gain.mean())
        amplitude = np.sqrt(2 * crossing.variance_dn2)
        found["interference"] = {
            "amplitude": (amplitude / g, crossing.error_dn2 / amplitude / g),
            "row_frequency": (crossing.row_frequency, np.inf),
            "column_frequency": (crossing.column_frequency, np.inf),
        }
    if (wave := pixel.channels[0].banding) is not None:
        amplitude, g = np.sqrt(2 * wave[1].variance_dn2), float(gain[0])
        size = amplitude / g, wave[1].error_dn2 / amplitude / g
        found["periodic_banding"] = {"amplitude": size, "frequency": (wave[1].frequency, np.inf)}
    if (groups := pixel.row_groups) is not None:
        sigma = float(np.sqrt(groups.variance_dn2[0]))
        size = sigma / gain.mean(), groups.variance_dn2[1] / (2 * sigma * gain.mean())
        found["row_group_noise"] = {"sigma": size, "shared": groups.shared}
    return found


def _noise_spread(pixel: PixelFit) -> dict[str, dict[str, tuple[float, float]]]:
    """Read noise that differs between pixels, rows or columns: means over the colours."""
    differs, *others = (of_colours(list(of)) for of in zip(*(c.noise_spread for c in pixel.channels), strict=True))
    lines = {name: of for name, of in zip(("row_spread", "column_spread", "tail"), others, strict=True) if of[0] > 0}
    is_there = lines or differs[0] > max(THERE * differs[1], LEAST_NOISE_SPREAD)
    return {"read_noise_nonuniformity": {"spread": differs, **lines}} if is_there else {}


def _with_banks(population: dict, pixel: PixelFit, model: NoiseModel | None) -> dict:
    """The population with row noise as that of two banks of converters, if rows say so and the model may have it."""
    banks = [c.row_spectrum.banks for c in pixel.channels]
    there = all(of is not None for of in banks)
    wanted = there if model is None else "row_bank_noise" in model and "row_noise" not in model
    if not wanted or "row_noise" not in population:
        return population
    of_rows = {"exponent": (0.0, np.inf), **population["row_noise"], "shared": (1.0, np.inf)}
    if there:
        of_rows["exponent"], of_rows["shared"] = (of_colours([of[i] for of in banks if of is not None]) for i in (0, 1))
    return {**{name: of for name, of in population.items() if name != "row_noise"}, "row_bank_noise": of_rows}


def _shading(pixel: PixelFit) -> tuple[str, Shading] | None:
    """Axis and size of the strongest drift of the black level, of the first colour that has one."""
    many = [(axis, one) for c in pixel.channels[:1] for axis, one in c.shading.items()]
    return max(many, key=lambda pair: pair[1].amplitude_dn) if many else None


def _with(pixel: PixelFit, many):
    return zip(many, [c for c in pixel.channels if c.population is not None], strict=True)


def _mean_error(channel: Channel) -> float:
    """Relative error of the mean dark current: spread is relative to it."""
    return float(np.sqrt(channel.covariance[2, 2]) / max(abs(channel.values[2]), 1e-12))


def _black(pixel: PixelFit, summary: Summary) -> tuple[np.ndarray, np.ndarray]:
    """Black level [channel] and its error: as given, or the level without signal."""
    if summary.black_level_dn is not None:
        return np.asarray(summary.black_level_dn, float), np.zeros(len(pixel.channels))
    level, error = np.array([c.black_dn for c in pixel.channels]).T
    if pixel.settling is not None:  # to which it settles
        offset, of_offset = pixel.settling.mean_dn(min(summary.n_frames))
        return level - offset, np.hypot(error, of_offset)
    return level, error


def _rows(pixel: PixelFit) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviation of the row gain [channel] and its error; 0 if it is within chance."""
    sigma, error = [], []
    for c in pixel.channels:
        variance, of = c.row_gain
        there = variance > ROW_GAIN_THERE * of
        sigma.append(np.sqrt(variance) if there else 0.0)
        error.append(of / (2 * np.sqrt(variance)) if there else np.sqrt(max(variance, 0.0) + 2 * of))
    return np.array(sigma), np.array(error)


def _model(
    wanted: list[str], paper: NoiseModel, population: Mapping, pixel: PixelFit, shared: Mapping[str, Shared]
) -> NoiseModel:
    """The wanted effects, from the paper's model and the population."""
    effects: list[AbstractEffect] = [paper[name] for name in wanted if name in paper]
    classes: dict[str, Any] = {cls.name: cls for cls in OF_PIXELS}
    for name in wanted:
        if name in classes:
            specs, measured = classes[name].specs(), population.get(name, {})
            fields = {
                of: value if (low := specs[of].low) is None else np.maximum(value, low)
                for of, (value, _) in measured.items()
            }
            required = [f.name for f in dataclasses.fields(classes[name]) if f.default is dataclasses.MISSING]
            fields = fields or {field: classes[name].specs()[field].low or 0.0 for field in required}
            effects.append(classes[name](**fields, **_settings(name, pixel, shared)))
    return NoiseModel(effects, cfa=paper.cfa, shutter=paper.shutter, exposure_s=paper.exposure_s)


def _settings(name: str, pixel: PixelFit, shared: Mapping[str, Shared]) -> dict[str, Any]:
    """What an effect has besides numbers."""
    if name in shared:
        along = {"axis": pixel.tilted.axis} if name == "frame_tilt" and pixel.tilted is not None else {}
        return along | {"after_gain": shared[name].after_gain}
    if name == "frame_settling":
        return {"after_gain": len(pixel.channels) > 1}  # alike in DN in all colours
    if name == "black_shading" and (drift := _shading(pixel)) is not None:
        return {"axis": drift[0], "start": drift[1].start, "above": drift[1].above}
    if name == "periodic_banding" and (wave := pixel.channels[0].banding) is not None:
        return {"axis": wave[0]}
    if name == "row_group_noise" and (groups := pixel.row_groups) is not None:
        return dict(zip(("rows", "start", "row_banks", "column_banks"), groups.layout, strict=True))
    if name in ("tap_offsets", "tap_gains") and pixel.taps is not None:
        return {"taps": pixel.taps.columns, "row_taps": pixel.taps.rows}
    if name == "interference" and len(pixel.waves) > 1:
        others = over_first(pixel.waves)[1:]
        return {"others": tuple(tuple(float(f"{x:.5g}") for x in other) for other in others)}
    if name == "adc_nonuniformity" and (comb := pixel.comb) is not None:
        return {"period": len(comb.errors), "pattern": np.round(comb.errors / comb.sigma, 2)}
    jumps = pixel.channels[0].jumps
    if name == "random_telegraph_noise" and jumps is not None:
        return {"double_sampling": jumps.double_sampling}
    return {}


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
    pixel: PixelFit, params: NoiseModel, population, black_error: np.ndarray, row_error: np.ndarray
) -> tuple[tuple[str, ...], np.ndarray]:
    """Fitted names and their covariance: gain, read noise and dark current jointly, the others independently in DN."""
    numbers = numbers_of(params)
    joint = [n.name for place in IN_ELECTRONS for n in numbers if n.place == place]
    apart: dict[tuple[str, str], Any] = {("row_gain", "sigma"): row_error}
    apart["black_level", "value"] = np.where(black_error > 0, black_error, np.inf)  # else it was given
    apart |= {(effect, field): error for effect, fields in population.items() for field, (_, error) in fields.items()}
    errors = {n.name: float(np.asarray(apart[n.place])[n.index]) for n in numbers if n.place in apart}
    errors = {name: error for name, error in errors.items() if np.isfinite(error)}
    errors = {name: error if error < UNKNOWN else np.inf for name, error in errors.items()}
    covariance = np.diag([*np.zeros(len(joint)), *np.square(list(errors.values()))])
    together = slice(len(joint))
    whole = pixel.covariance if pixel.determined else _without_gain(pixel, params)
    covariance[together, together] = whole[together, together]
    if pixel.determined:
        covariance = with_gain(covariance, params, [*joint, *errors], len(joint))
    return (*joint, *errors), covariance
