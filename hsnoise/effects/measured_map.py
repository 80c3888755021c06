"""What each pixel of one sensor does, measured: its offset, dark current, read noise and response to light."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.poisson import normal_of_pixels
from hsnoise._core.types import Frames, PixelMap, RandomKey, cfa_tile
from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._parameters import MOST_LINES, is_whole, measured

NORMALISED = 1e-3  # relative deviation of a mean or mean square from 1 that is rounding
SCALES = {"dark_current": np.mean, "read_noise": lambda x: np.mean(x**2), "photo_response": np.mean}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _factor(summary: Callable[[np.ndarray], float], doc: str) -> Any:
    """A map of factors, of which tables show `summary` in per cent."""
    axes = ("row", "column")
    return measured("1", axes, low=0, summary=lambda x: 100 * float(summary(x)), summary_unit="%", doc=doc)


def _pair(first: Any) -> Any:
    """A tuple, also of what JSON made a list of; anything else is refused where the map is checked."""
    return tuple(first) if isinstance(first, list | tuple | np.ndarray) else (first,)


class MeasuredMap(AbstractEffect):
    """Maps of one sensor: an offset, and factors on the dark current, the read noise and the light of each pixel.

    In place of a law over pixels, such as `dark_signal_nonuniformity`, these are the pixels themselves: every draw is
    the sensor that was measured, whatever its `sensor_key`. The offset is in DN, after the gain. The factors have a
    mean (dark current, light) or a mean square (read noise) of 1, so the rate stays the mean and the sigma the rms.

    Frames that are a window of the sensor take their part of the maps. Beyond the maps, or in frames of another size
    without a window, the maps are continued by mirrored copies.

    Attributes:
        first: row and column of the sensor at which the maps begin.

    Reference: Feng, Wang, Wang, Fan, Huang, "Learnability enhancement for low-light raw denoising", ACM MM 2022
    (dark shading); EMVA Standard 1288, release 4.0, 2021 (photo response).
    """

    name: ClassVar[str] = "measured_map"
    stage: ClassVar[Stage] = Stage.BLACK
    measurable: ClassVar[bool] = True
    offset: jax.Array | None = measured(
        "DN", ("row", "column"), summary=np.std, summary_unit="DN", doc="offset of each pixel"
    )
    dark_current: jax.Array | None = _factor(np.std, "dark current of each pixel over its mean")
    read_noise: jax.Array | None = _factor(np.std, "read noise of each pixel over its rms")
    dark_fluctuation: jax.Array | None = _factor(
        _rms, "relative change of each pixel's dark current from frame to frame; in tables its rms"
    )
    growth: jax.Array | None = measured(
        "DN/s",
        ("row", "column"),
        summary=_rms,
        summary_unit="DN/s",
        doc="change of each pixel's offset with exposure that is no charge; in tables its rms",
    )
    photo_response: jax.Array | None = _factor(np.std, "photoelectrons of each pixel over the mean, in even light")
    first: tuple[int, int] = eqx.field(static=True, default=(0, 0), converter=_pair)

    def check_arrays(self) -> None:
        if len(self.first) != 2 or not all(is_whole(i, 0, MOST_LINES) for i in self.first):
            raise ValueError(f"measured_map.first: expected a row and a column of the sensor, got {self.first!r:.60}.")
        shapes = {value.shape for value in self.arrays().values()}
        if len(shapes) > 1:
            raise ValueError(f"measured_map: expected maps of one shape, got {sorted(shapes)}.")
        for field, norm in SCALES.items():
            value = getattr(self, field)
            if value is not None and abs(norm(np.asarray(value, float)) - 1) > NORMALISED:
                what = "mean square" if field == "read_noise" else "mean"
                raise ValueError(f"measured_map.{field}: expected a {what} of 1, got {norm(np.asarray(value, float))}.")

    def dark_current_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> PixelMap | None:
        if self.dark_current is None:
            return None
        mean = self._part(self.dark_current, capture)
        if self.dark_fluctuation is None:
            return mean
        change = self._part(self.dark_fluctuation, capture) * normal_of_pixels(key, shape, mean.dtype)
        return mean * jnp.maximum(1 + change, 0)

    def light_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> PixelMap | None:
        return None if self.photo_response is None else self._part(self.photo_response, capture)

    def read_noise_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> PixelMap | None:
        return None if self.read_noise is None else self._part(self.read_noise, capture)

    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames:
        """The signal with the offsets; the other maps scale the light, and what other effects draw."""
        self._tell_of_copies(capture)
        if self.growth is not None:
            signal = signal + capture.exposure_s * self._part(self.growth, capture)
        return signal if self.offset is None else signal + self._part(self.offset, capture)

    def _part(self, whole: jax.Array, capture: Capture) -> PixelMap:
        """The part of a map that the frames see, [1, row, column]."""
        cell = len(cfa_tile(capture.cfa))
        row, column = (_mirrored(self._lines(capture, axis), whole.shape[axis], cell) for axis in (0, 1))
        return whole[row[:, None], column[None]][None]

    def _lines(self, capture: Capture, axis: int) -> np.ndarray | jax.Array:
        """Numbers of the frames' rows or columns, counted from the first of the maps."""
        lines = (capture.rows, capture.columns)[axis]
        return lines if capture.window is None else lines - self.first[axis]

    def _tell_of_copies(self, capture: Capture) -> None:
        whole = next(iter(self.arrays().values()), None)
        if whole is None or capture.moved is not None:
            return
        last = [self._lines(capture, axis)[[0, -1]] for axis in (0, 1)]
        if any(of[0] < 0 or of[1] >= size for of, size in zip(last, whole.shape, strict=True)):
            warnings.warn(
                f"measured_map: frames of {capture.shape[0]} x {capture.shape[1]} pixels reach beyond the map of"
                f" {whole.shape[0]} x {whole.shape[1]}, which is continued by mirrored copies",
                stacklevel=2,
            )


def _mirrored(lines: np.ndarray | jax.Array, size: int, cell: int) -> jax.Array:
    """Lines folded back into 0 ... size - 1; whole cells of the colour filter array, so that colours stay."""
    cells = size // cell
    number = jnp.asarray(lines // cell) % (2 * cells)
    return jnp.where(number < cells, number, 2 * cells - 1 - number) * cell + lines % cell
