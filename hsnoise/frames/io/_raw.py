"""Camera raw files and DNG, read by LibRaw (rawpy); exposure and ISO come from EXIF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import exifread
import numpy as np
import rawpy

from hsnoise._core.types import BAYER_CFAS
from hsnoise.frames.io._recording import Recording, lazy_frames, naming

EXPOSURE_FROM = "EXIF ExposureTime"


def read(path: Path) -> list[Recording]:
    """The raw Bayer counts in the visible area of a camera file; pixels are read later.

    Black level is LibRaw's per channel (the two greens averaged), white level LibRaw's saturation value.

    Raises:
        ValueError: unreadable, or not a 2 x 2 Bayer mosaic (X-Trans, Foveon, linear DNG).
    """
    with naming(path), rawpy.imread(str(path)) as raw:
        letters = raw.color_desc.decode()
        pattern = raw.raw_pattern
        cfa = "" if pattern is None else "".join(letters[i] for i in np.ravel(pattern))
        monochrome = raw.num_colors == 1
        if not monochrome and cfa not in BAYER_CFAS:
            raise ValueError(f"expected a 2 x 2 Bayer mosaic, got colours {letters!r} in pattern {cfa!r}")
        exif = _exif(path)
        return [
            Recording(
                path=path,
                counts=lazy_frames(path, _read_frame, 1, (raw.sizes.height, raw.sizes.width), np.uint16),
                exposure_s=_first(exif, "ExposureTime", raw.other.shutter_speed),
                iso=_first(exif, "ISOSpeedRatings", raw.other.iso_speed),
                cfa="mono" if monochrome else cfa,
                black_level=_black_level(raw, letters, monochrome),
                white_level=float(raw.white_level),
            )
        ]


def _read_frame(path: Path, _index: int) -> np.ndarray:
    with rawpy.imread(str(path)) as raw:
        return raw.raw_image_visible.copy()


def _black_level(raw: Any, letters: str, monochrome: bool) -> float | list[float]:
    black = np.asarray(raw.black_level_per_channel, float)
    if monochrome:
        return float(black[0])
    return [float(np.mean([b for b, one in zip(black, letters, strict=False) if one == c])) for c in "RGB"]


def _exif(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        return exifread.process_file(file, details=False)


def _first(exif: dict[str, Any], tag: str, libraw: float) -> float | None:
    """An EXIF value, or LibRaw's (float32; 0: unknown) if exifread does not know the container."""
    for key in (f"EXIF {tag}", f"Image {tag}"):
        if key in exif and exif[key].values:
            return float(exif[key].values[0])
    return float(libraw) if libraw > 0 else None
