"""The gain register of an EMCCD in a fit that follows each pixel: what single electrons tell."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.stats import gamma, poisson

from hsnoise.likelihood.flat_gain import FlatGain
from hsnoise.statistics.pixels.register import LEFT_OUT, Register, common_of, mean_of, rate_and_clocks
from hsnoise.statistics.pixels.survey import Group, Survey

MULTIPLIED = 1.0  # excess noise factor less 1 of a register of large gain
LESS = 3.0  # standard errors by which flats must show less, or clocks some electrons
LEAST_OUTPUT_E = 10.0  # read noise behind a register, where it is wanted: M is above this over that of its input
SYSTEMATIC = 0.03  # of the excess: neither a register nor flats follow their laws to less
APART = 0.2  # of the growth of the level that electrons of the register may leave unexplained
WELL_KNOWN = 0.1  # error of the excess
CHANCE, HIGH = 1e-3, 4.0  # of a pixel to have so many electrons, and multiplied so far; deviations of its read noise
FEWEST_HOT = 5
STEADY, STEADY_SIGMAS = 0.1, 5.0  # share, and standard errors, by which read noise may differ between exposures
SPREAD_THERE = 5.0  # standard errors

Number = tuple[float, float]


class Pixels(NamedTuple):
    """Of one exposure, s: share of hot pixels and their mean extra level, DN (0: none); relative standard deviation of
    the level of the others."""

    exposure_s: float
    hot: Number
    extra_dn: Number
    spread: Number


@dataclass(frozen=True)
class Multiplied:
    """A gain register as `electron_multiplication` has it.

    Attributes:
        gain: DN for each electron that enters; read_dn2: variance without electrons, rounding included, DN^2.
        growth: DN/s, and clocks: electrons whatever the exposure.
        black_dn: level without electrons.
        pixels: how the pixels' dark currents differ.
        confirmed: whether flats, or levels that grow by a step for each electron, say that it is one.
        excess: excess noise factor less 1; its error is infinite if that of a large gain is taken.
    """

    gain: Number
    read_dn2: Number
    growth: Number
    clocks: Number
    black_dn: Number
    pixels: Pixels
    confirmed: bool
    excess: Number = (MULTIPLIED, np.inf)


def has_register(found: Survey) -> bool:
    """Whether darks show a gain register."""
    return bool(_registers(found))


def _registers(found: Survey) -> list[tuple[float, Register]]:
    """Exposures that show a register, s; none if the noise beside its electrons grows with exposure, as shot noise
    does without one: then these are hits."""
    several = [(group.exposure_s, group.register) for group in found.darks if group.register is not None]
    noise, error = np.array([one.read_noise_dn for _, one in several]).reshape(-1, 2).T
    # Rates that differ from pixel to pixel leave a little of their noise beside the electrons.
    off = noise - noise[:1]
    is_steady = np.abs(off) < np.maximum(STEADY * noise[:1], STEADY_SIGMAS * np.hypot(error, error[:1]))
    return several if is_steady.all() else []


def multiplied_of(found: Survey, flats: FlatGain | None = None) -> Multiplied | None:
    """The register of all darks; None without one, and where flats or the growth of the level contradict it."""
    several = _registers(found)
    if not several:
        return None
    step, noise = common_of([one for _, one in several])
    entered, fits, grows = _electrons(found, step)
    of_flats = None if flats is None else _excess_of(step, flats)
    # Between none and that of a large multiplication, and what the two errors allow.
    agree = of_flats is not None and -LESS * of_flats[1] < of_flats[0] < MULTIPLIED + LESS * of_flats[1]
    if not fits or (of_flats is not None and not agree):
        return None
    rate, clocks = rate_and_clocks(entered)
    if found.has_exposures and of_flats is None and not clocks[0] > LESS * clocks[1]:
        return None  # hits come with exposure alone, a register's electrons with its clocks, too
    shortest = found.shortest
    in_darks = clocks[0] + rate[0] * shortest.exposure_s
    level = shortest.mean_dn(0)
    off = np.hypot(step[0] * np.hypot(clocks[1], rate[1] * shortest.exposure_s if rate[0] else 0.0), in_darks * step[1])
    return Multiplied(
        gain=(step[0], float(np.hypot(step[1], _of_multiplication(noise[0])))),
        read_dn2=(max(noise[0] ** 2 - _of_lines(shortest), 0.0), 2 * noise[0] * noise[1]),
        growth=(step[0] * rate[0], step[0] * rate[1]),
        clocks=clocks,
        black_dn=(level - step[0] * in_darks, float(np.hypot(shortest.level_error_dn(0), off))),
        pixels=_pixels(found, step[0], noise[0], clocks[0], rate[0]),
        confirmed=agree or grows,
    )


def _electrons(found: Survey, step: Number) -> tuple[list[tuple[float, Number]], bool, bool]:
    """Electrons of each exposure, s, by its register or else by how its level differs from one that shows a register.

    And whether levels contradict that each electron adds a step, and whether they show it.
    """
    shown = [group for group in found.repeated_darks if group.register is not None]
    first, out, fits, grows = shown[0], [], True, False
    cool = _cool(found)
    of_first, level = first.register.with_step(step), _level_of(first, cool)
    for group in found.repeated_darks:
        rise = _level_of(group, cool) - level
        error = float(np.hypot(group.level_error_dn(0), first.level_error_dn(0)))
        if group.register is None:
            by_level = of_first[0] + rise / step[0], float(np.hypot(of_first[1], error / step[0]))
            out.append((group.exposure_s, by_level))
            continue
        own = group.register.with_step(step)
        more = own[0] - of_first[0]
        error = float(np.hypot(error, np.hypot(more * step[1], step[0] * np.hypot(own[1], of_first[1]))))
        fits &= bool(abs(rise - step[0] * more) < max(STEADY_SIGMAS * error, APART * abs(rise)))
        grows |= bool(rise > STEADY_SIGMAS * error)
        out.append((group.exposure_s, own))
    return out, fits, grows


def _cool(found: Survey) -> np.ndarray:
    """Pixels that are not among the hottest of the longest exposure, by each half of its frames [half, pixel]."""
    hottest = found.longest.pixels(0, "level_dn")
    return hottest <= np.quantile(hottest, 1 - LEFT_OUT, axis=1, keepdims=True)


def _level_of(group: Group, cool: np.ndarray) -> float:
    """Mean level of cool pixels, DN; the other half of the frames says which are, so that no chance does."""
    levels = group.pixels(0, "level_dn").astype(np.float64)
    return float(np.mean([levels[1 - half][cool[half]].mean() for half in (0, 1)]))


def _excess_of(step: Number, flats: FlatGain) -> Number:
    """Excess noise factor less 1: flats have the step times the factor as their variance over signal."""
    ratio = float(flats.gain[0] / step[0])
    error = ratio * float(np.hypot(flats.standard_error[0] / flats.gain[0], step[1] / step[0]))
    return ratio - 1, error + SYSTEMATIC


def _pixels(found: Survey, step: float, noise: float, clocks: float, rate: float) -> Pixels:
    """How pixels differ at the longest exposure that shows it, from halves of its frames, whose chance is their own."""
    longest = found.longest
    frames, t = longest.n_frames, longest.exposure_s
    halves = longest.pixels(0, "level_dn").astype(np.float64)
    mean = clocks + rate * t
    most = poisson.isf(CHANCE, mean * frames) if mean > 0 else 0
    limit = (step * gamma.isf(CHANCE, max(most, 1)) + HIGH * noise * np.sqrt(frames)) / frames - step * mean
    is_hot = np.zeros(halves.shape[1], bool)
    for _ in range(2):  # hot pixels raise the mean from which they are told
        off = halves - np.mean(halves[:, ~is_hot], axis=1, keepdims=True)
        level = off.mean(0)
        is_hot = level > limit
    hot, extra = (0.0, np.inf), (0.0, np.inf)
    beyond = float((level[is_hot] - limit).mean()) if is_hot.sum() > FEWEST_HOT else 0.0
    if beyond > limit:  # else more were below the limit than above it
        # Exponential charges exceed any limit by their mean.
        number = float(is_hot.sum())
        share = number / level.size * np.exp(limit / beyond)
        hot = float(share), float(share * np.sqrt(1 + (limit / beyond) ** 2) / np.sqrt(number))
        extra = beyond, beyond / float(np.sqrt(number))
    return Pixels(t, hot, extra, _spread(found, off[:, ~is_hot], is_hot, step * rate * t))


def _spread(found: Survey, off: np.ndarray, is_hot: np.ndarray, dark_dn: float) -> Number:
    """Relative standard deviation over pixels of a dark level, DN, beside that of their offsets."""
    offsets = found.shortest.pixels(0, "level_dn")[:, ~is_hot]
    offsets, off = (one - one.mean(1, keepdims=True) for one in (offsets, off))
    products = off[0] * off[1] - offsets[0] * offsets[1] * found.has_exposures
    if dark_dn <= 0:
        return 0.0, np.inf
    variance, error = float(products.mean()), float(products.std() / np.sqrt(products.size))
    if not found.has_exposures or variance < SPREAD_THERE * error:
        return 0.0, np.inf
    spread = float(np.sqrt(variance)) / dark_dn
    return spread, spread * error / variance / 2


def _of_lines(group: Group) -> float:
    """Variance that rows and columns share in a frame, DN^2."""
    components = group.planes[0].components
    return sum(max(components[name].variance_dn2, 0.0) for name in ("row_x_frame", "column_x_frame"))


def with_flats(register: Multiplied, flats: FlatGain) -> Multiplied:
    """The register with what flats say of it: its excess if that is small, and else a better gain."""
    excess, error = _excess_of(register.gain, flats)
    if error < WELL_KNOWN and excess < MULTIPLIED - LESS * error:
        return replace(register, excess=(max(excess, 0.0), error))
    halved = float(flats.gain[0] / (1 + MULTIPLIED)), float(flats.standard_error[0] / (1 + MULTIPLIED))
    gain, known = mean_of([register.gain, halved])
    return replace(register, gain=(gain, float(np.hypot(known, _of_multiplication(register.read_dn2[0] ** 0.5)))))


def _of_multiplication(noise_dn: float) -> float:
    """Error of the gain, DN/e-, by a multiplication M that is not known: single electrons scatter by 1/(2M) less."""
    return noise_dn / (2 * LEAST_OUTPUT_E)


def effects_of(register: Multiplied) -> dict[str, dict[str, Number]]:
    """The effects of the register and of the pixels before it, by name: their fields with errors."""
    found = {"electron_multiplication": {"excess": register.excess, "clock_induced": register.clocks}}
    t, hot, extra, spread = register.pixels
    if hot[0] > 0:
        charge = extra[0] / register.gain[0], extra[1] / register.gain[0]
        rate, at_readout = ((charge[0] / t, charge[1] / t), (0.0, np.inf)) if t > 0 else ((0.0, np.inf), charge)
        found["hot_pixels"] = {"fraction": hot, "rate": rate, "at_readout": at_readout}
    if spread[0] > 0:
        log_spread = float(np.sqrt(np.log1p(spread[0] ** 2)))
        found["dark_current_nonuniformity"] = {"spread": (log_spread, spread[1])}
    return found
