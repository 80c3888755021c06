"""Reading and writing colour video: files by PyAV, folders of images, NumPy arrays. Display values, 8 bits."""

from __future__ import annotations

import os
import uuid
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from hsnoise._core.interrupting import unfinished
from hsnoise.frames.lazy import in_order

VIDEO = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
WRITTEN = tuple(suffix for suffix in VIDEO if suffix != ".webm")  # formats that hold H.264
IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
# Options of x264. crf: visually lossless. mbtree: would make the file differ each time.
OPTIONS = {"crf": "16", "mbtree": "0"}
BT709 = 1  # matrix, primaries and curve of HD video, in ITU-T H.273
BITS_PER_SAMPLE = 258  # tag of TIFF
LIMITED = 1  # FFmpeg's number for the range 16 to 235
WHOLE, SLACK_S = 0.95, 0.2  # of the length that a file announces: less means lost frames, not a longer sound track


def is_clip(path: Path) -> bool:
    """Whether `frames_of` might read this path. Hidden files are excluded: macOS adds one beside every file."""
    if path.is_dir():
        return any(map(_is_image, path.iterdir()))
    return not path.name.startswith(".") and path.suffix.lower() in (*VIDEO, ".npz", ".npy")


def _is_image(path: Path) -> bool:
    return not path.name.startswith(".") and path.suffix.lower() in IMAGES


def frames_of(path: str | os.PathLike) -> Iterator[np.ndarray]:
    """Frames [row, column, 3] of uint8, display values in R, G, B, upright, one after the other.

    Warns after the last frame if a video file is truncated or damaged.

    path: a video file, a folder of images (sorted by name, with numbers compared as numbers; every page of a TIFF
        is a frame), or an .npz (array `frames`) or .npy file.

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
    """Frames per second of a video file; `default` if it states none. Raises ValueError if it cannot be read."""
    path = Path(path)
    if path.suffix.lower() in VIDEO:
        with _opened(path) as container:
            rate = container.streams.video[0].average_rate if container.streams.video else None
            if rate:
                return Fraction(rate)
    return Fraction(default).limit_denominator(1001)


def write_video(path: str | os.PathLike, frames: Iterable[np.ndarray], rate: Fraction) -> int:
    """Write frames [row, column, 3] of uint8 as H.264 in HD video colours, all or nothing; returns their number.

    Odd sizes lose their last row or column, with a warning: H.264 has even sizes. Raises ValueError for no frames or
    an unknown suffix, ImportError without PyAV.
    """
    path = Path(path)
    if path.suffix.lower() not in WRITTEN:
        raise ValueError(f"{path}: expected a video file, ending in {', '.join(WRITTEN)}")
    av = _av(path)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex}.tmp{path.suffix}")
    count = 0
    with unfinished(temporary):
        with av.open(str(temporary), "w") as container:
            stream = _stream(container, rate)
            for frame in frames:
                if not count:
                    stream.height, stream.width = _even(frame.shape[:2])
                count += 1
                pixels = np.ascontiguousarray(frame[: stream.height, : stream.width])
                picture = av.VideoFrame.from_ndarray(pixels, format="rgb24")
                picture = picture.reformat(format=stream.pix_fmt, dst_colorspace=BT709, dst_color_range=LIMITED)
                container.mux(stream.encode(picture))
            if not count:
                raise ValueError("frames: expected at least one, got none")
            container.mux(stream.encode())
        os.replace(temporary, path)
    return count


def _stream(container: Any, rate: Fraction) -> Any:
    stream = container.add_stream("libx264", rate=rate, options=OPTIONS)
    stream.pix_fmt = "yuv420p"
    context = stream.codec_context
    context.colorspace = context.color_primaries = context.color_trc = BT709
    context.color_range = LIMITED
    return stream


def _even(shape: tuple[int, int]) -> tuple[int, int]:
    rows, columns = (n - n % 2 for n in shape)
    if min(rows, columns) < 2:
        raise ValueError(f"frames: expected at least 2 x 2 pixels, got {shape[0]} x {shape[1]}")
    if (rows, columns) != shape:
        warnings.warn(
            f"frames: H.264 has even sizes only, so {rows} x {columns} of {shape[0]} x {shape[1]} pixels are written",
            stacklevel=3,
        )
    return rows, columns


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
        count, end_s, damaged = 0, 0.0, False
        for packet in container.demux(video=0):
            damaged |= packet.is_corrupt
            start = packet.dts if packet.pts is None else packet.pts
            if start is not None:
                end_s = max(end_s, float((start + (packet.duration or 0)) * packet.time_base))
            for frame in packet.decode():
                damaged |= frame.is_corrupt
                count += 1
                yield np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90))
        announced_s = _length_s(container)
        if damaged or end_s < WHOLE * announced_s - SLACK_S:  # FFmpeg skips what it cannot read without an error
            warnings.warn(
                f"{path}: truncated or damaged; {count} frames could be read, up to {end_s:.3g} s, of a video of"
                f" {announced_s:.3g} s",
                stacklevel=2,
            )


def _length_s(container: Any) -> float:
    """Length of the video, s, as the file announces it; 0 if it does not."""
    stream = container.streams.video[0]
    if stream.duration:
        return float(stream.duration * stream.time_base)
    if "DURATION" in stream.metadata:  # of Matroska
        hours, minutes, seconds = map(float, stream.metadata["DURATION"].split(":"))
        return 3600 * hours + 60 * minutes + seconds
    return (container.duration or 0) / 1e6  # microseconds; the longest stream's


def _images(folder: Path) -> Iterator[np.ndarray]:
    from PIL import Image, UnidentifiedImageError

    for path in sorted(filter(_is_image, folder.iterdir()), key=in_order):
        try:
            with Image.open(path) as image:
                yield from _pages(path, image)
        except (UnidentifiedImageError, OSError) as error:
            raise ValueError(f"{path}: cannot be read as an image ({error})") from error


def _pages(path: Path, image: Any) -> Iterator[np.ndarray]:
    from PIL import ImageOps, ImageSequence

    for page in ImageSequence.Iterator(image):
        if _is_deep(page):
            raise ValueError(f"{path}: expected 8 bits a channel, display values; got more")
        if "A" in page.getbands() or "transparency" in page.info:
            raise ValueError(f"{path}: expected an image without an alpha channel")
        yield np.asarray(ImageOps.exif_transpose(page).convert("RGB"))
        if image.format == "MPO":  # from phones: its other pictures are depth or gain maps
            return


def _is_deep(page: Any) -> bool:
    """Whether the file holds more than 8 bits a channel, which Pillow reduces to 8 for three channels."""
    in_tiff = getattr(page, "tag_v2", {}).get(BITS_PER_SAMPLE, (8,))
    in_png = any(str(tile.args).endswith(";16B") for tile in page.tile)
    return in_png or max(in_tiff) > 8 or page.mode.startswith(("I", "F"))


def _array(path: Path) -> np.ndarray:
    try:
        with open(path, "rb") as file:
            content = np.load(file)
            frames = content if isinstance(content, np.ndarray) else content["frames"]
    except Exception as error:  # archives and headers can fail in countless ways
        raise ValueError(f"{path}: expected an array `frames` of video ({error})") from error
    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8:
        raise ValueError(
            f"{path}: expected frames [frame, row, column, 3] of uint8, got {frames.shape} of {frames.dtype}"
        )
    return frames
