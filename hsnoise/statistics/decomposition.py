"""The three-dimensional noise decomposition: counts split over frames, rows, columns and their interactions.

Counts of one colour plane are a sum of independent random effects,

    y[f, r, c] = mean + F[f] + R[r] + C[c] + RF[f, r] + CF[f, c] + P[r, c] + e[f, r, c],

whose variances follow without bias from the mean squares of an analysis of variance. The expectation of a mean square
is the variance of its own effect plus those of the finer effects divided by the pixels averaged, which are subtracted.

Reference: D'Agostino and Webb, "Three-dimensional analysis framework and measurement methodology for imaging system
noise", SPIE 1488, 1991; expected mean squares: Searle, Casella, McCulloch, *Variance Components*, 1992.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

COMPONENTS = ("frame", "row", "column", "row_x_frame", "column_x_frame", "pixel", "temporal")
STATIC = ("row", "column", "pixel")
BLOCK_ROWS = 256  # rows converted to float64 at a time


@dataclass(frozen=True)
class Component:
    """Variance of one component and its standard error, DN^2 (NaN: not determined by these frames), and its share.

    chance_dn2: standard deviation of the estimate if the component is absent.
    """

    variance_dn2: float
    standard_error_dn2: float
    share: float = float("nan")
    chance_dn2: float = float("nan")


def mean_of(parts: Sequence[Component]) -> Component:
    """The mean of one component over the planes of a colour; their errors are independent."""
    n = len(parts)
    error, chance = (
        float(np.sqrt(sum(getattr(part, name) ** 2 for part in parts))) / n
        for name in ("standard_error_dn2", "chance_dn2")
    )
    return Component(sum(p.variance_dn2 for p in parts) / n, error, sum(p.share for p in parts) / n, chance)


class PlaneSums:
    """Running sums of one colour plane, from which the decomposition follows; frames are added one by one.

    Memory: one int32 per pixel, for any number of frames.
    """

    def __init__(self, shape: tuple[int, int]):
        self.shape = shape
        self.reference: int | None = None
        self.pixel = np.zeros(shape, np.int32)
        self.rows: list[np.ndarray] = []
        self.columns: list[np.ndarray] = []
        self.squares = 0.0

    def add(self, plane: np.ndarray) -> None:
        """Add one frame [row, column] of whole counts."""
        if self.reference is None:
            self.reference = int(np.median(plane[:: max(1, plane.shape[0] // 64)]))
        rows, columns = np.empty(self.shape[0]), np.zeros(self.shape[1])
        for start in range(0, self.shape[0], BLOCK_ROWS):
            at = slice(start, start + BLOCK_ROWS)
            block = plane[at].astype(np.int32) - np.int32(self.reference)
            self.pixel[at] += block
            values = block.astype(np.float64)
            rows[at] = values.sum(1)
            columns += values.sum(0)
            self.squares += float(np.vdot(values, values))
        self.rows.append(rows)
        self.columns.append(columns)

    def followed_by(self, later: PlaneSums) -> PlaneSums:
        """The sums of these frames and of `later` ones, exactly those of adding all to one."""
        if self.reference is None or later.reference is None:
            return later if self.reference is None else self
        total, (h, w) = PlaneSums(self.shape), self.shape
        shift = later.reference - self.reference
        total.reference = self.reference
        total.pixel = self.pixel + later.pixel + np.int32(shift * later.n_frames)
        total.rows = self.rows + [rows + shift * w for rows in later.rows]
        total.columns = self.columns + [columns + shift * h for columns in later.columns]
        of_later = 2 * shift * sum(float(rows.sum()) for rows in later.rows) + shift**2 * later.n_frames * h * w
        total.squares = self.squares + later.squares + of_later
        return total

    @property
    def n_frames(self) -> int:
        return len(self.rows)

    @property
    def frame_means_dn(self) -> np.ndarray:
        """Mean of each frame [frame], DN."""
        return np.array([r.sum() for r in self.rows]) / (self.shape[0] * self.shape[1]) + self.reference

    def mean_map_dn(self) -> np.ndarray:
        """Mean of each pixel over the frames [row, column], DN, float32."""
        return self.pixel.astype(np.float32) / np.float32(self.n_frames) + np.float32(self.reference)

    def components(self) -> dict[str, Component]:
        """The variances of all components; standard errors assume normal noise."""
        n, (h, w) = self.n_frames, self.shape
        if n < 2 or min(h, w) < 2:
            return dict.fromkeys(COMPONENTS, Component(np.nan, np.nan))
        return _from_mean_squares(_sums_of_squares(self), n, h, w)


def decomposed(counts: np.ndarray) -> dict[str, Component]:
    """The components of one colour plane in memory, whole counts [frame, row, column] of two frames or more."""
    sums = PlaneSums(counts.shape[1:])
    for plane in counts:
        sums.add(plane)
    variance = counts.var(axis=0, ddof=1, dtype=np.float64)
    return with_tails(sums.components(), sums.mean_map_dn().astype(np.float64), variance, sums.shape)


def with_tails(
    found: dict[str, Component], level_dn: np.ndarray, variance_dn2: np.ndarray, shape: tuple[int, int]
) -> dict[str, Component]:
    """Components with shares, and errors taken from the pixels themselves, whose noise differs and has tails.

    Of all rows or some: level_dn [row, column] is the mean of each pixel, variance_dn2 its temporal variance; shape:
    of the whole plane.
    """
    level = level_dn - level_dn.mean(0) - level_dn.mean(1, keepdims=True) + level_dn.mean()
    for name, values in {"temporal": variance_dn2, "pixel": level**2}.items():
        error = float(values.std(dtype=np.float64)) / np.sqrt(shape[0] * shape[1])
        found[name] = replace(found[name], standard_error_dn2=max(error, found[name].standard_error_dn2))
    total = sum(max(found[name].variance_dn2, 0.0) for name in COMPONENTS)
    return {
        name: replace(c, share=max(c.variance_dn2, 0.0) / total if total > 0 else float("nan"))
        for name, c in found.items()
    }


def of_neighbouring_rows(row_mean_dn: np.ndarray, lag: int = 1) -> Component:
    """Covariance of rows `lag` apart in a frame, DN^2, from row means [frame, row]; 0 for white rows."""
    n, h = row_mean_dn.shape
    if n < 2 or h < lag + 2:
        return Component(np.nan, np.nan)
    left = row_mean_dn - row_mean_dn.mean(0)
    left = left - left.mean(1, keepdims=True)
    error = float(left.var()) / np.sqrt((n - 1) * (h - 1))
    product = float((left[:, lag:] * left[:, :-lag]).sum())
    return Component(product / ((n - 1) * (h - lag)), error, chance_dn2=error)


def _sums_of_squares(sums: PlaneSums) -> dict[str, float]:
    """Sum of squares of each effect; together they are that of all counts about their mean."""
    n, (h, w) = sums.n_frames, sums.shape
    row_frame, column_frame = np.stack(sums.rows), np.stack(sums.columns)  # sums over columns; over rows
    whole = row_frame.sum()
    correction = whole**2 / (n * h * w)
    frame = (row_frame.sum(1) ** 2).sum() / (h * w)
    row, column = (row_frame.sum(0) ** 2).sum() / (n * w), (column_frame.sum(0) ** 2).sum() / (n * h)
    of_row_frame, of_column_frame = (row_frame**2).sum() / w, (column_frame**2).sum() / h
    pixel = sum(float((part.astype(np.float64) ** 2).sum()) for part in np.array_split(sums.pixel, h // 64 + 1)) / n
    return {
        "frame": frame - correction,
        "row": row - correction,
        "column": column - correction,
        "row_x_frame": of_row_frame - row - frame + correction,
        "column_x_frame": of_column_frame - column - frame + correction,
        "pixel": pixel - row - column + correction,
        "temporal": sums.squares - of_row_frame - of_column_frame - pixel + frame + row + column - correction,
    }


def _from_mean_squares(squares: dict[str, float], n: int, h: int, w: int) -> dict[str, Component]:
    """Variance components by equating mean squares with their expectations."""
    dof = {
        "frame": n - 1,
        "row": h - 1,
        "column": w - 1,
        "row_x_frame": (n - 1) * (h - 1),
        "column_x_frame": (n - 1) * (w - 1),
        "pixel": (h - 1) * (w - 1),
        "temporal": (n - 1) * (h - 1) * (w - 1),
    }
    mean = {name: squares[name] / dof[name] for name in COMPONENTS}
    # The signed mean squares that isolate an effect's variance, and the counts that one value of the effect spans.
    contrasts: dict[str, tuple[int, dict[str, int]]] = {
        "temporal": (1, {"temporal": 1}),
        "pixel": (n, {"pixel": 1, "temporal": -1}),
        "row_x_frame": (w, {"row_x_frame": 1, "temporal": -1}),
        "column_x_frame": (h, {"column_x_frame": 1, "temporal": -1}),
        "row": (n * w, {"row": 1, "pixel": -1, "row_x_frame": -1, "temporal": 1}),
        "column": (n * h, {"column": 1, "pixel": -1, "column_x_frame": -1, "temporal": 1}),
        "frame": (h * w, {"frame": 1, "row_x_frame": -1, "column_x_frame": -1, "temporal": 1}),
    }
    found = {}
    for name in COMPONENTS:
        span, signs = contrasts[name]
        variance = sum(sign * mean[other] for other, sign in signs.items()) / span
        error = np.sqrt(sum(2 * mean[other] ** 2 / dof[other] for other in signs)) / span
        without = mean[name] - span * variance  # expectation of its mean square if it is absent
        rest = sum(2 * mean[other] ** 2 / dof[other] for other in signs if other != name)
        chance = np.sqrt(2 * without**2 / dof[name] + rest) / span
        found[name] = Component(float(variance), float(error), chance_dn2=float(chance))
    return found
