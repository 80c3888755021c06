"""The files of a noise model: readable JSON, and beside it an .npz file with measured arrays if there are any."""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hsnoise._core.output import write_atomically

FORMAT, FORMAT_VERSION = "hsnoise noise model", 1
PRECISIONS = ("float32", "float64")
MARK = "format"  # the entry of an .npz file that says whose it is


def write_model(path: str | os.PathLike, content: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write the JSON, and arrays by name to the .npz file of the same name; each file whole or not at all.

    The JSON states a hash of the .npz file, so a pair that does not belong together is noticed. Raises ValueError
    rather than overwriting an .npz file that holds something else.
    """
    path = Path(path)
    whole: dict[str, Any] = {"format": FORMAT, "format_version": FORMAT_VERSION, **content}
    if arrays:
        beside, buffer = path.with_suffix(".npz"), io.BytesIO()
        _check_may_write(beside)
        np.savez_compressed(buffer, **{MARK: FORMAT}, **{name: np.asarray(value) for name, value in arrays.items()})
        whole["arrays"] = {"file": beside.name, "sha256": hashlib.sha256(buffer.getvalue()).hexdigest()}
        write_atomically(beside, buffer.getvalue())
    write_atomically(path, (json.dumps(whole, indent=2, allow_nan=False) + "\n").encode())


def read_model(path: str | os.PathLike) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The content of the JSON and the arrays by name.

    Raises ValueError for anything but the files of a model, and where the .npz file is missing, cut short, or of
    another model.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"), object_pairs_hook=_once_each)
    except RecursionError:
        raise ValueError(f"{path}: not a noise model saved by hsnoise: it is nested too deeply.") from None
    except ValueError as error:
        raise ValueError(f"{path}: not a JSON file ({error}).") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f"{path}: not a noise model saved by hsnoise.")
    if content.get("format_version") != FORMAT_VERSION:
        raise ValueError(
            f"{path}: file format {content.get('format_version')}, written by hsnoise "
            f"{content.get('hsnoise_version')}; this version reads format {FORMAT_VERSION}."
        )
    _check_fields(path, content)
    return content, _arrays(Path(path), content["arrays"]) if "arrays" in content else {}


def _check_fields(path: str | os.PathLike, content: Mapping[str, Any]) -> None:
    """Raise ValueError unless the fields hold what `write_model` puts there; their values are checked by the model."""
    precision = content.get("precision")
    if precision not in PRECISIONS:
        raise ValueError(f"{path}: precision: expected {' or '.join(PRECISIONS)}, got {precision!r:.60}.")
    effects = content.get("effects")
    if not isinstance(effects, list) or not effects:
        raise ValueError(f"{path}: effects: expected a list of effects, got {effects!r:.60}.")
    for i, effect in enumerate(effects):
        fields = effect if isinstance(effect, dict) else {}
        kinds = {"name": str, "parameters": dict, "settings": dict}
        if not all(isinstance(fields.get(name), kind) for name, kind in kinds.items()):
            raise ValueError(f"{path}: effect {i}: expected a name, parameters and settings, got {effect!r:.60}.")
    twice = [name for name, n in Counter(effect["name"] for effect in effects).items() if n > 1]
    if twice:  # before thousands of them are made
        raise ValueError(f"{path}: effects: {', '.join(twice):.60} given twice; a model holds one effect per name.")


def _once_each(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object, in which a name that is given twice would silently win over itself."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)!r} is given twice")
    return found


def _arrays(path: Path, stated: Any) -> dict[str, np.ndarray]:
    if not (isinstance(stated, dict) and all(isinstance(stated.get(key), str) for key in ("file", "sha256"))):
        raise ValueError(f'{path}: arrays: expected {{"file": ..., "sha256": ...}}, two texts, got {stated!r:.80}.')
    beside = path.parent / Path(stated["file"]).name
    if not beside.is_file():
        raise ValueError(f"{path}: its measured arrays are in {beside.name}, which is not beside it; copy both files.")
    found = beside.read_bytes()
    if hashlib.sha256(found).hexdigest() != stated["sha256"]:
        raise ValueError(
            f"{path}: {beside.name} is damaged, or belongs to another model; expected the file saved with it."
        )
    with np.load(io.BytesIO(found)) as arrays:
        return {name: arrays[name] for name in arrays.files if name != MARK}


def _check_may_write(path: Path) -> None:
    """Raise ValueError if the file exists and holds anything but arrays of a model, such as the frames themselves."""
    if not path.exists():
        return
    try:
        with np.load(path) as arrays:
            is_own = MARK in arrays.files and str(arrays[MARK]) == FORMAT
    except (ValueError, OSError, zipfile.BadZipFile):
        is_own = False
    if not is_own:
        raise ValueError(
            f"path: the measured arrays belong into {path}, which holds something else; choose another name."
        )
