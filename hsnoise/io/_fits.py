"""FITS files, by Astropy."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from hsnoise._frames import shift_cfa
from hsnoise._types import BAYER_CFAS
from hsnoise.io._recording import UNKNOWN_ORDER, Recording, lazy_frames, naming

EXPOSURE_FROM = "EXPTIME or EXPOSURE in the FITS header"


def read(path: Path) -> list[Recording]:
    """The image of a FITS file: one frame, or frames of one exposure along the slowest axis of three.

    EXPTIME or EXPOSURE (s), IMAGETYP (bias: a dark of 0 s), CCD-TEMP and BAYERPAT are taken from the image's
    header, or else from the primary one.

    Raises:
        ValueError: unreadable, truncated, or not exactly one image of raw frames.
    """
    with naming(path), fits.open(path, memmap=False) as file:
        index = _image_index(file)
        hdu = file[index]
        _check_complete(path, hdu)
        *frames, rows, columns = hdu.shape
        header = dict(file[0].header) | dict(hdu.header)
        kind = _kind(header)
        exposure_s = header.get("EXPTIME", header.get("EXPOSURE", 0.0 if kind == "bias" else None))
        temperature_c = header.get("CCD-TEMP")
        counts = lazy_frames(
            path, partial(_read_frame, hdu=index), frames[0] if frames else 1, (rows, columns), _dtype(header)
        )
        return [
            Recording(
                path=path,
                counts=counts,
                exposure_s=None if exposure_s is None else float(exposure_s),
                kind="dark" if kind == "bias" else kind,
                cfa=_cfa(header),
                temperature_c=None if temperature_c is None else float(temperature_c),
            )
        ]


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
        return  # a decompressor notices itself
    end, size = hdu.fileinfo()["datLoc"] + hdu.size, path.stat().st_size
    if end > size:
        raise ValueError(f"truncated: {size} bytes, its header promises {end}")


def _dtype(header: Mapping[str, Any]) -> np.dtype:
    """Of the counts: BZERO makes signed integers unsigned, any other scale makes them floating."""
    bits, zero = header["BITPIX"], header.get("BZERO", 0)
    if bits < 0 or header.get("BSCALE", 1) != 1:
        return np.dtype(np.float64 if bits == -64 else np.float32)
    return np.dtype(f"{'u' if bits == 8 or zero > 0 else 'i'}{bits // 8}")


def _kind(header: Mapping[str, Any]) -> str | None:
    """Kind by IMAGETYP: bias, dark or flat; any other text as it is."""
    text = str(header.get("IMAGETYP", "")).strip().lower()
    names = {"bias": "bias", "zero": "bias", "dark": "dark", "flat": "flat"}
    return next((kind for word, kind in names.items() if word in text), text or None)


def _cfa(header: Mapping[str, Any]) -> str | None:
    """Bayer order from the first stored pixel on; for ROWORDER BOTTOM-UP programs disagree what it means."""
    pattern = str(header.get("BAYERPAT", "")).strip().upper()
    if not pattern:
        return None
    if pattern not in BAYER_CFAS or str(header.get("ROWORDER", "")).strip().upper() == "BOTTOM-UP":
        return UNKNOWN_ORDER
    return shift_cfa(pattern, int(header.get("YBAYROFF", 0)), int(header.get("XBAYROFF", 0)))
