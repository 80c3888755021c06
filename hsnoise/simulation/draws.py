"""Captures drawn from a model, like a given one: same exposures, frames, shape and light, one sensor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache

import jax
import numpy as np
import scipy  # its parts are imported when they are used

from hsnoise._core.keys import key_of, named_key, numbered_keys
from hsnoise._core.naming import named, setting
from hsnoise._core.robust import robust_sigma
from hsnoise._core.types import RandomKey, cfa_tile, channel_index
from hsnoise.chain.shared import Shared
from hsnoise.effects import Stage
from hsnoise.frames.stack import FrameStack
from hsnoise.likelihood.summary import Summary
from hsnoise.model import NoiseModel, dark_signals, in_session_precision, sample_by_effect

MOST_RANGES = 100.0  # a signal this many times what the camera can hold is in another unit
SURFACE_DEGREE = 3  # of the light on flats
SPIKE, LEAST_DN = 8.0, 0.5  # deviations of a pixel from the median of those around it; the least of these
SMOOTH_PIXELS = 3.0  # of the light on flats: a pixel has 1 % of a say in its own
TOGETHER = 800_000  # pixels that are drawn in one go: more leave the processor's cache, fewer wait for Python
SPARE = 0.3  # of those that are drawn, for exposures of almost as many frames to share compiled programs


def check_fits(model: NoiseModel, stack: FrameStack | Summary, name: str = "params") -> None:
    """Raise TypeError or ValueError, naming the argument, unless `model` can describe the sensor of `stack`."""
    if not isinstance(model, NoiseModel):
        raise TypeError(f"{named(name)}: expected a NoiseModel (fit.params of a fit), got {type(model).__name__}")
    if (model.cfa, model.shutter) != (stack.cfa, stack.shutter):
        raise ValueError(
            f"{named(name)}: made for {model.cfa}, {model.shutter} shutter; the stack is {stack.cfa}, {stack.shutter}"
            f" (if its files do not say so, give it {setting('cfa')} and {setting('shutter')})"
        )
    if "adc" not in model:
        raise ValueError(f"{named(name)}: expected a model with the effect adc, which makes counts (DN)")


def check_effects(model: NoiseModel, like: FrameStack) -> None:
    """Raise ValueError, naming the effect, if one of them returns another shape, NaN or numbers of another unit.

    The longest exposure is drawn, effect by effect.
    """
    longest = int(np.argmax(like.exposure_s))
    frames, exposure_s = like.n_frames[longest], float(like.exposure_s[longest])
    gain = float(np.mean(np.asarray(model["gain"].value))) if "gain" in model else 1.0
    if like.white_level is None:
        white_dn = max(2.0**16, *(float(frame.max()) for frame in like.frames(longest)))
    else:
        white_dn = float(like.white_level)
    for effect, signal in dark_signals(jax.random.key(0), frames, like.shape, model, exposure_s=exposure_s):
        values = np.asarray(signal, float)
        unit, largest = ("e-", white_dn / gain) if effect.acts_at < Stage.GAIN else ("DN", white_dn)
        bad = ~np.isfinite(values)
        if bad.any():
            raise ValueError(
                f"{effect.name}: its sample returned NaN or infinity in {100 * bad.mean():.3g} % of the pixels."
            )
        typical = float(np.sqrt(np.mean(values**2)))
        if typical > MOST_RANGES * largest:
            raise ValueError(
                f"{effect.name}: its sample returned a signal of {typical:.3g} {unit} (rms) in a dark frame, where the"
                f" camera holds {largest:.3g}; are its parameters in the units that it declares?"
            )


def black_level_of(model: NoiseModel) -> np.ndarray:
    """Black level [channel], DN."""
    n = len(model.channels)
    return np.asarray(model["black_level"].value, float) if "black_level" in model else np.zeros(n)


def draw_capture(
    key: RandomKey | int,
    model: NoiseModel,
    like: FrameStack,
    before: Sequence[int] = (),
    shared: Shared | None = None,
) -> FrameStack:
    """A capture drawn from `model` as `like` was taken: one sensor, every frame new, flats in light as bright.

    key: a random key, or its seed; before: for each exposure, how many frames of the series come before those of
    `like`; default: none; shared: what draws of other models may have in common with this one.
    """
    key = key_of("key", key)
    sensor_key, of_frames = named_key(key, "sensor"), named_key(key, "frames")
    firsts = before or [0] * like.n_exposures
    needed = [first + frames for first, frames in zip(firsts, like.n_frames, strict=True)]
    sampled = in_session_precision(model)  # once for all exposures
    counts: dict[int, np.ndarray] = {}
    for frames, some in _together(_alike(needed), like):
        drawn = sample_by_effect(
            numbered_keys(of_frames, np.array(some)),
            _light_of_all(model, like, some),
            frames,
            sampled,
            exposures_s=[float(like.exposure_s[e]) for e in some],
            sensor_key=sensor_key,
            window=like.window,
            shared=shared,
        )
        counts.update((e, of[firsts[e] : needed[e]]) for e, of in zip(some, np.asarray(drawn), strict=True))
    return like.with_counts([counts[e] for e in range(like.n_exposures)], like.window)


def _together(numbers: Sequence[int], like: FrameStack) -> Iterator[tuple[int, list[int]]]:
    """Numbers of frames, and exposures of which so many are drawn together: all darks or all flats, TOGETHER pixels.

    For them to share compiled programs, some may come twice.
    """
    for frames in dict.fromkeys(numbers):
        most = max(TOGETHER // (frames * like.shape[0] * like.shape[1]), 1)
        groups: dict[str, list[int]] = {}
        for e, kind in enumerate(like.kind):
            if numbers[e] == frames:
                groups.setdefault(kind, []).append(e)
        sizes = _alike([-(-len(group) // -(-len(group) // most)) for group in groups.values()])
        for group, size in zip(groups.values(), sizes, strict=True):
            for first in range(0, len(group), size):
                some = group[first : first + size]
                yield frames, some + some[-1:] * (size - len(some))


def _alike(numbers: Sequence[int]) -> list[int]:
    """Numbers (of frames, of exposures) to draw for those that are needed: compiling an effect for one more takes as
    long as drawing many frames.
    """
    kept: list[int] = []
    for number in sorted(set(numbers), reverse=True):
        if not kept or number < (1 - SPARE) * kept[-1]:
            kept.append(number)
    return [min(size for size in kept if size >= number) for number in numbers]


def _light_of_all(model: NoiseModel, like: FrameStack, exposures: list[int]) -> np.ndarray:
    """Light of exposures that are all darks or all flats [exposure, row, column]."""
    if like.kind[exposures[0]] == "dark":
        return np.broadcast_to(np.float32(0), (len(exposures), *like.shape))
    return np.stack([light_of(model, like, e) for e in exposures])


def light_of(model: NoiseModel, like: FrameStack, exposure: int) -> np.ndarray:
    """Expected photoelectrons [row, column] at which `model` gives an exposure of `like` its mean; 0 in darks."""
    if like.kind[exposure] == "dark":
        return np.broadcast_to(np.float32(0), like.shape)
    light_e = photoelectrons(model, _illumination_dn(like, exposure), float(like.exposure_s[exposure]))
    return np.maximum(light_e, 0.0).astype(np.float32)


def photoelectrons(model: NoiseModel, reading_dn: np.ndarray, exposure_s: float) -> np.ndarray:
    """Photoelectrons [..., row, column] that read so many DN, in pixels without offsets and with the mean dark current.

    Below 0 where the reading is below that of darks.
    """
    channel = channel_index(model.cfa, reading_dn.shape[-2:])
    dark_e = float(model["dark_current"].rate) * exposure_s if "dark_current" in model else 0.0
    if "measured_response" in model:
        reading_dn = model["measured_response"].before(reading_dn)
    signal_e = (reading_dn - black_level_of(model)[channel]) / np.asarray(model["gain"].value)[channel]
    if "nonlinearity" in model:
        signal_e = model["nonlinearity"].before(signal_e)
    return signal_e - dark_e


@lru_cache(maxsize=32)
def _illumination_dn(like: FrameStack, exposure: int) -> np.ndarray:
    """Mean of an exposure [row, column], DN, of each plane of the Bayer pattern without what pixels differ by.

    A cubic surface, which goes on to the edges, and what is left of it, smoothed: the light of real flats has edges
    of its own (a slit, dust, a vignette). Single pixels that lie far off, such as hot ones, do not light their
    surroundings.
    """
    mean = np.mean([frame.astype(np.float32) for frame in like.frames(exposure)], axis=0, dtype=np.float64)
    step, smooth = len(cfa_tile(like.cfa)), np.empty(like.shape)
    for r, c in np.ndindex(step, step):
        plane = mean[r::step, c::step]
        down, across = (np.polynomial.legendre.legvander(np.linspace(-1, 1, n), SURFACE_DEGREE) for n in plane.shape)
        surface = down @ (np.linalg.pinv(down) @ plane @ np.linalg.pinv(across).T) @ across.T
        left = _without_spikes(plane - surface)
        smooth[r::step, c::step] = surface + scipy.ndimage.gaussian_filter(left, SMOOTH_PIXELS, mode="mirror")
    return smooth


def _without_spikes(plane: np.ndarray) -> np.ndarray:
    """The plane with the median of their surroundings in place of single pixels that lie far from it."""
    beside = scipy.ndimage.median_filter(plane, 3, mode="mirror")
    off = np.abs(plane - beside)
    usual = max(robust_sigma(off), LEAST_DN)  # where most pixels have the same count, others are no spikes
    return np.where(off > SPIKE * usual, beside, plane)
