"""A fit of darks whose pixels differ: gain by pixel transfer, the rest from the noise components.

Everything is conditional on the pixel: what is constant in a pixel is not noise. The gain comes from the growth of a
pixel's temporal variance with its level, or from flats if there are any; read noise from the variance without signal;
row gain from the row component; and the population of pixels is described by the effects that draw it. See
docs/likelihood.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from hsnoise.fitting.pixel_classes import classes_less
from hsnoise.fitting.pixel_flats import Responses, photo_response
from hsnoise.fitting.pixel_joint import UNKNOWN, joint_estimate
from hsnoise.fitting.pixel_levels import black_of_pixels, growth_of_means, is_unlit, mean_black, subtracted
from hsnoise.fitting.pixel_lines import Lines
from hsnoise.fitting.pixel_narrow import law_of, narrow_of, variance_of, with_law
from hsnoise.fitting.pixel_offsets import offset_of, offset_patterns
from hsnoise.fitting.pixel_outputs import outputs_by_light
from hsnoise.fitting.pixel_patterns import (
    banding_in,
    known_of_columns,
    known_of_rows,
    lines_in,
    patterns_of,
    shadings_of,
    shortest_of,
)
from hsnoise.fitting.pixel_register import Multiplied, multiplied_of, with_flats
from hsnoise.fitting.pixel_response import STRAIGHT, Bend, bend_of
from hsnoise.fitting.pixel_rows import RowSpectrum, column_spectrum, row_gain_of_darks, row_spectrum
from hsnoise.fitting.pixel_tilt import Tilted, straightened, tilted_in
from hsnoise.fitting.pixel_warm import warm_in
from hsnoise.likelihood.flat_gain import FlatGain, flat_gain, row_gain_of
from hsnoise.likelihood.flats import FlatMoments
from hsnoise.likelihood.summary import Summary
from hsnoise.statistics.pixels.along_rows import Limits, Ringing, limits_of_the_signal, of_read_noise, shared_by_row
from hsnoise.statistics.pixels.banding import Banding
from hsnoise.statistics.pixels.classes import Levels, hot_from, levels_of, slope_over
from hsnoise.statistics.pixels.comb import Comb
from hsnoise.statistics.pixels.glow import Glow, glow_of, glow_of_pixels, without_glow
from hsnoise.statistics.pixels.hits import Rays, rays_of
from hsnoise.statistics.pixels.jump_search import Jumps
from hsnoise.statistics.pixels.jumps import jumps_of
from hsnoise.statistics.pixels.population import Population, Warm, population_of
from hsnoise.statistics.pixels.read_noise import NoiseSpread, Tail, noise_spread_of, tail_of
from hsnoise.statistics.pixels.row_groups import RowGroups
from hsnoise.statistics.pixels.sample import without_outliers
from hsnoise.statistics.pixels.settling import Settling
from hsnoise.statistics.pixels.shading import Shading
from hsnoise.statistics.pixels.stuck import without_stuck
from hsnoise.statistics.pixels.survey import Plane, Survey
from hsnoise.statistics.pixels.taps import Taps, levelled, taps_of
from hsnoise.statistics.pixels.transfer import ROUNDING, Transfer, pixel_transfer
from hsnoise.statistics.pixels.waves import Wave

DETERMINED = 0.25  # relative standard error up to which a gain counts as determined
MOST_READ_NOISE_E = 300.0  # a gain that implies more comes from pedestal jumps that look like signal
RAISED_BY = 0.1  # error of the noise of pixels that were left out for it, by the shape of its tail
UNSEEN = 0.3  # share of the variance of unseen jumps that the gain may be off by
UNKNOWN_SPREAD = NoiseSpread((0.0, np.inf))


@dataclass(frozen=True)
class Channel:
    """What the darks (and flats) say about one colour, in DN.

    Attributes:
        name; transfer, population: None if all exposures are equal.
        values, covariance: gain (DN/e-), variance without signal (DN^2, rounding included), growth (DN/s); unknown
            values have an error of UNKNOWN.
        black_dn: level without signal and its error.
        row_gain: variance of the row gain and its error.
        patterns: by effect, the variance that whole frames, rows or columns share without signal, DN^2, its standard
            error, and its chance deviation if there is none.
        lines: by axis, static levels of rows and columns beside that drift.
        temporal_dn2: variance of the pixels themselves.
        is_narrow: whether that noise is narrower than a count, and rounding hides how pixels differ.
        shading: by axis, a drift of the static means of columns or rows; its variance is not in `patterns`.
        row_spectrum, column_spectrum: of what rows and columns share in a frame.
        noise_spread: of the logarithm of read noise over pixels, rows and columns.
        bend: of the response, from flats.
        photo_response: how pixels, rows and columns differ in their response to light (PRNU).
        warm: the warm pixels, if the darks have one exposure; else None.
        rays: hits of single frames; None if there are none.
        banding: axis of the strongest sinusoid over rows or columns, and the sinusoid; None without one. Its variance
            is not in `patterns`.
        subtracted: dark signal that the camera subtracts, DN/s, and its error; infinite if there is none.
        jumps: pixels that jump between levels; None if there are none.
        glow: what fades from one spot; None if nothing does. It is in none of the dark currents.
        register: the gain register of an EMCCD; None without one.
    """

    name: str
    transfer: Transfer | None
    population: Population | None
    offset_dn: tuple[float, float]
    values: np.ndarray
    covariance: np.ndarray
    black_dn: tuple[float, float]
    row_gain: tuple[float, float]
    patterns: Mapping[str, tuple[float, float, float]]
    lines: Mapping[str, Lines]
    temporal_dn2: float
    is_narrow: bool
    shading: Mapping[str, Shading]
    row_spectrum: RowSpectrum
    column_spectrum: RowSpectrum
    noise_spread: NoiseSpread
    bend: Bend
    photo_response: Responses
    warm: Warm | None
    rays: Rays | None
    jumps: Jumps | None
    glow: Glow | None
    register: Multiplied | None
    banding: tuple[str, Banding] | None
    subtracted: tuple[float, float]


@dataclass(frozen=True)
class PixelFit:
    """The channels, the gain of the flats if there are any, and the joint estimate with its covariance.

    ringing: the part of the read noise that goes on along rows, if it is there.
    row_groups: rows that are read together, if there are.
    taps: blocks of the frame that separate outputs read; None for one output. code_step: of the converter, DN.
    parity_told: whether noise tells what makes even and odd columns differ in light, if they do.
    waves: what crosses the frame obliquely and moves from frame to frame, the strongest first. It is in no read noise.
    comb: codes of unequal width, if they are. settling: the course of the black level over the frames, if it has one.
    tilted: lines over rows or columns that are new in each frame, if there are; in no noise of rows or columns.
    shortest_s: the shortest exposure of repeated darks; 0 without any.
    coupled: limits of what shot noise shares with that of neighbours.
    estimate: gain [channel], read noise (e-), dark current (e-/s); `determined`: whether all gains are.
    """

    channels: tuple[Channel, ...]
    flats: FlatGain | None
    ringing: Ringing | None
    row_groups: RowGroups | None
    taps: Taps | None
    code_step: int
    parity_told: bool
    waves: tuple[Wave, ...]
    comb: Comb | None
    settling: Settling | None
    tilted: Tilted | None
    shortest_s: float
    coupled: Limits
    estimate: np.ndarray = field(default_factory=lambda: np.zeros(0))
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    determined: bool = False


def measure(found: Survey, summary: Summary) -> PixelFit:
    """Pixel transfer, flats and population of all channels, and the joint estimate."""
    found = without_stuck(found)
    taps = taps_of(found)
    found = found if taps is None else levelled(found, taps)
    tilted = tilted_in(found)
    found = found if tilted is None else straightened(found, tilted)
    flats = _flat_gain(found, summary)
    told = flats if flats is not None and np.isfinite(flats.gain).all() else None
    register = multiplied_of(found, told)
    wander_dn2 = 0.0 if taps is None else taps.changes_dn2().get("temporal", 0.0)
    shared = register, told, wander_dn2, tilted
    channels = [_channel(found, c, name, *shared) for c, name in enumerate(found.channels)]
    channels = [with_law(one, law_of(found, c), narrow_of(found, c)) for c, one in enumerate(channels)]
    if told is not None:
        channels = [_with_flats(one, summary.flats, told, c) for c, one in enumerate(channels)]
    taps, channels, parity_told = outputs_by_light(found, taps, channels)
    estimate, covariance = joint_estimate(channels)
    gain, variance = estimate[: len(channels)], np.diagonal(covariance)[: len(channels)]
    known = (gain > 0) & (variance > 0) & (variance < (DETERMINED * gain) ** 2)
    known &= (summary.flats is not None) | (abs(estimate[len(channels)]) < MOST_READ_NOISE_E)
    read_dn2 = float(np.mean([max(one.values[1] - ROUNDING, ROUNDING) for one in channels]))
    unlit = summary.flats is None and not summary.exposure_s.any()
    ringing = None if found.shortest is None else of_read_noise(found.along, read_dn2, unlit=unlit)
    if ringing is not None:
        channels = [_without_rows_of(ringing, one, shortest_of(found, c)) for c, one in enumerate(channels)]
    apart = ringing, found.row_groups, taps, found.code_step, parity_told, found.waves, found.comb, found.settling
    shortest_s = 0.0 if found.shortest is None else found.shortest.exposure_s
    coupled = limits_of_the_signal(found.along, ringing)
    joint = estimate, covariance, bool(known.all())
    return PixelFit(tuple(channels), flats, *apart, tilted, shortest_s, coupled, *joint)


def _channel(
    found: Survey,
    c: int,
    name: str,
    register: Multiplied | None,
    flats: FlatGain | None,
    wander_dn2: float,
    tilted: Tilted | None,
) -> Channel:
    """wander_dn2: variance of pixels over time that outputs make whose change is neither of rows nor of columns."""
    (growth, growth_error), black = growth_of_means(found, c)
    narrow = narrow_of(found, c)
    is_plain = narrow is None and register is None  # else rounding or multiplied electrons shape the noise
    jumps, jumping = jumps_of(found, c) if is_plain else (None, None)
    tail = tail_of(found, c) if is_plain and jumps is None else None
    raised = 1.0 if jumps is None else _raised_by(jumps, found.shortest.n_frames)
    floor, floor_error = _temporal(found, c, raised) if narrow is None else variance_of(narrow)
    pixels = levels_of(found, c, jumping) if register is None else None
    spectrum = row_spectrum(shortest_of(found, c), found.shape[0], partial(known_of_rows, found, c))
    of_columns = column_spectrum(shortest_of(found, c), found.shape[1], known_of_columns(found, c))
    banding = banding_in(found, c)
    row_gain = partial(row_gain_of_darks, found, c, spectrum, banding)
    rays = _rays(found, c) if is_plain else None
    at_rest = np.array([1.0, floor, growth]), np.diag([UNKNOWN, floor_error, growth_error]) ** 2
    if tail is not None:
        _raise(*at_rest, tail)
    (values, covariance), transfer, population, glow = at_rest, None, None, None
    if register is not None:
        values, errors = np.array([register.gain, register.read_dn2, register.growth]).T
        covariance, floor = np.diag(np.minimum(errors, UNKNOWN) ** 2), register.read_dn2[0]
    if pixels is not None:
        transfer = pixel_transfer(classes_less(pixels, found.full_scale_dn, row_gain(growth), rays))
    if transfer is not None and pixels is not None:
        glow = glow_of(found, c)
        of_glow = None if glow is None else glow_of_pixels(glow, found, c)[~found.stuck(c)][pixels.is_calm]
        population = _population(found, c, pixels.calm(), transfer, of_glow)
        values, covariance = _transferred(transfer, at_rest, population, (jumps, raised), tail)
    if found.code_step > 1:
        coarse = ROUNDING * (found.code_step**2 - 1)
        values[1], floor = max(values[1] - coarse, ROUNDING), max(floor - coarse, ROUNDING)
    apart_dn2 = wander_dn2 + sum(wave.variance_dn2 for wave in found.waves)
    if apart_dn2 > 0:
        values[1], floor = (max(one - apart_dn2, ROUNDING) for one in (values[1], floor))
        covariance[1, 1] += sum(wave.error_dn2**2 for wave in found.waves)
    if found.row_groups is not None:
        apart, error = found.row_groups.of_pixels_dn2(mono=found.cfa == "mono")
        values[1], covariance[1, 1] = values[1] - apart, covariance[1, 1] + error**2
    spectra = spectrum, of_columns
    shading = shadings_of(found, c, spectra, tilted)
    lines = lines_in(found, c, shading)
    offset = offset_of(found, c, population)
    warm = warm_in(found, c) if is_plain and not found.has_exposures else None
    if pixels is not None:
        black = black_of_pixels(pixels.calm()), black[1]
    # Hot pixels with a population of their own would raise the mean: black is the level of the typical pixel then.
    if is_unlit(found, max(growth, values[2])) and (population is None or population.hot_fraction[0] <= 0):
        black = mean_black(found, c, warm, jumps), black[1]
    if register is not None:
        black = register.black_dn
    return Channel(
        name=name,
        transfer=transfer,
        population=population,
        offset_dn=offset,
        values=values,
        covariance=covariance,
        black_dn=black,
        row_gain=row_gain(values[2]),
        patterns=patterns_of(found, c, shading, lines, spectra, tilted),
        lines=lines,
        temporal_dn2=floor,
        is_narrow=narrow is not None,
        shading=shading,
        row_spectrum=spectrum,
        column_spectrum=of_columns,
        noise_spread=_noise_spread(found, c, float(values[1]), jumps, tail) if is_plain else UNKNOWN_SPREAD,
        bend=(bend := STRAIGHT if flats is None else bend_of(found, flats, c)),
        photo_response=photo_response(found, c, black[0], offset[0], flats, bend),
        warm=warm,
        rays=rays,
        jumps=jumps,
        glow=glow,
        register=register,
        banding=banding,
        subtracted=subtracted(transfer, (growth, growth_error)),
    )


def _transferred(
    transfer: Transfer,
    at_rest: tuple[np.ndarray, np.ndarray],
    population: Population,
    jumps: tuple[Jumps | None, float],
    tail: Tail | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Gain, variance without signal and growth, with their covariance, by pixel transfer.

    at_rest: the same without it. jumps: and the factor by which they raise the variance.
    """
    values, covariance = transfer.values.copy(), transfer.covariance.copy()
    if jumps[0] is not None:
        _correct(values, covariance, *jumps)
    if tail is not None:
        _raise(values, covariance, tail)
    values[2] = population.mean
    if not transfer.ordinary_error < DETERMINED * abs(transfer.ordinary_gain) or transfer.gain <= 0:
        # If ordinary pixels do not grow, hot ones only give a bound.
        values[:2] = 1.0, at_rest[0][1]
        covariance = np.diag([UNKNOWN**2, at_rest[1][1, 1], covariance[2, 2]])
    return values, covariance


def _raised_by(jumps: Jumps, n_frames: int) -> float:
    """Factor by which jumping pixels that are no outliers raise the mean variance over so many frames."""
    return jumps.raises(lambda variances: without_outliers(variances, n_frames)[0], n_frames)


def _correct(values: np.ndarray, covariance: np.ndarray, jumps: Jumps, raised: float) -> None:
    """Adds the noise of the pixels that were left out, and to the errors half of it, and what unseen jumps may add."""
    more = (jumps.cut - 1) * max(values[1] - ROUNDING, 0.0)
    values[1] += more
    covariance[1, 1] += (more / 2) ** 2
    covariance[0, 0] += (UNSEEN * (raised - 1) * values[0]) ** 2


def _raise(values: np.ndarray, covariance: np.ndarray, tail: Tail) -> None:
    """Adds the noise of the noisiest pixels, which were left out, and to the error a tenth of it."""
    more = (tail.raised - 1) * max(values[1] - ROUNDING, 0.0)
    values[1] += more
    covariance[1, 1] += (RAISED_BY * more) ** 2


def _noise_spread(found: Survey, c: int, read_dn2: float, jumps: Jumps | None, tail: Tail | None) -> NoiseSpread:
    of_pixels = None if jumps is None else jumps.noise_spread
    if tail is None:
        return noise_spread_of(found, c, read_dn2, of_pixels)
    return noise_spread_of(found, c, read_dn2, tail.spread)._replace(tail=tail.value)


def _rays(found: Survey, c: int) -> Rays | None:
    """Hits of single dark frames."""
    of = [(group.exposure_s, p.halves.hits) for group in found.repeated_darks for p in group.of(c)]
    return rays_of([(t, hits) for t, hits in of if hits is not None])


def _without_rows_of(ringing: Ringing, channel: Channel, planes: list[Plane]) -> Channel:
    """The channel without the row noise that correlated read noise makes."""
    step = 1 if channel.name == "mono" else 2
    extra = shared_by_row(ringing, len(planes[0].column_mean_dn), step) * max(channel.values[1] - ROUNDING, 0.0)
    variance, *errors = channel.patterns["row_noise"]
    return replace(channel, patterns={**channel.patterns, "row_noise": (variance - extra, *errors)})


def _flat_gain(found: Survey, summary: Summary) -> FlatGain | None:
    """The gain of the flats. Rounding changes the variance of darks that are narrower than a count.

    That of their noise counts then, if a curve describes the levels with it: EMVA 1288's line is that of measured ones.
    """
    if (flats := summary.flats) is None:
        return None
    narrow = [of for c in range(len(found.channels)) if (of := narrow_of(found, c)) is not None]
    if len(narrow) == len(found.channels):
        variance, error = np.array([variance_of(of) for of in narrow]).T
        by_noise = flat_gain(flats, None, variance, error)
        if by_noise.described.all():
            return by_noise
    return flat_gain(flats)


def _temporal(found: Survey, c: int, raised: float) -> tuple[float, float]:
    """Temporal variance of the pixels at the shortest exposure, DN^2, without outliers, and its standard error.

    raised: factor by which jumping pixels that are no outliers raise it.
    """
    group = found.shortest
    if group is None:
        return 0.0, UNKNOWN
    variance = group.pixels(c, "pair_variance_dn2").astype(np.float64)
    variance = variance[~found.stuck(c)]
    if not (variance > 0).any():
        return 0.0, UNKNOWN
    mean, error = without_outliers(variance, group.n_frames)
    return mean / raised, error


def _population(found: Survey, c: int, pixels: Levels, transfer: Transfer, of_glow: np.ndarray | None) -> Population:
    """The pixels' dark currents, beside a glow, DN/s [pixel]."""
    t, limit, ordinary = pixels.exposure_s, transfer.classes.limit_dn_per_s, float(transfer.values[2])
    shift = float(slope_over(t, transfer.pedestal_dn))
    if of_glow is not None:
        ordinary -= float(of_glow[slope_over(t, pixels.level).mean(0) < limit].mean())
        pixels = without_glow(pixels, of_glow)
        limit = hot_from(slope_over(t, pixels.level))
    return population_of(pixels, limit, ordinary, shift, offset_patterns(found, c))


def _with_flats(one: Channel, moments: FlatMoments, flats: FlatGain, c: int) -> Channel:
    """The channel with the gain and row gain of its flats; the transfer of its darks remains as a check."""
    values, covariance = one.values.copy(), one.covariance.copy()
    register = None if one.register is None else with_flats(one.register, flats)
    gain = (flats.gain[c], flats.standard_error[c]) if register is None else register.gain
    values[0] = gain[0]
    covariance[0], covariance[:, 0] = 0.0, 0.0
    covariance[0, 0] = gain[1] ** 2
    rows = row_gain_of(moments, flats.signal_dn[:, c], c)
    return replace(one, values=values, covariance=covariance, row_gain=rows, register=register)
