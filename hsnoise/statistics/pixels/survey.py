"""One pass over a stack: the noise decomposition of each exposure and colour, and halves of its sampled pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from hsnoise._core.robust import robust_sigma
from hsnoise._core.types import cfa_tile
from hsnoise.frames.stack import FrameStack
from hsnoise.statistics.decomposition import Component, PlaneSums, of_neighbouring_rows, with_tails
from hsnoise.statistics.narrow_noise import narrow_read_noise
from hsnoise.statistics.pixels.along_rows import Along, along_rows, neighbours_share
from hsnoise.statistics.pixels.banding import Banding, banding_of
from hsnoise.statistics.pixels.comb import Comb, Histogram, comb_of, histogram_of
from hsnoise.statistics.pixels.look import Look, OddLines
from hsnoise.statistics.pixels.narrow import NARROW_DN, NarrowLaw, narrow_law, usual_dn
from hsnoise.statistics.pixels.register import Register, register_of
from hsnoise.statistics.pixels.row_groups import RowGroups, row_groups_of, shortest_repeated
from hsnoise.statistics.pixels.sample import CORE_SIGMAS, Halves, halves_of, sampled_rows
from hsnoise.statistics.pixels.settling import Settling, settling_of
from hsnoise.statistics.pixels.tilt import Tilt, tilt_of
from hsnoise.statistics.pixels.waves import Spectrum, Wave, spectrum_of, waves_of

NOISY_DN = 0.5  # temporal deviation above which a pixel that never changes is stuck
FEWEST_STILL = 4  # frames
MOST_CODES = 100_000  # counts of a frame that tell the step of its codes
COLUMN_BLOCKS = 16  # the most outputs side by side that are looked for
FEWEST_LINES = 16  # rows and columns of a plane whose counts tell how its pixels are distributed
NARROW_DN2 = 0.25  # temporal variance below which rounding does not add 1/12 DN^2


@dataclass(frozen=True)
class Plane:
    """One colour plane of one exposure: its channel, means, components, and sampled pixels.

    rows_together, columns_together: covariance of a line with the next, and with the next but one, in a frame.
    rows_error_dn2: standard error of the variance of rows over frames by how it differs from frame to frame, where that
    exceeds the error for independent rows: slow noise, bands, and noise that is stronger in some frames.
    banding: by axis, a sinusoid over rows or columns that moves from frame to frame; of mono frames alone, as lines of
    every second row do not tell its frequency.
    tilts: by axis, how rows or columns are tilted from frame to frame, of several frames.
    single_dn: sampled pixels of an exposure of one frame [pixel], DN; None of several.
    blocks_dn: mean change of blocks of the frame [frame, half of the rows, sixteenth of the columns] from the mean of
        the frames, DN; of the shortest repeated darks alone.
    neighbours_share: correlation of the temporal noise of neighbours in a row; NaN with one frame.
    narrow_dn: estimate and upper bound of noise narrower than a count, DN; None for wider noise.
    narrow_law: how such pixels are distributed; looked for in the darks of most frames alone.
    """

    channel: int
    row_mean_dn: np.ndarray
    column_mean_dn: np.ndarray
    frame_means_dn: np.ndarray
    components: dict[str, Component]
    rows_together: tuple[Component, Component]
    columns_together: tuple[Component, Component]
    rows_error_dn2: float
    banding: dict[str, Banding]
    tilts: dict[str, Tilt]
    halves: Halves | None
    single_dn: np.ndarray | None
    blocks_dn: np.ndarray | None
    neighbours_share: float
    narrow_dn: tuple[float, float] | None
    narrow_law: NarrowLaw | None


@dataclass(frozen=True)
class Group:
    """One exposure: its conditions, shares of clipped and saturated counts [channel], and planes.

    along: what pixels share of their temporal noise along rows; None if the frames do not show it.
    row_groups: rows that are read together; looked for in the shortest repeated darks, None if they do not show any.
    register: of an EMCCD, of darks that show one.
    spectrum: of what changes between darks in two directions; None of one frame, and of flats.
    codes: how often the central codes occur; None where they are too few to tell their widths.
    files: names of the frames' files; empty for arrays.
    """

    exposure_s: float
    kind: str
    n_frames: int
    clipped_share: np.ndarray
    saturated_share: np.ndarray
    odd_lines: OddLines
    planes: tuple[Plane, ...]
    along: Along | None
    row_groups: RowGroups | None
    register: Register | None
    spectrum: Spectrum | None
    codes: Histogram | None
    files: tuple[str, ...]

    def of(self, channel: int) -> list[Plane]:
        """The planes of one channel."""
        return [plane for plane in self.planes if plane.channel == channel]

    def pixels(self, channel: int, name: str) -> np.ndarray:
        """An attribute of `Halves` of all sampled pixels of a channel, [half, pixel] or [pixel]."""
        return np.concatenate([getattr(plane.halves, name) for plane in self.of(channel)], axis=-1)

    def mean_dn(self, channel: int) -> float:
        """Mean count of a channel, DN."""
        return float(np.mean([plane.row_mean_dn.mean() for plane in self.of(channel)]))

    def level_error_dn(self, channel: int) -> float:
        """Standard error of a channel's level by how its frames differ, DN; 0 of one frame."""
        frames = np.mean([plane.frame_means_dn for plane in self.of(channel)], axis=0)
        return float(frames.std(ddof=1) / np.sqrt(self.n_frames)) if self.n_frames > 1 else 0.0

    def rows_error_dn2(self, channel: int) -> float:
        """Standard error of the variance of rows over frames; rows of a channel's planes are independent."""
        planes = self.of(channel)
        return float(np.mean([plane.rows_error_dn2 for plane in planes]) / np.sqrt(len(planes)))

    @property
    def noise_dn(self) -> float:
        """Temporal noise of the typical pixel, from two or more frames; 0 where rounding hides it."""
        variance = np.concatenate([plane.halves.pair_variance_dn2 for plane in self.planes if plane.halves is not None])
        return float(np.sqrt(max(float(np.median(variance)), 0.0)))


@dataclass(frozen=True)
class Survey:
    """The result of one pass over a stack: its groups, the rows [row] of the sampled pixels, and the shape.

    origin: numbers of the frames' first row and column on the sensor. is_whole: whether the frames are not known to be
    a part of a sensor's. code_step: the largest number of which all counts are multiples, DN: 16 of 12 bits that are
    shifted into 16.
    """

    groups: tuple[Group, ...]
    channels: tuple[str, ...]
    cfa: str
    sampled_rows: np.ndarray
    shape: tuple[int, int]
    origin: tuple[int, int]
    full_scale_dn: float
    is_whole: bool
    code_step: int

    def stuck(self, channel: int) -> np.ndarray:
        """Sampled pixels of a channel [pixel] with the same count in all frames of the noisy groups."""
        several = [g for g in self.groups if g.n_frames > 1]
        still = [g.pixels(channel, "lowest") == g.pixels(channel, "highest") for g in several]
        noisy = [bool(np.median(g.pixels(channel, "pair_variance_dn2")) > NOISY_DN**2) for g in several]
        frames = np.sum([g.of(channel)[0].halves.n_frames for g, loud in zip(several, noisy, strict=True) if loud])
        if frames < FEWEST_STILL:  # so few may agree by chance
            return np.zeros(len(still[0]) if still else 0, bool)
        return np.all([s for s, loud in zip(still, noisy, strict=True) if loud], axis=0)

    @property
    def darks(self) -> tuple[Group, ...]:
        return tuple(group for group in self.groups if group.kind == "dark")

    @property
    def repeated_darks(self) -> tuple[Group, ...]:
        """The dark exposures of two or more frames: only these separate static from temporal."""
        return tuple(group for group in self.darks if group.n_frames > 1)

    @property
    def repeated_flats(self) -> tuple[Group, ...]:
        """The levels of light of two or more frames."""
        return tuple(group for group in self.groups if group.kind == "flat" and group.n_frames > 1)

    @property
    def along(self) -> list[Along]:
        """What pixels share along rows, of the groups that show it."""
        return [group.along for group in self.groups if group.along is not None]

    @property
    def row_groups(self) -> RowGroups | None:
        """Rows that are read together, of the shortest darks."""
        return None if self.shortest is None else self.shortest.row_groups

    @cached_property
    def waves(self) -> tuple[Wave, ...]:
        """The waves that cross the darks obliquely, the strongest first."""
        return waves_of([group.spectrum for group in self.darks if group.spectrum is not None])

    @cached_property
    def comb(self) -> Comb | None:
        """The pattern of the widths of codes, if all exposures share one."""
        return comb_of([group.codes for group in self.groups if group.codes is not None])

    @cached_property
    def settling(self) -> Settling | None:
        """The course of the black level over the frames, if all repeated darks have the same."""
        groups = self.repeated_darks
        runs = [np.mean([plane.frame_means_dn for plane in group.planes], axis=0) for group in groups]
        return settling_of(runs, is_bias=all(group.exposure_s == 0 for group in groups))

    @property
    def has_exposures(self) -> bool:
        """Whether `repeated_darks` are of several exposures."""
        return len({group.exposure_s for group in self.repeated_darks}) > 1

    @property
    def shortest(self) -> Group | None:
        """The shortest of `repeated_darks`; None without any."""
        return min(self.repeated_darks, key=lambda group: group.exposure_s, default=None)

    @property
    def longest(self) -> Group | None:
        """The longest of `repeated_darks`; None without any."""
        return max(self.repeated_darks, key=lambda group: group.exposure_s, default=None)


def survey(stack: FrameStack, tick: Callable[[], object] = lambda: None) -> Survey:
    """Read every frame of `stack` once; `tick` is called after each.

    Raises ValueError for frames that cannot be measured, as `FrameStack.check_frame` does.
    """
    cell = len(cfa_tile(stack.cfa))
    rows = sampled_rows(stack.shape, cell, stack.n_exposures, max(stack.n_frames))
    highest = 0
    groups, steps, looked_at = [], [], (shortest_repeated(stack), _of_most_frames(stack))
    for i in range(stack.n_exposures):
        group, top, step = _group(stack, i, rows, tick, *(i == of for of in looked_at))
        groups.append(group)
        steps.append(step)
        highest = max(highest, top)
    full = float(stack.white_level) if stack.white_level is not None else _full_scale(highest)
    is_whole = stack.window is None or tuple(stack.window[2:]) == stack.shape
    step = int(np.gcd.reduce(steps))
    origin = (0, 0) if stack.window is None else (stack.window[0], stack.window[1])
    return Survey(tuple(groups), stack.channels, stack.cfa, rows, stack.shape, origin, full, is_whole, step)


def _full_scale(highest: int) -> float:
    """The highest code: that of a converter of 8, 10, 12 or 14 bits if counts reach it, else of 16 or more."""
    if highest in (2**b - 1 for b in (8, 10, 12, 14)):
        return float(highest)
    return float(max(2**16 - 1, highest))


def _group(
    stack: FrameStack,
    i: int,
    rows: np.ndarray,
    tick: Callable[[], object],
    looks_for_row_groups: bool,
    looks_at_counts: bool,
) -> tuple[Group, int, int]:
    """A group, its highest count, and the largest number of which the counts of its first frame are multiples."""
    tile, n = cfa_tile(stack.cfa), stack.n_frames[i]
    step = len(tile)
    look = Look(
        stack.cfa, stack.shape, rows, stack.white_level, looks_for_row_groups, looks_for_waves=stack.kind[i] == "dark"
    )
    seen = stack.fold_frames(i, look.start, look.add, look.merge, tick)
    assert seen.odd is not None  # FrameStack has no empty groups
    kept, pixels = np.stack(seen.kept), n * np.bincount(tile.ravel()) * seen.sums[0].pixel.size
    seen.kept.clear()  # it is there twice
    half = int(np.searchsorted(rows[::step], stack.shape[0] / 2)) if looks_for_row_groups else None
    planes = tuple(
        _plane(seen.sums[p], kept[:, p // step :: step, p % step :: step], tile.ravel()[p], step, half, looks_at_counts)
        for p in range(step**2)
    )
    conditions = float(stack.exposure_s[i]), stack.kind[i], n
    first_row = 0 if stack.window is None else stack.window[0]
    banding, means = planes[0].banding.get("row"), seen.row_means
    groups = row_groups_of(np.stack(means), first_row, banding) if means else None
    spectrum = spectrum_of(seen.middles, step)
    of_frames = (
        along_rows(kept, step, rows, waves_of([] if spectrum is None else [spectrum])),
        groups,
        register_of(kept) if step == 1 and stack.kind[i] == "dark" else None,
        spectrum,
        histogram_of(kept, np.inf if stack.white_level is None else stack.white_level),
        tuple(Path(name).name for name in getattr(stack.counts[i], "names", ())),
    )
    of_codes = int(np.gcd.reduce(kept[0].ravel()[:: max(1, kept[0].size // MOST_CODES)].astype(np.int64)))
    shares = seen.clipped / pixels, seen.saturated / pixels
    return Group(*conditions, *shares, seen.odd, planes, *of_frames), seen.highest, of_codes


def _plane(
    sums: PlaneSums, counts: np.ndarray, channel: int, step: int, half: int | None, looks_at_counts: bool
) -> Plane:
    """half: sampled rows of the plane in the first half of the frame; None where blocks are not looked at."""
    n, (h, w) = sums.n_frames, sums.shape
    halves = halves_of(counts) if n > 1 else None
    row_frame, column_frame = np.stack(sums.rows) / w, np.stack(sums.columns) / h
    reference, components = float(sums.reference or 0), _components(sums, halves)
    narrow = _narrow(counts, halves)
    return Plane(
        channel=int(channel),
        row_mean_dn=row_frame.mean(0) + reference,
        column_mean_dn=column_frame.mean(0) + reference,
        frame_means_dn=sums.frame_means_dn,
        components=components,
        rows_together=(of_neighbouring_rows(row_frame), of_neighbouring_rows(row_frame, 2)),
        columns_together=(of_neighbouring_rows(column_frame), of_neighbouring_rows(column_frame, 2)),
        rows_error_dn2=max(components["row_x_frame"].standard_error_dn2, _by_frames(row_frame)),
        banding={} if step > 1 else _banding(row_frame, column_frame),
        tilts=_tilts(row_frame, column_frame),
        halves=halves,
        single_dn=counts[0].ravel().astype(np.float32) if n == 1 else None,
        blocks_dn=None if half is None or n == 1 else _blocks(counts, half),
        neighbours_share=neighbours_share(counts),
        narrow_dn=narrow,
        narrow_law=_law(narrow, counts) if looks_at_counts else None,
    )


def _blocks(counts: np.ndarray, half: int) -> np.ndarray | None:
    """Mean change of blocks of each frame [frame, half of the rows, sixteenth of the columns], outliers cut, DN."""
    _, rows, columns = counts.shape
    edges = [columns * of // COLUMN_BLOCKS for of in range(COLUMN_BLOCKS)]
    if not 0 < half < rows or columns < COLUMN_BLOCKS:
        return None
    mean, blocks = counts.mean(0, dtype=np.float32), []
    for frame in counts:
        change = frame - mean
        middle = float(np.median(change))
        width = CORE_SIGMAS * robust_sigma(change - middle)
        cut = np.clip(change, middle - width, middle + width)
        of_columns = np.stack([part.mean(0) for part in np.split(cut, [half])])
        sizes = np.diff([*edges, columns])
        blocks.append(np.add.reduceat(of_columns, edges, axis=1) / sizes)
    return np.stack(blocks)


def _by_frames(row_frame: np.ndarray) -> float:
    """Error of the variance of rows [frame, row] over frames, by its scatter over frames; 0 of fewer than 3."""
    n = len(row_frame)
    if n < 3:
        return 0.0
    of_frames = (row_frame - row_frame.mean(0)).var(1) * n / (n - 1)
    return float(of_frames.std(ddof=1) / np.sqrt(n))


def _banding(row_frame: np.ndarray, column_frame: np.ndarray) -> dict[str, Banding]:
    found = {"row": banding_of(row_frame), "column": banding_of(column_frame)}
    return {axis: one for axis, one in found.items() if one is not None}


def _tilts(row_frame: np.ndarray, column_frame: np.ndarray) -> dict[str, Tilt]:
    found = {"row": tilt_of(row_frame), "column": tilt_of(column_frame)}
    return {axis: one for axis, one in found.items() if one is not None}


def _components(sums: PlaneSums, halves: Halves | None) -> dict[str, Component]:
    if halves is None:
        return sums.components()
    level = halves.level_dn.mean(0, dtype=np.float64).reshape(-1, sums.shape[1])
    return with_tails(sums.components(), level, halves.pair_variance_dn2, sums.shape)


def _of_most_frames(stack: FrameStack) -> int | None:
    """The repeated darks of most frames, the shortest of several."""
    darks = [i for i, kind in enumerate(stack.kind) if kind == "dark" and stack.n_frames[i] > 1]
    return min(darks, key=lambda i: (-stack.n_frames[i], stack.exposure_s[i]), default=None)


def _law(narrow: tuple[float, float] | None, counts: np.ndarray) -> NarrowLaw | None:
    is_narrow = narrow is not None and usual_dn(narrow) < NARROW_DN
    return narrow_law(counts) if is_narrow and min(counts.shape[1:]) >= FEWEST_LINES else None


def _narrow(counts: np.ndarray, halves: Halves | None) -> tuple[float, float] | None:
    """Estimate and upper bound of noise narrower than a count, DN; None for wider noise."""
    if halves is None or not 0 < float(halves.pair_variance_dn2.mean()) < NARROW_DN2:
        return None
    return narrow_read_noise(counts)
