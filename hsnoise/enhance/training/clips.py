"""Clean clips to train and test on: folders of videos, or moving crops over scikit-image's pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hsnoise.chain.photometry import linear_from_display
from hsnoise.enhance.video import frames_of, is_clip

HELD_OUT_EVERY = 4
LONG = "_long"  # suffix of the name of a longer cut of the same video
STILLS = {"astronaut": "astronaut", "cells": "immunohistochemistry", "chelsea": "chelsea", "coffee": "coffee"}
STILLS |= {"deep_field": "hubble_deep_field", "retina": "retina", "rocket": "rocket"}  # the fourth is held out
MOVING_FRAMES, MOVING_CROP = 12, 192
FASTEST = 3.0  # pixels a frame
MOST_FRAMES = 300  # of a clip: longer videos are cut to fit into memory


@dataclass(frozen=True)
class Clip:
    """A clean clip: frames [frame, row, column, 3] of uint8 display values."""

    name: str
    frames: np.ndarray

    @property
    def source(self) -> str:
        """The video that it was cut from."""
        return source_of(self.name)

    @property
    def is_long(self) -> bool:
        """Whether it is a longer cut of a video."""
        return self.source != self.name

    @cached_property
    def average(self) -> float:
        """Average linear light of all frames (1 is white). Raises ValueError for a black clip."""
        counts = np.bincount(self.frames.reshape(-1), minlength=256)
        average = float(counts @ np.asarray(linear_from_display(np.arange(256) / 255)) / counts.sum())
        if not average > 0:
            raise ValueError(f"clip {self.name}: expected some light, got black frames")
        return average


class Batch(NamedTuple):
    """Pieces of clips: frames [example, frame, row, column, 3] of uint8, and the average light of each one's clip."""

    frames: np.ndarray
    average: np.ndarray


def source_of(name: str) -> str:
    """The video that a clip of this name was cut from."""
    return name.removesuffix(LONG)


def read_clips(folder: Path | None) -> list[Clip]:
    """All clips of a folder, sorted by name; without a folder, moving crops over scikit-image's pictures.

    Raises:
        ValueError: the folder has no clips, or one cannot be read.
    """
    if folder is None:
        return moving_stills()
    if not folder.is_dir():
        raise ValueError(f"--clips: expected a folder, got {folder}")
    paths = [path for path in sorted(folder.iterdir()) if is_clip(path)]
    if not paths and is_clip(folder):
        paths = [folder]
    if not paths:
        raise ValueError(f"--clips: found no videos, folders of images or .npz files in {folder}")
    return [Clip(path.name if path.is_dir() else path.stem, _first_frames(path)) for path in paths]


def _first_frames(path: Path) -> np.ndarray:
    frames = []
    for frame in frames_of(path):
        frames.append(frame)
        if len(frames) == MOST_FRAMES:
            break
    return np.stack(frames)


def held_out(clips: Sequence[Clip], fold: int = 0) -> tuple[list[Clip], list[Clip]]:
    """(to train on, held out): every fourth video by name is held out with all its cuts; each fold takes others.

    Raises:
        ValueError: fewer than two videos.
    """
    sources = sorted({clip.source for clip in clips})
    if len(sources) < 2:
        raise ValueError(f"clips: expected at least two videos, because one is held out; got {len(sources)}")
    every = min(HELD_OUT_EVERY, len(sources))
    kept = set(sources[(every - 1 - fold) % every :: every])
    train = [clip for clip in clips if clip.source not in kept]
    return without_longer_cuts(train), [clip for clip in clips if clip.source in kept]


def without_longer_cuts(clips: Sequence[Clip]) -> list[Clip]:
    """Clips to train on: a longer cut adds nothing new to the clip that it continues."""
    names = {clip.name for clip in clips}
    return [clip for clip in clips if clip.name == clip.source or clip.source not in names]


def check_sizes(clips: Sequence[Clip], frames: int, side: int) -> None:
    """Raise ValueError unless every clip has at least `side` rows and columns, and at least half the frames."""
    for clip in clips:
        n, rows, columns = clip.frames.shape[:3]
        if n < (frames + 1) // 2 or min(rows, columns) < side:
            raise ValueError(
                f"clip {clip.name}: {n} frames of {rows} x {columns}; expected {frames} frames (or half of them,"
                f" forth and back) of at least {side} x {side}"
            )


def moving_stills(seed: int = 0) -> list[Clip]:
    """Crops that move over scikit-image's pictures at a steady speed of up to 3 pixels a frame."""
    import skimage.data

    rng = np.random.default_rng(seed)
    clips = []
    for name, loader in STILLS.items():
        picture = np.asarray(getattr(skimage.data, loader)())
        clips.append(Clip(f"still_{name}", _moved(picture, rng)))
    return clips


def _moved(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    side = min(MOVING_CROP, *(n - int(FASTEST * MOVING_FRAMES) - 1 for n in picture.shape[:2]))
    room = np.array(picture.shape[:2]) - side - 1
    reach = rng.uniform(-FASTEST, FASTEST, 2) * (MOVING_FRAMES - 1)
    start = rng.uniform(np.maximum(-reach, 0), np.minimum(room - reach, room))
    places = np.rint(start + np.linspace(0, 1, MOVING_FRAMES)[:, None] * reach).astype(int)
    return np.stack([picture[r : r + side, c : c + side] for r, c in places])


def crops(clips: Sequence[Clip], rng: np.random.Generator, batch: int, frames: int, side: int) -> Batch:
    """Random pieces of random clips, mirrored at random.

    A shorter clip gives all its frames from a random one on, forth and back.
    """
    out = Batch(np.empty((batch, frames, side, side, 3), np.uint8), np.empty(batch, np.float32))
    for i in range(batch):
        clip = clips[int(rng.integers(len(clips)))]
        video = clip.frames
        row, column = (rng.integers(n - side + 1) for n in video.shape[1:3])
        piece = video[_places(len(video), frames, rng), row : row + side, column : column + side]
        if rng.integers(2):
            piece = piece[:, ::-1]
        if rng.integers(2):
            piece = piece[:, :, ::-1]
        if rng.integers(2):
            piece = piece.swapaxes(1, 2)
        if rng.integers(2):
            piece = piece[::-1]
        out.frames[i], out.average[i] = piece, clip.average
    return out


def _places(length: int, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Indices of `frames` consecutive frames, reversing at the ends of the clip."""
    if length >= frames:
        return rng.integers(length - frames + 1) + np.arange(frames)
    round_trip = np.concatenate([np.arange(length), np.arange(length - 2, 0, -1)])
    return round_trip[(rng.integers(len(round_trip)) + np.arange(frames)) % len(round_trip)]
