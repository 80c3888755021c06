"""Greyscale PNG files, read by Pillow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from hsnoise.frames.io._recording import Recording, lazy_frames, naming

EXPOSURE_FROM = "the PNG format, which has none"
_DTYPES = {"I;16": np.uint16, "L": np.uint8}
_DEPTH_AT = 24  # byte of the file that holds the bits per sample


def read(path: Path) -> list[Recording]:
    """One frame of a greyscale PNG of 16 bits (or 8); the format does not hold the exposure.

    Raises:
        ValueError: unreadable, or a colour image.
    """
    with naming(path), Image.open(path) as image:
        if image.mode not in _DTYPES:
            raise ValueError(f"expected a greyscale PNG of 16 or 8 bits, got mode {image.mode!r}")
        frame_shape, dtype = (image.height, image.width), _DTYPES[image.mode]
        return [Recording(path=path, counts=lazy_frames(path, _read_frame, 1, frame_shape, dtype))]


def _read_frame(path: Path, _index: int) -> np.ndarray:
    with Image.open(path) as image:
        image.verify()  # checksums, which Pillow ignores where pixels are
    with Image.open(path) as image:
        counts = np.asarray(image)
    with path.open("rb") as file:
        depth = file.read(_DEPTH_AT + 1)[_DEPTH_AT] if counts.dtype == np.uint8 else 8
    return counts // (255 // (2**depth - 1))  # Pillow stretches 2 and 4 bits to 8
