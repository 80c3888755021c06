"""Noise that a pixel shares with its neighbours or with the frame before: its variance measures no electrons then."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hsnoise.fitting.result import FitResult
from hsnoise.statistics.pixels.along_rows import of_the_signal
from hsnoise.statistics.pixels.memory import Memory
from hsnoise.statistics.pixels.oddities import smoothed
from hsnoise.statistics.pixels.survey import Survey

COUPLED, MOST_COUPLED = 0.02, 0.05  # error of the gain by coupled pixels that is reported; that is not trusted
SURE = 5.0  # standard errors of the share that frames have in common
LEAST_NOISE_DN = 0.5  # with less, where a level lies between two counts decides which frames agree


def shared_noise(result: FitResult, found: Survey) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Sentences on what makes numbers wrong, and on what makes them a little wrong."""
    pixel = result.transfer
    smooth = () if pixel is not None and pixel.ringing is not None else tuple(smoothed(found))
    spread = pixel is not None and any(one.bend.spreads for one in pixel.channels)
    shared = of_the_signal(found.along)
    coupled = () if spread else tuple(_coupled(shared))
    memory = None if "image_lag" in result.params else _memory(found)
    kept = () if memory is None else tuple(_remembered(memory))
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
    """What pixels keep of the frame before, of all darks together; None where it is too little to matter.

    Light may differ from frame to frame, so flats say nothing.
    """
    wide = [group for group in found.repeated_darks if group.noise_dn > LEAST_NOISE_DN]
    told = [p.halves.memory for group in wide for p in group.planes if p.halves.memory is not None]
    if not told:
        return None
    weight = np.array([one.error for one in told]) ** -2.0
    share = float(weight @ [one.share for one in told] / weight.sum())
    memory = Memory(share, float(weight.sum() ** -0.5))
    return memory if memory.exceeds(COUPLED / 2, SURE) else None


def _remembered(memory: Memory) -> Iterator[str]:
    yield (
        f"Pixels have {memory.share:.1%} of their noise in common with the frame before: a filter over frames (temporal"
        " noise reduction in the camera), or image lag. Variances come out too small by"
        f" {2 * memory.share:.0%} or more, and so do gain or noise. Switch the filter off."
    )
