"""Groups of statistics in the colours of the noise budget, and their misfits as parts of a bar."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hsnoise.plots._budget import ORDER, SHADES
from hsnoise.statistics.structure import OF_FLATS

OTHER = "other"
COLOUR_OF = {**SHADES, OTHER: "#8C8C8C"}
INK = dict.fromkeys(COLOUR_OF, "#000000") | {"temporal": "#ffffff"}  # readable on the colour
WORDS = {
    "temporal": "noise of pixels",
    "row_x_frame": "rows, frame by frame",
    "column_x_frame": "columns, frame by frame",
    "frame": "levels, whole frames",
    "pixel": "fixed pixels",
    "column": "fixed columns",
    "row": "fixed rows",
    OTHER: "other",
}
FAMILIES = {
    "noise": "temporal",
    "tails": "temporal",
    "spatial lags": "temporal",
    "pixels over time": "temporal",
    "row x frame": "row_x_frame",
    "row spectrum": "row_x_frame",
    "column x frame": "column_x_frame",
    "frames over time": "frame",
    "level": "frame",
    "static pixels": "pixel",
    "blocks": "pixel",
    "static columns": "column",
    "static rows": "row",
    "column responses": "column",
    "row responses": "row",
}
FAMILIES |= {of_flats: FAMILIES[group] for group, of_flats in OF_FLATS.items()}
PLACE = {name: i for i, name in enumerate((*ORDER, OTHER))}


class Part(NamedTuple):
    """A group of statistics: the ratio of its misfit to that of the model's own samples, and the ratio's log10."""

    group: str
    family: str
    times: float
    decades: float


def family_of(group: str) -> str:
    """The component of the noise budget to which a group of statistics belongs, or "other"."""
    return FAMILIES.get(group, OTHER)


def parts_of(comparison) -> list[Part]:
    """The groups whose misfit exceeds that of the model's own samples, by colour, then worst first.

    Misfits span many decades, and a thousand would hide a ten, so lengths are in powers of ten.
    """
    own = comparison.own_misfit
    times = {group: misfit / own for group, misfit in comparison.groups.items()}
    parts = [Part(g, family_of(g), x, float(np.log10(x))) for g, x in times.items() if x > 1]
    return sorted(parts, key=lambda part: (PLACE[part.family], -part.times))
