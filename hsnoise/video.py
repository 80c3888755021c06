"""Colour video in and out: files through PyAV, folders of images, NumPy arrays. Display values, 8 bits."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any
from zipfile import BadZipFile

import numpy as np

from hsnoise._frames import in_order

VIDEO = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
WRITTEN = tuple(suffix for suffix in VIDEO if suffix != ".webm")  # those that hold H.264
IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
QUALITY = {"crf": "16"}  # of x264: hard to tell from the original


def is_clip(path: Path) -> bool:
    """Whether `frames_of` might read this path."""
    if path.is_dir():
        return any(child.suffix.lower() in IMAGES for child in path.iterdir())
    return path.suffix.lower() in (*VIDEO, ".npz", ".npy")


def frames_of(path: str | os.PathLike) -> Iterator[np.ndarray]:
    """Frames [row, column, 3] of uint8, display values in R, G, B, one after the other.

    path: a video file, a folder of images (in the order of their names, numbers by their size), or an .npz (array
        `frames`) or .npy file.

    Raises:
        ValueError: an unknown format, no frames, frames of several sizes, images of more than 8 bits or with an
            alpha channel, or a video that cannot be read.
        ImportError: a video file, and PyAV is not installed.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"{path}: no such file or folder")
    suffix = path.suffix.lower()
    if path.is_dir():
        frames = _images(path)
    elif suffix in VIDEO:
        frames = _decoded(path)
    elif suffix in (".npz", ".npy"):
        frames = iter(_array(path))
    else:
        known = " ".join((*VIDEO, ".npz", ".npy"))
        raise ValueError(f"{path}: unknown format; expected a folder of images, or a file ending in {known}")
    shape = None
    for number, frame in enumerate(frames):
        if shape is not None and frame.shape != shape:
            raise ValueError(f"{path}: frame {number} has shape {frame.shape}, those before {shape}")
        shape = frame.shape
        yield frame
    if shape is None:
        raise ValueError(f"{path}: holds no frames")


def frame_rate_of(path: str | os.PathLike, default: float = 25) -> Fraction:
    """Frames a second of a video file; `default` of what says none. Raises ValueError for what cannot be read."""
    path = Path(path)
    if path.suffix.lower() in VIDEO:
        with _opened(path) as container:
            rate = container.streams.video[0].average_rate if container.streams.video else None
            if rate:
                return Fraction(rate)
    return Fraction(default).limit_denominator(1001)


def write_video(path: str | os.PathLike, frames: Iterable[np.ndarray], rate: Fraction) -> int:
    """Write frames [row, column, 3] of uint8 as H.264, all or nothing; returns how many.

    Odd sizes lose their last row or column: the format has none. Raises ValueError for no frames or an unknown
    suffix, ImportError without PyAV.
    """
    path = Path(path)
    if path.suffix.lower() not in WRITTEN:
        raise ValueError(f"{path}: expected a video file, ending in {', '.join(WRITTEN)}")
    av = _av(path)
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    count = 0
    try:
        with av.open(str(temporary), "w") as container:
            stream = container.add_stream("libx264", rate=rate, options=QUALITY)
            stream.pix_fmt = "yuv420p"
            for frame in frames:
                rows, columns = (n - n % 2 for n in frame.shape[:2])
                if min(rows, columns) < 2:
                    raise ValueError(f"frames: expected at least 2 x 2 pixels, got {frame.shape[0]} x {frame.shape[1]}")
                if not count:
                    stream.width, stream.height = columns, rows
                count += 1
                picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame[:rows, :columns]), format="rgb24")
                container.mux(stream.encode(picture))
            if not count:
                raise ValueError("frames: expected at least one, got none")
            container.mux(stream.encode())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return count


def _av(path: Path) -> ModuleType:
    try:
        import av
    except ImportError as error:
        raise ImportError(f"{path}: video files need PyAV: pip install 'hsnoise[video]'") from error
    return av


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    av = _av(path)
    try:
        with av.open(str(path)) as container:
            yield container
    except FileNotFoundError as error:
        raise ValueError(f"{path}: no such file or folder") from error
    except av.FFmpegError as error:
        raise ValueError(f"{path}: cannot be read as video ({error})") from error


def _decoded(path: Path) -> Iterator[np.ndarray]:
    with _opened(path) as container:
        if not container.streams.video:
            raise ValueError(f"{path}: holds no video")
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24")


def _images(folder: Path) -> Iterator[np.ndarray]:
    from PIL import Image, UnidentifiedImageError

    paths = [path for path in folder.iterdir() if path.suffix.lower() in IMAGES and not path.name.startswith(".")]
    for path in sorted(paths, key=in_order):
        try:
            with Image.open(path) as image:
                if image.mode.startswith(("I", "F")):
                    raise ValueError(f"{path}: expected 8 bits a channel, display values; got mode {image.mode}")
                if "A" in image.getbands() or "transparency" in image.info:
                    raise ValueError(f"{path}: expected an image without an alpha channel")
                pixels = np.asarray(image.convert("RGB"))
        except (UnidentifiedImageError, OSError) as error:
            raise ValueError(f"{path}: cannot be read as an image ({error})") from error
        yield pixels


def _array(path: Path) -> np.ndarray:
    try:
        with open(path, "rb") as file:
            content = np.load(file)
            frames = content["frames"] if path.suffix.lower() == ".npz" else content
    except (ValueError, OSError, KeyError, EOFError, BadZipFile) as error:
        raise ValueError(f"{path}: expected an array `frames` of video ({error})") from error
    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8:
        raise ValueError(
            f"{path}: expected frames [frame, row, column, 3] of uint8, got {frames.shape} of {frames.dtype}"
        )
    return frames
