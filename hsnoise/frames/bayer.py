"""Bayer orders, and the pixels of one colour."""

from __future__ import annotations

import numpy as np


def channel_planes(cfa: str, channel: str) -> list[tuple[int, int]]:
    """(row, column) offsets of a channel's pixels in the 2x2 cell; mono has one plane."""
    if cfa == "mono":
        return [(0, 0)]
    return [divmod(i, 2) for i, letter in enumerate(cfa) if letter == channel]


def channel_pixels(frame: np.ndarray, cfa: str, channel: str) -> np.ndarray:
    """All pixels `[pixel]` of one channel of a frame `[row, column]`."""
    if cfa == "mono":
        return frame.ravel()
    return np.concatenate([frame[row::2, column::2].ravel() for row, column in channel_planes(cfa, channel)])


def transpose_cfa(cfa: str) -> str:
    """Bayer order of a frame after transposing it."""
    return cfa if cfa == "mono" else cfa[0] + cfa[2] + cfa[1] + cfa[3]


def shift_cfa(cfa: str, rows: int, columns: int) -> str:
    """Bayer order of a frame cropped to start at (rows, columns)."""
    if cfa == "mono":
        return cfa
    return "".join(cfa[2 * ((i + rows) % 2) + (j + columns) % 2] for i in (0, 1) for j in (0, 1))


def channel_rows(frame: np.ndarray, cfa: str, channel: str) -> np.ndarray:
    """Pixels of a channel as [colour row, pixel]: R and B are in every second sensor row, G in all."""
    if cfa == "mono":
        return frame
    planes = channel_planes(cfa, channel)
    if len(planes) == 1:
        (r, c) = planes[0]
        return frame[r::2, c::2]
    rows = np.empty((frame.shape[0], frame.shape[1] // 2), frame.dtype)
    for r, c in planes:
        rows[r::2] = frame[r::2, c::2]
    return rows
