"""HDF5 files, read by h5py."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hsnoise.frames.io._recording import METADATA, Recording, check_held, lazy_frames, naming, recordings

EXPOSURE_FROM = "'exposure_s' in the HDF5 file"


def read(path: Path) -> list[Recording]:
    """The data set `counts`: `[frame, row, column]` or `[exposure, frame, row, column]`, read later.

    exposure_s, kind, black_level, white_level, cfa, shutter, iso and temperature_c may be data sets beside
    it, attributes of it or attributes of the file.

    Raises:
        ValueError: unreadable, truncated, or without counts of these shapes.
    """
    with naming(path), h5py.File(path, "r") as file:
        if "counts" not in file:
            raise ValueError(f"expected a data set 'counts', got {sorted(file)}")
        counts = _data_set(file)
        if len(counts.shape) not in (3, 4):
            raise ValueError(
                f"expected counts [frame, row, column] or [exposure, frame, row, column], got shape {counts.shape}"
            )
        *exposures, n, rows, columns = counts.shape
        places = [(i,) for i in range(exposures[0])] if exposures else [()]
        groups = [
            lazy_frames(path, partial(_read_frame, place=place), n, (rows, columns), counts.dtype) for place in places
        ]
        beside = {name: _data_set(file, name)[()] for name in METADATA if name in file}
        metadata = _attributes(file) | _attributes(counts) | beside
        return recordings(path, groups, {name: _text(name, value) for name, value in metadata.items()})


def _data_set(file: h5py.File, name: str = "counts") -> h5py.Dataset:
    """A data set of this file. Raises ValueError for one that is elsewhere, empty, or declared but not written."""
    if isinstance(file.get(name, getlink=True), h5py.ExternalLink):
        raise ValueError(f"{name!r} is a link to another file, which is not followed; give that file")
    found = file.get(name)
    if not isinstance(found, h5py.Dataset):
        raise ValueError(f"expected a data set {name!r}, got {'a broken link' if found is None else 'a group'}")
    if found.is_virtual or found.external:
        raise ValueError(f"the values of {name!r} are in another file, which is not followed; give that file")
    if found.shape is None:
        raise ValueError(f"the data set {name!r} is empty")
    check_held(name, found.id.get_storage_size(), found.size * found.dtype.itemsize)
    return found


def _attributes(of: h5py.Group | h5py.Dataset) -> dict[str, Any]:
    return {name: of.attrs[name] for name in METADATA if name in of.attrs}


def _read_frame(path: Path, index: int, *, place: tuple[int, ...]) -> np.ndarray:
    with h5py.File(path, "r") as file:
        return file["counts"][(*place, index)]


def _text(name: str, value: Any) -> Any:
    """HDF5 strings, bytes or arrays of them, as str. Raises ValueError if they are not in UTF-8."""
    array = np.asarray(value)
    if array.dtype.kind in "SO":
        try:
            words = [one.decode() if isinstance(one, bytes) else one for one in array.ravel()]
        except UnicodeDecodeError:
            raise ValueError(f"{name}: expected text in UTF-8, got {value!r:.60}") from None
        return np.array(words).reshape(array.shape)
    return value
