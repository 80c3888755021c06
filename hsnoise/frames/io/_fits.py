"""FITS files, read by Astropy."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from hsnoise.frames.io._header import described
from hsnoise.frames.io._recording import Recording, lazy_frames, naming

EXPOSURE_FROM = "EXPTIME, EXPOSURE or EXP_TIME in the FITS header"


def read(path: Path) -> list[Recording]:
    """The image of a FITS file: one frame, or frames of one exposure along the slowest axis of three.

    Exposure, kind, temperature, binning, gain, filter and Bayer order come from the image's header or, failing that,
    from the primary header; see `_header`.

    Raises:
        ValueError: unreadable, truncated, or not exactly one image of raw frames.
    """
    with naming(path), warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        with fits.open(path, memmap=False) as file:
            found = _recording(path, file)
        # Astropy only warns of a file that is cut short, and its frames fail when they are read.
        cut = next((str(one.message) for one in told if "truncated" in str(one.message)), None)
        if cut is not None:
            raise ValueError(cut)
    for one in told:
        warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    return [found]


def _recording(path: Path, file: fits.HDUList) -> Recording:
    index = _image_index(file)
    hdu = file[index]
    _check_complete(path, hdu)
    *frames, rows, columns = hdu.shape
    header = file[0].header.copy()
    header.update(hdu.header)
    shape = (frames[0] if frames else 1, (rows, columns))
    counts = lazy_frames(path, partial(_read_frame, hdu=index), *shape, _dtype(header))
    return Recording(path=path, counts=counts, **described(header, (rows, columns)))


def _read_frame(path: Path, index: int, *, hdu: int) -> np.ndarray:
    with fits.open(path, memmap=False) as file:
        section = file[hdu].section
        return np.asarray(section[index, :, :] if len(section.shape) == 3 else section[:, :])


def _image_index(file: fits.HDUList) -> int:
    images = [i for i, hdu in enumerate(file) if hasattr(hdu, "section") and hdu.shape]
    if len(images) != 1 or len(file[images[0]].shape) not in (2, 3):
        shapes = [file[i].shape for i in images]
        raise ValueError(f"expected one image [row, column] or [frame, row, column], got {shapes or 'none'}")
    return images[0]


def _check_complete(path: Path, hdu: Any) -> None:
    if isinstance(hdu, fits.CompImageHDU) or path.suffix.lower() == ".gz":
        return  # the decompressor notices by itself
    end, size = hdu.fileinfo()["datLoc"] + hdu.size, path.stat().st_size
    if end > size:
        raise ValueError(f"truncated: {size} bytes, its header promises {end}")


def _dtype(header: fits.Header) -> np.dtype:
    """The counts' dtype: BZERO makes signed integers unsigned; any other scaling makes them floats."""
    bits, zero = header["BITPIX"], header.get("BZERO", 0)
    if bits < 0 or header.get("BSCALE", 1) != 1:
        return np.dtype(np.float64 if bits == -64 else np.float32)
    return np.dtype(f"{'u' if bits == 8 or zero > 0 else 'i'}{bits // 8}")
