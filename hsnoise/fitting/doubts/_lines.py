"""Static rows and columns that a pattern of independent lines does not describe: those far off, and curves."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hsnoise.fitting.pixel_lines import Lines
from hsnoise.fitting.pixel_patterns import AXES, PATTERNS
from hsnoise.fitting.result import FitResult

NOTABLE = 0.01  # of the temporal variance of pixels: less changes no frame visibly


def curves(result: FitResult) -> Iterator[str]:
    """Fixed patterns of lines that follow a curve, where their effect draws a random one."""
    for axis in AXES:
        name, found = PATTERNS[axis], _lines(result, axis)
        notable = [one.follow and one.variance_dn2 > NOTABLE * temporal_dn2 for one, temporal_dn2 in found]
        if name not in result.added or not any(notable):
            continue
        whole = max(float(np.mean([one.variance_dn2 for one, _ in found])), 0.0) ** 0.5
        beside = max(float(np.mean([one.next_dn2 for one, _ in found])), 0.0) ** 0.5
        yield (
            f"The fixed levels of {axis}s differ by {whole:.2g} DN, but those of neighbours only by {beside:.2g} DN:"
            f" they follow a curve of another shape than black_shading. {name} draws other curves, as smooth."
        )


def defects(result: FitResult) -> Iterator[str]:
    """Lines that lie far off, which no effect draws."""
    for axis in AXES:
        found = [one for one, dn2 in _lines(result, axis) if one.far and one.farthest_dn**2 > NOTABLE * dn2]
        if found:
            far, farthest = max(one.far for one in found), max(one.farthest_dn for one in found)
            lines, are = (f"{far} {axis}s lie", "are") if far > 1 else (f"One {axis} lies", "is")
            yield (
                f"{lines} far off the others in all frames, by up to {farthest:.2g} DN, and {are} in no effect:"
                " defects, or the edge of a drift."
            )


def _lines(result: FitResult, axis: str) -> list[tuple[Lines, float]]:
    """Static lines of each colour, and the temporal variance of its pixels, DN^2."""
    channels = () if result.transfer is None else result.transfer.channels
    return [(channel.lines[axis], channel.temporal_dn2) for channel in channels if axis in channel.lines]
