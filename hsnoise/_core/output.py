"""Output files: written whole or not at all, and frames in the formats that `hsnoise.load` reads."""

from __future__ import annotations

import errno
import io
import os
import uuid
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from hsnoise._core.interrupting import unfinished
from hsnoise._core.naming import named

FRAME_FORMATS = (".npz", ".npy", ".tif", ".tiff", ".fits")
_EXPOSURE_TIME_TAG, _RATIONAL = 33434, 5
MOST_PART = 2**32 - 1  # above and below the line of a rational number in a tag
SAME_EXPOSURE = 1e-3  # exposures that differ by less count as the same when they are read


def is_one_file(one: Path, other: Path) -> bool:
    """Whether two paths lead to the same file that is there: to write one would lose the other."""
    return one.exists() and other.exists() and one.samefile(other)


def write_atomically(path: str | os.PathLike, content: bytes) -> None:
    """Write a file so that a reader finds either the old or the new content, never half of it.

    Raises:
        OSError: the folder does not exist or cannot be written; an existing file is left as it was.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "expected a file, but it is a folder", str(path))
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    with unfinished(temporary):
        try:
            with open(temporary, "xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)  # atomic within a directory
        except OSError as error:
            if error.errno is None:
                raise
            raise type(error)(error.errno, error.strerror, str(path)) from error  # not of the temporary file


def check_file(name: str, path: Path, made: str | os.PathLike | None = None) -> None:
    """Raise ValueError, naming the argument, unless `path` may be a file in a folder that exists or is `made` later."""
    if path.is_dir():
        raise ValueError(f"{named(name)}: expected a file, but {path} is a folder")
    if not path.parent.is_dir() and (made is None or path.parent.resolve() != Path(made).resolve()):
        raise ValueError(f"{named(name)}: there is no folder {path.parent}")


def write_figure(path: str | os.PathLike, figure: Any, **keywords: Any) -> None:
    """Write a Matplotlib figure as PNG, all or nothing; `keywords` go to `savefig`."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", **keywords)
    write_atomically(path, buffer.getvalue())


def frames_file(suffix: str, counts: np.ndarray, metadata: Mapping[str, Any]) -> bytes:
    """The content of a file of raw frames.

    Args:
        suffix: one of `FRAME_FORMATS`. Only .npz holds several exposures and all metadata; .fits holds exposure,
            kind and Bayer order, .tif the exposure, .npy the counts alone.
        counts: DN, `[exposure, frame, row, column]`.
        metadata: exposure_s [exposure], kind, cfa, and any other field that `hsnoise.load` reads from an .npz file.

    Raises:
        ValueError: an unknown suffix, or a format that cannot hold the exposures.
    """
    if suffix not in FRAME_FORMATS:
        raise ValueError(
            f"cannot write frames as {suffix or 'a file without suffix'}; known: {' '.join(FRAME_FORMATS)}"
        )
    if suffix in (".tif", ".tiff", ".fits") and len(counts) > 1:
        raise ValueError(f"a {suffix} file holds one exposure, got {len(counts)}; write an .npz file, or one file each")
    buffer = io.BytesIO()
    if suffix == ".npz":
        np.savez_compressed(buffer, counts=counts, **metadata)
    elif suffix == ".npy":
        np.save(buffer, counts)
    elif suffix == ".fits":
        _write_fits(buffer, counts[0], metadata)
    else:
        _write_tiff(buffer, counts[0], metadata)
    return buffer.getvalue()


def _write_fits(buffer: io.BytesIO, frames: np.ndarray, metadata: Mapping[str, Any]) -> None:
    from astropy.io import fits

    header = fits.Header()
    header["EXPTIME"] = (float(metadata["exposure_s"][0]), "s")
    header["IMAGETYP"] = metadata["kind"]
    if metadata["cfa"] != "mono":
        header["BAYERPAT"] = metadata["cfa"]
        header["ROWORDER"] = "TOP-DOWN"
    fits.PrimaryHDU(frames, header).writeto(buffer)


def _write_tiff(buffer: io.BytesIO, frames: np.ndarray, metadata: Mapping[str, Any]) -> None:
    import tifffile

    seconds = float(metadata["exposure_s"][0])
    exposure_s = Fraction(seconds).limit_denominator(MOST_PART)
    if exposure_s.numerator > MOST_PART or abs(exposure_s - Fraction(seconds)) > SAME_EXPOSURE * seconds:
        raise ValueError(f"a .tif file cannot hold an exposure of {seconds:g} s; write an .npz or a .fits file")
    tag = (_EXPOSURE_TIME_TAG, _RATIONAL, 1, exposure_s.as_integer_ratio(), True)
    with tifffile.TiffWriter(buffer) as file:
        for frame in frames:
            file.write(frame, photometric="minisblack", metadata=None, extratags=[tag])


def _image(path: Path) -> Any:
    suffix = path.suffix.lower()
    if suffix == ".npy":
        with path.open("rb") as file:  # NumPy leaves it open if it is broken
            return np.load(file)
    if suffix in (".tif", ".tiff"):
        import tifffile

        return tifffile.imread(path)
    if suffix == ".png":
        from PIL import Image

        with Image.open(path) as file:
            return np.asarray(file)
    raise ValueError("unknown image format; known are .npy, .tif, .tiff and .png")


def read_image(path: str | os.PathLike) -> np.ndarray:
    """An image of light, `[row, column]` or `[row, column, 3]` in R, G, B, from .npy, .tif or .png.

    Raises:
        ValueError: an unknown format, a broken file, or an array of another shape.
        OSError: no such file.
    """
    path = Path(path)
    try:
        image = _image(path)
    except Exception as error:  # each library has its own for a broken file
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise ValueError(f"{path}: cannot be read as an image: {error or type(error).__name__}") from error
    if not isinstance(image, np.ndarray):
        image.close()
        raise ValueError(f"{path}: expected one array, got an archive of several (.npz)")
    if image.dtype.kind not in "biuf":
        raise ValueError(f"{path}: expected an image of real numbers, got {image.dtype}")
    if image.ndim != 2 and not (image.ndim == 3 and image.shape[2] == 3):
        raise ValueError(f"{path}: expected an image [row, column] or [row, column, 3], got shape {image.shape}")
    return image
