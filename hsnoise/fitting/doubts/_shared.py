"""Noise that a pixel shares with its neighbours or with the frame before: its variance measures no electrons then."""

from __future__ import annotations

from collections.abc import Iterator

from hsnoise.fitting.result import FitResult
from hsnoise.statistics.pixels.along_rows import of_the_signal
from hsnoise.statistics.pixels.memory import LEAST_NOISE_DN, Memory, together
from hsnoise.statistics.pixels.oddities import smoothed
from hsnoise.statistics.pixels.survey import Survey

COUPLING = {"crosstalk", "brighter_fatter", "readout_bandwidth", "readout_overshoot"}  # effects that act on the signal
COUPLED, MOST_COUPLED = 0.02, 0.05  # error of the gain by coupled pixels that is reported; that is not trusted
MOST_TOLD = 0.5  # of such errors, as a number


def shared_noise(result: FitResult, found: Survey) -> tuple[list[str], list[str]]:
    """Sentences on what makes numbers wrong, and on what makes them a little wrong; nothing that effects describe."""
    pixel, shared, names = result.transfer, of_the_signal(found.along), set(result.params.names)
    much: list[str] = []
    little: list[str] = []
    if (pixel is None or pixel.ringing is None) and names.isdisjoint({*COUPLING, "correlated_read_noise"}):
        much += smoothed(found)
    spreads = pixel is not None and any(one.bend.spreads for one in pixel.channels)
    if not spreads and names.isdisjoint(COUPLING):
        (much if abs(2 * sum(shared)) > MOST_COUPLED else little).extend(_coupled(shared))
    memory = None if "image_lag" in names else _memory(found)
    if memory is not None:
        (much if 2 * memory.share > MOST_COUPLED else little).append(memory.sentence)
    return much, little


def _coupled(shared: tuple[float, float]) -> Iterator[str]:
    """Shot noise that neighbours share.

    shared: correlation along rows and down columns. What two share is missing in the variance of both.
    """
    (along, down), less = shared, 2 * sum(shared)
    if abs(less) > COUPLED:
        much = f"about {abs(less):.0%}" if abs(less) < MOST_TOLD else f"{MOST_TOLD:.0%} or more"
        above = f", those above each other {down:+.1%}," if down else ""
        yield (
            f"Neighbours along a row share {along:+.1%}{above} of their shot noise: the signal is coupled (hsnoise"
            f" diagnose may name it), and the gain comes out too {'small' if less > 0 else 'large'} by {much}."
        )


def _memory(found: Survey) -> Memory | None:
    """What pixels keep of the frame before, in darks or, if it is more, in flats: image lag is in electrons alone."""
    told = []
    quiet_dn = min((group.noise_dn for group in found.repeated_darks), default=0.0)
    for groups in (found.repeated_darks, found.repeated_flats):
        wide = [group for group in groups if group.noise_dn > LEAST_NOISE_DN]
        each = [(one, group.noise_dn) for group in wide for p in group.planes if (one := p.halves.memory) is not None]
        told.append(together(each, quiet_dn))
    return max((one for one in told if one is not None), key=lambda one: one.share, default=None)
