"""Sorting recordings into exposure groups."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hsnoise.frames.io._recording import Recording
from hsnoise.frames.lazy import LazyFrames

RELATIVE_TOLERANCE = 1e-3  # EXIF rounds, and cameras time exposures to about one row


def group_by_exposure(recordings: Sequence[Recording]) -> list[list[Recording]]:
    """Recordings grouped by kind and exposure time: darks before flats, short before long.

    A recording whose exposure is within 1e-3 (relative) of the shortest in a group joins that group. Groups keep the
    order of their recordings.
    """
    groups: list[list[int]] = []
    order = sorted(range(len(recordings)), key=lambda i: (recordings[i].kind, recordings[i].exposure_s, i))
    for i in order:
        shortest = recordings[groups[-1][0]] if groups else None
        if (
            shortest is not None
            and recordings[i].kind == shortest.kind
            and recordings[i].exposure_s <= shortest.exposure_s * (1 + RELATIVE_TOLERANCE)
        ):
            groups[-1].append(i)
        else:
            groups.append([i])
    return [[recordings[i] for i in sorted(group)] for group in groups]


def group_exposure_s(group: Sequence[Recording]) -> float:
    """Exposure time of a group, s: the median."""
    return float(np.median([recording.exposure_s for recording in group]))


def group_temperature_c(group: Sequence[Recording]) -> float:
    """Mean of the known temperatures of a group, NaN if none is known."""
    known = [recording.temperature_c for recording in group if recording.temperature_c is not None]
    return float(np.mean(known)) if known else float("nan")


def group_counts(group: Sequence[Recording]) -> Any:
    """All frames of a group, `[frame, row, column]`; lazy for several files, or if times are known."""
    if len(group) == 1 and group[0].taken is None:
        return group[0].counts
    readers, names, taken = [], [], []
    for recording in group:
        counts = recording.counts
        readers += [lambda counts=counts, i=i: counts[i] for i in range(counts.shape[0])]
        lazy = isinstance(counts, LazyFrames)
        names += counts.names if lazy else [f"{recording.path}, frame {i}" for i in range(counts.shape[0])]
        taken += [recording.taken] * counts.shape[0]
    dtype = np.result_type(*(recording.counts.dtype for recording in group))
    return LazyFrames(readers, group[0].counts.shape[1:], dtype, names, taken)
