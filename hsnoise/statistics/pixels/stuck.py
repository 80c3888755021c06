"""Stuck pixels are taken out of the static statistics of a survey: they are no noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hsnoise.statistics.pixels.sample import of_neighbours
from hsnoise.statistics.pixels.survey import Group, Plane, Survey


def without_stuck(found: Survey) -> Survey:
    """The survey with levels of stuck pixels replaced by those of their neighbours, and out of rows and columns.

    Where only some rows were sampled, the means of rows and columns stay as they are.
    """
    stuck = [found.stuck(c) for c in range(len(found.channels))]
    if not any(of.any() for of in stuck):
        return found
    return replace(found, groups=tuple(_of_group(group, stuck) for group in found.groups))


def _of_group(group: Group, stuck: list[np.ndarray]) -> Group:
    used, planes = [0] * len(stuck), []
    for plane in group.planes:
        if plane.halves is not None:
            first, pixels = used[plane.channel], plane.halves.lowest.size
            used[plane.channel] += pixels
            plane = _of_plane(plane, stuck[plane.channel][first : first + pixels])
        planes.append(plane)
    return replace(group, planes=tuple(planes))


def _of_plane(plane: Plane, stuck: np.ndarray) -> Plane:
    assert plane.halves is not None
    level, width = plane.halves.level_dn, len(plane.column_mean_dn)
    filled = np.stack([np.where(stuck, of_neighbours(half, width), half) for half in level])
    less = (level - filled).mean(0, dtype=np.float64).reshape(-1, width)
    out = replace(plane, halves=replace(plane.halves, level_dn=filled))
    if len(less) != len(plane.row_mean_dn):
        return out
    means, components = {}, dict(plane.components)
    for name, axis in (("row", 1), ("column", 0)):
        before = getattr(plane, f"{name}_mean_dn")
        after = means[f"{name}_mean_dn"] = before - less.mean(axis)
        one = components[name]
        components[name] = replace(one, variance_dn2=one.variance_dn2 - float(before.var(ddof=1) - after.var(ddof=1)))
    return replace(out, components=components, **means)
