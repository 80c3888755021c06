"""Which clips train, which validate and which are scored: a fixed split in a file."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from hsnoise.enhance.training.clips import Clip, held_out, without_longer_cuts

LISTS = ("training", "validation", "test")


class Split(NamedTuple):
    """Clips to train on, clips to validate and tune with, and clips to score."""

    training: list[Clip]
    validation: list[Clip]
    test: list[Clip]


def split_of(clips: Sequence[Clip], path: Path | None) -> Split:
    """The split of a TOML file with the lists `training`, `validation` and `test` of videos; others are not used.

    A video's name stands for all its cuts. Without a file, every fourth video both validates and is scored.

    Raises:
        ValueError: a file that cannot be read, other lists, an empty list, a video in two, or one that is not there.
    """
    if path is None:
        training, kept = held_out(clips)
        return Split(training, kept, kept)
    lists = _lists(path)
    twice = sorted(name for name, times in Counter(sum(lists.values(), [])).items() if times > 1)
    if twice:
        raise ValueError(f"--split: expected each video once in {path}, got {', '.join(twice)} more often")
    missing = sorted({*sum(lists.values(), [])} - {clip.source for clip in clips})
    if missing:
        raise ValueError(f"--split: {path} names {', '.join(missing)}, of which --clips has no clip")
    found = {name: [clip for clip in clips if clip.source in videos] for name, videos in lists.items()}
    return Split(without_longer_cuts(found["training"]), found["validation"], found["test"])


def _lists(path: Path) -> dict[str, list[str]]:
    try:
        lists = tomllib.loads(path.read_text())
    except OSError as error:
        raise ValueError(f"--split: {path}: {error.strerror}") from error
    except ValueError as error:  # tomllib's, or that of wrong bytes
        raise ValueError(f"--split: expected a TOML file, got {path} ({error})") from error
    if set(lists) != set(LISTS):
        raise ValueError(f"--split: expected the lists {', '.join(LISTS)} in {path}, got {', '.join(lists) or 'none'}")
    for name, videos in lists.items():
        if not isinstance(videos, list) or not videos or not all(isinstance(video, str) for video in videos):
            raise ValueError(f"--split: expected names of videos in {name} of {path}, got {videos!r}")
    return lists
