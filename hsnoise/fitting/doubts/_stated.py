"""What headers and the user said, tested against the frames: gain, black and white level, shutter, colours."""

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

BLACK_SIGMAS, BLACK_DN, EXTRAPOLATED = 5.0, 0.25, 0.5  # the last of the signal at the shortest exposure
FEWEST_PILED, PILED = 20, 3.0  # pixels at the highest count; as many times those of the counts below it
NOISY_DN = 1.0  # counts of narrower noise pile up anyway
ROW_SIGMAS, TOGETHER = 6.0, 0.3  # of what a row shares, that the next one has, too


def stated(result: FitResult, seen: Evidence) -> Iterator[str]:
    """All that was given and that the frames contradict."""
    gain = None if result.stack is None else result.stack.stated_gain
    if gain is not None and gain.certain:
        yield from header_gain(result)
    for check in (_black_level, _white_level, _mosaic, _shutter):
        yield from check(result, seen)


def header_gain(result: FitResult) -> Iterator[str]:
    """A gain that the header states, against the fitted one; where it may be a nominal one, the frames are believed."""
    if result.stack is None or not result.has_gain:
        return
    rows = list(result.rows_of("gain").values())
    value, error = (float(np.mean([row[i] for row in rows])) for i in (0, 1))
    yield from stated_gain_note(result.stack.stated_gain, value, error)


def _black_level(result: FitResult, seen: Evidence) -> Iterator[str]:
    """A black level that was given, against the level of the darks without signal."""
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
        back = EXTRAPOLATED * abs(channel.values[2]) * shortest  # the median of growing pixels is no straight line
        if abs(level - given[c]) > max(BLACK_SIGMAS * error, BLACK_DN, back):
            of = "" if channel.name == "mono" else f" of {channel.name}"
            yield (
                f"The black level{of} was given as {given[c]:.4g} DN; the darks without signal lie at {level:.4g} ±"
                f" {error:.2g} DN. Leave it out, and it is fitted."
            )


def _white_level(result: FitResult, seen: Evidence) -> Iterator[str]:
    """Counts that end below the white level, or go on above it."""
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
            f"{100 * above:.2g} % of the pixels hold counts above the white level, which was given as {given:g} DN, up"
            f" to {top:g}: it is higher. Leave it out, or give {setting('white_level', top)}."
        )
        return
    piled = int((highest == top).sum())
    below = int(((highest < top) & (highest >= top - 4 * max(group.noise_dn for group in noisy))).sum())
    if piled < max(FEWEST_PILED, PILED * below) or top >= (seen.survey.full_scale_dn if given is None else given) - 1:
        return
    what = "no white level was given" if given is None else f"the white level was given as {given:g} DN"
    yield (
        f"{piled} of the pixels looked at end at a count of {top:g} DN, and {what}: give {setting('white_level', top)}."
    )


def _highest(group: Group, moving: list[np.ndarray]) -> np.ndarray:
    """The highest count of each pixel that is not stuck."""
    of = [np.concatenate([p.halves.highest for p in group.of(c)])[kept] for c, kept in enumerate(moving)]
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
    """Rows that share noise with the next one, where the shutter was said to be a global one."""
    planes = [plane for group in seen.survey.repeated_darks for plane in group.planes]
    if result.summary.shutter != "global" or not planes:
        return
    shared = mean_of([plane.components["row_x_frame"] for plane in planes])
    together = mean_of([plane.rows_together for plane in planes])
    if not shared.variance_dn2 > ROW_SIGMAS * shared.chance_dn2:  # NaN, too
        return
    if together.variance_dn2 > max(ROW_SIGMAS * together.chance_dn2, TOGETHER * shared.variance_dn2):
        correlation = together.variance_dn2 / shared.variance_dn2
        yield (
            f"What a row shares in a frame goes on in the next row (correlation {correlation:.2f}), which a"
            " global shutter does not do: the shutter is a rolling one, or the rows have noise of another kind."
        )
