"""From a path to frames of one camera that belong together."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from hsnoise._core.arguments import numbers, span
from hsnoise._core.naming import named, setting
from hsnoise._core.types import StatedGain
from hsnoise.frames.bayer import shift_cfa
from hsnoise.frames.io import _emva
from hsnoise.frames.io._apart import sort_out
from hsnoise.frames.io._files import of_one_format, paths_of, reader_name, root_of
from hsnoise.frames.io._grouping import (
    RELATIVE_TOLERANCE,
    group_by_exposure,
    group_counts,
    group_exposure_s,
    group_temperature_c,
)
from hsnoise.frames.io._kinds import exposure_of_names, frames, with_kinds
from hsnoise.frames.io._levels import split_levels, thinned
from hsnoise.frames.io._overscan import with_overscan
from hsnoise.frames.io._recording import UNKNOWN_ORDER, Recording
from hsnoise.frames.joining import replaced
from hsnoise.frames.lazy import crop
from hsnoise.frames.stack import FrameStack

_LONG_READ = 16  # files; from here on a progress bar is shown

Groups = list[list[Recording]]


def read_capture(
    path: Any,
    *,
    exposure_s: Any,
    kind: Any,
    cfa: str | None,
    hdu: int | str | None,
    overscan: Any,
    progress: bool,
    roi: Any,
    **keywords: Any,
) -> FrameStack:
    """The work of `hsnoise.load`; `keywords` are levels, shutter and row_axis."""
    read, root, told, source = _recordings(path, hdu, progress)
    read = read if exposure_s is None else _with_given(read, exposure_s)
    read, about_kinds = with_kinds(read, kind, root)
    read, about_exposures = _with_exposures_of_names(read, root)
    if cfa is not None:
        _warn_of_another_cfa(read, cfa)
        read = [replace(one, cfa=cfa) for one in read]
    found = sort_out(read, root)
    _check_exposures([*found.main, *found.elsewhere], source)
    gain, about_gain = _stated_gain([*found.main, *found.elsewhere])
    stacks, about_levels, parts, shown = [], [], [], None
    black_dn = _black_dn(found.main)
    for some, region in ((found.main, roi), (found.elsewhere, None)):
        if some:
            given = keywords["white_level"]
            stated = _shared(some, "white_level") if given is None else given
            levels, white_level, about = split_levels(group_by_exposure(some), black_dn, stated)
            shown = white_level if stated is None and white_level is not None else shown
            about_levels += about
            parts.append((some, region, levels, stated))
    files = {one.path for one in read}
    for some, region, levels, stated in parts:
        white_level = shown if stated is None else stated
        with _naming(root if len(files) > 1 else next(iter(files)), found.told):
            stack = _stack(levels, some, region, gain, **{**keywords, "white_level": white_level})
        stacks.append(with_overscan(stack, overscan, some if region is None else ()))
    assumed = told + about_kinds + about_exposures + found.told + about_levels + about_gain
    joined = FrameStack.join(*stacks)
    return replaced(joined, assumed=(*assumed, *joined.assumed))


@contextmanager
def _naming(path: Path, left_out: list[str]) -> Iterator[None]:
    """Errors about frames as a whole name the file, or the folder of several, and say what was left out of it."""
    try:
        yield
    except (TypeError, ValueError) as error:
        if str(path) in str(error):
            raise
        raise type(error)(f"{path}: {error}" + "".join(f" ({one})" for one in left_out)) from error


def _recordings(path: Any, hdu: int | str | None, progress: bool) -> tuple[list[Recording], Path, list[str], str]:
    """All recordings, the folder that holds them, what was skipped, and where their format keeps the exposure."""
    if isinstance(path, str | Path) and (Path(path) / _emva.DESCRIPTOR).is_file():
        return _emva.read(Path(path)), Path(path), [], _emva.DESCRIPTOR
    paths, passed = paths_of(path)
    root = root_of(path, paths)
    paths, reader, others = of_one_format(paths, root)
    if hdu is not None and reader_name(paths[0]) != "_fits":
        raise ValueError(f"{setting('hdu', hdu)}: expected with FITS files alone, got {paths[0].name}")
    options = {} if hdu is None else {"hdu": hdu}
    console = Console(stderr=True)
    bar = progress and len(paths) >= _LONG_READ and console.is_terminal
    tracked = track(paths, "Reading headers", disable=not bar, transient=True, console=console)
    read = [one for path in tracked for one in reader.read(path, **options)]
    for one in read:
        if min(one.counts.shape) < 1:
            raise ValueError(f"{one.path}: expected frames, got counts of shape {one.counts.shape}")
    return read, root, passed + others, reader.EXPOSURE_FROM


def _with_given(read: list[Recording], exposure_s: Any) -> list[Recording]:
    """Exposures as given; warns if a file states another."""
    given = np.full(len(read), exposure_s) if np.ndim(exposure_s) == 0 else exposure_s
    values = numbers("exposure_s", given, len(read), "file or exposure").tolist()
    _warn_of_other_exposures(read, values)
    return [replace(recording, exposure_s=value) for recording, value in zip(read, values, strict=True)]


def _with_exposures_of_names(read: list[Recording], root: Path) -> tuple[list[Recording], list[str]]:
    """Exposures taken from the names of files and folders where headers lack them, and a sentence that says so."""
    out = [
        recording
        if recording.exposure_s is not None
        else replace(recording, exposure_s=exposure_of_names(recording.path, root))
        for recording in read
    ]
    named = [new for old, new in zip(read, out, strict=True) if old.exposure_s is None and new.exposure_s is not None]
    seconds = ", ".join(f"{t:g}" for t in sorted({recording.exposure_s for recording in named}))
    n = sum(recording.n_frames for recording in named)
    return out, [f"{frames(n)}: exposure taken from the names of files and folders ({seconds} s)"] if named else []


def _check_exposures(read: list[Recording], source: str) -> None:
    for recording in read:
        value = recording.exposure_s
        if value is None:
            raise ValueError(
                f"{recording.path}: no exposure time (looked for {source}); give {setting('exposure_s')}, in"
                " seconds, one for all files or one for each, or name files or folders by it (dark_30s_01.tif)"
            )
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"{recording.path}: expected an exposure_s >= 0, got {value} s")


def _warn_of_other_exposures(read: list[Recording], given: list[float]) -> None:
    for recording, value in zip(read, given, strict=True):
        own = recording.exposure_s
        if own is not None and abs(value - own) > RELATIVE_TOLERANCE * own:
            warnings.warn(
                f"{named('exposure_s')}: {recording.path} says {own:g} s; the given {value:g} s are used instead",
                stacklevel=4,
            )
            return


def _warn_of_another_cfa(read: list[Recording], given: str) -> None:
    for recording in read:
        if recording.cfa not in (None, UNKNOWN_ORDER, given):
            warnings.warn(
                f"{named('cfa')}: {recording.path} says {recording.cfa}; the given {given} is used instead",
                stacklevel=4,
            )
            return


def _shared(read: list[Recording], name: str) -> Any:
    """The one value of `name` in all files."""
    first, *others = read
    for other in others:
        one, two = getattr(first, name), getattr(other, name)
        if one != two:
            raise ValueError(
                f"{first.path} and {other.path} differ in {name}: {one} and {two}; give {name}= or load them separately"
            )
    return getattr(first, name)


def _stack(
    groups: Groups,
    read: list[Recording],
    roi: Any,
    gain: StatedGain | None,
    *,
    black_level: Any,
    white_level: float | None,
    shutter: str | None,
    row_axis: int,
) -> FrameStack:
    counts, cfa = [group_counts(group) for group in groups], _cfa(read)
    if roi is not None:
        counts, cfa = _region(counts, cfa, roi, row_axis)
    return FrameStack(
        counts,
        [group_exposure_s(group) for group in groups],
        black_level=_black_level(read) if black_level is None else black_level,
        white_level=white_level,
        cfa=cfa,
        shutter=(_shared(read, "shutter") or "rolling") if shutter is None else shutter,
        kind=[str(group[0].kind) for group in groups],
        temperature_c=[group_temperature_c(group) for group in groups],
        iso=_known(read, "iso"),
        row_axis=row_axis,
        stated_gain=gain,
    )


def _known(read: list[Recording], name: str) -> Any:
    """The value of `name` in the files that state it; files that contradict the majority have been set aside."""
    return next((value for value in (getattr(one, name) for one in read) if value is not None), None)


def _stated_gain(read: list[Recording]) -> tuple[StatedGain | None, list[str]]:
    """The gain that the headers state, and a sentence if they contradict each other."""
    stated = {one.stated_gain.source: one.stated_gain for one in read if one.stated_gain is not None}
    if len(stated) < 2:
        return next(iter(stated.values()), None), []
    return None, [f"Headers state different gains ({', '.join(stated)}): none of them is used"]


def _black_dn(read: list[Recording]) -> float:
    """Mean of one of the shortest darks, DN, if there are flats to compare; otherwise 0."""
    darks = [one for one in read if one.kind == "dark"]
    if len(darks) in (0, len(read)):
        return 0.0
    return float(thinned([min(darks, key=lambda one: float(one.exposure_s or 0))])[0][0])


def _cfa(read: list[Recording]) -> str:
    found = _known(read, "cfa") or "mono"
    if found == UNKNOWN_ORDER:
        raise ValueError(f"{read[0].path}: a colour mosaic of unknown Bayer order; give {setting('cfa')}")
    return found


def _black_level(read: list[Recording]) -> Any:
    """Mean of the levels in the files; some cameras write a slightly different level in each frame."""
    levels = [recording.black_level for recording in read]
    if any(level is None for level in levels):
        return _shared(read, "black_level")
    levels_dn = np.array([np.asarray(level, float) for level in levels])
    if np.ptp(levels_dn, axis=0).max() > 1:
        raise ValueError(
            f"files differ in black_level by more than 1 DN ({levels_dn.min():g} to {levels_dn.max():g}); "
            f"give {setting('black_level')} or load them separately"
        )
    return levels_dn.mean(axis=0)


def _region(counts: list[Any], cfa: str, roi: tuple[Any, Any], row_axis: int) -> tuple[list[Any], str]:
    """Counts and Bayer order of a region, all in stored orientation; `roi` is in sensor orientation."""
    if not isinstance(roi, Sequence) or len(roi) != 2:
        raise ValueError(f"{named('roi')}: expected ((first row, end row), (first column, end column)), got {roi!r}")
    sizes = counts[0].shape[1:]
    spans = roi[::-1] if row_axis == 1 else roi
    rows, columns = (span("roi", one, size) for one, size in zip(spans, sizes, strict=True))
    return [crop(one, rows, columns) for one in counts], shift_cfa(cfa, rows.start, columns.start)
