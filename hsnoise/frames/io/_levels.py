"""Splitting flats of one exposure but different light into separate levels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from hsnoise.frames.io._recording import Recording

SAME_LIGHT = 0.05  # of the signal: frames that differ by more are different levels
STEADY_DN = 5.0  # differences that a drifting black level may cause
THIN = 5  # one in so many rows and columns is enough for a mean; odd, to meet all colours of a mosaic
SATURATED = 0.5  # share of pixels at white; from here on a frame is useless
READERS = 2  # files decoded at the same time

Groups = list[list[Recording]]


def split_levels(groups: Groups, black_dn: float, white_level: float | None) -> tuple[Groups, float | None, list[str]]:
    """Groups of flats split by filter and light, darker first, the white level, and what was found.

    Groups of darks are unchanged. The thinned means of each file's first frame are compared. Flats with most pixels at
    `white_level` are left out; if none is known, flats that hold one count alone show it.
    """
    out: Groups = []
    told: list[str] = []
    too_bright: list[Recording] = []
    brightest, whites = black_dn, set()
    for group in groups:
        if group[0].kind == "dark":
            out.append(group)
            continue
        mean_dn, saturated = thinned(group, white_level)
        lit = [recording for recording, at_white in zip(group, saturated, strict=True) if not at_white]
        brightest = max(brightest, mean_dn[~saturated].max(initial=-np.inf))
        whites |= set(mean_dn[saturated].tolist())
        too_bright += [recording for recording, at_white in zip(group, saturated, strict=True) if at_white]
        levels = _levels_of(lit, mean_dn[~saturated] - black_dn)
        if len(levels) > 1:
            low, high = mean_dn[~saturated].min(), mean_dn[~saturated].max()
            name = f"{len(lit)} flats of {group[0].exposure_s:g} s"
            told.append(f"{name} were taken as {len(levels)} levels of light, {low:.0f} to {high:.0f} DN")
        out += levels
    if too_bright:
        seconds = sorted(recording.exposure_s for recording in too_bright)
        name = f"{len(seconds)} flats of {' to '.join(f'{t:g}' for t in sorted({seconds[0], seconds[-1]}))} s"
        told.append(f"{name} were set aside: most of their pixels are saturated")
    if white_level is None and len(whites) == 1 and (only := whites.pop()) > brightest:
        white_level = only
        told.append(f"the white level is taken as {only:g} DN: these flats hold no other count")
    return out, white_level, told


def thinned(group: Sequence[Recording], white_level: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Mean, DN, of each recording's first frame, and whether most of its pixels are saturated."""

    def of(recording: Recording) -> tuple[float, bool]:
        some = np.asarray(recording.counts[0])[::THIN, ::THIN]
        # A frame with the same count everywhere is at white, even if the file states no white level.
        white = some.max() if some.min() == some.max() else np.inf if white_level is None else white_level
        return float(some.mean()), bool(np.mean(some >= white) > SATURATED)

    with ThreadPoolExecutor(READERS) as pool:
        means, saturated = zip(*pool.map(of, group), strict=True)
    return np.array(means), np.array(saturated, bool)


def _levels_of(group: Sequence[Recording], signal_dn: np.ndarray) -> Groups:
    """Split by filter and light, and also by folder where each folder holds several frames of its level."""
    by_folder = _split(group, signal_dn, lambda r: (r.filter_name or "", str(r.path.parent)))
    if all(sum(r.n_frames for r in level) > 1 for level in by_folder):
        return by_folder
    return _split(group, signal_dn, lambda r: (r.filter_name or "",))


def _split(group: Sequence[Recording], signal_dn: np.ndarray, key: Callable[[Recording], Any]) -> Groups:
    levels: Groups = []
    last = None
    for i in sorted(range(len(group)), key=lambda i: (key(group[i]), signal_dn[i])):
        within = last is not None and key(group[i]) == last[0]
        if not within or signal_dn[i] - last[1] > max(SAME_LIGHT * last[1], STEADY_DN):
            levels.append([])
            last = key(group[i]), signal_dn[i]
        levels[-1].append(group[i])
    order = {id(recording): i for i, recording in enumerate(group)}
    return [sorted(level, key=lambda recording: order[id(recording)]) for level in levels]
