"""Noise that a pixel shares with its neighbours or with the frame before: its variance measures no electrons then."""

from __future__ import annotations

from collections.abc import Iterator

from hsnoise.fitting.result import FitResult
from hsnoise.statistics.pixels.along_rows import of_the_signal
from hsnoise.statistics.pixels.memory import Memory, together
from hsnoise.statistics.pixels.oddities import smoothed
from hsnoise.statistics.pixels.survey import Survey

COUPLED, MOST_COUPLED = 0.02, 0.05  # error of the gain by coupled pixels that is reported; that is not trusted
LEAST_NOISE_DN = 0.5  # with less, where a level lies between two counts decides which frames agree


def shared_noise(result: FitResult, found: Survey) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Sentences on what makes numbers wrong, and on what makes them a little wrong."""
    pixel = result.transfer
    smooth = () if pixel is not None and pixel.ringing is not None else tuple(smoothed(found))
    spread = pixel is not None and any(one.bend.spreads for one in pixel.channels)
    shared = of_the_signal(found.along)
    coupled = () if spread else tuple(_coupled(shared))
    memory = None if "image_lag" in result.params else _memory(found)
    kept = () if memory is None else (memory.sentence,)
    is_much = [abs(2 * sum(shared)) > MOST_COUPLED, memory is not None and 2 * memory.share > MOST_COUPLED]
    both = list(zip((coupled, kept), is_much, strict=True))
    of_size = [tuple(one for told, much in both if much is size for one in told) for size in (True, False)]
    return (*smooth, *of_size[0]), of_size[1]


def _coupled(shared: tuple[float, float]) -> Iterator[str]:
    """Shot noise that neighbours share.

    shared: correlation along rows and down columns. What two share is missing in the variance of both.
    """
    (along, down), less = shared, 2 * sum(shared)
    if abs(less) > COUPLED:
        above = f", those above each other {down:+.1%}," if down else ""
        yield (
            f"Neighbours along a row share {along:+.1%}{above} of their shot noise: the signal is coupled (hsnoise"
            f" diagnose may name it), and the gain comes out too {'small' if less > 0 else 'large'} by up to"
            f" {abs(less):.0%}."
        )


def _memory(found: Survey) -> Memory | None:
    """What pixels keep of the frame before, in all darks: light may differ from frame to frame."""
    wide = [group for group in found.repeated_darks if group.noise_dn > LEAST_NOISE_DN]
    return together([p.halves.memory for group in wide for p in group.planes if p.halves.memory is not None])
