"""TIFF files with one raw frame per page, read by tifffile."""

from __future__ import annotations

import struct
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from hsnoise._core.types import BAYER_CFAS
from hsnoise.frames.io._recording import UNKNOWN_ORDER, Recording, check_held, lazy_frames, naming
from hsnoise.frames.lazy import LazyFrames

EXPOSURE_FROM = "EXIF ExposureTime"
_CFA_PHOTOMETRIC, _CFA_PATTERN, _UNCOMPRESSED = 32803, 33422, 1
_HEADER = 8  # bytes


def read(path: Path) -> list[Recording]:
    """The pages of a TIFF file as frames, grouped by exposure and ISO; the Bayer order is the first page's.

    Raises:
        ValueError: unreadable, truncated, colour pages, pages of several sizes, an invalid exposure or ISO.
    """
    with naming(path), tifffile.TiffFile(path) as file:
        pages = _pages(file)
        sizes = {(page.shape, str(page.dtype)) for page in pages}
        if len(sizes) != 1 or len(pages[0].shape) != 2:
            raise ValueError(f"expected pages [row, column] of one size and type, got {sorted(sizes)}")
        _check_segments(pages, _next_page(file), path.stat().st_size)
        first = _tags(pages[0])
        groups: dict[tuple[float | None, float | None], list[int]] = {}
        for page in pages:
            tags = first | _tags(page)  # a page inherits the first page's tags
            groups.setdefault((_exposure_s(tags), _iso(tags)), []).append(page.offset)
        return [
            Recording(
                path=path,
                counts=_frames(path, places, pages[0]),
                exposure_s=exposure_s,
                iso=iso,
                cfa=_cfa(pages[0], first),
            )
            for (exposure_s, iso), places in groups.items()
        ]


def _pages(file: tifffile.TiffFile) -> list[Any]:
    """All pages but thumbnails. Raises ValueError for pages that lead in a circle."""
    pages, places = [], set()
    for page in file.pages:
        if page.offset in places:
            raise ValueError("its last page leads back to an earlier one")
        places.add(page.offset)
        if not page.is_reduced:
            pages.append(page)
    return pages


def _check_segments(pages: list[Any], next_page: int, size: int) -> None:
    """Raise ValueError unless the segments of all pages lie side by side in the file and can hold their pixels."""
    segments = sorted(pair for page in pages for pair in zip(page.dataoffsets, page.databytecounts, strict=True))
    end = max(next_page, *(offset + length for offset, length in segments))
    if end > size:
        raise ValueError(f"truncated: {size} bytes, its tags promise {end}")
    ends = [_HEADER, *(offset + length for offset, length in segments)]
    if any(offset < end for (offset, _), end in zip(segments, ends, strict=False)):
        raise ValueError("the pixels of its pages overlap")
    for page in pages:
        held = sum(page.databytecounts)
        if page.compression == _UNCOMPRESSED and held < page.nbytes:
            raise ValueError(f"its tags declare {page.nbytes} bytes of pixels, and it holds {held}")
        check_held("pixels", held, page.nbytes)


def _frames(path: Path, places: list[int], page: Any) -> LazyFrames:
    return lazy_frames(path, partial(_read_frame, places=tuple(places)), len(places), page.shape, page.dtype)


def _read_frame(path: Path, index: int, *, places: tuple[int, ...]) -> np.ndarray:
    """The page whose directory is at `places[index]`: walking through the pages before it would take quadratic time."""
    with tifffile.TiffFile(path) as file:
        file.filehandle.seek(places[index])
        return tifffile.TiffPage(file, index).asarray()


def _next_page(file: tifffile.TiffFile) -> int:
    """Offset of a page that tifffile skipped because it is outside the file; 0: there is none."""
    file.filehandle.seek(file.pages.next_page_offset)
    return struct.unpack(file.tiff.offsetformat, file.filehandle.read(file.tiff.offsetsize))[0]


def _tags(page: Any) -> dict[str, Any]:
    """Tags by name, including those of the EXIF directory."""
    tags = {tag.name: tag.value for tag in page.tags.values()}
    return tags | tags.get("ExifTag", {})


def _exposure_s(tags: dict[str, Any]) -> float | None:
    """The exposure, a rational: a pair of whole numbers."""
    value = tags.get("ExposureTime")
    if value is None:
        return None
    if not isinstance(value, tuple) or len(value) != 2 or not value[1]:
        raise ValueError(f"ExposureTime: expected one rational number of seconds, got {value}")
    return float(value[0] / value[1])


def _iso(tags: dict[str, Any]) -> float | None:
    """The ISO; 0 means unknown. Some cameras write it twice."""
    value = tags.get("ISOSpeedRatings", tags.get("PhotographicSensitivity"))
    numbers = set(value) if isinstance(value, tuple) else {value}
    if len(numbers) > 1:
        raise ValueError(f"ISOSpeedRatings: expected one number, got {value}")
    (one,) = numbers
    return float(one) if one else None


def _cfa(page: Any, tags: dict[str, Any]) -> str | None:
    if page.photometric != _CFA_PHOTOMETRIC and _CFA_PATTERN not in page.tags:
        return None
    pattern = tags.get("CFAPattern", ())
    codes = pattern if isinstance(pattern, bytes | tuple) else ()
    cfa = "".join("RGB"[code] for code in codes if code < 3)
    return cfa if cfa in BAYER_CFAS else UNKNOWN_ORDER
