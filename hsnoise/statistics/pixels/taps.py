"""Outputs that read blocks of the frame (level or noise step at halves, quarters, eighths), or every second column."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hsnoise._core.robust import robust_sigma
from hsnoise.statistics.pixels.classes import FILLED
from hsnoise.statistics.pixels.sample import without_outliers
from hsnoise.statistics.pixels.survey import Group, Plane, Survey

LAYOUTS = {0: (2,), 1: (2, 4, 8, 16)}  # outputs over the rows, over the columns
SEAM = 8.0  # typical differences between neighbouring runs of lines
REACH, LEAST_REACH = 16, 4  # lines on each side of a seam
FEWEST_PLACES = 24  # elsewhere, which tell the typical difference
MOST = 0.6  # share of the new seams of a layout that must be there
LEAST, LEAST_NOISE = 1e-4, 3e-3  # of the noise's variance, of the noise: differences that change no frame visibly
PIECES = 8  # of a row, in all of which even columns lie on one side of odd ones
WANDERS = 25.0  # times the variance by chance, beyond which outputs wander from frame to frame
GAINS_APART = 5.0  # standard errors of the spread of gains
LEAST_LIT = 0.2  # of the signal of the typical pixel
LEAST_SIGNAL = 0.2  # of the variance without signal: less tells no gain

Bounds = list[slice]
EVEN_AND_ODD: Bounds = [slice(0, None, 2), slice(1, None, 2)]
Moments = tuple[np.ndarray, np.ndarray, np.ndarray]


class Taps(NamedTuple):
    """Outputs that read blocks of the frame or, `interleaved`, even and odd columns of each colour.

    Attributes:
        rows, columns: number of blocks over the rows and over the columns; 1 and 2 of interleaved ones.
        offset_dn [block row, block column]: level without signal less its mean, DN.
        noise_dn: temporal noise of the typical pixel without signal, DN.
        gain, gain_error: relative to the mean of the outputs, by the variance that signal adds; NaN without signal.
        change_dn: how the blocks wander from frame to frame [frame, block row, block column], DN; None within chance.
    """

    rows: int
    columns: int
    offset_dn: np.ndarray
    noise_dn: np.ndarray
    gain: np.ndarray
    gain_error: np.ndarray
    interleaved: bool
    change_dn: np.ndarray | None = None

    @property
    def wander_dn(self) -> tuple[float, float]:
        """Standard deviation of an output's change from frame to frame, and its error, DN; from outputs side by side.

        What frames and rows share, outputs one above the other share, too.
        """
        if self.change_dn is None:
            return 0.0, np.inf
        variance, few = _side_by_side(self.change_dn)
        return float(np.sqrt(variance)), float(np.sqrt(variance / (2 * few)))

    def changes_dn2(self) -> dict[str, float]:
        """Variance of each component that wandering outputs make in these frames, DN^2."""
        if self.change_dn is None:
            return {}
        frames, rows, columns = self.change_dn.shape
        beside = self.change_dn - self.change_dn.mean((1, 2), keepdims=True)
        of = {name: float(np.sum(beside.mean(axis) ** 2)) / (frames - 1) for name, axis in (("row", 2), ("column", 1))}
        left = beside - beside.mean(2, keepdims=True) - beside.mean(1, keepdims=True)
        return {
            "frame": self.wander_dn[0] ** 2 / (rows * columns),
            "row_x_frame": of["row"] / rows,
            "column_x_frame": of["column"] / columns,
            "temporal": float(np.mean(np.sum(left**2, 0))) / (frames - 1),
        }

    def of_lines_dn(self, axis: str, lines: int) -> np.ndarray:
        """Mean offset of each of the rows or columns of a plane [line], DN."""
        blocks = self.offset_dn.mean(1 if axis == "row" else 0)
        numbers = np.arange(lines)
        return blocks[numbers % len(blocks) if self.interleaved else numbers * len(blocks) // lines]

    @property
    def gain_spread(self) -> tuple[float, float]:
        """Standard deviation of the logarithm of gain over the outputs, and its standard error; infinite if unknown."""
        if np.isnan(self.gain).any():
            return 0.0, np.inf
        logarithm, error_2 = np.log(self.gain), np.mean((self.gain_error / self.gain) ** 2)
        spread = float(np.sqrt(max(logarithm.var(ddof=1) - error_2, 0.0)))
        return spread, float(np.sqrt(error_2 / (self.gain.size - 1)))

    @property
    def gains_differ(self) -> bool:
        """Whether the gains of the outputs differ beyond chance."""
        spread, error = self.gain_spread
        return spread > GAINS_APART * error


def taps_of(found: Survey) -> Taps | None:
    """The outputs of a sensor, from its shortest darks of several frames; None if there is one, or nothing tells."""
    group = found.shortest
    if group is None or not found.is_whole:
        return None
    level, noise = _level_and_noise(group)
    rows, columns = (max(_layout(of, axis, found) for of in (level, noise)) for axis in (0, 1))
    interleaved = rows * columns == 1 and any(_alternates(of) for of in (level, noise))
    if rows * columns == 1 and not interleaved:
        return None
    bounds = [_bounds(found, axis, count) for axis, count in enumerate((rows, columns))]
    if interleaved:
        columns, bounds[1] = 2, EVEN_AND_ODD
    at_rest = level_dn, variance, _ = _moments(group, bounds)
    offset = level_dn - level_dn.mean()
    noise_dn = np.sqrt(np.maximum(variance, 0.0))
    if offset.var() < LEAST * variance.mean() and noise_dn.std() < LEAST_NOISE * noise_dn.mean():
        return None
    change = None if interleaved else _changes(group, rows, columns, float(variance.mean()))
    return Taps(rows, columns, offset, noise_dn, *_gains(found, bounds, at_rest), interleaved, change)


def _changes(group: Group, rows: int, columns: int, noise_dn2: float) -> np.ndarray | None:
    """How outputs wander from frame to frame [frame, block row, block column], DN; None within chance, and of one."""
    of_planes = [plane.blocks_dn for plane in group.planes if plane.blocks_dn is not None]
    if columns < 2 or not of_planes:
        return None
    blocks = np.mean(of_planes, axis=0)
    change = blocks.reshape(len(blocks), rows, 2 // rows, columns, -1).mean((2, 4))
    variance, few = _side_by_side(change)
    columns_dn2 = float(np.mean([p.components["column_x_frame"].chance_dn2 for p in group.planes]))
    chance = noise_dn2 * change[0].size / _map(group, "pair_variance_dn2").size / len(of_planes) + columns_dn2
    is_there = variance > max(WANDERS * (1 + np.sqrt(2 / few)) * chance, LEAST * noise_dn2)
    return change if is_there else None


def _side_by_side(change: np.ndarray) -> tuple[float, float]:
    """Variance of an output's change, DN^2, by how those of a row differ, and its degrees of freedom."""
    frames, rows, columns = change.shape
    beside = change - change.mean(2, keepdims=True)
    few = (frames - 1) * rows * (columns - 1)
    return float((beside**2).sum()) / few, few


def alternating(found: Survey) -> Taps | None:
    """Even and odd columns as two outputs of the same level; None without darks of several frames."""
    group = found.shortest
    if group is None:
        return None
    bounds = [slice(None)], EVEN_AND_ODD
    at_rest = level, variance, _ = _moments(group, bounds)
    return Taps(1, 2, np.zeros_like(level), np.sqrt(np.maximum(variance, 0.0)), *_gains(found, bounds, at_rest), True)


def _level_and_noise(group: Group) -> tuple[np.ndarray, np.ndarray]:
    """Level, DN, and logarithm of the variance of pixels, in which seams are looked for.

    Means of few whole counts lie on a lattice, on which medians would not differ at all: they are blurred.
    """
    level, variance = _map(group, "level_dn"), _map(group, "pair_variance_dn2")
    level += np.random.default_rng(0).uniform(-0.5, 0.5, level.shape) / group.n_frames
    blurred = variance * np.random.default_rng(1).uniform(0.8, 1.25, variance.shape)
    return level, np.log(np.maximum(blurred, 0.1 * float(np.median(variance)) + 1e-6))


def levelled(found: Survey, taps: Taps) -> Survey:
    """The survey with the offsets of outputs subtracted from all pixels, and from lines of its shortest darks."""
    bounds = _bounds_of(found, taps)
    shift = np.zeros((found.sampled_rows.size // _step(found), found.shape[1] // _step(found)), np.float32)
    for rows, of_row in zip(bounds[0], taps.offset_dn, strict=True):
        for columns, offset in zip(bounds[1], of_row, strict=True):
            shift[rows, columns] = offset
    groups = []
    for group in found.groups:
        planes = [_pixels_levelled(plane, shift.ravel()) for plane in group.planes]
        if group is found.shortest:
            planes = [_lines_levelled(plane, taps) for plane in planes]
        groups.append(replace(group, planes=tuple(planes)))
    return replace(found, groups=tuple(groups))


def _pixels_levelled(plane: Plane, shift: np.ndarray) -> Plane:
    if plane.halves is None:
        return replace(plane, single_dn=plane.single_dn - shift)
    return replace(plane, halves=replace(plane.halves, level_dn=plane.halves.level_dn - shift))


def _lines_levelled(plane: Plane, taps: Taps) -> Plane:
    means, components = {}, dict(plane.components)
    for axis in ("row", "column"):
        before = getattr(plane, f"{axis}_mean_dn")
        after = before - taps.of_lines_dn(axis, len(before))
        means[f"{axis}_mean_dn"], one = after, components[axis]
        less = float(before.var(ddof=1) - after.var(ddof=1))
        components[axis] = replace(one, variance_dn2=one.variance_dn2 - less)
    together = {"row_x_frame": plane.rows_together, "column_x_frame": plane.columns_together}
    for name, less in taps.changes_dn2().items():
        of_lines = (components[name], *together.get(name, ()))
        components[name], *rest = (replace(one, variance_dn2=one.variance_dn2 - less) for one in of_lines)
        together |= {name: tuple(rest)} if rest else {}
    both = {"rows_together": together["row_x_frame"], "columns_together": together["column_x_frame"]}
    return replace(plane, components=components, **both, **means)


def _map(group: Group, name: str) -> np.ndarray:
    """A statistic of the sampled pixels, mean over halves of the frames and over planes [row, column] of a plane."""
    maps = []
    for plane in group.planes:
        values = getattr(plane.halves, name).reshape(-1, plane.halves.lowest.size).mean(0, dtype=np.float64)
        maps.append(values.reshape(-1, len(plane.column_mean_dn)))
    return np.mean(maps, axis=0)


def _bounds(found: Survey, axis: int, count: int) -> Bounds:
    """First and last line of each block among the sampled lines of a plane."""
    step = _step(found)
    lines = found.sampled_rows[::step] if axis == 0 else np.arange(0, found.shape[1], step)
    edges = np.searchsorted(lines, [of * found.shape[axis] / count for of in range(count + 1)])
    return [slice(start, stop) for start, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)]


def _bounds_of(found: Survey, taps: Taps) -> list[Bounds]:
    rows = _bounds(found, 0, taps.rows)
    return [rows, EVEN_AND_ODD if taps.interleaved else _bounds(found, 1, taps.columns)]


def _step(found: Survey) -> int:
    """Lines of the sensor for one of a plane."""
    return 1 if found.cfa == "mono" else 2


def _alternates(values: np.ndarray) -> bool:
    """Whether even and odd columns differ by more than columns of one kind do, everywhere alike."""
    profile = np.median(values, axis=0)
    beside = (profile[1:-1] - (profile[:-2] + profile[2:]) / 2) * (-1.0) ** np.arange(len(profile) - 2)
    pieces = np.array([np.median(of) for of in np.array_split(beside, PIECES)])
    error = robust_sigma(beside - np.median(beside)) / np.sqrt(len(beside))
    return bool(abs(np.median(beside)) > SEAM * error and (np.sign(pieces) == np.sign(pieces[0])).all())


def _layout(values: np.ndarray, axis: int, found: Survey) -> int:
    """Number of outputs along an axis: the most whose new seams are mostly there."""
    half = values.shape[1 - axis] // 2
    # Two halves across: the offsets of outputs may cancel in their mean.
    parts = np.split(values, [half], axis=1 - axis)
    profiles = [np.median(of, axis=1 - axis) for of in parts]
    most = 1
    for count in LAYOUTS[axis]:
        edges = [of.start for of in _bounds(found, axis, count)[1:]]
        new = edges[::2] if count > 2 else edges  # the others are those of half as many outputs
        there = [any(_is_seam(profile, edge, edges) for profile in profiles) for edge in new]
        if np.mean(there) >= MOST:
            most = count
    return most


def _is_seam(profile: np.ndarray, edge: int, edges: Iterable[int]) -> bool:
    """Whether lines on both sides of an edge differ by more than anywhere else, and most at the edge itself."""
    gaps = np.diff([0, *edges, len(profile)])
    reach = min(REACH, int(gaps.min()) // 4)
    if reach < LEAST_REACH:
        return False
    sums = np.concatenate([[0.0], np.cumsum(profile)])
    at = np.arange(reach, len(profile) - reach + 1)
    steps = (sums[at + reach] - 2 * sums[at] + sums[at - reach]) / reach
    elsewhere = steps[np.all([np.abs(at - one) > reach for one in edges], axis=0)]
    if len(elsewhere) < FEWEST_PLACES:
        return False
    middle = float(np.median(elsewhere))
    typical = robust_sigma(elsewhere - middle)
    here = np.abs(steps - middle)
    near = np.abs(at - edge) <= reach
    return bool(here[at == edge][0] > SEAM * typical and np.abs(at[near][here[near].argmax()] - edge) <= 1)


def _gains(found: Survey, bounds: Sequence[Bounds], at_rest: Moments) -> tuple[np.ndarray, np.ndarray]:
    """Gains of blocks relative to their mean, by the variance that signal adds, and errors; weighted means.

    Light need not be even within a block: each pixel's variance is taken over the one that its own signal lets expect.

    at_rest: moments of the blocks in the shortest darks.
    """
    ratios, errors = [], []
    level, rest, chance = at_rest
    dark = None if found.shortest is None else _map(found.shortest, "level_dn")
    for group in found.groups:
        if group.n_frames < 2 or group is found.shortest:
            continue
        brighter, noisier, _ = _moments(group, bounds)
        if (brighter <= level).any() or brighter.max() > FILLED * found.full_scale_dn:
            continue
        if (noisier - rest).mean() > LEAST_SIGNAL * rest.mean():
            signal, variance = _map(group, "level_dn") - dark, _map(group, "pair_variance_dn2")
            mean = float(np.mean((noisier - rest) / (brighter - level)))
            of = [
                [
                    _against(signal[rows, columns], variance[rows, columns], mean, at, group.n_frames)
                    for columns, at in zip(bounds[1], of_row, strict=True)
                ]
                for rows, of_row in zip(bounds[0], rest, strict=True)
            ]
            ratio, error = np.moveaxis(np.array(of), 2, 0)
            ratios.append(ratio / ratio.mean())
            errors.append(np.hypot(error, chance / (mean * (brighter - level))))
    if not ratios:
        return np.full_like(level, np.nan), np.full_like(level, np.nan)
    weight = np.array(errors) ** -2.0
    return (weight * ratios).sum(0) / weight.sum(0), weight.sum(0) ** -0.5


def _against(signal: np.ndarray, variance: np.ndarray, gain: float, rest: float, frames: int) -> tuple[float, float]:
    """Gain of the pixels of a block over `gain`, and its error; `rest`: their variance without signal, DN^2."""
    lit = signal > LEAST_LIT * float(np.median(signal))  # covered pixels tell nothing of gains
    expected = rest + gain * np.maximum(signal[lit], 0.0)
    ratio, error = without_outliers(variance[lit] / expected, frames)
    share = float(np.mean(gain * signal[lit] / expected))
    return 1 + (ratio - 1) / share, error / share


def _moments(group: Group, bounds: Sequence[Bounds]) -> Moments:
    """Level of the typical pixel, mean variance without outliers, and its error, of each block."""
    variance = _map(group, "pair_variance_dn2")
    both = [
        [without_outliers(variance[rows, columns].ravel(), group.n_frames) for columns in bounds[1]]
        for rows in bounds[0]
    ]
    level = _map(group, "level_dn")
    typical = [[float(np.median(level[rows, columns])) for columns in bounds[1]] for rows in bounds[0]]
    return np.array(typical), *np.moveaxis(np.array(both), 2, 0)
