"""What whole frames, rows and columns share in the shortest darks, and which part of it other effects make."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import scipy  # its parts are imported when they are used

from hsnoise.fitting.pixel_lines import Lines, lines_of
from hsnoise.fitting.pixel_rows import RowSpectrum
from hsnoise.fitting.pixel_tilt import AXES, Tilted
from hsnoise.statistics.decomposition import Component, mean_of
from hsnoise.statistics.pixels.banding import Banding
from hsnoise.statistics.pixels.settling import Settling
from hsnoise.statistics.pixels.shading import Shading, shading_of
from hsnoise.statistics.pixels.survey import Plane, Survey

ALTERNATING = 0.45  # cycles per row
CERTAIN = 10.0  # standard errors of a drift
LEAST_P = 0.01  # that frames of several exposures differ alike
PATTERNS = {
    "frame": "frame_offset",
    "row": "row_fixed_pattern",
    "column": "column_fixed_pattern",
    "row_x_frame": "row_noise",
    "column_x_frame": "column_noise",
}


def shortest_of(found: Survey, c: int) -> list[Plane]:
    """The planes of a channel at the shortest dark exposure of several frames; empty without one."""
    return [] if found.shortest is None else found.shortest.of(c)


def banding_in(found: Survey, c: int) -> tuple[str, Banding] | None:
    """The strongest sinusoid over rows or columns, and its axis: a model has one."""
    several = [pair for plane in shortest_of(found, c) for pair in plane.banding.items()]
    if found.row_groups is not None and found.row_groups.row_banks == 2:  # even and odd rows differ: no sinusoid
        several = [(axis, wave) for axis, wave in several if axis != "row" or wave.frequency < ALTERNATING]
    return max(several, key=lambda pair: pair[1].variance_dn2, default=None)


def _wave_of(found: Survey, c: int, axis: str) -> Banding | None:
    """The sinusoid that the model has, if it is over this axis."""
    wave = banding_in(found, c)
    return None if wave is None or wave[0] != axis else wave[1]


def known_of_rows(found: Survey, c: int, apart: int = 0) -> float:
    """Covariance of rows so far apart that a sinusoid and groups of rows make at the shortest exposure, DN^2."""
    wave, groups = _wave_of(found, c, "row"), found.row_groups
    of_wave = 0.0 if wave is None else wave.of_rows_dn2(apart)
    return of_wave + (0.0 if groups is None else groups.of_rows_dn2(apart, mono=found.cfa == "mono"))


def known_of_columns(found: Survey, c: int) -> float:
    """Variance of columns over frames that a sinusoid makes at the shortest exposure, DN^2."""
    wave = _wave_of(found, c, "column")
    return 0.0 if wave is None else wave.variance_dn2


def shadings_of(
    found: Survey, c: int, spectra: tuple[RowSpectrum, RowSpectrum], tilted: Tilted | None
) -> dict[str, Shading]:
    """The drift of the black level along the rows or down the frame: a model has one.

    spectra: of what rows and columns share in a frame; slow noise drifts, too, and few frames do not average it out.
    Nor do they average out what frames are tilted by.
    """
    planes, out = shortest_of(found, c), {}
    for axis, name in (("column", "column_mean_dn"), ("row", "row_mean_dn")):
        if planes:
            noise = np.sqrt(planes[0].components["temporal"].variance_dn2 / planes[0].row_mean_dn.size)
            means = np.mean([getattr(p, name) for p in planes], axis=0)
            of_lines_dn2 = mean_of([p.components[f"{axis}_x_frame"] for p in planes]).variance_dn2
            # In the shape of a shading: all of it, if a few slow waves make the noise.
            slow = min(2 * spectra[AXES.index(axis)].widened ** 2 / len(means), 1.0)
            chance = np.sqrt(max(of_lines_dn2, 0.0) / found.shortest.n_frames * slow)
            chance = np.hypot(chance, np.sqrt(_of_tilts(tilted, axis, c)))
            one = shading_of(means, float(noise), float(chance))
            out |= {} if one is None else {axis: one}
    # The larger of two that are certain; else the more certain, which a few frames less still show.
    certain = {axis: one for axis, one in out.items() if one.amplitude_dn > CERTAIN * one.error_dn}
    largest = max(certain or out, key=lambda axis: _rank(out[axis], bool(certain)), default=None)
    return {} if largest is None else {largest: out[largest]}


def _rank(one: Shading, by_size: bool) -> float:
    return one.amplitude_dn if by_size else one.amplitude_dn / max(one.error_dn, 1e-12)


def lines_in(found: Survey, c: int, shading: Mapping[str, Shading]) -> dict[str, Lines]:
    """Static rows and columns of a channel at the shortest dark exposure, by axis; empty without one."""
    planes = shortest_of(found, c)
    step = 1 if found.cfa == "mono" else 2
    frames = found.shortest.n_frames if planes else 0
    each = zip(AXES, found.origin, strict=True)
    return {axis: lines_of(planes, axis, shading, frames, step, first) for axis, first in each} if planes else {}


def patterns_of(
    found: Survey,
    c: int,
    shading: Mapping[str, Shading],
    lines: Mapping[str, Lines],
    spectra: tuple[RowSpectrum, RowSpectrum],
    tilted: Tilted | None,
) -> dict[str, tuple[float, float, float]]:
    """Variance that frames, rows and columns share at the shortest exposure, by the effect that draws it.

    spectra: of what rows and columns share in a frame: where they resemble each other, by a power law that is known,
    their mean over frames scatters more.
    """
    planes, out = shortest_of(found, c), {}
    if not planes:
        return out
    waves = {axis: _wave_of(found, c, axis) for axis in ("row", "column")}
    known = {"row_x_frame": known_of_rows(found, c)}
    known["column_x_frame"] = known_of_columns(found, c)
    scatter = {}
    if (groups := found.row_groups) is not None:
        mono, frames = found.cfa == "mono", found.shortest.n_frames
        known["frame"] = groups.of_frames_dn2(found.shape[0], mono=mono)
        scatter = {"row_x_frame": groups.variance_dn2[1], "frame": known["frame"] * np.sqrt(2 / (frames - 1))}
        of_mean_dn2 = groups.of_rows_dn2(mono=mono) / frames
        scatter["row"] = of_mean_dn2 * np.sqrt(2 * groups.rows / found.shape[0])  # fewer groups than rows
    of_axes = zip(AXES, spectra, strict=True)
    wider = {axis: of.widened for axis, of in of_axes if np.isfinite(of.exponent[1])}
    for component, effect in PATTERNS.items():
        shared = mean_of([plane.components[component] for plane in planes])
        of = lines.get(component)
        if of is not None and (component in shading or of.far or of.parity_dn is not None):
            shared = replace(shared, variance_dn2=of.variance_dn2, standard_error_dn2=of.error_dn2)
        if component == "frame":
            shared = _of_frames(found, c) if found.settling is None else _about(found.settling, shared, planes)
        chance = shared.chance_dn2 * wider.get(component, 1.0)
        # A sinusoid of random phases leaves a mean that scatters as a whole, not line by line.
        of_mean = waves[component].variance_dn2 / found.shortest.n_frames if waves.get(component) else 0.0
        of_mean += _of_tilts(tilted, component, c)
        out[effect] = (
            shared.variance_dn2 - known.get(component, 0.0),
            float(np.hypot(shared.standard_error_dn2, scatter.get(component, 0.0))),
            float(np.hypot(chance, max(of_mean, scatter.get(component, 0.0)))),
        )
    return out


def _of_tilts(tilted: Tilted | None, axis: str, c: int) -> float:
    """Variance of static rows or columns that the frames' tilts leave, DN^2."""
    return 0.0 if tilted is None or tilted.axis != axis else float(tilted.of_mean_dn2[c])


def _of_frames(found: Survey, c: int) -> Component:
    """The component of frames: of all repeated darks if these agree, or else of the shortest."""
    groups = found.repeated_darks
    dof = np.array([group.n_frames - 1.0 for group in groups])
    parts = [mean_of([plane.components["frame"] for plane in group.of(c)]) for group in groups]
    # Offsets of frames are shared by all planes.
    planes = float(np.sqrt(len(groups[0].of(c))))
    error = np.array([planes * part.standard_error_dn2 for part in parts])
    # Counts of noise narrower than a count follow levels the less, the narrower it is: longer darks are others.
    is_narrow = any(plane.narrow_dn is not None for group in groups for plane in group.of(c))
    if is_narrow or not _alike(error * np.sqrt(dof / 2), dof):
        i = next(i for i, group in enumerate(groups) if group is found.shortest)
        return replace(parts[i], standard_error_dn2=float(error[i]))
    variance, chance = (np.array([getattr(part, name) for part in parts]) for name in ("variance_dn2", "chance_dn2"))
    weight = dof / dof.sum()
    of_error, of_chance = (float(np.linalg.norm(weight * each)) for each in (error, chance))
    return Component(float(weight @ variance), of_error, chance_dn2=of_chance)


def _alike(variance: np.ndarray, dof: np.ndarray) -> bool:
    """Whether normal samples have one variance (Bartlett, Proc. R. Soc. A 160, 1937)."""
    if len(dof) == 1 or (variance <= 0).any():
        return len(dof) == 1
    total, others = dof.sum(), len(dof) - 1
    apart = total * np.log(dof @ variance / total) - dof @ np.log(variance)
    return bool(scipy.special.chdtrc(others, apart / (1 + ((1 / dof).sum() - 1 / total) / (3 * others))) > LEAST_P)


def _about(course: Settling, frame: Component, planes: list[Plane]) -> Component:
    """The component of frames about the course that they share."""
    means = np.mean([plane.frame_means_dn for plane in planes], axis=0)
    of_pixels_dn2 = max(float(means.var(ddof=1)) - frame.variance_dn2, 0.0)  # by which means scatter without offsets
    scatter = np.sqrt(2 / course.dof)
    left = course.left_dn2 - of_pixels_dn2
    return replace(
        frame, variance_dn2=left, standard_error_dn2=scatter * course.left_dn2, chance_dn2=scatter * of_pixels_dn2
    )
