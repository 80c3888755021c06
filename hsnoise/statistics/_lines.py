"""Statistics of rows and columns of exposures: their variances, colours, scales, spectra."""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import numpy as np
import scipy  # its parts are imported when they are used

from hsnoise.statistics._anova import Lines
from hsnoise.statistics._exposures import Exposures, inner
from hsnoise.statistics._sheet import ABS_VARIANCE, Sheet, correlation, correlations, fisher, log_ratio

BANDS = 5
BLOCKS_OF_ROWS, FEWEST_BLOCKS = (2, 4, 8, 16), 4  # rows that sensors read at a time
HAAR_LEVELS = 6
SAME_ROW = ((0, 1), (2, 3))
SAME_COLUMN = ((0, 2), (1, 3))
TINY = 1e-6
BESIDE = 1.5  # variance of a line less the mean of the two beside it, in variances of a line
MEDIAN_SQUARE = 0.4549  # of a standard normal variable
WHITENED_FROM = 2  # the lowest frequencies of a periodogram carry trends, not lines


def variances(sheet: Sheet, x: Exposures) -> None:
    """Log ratios of the mean squares of the analysis of variance, each the residual variance under white noise."""
    planes, frames, rows, columns = x.shape
    dof = max(frames - 1, 1)
    row_frame = columns * _power(x.row_frame) / (dof * (rows - 1))
    column_frame = rows * _power(x.column_frame) / (dof * (columns - 1))
    sheet.add_colours(
        "row x frame", "row x frame / pixel", log_ratio(row_frame, x.variance), np.sqrt(2 / (dof * (rows - 1)))
    )
    error = np.sqrt(2 / (planes * dof * (columns - 1)))
    sheet.add("column x frame", "column x frame / pixel", log_ratio(column_frame, x.variance), error)
    if frames == 1:
        return
    row = frames * columns * _power(x.row) / (rows - 1)
    column = frames * rows * _power(x.column) / (columns - 1)
    pixel = frames * inner(x.pixel, x.pixel) / ((rows - 1) * (columns - 1))
    sheet.add("static rows", "row / row x frame", log_ratio(row, row_frame), np.sqrt(2 / (planes * (rows - 1))))
    sheet.add("static columns", "column / pixel", log_ratio(column, x.variance), np.sqrt(2 / (planes * (columns - 1))))
    error = np.sqrt(2 / (planes * (rows - 1) * (columns - 1)))
    sheet.add("static pixels", "pixel / residual", log_ratio(pixel, x.variance), error)


def _power(x: np.ndarray) -> np.ndarray:
    """Sum of squares [exposure, plane] of x [exposure, plane, ...]."""
    return np.square(x).reshape(*x.shape[:2], -1).sum(-1)


@lru_cache
def _colour_pairs(letters: tuple[str, ...]) -> list[tuple[str, list[int], list[int]]]:
    """Name of each pair of colours, by whether they share a row, and the planes that it is of."""
    labels: dict[str, list[tuple[int, int]]] = {}
    for i in range(len(letters)):
        for j in range(i):
            where = "same row" if (j, i) in SAME_ROW else "neighbouring row"
            labels.setdefault(f"{where} of {'-'.join(sorted((letters[j], letters[i])))}", []).append((j, i))
    return [(label, [j for j, _ in pairs], [i for _, i in pairs]) for label, pairs in labels.items()]


def colours(sheet: Sheet, x: Exposures) -> None:
    """Correlations of rows and columns between colours and with their neighbours in space and time."""
    planes, frames, rows, columns = x.shape
    n_rows, n_columns = max(frames - 1, 1) * rows, max(frames - 1, 1) * columns
    values = correlations(x.row_frame)
    for label, first, second in _colour_pairs(sheet.letters):
        error = 1 / np.sqrt(n_rows * len(first))
        sheet.add("row x frame", f"correlation, {label}", values[:, first, second], error)
    near = _next(x.row_frame, 3)
    sheet.add_colours("row x frame", f"correlation with the {_next_line('row', planes)}", near, 1 / np.sqrt(n_rows))
    but_one = f"correlation with the {_next_line('row but one', planes)}"
    sheet.add("row x frame", but_one, _next(x.row_frame, 3, 2), 1 / np.sqrt(n_rows * planes))
    near = _next(x.column_frame, 3)
    error = 1 / np.sqrt(n_columns * planes)
    sheet.add("column x frame", f"correlation with the {_next_line('column', planes)}", near, error)
    if planes == 4:
        for group, what, moving, pairs, n in (
            ("column x frame", "same column", x.column_frame, SAME_COLUMN, n_columns),
            ("static rows", "same row", x.row, SAME_ROW, rows),
            ("static columns", "same column", x.column, SAME_COLUMN, columns),
        ):
            values = correlations(moving)[:, *np.transpose(pairs)]
            sheet.add(group, f"correlation, {what}", values, 1 / np.sqrt(n * 2))
    if frames > 2:
        later = _next(x.row_frame, 2)
        sheet.add("row x frame", "correlation with the next frame", later, 1 / np.sqrt(n_rows * planes))
        later = _next(x.column_frame, 2)
        sheet.add("column x frame", "correlation with the next frame", later, 1 / np.sqrt(n_columns * planes))


def together(sheet: Sheet, x: Exposures) -> None:
    """Whether a row resembles its neighbours more inside blocks of some rows than across their edges."""
    planes, frames, rows, _ = x.shape
    if frames == 1:
        return
    power, most = np.square(x.row_frame).mean((1, 2, 3)), np.zeros(len(x.row_frame))
    for lag, size in product((1, 2), BLOCKS_OF_ROWS):
        alike = (x.row_frame[..., lag:] * x.row_frame[..., :-lag]).mean((1, 2))
        blocks = alike.shape[1] // size
        if blocks < FEWEST_BLOCKS or size < 2 * lag:
            continue
        at_place = alike[:, : blocks * size].reshape(-1, blocks, size).mean(1)
        most = np.maximum(most, (alike.mean(1, keepdims=True) - at_place).max(1) / (power + TINY))
    error = 1 / np.sqrt((frames - 1) * planes * rows / BLOCKS_OF_ROWS[-1])
    sheet.add("row x frame", "rows read together", most, error / 3)


def _next(moving: np.ndarray, axis: int, lag: int = 1) -> np.ndarray:
    """artanh of the correlation `lag` apart along an axis, 2 or 3, of x [exposure, plane, frame, line].

    Of mean 0 for white noise.
    """
    n = moving.shape[axis]
    along = moving.swapaxes(2, 3) if axis == 2 else moving
    after, before = along[..., lag:], along[..., :-lag]
    # What sums to zero over n has correlation -1/(n - 1).
    return correlation(after, before, (2, 3)) + 1 / (n - 1)


def _next_line(line: str, planes: int) -> str:
    return f"next {line} of the colour" if planes > 1 else f"next {line}"


def scales(sheet: Sheet, x: Exposures) -> None:
    """Static profiles by scale and parity, against what the frames' fluctuations leave in their mean."""
    if x.shape[1] == 1:
        return
    for group, profile, moving in (
        ("static rows", x.row, x.row_frame),
        ("static columns", x.column, x.column_frame),
    ):
        planes, frames, n = moving.shape[1:]
        steps = _haar(np.concatenate([profile[:, :, None], moving], 2))
        still, noise = steps[..., 0], steps[..., 1:].mean(-1) * frames / (frames - 1)
        for level, value in enumerate(log_ratio(frames * still, noise)):
            independent = planes * max(n >> (level + 1), 1)
            sheet.add(group, f"steps of {1 << level}", value, np.sqrt(2 / independent * frames / (frames - 1)))
        sheet.add(group, "parity", _parity(profile, noise[0] / frames), 0.6)
        basis = cosines(n).T
        slow, fast = profile.sum(1) @ basis, moving.sum(1) @ basis
        value = log_ratio((slow**2).sum(1) * frames, (fast**2).sum((1, 2)) / (frames - 1))
        sheet.add(group, "low-order shape", value, np.sqrt(2 / 3 * frames / (frames - 1)))


def tilts(sheet: Sheet, x: Exposures) -> None:
    """How much more of the slow course of a frame's rows and columns is its slowest cosine, a tilt, than the next two.

    Slow noise has all three; a line from end to end hardly has the others.
    """
    frames = x.shape[1]
    if frames == 1:
        return
    for group, moving in (("row x frame", x.row_frame), ("column x frame", x.column_frame)):
        power = np.square(moving.sum(1) @ cosines(moving.shape[-1]).T).mean(1)
        value = log_ratio(power[:, 0], power[:, 1:].mean(1))
        sheet.add(group, "tilt of the frames", value, np.sqrt(3 / (frames - 1)))


def responses(sheet: Sheet, x: Exposures) -> None:
    """Static rows and columns less the mean of those on both sides, where light that varies smoothly cancels.

    Of the typical line: edges of shadows are few.
    """
    _, frames, rows, columns = x.shape
    if frames == 1:
        return
    for group, profile, places in (("row responses", x.row, columns), ("column responses", x.column, rows)):
        beside = profile[..., 1:-1] - (profile[..., :-2] + profile[..., 2:]) / 2
        lines = beside.shape[-1]
        noise = BESIDE * x.variance / (frames * places)
        typical = np.median(np.square(beside), -1) / MEDIAN_SQUARE
        sheet.add(
            group, "beside their neighbours", log_ratio(typical, noise), 2 * np.sqrt(2 / (beside.shape[1] * lines))
        )
        contrast = np.median(beside * (1.0 - 2.0 * (np.arange(lines) % 2)), -1)
        sheet.add(group, "even and odd", np.abs(contrast) / np.sqrt(noise / lines), 0.75)


def noise_of_rows(sheet: Sheet, x: Exposures) -> None:
    """Whether the noise of single rows differs from frame to frame, and that of neighbours together (interference)."""
    planes, frames, rows, columns = x.shape
    spread = np.log(x.scale)
    spread = (spread - spread.mean((2, 3), keepdims=True)) / np.sqrt(ABS_VARIANCE * np.pi / 2 / columns)
    n = planes * frames * rows
    sheet.add("blocks", "noise of rows, spread", log_ratio(np.square(spread).mean((2, 3)), 1.0), np.sqrt(2 / n))
    sheet.add("blocks", f"noise of rows, {_next_line('row', planes)}", _next(spread, 3), 1 / np.sqrt(n))


def _haar(profile: np.ndarray) -> np.ndarray:
    """Mean squares [level, ...] of steps between neighbouring blocks of 1, 2, 4 ... lines of a profile [..., n].

    Alike if white.
    """
    n = profile.shape[-1]
    total = np.zeros((*profile.shape[:-1], n + 1))
    np.cumsum(profile, -1, out=total[..., 1:])
    out = []
    for width in (1 << level for level in range(HAAR_LEVELS)):
        if 2 * width > n:
            break
        block = total[..., width:] - total[..., :-width]
        step = block[..., width:] - block[..., :-width]
        out.append(np.square(step, out=step).mean(-1) / (2 * width))
    return np.stack(out)


def _parity(profile: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """|contrast| [exposure] of even and odd lines of a profile [exposure, plane, line], common to all planes.

    In its standard errors, from the variance noise [exposure, plane].
    """
    _, planes, n = profile.shape
    signs = 1.0 - 2.0 * (np.arange(n) % 2)
    contrast = (profile @ signs) / np.sqrt(n * (noise + TINY))
    return np.abs(contrast.sum(1)) / np.sqrt(planes)


@lru_cache
def cosines(n: int) -> np.ndarray:
    """The three slowest cosines [3, n], orthonormal, without a mean."""
    waves = np.sqrt(2 / n) * np.cos(np.pi * np.outer(np.arange(1, 4), np.arange(n) + 0.5) / n)
    waves.setflags(write=False)
    return waves


@lru_cache
def _band_edges(n: int) -> list[int]:
    """First frequency of each band of n, and n."""
    return (np.unique(np.rint(np.geomspace(1, n + 1, BANDS + 1)).astype(int)) - 1).tolist()


def spectra(sheet: Sheet, x: Exposures) -> None:
    """Spectra over rows and columns of what is new in each frame: shape, and coherence of the colours of a line."""
    planes, frames, _, _ = x.shape
    for group, moving, pairs in (
        ("row spectrum", x.row_frame, SAME_ROW),
        ("column x frame", x.column_frame, SAME_COLUMN),
    ):
        waves = np.fft.rfft(moving)[..., 1:]
        power = (np.square(waves.real) + np.square(waves.imag)).sum(2)
        edges = _band_edges(power.shape[-1])
        widths, bands = np.diff(edges), len(edges) - 1
        of_band = np.add.reduceat(power, edges[:-1], -1)
        values = log_ratio(of_band / widths, power.mean(-1, keepdims=True))
        if planes == 4:
            first, second = (list(planes) for planes in zip(*pairs, strict=True))
            cross = (waves[:, first] * waves[:, second].conj()).real.sum(2)
            size = np.maximum(of_band[:, first] * of_band[:, second], 1e-60)
            coherence = fisher(np.add.reduceat(cross, edges[:-1], -1) / np.sqrt(size))
        for band, width in enumerate(widths.tolist()):
            n = max(frames - 1, 1) * width
            name = f"in band {band + 1} of {bands}"
            sheet.add(group, f"power {name}", values[..., band], 1 / np.sqrt(n * planes))
            if planes == 4:
                sheet.add(group, f"coherence of colours {name}", coherence[..., band], 1 / np.sqrt(4 * n))


def periodograms(x: Lines) -> dict[str, np.ndarray]:
    """Whitened periodograms [exposure, frequency] over the lines of the whole sensor (colours mixed).

    Rows and columns, what is new in each frame and what is static.
    """
    n, planes, frames, rows = x.row_frame.shape
    step = 1 if planes == 1 else 2
    row = x.row_frame.reshape(n, step, step, frames, rows).mean(2).transpose(0, 2, 3, 1)
    column = x.column_frame.reshape(n, step, step, frames, -1).mean(1).transpose(0, 2, 3, 1)
    moving = {"row x frame": row.reshape(n, frames, -1), "column x frame": column.reshape(n, frames, -1)}
    static = {group: profile[:, None] for group, profile in static_profiles(x).items()}
    return {group: _whitened(values, alternating=step > 1) for group, values in (moving | static).items()}


def static_profiles(x: Lines) -> dict[str, np.ndarray]:
    """Mean of each row and column of the whole sensor (colours mixed) over the frames, [exposure, line].

    None of one frame.
    """
    n, planes, frames, rows = x.row_frame.shape
    if frames == 1:
        return {}
    step = 1 if planes == 1 else 2
    row = x.row.reshape(n, step, step, rows).mean(2).transpose(0, 2, 1)
    column = x.column.reshape(n, step, step, -1).mean(1).transpose(0, 2, 1)
    return {"static rows": row.reshape(n, -1), "static columns": column.reshape(n, -1)}


def strongest_share(profile: np.ndarray) -> float:
    """Log of the power of the two neighbouring frequencies that have most of a profile [line], over the mean.

    A pattern of independent lines spreads over all frequencies; a period, a ramp or a shape does not. A line between
    two frequencies of the transform shares its power between them.
    """
    power = np.square(np.abs(np.fft.rfft(profile)))[1:]
    return float(log_ratio((power[1:] + power[:-1]).max(), power.mean()))


def _whitened(series: np.ndarray, *, alternating: bool) -> np.ndarray:
    """Periodogram [exposure, frequency] of series [exposure, frame, n], averaged over frames, over a power law.

    About 1 for any 1/f noise. alternating: the series takes turns between colours of mean zero, so that nothing but
    rounding is left at half a cycle, which must not bend the law.
    """
    power = np.square(np.abs(np.fft.rfft(series))).mean(1)[:, 1 + WHITENED_FROM :] + 1e-12
    frequency = np.log(np.arange(power.shape[1]) + 1.0 + WHITENED_FROM)
    some = slice(power.shape[1] - alternating)
    frequency -= frequency[some].mean()
    log_power = np.log(power[:, some])
    slope = log_power @ frequency[some] / np.square(frequency[some]).sum()
    return power / np.exp(log_power.mean(1, keepdims=True) + slope[:, None] * frequency)


def peak(periodogram: np.ndarray) -> float:
    """Log of the largest value over its surroundings (a running median), which a 1/f rise does not move."""
    width = min(31, len(periodogram) // 4 * 2 + 1)
    return float(
        log_ratio(np.max(periodogram / (scipy.ndimage.median_filter(periodogram, width, mode="reflect") + 1e-12)), 1.0)
    )


def strongest_line(height: np.ndarray, n: int) -> tuple[float, float]:
    """The highest of a periodogram about 1 of n sensor rows (columns), and its frequency, cycles each."""
    i = int(np.argmax(height))
    around = np.sqrt(np.maximum(np.pad(height, 1, constant_values=1.0)[i : i + 3] - 1, 0))
    # A line between two frequencies of the transform has amplitudes there as its distances from them.
    left, right = around[[0, 2]] / max(around[1] + max(around[0], around[2]), 1e-12)
    offset = right if right > left else -left
    return float(height[i]), float(min((i + 1 + WHITENED_FROM + offset) / n, 0.5))
