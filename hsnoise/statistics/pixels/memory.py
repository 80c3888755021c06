"""What a pixel keeps of the frame before: a filter over frames in the camera, or image lag."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hsnoise._core.robust import robust_sigma

FEWEST_FRAMES = 4
PARTS, MOST_PIXELS = 64, 1 << 18  # of a plane, which tell the error
WIDTH = 4.0  # deviations at which differences are cut: jumping and hit pixels say nothing here
LEAST_NOISE_DN = 0.5  # of a pixel; where a count is wider than the noise, levels decide which frames agree
LEAST, SURE = 0.01, 4.0  # share that matters, and its standard errors


class Memory(NamedTuple):
    """Share of its temporal noise that a pixel has in common with the frame before, and the error.

    of_signal: whether it is a share of the noise of the signal alone, as what a pixel keeps of its charge makes it.
    """

    share: float
    error: float
    of_signal: bool = False

    @property
    def sentence(self) -> str:
        if self.of_signal:
            return (
                f"Pixels have {self.share:.1%} of the noise of their signal in common with the frame before: they keep"
                " some of its charge (image lag; hsnoise diagnose may name it), or a filter over frames is on. The gain"
                f" comes out too small by {2 * self.share:.0%} or more."
            )
        return (
            f"Pixels have {self.share:.1%} of their noise in common with the frame before: a filter over frames"
            " (temporal noise reduction in the camera), or image lag (hsnoise diagnose may name it). Variances come out"
            f" too small by {2 * self.share:.0%} or more, and so do gain or noise. Switch a filter off."
        )


def together(of: Sequence[tuple[Memory, float]], quiet_dn: float) -> Memory | None:
    """Of all planes and exposures; None where it may be chance, or is too little to matter.

    It is a share of all noise, or of what is beyond that without signal: whichever is surer.

    of: what each tells, and its temporal noise, DN; quiet_dn: that without signal, as far as it is known.
    """
    if not of:
        return None
    told, noise_dn = zip(*of, strict=True)
    beyond = np.clip(1 - (quiet_dn / np.maximum(noise_dn, 1e-6)) ** 2, 0.0, 1.0)
    of_all, of_signal = _mean(told, np.ones(len(told))), _mean(told, beyond)
    surest = of_signal._replace(of_signal=True) if _is_surer(of_signal, of_all) else of_all
    return surest if surest.share > max(LEAST, SURE * surest.error) else None


def _mean(told: Sequence[Memory], part: np.ndarray) -> Memory:
    """The share of a part of the noise [one of told]."""
    weight = np.array([max(one.error, 1e-6) for one in told]) ** -2.0
    known = max(float(weight @ part**2), 1e-12)
    return Memory(float(weight * part @ [one.share for one in told]) / known, known**-0.5)


def _is_surer(one: Memory, other: Memory) -> bool:
    return one.share / one.error > other.share / other.error


def memory_of_region(counts: np.ndarray) -> Memory | None:
    """Of counts [frame, row, column], of which some rows suffice."""
    rows = counts[:, : max(MOST_PIXELS // counts.shape[2], 1)].astype(np.float32)
    rows -= rows.mean(0)
    rows -= np.median(rows, axis=2, keepdims=True)
    rows -= np.median(rows, axis=1, keepdims=True)
    return memory_of(rows.reshape(len(rows), -1))


def memory_of(values: np.ndarray) -> Memory | None:
    """Of values [frame, pixel] without what frames, rows and columns share; None of too few frames or still pixels.

    By D(k), the mean square difference of frames k apart: (2 D(2) - D(1) - D(3)) / D(3). What decays from frame to
    frame makes it positive; levels that wander leave it at 0, and levels that drift make it negative.
    """
    if len(values) < FEWEST_FRAMES or values.shape[1] < PARTS:
        return None
    thin = values[:, :: max(1, values.shape[1] // MOST_PIXELS)]
    width = WIDTH * robust_sigma(thin[1] - thin[0])
    if width <= 0:
        return None
    square = [_mean_square(thin, apart, width) for apart in (1, 2, 3)]
    shares = (2 * square[1] - square[0] - square[2]) / square[2].mean()
    return Memory(float(shares.mean()), float(shares.std(ddof=1) / np.sqrt(PARTS)))


def _mean_square(values: np.ndarray, apart: int, width: float) -> np.ndarray:
    """Of the differences of frames that are so far apart [part of the pixels]."""
    square = np.zeros(values.shape[1])
    for one, later in zip(values, values[apart:], strict=False):
        square += np.clip(later - one, -width, width) ** 2
    parts = np.array_split(square, PARTS)
    return np.array([float(part.mean()) for part in parts]) / (len(values) - apart)
