"""Rows that are read together: a row resembles those of its group, and tells nothing of the next group."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hsnoise.frames.stack import FrameStack
from hsnoise.statistics.pixels.banding import Banding, banding_of

FEWEST_FRAMES, FEWEST_ROWS = 2, 32
LARGEST, FEWEST_GROUPS = 64, 4  # rows of a group; groups in the frame
THERE = 8.0  # standard errors by which rows resemble each other more inside groups than across their edges
EDGE = 0.5  # of the covariance inside, which is left across the edges: of what other effects add
SURE = 3.0  # standard errors of the variance
APART = 0.9  # of the covariance of one bank, below which another row or column is of another bank


class RowGroups(NamedTuple):
    """Groups of rows as `RowGroupNoise` has them; variance_dn2, shared: with their standard errors."""

    rows: int
    start: int
    row_banks: int
    column_banks: int
    variance_dn2: tuple[float, float]
    shared: tuple[float, float]

    @property
    def layout(self) -> tuple[int, int, int, int]:
        """Rows of a group, start, banks of rows and of columns."""
        return self[:4]

    def of_rows_dn2(self, apart: int = 0, *, mono: bool) -> float:
        """Covariance of the means of rows so far `apart`, DN^2; rows of one colour have one bank of columns."""
        same, other = self.variance_dn2[0], self.variance_dn2[0] * self.shared[0]
        own = same if apart % self.row_banks == 0 else other
        mean = (own + other) / 2 if mono and self.column_banks == 2 else own
        return mean * max(1 - apart / self.rows, 0.0)

    def of_frames_dn2(self, rows: int, *, mono: bool) -> float:
        """Variance that so few groups leave in the mean of a frame of `rows` rows, beyond that of independent rows."""
        apart = range(1, self.rows) if mono else range(2, self.rows, 2)
        return 2 * sum(self.of_rows_dn2(d, mono=mono) for d in apart) / (rows if mono else rows / 2)

    def of_pixels_dn2(self, *, mono: bool) -> tuple[float, float]:
        """Variance of the pixels of one colour about the means of their rows, DN^2, and its standard error."""
        (variance, error), (_, error_of_share) = self.variance_dn2, self.shared
        value = variance - self.of_rows_dn2(mono=mono)
        return value, float(np.hypot(value / variance * error, variance * error_of_share / 2)) if value > 0 else 0.0


def row_means(frame: np.ndarray) -> np.ndarray:
    """Means [row, 2] of the even and of the odd columns of a frame."""
    return np.stack([frame[:, column::2].mean(1, dtype=np.float64) for column in (0, 1)], 1)


def shortest_repeated(stack: FrameStack) -> int | None:
    """Number of the shortest dark exposure of several frames; None without one."""
    repeated = [i for i, kind in enumerate(stack.kind) if kind == "dark" and stack.n_frames[i] >= FEWEST_FRAMES]
    return min(repeated, key=lambda i: stack.exposure_s[i], default=None)


def row_groups_in(stack: FrameStack) -> tuple[int, int, int, int] | None:
    """The layout of the groups of rows in the shortest repeated darks of a stack; None without any."""
    shortest = shortest_repeated(stack)
    if shortest is None:
        return None
    means = np.stack([row_means(frame) for frame in stack.frames(shortest)])
    wave = banding_of(means.mean(2)) if stack.cfa == "mono" else None
    found = row_groups_of(means, 0 if stack.window is None else stack.window[0], wave)
    return None if found is None else found.layout


def row_groups_of(means_dn: np.ndarray, first_row: int = 0, wave: Banding | None = None) -> RowGroups | None:
    """The groups in row means [frame, row, 2] of even and odd columns; None if no division of the rows stands out.

    first_row: number of the first row on the sensor. wave: a sinusoid over the rows, which is in their covariance, too.
    """
    frames, rows, _ = means_dn.shape
    if frames < FEWEST_FRAMES or rows < FEWEST_ROWS:
        return None
    left = (means_dn - means_dn.mean(0)) * np.sqrt(frames / (frames - 1))
    left -= left.mean(1, keepdims=True)
    found = [(*_division(np.mean(left[:, :-lag] * left[:, lag:], (0, 2)), lag), lag) for lag in (1, 2)]
    score, size, start, lag = max(found)
    if score < THERE or _goes_on(left, size):
        return None
    other_columns = left[..., ::-1]
    same, other_column = (_inside(left, other, lag, size, start, wave) for other in (left, other_columns))
    if np.mean(same) < SURE * _error(same):
        return None
    # Groups in which the next row but one is the most alike have at least two rows of each bank.
    other_row, both = (_inside(left, other, 1, size, start, wave) for other in (left, other_columns))
    row_banks = 2 if lag == 2 and np.mean(other_row) < APART * np.mean(same) else 1
    column_banks = 2 if np.mean(other_column) < APART * np.mean(same) else 1
    parts = [part for part, apart in ((other_row, row_banks), (other_column, column_banks)) if apart == 2]
    parts += [both] if row_banks == column_banks == 2 else []
    ratios = np.mean(parts, 0) / np.mean(same) if parts else np.ones(frames)
    shared = float(np.clip(ratios.mean(), 0.0, 1.0)), _error(ratios) if parts else np.inf
    # Few frames do not tell how much they differ: at least as normal offsets of so many groups and banks.
    banks = row_banks * column_banks
    independent = rows / size * (frames - 1) * banks / (1 + (banks - 1) * shared[0] ** 2)
    variance = float(np.mean(same)), max(_error(same), float(np.mean(same)) * np.sqrt(2 / independent))
    return RowGroups(size, (start + first_row) % size, row_banks, column_banks, variance, shared)


def _goes_on(left: np.ndarray, size: int) -> bool:
    """Whether rows resemble, or oppose, those of the next group or the next but one: a wave, not groups."""
    power = np.mean(left[:, :-1] * left[:, 1:]), np.mean(left[:, :-2] * left[:, 2:])
    beyond = [np.mean(left[:, :-apart] * left[:, apart:]) for apart in (size, 2 * size)]
    return float(np.max(np.abs(beyond))) > EDGE * float(np.max(power))


def _error(of_frames: np.ndarray) -> float:
    return float(of_frames.std(ddof=1) / np.sqrt(len(of_frames)))


def _division(products: np.ndarray, lag: int) -> tuple[float, int, int]:
    """Score, rows of a group and start of the best division, from products of rows `lag` apart [row]."""
    best = (0.0, 0, 0)
    for size in range(lag + 1, min(LARGEST, len(products) // FEWEST_GROUPS) + 1):
        phase = np.arange(len(products)) % size
        n, total = np.bincount(phase, minlength=size), np.bincount(phase, products, size)
        scatter = float(np.mean((products - (total / n)[phase]) ** 2))
        # Edges lie between the `lag` rows before a start and those after it.
        at_edge, sum_at_edge = (sum(np.roll(of, step) for step in range(1, lag + 1)) for of in (n, total))
        inside, edge = (total.sum() - sum_at_edge) / (n.sum() - at_edge), sum_at_edge / at_edge
        score = (inside - edge) / np.sqrt(max(scatter, 1e-300) * (1 / at_edge + 1 / (n.sum() - at_edge)))
        score[edge > EDGE * inside] = 0.0
        start = int(score.argmax())
        best = max(best, (float(score[start]), size, start))
    return best


def _inside(one: np.ndarray, other: np.ndarray, lag: int, size: int, start: int, wave: Banding | None) -> np.ndarray:
    """Mean product by frame of rows `lag` apart in one group [frame], less what other effects add to it.

    That is what rows as far apart in neighbouring groups have, or a sinusoid, which may stand still inside a group.
    """
    products = np.mean(one[:, :-lag] * other[:, lag:], 2)
    row = np.arange(products.shape[1]) - start
    together = row // size == (row + lag) // size
    added = products[:, ~together].mean(1) if wave is None else wave.of_rows_dn2(lag)
    return products[:, together].mean(1) - added
