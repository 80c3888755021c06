"""Outputs that read parts of the frame: what they are, and that numbers of the table are means over them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hsnoise._core.robust import OF_MEDIAN, robust_sigma
from hsnoise.fitting.result import FitResult
from hsnoise.statistics.pixels.survey import Plane, Survey
from hsnoise.statistics.pixels.taps import Taps

DIFFER = 0.02  # largest relative difference of gains that is no doubt
SIGMAS = 5.0  # standard errors beyond which the pixels of a channel differ


def gains_differ(result: FitResult, found: Survey) -> Iterator[str]:
    """That no pixel may have the gain of the table."""
    yield from outputs_differ(result)
    yield from _of_greens(found)


def outputs_differ(result: FitResult) -> Iterator[str]:
    """That outputs have gains of their own."""
    taps = _taps(result)
    if taps is None or not taps.gains_differ or np.ptp(taps.gain) < DIFFER:
        return
    rows, columns = (n // of for n, of in zip(result.summary.shape, (taps.rows, taps.columns), strict=True))
    alone = "counts[..., ::2]" if taps.interleaved else f"--roi 0:{rows},0:{columns}, or stack.select,"
    yield (
        f"{_outputs(taps)}, and their gains differ: {_listed(taps.gain, '.3f')} of the mean"
        f" (± {float(taps.gain_error.mean()):.1g}). Gain, read noise and dark current here are of all of them together;"
        f" {alone} fits the first output alone."
    )


def _of_greens(found: Survey) -> Iterator[str]:
    """That the two pixels of a channel in each cell grow unlike: they are alike, so that their gains differ."""
    if not found.has_exposures:
        return
    for c, name in enumerate(found.channels):
        pairs = [*zip(found.shortest.of(c), found.longest.of(c), strict=True)]
        if len(pairs) != 2 or any(plane.narrow_dn is not None for pair in pairs for plane in pair):
            continue  # one a cell; or rounding bends the levels
        (one, one_error), (other, other_error) = (_growth(*pair) for pair in pairs)
        if min(one, other) <= 0:
            continue
        ratio, error = one / other, np.hypot(one_error / one, other_error / other)
        if abs(ratio - 1) > max(DIFFER, SIGMAS * error):
            yield (
                f"In even rows the pixels of channel {name} gather {ratio:.3f} ± {ratio * error:.2g} times the dark"
                f" signal, in DN, of those in odd rows: their gains differ, and gain.{name} is of both together."
            )


def _growth(short: Plane, long: Plane) -> tuple[float, float]:
    """Of the level of the typical pixel between two exposures, DN, and its standard error by how pixels differ."""
    grown = long.halves.level_dn.mean(0) - short.halves.level_dn.mean(0)
    typical = float(np.median(grown))
    return typical, OF_MEDIAN * robust_sigma(grown - typical) / np.sqrt(len(grown))


def outputs(result: FitResult) -> Iterator[str]:
    """Offsets and noise of each output."""
    taps = _taps(result)
    if taps is not None:
        yield (
            f"{_outputs(taps)}: offsets of {_listed(taps.offset_dn, '+.3g')} DN, noise of"
            f" {_listed(taps.noise_dn, '.3g')} DN."
        )


def columns_in_light(result: FitResult) -> Iterator[str]:
    """That even and odd columns differ in light, where noise does not tell why."""
    if result.transfer is not None and not result.transfer.parity_told:
        yield (
            "Whether even and odd columns differ in light by their response"
            " (photo_response_nonuniformity.column_parity) or by the gains of two outputs"
            " (odd_even_pattern.gain_mismatch), their noise does not tell: more frames of the flats would."
        )


def _taps(result: FitResult) -> Taps | None:
    return None if result.transfer is None else result.transfer.taps


def _outputs(taps: Taps) -> str:
    if taps.interleaved:
        return "Even and odd columns differ as if outputs of their own read them"
    return f"{taps.rows} x {taps.columns} outputs read blocks of the frame (rows x columns)"


def _listed(values: np.ndarray, form: str) -> str:
    return "; ".join(", ".join(format(value, form) for value in row) for row in values)
