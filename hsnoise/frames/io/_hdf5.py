"""HDF5 files, read by h5py."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hsnoise.frames.io._recording import Recording, lazy_frames, naming, recordings

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
        counts = file["counts"]
        if len(counts.shape) not in (3, 4):
            raise ValueError(
                f"expected counts [frame, row, column] or [exposure, frame, row, column], got shape {counts.shape}"
            )
        *exposures, n, rows, columns = counts.shape
        places = [(i,) for i in range(exposures[0])] if exposures else [()]
        groups = [
            lazy_frames(path, partial(_read_frame, place=place), n, (rows, columns), counts.dtype) for place in places
        ]
        beside = {name: file[name][()] for name in file if name != "counts" and file[name].size < counts.size}
        metadata = dict(file.attrs) | dict(counts.attrs) | beside
        return recordings(path, groups, {name: _text(value) for name, value in metadata.items()})


def _read_frame(path: Path, index: int, *, place: tuple[int, ...]) -> np.ndarray:
    with h5py.File(path, "r") as file:
        return file["counts"][(*place, index)]


def _text(value: Any) -> Any:
    """HDF5 strings, bytes or arrays of them, as str."""
    array = np.asarray(value)
    if array.dtype.kind in "SO":
        words = [one.decode() if isinstance(one, bytes) else one for one in array.ravel()]
        return np.array(words).reshape(array.shape)
    return value
