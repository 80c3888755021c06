"""FITS files, read by Astropy."""

from __future__ import annotations

import gzip
import io
import math
import warnings
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from hsnoise._core.naming import setting
from hsnoise.frames.io._header import check_exposures, described
from hsnoise.frames.io._recording import LEAST_DECLARED, MOST_PACKED, Recording, check_held, lazy_frames, naming

MOST_COLUMNS = 999
BITS = (8, 16, 32, 64, -32, -64)
EXPOSURE_FROM = "EXPTIME, EXPOSURE or EXP_TIME in the FITS header"


def read(path: Path, hdu: int | str | None = None) -> list[Recording]:
    """The image of a FITS file: one frame, or frames of one exposure along the slowest axis of three.

    hdu: number or EXTNAME of the image's HDU, of a file with several; None for the only one.

    Exposure, kind, temperature, binning, gain, filter and Bayer order come from the image's header or, failing that,
    from the primary header; see `_header`.

    Raises:
        ValueError: unreadable, truncated, or not exactly one image of raw frames.
    """
    with naming(path), warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            with _opened(path, disable_image_compression=True) as file:
                _check_headers(file)
        except KeyError as card:
            raise ValueError(f"a header lacks {card}") from card
        with _opened(path) as file:
            found = _recording(path, file, hdu)
        # Astropy only warns of a file that is cut short, and its frames fail when they are read.
        cut = next((str(one.message) for one in told if "truncated" in str(one.message)), None)
        if cut is not None:
            raise ValueError(cut)
    for one in told:
        warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    return [found]


def _opened(path: Path, **options: Any) -> fits.HDUList:
    if path.suffix.lower() != ".gz":
        stream = path.open("rb")
        try:
            return fits.open(stream, memmap=False, **options)
        except BaseException:
            stream.close()  # Astropy does not
            raise
    state = path.stat()
    return fits.open(io.BytesIO(_unpacked(path, (state.st_size, state.st_mtime_ns))), **options)


@lru_cache(maxsize=1)
def _unpacked(path: Path, state: tuple[int, int]) -> bytes:
    """The content of a .gz file, checked to its end; kept, because each frame would have to unpack those before it."""
    most = max(LEAST_DECLARED, state[0] * MOST_PACKED)
    with gzip.open(path) as file:
        content = file.read(most + 1)
    check_held("the file", state[0], len(content))
    return content


def _check_headers(file: fits.HDUList) -> None:
    """Raise ValueError for headers with which Astropy would not come to an end, or fail without a reason.

    Sizes below 0, over which it goes back and reads the same again, tables of more columns than FITS allows, each of
    which it looks for, and numbers of another type. HDUs are read one after the other, as they are checked.
    """
    for hdu in file:
        for card in ("BZERO", "BSCALE", "BITPIX", "NAXIS"):
            number = hdu.header.get(card, 0)
            if isinstance(number, bool) or not isinstance(number, (int, float)):
                raise ValueError(f"{card}: expected a number, got {number!r:.60}")
        if hdu.header.get("BITPIX", 8) not in BITS:
            raise ValueError(f"BITPIX: expected one of {', '.join(map(str, BITS))}, got {hdu.header['BITPIX']!r:.60}")
        for i in range(1, int(hdu.header.get("NAXIS", 0)) + 1):
            size = hdu.header.get(f"NAXIS{i}")
            if isinstance(size, bool) or not (isinstance(size, int) and size >= 0):
                raise ValueError(f"NAXIS{i}: expected a size of 0 or more, got {size!r:.60}")
        n = hdu.header.get("TFIELDS", 0)
        if not (isinstance(n, int) and 0 <= n <= MOST_COLUMNS):
            raise ValueError(f"TFIELDS: expected 0 to {MOST_COLUMNS} columns, got {n!r:.60}")


def _recording(path: Path, file: fits.HDUList, hdu: int | str | None) -> Recording:
    index = _image_index(file, hdu)
    image = file[index]
    _check_complete(path, image)
    *frames, rows, columns = image.shape
    for one in (file[0].header, image.header):
        check_exposures(one)
    header = file[0].header.copy()
    header.update(image.header)
    shape = (frames[0] if frames else 1, (rows, columns))
    counts = lazy_frames(path, partial(_read_frame, hdu=index), *shape, _dtype(header))
    return Recording(path=path, counts=counts, **described(header, (rows, columns)))


def _read_frame(path: Path, index: int, *, hdu: int) -> np.ndarray:
    with _opened(path) as file:
        section = file[hdu].section
        return np.asarray(section[index, :, :] if len(section.shape) == 3 else section[:, :])


def _image_index(file: fits.HDUList, hdu: int | str | None) -> int:
    images = [i for i, one in enumerate(file) if hasattr(one, "section") and one.shape]
    wanted = images if hdu is None else [i for i in images if hdu == i or _same_name(hdu, file[i].name)]
    if len(wanted) == 1 and len(file[wanted[0]].shape) in (2, 3):
        return wanted[0]
    got = ", ".join(f"{i} {file[i].name} {file[i].shape}".replace("  ", " ") for i in images) or "none"
    if hdu is not None:
        raise ValueError(f"{setting('hdu', hdu)}: expected one of the images (number, name, shape): {got}")
    which = f"; {setting('hdu')} takes one of several, such as an amplifier's" if len(images) > 1 else ""
    raise ValueError(f"expected one image [row, column] or [frame, row, column], got {got}{which}")


def _same_name(hdu: int | str, name: str) -> bool:
    return isinstance(hdu, str) and hdu.strip().upper() == name.strip().upper() != ""


def _check_complete(path: Path, hdu: Any) -> None:
    if isinstance(hdu, fits.CompImageHDU):  # the decompressor notices by itself
        check_held("the image", path.stat().st_size, math.prod(hdu.shape) * abs(hdu.header["BITPIX"]) // 8)
        return
    place = hdu.fileinfo()
    end, size = place["datLoc"] + hdu.size, place["file"].size
    if end > size:
        raise ValueError(f"truncated: {size} bytes, its header promises {end}")


def _dtype(header: fits.Header) -> np.dtype:
    """The counts' dtype: BZERO makes signed integers unsigned; any other scaling makes them floats."""
    bits, zero = header["BITPIX"], header.get("BZERO", 0)
    if bits < 0 or header.get("BSCALE", 1) != 1:
        return np.dtype(np.float64 if bits == -64 else np.float32)
    return np.dtype(f"{'u' if bits == 8 or zero > 0 else 'i'}{bits // 8}")
