"""What whole frames, rows, columns and outputs share, in electrons: before the gain or, as colours say, after it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from hsnoise._core.types import cfa_tile
from hsnoise.fitting.pixel_lines import Lines
from hsnoise.fitting.pixel_patterns import PATTERNS
from hsnoise.fitting.pixel_tilt import AXES, Tilted
from hsnoise.frames.stack import FrameStack
from hsnoise.statistics.pixels.glow import Glow
from hsnoise.statistics.pixels.settling import Settling
from hsnoise.statistics.pixels.taps import GAINS_APART, LEAST, Taps

PATTERN_THERE, LEAST_PATTERN = 6.0, 1e-4  # chance deviations, share of the temporal variance
OFFSETS_THERE = 5.0  # standard errors
SURE = 10.0  # standard errors, at least, of offsets that were found by their seams
AFTER = 12.0  # by which chi2 must be less for a pattern of one size in DN than for one of one size in electrons


class Channel(Protocol):
    """What a colour shares: by effect, variance, standard error and chance deviation, DN^2; noise of its pixels, and
    whether it is narrower than a count; standard deviation of the pixels' offsets, DN, and its error."""

    patterns: Mapping[str, tuple[float, float, float]]
    lines: Mapping[str, Lines]
    temporal_dn2: float
    is_narrow: bool
    offset_dn: tuple[float, float]


class Glowing(Protocol):
    """A colour's glow, DN/s."""

    glow: Glow | None


class Shared(NamedTuple):
    """Standard deviation of what is shared, e-, and its error; whether it arises after the gain."""

    sigma: tuple[float, float]
    after_gain: bool


def shared_patterns(channels: Sequence[Channel], gain: np.ndarray, cfa: str) -> dict[str, Shared]:
    """The patterns beyond chance by the effect that draws them; gain [channel], DN/e-.

    Electrons of a pattern after the gain are DN over the mean gain of the pixels, as in the effects.
    """
    found = {}
    noise = float(np.mean([c.temporal_dn2 / g**2 for c, g in zip(channels, gain, strict=True)]))
    for name in PATTERNS.values():
        variance, error, chance = np.array([c.patterns.get(name, (0.0, 0.0, 0.0)) for c in channels]).T
        after = is_after_gain(variance, error, gain)
        scale = np.full(len(gain), gain[cfa_tile(cfa)].mean()) if after else gain
        mean = float(np.mean(variance / scale**2))
        if mean > max(PATTERN_THERE * _error_of_mean(chance / scale**2), LEAST_PATTERN * noise):
            of_sigma = _error_of_common(error / scale**2, name) / (2 * np.sqrt(mean))
            found[name] = Shared((float(np.sqrt(mean)), of_sigma), after)
    return found


def shared_of(
    channels: Sequence[Channel], tilted: Tilted | None, gain: np.ndarray, stack: FrameStack
) -> dict[str, Shared]:
    """What is shared beyond chance, and the offsets of pixels, by the effect that draws it."""
    found = shared_patterns(channels, gain, stack.cfa)
    if (offsets := offsets_of(channels, gain, stack.cfa)) is not None:
        found["dark_signal_nonuniformity"] = offsets
    if tilted is not None:
        found["frame_tilt"] = slopes_of(tilted, gain, stack)
    return found


def slopes_of(tilted: Tilted, gain: np.ndarray, stack: FrameStack) -> Shared:
    """Slopes of the frames, from end to end of the sensor, of which they may be a part."""
    i = AXES.index(tilted.axis)
    longer = 1.0 if stack.window is None else (stack.window[2 + i] - 1) / (stack.shape[i] - 1)
    after = is_after_gain(tilted.seen_dn2[:, 0], tilted.seen_dn2[:, 1], gain)
    scale = np.full(len(gain), gain[cfa_tile(stack.cfa)].mean()) if after else gain
    variance, error = np.mean(tilted.slope_dn2 / scale[:, None] ** 2, 0)  # the same frames tell all colours
    sigma = float(np.sqrt(variance))
    return Shared((longer * sigma, longer * float(error) / (2 * sigma)), after)


def with_parity(
    found: dict[str, dict[str, tuple[float, float]]],
    channels: Sequence[Channel],
    gain: np.ndarray,
) -> dict[str, dict[str, tuple[float, float]]]:
    """The population with what even and odd rows or columns of a mono sensor differ by; its channel has one gain."""
    for axis, lines in channels[0].lines.items():
        if lines.parity_dn is None:
            continue
        variance, error, _ = channels[0].patterns[PATTERNS[axis]]
        sigma = float(np.sqrt(max(variance, 0.0)))
        alone = sigma / gain[0], error / max(2 * sigma, float(np.sqrt(error))) / gain[0]
        parity = tuple(each / gain[0] for each in lines.parity_dn)
        found[PATTERNS[axis]] = {"sigma": alone, **found.get(PATTERNS[axis], {}), "parity": parity}
    return found


def offsets_of(channels: Sequence[Channel], gain: np.ndarray, cfa: str) -> Shared | None:
    """The offsets of pixels, None within chance. Rounding hides an unknown part of them where noise is narrow."""
    sigma, error = np.array([c.offset_dn for c in channels]).T
    after = bool(np.isfinite(error).all()) and is_after_gain(sigma**2, 2 * sigma * error, gain)
    scale = np.full(len(gain), gain[cfa_tile(cfa)].mean()) if after else gain
    mean, of_mean = float(np.mean(sigma / scale)), _error_of_mean(error / scale)
    if mean <= OFFSETS_THERE * of_mean:
        return None
    return Shared((mean, mean if any(c.is_narrow for c in channels) else of_mean), after)


def of_taps(taps: Taps, gain: float) -> dict[str, dict[str, tuple[float, float]]]:
    """Offsets of outputs in electrons and, beyond chance, the spread of their gains; few outputs tell it roughly."""
    if taps.interleaved:
        return {"odd_even_pattern": _of_two(taps, gain)}
    few = np.sqrt(2 * (taps.offset_dn.size - 1))
    sigma, (spread, error) = float(taps.offset_dn.std(ddof=1)) / gain, taps.gain_spread
    found = {"tap_offsets": {"sigma": (sigma, sigma / few)}}
    if taps.change_dn is not None:
        wander, of_wander = taps.wander_dn
        found["tap_offsets"]["frame_sigma"] = wander / gain, of_wander / gain
    if taps.gains_differ:
        found["tap_gains"] = {"spread": (spread, float(np.hypot(spread / few, error)))}
    return found


def of_settling(course: Settling, gain: float) -> dict[str, dict[str, tuple[float, float]]]:
    """The course of the black level in electrons; time constants are held."""
    fields = {"amplitude": course.offset_dn, "slow": course.slow_dn}
    found = {name: (value / gain, error / gain) for name, (value, error) in fields.items() if value}
    frames = {"frames": course.frames} | ({"slow_frames": course.slow_frames} if "slow" in found else {})
    return {"frame_settling": found | {name: (value, np.inf) for name, value in frames.items()}}


def of_glow(channels: Sequence[Glowing], gain: np.ndarray) -> dict[str, dict[str, tuple[float, float]]]:
    """The glow of an amplifier, if all colours have it: the mean of their electrons, the shape of the first."""
    glows = [one.glow for one in channels if one.glow is not None]
    if len(glows) < len(channels):
        return {}
    rates = np.array([glow.rate_dn_per_s for glow in glows]) / gain[:, None]
    shape = {name: of for name, of in glows[0]._asdict().items() if name != "rate_dn_per_s"}
    return {"amplifier_glow": {"rate": (float(rates[:, 0].mean()), _error_of_mean(rates[:, 1])), **shape}}


def _of_two(taps: Taps, gain: float) -> dict[str, tuple[float, float]]:
    """Offset and gain of the second of two outputs less those of the first."""
    offset, mismatch, errors = np.diff(taps.offset_dn[0])[0], np.diff(taps.gain[0])[0], taps.gain_error[0]
    least = np.sqrt(LEAST) * taps.noise_dn.mean()
    found = {"offset": (float(offset) / gain, float(max(abs(offset) / SURE, least)) / gain)}
    if abs(mismatch) > GAINS_APART * np.hypot(*errors):  # False of NaN: no signal
        found["gain_mismatch"] = (float(mismatch), float(np.hypot(*errors)))
    return found


def is_after_gain(variance_dn2: np.ndarray, error_dn2: np.ndarray, gain: np.ndarray) -> bool:
    """Whether variances [channel] are alike in DN, not in electrons; False where gains or errors do not tell."""
    if len(gain) < 2 or not (error_dn2 > 0).all():
        return False
    as_electrons, as_dn = (_off_by(variance_dn2, error_dn2, shape) for shape in (gain**2, np.ones_like(gain)))
    return as_electrons - as_dn > AFTER


def _off_by(values: np.ndarray, errors: np.ndarray, shape: np.ndarray) -> float:
    """Chi2 of values of that shape, of any size."""
    shape, values = shape / errors, values / errors
    return float(((values - shape * (shape @ values) / (shape @ shape)) ** 2).sum())


def _error_of_common(errors: np.ndarray, pattern: str) -> float:
    """Of the mean over colours, which share all frames, and each row or column with another."""
    if len(errors) == 1 or pattern == PATTERNS["frame"]:
        return float(errors.mean())
    return float(np.sqrt(2)) * _error_of_mean(errors)


def _error_of_mean(errors: np.ndarray) -> float:
    return float(np.sqrt((errors**2).sum()) / len(errors))
