"""Values from headers and the user, tested against the frames: gain, black and white level, shutter, colours."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hsnoise._core.naming import setting
from hsnoise.fitting.doubts._evidence import Evidence
from hsnoise.fitting.flat_notes import stated_gain_note
from hsnoise.fitting.result import FitResult, Method
from hsnoise.frames.mosaics import looks_like_a_mosaic, mosaic_in_words
from hsnoise.statistics.decomposition import mean_of
from hsnoise.statistics.pixels.survey import Group

BLACK_SIGMAS, BLACK_DN, EXTRAPOLATED = 5.0, 0.25, 0.5  # the last: share of the signal at the shortest exposure
FEWEST_PILED, PILED = 20, 3.0  # pixels at the highest count, and how many times as many as just below it
NOISY_DN = 1.0  # with less noise, counts pile up anyway
OF_READOUT = {"row_group_noise", "row_bank_noise"}
ROW_SIGMAS, TOGETHER = 6.0, 0.3  # the last: share of a row's noise that continues in the next row


def stated(result: FitResult, seen: Evidence) -> Iterator[str]:
    """All given values that the frames contradict."""
    gain = None if result.stack is None else result.stack.stated_gain
    if gain is not None and gain.certain:
        yield from header_gain(result)
    for check in (_black_level, _white_level, _mosaic, _shutter):
        yield from check(result, seen)


def header_gain(result: FitResult) -> Iterator[str]:
    """The header's gain against the fitted one; where the header's may be nominal, the frames are trusted."""
    if result.stack is None or not result.has_gain:
        return
    rows = list(result.rows_of("gain").values())
    value, error = (float(np.mean([row[i] for row in rows])) for i in (0, 1))
    yield from stated_gain_note(result.stack.stated_gain, value, error)


def _black_level(result: FitResult, seen: Evidence) -> Iterator[str]:
    """A given black level, against the level of the darks without signal."""
    given = result.summary.black_level_dn
    if given is None or result.transfer is None and result.method != Method.ML or not seen.survey.has_exposures:
        return
    pixel = result.transfer if result.transfer is not None else seen.darks
    darks = seen.survey.darks
    shortest = min(g.exposure_s for g in darks)
    for c, channel in enumerate(pixel.channels):
        level, error = channel.black_dn
        clipped = max(g.clipped_share[c] for g in darks)
        if clipped > 1e-4 or not np.isfinite(error):
            continue
        back = EXTRAPOLATED * abs(channel.values[2]) * shortest  # the median of pixels does not grow linearly
        if abs(level - given[c]) > max(BLACK_SIGMAS * error, BLACK_DN, back):
            of = "" if channel.name == "mono" else f" of {channel.name}"
            yield (
                f"The black level{of} was given as {given[c]:.4g} DN, but darks without signal lie at {level:.4g} ±"
                f" {error:.2g} DN. Omit it to have it fitted."
            )


def _white_level(result: FitResult, seen: Evidence) -> Iterator[str]:
    """Counts that saturate below the white level, or exceed it."""
    given = result.summary.white_level_dn
    noisy = [group for group in seen.survey.groups if group.n_frames > 1 and group.noise_dn > NOISY_DN]
    if not noisy:
        return
    moving = [~seen.survey.stuck(c) for c in range(len(seen.survey.channels))]
    highest = np.concatenate([_highest(group, moving) for group in noisy])
    top = float(highest.max())
    above = 0.0 if given is None else float((highest > given).mean())
    if above > 0:
        yield (
            f"{100 * above:.2g} % of the pixels have counts above the given white level of {given:g} DN, up to"
            f" {top:g}. Omit the white level, or give {setting('white_level', top)}."
        )
        return
    piled = int((highest == top).sum())
    below = int(((highest < top) & (highest >= top - 4 * max(group.noise_dn for group in noisy))).sum())
    if piled < max(FEWEST_PILED, PILED * below) or top >= (seen.survey.full_scale_dn if given is None else given) - 1:
        return
    what = "no white level was given" if given is None else f"the white level was given as {given:g} DN"
    yield (f"{piled} of the sampled pixels saturate at {top:g} DN, but {what}: give {setting('white_level', top)}.")


def _highest(group: Group, moving: list[np.ndarray]) -> np.ndarray:
    """The highest count of each pixel, without stuck pixels."""
    of = [group.pixels(c, "highest")[kept] for c, kept in enumerate(moving)]
    return np.concatenate(of).astype(np.float64)


def _mosaic(result: FitResult, seen: Evidence) -> Iterator[str]:
    """A colour sensor that was read as mono."""
    stack = result.stack
    if stack is None or stack.cfa != "mono" or "dark" not in stack.kind:
        return
    darks = [i for i, kind in enumerate(stack.kind) if kind == "dark"]
    if looks_like_a_mosaic(stack.frame(max(darks, key=lambda i: stack.exposure_s[i]), 0)):
        yield f"The frames are {mosaic_in_words()}."


def _shutter(result: FitResult, seen: Evidence) -> Iterator[str]:
    """Rows that share noise with the next row, although the shutter was given as global."""
    planes = [plane for group in seen.survey.repeated_darks for plane in group.planes]
    # Rows that a global shutter exposes at once may still be read together, or by two banks.
    if result.summary.shutter != "global" or not planes or not OF_READOUT.isdisjoint(result.params.names):
        return
    shared = mean_of([plane.components["row_x_frame"] for plane in planes])
    together = mean_of([plane.rows_together[0] for plane in planes])
    if not shared.variance_dn2 > ROW_SIGMAS * shared.chance_dn2:  # NaN, too
        return
    if together.variance_dn2 > max(ROW_SIGMAS * together.chance_dn2, TOGETHER * shared.variance_dn2):
        correlation = together.variance_dn2 / shared.variance_dn2
        yield (
            f"The noise of a row continues in the next row (correlation {correlation:.2f}), which a global shutter does"
            " not cause: the shutter is rolling, or the rows have another kind of noise."
        )
