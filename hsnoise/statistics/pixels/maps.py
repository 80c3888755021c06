"""Maps of single pixels: offset, dark current, temporal noise, flags; written to FITS or npz."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hsnoise._core.naming import named
from hsnoise._core.output import check_file, write_atomically
from hsnoise._core.types import cfa_tile
from hsnoise.frames.stack import FrameStack
from hsnoise.statistics.pixels.classes import slope_over
from hsnoise.statistics.pixels.flags import FLAGS, flags_of
from hsnoise.statistics.pixels.sample import MOST_COUNTS, MOST_OF_ALL, MOST_PIXELS
from hsnoise.statistics.pixels.survey import Survey, survey

MAP_FORMATS = (".npz", ".fits")


def check_path(path: str | os.PathLike, *, made: str | os.PathLike | None = None) -> None:
    """Raise ValueError unless maps can be written to `path`, in a folder that exists or is `made` later."""
    path = Path(path)
    if path.suffix.lower() not in MAP_FORMATS:
        raise ValueError(f"{named('path')}: expected a file ending in {' or '.join(MAP_FORMATS)}, got {path}")
    check_file("path", path, made)


@dataclass(frozen=True)
class PixelMaps:
    """Maps of a sensor's pixels [row, column].

    Attributes:
        offset_dn: level without signal, DN.
        dark_current: in `dark_current_unit`, e-/s, or DN/s where the gain is not determined; NaN with one exposure.
        noise_dn: temporal noise at the shortest exposure, DN.
        flags: bits of `hsnoise.statistics.pixels.flags.FLAGS`: 1 stuck, 2 dead, 4 hot, 8 telegraph-like.
    """

    offset_dn: np.ndarray
    dark_current: np.ndarray
    noise_dn: np.ndarray
    flags: np.ndarray
    dark_current_unit: str

    def save(self, path: str | os.PathLike) -> None:
        """Write the maps to a .npz or .fits file, whole or not at all.

        Raises ValueError for any other suffix.
        """
        check_path(path)
        suffix = Path(path).suffix.lower()
        buffer = io.BytesIO()
        if suffix == ".npz":
            np.savez_compressed(buffer, **self._arrays(), dark_current_unit=self.dark_current_unit)
        else:
            self._to_fits(buffer)
        write_atomically(Path(path), buffer.getvalue())

    def _arrays(self) -> dict[str, np.ndarray]:
        return {name: getattr(self, name) for name in ("offset_dn", "dark_current", "noise_dn", "flags")}

    def _to_fits(self, buffer: io.BytesIO) -> None:
        from astropy.io import fits

        units = {"offset_dn": "adu", "dark_current": self.dark_current_unit, "noise_dn": "adu", "flags": ""}
        images = [fits.ImageHDU(array, name=name.upper()) for name, array in self._arrays().items()]
        for image, unit in zip(images, units.values(), strict=True):
            image.header["BUNIT"] = unit
        for name, bit in FLAGS.items():
            images[-1].header[name.upper()[:8]] = (bit, "bit of FLAGS")
        fits.HDUList([fits.PrimaryHDU(), *images]).writeto(buffer)


def pixel_maps(stack: FrameStack, gain: np.ndarray | None) -> PixelMaps:
    """The maps of a stack with darks, made in bands of rows that fit into memory.

    gain [channel], DN/e-, or None where it is not determined. Raises ValueError without two frames of a dark exposure.
    """
    if not any(k == "dark" and n > 1 for k, n in zip(stack.kind, stack.n_frames, strict=True)):
        raise ValueError("pixels: maps need a dark exposure of two frames or more")
    cell = len(cfa_tile(stack.cfa))
    most = min(MOST_PIXELS, MOST_OF_ALL // stack.n_exposures, MOST_COUNTS // max(stack.n_frames))
    height = max(cell, most // stack.shape[1] // cell * cell)
    starts = range(0, stack.shape[0], height)
    bands = [_band(survey(stack.select(rows=(s, min(s + height, stack.shape[0]))))) for s in starts]
    offset, rate, noise, flags = (np.concatenate(x) for x in zip(*bands, strict=True))
    if gain is not None:
        tile = cfa_tile(stack.cfa)
        repeats = [size // len(tile) for size in stack.shape]
        rate = rate / np.tile(np.asarray(gain, np.float32)[tile], repeats)
    return PixelMaps(offset, rate, noise, flags, "DN/s" if gain is None else "e-/s")


def _band(found: Survey) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Offset, growth, noise and flags [row, column] of a survey that sampled all rows."""
    step = 1 if found.cfa == "mono" else 2
    shape = (len(found.sampled_rows), found.shape[1])
    offset, rate, noise = (np.empty(shape, np.float32) for _ in range(3))
    flags = np.empty(shape, np.uint8)
    darks = found.repeated_darks
    t = np.array([g.exposure_s for g in darks])
    shortest = int(t.argmin())
    of_channel = [flags_of(found, c) for c in range(len(found.channels))]
    used = [0] * len(found.channels)
    for p, plane in enumerate(darks[0].planes):
        at = (slice(p // step, None, step), slice(p % step, None, step))
        size = offset[at].shape
        level = np.stack([_whole_level(g.planes[p].halves) for g in darks])
        growth = slope_over(t, level) if np.ptp(t) > 0 else np.full(level.shape[1:], np.nan)
        offset[at] = (level.mean(0) - np.nan_to_num(growth) * t.mean()).reshape(size)
        rate[at] = growth.reshape(size)
        noise[at] = np.sqrt(np.maximum(darks[shortest].planes[p].halves.pair_variance_dn2, 0)).reshape(size)
        pixels, c = size[0] * size[1], plane.channel
        flags[at] = of_channel[c][used[c] : used[c] + pixels].reshape(size)
        used[c] += pixels
    return offset, rate, noise, flags


def _whole_level(halves) -> np.ndarray:
    n = np.array(halves.n_frames, np.float32)
    return (n[:, None] * halves.level_dn).sum(0) / n.sum()
