"""What is known about a capture when effects are proposed for it; it sets amplitudes and details."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hsnoise.effects._base import AbstractEffect

Maker = Callable[[float, np.random.Generator], "AbstractEffect"]

NO_LIMITS = (-np.inf, np.inf), (-np.inf, np.inf)
LEAST_SHARED = 0.01  # of shot noise, with a neighbour: less changes gains by less than 2 %
LEAST_ELECTRONS = 0.2  # of a signal, below which nothing that acts on it shows


@dataclass(frozen=True)
class Places:
    """The patterns of place and time that fit the dark frames best, whether or not they are present.

    shading: axis, start, above and length of a `BlackShading`. glow: row and column of an `AmplifierGlow`.
    second_chain: 1 if the second chain of an `OddEvenPattern` reads more, else -1. settling: 1 if the first frames of
    a `FrameSettling` read more, else -1.
    """

    shading: tuple[str, str, bool, float]
    glow: tuple[float, float]
    second_chain: int
    settling: int


@dataclass(frozen=True)
class CaptureFacts:
    """What a capture and the model fitted to it say about effects that may be missing.

    Attributes:
        effects: names of those in the model.
        cfa: "mono" or a 2x2 Bayer string; shutter: "rolling" or "global".
        read_noise_e: its rms, e-.
        dark_e_per_s: mean dark current, e-/s.
        gain: DN/e- [channel].
        frames: most frames of a dark exposure.
        longest_s: longest dark exposure, s; at least 1e-9, so that it divides.
        has_exposure: whether that is more than 0.
        has_bias: whether an exposure is short enough to show what happens while a frame waits to be read.
        exposures_differ: whether the darks have more than one exposure.
        levels: numbers of signal levels: exposures of the darks, and flats.
        light_e: mean photoelectrons of a pixel in the brightest flat; 0 without flats.
        line: axis ("row" or "column") and frequency, cycles/pixel, of the strongest line that moves between frames.
        waves: of those that cross the darks obliquely, the strongest first: amplitude over that of the first, cycles
            per row, cycles per column.
        may_be_outputs: whether panels describe what is static over the frame and not in the model, as far as it shows.
        places: where static patterns lie, and signs.
        code_step: distance of the codes, DN; None if all occur.
        comb: rms of the errors of the codes' widths, DN, and the errors of a period; None if none is certain.
        row_groups: rows, start, row_banks and column_banks of a `RowGroupNoise`; None if no rows are read together.
        pixels_followed: whether the fit follows each pixel over time, and has looked for what shows there.
        coupled: least and most correlation of shot noise with that of neighbours along rows, and down columns, that the
            fit allows.
    """

    effects: tuple[str, ...]
    cfa: str
    shutter: str
    read_noise_e: float
    dark_e_per_s: float
    gain: np.ndarray
    frames: int
    longest_s: float
    has_exposure: bool
    has_bias: bool
    exposures_differ: bool
    levels: int
    light_e: float
    line: tuple[str, float]
    waves: tuple[tuple[float, float, float], ...]
    may_be_outputs: bool
    places: Places
    code_step: float | None
    comb: tuple[float, tuple[float, ...]] | None
    row_groups: tuple[int, int, int, int] | None
    pixels_followed: bool = False
    coupled: tuple[tuple[float, float], tuple[float, float]] = NO_LIMITS

    @property
    def dark_e(self) -> float:
        """Mean dark electrons of a pixel in the longest exposure."""
        return self.dark_e_per_s * self.longest_s

    @property
    def signal_e(self) -> float:
        """Mean electrons of a pixel, from light or dark current, in the exposure with the most."""
        return max(self.dark_e, self.light_e)

    def may_share(self, sign: int, axis: int = 0) -> bool:
        """Whether neighbours along rows (axis 0) or down columns (1) may share LEAST_SHARED or more, of this sign."""
        low, high = self.coupled[axis]
        return (high if sign > 0 else -low) > LEAST_SHARED

    @property
    def shows_dark_current(self) -> bool:
        """Whether there are enough dark electrons for effects on them to show."""
        return self.dark_e > LEAST_ELECTRONS

    @property
    def shows_signal(self) -> bool:
        """Whether there are enough electrons for effects on them to show."""
        return self.signal_e > LEAST_ELECTRONS


def either_side(rng: np.random.Generator) -> bool:
    """Whether an offset arises after the gain: an unknown detail, drawn at random."""
    return bool(rng.integers(2))
