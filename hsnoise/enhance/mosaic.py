"""Converting between colour frames and the mosaic that a sensor sees.

A pixel of a colour frame is one 2 x 2 cell of the colour filter array. The frame has half the sensor's rows and
columns, its green is the mean of the cell's two, and noise does not spread from pixel to pixel as in demosaicking.
A mono sensor's pixels are those of the frame.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from hsnoise._core.types import Scalar, cfa_tile
from hsnoise.model import NoiseModel


def mosaic(light: ArrayLike, cfa: str) -> jax.Array:
    """The light on each sensor pixel, [..., 2 row, 2 column], from colour frames [..., row, column, 3].

    For a mono sensor [..., row, column], from frames [..., row, column, 1].

    Raises:
        ValueError: wrong number of channels, or an unknown `cfa`.
    """
    light, tile = jnp.asarray(light), cfa_tile(cfa)
    channels = int(tile.max()) + 1
    if light.ndim < 3 or light.shape[-1] != channels:
        raise ValueError(f"light: expected [..., row, column, {channels}] for cfa {cfa}, got shape {light.shape}")
    cells = jnp.moveaxis(light[..., tile], -2, -3)  # [..., row, row in cell, column, column in cell]
    rows, columns = (n * len(tile) for n in light.shape[-3:-1])
    return cells.reshape(*light.shape[:-3], rows, columns)


def electrons_of(counts: ArrayLike, params: NoiseModel, exposure_s: float | Scalar | None = None) -> jax.Array:
    """Colour frames in electrons, e- [..., row / 2, column / 2, 3], from a camera's counts [..., row, column].

    Black level (net of a black clamp) and mean dark current are subtracted: without noise and clipping, the results are
    the photoelectrons of each sensor pixel. For a mono sensor [..., row, column, 1].

    Args:
        counts: DN; params: the camera; exposure_s: exposure, s; default: that of `params`.

    Raises:
        ValueError: odd sizes with a Bayer array.
    """
    counts, tile = jnp.asarray(counts), cfa_tile(params.cfa)
    period = len(tile)
    if counts.ndim < 2 or counts.shape[-2] % period or counts.shape[-1] % period:
        raise ValueError(f"counts: expected even rows and columns for cfa {params.cfa}, got shape {counts.shape}")
    exposure_s = params.exposure_s if exposure_s is None else exposure_s
    channels = len(params.channels)

    def of(effect: str, field: str, default: float = 0.0) -> jax.Array:
        # A fit's parameters are float64, which a float32 session would warn about.
        value = getattr(params[effect], field) if effect in params else jnp.full(channels, default)
        return jnp.broadcast_to(jax.lax.convert_element_type(value, jnp.float32), (channels,))

    black = of("black_level", "value") - of("black_clamp", "rate") * exposure_s
    gain, dark = of("gain", "value", 1.0), of("dark_current", "rate") * exposure_s
    planes: list[list[jax.Array]] = [[] for _ in range(channels)]
    for (row, column), channel in np.ndenumerate(tile):
        planes[channel].append(counts[..., row::period, column::period].astype(jnp.float32))
    electrons = [(sum(plane) / len(plane) - black[i]) / gain[i] - dark[i] for i, plane in enumerate(planes)]
    return jnp.stack(electrons, -1).astype(jnp.float32)
