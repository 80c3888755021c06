"""NumPy files: .npy is memory-mapped, .npz loaded whole."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from hsnoise.frames.io._recording import METADATA, Recording, check_held, naming, recordings

HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
EXPOSURE_FROM = "'exposure_s' in an .npz file"


def read(path: Path) -> list[Recording]:
    """Counts `[row, column]`, `[frame, row, column]` or `[exposure, frame, row, column]` of a NumPy file.

    An .npy file is memory-mapped. An .npz file is compressed, so it is loaded whole. It holds `counts`, and may hold
    exposure_s, kind, black_level, white_level, cfa, shutter, iso and temperature_c. An .npz file of several arrays
    `[frame, row, column]` needs a .json file beside it, whose `arrays` gives the `kind` and `exposure_s` of each.

    Raises:
        ValueError: unreadable, truncated, or without counts of these shapes.
    """
    with naming(path):
        if path.suffix.lower() == ".npy":
            return recordings(path, _groups(_mapped(path)), {})
        if not zipfile.is_zipfile(path):
            raise ValueError("it is not an .npz file, or it is truncated")
        with zipfile.ZipFile(path) as archive:
            names, array = _names(archive), partial(_array, archive)
            if "counts" not in names and path.with_suffix(".json").is_file():
                return _described(path, names, array)
            if "counts" not in names:
                raise ValueError(f"expected an array 'counts', got {sorted(names)}")
            return recordings(path, _groups(array("counts")), {name: array(name) for name in METADATA if name in names})


def _mapped(path: Path) -> np.ndarray:
    """The array of an .npy file, memory-mapped. Raises ValueError if its header declares another size than it holds."""
    if zipfile.is_zipfile(path):
        raise ValueError("it is an archive of several arrays; give it the suffix .npz")
    with path.open("rb") as file:
        declared, dtype = _declared(file)
        if not dtype.hasobject:
            _check_end(declared, path.stat().st_size - file.tell())
    return np.load(path, mmap_mode="r")


def _names(archive: zipfile.ZipFile) -> list[str]:
    """Names of the arrays of an .npz file. Raises ValueError if one is given twice or is not what the index says."""
    for one in archive.infolist():
        archive.open(one).close()  # compares the name with that beside the data
    names = [one.removesuffix(".npy") for one in archive.namelist()]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"expected each array once, got several called {twice[0]!r}")
    return names


def _array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """An array of an .npz file. Raises ValueError if its header declares another size than the file holds."""
    member = archive.getinfo(f"{name}.npy")
    with archive.open(member) as file:
        declared, dtype = _declared(file, f"{name}: ")
        check_held(name, member.compress_size, declared)
        if not dtype.hasobject:
            _check_end(declared, member.file_size - file.tell())
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)


def _declared(file: IO[bytes], of: str = "") -> tuple[int, np.dtype]:
    """Bytes of the array that its header declares, and their type; `of`: the array, for the error."""
    version = np.lib.format.read_magic(file)
    if version not in HEADERS:
        raise ValueError(f"{of}expected an array of numbers, got one with names of fields")
    shape, _, dtype = HEADERS[version](file)
    return math.prod(shape) * dtype.itemsize, dtype


def _check_end(declared: int, held: int) -> None:
    if held != declared:
        raise ValueError(f"its header declares {declared} bytes, and it holds {held}")


def _described(path: Path, names: list[str], array: Callable[[str], np.ndarray]) -> list[Recording]:
    """Recordings of named arrays, described by the .json file beside them."""
    beside = path.with_suffix(".json")
    about = json.loads(beside.read_text(encoding="utf-8"))
    described = about.get("arrays") if isinstance(about, dict) else None
    if not isinstance(described, dict) or not described:
        raise ValueError(f"expected an array 'counts', or 'arrays' in {beside.name} with kind and exposure of each")
    found = []
    for name, one in described.items():
        missing = [key for key in ("kind", "exposure_s") if not isinstance(one, dict) or key not in one]
        if name not in names or missing:
            raise ValueError(f"{beside.name} describes {name!r}: expected an array of that name, kind and exposure_s")
        kind = [*str(one["kind"]).split(), ""][0].lower()
        metadata: dict[str, Any] = {"exposure_s": float(one["exposure_s"]), "kind": "dark" if kind == "bias" else kind}
        if about.get("cfa"):
            metadata["cfa"] = about["cfa"].split()[0]
        temperatures = np.asarray(one.get("sensor_temp_c") or [], float)
        if np.isfinite(temperatures).any():
            metadata["temperature_c"] = float(np.nanmean(temperatures))
        found += recordings(path, _groups(array(name)), metadata)
    return found


def _groups(counts: np.ndarray) -> list[np.ndarray]:
    if counts.ndim not in (2, 3, 4):
        raise ValueError(
            "expected counts [row, column], [frame, row, column] or [exposure, frame, row, column], "
            f"got shape {counts.shape}"
        )
    if counts.ndim == 4:
        return list(counts)
    return [counts if counts.ndim == 3 else counts[np.newaxis]]
