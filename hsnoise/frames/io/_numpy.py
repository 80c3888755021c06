"""NumPy files: .npy is memory-mapped, .npz loaded whole."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hsnoise.frames.io._recording import Recording, naming, recordings

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
            found = np.load(path, mmap_mode="r")
            if not isinstance(found, np.ndarray):
                raise ValueError("it is an archive of several arrays; give it the suffix .npz")
            return recordings(path, _groups(found), {})
        if not zipfile.is_zipfile(path):
            raise ValueError("it is not an .npz file, or it is truncated")
        with path.open("rb") as file, np.load(file) as arrays:
            if "counts" not in arrays and path.with_suffix(".json").is_file():
                return _described(path, arrays)
            if "counts" not in arrays:
                raise ValueError(f"expected an array 'counts', got {sorted(arrays)}")
            return recordings(path, _groups(arrays["counts"]), arrays)


def _described(path: Path, arrays: Mapping[str, np.ndarray]) -> list[Recording]:
    """Recordings of named arrays, described by the .json file beside them."""
    beside = path.with_suffix(".json")
    about = json.loads(beside.read_text(encoding="utf-8"))
    described = about.get("arrays") if isinstance(about, dict) else None
    if not isinstance(described, dict) or not described:
        raise ValueError(f"expected an array 'counts', or 'arrays' in {beside.name} with kind and exposure of each")
    found = []
    for name, one in described.items():
        missing = [key for key in ("kind", "exposure_s") if not isinstance(one, dict) or key not in one]
        if name not in arrays or missing:
            raise ValueError(f"{beside.name} describes {name!r}: expected an array of that name, kind and exposure_s")
        kind = [*str(one["kind"]).split(), ""][0].lower()
        metadata: dict[str, Any] = {"exposure_s": float(one["exposure_s"]), "kind": "dark" if kind == "bias" else kind}
        if about.get("cfa"):
            metadata["cfa"] = about["cfa"].split()[0]
        temperatures = np.asarray(one.get("sensor_temp_c") or [], float)
        if np.isfinite(temperatures).any():
            metadata["temperature_c"] = float(np.nanmean(temperatures))
        found += recordings(path, _groups(arrays[name]), metadata)
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
