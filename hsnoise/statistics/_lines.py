"""Statistics of the rows and columns of one exposure: variances, colours, scales, spectra."""

from __future__ import annotations

import numpy as np
import scipy  # its submodules are imported on first use

from hsnoise.statistics._anova import Exposure
from hsnoise.statistics._sheet import ABS_VARIANCE, Sheet, correlation, fisher, log_ratio

BANDS = 5
HAAR_LEVELS = 6
SAME_ROW = ((0, 1), (2, 3))
SAME_COLUMN = ((0, 2), (1, 3))
TINY = 1e-6
WHITENED_FROM = 2  # lower frequencies of a periodogram carry trends, not spectral lines


def variances(sheet: Sheet, x: Exposure) -> None:
    """Log ratios of the mean squares of the analysis of variance; white noise makes all equal the residual variance."""
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
    pixel = frames * _power(x.pixel) / ((rows - 1) * (columns - 1))
    sheet.add("static rows", "row / row x frame", log_ratio(row, row_frame), np.sqrt(2 / (planes * (rows - 1))))
    sheet.add("static columns", "column / pixel", log_ratio(column, x.variance), np.sqrt(2 / (planes * (columns - 1))))
    error = np.sqrt(2 / (planes * (rows - 1) * (columns - 1)))
    sheet.add("static pixels", "pixel / residual", log_ratio(pixel, x.variance), error)


def _power(x: np.ndarray) -> np.ndarray:
    """Sum of squares of each plane."""
    return np.square(x, dtype=np.float64).sum(tuple(range(1, x.ndim)))


def colours(sheet: Sheet, x: Exposure) -> None:
    """Correlations of rows and columns between colours, and with their neighbours in space and time."""
    planes, frames, rows, columns = x.shape
    n_rows, n_columns = max(frames - 1, 1) * rows, max(frames - 1, 1) * columns
    labels: dict[str, list[tuple[int, int]]] = {}
    for i in range(planes):
        for j in range(i):
            where = "same row" if (j, i) in SAME_ROW else "neighbouring row"
            labels.setdefault(f"{where} of {'-'.join(sorted((sheet.letters[j], sheet.letters[i])))}", []).append((j, i))
    for label, pairs in labels.items():
        values = [correlation(x.row_frame[j], x.row_frame[i], (0, 1)) for j, i in pairs]
        sheet.add("row x frame", f"correlation, {label}", values, 1 / np.sqrt(n_rows * len(pairs)))
    near = _next(x.row_frame, 2)
    sheet.add_colours("row x frame", f"correlation with the {_next_line('row', planes)}", near, 1 / np.sqrt(n_rows))
    near = _next(x.column_frame, 2)
    error = 1 / np.sqrt(n_columns * planes)
    sheet.add("column x frame", f"correlation with the {_next_line('column', planes)}", near, error)
    if planes == 4:
        values = [correlation(x.column_frame[j], x.column_frame[i], (0, 1)) for j, i in SAME_COLUMN]
        sheet.add("column x frame", "correlation, same column", values, 1 / np.sqrt(n_columns * 2))
        values = [correlation(x.row[j], x.row[i], (0,)) for j, i in SAME_ROW]
        sheet.add("static rows", "correlation, same row", values, 1 / np.sqrt(2 * rows))
        values = [correlation(x.column[j], x.column[i], (0,)) for j, i in SAME_COLUMN]
        sheet.add("static columns", "correlation, same column", values, 1 / np.sqrt(2 * columns))
    if frames > 2:
        later = _next(x.row_frame, 1)
        sheet.add("row x frame", "correlation with the next frame", later, 1 / np.sqrt(n_rows * planes))
        later = _next(x.column_frame, 1)
        sheet.add("column x frame", "correlation with the next frame", later, 1 / np.sqrt(n_columns * planes))


def _next(moving: np.ndarray, axis: int) -> np.ndarray:
    """artanh of the correlation of neighbours along an axis of x [plane, frame, row or column], 0 for white noise."""
    n = moving.shape[axis]
    after, before = (np.take(moving, range(*ends), axis) for ends in ((1, n), (n - 1,)))
    # n white numbers that sum to zero have correlation -1/(n - 1).
    return correlation(after, before, (1, 2)) + 1 / (n - 1)


def _next_line(line: str, planes: int) -> str:
    return f"next {line} of the colour" if planes > 1 else f"next {line}"


def scales(sheet: Sheet, x: Exposure) -> None:
    """Static profiles by scale and parity, relative to what the frames' fluctuations leave in their mean."""
    if x.shape[1] == 1:
        return
    for group, profile, moving in (
        ("static rows", x.row, x.row_frame),
        ("static columns", x.column, x.column_frame),
    ):
        planes, frames, n = moving.shape
        for level, (still, noise) in enumerate(zip(_haar(profile), _haar(moving), strict=True)):
            value = log_ratio(frames * still, noise.mean(1) * frames / (frames - 1))
            independent = planes * max(n >> (level + 1), 1)
            sheet.add(group, f"steps of {1 << level}", value, np.sqrt(2 / independent * frames / (frames - 1)))
            if level == 0:
                finest = noise.mean(1) / (frames - 1)
        sheet.add(group, "parity", _parity(profile, finest), 0.6)
        basis = cosines(n)
        still, noise = ((z @ basis.T).astype(np.float64) for z in (profile.sum(0), moving.sum(0)))
        value = log_ratio((still**2).sum() * frames, (noise**2).sum() / (frames - 1))
        sheet.add(group, "low-order shape", value, np.sqrt(2 / 3 * frames / (frames - 1)))


def noise_of_rows(sheet: Sheet, x: Exposure) -> None:
    """Whether rows change their noise from frame to frame, and neighbours change together (interference)."""
    planes, frames, rows, columns = x.shape
    spread = np.log(x.scale)
    spread = (spread - spread.mean((1, 2), keepdims=True)) / np.sqrt(ABS_VARIANCE * np.pi / 2 / columns)
    n = planes * frames * rows
    sheet.add("blocks", "noise of rows, spread", log_ratio(np.square(spread).mean((1, 2)), 1.0), np.sqrt(2 / n))
    sheet.add("blocks", f"noise of rows, {_next_line('row', planes)}", _next(spread, 2), 1 / np.sqrt(n))


def _haar(profile: np.ndarray) -> list[np.ndarray]:
    """Mean squares of steps between neighbouring blocks of 1, 2, 4 ... values of a profile [..., n]; equal if white."""
    n = profile.shape[-1]
    total = np.zeros((*profile.shape[:-1], n + 1))
    np.cumsum(profile, -1, out=total[..., 1:])
    out = []
    for level in range(HAAR_LEVELS):
        width = 1 << level
        if 2 * width > n:
            break
        step = total[..., 2 * width :] - 2 * total[..., width:-width] + total[..., : -2 * width]
        out.append((step**2).mean(-1) / (2 * width))
    return out


def _parity(profile: np.ndarray, noise: np.ndarray) -> float:
    """|contrast| of even and odd rows (columns) of a profile [plane, n] in standard errors, all planes together."""
    signs = 1.0 - 2.0 * (np.arange(profile.shape[1]) % 2)
    contrast = (profile @ signs) / np.sqrt(profile.shape[1] * (noise + TINY))
    return abs(contrast.sum()) / np.sqrt(len(profile))


def cosines(n: int) -> np.ndarray:
    """The three slowest cosines [3, n], orthonormal, of mean 0."""
    return np.sqrt(2 / n) * np.cos(np.pi * np.outer(np.arange(1, 4), np.arange(n) + 0.5) / n)


def spectra(sheet: Sheet, x: Exposure) -> None:
    """Spectra over rows and columns of what is new in each frame: shape, and coherence of the colours in one row."""
    planes, frames, rows, columns = x.shape
    for group, moving, pairs in (
        ("row spectrum", x.row_frame, SAME_ROW),
        ("column x frame", x.column_frame, SAME_COLUMN),
    ):
        waves = np.fft.rfft(moving)[..., 1:]
        power = np.square(np.abs(waves)).sum(1)
        edges = np.unique(np.rint(np.geomspace(1, power.shape[-1] + 1, BANDS + 1)).astype(int)) - 1
        level, bands = power.mean(-1), len(edges) - 1
        for band, (low, high) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
            n = max(frames - 1, 1) * (high - low)
            value = log_ratio(power[:, low:high].mean(-1), level)
            sheet.add(group, f"power in band {band + 1} of {bands}", value, 1 / np.sqrt(n * planes))
            if planes == 4:
                cut = waves[..., low:high]
                cross = [(cut[j] * cut[i].conj()).real.sum() for j, i in pairs]
                size = [power[j, low:high].sum() * power[i, low:high].sum() for j, i in pairs]
                value = fisher(np.array(cross) / np.sqrt(np.maximum(size, 1e-60)))
                sheet.add(group, f"coherence of colours in band {band + 1} of {bands}", value, 1 / np.sqrt(4 * n))


def periodograms(x: Exposure) -> dict[str, np.ndarray]:
    """Whitened periodograms over the rows and columns of the whole sensor (colours mixed), moving and static."""
    step = 1 if x.shape[0] == 1 else 2
    frames, rows, columns = x.shape[1:]
    row = x.row_frame.reshape(step, step, frames, rows).mean(1).transpose(1, 2, 0).reshape(frames, -1)
    column = x.column_frame.reshape(step, step, frames, columns).mean(0).transpose(1, 2, 0).reshape(frames, -1)
    series = {"row x frame": row, "column x frame": column, **static_profiles(x)}
    return {group: _whitened(values) for group, values in series.items()}


def static_profiles(x: Exposure) -> dict[str, np.ndarray]:
    """Means over frames of the sensor's rows and columns (colours mixed), [1, n] each; empty for a single frame."""
    step = 1 if x.shape[0] == 1 else 2
    _, frames, rows, columns = x.shape
    if frames == 1:
        return {}
    row = x.row.reshape(step, step, rows).mean(1).T.reshape(1, -1)
    column = x.column.reshape(step, step, columns).mean(0).T.reshape(1, -1)
    return {"static rows": row, "static columns": column}


def strongest_share(profile: np.ndarray) -> float:
    """Log of the power of the strongest pair of neighbouring frequencies of a profile [1, n], over the mean power.

    Independent rows spread over all frequencies; a period, a ramp or a shape does not. A spectral line between two
    frequencies of the transform shares its power between them.
    """
    power = np.square(np.abs(np.fft.rfft(profile[0])))[1:]
    return float(log_ratio((power[1:] + power[:-1]).max(), power.mean()))


def _whitened(series: np.ndarray) -> np.ndarray:
    """Periodogram of series [frame, n], averaged over frames and divided by a power law: about 1 for any 1/f noise."""
    power = np.square(np.abs(np.fft.rfft(series))).mean(0)[1 + WHITENED_FROM :] + 1e-12
    frequency = np.log(np.arange(len(power)) + 1.0 + WHITENED_FROM)
    slope, offset = np.polyfit(frequency, np.log(power), 1)
    return power / np.exp(offset + slope * frequency)


def peak(periodogram: np.ndarray) -> float:
    """Log of the largest value over a running median around it, which a 1/f rise does not move."""
    width = min(31, len(periodogram) // 4 * 2 + 1)
    return float(
        log_ratio(np.max(periodogram / (scipy.ndimage.median_filter(periodogram, width, mode="reflect") + 1e-12)), 1.0)
    )


def strongest_line(height: np.ndarray, n: int) -> tuple[float, float]:
    """Height and frequency (cycles per row or column) of the highest peak of a whitened periodogram of n of them."""
    i = int(np.argmax(height))
    around = np.sqrt(np.maximum(np.pad(height, 1, constant_values=1.0)[i : i + 3] - 1, 0))
    # The amplitudes at the two nearest frequencies of the transform give the line's distance from each.
    left, right = around[[0, 2]] / max(around[1] + max(around[0], around[2]), 1e-12)
    offset = right if right > left else -left
    return float(height[i]), float(min((i + 1 + WHITENED_FROM + offset) / n, 0.5))
