"""Read captures: camera raw, DNG, FITS, TIFF, PNG, NumPy and HDF5 files to a `FrameStack`."""

from __future__ import annotations

import glob
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from hsnoise._arguments import KINDS, numbers, one_of, span
from hsnoise._frames import crop, in_order, shift_cfa
from hsnoise.io._grouping import (
    RELATIVE_TOLERANCE,
    group_by_exposure,
    group_counts,
    group_exposure_s,
    group_temperature_c,
)
from hsnoise.io._recording import UNKNOWN_ORDER, Recording
from hsnoise.stack import FrameStack

_READERS = {
    "_raw": ".dng .cr2 .cr3 .nef .nrw .arw .srf .sr2 .raf .rw2 .orf .pef .srw .3fr .fff .iiq .mrw .erf .rwl",
    "_fits": ".fits .fit .fts .fits.gz .fit.gz .fits.fz",
    "_tiff": ".tif .tiff",
    "_png": ".png",
    "_numpy": ".npy .npz",
    "_hdf5": ".h5 .hdf5",
}
_LONG_READ = 16  # files from which on a progress bar is shown


def load(
    path: Any,
    *,
    exposure_s: Any = None,
    kind: str | Sequence[str] | None = None,
    cfa: str | None = None,
    black_level: Any = None,
    white_level: float | None = None,
    shutter: str | None = None,
    row_axis: int = 0,
    roi: tuple[Any, Any] | None = None,
    progress: bool = True,
) -> FrameStack:
    """Read a capture: dark frames, flat frames or both, of one camera at one gain setting.

    Only headers are read now; frames are read one at a time when the stack is iterated (.npz files are loaded
    whole). Frames of one kind whose exposures agree to 1e-3 form a group; darks first, short before long.
    What is given here overrides what the files say; a warning tells of exposures that differ.

    Args:
        path: a folder, a glob pattern, one file, or a list of files; all of one format. A folder's files are
            taken in natural order (frame2 before frame10), files of no known format are passed over.
        exposure_s: exposure time, s; one for all, or one a file (one an exposure for a file of several).
        kind: "dark" or "flat", likewise. None: what the files say, or "dark" if they say nothing.
        cfa: "mono" or the Bayer order of the first stored pixel. None: what the files say, or "mono".
        black_level, white_level: DN; black one value or one a channel. None: what the files say; if they say
            nothing, black is to be estimated and white unknown.
        shutter: "rolling" or "global". None: what the files say, or "rolling".
        row_axis: axis of a stored frame that counts sensor rows; 1 for frames stored in portrait.
        roi: ((first row, end row), (first column, end column)) in sensor coordinates, ends excluded; either
            may be None. Odd starts rotate `cfa`.
        progress: show a bar on long reads.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unreadable file, no exposure time, or frames that do not belong together; the message
            names the file. Also whatever `FrameStack` refuses.
    """
    paths = _paths(path)
    reader = _reader(paths)
    console = Console(stderr=True)
    bar = progress and len(paths) >= _LONG_READ and console.is_terminal
    tracked = track(paths, "Reading headers", disable=not bar, transient=True, console=console)
    read = [recording for one in tracked for recording in reader.read(one)]
    read = _with_exposures(_with_kinds(read, kind), exposure_s, reader.EXPOSURE_FROM)
    _check_sizes(read)
    cfa = _cfa(read, cfa)
    black_level = _black_level(read) if black_level is None else black_level
    groups = group_by_exposure(read)
    counts = [group_counts(group) for group in groups]
    if roi is not None:
        counts, cfa = _region(counts, cfa, roi, one_of("row_axis", row_axis, (0, 1)))
    return FrameStack(
        counts,
        [group_exposure_s(group) for group in groups],
        black_level=black_level,
        white_level=_shared(read, "white_level") if white_level is None else white_level,
        cfa=cfa,
        shutter=(_shared(read, "shutter") or "rolling") if shutter is None else shutter,
        kind=[str(group[0].kind) for group in groups],
        temperature_c=[group_temperature_c(group) for group in groups],
        iso=_shared(read, "iso"),
        row_axis=row_axis,
    )


def _paths(path: Any) -> list[Path]:
    """The files meant, of known formats in a folder, of any in a list."""
    if not isinstance(path, str | Path):
        if not isinstance(path, Iterable):
            raise TypeError(f"path: expected a folder, a file, a pattern or a list of files, got {type(path).__name__}")
        paths = [Path(one) for one in path]
    elif Path(path).is_dir():
        found = [one for one in Path(path).iterdir() if one.is_file() and not one.name.startswith(".")]
        paths = sorted(filter(_reader_name, found), key=in_order)
    elif glob.has_magic(str(path)) and not Path(path).exists():
        paths = sorted(filter(_reader_name, map(Path, glob.glob(str(path)))), key=in_order)
    else:
        paths = [Path(path)]
    if not paths:
        raise FileNotFoundError(f"path: no capture in {path!s}; known formats: {' '.join(_READERS.values())}")
    for one in paths:
        if not one.is_file():
            raise FileNotFoundError(f"path: no such file or folder: {one}")
    return paths


def _reader_name(path: Path) -> str | None:
    for name, suffixes in _READERS.items():
        if path.name.lower().endswith(tuple(suffixes.split())):
            return name
    return None


def _reader(paths: list[Path]) -> ModuleType:
    names = [_reader_name(path) for path in paths]
    for path, name in zip(paths, names, strict=True):
        if name is None:
            raise ValueError(f"{path}: unknown format; known are {' '.join(_READERS.values())}")
        if name != names[0]:
            raise ValueError(
                f"path: files of several formats ({paths[0].name}, {path.name}); give a pattern such as '*.dng'"
            )
    return import_module(f"hsnoise.io.{names[0]}")


def _with_kinds(read: list[Recording], kind: Any) -> list[Recording]:
    given = [kind] * len(read) if kind is None or isinstance(kind, str) else list(kind)
    if len(given) != len(read):
        raise ValueError(f"kind: expected one, or {len(read)} (one a file or exposure), got {kind}")
    kinds = [one or recording.kind or "dark" for one, recording in zip(given, read, strict=True)]
    for one, recording in zip(kinds, read, strict=True):
        if one not in KINDS:
            raise ValueError(f"{recording.path}: expected kind 'dark' or 'flat', got {one!r}; give kind=")
    return [replace(recording, kind=one) for recording, one in zip(read, kinds, strict=True)]


def _with_exposures(read: list[Recording], exposure_s: Any, source: str) -> list[Recording]:
    if exposure_s is not None:
        given = np.full(len(read), exposure_s) if np.ndim(exposure_s) == 0 else exposure_s
        values = numbers("exposure_s", given, len(read), "file or exposure").tolist()
        _warn_of_other_exposures(read, values)
    else:
        values = [recording.exposure_s for recording in read]
    for recording, value in zip(read, values, strict=True):
        if value is None:
            raise ValueError(f"{recording.path}: no exposure time (looked for {source}); give exposure_s=, in seconds")
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"{recording.path}: expected an exposure_s >= 0, got {value} s")
    return [replace(recording, exposure_s=value) for recording, value in zip(read, values, strict=True)]


def _warn_of_other_exposures(read: list[Recording], given: list[float]) -> None:
    for recording, value in zip(read, given, strict=True):
        own = recording.exposure_s
        if own is not None and abs(value - own) > RELATIVE_TOLERANCE * own:
            warnings.warn(
                f"exposure_s: {recording.path} says {own:g} s; the given {value:g} s are taken instead", stacklevel=4
            )
            return


def _check_sizes(read: list[Recording]) -> None:
    first, *others = read
    for other in others:
        if other.counts.shape[1:] != first.counts.shape[1:]:
            raise ValueError(
                f"{other.path}: frames of {other.counts.shape[1:]} pixels, those of {first.path} have "
                f"{first.counts.shape[1:]}; all frames must have one size"
            )


def _shared(read: list[Recording], name: str) -> Any:
    """What all files say of `name`."""
    first, *others = read
    for other in others:
        one, two = getattr(first, name), getattr(other, name)
        if one != two:
            hint = "load them separately" if name == "iso" else f"give {name}= or load them separately"
            raise ValueError(f"{first.path} and {other.path} differ in {name}: {one} and {two}; {hint}")
    return getattr(first, name)


def _cfa(read: list[Recording], cfa: str | None) -> str:
    found = (_shared(read, "cfa") or "mono") if cfa is None else cfa
    if found == UNKNOWN_ORDER:
        raise ValueError(f"{read[0].path}: a colour mosaic, but its Bayer order is not certain; give cfa=")
    return found


def _black_level(read: list[Recording]) -> Any:
    """Mean of what the files say; some cameras write a slightly different level in each frame."""
    levels = [recording.black_level for recording in read]
    if any(level is None for level in levels):
        return _shared(read, "black_level")
    levels_dn = np.array([np.asarray(level, float) for level in levels])
    if np.ptp(levels_dn, axis=0).max() > 1:
        raise ValueError(
            f"files differ in black_level by more than 1 DN ({levels_dn.min():g} to {levels_dn.max():g}); "
            "give black_level= or load them separately"
        )
    return levels_dn.mean(axis=0)


def _region(counts: list[Any], cfa: str, roi: tuple[Any, Any], row_axis: int) -> tuple[list[Any], str]:
    """Counts and Bayer order of a region, all in stored orientation; `roi` is in sensor orientation."""
    if not isinstance(roi, Sequence) or len(roi) != 2:
        raise ValueError(f"roi: expected ((first row, end row), (first column, end column)), got {roi!r}")
    sizes = counts[0].shape[1:]
    spans = roi[::-1] if row_axis == 1 else roi
    rows, columns = (span("roi", one, size) for one, size in zip(spans, sizes, strict=True))
    return [crop(one, rows, columns) for one in counts], shift_cfa(cfa, rows.start, columns.start)
