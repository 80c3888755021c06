"""Captured raw frames with what is known about them, validated once: `FrameStack`."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np

from hsnoise._arguments import (
    check_sizes,
    exposure_groups,
    exposures,
    kinds,
    levels,
    listed,
    one_of,
    photons,
    positive,
    span,
    temperatures,
    whole_number,
    window_of,
)
from hsnoise._frames import LazyFrames, check_black_level, check_values, crop, read_mapped, shift_cfa, transpose_cfa
from hsnoise._types import BAYER_CFAS, SHUTTERS, Window, channels_of

BATCH = 64  # frames of a Dask array that are handed to its scheduler at a time


@dataclass(frozen=True, init=False, repr=False, eq=False)
class FrameStack:
    """Raw frames of one camera at one gain setting: dark frames, flat frames, or both.

    Args:
        counts: DN; one array `[frame, row, column]` or `[exposure, frame, row, column]`, or a list of
            `[frame, row, column]` arrays, one an exposure (frame numbers may differ). NumPy, JAX, or anything
            lazy with `.shape`, `.dtype` and an index along the first axis (memory map, Dask, HDF5 data set).
            Arrays in memory are checked now, lazy ones frame by frame as they are read.
        exposure_s: exposure time of each exposure group, s. A bias frame is a dark frame of 0 s.
        black_level: DN, one value or one a channel; None: to be estimated.
        white_level: DN at which the sensor saturates; None: unknown.
        cfa: "mono" (or None), or the Bayer order from the first stored pixel on.
        shutter: "rolling" or "global".
        kind: "dark" or "flat", one for all or one a group.
        photons_e: expected photoelectrons per pixel, one a flat group (or one a group, NaN for darks); NaN or
            None: unknown.
        temperature_c: sensor temperature, degrees Celsius, one for all or one a group (NaN: unknown).
        iso: ISO speed of all frames.
        row_axis: axis of a stored frame that counts sensor rows: 0, or 1 for frames stored in portrait.
        window: (first row, first column, rows, columns) of the whole sensor where the frames are a part of it and
            effects that depend on the place (glow, taps) are to be told in its coordinates; None: they are all of it.

    Attributes are the arguments, checked and brought to one shape: `counts` a tuple of arrays (as stored);
    `exposure_s`, `photons_e` and `temperature_c` arrays `[exposure]`, the last two None if nothing is known;
    `black_level` None, a float or an array `[channel]`; `kind` a tuple. `cfa` and `shape` are in sensor
    orientation, that of `frames`.

    Raises:
        TypeError: counts are not numbers.
        ValueError: any value or size that cannot be right; the message names the argument.
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
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of a frame in sensor orientation."""
        rows, columns = self.counts[0].shape[1:]
        return (columns, rows) if self.row_axis == 1 else (rows, columns)

    @property
    def channels(self) -> tuple[str, ...]:
        return channels_of(self.cfa)

    def is_lazy(self, exposure: int) -> bool:
        """Whether this group's pixels are read only when asked for."""
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
            with _while_reading(frame_name(self, exposure, number)):
                frame = np.asarray(counts[number])
        if self.is_lazy(exposure):
            check_frame(frame, self, exposure=exposure, frame_number=number)
        return in_sensor_orientation(frame, self.row_axis)

    def frames(self, exposure: int) -> Iterator[np.ndarray]:
        """The frames of one exposure group in order, one in memory at a time; see `frame`."""
        return (self.frame(exposure, number) for number in range(self.n_frames[exposure]))

    def map_frames(
        self,
        exposure: int,
        function: Callable[[np.ndarray], Any],
        combine: Callable[[Any, Any], Any] | None = None,
        chosen: Sequence[int] | None = None,
    ) -> Iterator[Any]:
        """`function` of each frame of one exposure group, or of those `chosen`, in order.

        Frames of a Dask array are read, checked and reduced where its scheduler runs, such as on a cluster's workers;
        results come back, some as one if `combine` adds two up. Lost tasks run again; RuntimeError if all workers are.
        """
        counts, chosen = self.counts[exposure], range(self.n_frames[exposure]) if chosen is None else chosen
        if not is_dask(counts):
            yield from (function(self.frame(exposure, number)) for number in chosen)
            return
        import dask  # only for those who hand over a Dask array

        for start in range(0, len(chosen), BATCH):
            numbers = chosen[start : start + BATCH]
            names = [frame_name(self, exposure, number) for number in numbers]
            tasks = [
                dask.delayed(_checked)(counts[number], name, self.white_level, self.row_axis, function)
                for number, name in zip(numbers, names, strict=True)
            ]
            while combine is not None and len(tasks) > 1:
                pairs = zip(tasks[::2], tasks[1::2], strict=False)
                tasks = [dask.delayed(combine)(*pair) for pair in pairs] + tasks[len(tasks) // 2 * 2 :]
            with _while_reading(names[0]):
                results = dask.compute(*tasks)
            yield from results

    def with_counts(self, counts: Sequence[np.ndarray], window: Window | None) -> FrameStack:
        """Other `counts`, an array an exposure in sensor orientation, as if they had been taken as this stack was.

        Their values are not checked: what would be a broken file may be a fair draw of a quiet camera.
        """
        unknown = {"black_level": None, "photons_e": None, "temperature_c": None, "iso": None, "row_axis": 0}
        stack = object.__new__(FrameStack)
        for name in self.__dataclass_fields__:
            object.__setattr__(stack, name, unknown.get(name, getattr(self, name)))
        object.__setattr__(stack, "counts", tuple(counts))
        object.__setattr__(stack, "window", window)
        return stack

    def check(self) -> None:
        """Read the first frame of each exposure, check its values and the black level; call before long work.

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
            rows, columns: (start, stop) or slice of step 1, in sensor coordinates; None: all. Odd starts are
                allowed: `cfa` is rotated so that it still names the first pixel.
            frames: slice of the frames of every exposure, or a list of slices, one for each that is selected.
            exposures: indices of exposure groups.

        Raises:
            ValueError: an empty or outside region, or one with an odd side on a Bayer sensor; slices for another
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
        }
        if self.window is not None:
            row, column, *sensor = self.window
            changes["window"] = (row + rows.start, column + columns.start, *sensor)
        return FrameStack(**{**self._arguments(), **changes})

    def _groups(self, exposures: Any) -> np.ndarray:
        """Indices of exposure groups. Raises TypeError for what is no list, ValueError for those that there are not."""
        given = listed("exposures", exposures, "a list of indices of exposures")
        groups = np.array([whole_number("exposures", i) for i in given], int)
        if not groups.size or groups.min() < -self.n_exposures or groups.max() >= self.n_exposures:
            raise ValueError(f"exposures: expected indices from 0 to {self.n_exposures - 1}, got {exposures}")
        return groups

    @staticmethod
    def join(*stacks: FrameStack) -> FrameStack:
        """The exposures of several stacks of one camera (darks and flats, say) in one, in the order given.

        Raises:
            ValueError: they differ in anything but exposures, kinds, frames and temperatures.
        """
        if not stacks:
            raise ValueError("join: expected at least one FrameStack, got none")
        first = stacks[0]
        for name in ("shape", "row_axis", "window", "cfa", "shutter", "black_level", "white_level", "iso"):
            for other in stacks[1:]:
                one, two = getattr(first, name), getattr(other, name)
                if not np.array_equal(one, two):
                    raise ValueError(f"join: the stacks differ in {name}: {one} and {two}")
        changes = {
            "counts": [counts for stack in stacks for counts in stack.counts],
            "exposure_s": np.concatenate([stack.exposure_s for stack in stacks]),
            "kind": [kind for stack in stacks for kind in stack.kind],
            "photons_e": _concatenate([stack.photons_e for stack in stacks], stacks),
            "temperature_c": _concatenate([stack.temperature_c for stack in stacks], stacks),
        }
        return FrameStack(**{**first._arguments(), **changes})

    def _arguments(self) -> dict[str, Any]:
        arguments = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return {**arguments, "cfa": transpose_cfa(self.cfa) if self.row_axis == 1 else self.cfa}

    def __repr__(self) -> str:
        rows, columns = self.shape
        black = "to be estimated" if self.black_level is None else f"{np.round(self.black_level, 3)} DN"
        white = "unknown" if self.white_level is None else f"{self.white_level:g} DN"
        lines = [
            f"FrameStack: {sum(self.n_frames)} frames of {rows} rows x {columns} columns, "
            f"{self.cfa}, {self.shutter} shutter" + ("" if self.iso is None else f", ISO {self.iso:g}"),
            f"  black level {black}, white level {white}",
        ]
        for i, (kind, exposure, n) in enumerate(zip(self.kind, self.exposure_s, self.n_frames, strict=True)):
            line = f"  {kind} {exposure:9.6g} s  {n} frame{'s' if n > 1 else ''}"
            if self.photons_e is not None and np.isfinite(self.photons_e[i]):
                line += f", {self.photons_e[i]:g} photoelectrons per pixel"
            if self.temperature_c is not None and np.isfinite(self.temperature_c[i]):
                line += f", {self.temperature_c[i]:.1f} degrees Celsius"
            lines.append(line)
        return "\n".join(lines)


def _concatenate(values: list[np.ndarray | None], stacks: Sequence[FrameStack]) -> np.ndarray:
    """Per-exposure values of several stacks in one array, NaN where unknown."""
    pairs = zip(values, stacks, strict=True)
    return np.concatenate([np.full(stack.n_exposures, np.nan) if v is None else v for v, stack in pairs])


def check_frame(frame: np.ndarray, stack: FrameStack, *, exposure: int, frame_number: int) -> None:
    """Check the values of one raw frame `[row, column]` of a stack, DN.

    `FrameStack.frame` and `frames` do so for every lazy frame they read, the constructor for every frame in
    memory.

    Raises:
        ValueError: values that are not finite, not integers, negative, all the same, or mostly at the white
            level; the message names the file (or the exposure) and the frame.
    """
    check_values(frame, white_level=stack.white_level, name=frame_name(stack, exposure, frame_number))


def frame_name(stack: FrameStack, exposure: int, number: int) -> str:
    """A frame as error messages call it: its file, or its place in the stack."""
    counts = stack.counts[exposure]
    if isinstance(counts, LazyFrames):
        return counts.names[number]
    return f"counts: frame {number} of {stack.kind[exposure]} exposure {exposure} ({stack.exposure_s[exposure]:g} s)"


def in_sensor_orientation(frame: np.ndarray, row_axis: int) -> np.ndarray:
    """Contiguous uint16, or int32 where the stored type is signed, floating or wider than 16 bits."""
    dtype = np.uint16 if frame.dtype.kind == "u" and frame.dtype.itemsize <= 2 else np.int32
    return np.ascontiguousarray(frame.T if row_axis == 1 else frame, dtype)


@contextmanager
def _while_reading(name: str) -> Iterator[None]:
    """Raise RuntimeError if the cluster is lost that computes frames, the first of them called `name`.

    Other errors pass, those of whoever reads the chunks, say, with a note of where it was.
    """
    try:
        yield
    except Exception as error:
        if type(error).__module__.partition(".")[0] != "distributed":  # which is imported only by those who use it
            error.add_note(f"while {name}, or a frame after it, was read")
            raise
        raise RuntimeError(
            f"{name}: the cluster was lost that this frame, or some after it, was read on ({type(error).__name__});"
            " start it again, and run this once more"
        ) from error


def is_dask(counts: Any) -> bool:
    return hasattr(counts, "__dask_graph__")


def _checked(frame: np.ndarray, name: str, white_level: float | None, row_axis: int, function: Callable) -> Any:
    check_values(frame, white_level=white_level, name=name)
    return function(in_sensor_orientation(frame, row_axis))


def as_stack(array_or_stack: Any, **keywords: Any) -> FrameStack:
    """A `FrameStack` as it is, or one made of a bare array with the keywords of `FrameStack`.

    Raises:
        TypeError: keywords beside a `FrameStack`, which holds them already, or that it does not know; or a path.
    """
    known = [name for name in inspect.signature(FrameStack).parameters if name != "counts"]
    unknown = [name for name in keywords if name not in known]
    if unknown:
        raise TypeError(f"{', '.join(unknown)}: expected keywords among {', '.join(known)}")
    if isinstance(array_or_stack, FrameStack):
        if keywords:
            raise TypeError(
                f"{', '.join(keywords)}: only go with a bare array of counts; a FrameStack holds them already"
            )
        return array_or_stack
    if isinstance(array_or_stack, str | PathLike):
        raise TypeError(
            f"expected a FrameStack or an array of counts, got the path {array_or_stack!r}; hsnoise.load reads files"
        )
    if not hasattr(array_or_stack, "__len__") and not hasattr(array_or_stack, "shape"):
        raise TypeError(f"stack: expected a FrameStack or an array of counts, got {type(array_or_stack).__name__}")
    return FrameStack(array_or_stack, **keywords)
