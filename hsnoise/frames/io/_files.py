"""The files that a path names, and their reader."""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from hsnoise._core.naming import named
from hsnoise.frames.io._kinds import folder_of
from hsnoise.frames.lazy import in_order

READERS = {
    "_raw": ".dng .cr2 .cr3 .nef .nrw .arw .srf .sr2 .raf .rw2 .orf .pef .srw .3fr .fff .iiq .mrw .erf .rwl",
    "_fits": ".fits .fit .fts .fits.gz .fit.gz .fits.fz",
    "_tiff": ".tif .tiff",
    "_png": ".png",
    "_numpy": ".npy .npz",
    "_hdf5": ".h5 .hdf5",
}
PASSED_OVER = ("bad", "rejected", "reduced", "calibrated", "processed", "stacked", "registered")  # names of folders


def root_of(path: Any, paths: list[Path]) -> Path:
    """The folder of a capture: `path` itself, or the one that holds all its files."""
    if isinstance(path, str | Path) and Path(path).is_dir():
        return Path(path)
    parents = {one.absolute().parent for one in paths}
    root = Path(os.path.commonpath(parents))
    return root if paths[0].is_absolute() else Path(os.path.relpath(root))


def paths_of(path: Any) -> tuple[list[Path], list[str]]:
    """The files that `path` names, and what was skipped. Folders give all files of known formats in and below them.

    Raises:
        FileNotFoundError: there are none, or one is missing. TypeError: `path` is not a path.
    """
    paths: list[Path] = []
    told: list[str] = []
    if not isinstance(path, str | Path):
        if not isinstance(path, Iterable):
            raise TypeError(
                f"{named('path')}: expected a folder, a file, a pattern or a list of files, got {type(path).__name__}"
            )
        for one in map(Path, path):
            inside, passed = _below(one) if one.is_dir() else ([one], [])
            paths += inside
            told += passed
    elif Path(path).is_dir():
        paths, told = _below(Path(path))
    elif glob.has_magic(str(path)) and not Path(path).exists():
        paths = sorted(filter(reader_name, map(Path, glob.glob(str(path)))), key=in_order)
    else:
        paths = [Path(path)]
    if not paths:
        raise FileNotFoundError(f"{named('path')}: no capture in {path!s}; known formats: {' '.join(READERS.values())}")
    for one in paths:
        if not one.is_file():
            raise FileNotFoundError(f"{named('path')}: no such file or folder: {one}")
    return paths, told


def _below(root: Path) -> tuple[list[Path], list[str]]:
    """Files of known formats in and below a folder, in natural order, without folders named in `PASSED_OVER`."""
    found: list[Path] = []
    told = []
    seen: set[str] = set()
    for folder, inside, names in os.walk(root, followlinks=True):
        if os.path.realpath(folder) in seen:  # a link that loops back
            inside[:] = []
            continue
        seen.add(os.path.realpath(folder))
        passed = sorted(name for name in inside if name.lower() in PASSED_OVER)
        told += [f"{(Path(folder) / name).relative_to(root)}/ was passed over because of its name" for name in passed]
        inside[:] = [name for name in inside if name not in passed and not name.startswith((".", "hsnoise-"))]
        found += [Path(folder) / name for name in names if not name.startswith(".")]
    known = [path for path in found if reader_name(path)]
    chosen = [path for path in known if path.is_file()]
    lost = sorted(set(known).difference(chosen))
    told += [f"{path.relative_to(root)} was set aside: a link to nothing, or no file" for path in lost]
    return sorted(chosen, key=lambda path: [in_order(Path(part)) for part in path.relative_to(root).parts]), told


def reader_name(path: Path) -> str | None:
    """The module that reads files of this name, or None."""
    for name, suffixes in READERS.items():
        if path.name.lower().endswith(tuple(suffixes.split())):
            return name
    return None


def of_one_format(paths: list[Path], root: Path) -> tuple[list[Path], ModuleType, list[str]]:
    """The files of the most common format, their reader, and what was set aside.

    Raises:
        ValueError: an unknown format, or two formats with equally many files.
    """
    names = [reader_name(path) for path in paths]
    if None in names:
        raise ValueError(f"{paths[names.index(None)]}: unknown format; known are {' '.join(READERS.values())}")
    (most, n), *others = Counter(names).most_common()
    if others and others[0][1] == n:
        first = [next(path.name for path, name in zip(paths, names, strict=True) if name == one) for one in names]
        one, two = list(dict.fromkeys(first))[:2]
        raise ValueError(f"{named('path')}: files of several formats ({one}, {two}); give a pattern such as '*.dng'")
    reader = import_module(f"hsnoise.frames.io.{most}")
    chosen = [path for path, name in zip(paths, names, strict=True) if name == most]
    rest = [path for path, name in zip(paths, names, strict=True) if name != most]
    counts = Counter((path.suffix, folder_of(path, root)) for path in rest)
    told = [
        f"{m} {suffix} file{'s' if m > 1 else ''}{place} set aside: the others are {chosen[0].suffix}"
        for (suffix, place), m in counts.items()
    ]
    return chosen, reader, told
