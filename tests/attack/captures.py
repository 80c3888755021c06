"""Valid captures of three small frames, one writer a format, each by the format's own library."""

from __future__ import annotations

import gzip
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import tifffile
from astropy.io import fits
from PIL import Image

SHAPE = (3, 16, 24)
EXPOSURE_S = 0.25
FIELDS: dict[str, Any] = {
    "exposure_s": EXPOSURE_S,
    "kind": "dark",
    "cfa": "RGGB",
    "black_level": 900.0,
    "white_level": 4095.0,
    "shutter": "rolling",
    "iso": 800.0,
    "temperature_c": 20.0,
}
FILLERS = 4  # comments of a FITS header, places for further keywords
EXPOSURE, BAYER, REPEAT = 33434, 33422, 33421


def frames(dtype: Any = np.uint16) -> np.ndarray:
    return np.random.default_rng(1).normal(1000, 20, SHAPE).round().astype(dtype)


def npy(path: Path, counts: np.ndarray | None = None) -> None:
    np.save(path, frames() if counts is None else counts, allow_pickle=True)


def npz(path: Path, **fields: Any) -> None:
    with path.open("wb") as file:
        np.savez_compressed(file, **{"counts": frames(), **FIELDS, **fields})


def hdf5(path: Path, counts: Any = None, **options: Any) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("counts", data=frames() if counts is None else counts, **options)
        file.attrs.update(FIELDS)


def fits_header() -> fits.Header:
    header = fits.Header()
    header["EXPTIME"] = (EXPOSURE_S, "s")
    header["IMAGETYP"] = "dark"
    header["BAYERPAT"] = "RGGB"
    header["CCD-TEMP"] = 20.0
    for i in range(FILLERS):
        header["COMMENT"] = f"filler {i}"
    return header


def fits_bytes(counts: np.ndarray | None = None) -> bytes:
    buffer = io.BytesIO()
    fits.PrimaryHDU(frames() if counts is None else counts, fits_header()).writeto(buffer)
    return buffer.getvalue()


def packed_fits(path: Path) -> None:
    compressed = fits.CompImageHDU(frames(), fits_header(), compression_type="RICE_1")
    fits.HDUList([fits.PrimaryHDU(), compressed]).writeto(path)


def tiff_bytes(counts: np.ndarray | None = None, **options: Any) -> bytes:
    buffer = io.BytesIO()
    tags = [
        (EXPOSURE, "2I", 1, (1, 4), True),
        (REPEAT, "H", 2, (2, 2), True),
        (BAYER, "B", 4, (0, 1, 1, 2), True),
    ]
    with tifffile.TiffWriter(buffer, byteorder="<") as file:
        for page in frames() if counts is None else counts:
            file.write(page, photometric=32803, metadata=None, software=False, extratags=tags, **options)
    return buffer.getvalue()


def png_bytes(frame: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, "png")
    return buffer.getvalue()


def dng_bytes(frame: np.ndarray) -> bytes:
    """The least DNG that LibRaw opens."""
    identity = [x for value in np.eye(3, dtype=int).ravel() for x in (int(value), 1)]
    tags = [
        (REPEAT, "H", 2, (2, 2), True),
        (BAYER, "B", 4, (0, 1, 1, 2), True),
        (50706, "B", 4, (1, 4, 0, 0), True),  # DNGVersion
        (50708, "s", 0, "hsnoise test camera", True),  # UniqueCameraModel
        (50713, "H", 2, (2, 2), True),  # BlackLevelRepeatDim
        (50714, "H", 4, (900, 900, 900, 900), True),  # BlackLevel
        (50717, "H", 1, 4095, True),  # WhiteLevel
        (50721, "2i", 9, identity, True),  # ColorMatrix1
        (271, "s", 0, "hsnoise", True),  # Make
        (272, "s", 0, "test", True),  # Model
        (EXPOSURE, "2I", 1, (1, 4), True),
    ]
    buffer = io.BytesIO()
    with tifffile.TiffWriter(buffer, byteorder="<") as file:
        # LibRaw takes no frame of fewer than 22 rows.
        file.write(np.tile(frame, (2, 2)), photometric=32803, extratags=tags, metadata=None, subfiletype=0)
    return buffer.getvalue()


def _of_files(suffix: str, content: Callable[[np.ndarray], bytes]) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        for i, frame in enumerate(frames()):
            (folder / f"{i}{suffix}").write_bytes(content(frame))

    return write


# By name: what writes a clean capture into a folder, and its first file.
CLEAN: dict[str, tuple[Callable[[Path], Any], str]] = {
    "npy": (lambda folder: npy(folder / "a.npy"), "a.npy"),
    "npz": (lambda folder: npz(folder / "a.npz"), "a.npz"),
    "hdf5": (lambda folder: hdf5(folder / "a.h5"), "a.h5"),
    "fits": (lambda folder: (folder / "a.fits").write_bytes(fits_bytes()), "a.fits"),
    "fits.gz": (lambda folder: (folder / "a.fits.gz").write_bytes(gzip.compress(fits_bytes(), mtime=0)), "a.fits.gz"),
    "fits.fz": (lambda folder: packed_fits(folder / "a.fits.fz"), "a.fits.fz"),
    "tiff": (lambda folder: (folder / "a.tif").write_bytes(tiff_bytes()), "a.tif"),
    "png": (_of_files(".png", png_bytes), "0.png"),
    "raw": (_of_files(".dng", dng_bytes), "0.dng"),
}
# What `hsnoise.load` needs beside the files.
GIVEN: dict[str, dict[str, Any]] = {
    "npy": {"exposure_s": EXPOSURE_S, "cfa": "RGGB"},
    "png": {"exposure_s": EXPOSURE_S, "cfa": "RGGB"},
}
