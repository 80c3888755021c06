"""The noise budget of the fitted model against the measured one: components that determine a parameter must agree.

Mean and noise of the typical pixel determine black level, dark current, read noise and gain; the offset that a row
shares within a frame determines the row gain. Frames are drawn from the fit under the conditions of the capture, and
both are decomposed in the same way.
"""

from __future__ import annotations

from collections.abc import Iterator

import jax
import numpy as np

from hsnoise._core.keys import named_key, numbered_keys
from hsnoise._core.types import seconds
from hsnoise.fitting.result import FitResult
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel, sample_by_effect
from hsnoise.statistics.decomposition import Component, mean_of
from hsnoise.statistics.pixels.probe import PROBE_FRAMES
from hsnoise.statistics.pixels.sample import without_outliers
from hsnoise.statistics.pixels.survey import Group, Survey, survey
from hsnoise.statistics.pixels.taps import levelled

FRAMES, SHAPE = 8, (128, 256)  # drawn per exposure
MOST_EXPOSURES = 4  # drawn: the shortest, the longest, and some between
NOISE_SHARE = 0.08  # relative difference in noise that is tolerated
LEVEL_NOISES, LEVEL_SHARE = 1.0, 0.1  # tolerated difference in level: of a pixel's noise, and of the signal
ROW_SHARE, ROW_NOISE = 0.5, 0.02  # tolerated difference of rows: of the larger one, and of the variance of a pixel
SIGMAS = 5.0


def disagreements(result: FitResult, found: Survey) -> Iterator[str]:
    """Sentences on measured noise that the fitted model does not reproduce; none without a gain."""
    if result.stack is None or not result.has_gain or found.shortest is None:
        return
    taps = None if result.transfer is None else result.transfer.taps
    if "amplifier_glow" in result.params:  # the middle, where frames are drawn, has less of it
        found = _of_the_middle(result.stack, found)
    elif taps is not None:  # the typical pixel of outputs that lie far apart would be that of either
        found = levelled(found, taps)
    if "electron_multiplication" in result.params:  # what is an outlier of a skewed noise depends on their number
        found = survey(result.stack.select(frames=slice(0, FRAMES)))
    chosen = _chosen(found)
    if any(plane.narrow_dn is not None for i in chosen for plane in found.groups[i].planes):
        return  # rounding dominates noise below a count, and affects the two unequally
    drawn = _drawn(_without_outputs(result.params), result.stack, [found.groups[i].exposure_s for i in chosen])
    pairs = [(found.groups[i], group) for i, group in zip(chosen, drawn.groups, strict=True)]
    for c, channel in enumerate(found.channels):
        of = "" if channel == "mono" else f" of {channel}"
        for differences in (_noise, _level, _rows):
            _, sentence = max(differences(pairs, c, of), default=(0.0, ""))
            if sentence:
                yield sentence


def _without_outputs(model: NoiseModel) -> NoiseModel:
    """The model as if one output read the frame: others are drawn at random for every sensor of the make."""
    for name in ("tap_offsets", "tap_gains"):
        model = model.remove(name) if name in model else model
    return model


def _drawn(model: NoiseModel, stack: FrameStack, exposures_s: list[float]) -> Survey:
    """A survey of darks drawn from the model, all of one size so that a process compiles the sampling once."""
    key = jax.random.key(0)
    counts = sample_by_effect(
        numbered_keys(named_key(key, "frames"), np.arange(len(exposures_s))),
        np.broadcast_to(np.float32(0), (len(exposures_s), *SHAPE)),
        FRAMES,
        model,
        exposures_s=exposures_s,
        sensor_key=named_key(key, "sensor"),
        window=_middle(stack),
    )
    taken = {"cfa": stack.cfa, "shutter": stack.shutter, "white_level": stack.white_level}
    return survey(FrameStack(list(np.asarray(counts)), exposure_s=exposures_s, **taken))


def _of_the_middle(stack: FrameStack, found: Survey) -> Survey:
    """A survey of the pixels that `_middle` says; `found` where frames are drawn as large as the sensor."""
    if _middle(stack) is None:
        return found
    starts = [(size - drawn) // 4 * 2 for size, drawn in zip(stack.shape, SHAPE, strict=True)]
    rows, columns = ((start, start + drawn) for start, drawn in zip(starts, SHAPE, strict=True))
    return survey(stack.select(rows=rows, columns=columns, frames=slice(0, PROBE_FRAMES)))


def _middle(stack: FrameStack) -> tuple[int, int, int, int] | None:
    """Where drawn frames lie on the sensor; None if the sensor is smaller than they are."""
    free = [size - drawn for size, drawn in zip(stack.shape, SHAPE, strict=True)]
    if min(free) < 0:
        return None
    row, column, *whole = stack.window or (0, 0, *stack.shape)
    return row + free[0] // 4 * 2, column + free[1] // 4 * 2, whole[0], whole[1]


def _chosen(found: Survey) -> list[int]:
    """The groups to draw: darks of several frames, evenly spread over their exposures."""
    repeated = [i for i, group in enumerate(found.groups) if group.kind == "dark" and group.n_frames > 1]
    repeated.sort(key=lambda i: found.groups[i].exposure_s)
    places = np.linspace(0, len(repeated) - 1, min(MOST_EXPOSURES, len(repeated))).round().astype(int)
    return sorted(repeated[place] for place in places)


def _noise(pairs: list[tuple[Group, Group]], c: int, of: str) -> Iterator[tuple[float, str]]:
    """How far temporal noise is off, with a sentence about it."""
    for group, drawn in pairs:
        (measured, error), (model, chance) = _typical(group, c), _typical(drawn, c)
        off = abs(np.sqrt(measured / max(model, 1e-12)) - 1)
        if off > NOISE_SHARE and abs(measured - model) > SIGMAS * np.hypot(error, chance):
            yield (
                off,
                f"The pixel noise{of} at {seconds(group.exposure_s)} is {np.sqrt(measured):.4g} DN, but"
                f" {np.sqrt(model):.4g} DN in frames drawn from the fit: gain or read noise is wrong.",
            )


def _level(pairs: list[tuple[Group, Group]], c: int, of: str) -> Iterator[tuple[float, str]]:
    """How far the typical pixel's level is off, with a sentence about it."""
    lowest = min(_median(group, c) for group, _ in pairs)
    for group, drawn in pairs:
        level, model, noise = _median(group, c), _median(drawn, c), np.sqrt(_typical(group, c)[0])
        off, error = abs(level - model), np.hypot(group.level_error_dn(c), drawn.level_error_dn(c))
        if off > max(LEVEL_NOISES * noise, LEVEL_SHARE * (level - lowest), SIGMAS * error):
            yield (
                off / max(noise, 1e-6),
                f"The level of the typical pixel{of} at {seconds(group.exposure_s)} is {level:.5g} DN, but"
                f" {model:.5g} DN in frames drawn from the fit: its dark signal does not grow with exposure as a dark"
                " current does.",
            )


def _rows(pairs: list[tuple[Group, Group]], c: int, of: str) -> Iterator[tuple[float, str]]:
    """How far the noise that a row shares within a frame is off, with a sentence about it."""
    for group, drawn in pairs:
        one, other = (_shared_by_rows(side, c) for side in (group, drawn))
        off, noise = abs(one.variance_dn2 - other.variance_dn2), _typical(group, c)[0]
        error = SIGMAS * np.hypot(group.rows_error_dn2(c), drawn.rows_error_dn2(c))
        if off > max(ROW_NOISE * noise, error, ROW_SHARE * max(one.variance_dn2, other.variance_dn2)):
            yield (
                off / max(noise, 1e-6),
                f"The row noise within frames{of} at {seconds(group.exposure_s)} is {_rms(one):.3g} DN, but"
                f" {_rms(other):.3g} DN in frames drawn from the fit: the row gain is wrong, or rows have another kind"
                " of noise.",
            )


def _typical(group: Group, c: int) -> tuple[float, float]:
    """Temporal variance of the pixels without outliers, DN^2, and its standard error."""
    frames = min(group.n_frames, PROBE_FRAMES)  # with many, pixels that are only brighter would be outliers
    mean, error = without_outliers(group.pixels(c, "pair_variance_dn2").astype(np.float64), frames)
    return max(mean, 0.0), error  # the noise of row and column offsets has been subtracted


def _median(group: Group, c: int) -> float:
    return float(np.median(group.pixels(c, "level_dn").mean(0)))


def _shared_by_rows(group: Group, c: int) -> Component:
    return mean_of([plane.components["row_x_frame"] for plane in group.of(c)])


def _rms(one: Component) -> float:
    return float(np.sqrt(max(one.variance_dn2, 0.0)))
