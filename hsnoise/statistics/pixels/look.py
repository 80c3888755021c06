"""What a survey keeps of the frames of one exposure; what workers of a cluster kept of some of them adds up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hsnoise._core.types import cfa_tile
from hsnoise.statistics.decomposition import PlaneSums
from hsnoise.statistics.pixels.row_groups import row_means
from hsnoise.statistics.pixels.waves import MOST_FRAMES, middle_of_frame


class OddLines(NamedTuple):
    """Numbers of the rows and columns in a group's first frame that are not measurements."""

    constant_rows: np.ndarray
    constant_columns: np.ndarray
    repeated_rows: np.ndarray

    @staticmethod
    def of(frame: np.ndarray, step: int) -> OddLines:
        """Rows and columns with a single count, and rows that repeat the previous row of the same colours."""
        rows, columns = np.ptp(frame, axis=1) == 0, np.ptp(frame, axis=0) == 0
        repeated = np.zeros(len(frame), bool)
        repeated[step:] = (frame[step:] == frame[:-step]).all(1) & ~rows[step:]
        return OddLines(*(np.flatnonzero(x) for x in (rows, columns, repeated)))


class Seen(NamedTuple):
    """Of frames one after the other.

    Attributes:
        sums: of each colour plane.
        kept: the sampled rows of each frame [row, column], DN.
        row_means, middles: of each frame, where looked for.
        odd: lines of the first frame; None before it.
        clipped, saturated: counts at 0 and from the white level on [channel].
        highest: count, DN.
    """

    sums: list[PlaneSums]
    kept: list[np.ndarray]
    row_means: list[np.ndarray]
    middles: list[np.ndarray]
    odd: OddLines | None
    clipped: np.ndarray
    saturated: np.ndarray
    highest: int


@dataclass(frozen=True)
class Look:
    """How the frames of an exposure are looked at: three functions for `FrameStack.fold_frames`."""

    cfa: str
    shape: tuple[int, int]
    rows: np.ndarray
    white_level: float | None
    looks_for_row_groups: bool
    looks_for_waves: bool

    def start(self) -> Seen:
        step, channels = len(cfa_tile(self.cfa)), int(cfa_tile(self.cfa).max()) + 1
        planes = [PlaneSums((self.shape[0] // step, self.shape[1] // step)) for _ in range(step**2)]
        return Seen(planes, [], [], [], None, np.zeros(channels), np.zeros(channels), 0)

    def add(self, seen: Seen, frame: np.ndarray, number: int) -> Seen:
        """`seen` with one more frame [row, column]; its lists and arrays are changed in place."""
        tile = cfa_tile(self.cfa)
        step, white = len(tile), np.inf if self.white_level is None else self.white_level
        seen.kept.append(frame[self.rows])
        seen.row_means.extend([row_means(frame)] if self.looks_for_row_groups else [])
        seen.middles.extend([middle_of_frame(frame)] if self.looks_for_waves and number < MOST_FRAMES else [])
        for p in range(step**2):
            plane, c = frame[p // step :: step, p % step :: step], tile[p // step, p % step]
            seen.sums[p].add(plane)
            seen.clipped[c] += np.count_nonzero(plane == 0)
            seen.saturated[c] += np.count_nonzero(plane >= white)
        odd = OddLines.of(frame, step) if number == 0 else seen.odd
        return seen._replace(odd=odd, highest=max(seen.highest, int(frame.max())))

    @staticmethod
    def merge(seen: Seen, later: Seen) -> Seen:
        """The total of earlier frames and of later ones."""
        return Seen(
            [one.followed_by(other) for one, other in zip(seen.sums, later.sums, strict=True)],
            seen.kept + later.kept,
            seen.row_means + later.row_means,
            seen.middles + later.middles,
            later.odd if seen.odd is None else seen.odd,
            seen.clipped + later.clipped,
            seen.saturated + later.saturated,
            max(seen.highest, later.highest),
        )
