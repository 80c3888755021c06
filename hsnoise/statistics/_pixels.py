"""Statistics of single pixels of one exposure: levels, lags, tails, pixels over time, codes, blocks."""

from __future__ import annotations

import numpy as np

from hsnoise.statistics._anova import BOUND, Exposure
from hsnoise.statistics._lines import cosines
from hsnoise.statistics._sheet import ABS_VARIANCE, TINY_DN2, Sheet, correlation, fisher, log_ratio

LAGS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0), (2, 2), (2, -2), (0, 4), (4, 0))
STATIC_LAGS = ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0))
TAILS = (4.5, 7.0, 15.0, -4.0, -6.0)
QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99, 0.999)
GRID = 8
FEWEST_PER_CODE = 8.0
FOURTH_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])


def levels(sheet: Sheet, x: Exposure, white_level: float | None) -> None:
    """Mean above black, variance, and the histogram of counts: skewness, roughness, ends."""
    planes, frames, rows, columns = x.shape
    n = frames * rows * columns
    sheet.add_colours("level", "mean above black, DN", x.mean, float(np.sqrt(x.variance.mean() / n)))
    sheet.add_colours("noise", "log variance", np.log(x.variance + TINY_DN2), np.sqrt(2 / n))
    robust = np.log(np.square(x.scale).mean((1, 2), dtype=np.float64) + TINY_DN2)
    sheet.add_colours("noise", "log variance without outliers", robust, np.sqrt(2 / n))
    if planes == 4:
        greens = [i for i, letter in enumerate(sheet.letters) if letter == "G"]
        step = (x.mean[greens[0]] - x.mean[greens[1]]) / np.sqrt(x.variance.mean() + TINY_DN2)
        sheet.add("level", "one green over the other", step, np.sqrt(2 / n))
    histograms = [_histogram_shape(low, counts) for low, counts in x.codes]
    skewness, roughness = (np.array(values) for values in zip(*histograms, strict=True))
    sheet.add_colours("level", "skewness of the quantiles", skewness, 2 / np.sqrt(n))
    sheet.add("codes", "roughness of the histogram", roughness, 0.1 / np.sqrt(planes))
    ends = [_share_at_ends(low, counts, white_level) for low, counts in x.codes]
    sheet.add("codes", "share at zero", [first for first, _ in ends], 0.5 / np.sqrt(n * planes))
    sheet.add("codes", "share at the white level", [last for _, last in ends], 0.5 / np.sqrt(n * planes))


def _histogram_shape(low: int, counts: np.ndarray) -> tuple[float, float]:
    """(skewness from quantiles, log roughness) of a histogram of counts."""
    cumulative = np.cumsum(counts) / counts.sum()
    below = np.concatenate([[0.0], cumulative])
    q05, q50, q95 = np.interp((0.05, 0.5, 0.95), below, np.arange(len(below)))
    skewness = (q95 + q05 - 2 * q50) / max(q95 - q05, 1e-6)
    # The codes between the outer quantiles; code 0 also holds all clipped counts.
    first, last = max(int(q05), 1 - low), int(q95) + 1
    some = counts[first:last].astype(np.float64)
    if len(some) < len(FOURTH_DIFFERENCE) or some.mean() < FEWEST_PER_CODE:
        return float(skewness), 0.0
    # Square roots have the same variance for any expected number; fourth differences ignore a smooth distribution.
    rough = np.convolve(2 * np.sqrt(some + 0.375), FOURTH_DIFFERENCE, "valid")
    return float(skewness), float(np.log(1 + np.mean(rough**2) / (FOURTH_DIFFERENCE**2).sum()))


def _share_at_ends(low: int, counts: np.ndarray, white_level: float | None) -> tuple[float, float]:
    """arcsin of the square root of the shares of counts at zero and at the white level."""
    n = counts.sum()
    zero = counts[0] if low == 0 else 0
    white = 0 if white_level is None else counts[max(int(white_level) - low, 0) :].sum()
    return float(np.arcsin(np.sqrt(zero / n))), float(np.arcsin(np.sqrt(white / n)))


def lags(sheet: Sheet, x: Exposure) -> None:
    """Correlation of the bounded residual with its neighbours on the sensor (of any colour) and in time."""
    planes, frames, rows, columns = x.shape
    n = max(frames - 1, 1) * rows * columns * planes
    power = float(np.einsum("pfrc,pfrc->pfr", x.bounded, x.bounded).mean(dtype=np.float64)) / columns
    for lag in LAGS:
        value = fisher(_lag_product(x.bounded, lag) / max(power, 1e-12) + _sum_to_zero(x, lag))
        sheet.add("spatial lags", f"residual, {lag[0]} rows {lag[1]} columns away", value, 1 / np.sqrt(n))
    if frames > 2:
        later = np.einsum("pfrc,pfrc->pfr", x.bounded[:, 1:], x.bounded[:, :-1]).mean(dtype=np.float64) / columns
        value = fisher(later / max(power, 1e-12) + 1 / (frames - 1))
        sheet.add("pixels over time", "residual, next frame", value, 1 / np.sqrt(n))
    if frames == 1:
        return
    static = static_map(x)[:, None]
    power = max(float(np.square(static, dtype=np.float64).mean()), 1e-12)
    error = 1 / np.sqrt(planes * rows * columns)
    for lag in STATIC_LAGS:
        value = fisher(_lag_product(static, lag) / power + _sum_to_zero(x, lag))
        sheet.add("static pixels", f"map, {lag[0]} rows {lag[1]} columns away", value, error, of_map=True)


def _sum_to_zero(x: Exposure, lag: tuple[int, int]) -> float:
    """Minus the correlation, at a lag along a row or column of one colour, of white noise whose sum is zero."""
    step = 1 if x.shape[0] == 1 else 2
    if lag[0] % step or lag[1] % step or all(lag):
        return 0.0
    return 1 / (x.shape[2] - 1 if lag[0] else x.shape[3] - 1)


def _lag_product(x: np.ndarray, lag: tuple[int, int]) -> float:
    """Mean product of pixels `lag` (rows, columns of the sensor) apart, from planes x [plane, frame, row, column]."""
    step = 1 if len(x) == 1 else 2
    total, n = 0.0, 0
    for p in range(len(x)):
        r, c = p // step + lag[0], p % step + lag[1]
        other = r % step * step + c % step
        rows, columns = r // step, c // step
        a = x[p][:, : x.shape[2] - rows, max(-columns, 0) : x.shape[3] - max(columns, 0)]
        b = x[other][:, rows:, max(columns, 0) : x.shape[3] + min(columns, 0)]
        total += float(np.einsum("frc,frc->fr", a, b).sum(dtype=np.float64))
        n += a.size
    return total / n


def static_map(x: Exposure) -> np.ndarray:
    """The static map [plane, row, column] in units of its own robust spread, bounded."""
    spread = np.abs(x.pixel).mean((1, 2), keepdims=True) * np.float32(np.sqrt(np.pi / 2)) + np.float32(1e-6)
    return np.clip(x.pixel / spread, -BOUND, BOUND)


def tails(sheet: Sheet, x: Exposure) -> None:
    """Shape of the residual, and the numbers of outlying pixels of the static map."""
    n = max(x.shape[1] - 1, 1) * x.shape[2] * x.shape[3]
    square = x.bounded * x.bounded
    second = square.mean((2, 3)).mean(1, dtype=np.float64)
    third = np.einsum("pfrc,pfrc->pfr", square, x.bounded).mean((1, 2), dtype=np.float64) / x.shape[3]
    fourth = np.einsum("pfrc,pfrc->pfr", square, square).mean((1, 2), dtype=np.float64) / x.shape[3]
    second = np.maximum(second, 1e-6)
    sheet.add_colours("tails", "skewness", third / second**1.5, np.sqrt(6 / n))
    sheet.add_colours("tails", "log kurtosis", np.log((fourth / second**2 + 0.01) / 3), np.sqrt(24 / n) / 3)
    # Few values lie far out: count only among those.
    far = x.residual[np.abs(x.bounded) >= min(map(abs, TAILS))]
    _count_tails(sheet, "tails", "residuals", far)
    if x.shape[1] > 1:
        spread = np.abs(x.pixel).mean((1, 2), keepdims=True) * np.float32(np.sqrt(np.pi / 2)) + np.float32(1e-6)
        static = x.pixel / spread
        _count_tails(sheet, "static pixels", "pixels of the map", static, of_map=True)
        bounded = np.clip(static, -BOUND, BOUND)
        square = bounded * bounded
        kurtosis = (square * square).mean((1, 2)) / np.maximum(square.mean((1, 2)) ** 2, 1e-6)
        error = np.sqrt(24 / x.pixel.size) / 3
        sheet.add("static pixels", "log kurtosis of the map", np.log((kurtosis + 0.01) / 3), error, of_map=True)


def _count_tails(sheet: Sheet, group: str, what: str, values: np.ndarray, *, of_map: bool = False) -> None:
    for limit in TAILS:
        number = np.count_nonzero(values > limit) if limit > 0 else np.count_nonzero(values < limit)
        sheet.add_count(group, f"{what} {'above' if limit > 0 else 'below'} {limit:g} sigma", number, of_map=of_map)


def log_temporal_variance(residual: np.ndarray) -> np.ndarray:
    """Log variance over time [plane, row, column] of a residual [plane, frame, row, column], relative to its row's."""
    return np.log(np.einsum("pfrc,pfrc->prc", residual, residual) / np.float32(residual.shape[1] - 1) + 1e-3)


def variance_over_time(sheet: Sheet, x: Exposure, log_variance: np.ndarray) -> None:
    """Quantiles of the pixels' variances, and whether pixels of large mean vary more (hot pixels do)."""
    n = log_variance[0].size
    flat = log_variance.reshape(len(log_variance), n)
    level = np.log(np.exp(flat).mean(1))
    for q, values in zip(QUANTILES, np.quantile(flat, QUANTILES, axis=1), strict=True):
        error = 1 / np.sqrt(n * len(flat) * min(q, 1 - q))
        sheet.add("pixels over time", f"quantile {q:g} of log variance", values - level, error)
    centred = flat - flat.mean(1, keepdims=True)
    value = correlation(static_map(x).reshape(flat.shape), centred, (1,))
    sheet.add("pixels over time", "correlation of mean and log variance", value, 1 / np.sqrt(n * len(flat)))


def frames_over_time(sheet: Sheet, x: Exposure) -> None:
    """Means and noise of whole frames: flicker, drift, jitter. The unit of means is their error from pixel noise."""
    planes, frames, rows, columns = x.shape
    if frames == 1:
        return
    group, unit = "frames over time", np.sqrt((x.variance + TINY_DN2) / (rows * columns))[:, None]
    means = x.frame / unit
    error = np.sqrt(2 / (planes * (frames - 1)))
    sheet.add(group, "frame mean / pixel", log_ratio((means**2).sum(1) / (frames - 1), 1.0), error)
    spreads = np.log(x.scale).mean(2) / np.sqrt(ABS_VARIANCE * np.pi / 2 / (rows * columns))
    time = np.arange(frames) - (frames - 1) / 2
    time /= np.sqrt((time**2).sum())
    together = np.sqrt(planes)
    sheet.add(group, "trend of the frame mean", (means @ time).sum() / together, 1.0)
    sheet.add(group, "trend of the noise", (spreads @ time).sum() / together, 1.0)
    if frames < 4:
        return
    means -= (means @ time)[:, None] * time
    spreads -= spreads.mean(1, keepdims=True) + (spreads @ time)[:, None] * time
    error = np.sqrt(2 / (planes * (frames - 2)))
    sheet.add(group, "detrended frame mean / pixel", log_ratio((means**2).sum(1) / (frames - 2), 1.0), error)
    sheet.add(group, "jitter of the noise", log_ratio((spreads**2).sum(1) / (frames - 2), 1.0), error)
    common = means.sum(0)
    sheet.add(group, "frame mean, next frame", correlation(common[1:], common[:-1], (0,)), 1 / np.sqrt(frames - 2))
    alternating = (-1.0) ** np.arange(frames) / np.sqrt(frames)
    sheet.add(group, "noise of even and odd frames", abs((spreads @ alternating).sum()) / together, 0.6)
    if planes == 4:
        pairs = [correlation(means[i], means[j], (0,)) for i in range(4) for j in range(i)]
        sheet.add(group, "correlation of colours, frame mean", pairs, 1 / np.sqrt(6 * (frames - 2)))


def blocks(sheet: Sheet, x: Exposure) -> None:
    """Coarse shape of the static map and of the noise: slow cosines and an 8 x 8 grid of blocks.

    The unit is what independent pixels give. Planes are summed where a map is common to the colours.
    """
    planes, frames, rows, columns = x.shape
    noise = np.abs(x.bounded).mean(1)
    noise -= noise.mean((1, 2), keepdims=True)
    noise *= np.float32(np.sqrt(frames / ABS_VARIANCE))
    column = noise.mean(1).sum(0) * np.sqrt(rows / planes)
    signs = 1.0 - 2.0 * (np.arange(columns) % 2)
    sheet.add("blocks", "noise, parity of columns", abs(column @ signs) / np.sqrt(columns), 0.6)
    shape = cosines(columns) @ column
    sheet.add("blocks", "noise, trend along the row", shape[0], 1.0)
    sheet.add("blocks", "noise, low-order shape over columns", log_ratio((shape**2).mean(), 1.0), np.sqrt(2 / 3))
    row = np.log(x.scale).mean(1).sum(0) / np.sqrt(planes * ABS_VARIANCE * np.pi / 2 / (frames * columns))
    shape = cosines(rows) @ (row - row.mean())
    sheet.add("blocks", "noise, trend along the column", shape[0], 1.0)
    sheet.add("blocks", "noise, low-order shape over rows", log_ratio((shape**2).mean(), 1.0), np.sqrt(2 / 3))
    _shape_of_map(sheet, "noise", noise)
    moving = _grid(x.bounded)
    sheet.add("blocks", "frames, energy of 8 x 8 blocks", log_ratio(np.square(moving).mean(), 1.0), 0.02)
    if frames > 1:
        unit = np.sqrt((x.variance + TINY_DN2) / frames).astype(np.float32)[:, None, None]
        _shape_of_map(sheet, "static map", x.pixel / unit)


def _shape_of_map(sheet: Sheet, name: str, values: np.ndarray) -> None:
    """Mixed slow cosines and blocks of a map [plane, row, column] that is about white with variance 1."""
    planes, rows, columns = values.shape
    common = values.sum(0) / np.float32(np.sqrt(planes))
    mixed = cosines(rows) @ common @ cosines(columns).T
    sheet.add("blocks", f"{name}, mixed low-order shape", log_ratio((mixed**2).mean(), 1.0), np.sqrt(2 / 9))
    grid = _grid(common[None])
    sheet.add("blocks", f"{name}, energy of 8 x 8 blocks", log_ratio(np.square(grid).mean(), 1.0), np.sqrt(2) / GRID)
    sheet.add("blocks", f"{name}, largest block", log_ratio(np.square(grid).max(), 1.0), 0.3)


def _grid(x: np.ndarray) -> np.ndarray:
    """Sums over an 8 x 8 grid of blocks of x [..., row, column], divided by the root of their number of pixels."""
    rows, columns = x.shape[-2] // GRID, x.shape[-1] // GRID
    x = x[..., : rows * GRID, : columns * GRID]
    over_columns = x.reshape(*x.shape[:-1], GRID, columns).sum(-1)
    over_rows = over_columns.reshape(*x.shape[:-2], GRID, rows, GRID).sum(-2)
    return over_rows / np.float32(np.sqrt(rows * columns))
