"""Photon transfer of flats: mean, temporal variance and the common part of rows of each level.

Flats have a fixed pattern of light: their frame-to-frame differences are used (Janesick, *Photon Transfer*, 2007; EMVA
1288).
"""

from __future__ import annotations

from functools import partial, reduce

import equinox as eqx
import numpy as np

from hsnoise._frames import channel_rows
from hsnoise.stack import FrameStack

FLICKER = 0.5  # of the mean: more is another light


class FlatMoments(eqx.Module):
    """Photon transfer of the flats: [level, channel] mean, temporal variance within rows, degrees of freedom.

    `row_power` is the mean square of row means of frame differences over 2, `row_dof` its degrees of freedom.
    """

    exposure_s: np.ndarray
    mean_dn: np.ndarray
    variance_dn2: np.ndarray
    dof: np.ndarray
    row_power_dn2: np.ndarray
    row_dof: np.ndarray
    row_pixels: np.ndarray
    photons_e: np.ndarray | None


def flat_moments(stack: FrameStack, groups: list[int], tick) -> FlatMoments:
    """Photon transfer of the exposure groups `groups`; `tick` is called after each frame.

    Raises ValueError for a group of one frame, or of frames in different light.
    """
    columns = [_flat_level(stack, i, tick) for i in groups]
    mean, variance, dof, row_power, row_dof, pixels = (np.stack(x) for x in zip(*columns, strict=True))
    photons = None if stack.photons_e is None else np.asarray(stack.photons_e, np.float64)[groups]
    exposure = np.asarray([stack.exposure_s[i] for i in groups], np.float64)
    return FlatMoments(exposure, mean, variance, dof, row_power, row_dof, pixels, photons)


def _check_same_light(levels: list[float], stack: FrameStack, group: int) -> None:
    """Frames of a flat group must be of one light: a lamp may flicker, not change."""
    if max(levels) - min(levels) > FLICKER * np.mean(levels):
        raise ValueError(
            f"flats: frames of exposure group {group} ({stack.exposure_s[group]:g} s) differ in mean, from"
            f" {min(levels):.4g} to {max(levels):.4g} DN; a group holds frames of the same light, so give each"
            " brightness its own group (its own array, or its own exposure_s)"
        )


Moments = dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]


def _within_rows(frame: np.ndarray, cfa: str, channels: tuple[str, ...]) -> Moments:
    """Of each channel: counts less their row's mean, float32, their squares, the means of the rows [1, row]."""
    out = {}
    for c in channels:
        y = channel_rows(frame, cfa, c).astype(np.float32)
        row_mean = y.mean(1, dtype=np.float64)
        y -= row_mean[:, None].astype(np.float32)
        out[c] = y, y * y, row_mean[None]
    return out


def _added(a: Moments, b: Moments) -> Moments:
    """Of all frames of both: sums of counts and squares, and the means of the rows [frame, row]."""
    return {c: (a[c][0] + b[c][0], a[c][1] + b[c][1], np.concatenate([a[c][2], b[c][2]])) for c in a}


def _flat_level(stack: FrameStack, group: int, tick):
    """Mean, temporal variance and row power of one flat level, each [channel]."""
    if stack.n_frames[group] < 2:
        raise ValueError(
            f"flats: exposure group {group} ({stack.exposure_s[group]:g} s) has one frame; photon transfer needs at"
            " least two frames of the same light, because only differences are free of the fixed pattern"
        )
    channels, n = stack.channels, stack.n_frames[group]
    totals = reduce(_added, stack.map_frames(group, partial(_within_rows, cfa=stack.cfa, channels=channels), _added))
    for _ in range(n):
        tick()
    out = []
    for c in channels:
        first, second, series = totals[c]
        _check_same_light(list(series.mean(1)), stack, group)
        rows, pixels = first.shape
        dof = rows * (pixels - 1) * (n - 1)
        variance = float((second.astype(np.float64) - first.astype(np.float64) ** 2 / n).sum() / dof)
        moving = series - series.mean(1, keepdims=True)  # the lamp may flicker from frame to frame
        moving -= moving.mean(0, keepdims=True)
        row_dof = (rows - 1) * (n - 1)
        out.append((series.mean(), variance, dof, float((moving**2).sum() / row_dof), row_dof, pixels))
    return tuple(np.asarray(x, np.float64) for x in zip(*out, strict=True))
