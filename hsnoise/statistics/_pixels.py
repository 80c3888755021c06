"""Statistics of single pixels of exposures: levels, lags, tails, pixels over time, codes, blocks."""

from __future__ import annotations

import numpy as np

from hsnoise.statistics._exposures import GRID, LAGS, TAILS, VARIANCE_FRAMES, Exposures, grid_of, inner, lag_product
from hsnoise.statistics._lines import cosines
from hsnoise.statistics._sheet import ABS_VARIANCE, TINY_DN2, Sheet, correlation, correlations, fisher, log_ratio

STATIC_LAGS = ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0))
QUANTILES = np.array([0.01, 0.1, 0.5, 0.9, 0.99, 0.999])


def levels(sheet: Sheet, x: Exposures) -> None:
    """Mean above black and variance."""
    planes, frames, rows, columns = x.shape
    n = frames * rows * columns
    mean_variance = x.variance.mean(1)
    sheet.add_colours("level", "mean above black, DN", x.mean, np.sqrt(mean_variance / n))
    sheet.add_colours("noise", "log variance", np.log(x.variance + TINY_DN2), np.sqrt(2 / n))
    robust = np.log(np.square(x.scale).mean((2, 3)) + TINY_DN2)
    sheet.add_colours("noise", "log variance without outliers", robust, np.sqrt(2 / n))
    if planes == 4:
        first, second = (i for i, letter in enumerate(sheet.letters) if letter == "G")
        step = (x.mean[:, first] - x.mean[:, second]) / np.sqrt(mean_variance + TINY_DN2)
        sheet.add("level", "one green over the other", step, np.sqrt(2 / n))


def codes(sheet: Sheet, x: Exposures) -> None:
    """The histogram of counts: skewness, roughness, gaps, ends."""
    planes, frames, rows, columns = x.shape
    n = frames * rows * columns
    skewness, roughness, left_out, zero, white = np.moveaxis(x.codes, 2, 0)
    sheet.add_colours("level", "skewness of the quantiles", skewness, 2 / np.sqrt(n))
    sheet.add("codes", "roughness of the histogram", roughness, 0.1 / np.sqrt(planes))
    sheet.add("codes", "share of codes left out", left_out, 0.02 / np.sqrt(planes))
    sheet.add("codes", "share at zero", zero, 0.5 / np.sqrt(n * planes))
    sheet.add("codes", "share at the white level", white, 0.5 / np.sqrt(n * planes))


def lags(sheet: Sheet, x: Exposures) -> None:
    """Correlation of the bounded residual with its neighbours on the sensor (of any colour) and in time."""
    planes, frames, rows, columns = x.shape
    n = max(frames - 1, 1) * rows * columns * planes
    power = np.maximum(x.powers[:, :, 0].mean(1), 1e-12)
    for i, lag in enumerate(LAGS):
        value = fisher(x.lags[:, i] / power + _sum_to_zero(x, lag))
        sheet.add("spatial lags", f"residual, {_away(lag)}", value, 1 / np.sqrt(n))
    if frames > 2:
        value = fisher(x.later / power + 1 / (frames - 1))
        sheet.add("pixels over time", "residual, next frame", value, 1 / np.sqrt(n))
    if frames == 1:
        return
    static = x.bounded_map
    power = np.maximum(inner(static, static).sum(1) / static[0].size, 1e-12)
    error = 1 / np.sqrt(planes * rows * columns)
    for lag in STATIC_LAGS:
        value = fisher(lag_product(static[:, :, None], lag) / power + _sum_to_zero(x, lag))
        sheet.add("static pixels", f"map, {_away(lag)}", value, error, of_map=True)


def _away(lag: tuple[int, int]) -> str:
    rows, columns = (f"{n} {what}{'' if n == 1 else 's'}" for n, what in zip(lag, ("row", "column"), strict=True))
    return f"{rows}, {columns} away" if all(lag) else f"{rows if lag[0] else columns} away"


def _sum_to_zero(x: Exposures, lag: tuple[int, int]) -> float:
    """Minus the correlation of white noise at a lag along a row or column of one colour, whose sum is zero."""
    planes, _, rows, columns = x.shape
    step = 1 if planes == 1 else 2
    if lag[0] % step or lag[1] % step or all(lag):
        return 0.0
    return 1 / (rows - 1 if lag[0] else columns - 1)


def tails(sheet: Sheet, x: Exposures) -> None:
    """Shape of the residual and, of the static map, how many pixels lie far out."""
    planes, frames, rows, columns = x.shape
    n = max(frames - 1, 1) * rows * columns
    second, third, fourth = np.moveaxis(x.powers, 2, 0)
    second = np.maximum(second, 1e-6)
    sheet.add_colours("tails", "skewness", third / second**1.5, np.sqrt(6 / n))
    sheet.add_colours("tails", "log kurtosis", np.log((fourth / second**2 + 0.01) / 3), np.sqrt(24 / n) / 3)
    _add_tails(sheet, "tails", "residuals", x.far)
    if frames > 1:
        _add_tails(sheet, "static pixels", "pixels of the map", x.far_on_map, of_map=True)
        square = np.square(x.bounded_map)
        pixels = rows * columns
        second, fourth = inner(x.bounded_map, x.bounded_map) / pixels, inner(square, square) / pixels
        kurtosis = fourth / np.maximum(second**2, 1e-6)
        error = np.sqrt(24 / (planes * pixels)) / 3
        sheet.add("static pixels", "log kurtosis of the map", np.log((kurtosis + 0.01) / 3), error, of_map=True)


def _add_tails(sheet: Sheet, group: str, what: str, numbers: np.ndarray, *, of_map: bool = False) -> None:
    """From numbers [exposure, tail]."""
    for limit, number in zip(TAILS, numbers.T, strict=True):
        sheet.add_count(group, f"{what} {'above' if limit > 0 else 'below'} {limit:g} sigma", number, of_map=of_map)


def variance_over_time(sheet: Sheet, x: Exposures) -> None:
    """Quantiles of the pixels' variances, and whether pixels of large mean vary more (hot ones do)."""
    planes, frames, rows, columns = x.shape
    if frames < VARIANCE_FRAMES:
        return
    n, level = rows * columns, np.log(x.temporal.mean((2, 3), dtype=np.float64))
    quantiles = _log_quantiles(x.temporal.reshape(-1, planes, n))
    for i, q in enumerate(QUANTILES.tolist()):
        error = 1 / np.sqrt(n * planes * min(q, 1 - q))
        sheet.add("pixels over time", f"quantile {q:g} of log variance", quantiles[..., i] - level, error)
    centred = np.log(x.temporal)
    centred -= centred.mean((2, 3), keepdims=True)
    static = x.bounded_map
    power = np.maximum(inner(static, static) * inner(centred, centred), 1e-60)
    value = fisher(inner(static, centred) / np.sqrt(power))
    sheet.add("pixels over time", "correlation of mean and log variance", value, 1 / np.sqrt(n * planes))


def _log_quantiles(x: np.ndarray) -> np.ndarray:
    """QUANTILES [..., quantile] of the logarithms of x [..., n]. NumPy sorts float32 faster than it selects."""
    at = QUANTILES * (x.shape[-1] - 1)
    below = at.astype(int)
    near = np.log(np.sort(x, -1)[..., [below, below + 1]].astype(np.float64))
    return near[..., 0, :] + (at - below) * (near[..., 1, :] - near[..., 0, :])


def frames_over_time(sheet: Sheet, x: Exposures) -> None:
    """Means and noise of whole frames: flicker, drift, jitter. Means are in units of what independent pixels give."""
    planes, frames, rows, columns = x.shape
    if frames == 1:
        return
    group, unit = "frames over time", np.sqrt((x.variance + TINY_DN2) / (rows * columns))[..., None]
    means = x.frame / unit
    error = np.sqrt(2 / (planes * (frames - 1)))
    sheet.add(group, "frame mean / pixel", log_ratio((means**2).sum(2) / (frames - 1), 1.0), error)
    spreads = np.log(x.scale).mean(3) / np.sqrt(ABS_VARIANCE * np.pi / 2 / (rows * columns))
    time = np.arange(frames) - (frames - 1) / 2
    time /= np.sqrt((time**2).sum())
    together = np.sqrt(planes)
    sheet.add(group, "trend of the frame mean", (means @ time).sum(1) / together, 1.0)
    sheet.add(group, "trend of the noise", (spreads @ time).sum(1) / together, 1.0)
    if frames < 4:
        return
    means -= (means @ time)[..., None] * time
    spreads -= spreads.mean(2, keepdims=True) + (spreads @ time)[..., None] * time
    error = np.sqrt(2 / (planes * (frames - 2)))
    sheet.add(group, "detrended frame mean / pixel", log_ratio((means**2).sum(2) / (frames - 2), 1.0), error)
    sheet.add(group, "jitter of the noise", log_ratio((spreads**2).sum(2) / (frames - 2), 1.0), error)
    common = means.sum(1)
    near = correlation(common[:, 1:], common[:, :-1], (1,))
    sheet.add(group, "frame mean, next frame", near, 1 / np.sqrt(frames - 2))
    alternating = (-1.0) ** np.arange(frames) / np.sqrt(frames)
    sheet.add(group, "noise of even and odd frames", np.abs((spreads @ alternating).sum(1)) / together, 0.6)
    if planes == 4:
        pairs = correlations(means)[:, *np.tril_indices(4, -1)]
        sheet.add(group, "correlation of colours, frame mean", pairs, 1 / np.sqrt(6 * (frames - 2)))


def blocks(sheet: Sheet, x: Exposures) -> None:
    """Coarse shape of the static map and of the noise: slow cosines and an 8 x 8 grid of blocks.

    All is in units of what independent pixels give; a map is common to the colours where planes are summed.
    """
    planes, frames, rows, columns = x.shape
    noise = x.noise - x.noise.mean((2, 3), keepdims=True)
    noise *= np.float32(np.sqrt(frames / ABS_VARIANCE))
    column = noise.mean(2, dtype=np.float64).sum(1) * np.sqrt(rows / planes)
    signs = 1.0 - 2.0 * (np.arange(columns) % 2)
    sheet.add("blocks", "noise, parity of columns", np.abs(column @ signs) / np.sqrt(columns), 0.6)
    _trend(sheet, "row", "columns", column)
    row = np.log(x.scale).mean(2).sum(1) / np.sqrt(planes * ABS_VARIANCE * np.pi / 2 / (frames * columns))
    _trend(sheet, "column", "rows", row - row.mean(1, keepdims=True))
    _shape_of_map(sheet, "noise", noise)
    moving = np.square(x.grid, dtype=np.float64).mean((1, 2, 3, 4))
    sheet.add("blocks", "frames, energy of 8 x 8 blocks", log_ratio(moving, 1.0), 0.02)
    if frames > 1:
        unit = np.sqrt((x.variance + TINY_DN2) / frames).astype(np.float32)[..., None, None]
        _shape_of_map(sheet, "static map", x.pixel / unit)


def _trend(sheet: Sheet, along: str, lines: str, profile: np.ndarray) -> None:
    """Slow cosines of the noise over lines, from profile [exposure, line]."""
    shape = profile @ cosines(profile.shape[1]).T
    sheet.add("blocks", f"noise, trend along the {along}", shape[:, 0], 1.0)
    sheet.add("blocks", f"noise, low-order shape over {lines}", log_ratio((shape**2).mean(1), 1.0), np.sqrt(2 / 3))


def _shape_of_map(sheet: Sheet, name: str, values: np.ndarray) -> None:
    """Mixed slow cosines and blocks of a map [exposure, plane, row, column], about white with variance 1."""
    _, planes, rows, columns = values.shape
    common = values.sum(1) / np.float32(np.sqrt(planes))
    mixed = cosines(rows) @ common @ cosines(columns).T
    sheet.add("blocks", f"{name}, mixed low-order shape", log_ratio((mixed**2).mean((1, 2)), 1.0), np.sqrt(2 / 9))
    power = np.square(grid_of(common))
    energy = log_ratio(power.mean((1, 2)), 1.0)
    sheet.add("blocks", f"{name}, energy of 8 x 8 blocks", energy, np.sqrt(2) / GRID)
    sheet.add("blocks", f"{name}, largest block", log_ratio(power.max((1, 2)), 1.0), 0.3)
