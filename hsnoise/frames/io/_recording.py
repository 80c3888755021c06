"""What every reader returns, and the words it uses: `Recording`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hsnoise._core.naming import named
from hsnoise._core.types import StatedGain
from hsnoise.frames.lazy import LazyFrames

UNKNOWN_ORDER = "unknown order"  # a colour mosaic whose Bayer order the file does not tell for sure


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """Frames of one exposure in one file; what the file does not say is None.

    Args:
        path: the file.
        counts: DN, `[frame, row, column]`, lazy unless the format forbids it.
        exposure_s, iso, temperature_c: as `FrameStack` has them.
        kind: "dark", "flat", "bias" (a dark of 0 s unless the file says another exposure) or "light".
        cfa: "mono", a Bayer order or `UNKNOWN_ORDER`.
        black_level, white_level: DN; black one value or one a channel.
        shutter: "rolling" or "global".
        is_open: whether light was let in, by the file.
        binning: sensor pixels in one of the file's, (rows, columns).
        gain_setting: the number that the camera calls its gain, whatever its unit.
        stated_gain: the gain as electrons per DN, if the file states it.
        filter_name: the colour filter in front of the sensor.
        is_master: an average of several frames, or counts that are no integers.
        overscan: header's section of overscan pixels, ((first row, end row), (first column, end column)).
        taken: time of the exposure, ISO 8601.
    """

    path: Path
    counts: Any
    exposure_s: float | None = None
    kind: str | None = None
    cfa: str | None = None
    black_level: Any = None
    white_level: float | None = None
    shutter: str | None = None
    iso: float | None = None
    temperature_c: float | None = None
    is_open: bool | None = None
    binning: tuple[int, int] | None = None
    gain_setting: float | None = None
    stated_gain: StatedGain | None = None
    filter_name: str | None = None
    is_master: bool = False
    overscan: tuple[tuple[int, int], tuple[int, int]] | None = None
    taken: str | None = None

    @property
    def n_frames(self) -> int:
        return int(self.counts.shape[0])

    @property
    def size(self) -> tuple[int, int]:
        """(rows, columns) as stored."""
        return self.counts.shape[1], self.counts.shape[2]


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Turn whatever a format's library raises on a broken file into a ValueError that names the file."""
    try:
        yield
    except Exception as error:
        raise ValueError(f"cannot read {path}: {error or type(error).__name__}") from error


def lazy_frames(path: Path, read: Any, n: int, frame_shape: tuple[int, int], dtype: Any) -> LazyFrames:
    """Frames 0 to n - 1 of a file; `read(path, index)` opens it, reads frame `index` and closes it."""
    readers = [partial(_read_named, path, read, i) for i in range(n)]
    names = [str(path)] if n == 1 else [f"{path}, frame {i}" for i in range(n)]
    return LazyFrames(readers, frame_shape, dtype, names)


def _read_named(path: Path, read: Any, index: int) -> np.ndarray:
    with naming(path):
        return read(path, index)


def _in_seconds(value: Any) -> np.ndarray:
    """Time spans of any unit as seconds; all else as it is."""
    array = np.asarray(value)
    return array / np.timedelta64(1, "s") if array.dtype.kind == "m" else array


def recordings(path: Path, groups: list[Any], metadata: Mapping[str, Any]) -> list[Recording]:
    """One `Recording` for each exposure group of an array file with named metadata.

    Args:
        path: the file.
        groups: counts `[frame, row, column]` of each exposure.
        metadata: any of exposure_s, kind, temperature_c (one for all or one a group), cfa, shutter, iso,
            black_level, white_level.

    Raises:
        ValueError: a value is neither one for all nor one a group.
    """
    per_group = {}
    for name in ("exposure_s", "kind", "temperature_c"):
        values = np.atleast_1d(_in_seconds(metadata[name])).tolist() if name in metadata else [None] * len(groups)
        if len(values) != len(groups) and (len(values) > 1 or name == "exposure_s"):
            raise ValueError(f"{named(name)}: expected {len(groups)} values (one an exposure), got {len(values)}")
        per_group[name] = values * len(groups) if len(values) < len(groups) else values
    shared = {
        name: np.asarray(metadata[name]).tolist()
        for name in ("cfa", "shutter", "black_level", "white_level", "iso")
        if name in metadata
    }
    return [
        Recording(path=path, counts=counts, **{name: per_group[name][i] for name in per_group}, **shared)
        for i, counts in enumerate(groups)
    ]
