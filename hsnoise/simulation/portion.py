"""The one cut of a capture: the part that is held in memory and drawn again and again."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from hsnoise._core.types import cfa_tile
from hsnoise.frames.arguments import check_no_copies
from hsnoise.frames.joining import replaced
from hsnoise.frames.stack import FrameStack
from hsnoise.simulation.defects import without_defects
from hsnoise.statistics.structure import check_size

MOST_PIXELS = 2_000_000  # beyond, statistics become sharper than any model, and draws slower
MOST_LEVELS = 10  # of darks, and of flats: draws of many exposures take longer, and show no more
LEAST_FRAMES, LEAST_COLUMNS = 8, 64
WHOLE_COLUMNS = 16  # their number is a multiple: Fourier transforms of large primes take twice as long
MIDDLE = (8, 320, 512)  # frames, rows and columns that are looked at
MOST_SATURATED = 0.2  # share of a flat's pixels
LINEAR = 0.7  # of saturation: the range in which EMVA 1288 takes photon transfer for a line
FALLEN = 0.9  # of the largest temporal variance: less is a sensor that saturates
RARE = 0.01  # share of a frame that rays may hit
BOTH = ("dark", "flat")


@dataclass(frozen=True, eq=False)
class Portion:
    """Frames of a capture, checked, cut and loaded once.

    Attributes:
        frames: the exposures that are used, in memory, with their place on the sensor.
        left_out: sentences on what is not in it.
        before: for each exposure, how many frames were taken before the first one here; empty: none.
        chosen: which exposures of the capture these are.
    """

    frames: FrameStack
    left_out: tuple[str, ...]
    before: tuple[int, ...] = ()
    chosen: tuple[int, ...] = ()

    @staticmethod
    def of(stack: FrameStack, kinds: tuple[str, ...] = BOTH, before: tuple[int, ...] = ()) -> Portion:
        """The exposures of some kinds, cut to MOST_PIXELS.

        Exposures beyond MOST_LEVELS of a kind are left out first, then frames, then columns: a coloured row gain runs
        over all rows. Raises ValueError without darks, for frames that are copies, and for frames too small to separate
        rows from pixels.
        """
        check_size(stack)
        if "dark" not in stack.kind:
            raise ValueError("stack: expected dark frames, got flats only")
        # In a single flat, nothing tells noise from what is in the light.
        single = [i for i, kind in enumerate(stack.kind) if kind == "flat" and stack.n_frames[i] == 1]
        wanted = [i for i, kind in enumerate(stack.kind) if kind in kinds and i not in single]
        cut = _Cut.of(stack, wanted)
        bright, full = _beyond(cut.part(stack, wanted), wanted)
        usable = [i for i in wanted if i not in (*bright, *full)]
        chosen = _spread(stack, usable)
        cut = cut if chosen == usable else _Cut.of(stack, chosen)
        part = cut.part(stack, chosen)
        counts = [np.stack(list(part.frames(i))) for i in range(part.n_exposures)]
        check_no_copies(((hashlib.blake2b(frame).digest() for frame in of) for of in counts), part.exposure_s)
        counts, left_out = without_defects(counts, part.kind, len(cfa_tile(part.cfa)))
        if single and "flat" in kinds:
            flats = f"{len(single)} flats of a single frame"
            left_out.append(f"{flats} were not compared: one frame cannot separate noise from light")
        if bright:
            which = f"{len(bright)} level{'s' * (len(bright) > 1)} of flats not compared"
            left_out.append(f"{which}: too many of their pixels are saturated")
        if full:
            which = f"{len(full)} level{'s' * (len(full) > 1)} of flats not compared: above {100 * LINEAR:.0f} % of"
            left_out.append(f"{which} saturation, which is where the temporal variance is largest (EMVA 1288)")
        if chosen != usable:
            left_out.append(f"{len(chosen)} of {len(usable)} exposures were compared, from the shortest to the longest")
        rows, columns = stack.shape
        is_cut = cut.end - cut.first < columns
        if is_cut:
            left_out.append(f"only columns {cut.first} to {cut.end - 1} of {columns} were compared: large capture")
        if any(stack.n_frames[i] > cut.frames for i in chosen):
            left_out.append(f"only the first {cut.frames} frames of each exposure were compared: large capture")
        # What depends on the place stays where it is on the sensor.
        window = part.window or ((0, cut.first, rows, columns) if is_cut else None)
        ahead = tuple(before[i] for i in chosen if before)
        return Portion(part.with_counts(counts, window), tuple(left_out), ahead, tuple(chosen))

    @cached_property
    def darks(self) -> Portion:
        """Its dark exposures."""
        dark = [i for i, kind in enumerate(self.frames.kind) if kind == "dark"]
        if len(dark) == self.frames.n_exposures:
            return self
        before, chosen = (tuple(of[i] for i in dark if of) for of in (self.before, self.chosen))
        return Portion(self.frames.select(exposures=dark), self.left_out, before, chosen)

    def without_flats(self, why: str) -> Portion:
        """Its dark exposures, where flats cannot be compared."""
        darks = self.darks
        return darks if darks is self else replace(darks, left_out=(*self.left_out, f"flats were not compared: {why}"))


class _Cut(NamedTuple):
    """How many frames of each exposure, and which columns."""

    frames: int
    first: int
    end: int

    @staticmethod
    def of(stack: FrameStack, exposures: Sequence[int]) -> _Cut:
        """With MOST_PIXELS in these exposures, if that is possible."""
        rows, columns = stack.shape
        per_exposure = max(LEAST_FRAMES, MOST_PIXELS // (len(exposures) * rows * columns))
        frames = sum(min(stack.n_frames[i], per_exposure) for i in exposures)
        kept = max(LEAST_COLUMNS, MOST_PIXELS // (frames * rows))
        if kept >= columns:
            return _Cut(per_exposure, 0, columns)
        kept = kept // WHOLE_COLUMNS * WHOLE_COLUMNS
        first = (columns - kept) // 4 * 2
        return _Cut(per_exposure, first, first + kept)

    def part(self, stack: FrameStack, exposures: Sequence[int]) -> FrameStack:
        """That of these exposures, nothing read."""
        return stack.select(frames=slice(0, self.frames), exposures=exposures, columns=(self.first, self.end))


def _beyond(part: FrameStack, of: Sequence[int]) -> tuple[list[int], list[int]]:
    """The flats of a part that are saturated, and those beyond the linear range, by their numbers in `of`."""
    bright = [i for i in range(part.n_exposures) if is_saturated(part, i)]
    lit = [i for i, kind in enumerate(part.kind) if kind == "flat"]
    full = [i for i in _beyond_the_range(part, lit) if i not in bright]
    return [of[i] for i in bright], [of[i] for i in full]


def _spread(stack: FrameStack, exposures: Sequence[int]) -> list[int]:
    """At most MOST_LEVELS of a kind, in order, with the shortest and the longest.

    Of exposures that could stand for one another, the one of most frames.
    """
    chosen: list[int] = []
    for kind in BOTH:
        some = sorted((i for i in exposures if stack.kind[i] == kind), key=lambda i: stack.exposure_s[i])
        if len(some) > MOST_LEVELS:
            between = [group.tolist() for group in np.array_split(some[1:-1], MOST_LEVELS - 2)]
            some = [max(group, key=lambda i: stack.n_frames[i]) for group in (some[:1], *between, some[-1:])]
        chosen += some
    return sorted(chosen)


def usable_flats(stack: FrameStack) -> list[int]:
    """Flats of two frames or more that are neither saturated nor beyond the linear range; there must be darks."""
    repeated = [i for i, kind in enumerate(stack.kind) if kind == "flat" and stack.n_frames[i] > 1]
    full = _beyond_the_range(stack, repeated)
    return [i for i in repeated if i not in full and not is_saturated(stack, i)]


def is_saturated(stack: FrameStack, exposure: int) -> bool:
    """Whether so many pixels of a flat's first frame are at the white level that it shows little else."""
    if stack.kind[exposure] != "flat" or stack.white_level is None:
        return False
    return float(np.mean(np.asarray(stack.counts[exposure][0]) >= stack.white_level)) > MOST_SATURATED


def _beyond_the_range(stack: FrameStack, flats: list[int]) -> list[int]:
    """Flats, of two frames or more, above 70 % of saturation: the signal of the largest temporal variance (EMVA 1288).

    If brighter ones show by a clearly smaller variance that it is: charge spills over there, or the output bends, and
    no linear model describes it. Of each level the first two frames count.
    """
    if not flats:
        return []
    darkest = min((i for i, kind in enumerate(stack.kind) if kind == "dark"), key=lambda i: stack.exposure_s[i])
    pairs = [np.asarray(stack.counts[i][:2], np.float32) for i in flats]
    variance = np.array([_temporal_variance(pair) for pair in pairs])
    signal = np.array([pair.mean() for pair in pairs]) - np.mean(stack.counts[darkest][0])
    fullest = variance.argmax()
    if not (variance[signal > signal[fullest]] < FALLEN * variance[fullest]).any():
        return []
    return [i for i, level in zip(flats, signal, strict=True) if level > LINEAR * signal[fullest]]


def _temporal_variance(pair: np.ndarray) -> float:
    """Of pixels beside the next one of their colour: without rows and lamps that flicker, and without rays."""
    apart = np.diff(pair, axis=0)[0]
    squares = (apart[:, 2:] - apart[:, :-2]) ** 2
    return float(np.minimum(squares, np.quantile(squares, 1 - RARE)).mean() / 4)


def middle_of(stack: FrameStack, kinds: tuple[str, ...] = BOTH) -> FrameStack:
    """The middle of a few frames of each exposure, nothing read: enough for a look at how pixels differ.

    Raises ValueError where there is no exposure of these kinds.
    """
    chosen = [i for i, kind in enumerate(stack.kind) if kind in kinds]
    if not chosen:
        raise ValueError(f"stack: expected {' or '.join(kinds)} frames, and there are none")
    frames, rows, columns = MIDDLE
    # What depends on the place stays where it is on the sensor.
    whole = replaced(stack, window=stack.window or (0, 0, *stack.shape))
    spans = [_middle(size, most) for size, most in zip(stack.shape, (rows, columns), strict=True)]
    return whole.select(frames=slice(0, frames), exposures=chosen, rows=spans[0], columns=spans[1])


def _middle(size: int, most: int) -> slice:
    """At most `most` of a side, even at both ends."""
    first = max((size - most) // 4 * 2, 0)
    return slice(first, min(first + most, size))
