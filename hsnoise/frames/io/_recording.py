"""`Recording`, which every reader returns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hsnoise._core.arguments import one_of
from hsnoise._core.naming import named
from hsnoise._core.types import BAYER_CFAS, SHUTTERS, StatedGain
from hsnoise.frames.lazy import LazyFrames

OF_GROUPS = ("exposure_s", "kind", "temperature_c")  # fields with one value for all exposures or one for each
METADATA = (*OF_GROUPS, "black_level", "white_level", "cfa", "shutter", "iso")
CHOICES = {"cfa": ("mono", *BAYER_CFAS), "shutter": SHUTTERS}
TEXT = ("kind", *CHOICES)
LEAST_DECLARED, MOST_PACKED = 1 << 20, 1000  # bytes; noise is hardly packed by a factor of ten
UNKNOWN_ORDER = "unknown order"  # a colour mosaic whose Bayer order the file leaves open


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """Frames of one exposure in one file; fields that the file does not state are None.

    Args:
        path: the file.
        counts: DN, `[frame, row, column]`, lazy unless the format forbids it.
        exposure_s, iso, temperature_c: as in `FrameStack`.
        kind: "dark", "flat", "bias" (a dark of 0 s unless the file states another exposure) or "light".
        cfa: "mono", a Bayer order or `UNKNOWN_ORDER`.
        black_level, white_level: DN; black is one value or one per channel.
        shutter: "rolling" or "global".
        is_open: whether the shutter was open, according to the file.
        binning: sensor pixels per pixel of the file, (rows, columns).
        gain_setting: the number that the camera calls its gain, in any unit.
        stated_gain: the gain as electrons per DN, if the file states it.
        filter_name: the colour filter in front of the sensor.
        is_master: whether it is an average of several frames, or has counts that are not integers.
        overscan: the header's section of overscan pixels, ((first row, end row), (first column, end column)).
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
    """Turn any error that a format's library raises on a broken file into a ValueError that names the file."""
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


def check_held(name: str, held: int, declared: int) -> None:
    """Raise ValueError for data of which a file declares far more bytes than it holds."""
    if declared > LEAST_DECLARED and held * MOST_PACKED < declared:
        raise ValueError(f"{name!r} declares {declared:.3g} bytes and holds {held}: was the file written to its end?")


def _values(name: str, value: Any) -> list[Any]:
    """One value or several of a field; time spans in seconds.

    Raises:
        ValueError: text where numbers are expected, numbers where text is, or more than one axis.
    """
    values = np.asarray(value)
    if values.dtype.kind == "m":
        values = values / np.timedelta64(1, "s")
    expected, kinds = ("text", "US") if name in TEXT else ("numbers", "iuf")
    if values.dtype.kind not in kinds or values.ndim > 1 or not values.size:
        raise ValueError(f"{named(name)}: expected {expected}, got {values.tolist()!r:.60}")
    return values.ravel().tolist()


def _shared(name: str, value: Any) -> Any:
    """The one value of a field of the whole file; black may be a list, one number a channel. ValueError for others."""
    values = _values(name, value)
    if len(values) > 1 and name != "black_level":
        raise ValueError(f"{named(name)}: expected one value, got {values!r:.60}")
    if name not in TEXT and not np.isfinite(values).all():
        raise ValueError(f"{named(name)}: expected finite numbers, got {values[0] if len(values) == 1 else values!r}")
    if name == "iso" and values[0] == 0:  # unknown, as in EXIF
        return None
    return one_of(name, values[0], CHOICES[name]) if name in CHOICES else values[0] if len(values) == 1 else values


def recordings(path: Path, groups: list[Any], metadata: Mapping[str, Any]) -> list[Recording]:
    """One `Recording` for each exposure group of an array file with named metadata.

    Args:
        path: the file.
        groups: counts `[frame, row, column]` of each exposure.
        metadata: any of exposure_s, kind, temperature_c (one for all or one per group), cfa, shutter, iso,
            black_level, white_level.

    Raises:
        ValueError: a field has neither one value nor one per group.
    """
    per_group = {}
    for name in OF_GROUPS:
        values = _values(name, metadata[name]) if name in metadata else [None] * len(groups)
        if len(values) != len(groups) and (len(values) > 1 or name == "exposure_s"):
            raise ValueError(f"{named(name)}: expected {len(groups)} values (one an exposure), got {len(values)}")
        per_group[name] = values * len(groups) if len(values) < len(groups) else values
    shared = {name: _shared(name, metadata[name]) for name in METADATA if name in metadata and name not in OF_GROUPS}
    return [
        Recording(path=path, counts=counts, **{name: per_group[name][i] for name in per_group}, **shared)
        for i, counts in enumerate(groups)
    ]
