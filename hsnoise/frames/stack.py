"""`FrameStack`: captured raw frames and what is known about them, validated once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hsnoise._core.arguments import listed, one_of, positive, span, whole_number, window_of
from hsnoise._core.data_frames import data_frame
from hsnoise._core.types import BAYER_CFAS, SHUTTERS, StatedGain, Window, channels_of
from hsnoise.frames.arguments import (
    check_sizes,
    exposure_groups,
    exposures,
    kinds,
    levels,
    overscan,
    photons,
    sentences,
    stated,
    temperatures,
)
from hsnoise.frames.bayer import shift_cfa, transpose_cfa
from hsnoise.frames.checks import check_black_level
from hsnoise.frames.describing import COLUMNS, as_html, described, groups_of
from hsnoise.frames.joining import joined, replaced
from hsnoise.frames.lazy import crop, read_mapped
from hsnoise.frames.passes import Kept, fold_frames, map_frames, whole_frames
from hsnoise.frames.reading import check_frame, frame_name, in_sensor_orientation, while_reading


@dataclass(frozen=True, init=False, repr=False, eq=False)
class FrameStack:
    """Raw frames of one camera at one gain setting: dark frames, flat frames, or both.

    Args:
        counts: DN; one array `[frame, row, column]` or `[exposure, frame, row, column]`, or a list of
            `[frame, row, column]` arrays, one per exposure (frame numbers may differ). NumPy, JAX, or anything
            lazy with `.shape`, `.dtype` and an index along the first axis (memory map, Dask, HDF5 data set).
            Arrays in memory are checked now, lazy arrays frame by frame as they are read.
        exposure_s: exposure time of each exposure group, s. A bias frame is a dark frame of 0 s.
        black_level: DN, one value or one per channel; None: to be estimated.
        white_level: DN at which the sensor saturates; None: unknown.
        cfa: "mono" (or None), or the Bayer order from the first stored pixel on.
        shutter: "rolling" or "global".
        kind: "dark" or "flat", one for all or one per group.
        photons_e: expected photoelectrons per pixel, one per flat group (or one per group, NaN for darks); NaN or
            None: unknown.
        temperature_c: sensor temperature, degrees Celsius, one for all or one per group (NaN: unknown).
        iso: ISO speed of all frames.
        row_axis: axis of a stored frame that counts sensor rows: 0, or 1 for frames stored in portrait.
        window: (first row, first column, rows, columns): the first two are where the frames lie on the sensor, the
            last two the sensor's size. Effects that depend on the place (glow, taps) need it if the frames are a crop.
            None: the frames are the whole sensor.
        stated_gain: the gain that the files' headers state; None: they state none.
        overscan_dn: DN, mean of each group's overscan pixels, which are not in `counts` (NaN or None: unknown).
        elsewhere: flats of the same sensor at the same gain, of another crop or size; only their photon transfer, which
            needs no positions, can be used. None: there are none.
        assumed: sentences about what was assumed or set aside when the frames were loaded.

    Attributes are the checked arguments in one form: `counts` is a tuple of arrays (as stored); `exposure_s`,
    `photons_e`, `temperature_c` and `overscan_dn` are arrays `[exposure]`, the last three None if nothing is known;
    `black_level` is None, a float or an array `[channel]`; `kind` is a tuple. `cfa` and `shape` are in sensor
    orientation, like `frames`.

    Raises:
        TypeError: counts are not numbers.
        ValueError: an impossible value or size; the message names the argument.
    """

    counts: tuple[Any, ...]
    exposure_s: np.ndarray
    black_level: float | np.ndarray | None
    white_level: float | None
    cfa: str
    shutter: str
    kind: tuple[str, ...]
    photons_e: np.ndarray | None
    temperature_c: np.ndarray | None
    iso: float | None
    row_axis: int
    window: Window | None
    stated_gain: StatedGain | None
    overscan_dn: np.ndarray | None
    elsewhere: FrameStack | None
    assumed: tuple[str, ...]

    def __init__(
        self,
        counts: Any,
        exposure_s: Any = None,
        *,
        black_level: Any = None,
        white_level: float | None = None,
        cfa: str | None = "mono",
        shutter: str = "rolling",
        kind: str | Sequence[str] = "dark",
        photons_e: Any = None,
        temperature_c: Any = None,
        iso: float | None = None,
        row_axis: int = 0,
        window: Window | None = None,
        stated_gain: StatedGain | None = None,
        overscan_dn: Any = None,
        elsewhere: FrameStack | None = None,
        assumed: Sequence[str] = (),
    ):
        groups = exposure_groups(counts)
        row_axis = one_of("row_axis", row_axis, (0, 1))
        cfa = one_of("cfa", "mono" if cfa is None else cfa, ("mono", *BAYER_CFAS))
        check_sizes(groups, cfa)
        kind = kinds(kind, len(groups))
        black_level, white_level = levels(black_level, white_level, channels_of(cfa))
        fields = {
            "counts": groups,
            "exposure_s": exposures(exposure_s, len(groups)),
            "black_level": black_level,
            "white_level": white_level,
            "cfa": transpose_cfa(cfa) if row_axis == 1 else cfa,
            "shutter": one_of("shutter", shutter, SHUTTERS),
            "kind": kind,
            "photons_e": photons(photons_e, kind),
            "temperature_c": temperatures(temperature_c, len(groups)),
            "iso": None if iso is None else positive("iso", iso),
            "row_axis": row_axis,
            "window": window_of(window, groups[0].shape[1:] if row_axis == 0 else groups[0].shape[:0:-1]),
            "stated_gain": stated(stated_gain),
            "overscan_dn": overscan(overscan_dn, len(groups)),
            "elsewhere": _flats_elsewhere(elsewhere, cfa),
            "assumed": sentences(assumed),
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        in_memory = [i for i in range(len(groups)) if not self.is_lazy(i)]
        for i in in_memory:
            for j, frame in enumerate(groups[i]):
                check_frame(frame, self, exposure=i, frame_number=j)
        if len(in_memory) == len(groups):
            self.check()

    @property
    def n_exposures(self) -> int:
        return len(self.counts)

    @property
    def n_frames(self) -> tuple[int, ...]:
        return tuple(int(counts.shape[0]) for counts in self.counts)

    @property
    def repeated_darks(self) -> list[int]:
        """The dark exposures of two frames or more, which tell what changes from what stays."""
        kinds = zip(self.kind, self.n_frames, strict=True)
        return [i for i, (kind, frames) in enumerate(kinds) if kind == "dark" and frames > 1]

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of a frame in sensor orientation."""
        rows, columns = self.counts[0].shape[1:]
        return (columns, rows) if self.row_axis == 1 else (rows, columns)

    @property
    def channels(self) -> tuple[str, ...]:
        return channels_of(self.cfa)

    def is_lazy(self, exposure: int) -> bool:
        """Whether this group's pixels are read only on demand."""
        counts = self.counts[exposure]
        return not isinstance(counts, np.ndarray) or isinstance(counts, np.memmap)

    def frame(self, exposure: int, number: int) -> np.ndarray:
        """One frame `[row, column]` in sensor orientation, DN.

        Contiguous uint16, or int32 where the stored type is signed, floating or wider than 16 bits. A lazy
        frame is read now, and checked: see `check_frame`.
        """
        counts = self.counts[exposure]
        if isinstance(counts, np.memmap):
            frame = read_mapped(counts, number)
        else:
            with while_reading(frame_name(self, exposure, number)):
                frame = np.asarray(counts[number])
        if self.is_lazy(exposure):
            check_frame(frame, self, exposure=exposure, frame_number=number)
        return in_sensor_orientation(frame, self.row_axis)

    def frames(self, exposure: int) -> Iterator[np.ndarray]:
        """The frames of one exposure group in order, one in memory at a time (of a Dask array, some); see `frame`."""
        return whole_frames(self, exposure)

    def map_frames(
        self,
        exposure: int,
        function: Callable[[np.ndarray], Any],
        combine: Callable[[Any, Any], Any] | None = None,
        chosen: Sequence[int] | None = None,
    ) -> Iterator[Any]:
        """`function` of each frame of one exposure group, or of the `chosen` ones, in order.

        Frames of a Dask array are read, checked and reduced where its scheduler runs, such as on a cluster's workers;
        results come back, some as one if `combine` adds two up. Lost tasks run again; RuntimeError if all workers are.
        """
        return map_frames(self, exposure, function, combine, chosen)

    def fold_frames(
        self,
        exposure: int,
        start: Callable[[], Kept],
        add: Callable[[Kept, np.ndarray, int], Kept],
        merge: Callable[[Kept, Kept], Kept],
        tick: Callable[[], object] = lambda: None,
    ) -> Kept:
        """One total of all frames of an exposure group: `add(total, frame, number)` for each in order, from `start()`.

        Frames of a Dask array have totals of their own where they are read, and `merge`, which changes neither of its
        arguments, adds up those of earlier and later frames. `tick` is called for each frame.
        """
        return fold_frames(self, exposure, start, add, merge, tick)

    def with_counts(self, counts: Sequence[np.ndarray], window: Window | None) -> FrameStack:
        """A stack of other `counts`, one array per exposure in sensor orientation, taken under the same conditions.

        Flats elsewhere on the sensor are left out: they are no such counts. Values are not checked: what would mean a
        broken file may be a valid draw of a quiet camera.
        """
        unknown = dict.fromkeys(("black_level", "photons_e", "temperature_c", "iso", "elsewhere")) | {"row_axis": 0}
        stack = object.__new__(FrameStack)
        for name in self.__dataclass_fields__:
            object.__setattr__(stack, name, unknown.get(name, getattr(self, name)))
        object.__setattr__(stack, "counts", tuple(counts))
        object.__setattr__(stack, "window", window)
        return stack

    def check(self) -> None:
        """Read the first frame of each exposure and check its values and the black level; call it before long work.

        Raises:
            ValueError: see `check_frame`; also a black level above the data.
        """
        first = [self.frame(i, 0) for i in range(self.n_exposures)]
        check_black_level(first, self.black_level, self.cfa)

    def select(
        self,
        *,
        rows: Any = None,
        columns: Any = None,
        frames: slice | Sequence[slice] | None = None,
        exposures: Sequence[int] | None = None,
    ) -> FrameStack:
        """Part of the stack; nothing is copied or read.

        Args:
            rows, columns: (start, stop) or a slice of step 1, in sensor coordinates; None: all. Odd starts are
                allowed: `cfa` is rotated so that it still names the first pixel.
            frames: slice of the frames of every exposure, or a list of slices, one for each selected exposure.
            exposures: indices of exposure groups.

        Raises:
            ValueError: a region that is empty, outside the frames or of odd side on a Bayer sensor; slices for another
                number of exposures.
        """
        rows, columns = span("rows", rows, self.shape[0]), span("columns", columns, self.shape[1])
        groups = np.arange(self.n_exposures) if exposures is None else self._groups(exposures)
        region = (columns, rows) if self.row_axis == 1 else (rows, columns)
        of_each = [frames] * len(groups) if frames is None or isinstance(frames, slice) else list(frames)
        if len(of_each) != len(groups):
            raise ValueError(f"frames: expected a slice for each of {len(groups)} exposures, got {len(of_each)}")
        cfa = shift_cfa(self.cfa, rows.start, columns.start)
        changes: dict[str, Any] = {
            "counts": [crop(self.counts[i], *region, frames=some) for i, some in zip(groups, of_each, strict=True)],
            "cfa": transpose_cfa(cfa) if self.row_axis == 1 else cfa,
            "exposure_s": self.exposure_s[groups],
            "kind": [self.kind[i] for i in groups],
            "photons_e": None if self.photons_e is None else self.photons_e[groups],
            "temperature_c": None if self.temperature_c is None else self.temperature_c[groups],
            "overscan_dn": None if self.overscan_dn is None else self.overscan_dn[groups],
        }
        if self.window is not None:
            row, column, *sensor = self.window
            changes["window"] = (row + rows.start, column + columns.start, *sensor)
        return replaced(self, **changes)

    def _groups(self, exposures: Any) -> np.ndarray:
        """Indices of exposure groups. Raises TypeError unless they are a list, ValueError for indices out of range."""
        given = listed("exposures", exposures, "a list of indices of exposures")
        groups = np.array([whole_number("exposures", i) for i in given], int)
        if not groups.size or groups.min() < -self.n_exposures or groups.max() >= self.n_exposures:
            raise ValueError(f"exposures: expected indices from 0 to {self.n_exposures - 1}, got {exposures}")
        return groups

    @staticmethod
    def join(*stacks: FrameStack) -> FrameStack:
        """Several stacks of one camera (darks and flats, say) joined into one, exposures in the order given.

        Flats of another crop or size than the darks become `elsewhere`.

        Raises:
            ValueError: they differ in anything but exposures, kinds, frames and temperatures, or darks differ in size.
        """
        return joined(stacks)

    def _arguments(self) -> dict[str, Any]:
        arguments = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return {**arguments, "cfa": transpose_cfa(self.cfa) if self.row_axis == 1 else self.cfa}

    def to_pandas(self) -> Any:
        """The exposure groups as a pandas DataFrame: kind, exposure_s, frames, photons_e, temperature_c, overscan_dn,
        NaN where unknown (needs `hsnoise[pandas]`).

        Raises ImportError without pandas.
        """
        return data_frame(self, COLUMNS, groups_of(self))

    def __repr__(self) -> str:
        return described(self)

    def _repr_html_(self) -> str:
        return as_html(self)


def _flats_elsewhere(elsewhere: Any, cfa: str) -> FrameStack | None:
    if elsewhere is None:
        return None
    if not isinstance(elsewhere, FrameStack):
        raise TypeError(f"elsewhere: expected a FrameStack of flats, got {type(elsewhere).__name__}")
    if "dark" in elsewhere.kind or elsewhere.elsewhere is not None or elsewhere.channels != channels_of(cfa):
        raise ValueError(
            f"elsewhere: expected flats alone, with the channels {channels_of(cfa)}, got kinds {elsewhere.kind} and"
            f" channels {elsewhere.channels}{' and more elsewhere' if elsewhere.elsewhere is not None else ''}"
        )
    return elsewhere
