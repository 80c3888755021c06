"""Tilts that are new in each frame: which axis they are along, their size, and a survey without them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hsnoise.statistics.decomposition import Component
from hsnoise.statistics.pixels.survey import Plane, Survey
from hsnoise.statistics.pixels.tilt import Tilt, share_of_a_line

AXES = ("row", "column")


class Tilted(NamedTuple):
    """Lines over the rows or columns of a frame (axis) whose slopes are new in each.

    slope_dn2 [channel, 2]: variance of the slopes, DN from the first line of the frame to the last, squared, and its
    error; slow_dn2 [channel]: what slow noise makes of it besides. seen_dn2 [channel, 2]: the variance in the shortest
    frames, whose slopes all colours share, and the error that other noise of lines makes of it. of_mean_dn2 [channel]:
    variance of the lines that is left of the tilts in the mean of the shortest frames.
    """

    axis: str
    slope_dn2: np.ndarray
    slow_dn2: np.ndarray
    seen_dn2: np.ndarray
    of_mean_dn2: np.ndarray


def tilted_in(found: Survey) -> Tilted | None:
    """The tilts of the repeated darks; the larger ones if both rows and columns are tilted: a model has one."""
    several = [one for axis in AXES if (one := _along(found, axis)) is not None]
    return max(several, key=lambda one: float(one.slope_dn2[:, 0].sum()), default=None)


def _along(found: Survey, axis: str) -> Tilted | None:
    planes = [plane for group in found.repeated_darks for plane in group.planes if axis in plane.tilts]
    alike = len(found.groups[0].planes)
    share = share_of_a_line([plane.tilts[axis] for plane in planes], alike) if planes else 0.0
    if share == 0:
        return None
    sizes = []
    for c in range(len(found.channels)):
        of = [plane.tilts[axis] for plane in planes if plane.channel == c]
        shortest = [p.tilts[axis] for p in found.shortest.of(c) if axis in p.tilts]
        if not of or not shortest:
            return None
        freedom = np.array([one.frames - 1.0 for one in of])
        slope, noise = np.average([(one.slope_dn2, one.noise_dn2) for one in of], 0, freedom)
        # All planes of a colour share the slopes of a frame.
        frames = freedom.sum() / len(shortest)
        error = np.sqrt(2 / frames) * (slope + noise)
        of_mean = shortest[0].of_lines(share * slope) / shortest[0].frames
        sizes.append((share * slope, error, (1 - share) * slope, *_seen(shortest), of_mean))
    values = np.array(sizes)
    return Tilted(axis, values[:, :2], values[:, 2], values[:, 3:5], values[:, 5])


def _seen(planes: Sequence[Tilt]) -> tuple[float, float]:
    slope, noise = np.mean([(one.slope_dn2, one.noise_dn2) for one in planes], axis=0)
    freedom = sum(one.frames - 1 for one in planes)
    return float(slope), float(np.sqrt((4 * max(slope, 0.0) * noise + 2 * noise**2) / freedom))


def straightened(found: Survey, tilted: Tilted) -> Survey:
    """The survey without the tilts in what rows and columns share."""
    groups = []
    for group in found.groups:
        planes = [_straightened(plane, tilted) for plane in group.planes] if group.kind == "dark" else group.planes
        groups.append(replace(group, planes=tuple(planes)))
    return replace(found, groups=tuple(groups))


def _straightened(plane: Plane, tilted: Tilted) -> Plane:
    axis = tilted.axis
    if (tilt := plane.tilts.get(axis)) is None:
        return plane
    slow_dn2 = float(tilted.slow_dn2[plane.channel])
    of_tilts = max(tilt.slope_dn2 - slow_dn2, 0.0)
    name, components = f"{axis}_x_frame", dict(plane.components)
    less = tilt.of_lines(of_tilts)
    components[name] = _less(components[name], less)
    components["frame"] = _of_frames(components, len(plane.row_mean_dn), len(plane.column_mean_dn), tilt, less)
    together = _with_slow(tilt, tilt.slope_dn2 - of_tilts)
    if axis == "column":
        return replace(plane, components=components, columns_together=together)
    error = max(components[name].standard_error_dn2, tilt.error_dn2)
    return replace(plane, components=components, rows_together=together, rows_error_dn2=error)


def _less(alone: Component, tilts_dn2: float) -> Component:
    left = alone.variance_dn2 - tilts_dn2
    share = float(np.clip(left / max(alone.variance_dn2, 1e-300), 0, 1))
    error = float(np.hypot(alone.chance_dn2, share * alone.standard_error_dn2))
    return replace(alone, variance_dn2=left, standard_error_dn2=error)


def _of_frames(components: Mapping[str, Component], h: int, w: int, tilt: Tilt, less_dn2: float) -> Component:
    """The component of frames: rows (columns) that change took their part off it, in which a tilt has none."""
    frame, alone = components["frame"], components["temporal"].variance_dn2
    rows, columns = w * components["row_x_frame"].variance_dn2, h * components["column_x_frame"].variance_dn2
    variance = frame.variance_dn2 + less_dn2 / tilt.lines
    chance = np.sqrt(2 / (tilt.frames - 1)) * max(rows + columns + alone, alone) / (h * w)
    error = chance + np.sqrt(2 / (tilt.frames - 1)) * max(variance, 0.0)
    return replace(frame, variance_dn2=variance, standard_error_dn2=float(error), chance_dn2=float(chance))


def _with_slow(tilt: Tilt, slope_dn2: float) -> tuple[Component, Component]:
    """Covariances of neighbouring lines less their slopes, with the part of the slopes that slow noise makes."""
    first, second = (
        replace(one, variance_dn2=one.variance_dn2 + tilt.of_lines(slope_dn2, lag))
        for lag, one in enumerate(tilt.together, 1)
    )
    return first, second
