"""TIFF files with one raw frame a page, by tifffile."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from hsnoise._types import BAYER_CFAS
from hsnoise.io._recording import UNKNOWN_ORDER, Recording, lazy_frames, naming

EXPOSURE_FROM = "EXIF ExposureTime"
_CFA_PHOTOMETRIC = 32803


def read(path: Path) -> list[Recording]:
    """The pages of a TIFF file as frames of one exposure; exposure, ISO and Bayer order from its tags.

    Raises:
        ValueError: unreadable, truncated, colour pages, or pages of several sizes.
    """
    with naming(path), tifffile.TiffFile(path) as file:
        pages = [page for page in file.pages if not page.is_reduced]  # reduced: a thumbnail
        sizes = {page.shape for page in pages}
        if len(sizes) != 1 or len(pages[0].shape) != 2:
            raise ValueError(f"expected pages [row, column] of one size, got {sorted(sizes)}")
        end, size = max(_next_page(file), *map(_end, pages)), path.stat().st_size
        if end > size:
            raise ValueError(f"truncated: {size} bytes, its tags promise {end}")
        tags = _tags(pages[0])
        counts = lazy_frames(path, _read_frame, len(pages), pages[0].shape, pages[0].dtype)
        return [
            Recording(
                path=path,
                counts=counts,
                exposure_s=_number(tags.get("ExposureTime")),
                iso=_number(tags.get("ISOSpeedRatings", tags.get("PhotographicSensitivity"))),
                cfa=_cfa(pages[0], tags),
            )
        ]


def _read_frame(path: Path, index: int) -> np.ndarray:
    with tifffile.TiffFile(path) as file:
        return [page for page in file.pages if not page.is_reduced][index].asarray()


def _next_page(file: tifffile.TiffFile) -> int:
    """Where a page that tifffile passed over for lying outside the file should begin; 0: none such."""
    file.filehandle.seek(file.pages.next_page_offset)
    return struct.unpack(file.tiff.offsetformat, file.filehandle.read(file.tiff.offsetsize))[0]


def _end(page: Any) -> int:
    """Where the page's last segment ends in the file, bytes."""
    segments = zip(page.dataoffsets, page.databytecounts, strict=True)
    return max((offset + length for offset, length in segments), default=0)


def _tags(page: Any) -> dict[str, Any]:
    """Tags by name, those of the EXIF directory too."""
    tags = {tag.name: tag.value for tag in page.tags.values()}
    return tags | tags.get("ExifTag", {})


def _number(value: Any) -> float | None:
    """A tag's number: rationals are pairs."""
    if value is None:
        return None
    if isinstance(value, tuple):
        return float(value[0] / value[1]) if len(value) == 2 and value[1] else float(value[0])
    return float(value)


def _cfa(page: Any, tags: dict[str, Any]) -> str | None:
    if page.photometric != _CFA_PHOTOMETRIC:
        return None
    pattern = tags.get("CFAPattern", ())
    codes = pattern if isinstance(pattern, bytes | tuple) else ()
    cfa = "".join("RGB"[code] for code in codes if code < 3)
    return cfa if cfa in BAYER_CFAS else UNKNOWN_ORDER
