"""The budget under the fitted model beside the measured one: the components that carry a parameter must agree.

Mean and noise of the typical pixel carry black level, dark current, read noise and gain; what rows share in a frame
carries the row gain. Frames are drawn from the fit as the measured ones were taken, and both are decomposed alike.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hsnoise._types import seconds
from hsnoise.decomposition import Component
from hsnoise.draws import draw_capture, middle_of
from hsnoise.pixels.survey import Group, Survey, survey
from hsnoise.result import FitResult

MOST_EXPOSURES = 4  # that are drawn: the shortest, the longest, and between
OUTLYING = 6.0  # deviations of a pixel's temporal variance that is no noise of it
NOISE_SHARE = 0.08  # of a noise, by which the two may differ
LEVEL_NOISES, LEVEL_SHARE = 1.0, 0.1  # of a pixel's noise, and of the signal
ROW_SHARE, ROW_NOISE = 0.5, 0.02  # of the larger one, and of the variance of a pixel
SIGMAS = 5.0


def disagreements(result: FitResult, found: Survey) -> Iterator[str]:
    """What of the measured noise the fitted model does not draw, in sentences; nothing where there is no gain."""
    if result.stack is None or not result.has_gain or found.shortest is None:
        return
    chosen = _chosen(found)
    if any(plane.narrow_dn is not None for i in chosen for plane in found.groups[i].planes):
        return  # rounding, which two noises below a count share unequally, is most of it
    drawn = survey(draw_capture(0, result.params, middle_of(result.stack.select(exposures=chosen))))
    pairs = [(found.groups[i], group) for i, group in zip(chosen, drawn.groups, strict=True)]
    for c, channel in enumerate(found.channels):
        of = "" if channel == "mono" else f" of {channel}"
        for differences in (_noise, _level, _rows):
            _, sentence = max(differences(pairs, c, of), default=(0.0, ""))
            if sentence:
                yield sentence


def _chosen(found: Survey) -> list[int]:
    """Which groups are drawn: darks of several frames, evenly over their exposures."""
    repeated = [i for i, group in enumerate(found.groups) if group.kind == "dark" and group.n_frames > 1]
    repeated.sort(key=lambda i: found.groups[i].exposure_s)
    places = np.linspace(0, len(repeated) - 1, min(MOST_EXPOSURES, len(repeated))).round().astype(int)
    return sorted(repeated[place] for place in places)


def _noise(pairs: list[tuple[Group, Group]], c: int, of: str) -> Iterator[tuple[float, str]]:
    """By how much temporal noise is off, and the sentence on it."""
    for group, drawn in pairs:
        (measured, error), (model, chance) = _typical(group, c), _typical(drawn, c)
        off = abs(np.sqrt(measured / max(model, 1e-12)) - 1)
        if off > NOISE_SHARE and abs(measured - model) > SIGMAS * np.hypot(error, chance):
            yield (
                off,
                f"The noise of the pixels{of} at {seconds(group.exposure_s)} is {np.sqrt(measured):.4g} DN, that of"
                f" frames drawn from the fit {np.sqrt(model):.4g} DN: gain and read noise describe another sensor.",
            )


def _level(pairs: list[tuple[Group, Group]], c: int, of: str) -> Iterator[tuple[float, str]]:
    """By how much the typical pixel's level is off, and the sentence on it."""
    lowest = min(_median(group, c) for group, _ in pairs)
    for group, drawn in pairs:
        level, model, noise = _median(group, c), _median(drawn, c), np.sqrt(_typical(group, c)[0])
        off = abs(level - model)
        if off > max(LEVEL_NOISES * noise, LEVEL_SHARE * (level - lowest)):
            yield (
                off / max(noise, 1e-6),
                f"The level of the typical pixel{of} at {seconds(group.exposure_s)} is {level:.5g} DN, in frames drawn"
                f" from the fit {model:.5g} DN: its dark signal does not grow with exposure as a dark current does.",
            )


def _rows(pairs: list[tuple[Group, Group]], c: int, of: str) -> Iterator[tuple[float, str]]:
    """By how much that which rows share in a frame is off, and the sentence on it."""
    for group, drawn in pairs:
        one, other = (_shared_by_rows(side, c) for side in (group, drawn))
        off, noise = abs(one.variance_dn2 - other.variance_dn2), _typical(group, c)[0]
        error = SIGMAS * np.hypot(one.standard_error_dn2, other.standard_error_dn2)
        if off > max(ROW_NOISE * noise, error, ROW_SHARE * max(one.variance_dn2, other.variance_dn2)):
            yield (
                off / max(noise, 1e-6),
                f"What a row{of} shares in a frame at {seconds(group.exposure_s)} is {_rms(one):.3g} DN, in frames"
                f" drawn from the fit {_rms(other):.3g} DN: the row gain is wrong, or rows have noise of another kind.",
            )


def _typical(group: Group, c: int) -> tuple[float, float]:
    """Temporal variance of the pixels that are no outliers, DN^2, and its standard error."""
    variance = np.concatenate([p.halves.pair_variance_dn2 for p in group.of(c)]).astype(np.float64)
    limit = (np.median(variance) + 1e-6) * (1 + OUTLYING * np.sqrt(2 / (group.n_frames - 1))) ** 2
    kept = variance[variance < limit]
    return float(kept.mean()), float(kept.std() / np.sqrt(len(kept)))


def _median(group: Group, c: int) -> float:
    return float(np.median(np.concatenate([p.halves.level_dn.mean(0) for p in group.of(c)])))


def _shared_by_rows(group: Group, c: int) -> Component:
    parts = [plane.components["row_x_frame"] for plane in group.of(c)]
    error = float(np.sqrt(sum(part.standard_error_dn2**2 for part in parts))) / len(parts)
    return Component(float(np.mean([part.variance_dn2 for part in parts])), error)


def _rms(one: Component) -> float:
    return float(np.sqrt(max(one.variance_dn2, 0.0)))
