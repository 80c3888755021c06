"""Array types and the colour filter array, shared by every package.

Shapes are named by jaxtyping: `frame`, `row`, `column`, `channel`. A channel is a colour; the two greens of a
Bayer sensor are one channel.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float, Key, UInt, UInt32

from hsnoise._core.naming import named

Scalar = Float[Array, ""]
PerChannel = Float[Array, "*channel"]  # a scalar until the model broadcasts it to its channels
Frames = Float[Array, "frame row column"]
FrameRows = Float[Array, "frame row channel"]  # one number for each row of each colour
PixelMap = Float[Array, "1 row column"]
Counts = UInt[Array, "frame row column"]
Window = tuple[int, int, int, int]  # first row, first column, rows and columns of the sensor
RandomKey = Key[Array, ""] | UInt32[Array, "2"]


@jax.tree_util.register_static
@dataclass(frozen=True)
class NotDeclared:
    """Stands for a scale of the capture that an effect uses without naming it in `scaled_by`: it fits no formula."""

    what: str

    def __rmul__(self, other):
        raise TypeError(f'capture.{self.what}: an effect that uses it names it: scaled_by = ("{self.what}",)')

    __mul__ = __rmul__


BAYER_CFAS = ("RGGB", "BGGR", "GRBG", "GBRG")
SHUTTERS = ("rolling", "global")


@dataclass(frozen=True)
class StatedGain:
    """The gain that a file's header states.

    `source` quotes the header ("EGAIN 2.62 e-/DN"). `certain`: the keyword can only mean electrons per DN;
    GAIN is often just the number of a setting.
    """

    value_dn_per_e: float
    source: str
    certain: bool


def unit_in_words(unit: str) -> str:
    """The unit as written after a number: empty for "1"."""
    return "" if unit == "1" else unit


def seconds(exposure_s: float) -> str:
    """An exposure for a label: 25 µs, 50 ms, 1.5 s."""
    for factor, unit in ((1.0, "s"), (1e3, "ms"), (1e6, "µs")):
        if exposure_s * factor >= 1:
            return f"{exposure_s * factor:.4g} {unit}"
    return f"{exposure_s:g} s"


def channels_of(cfa: str) -> tuple[str, ...]:
    """Names of the channels of a colour filter array: ("mono",) or ("R", "G", "B").

    Raises:
        ValueError: if `cfa` is neither "mono" nor a 2x2 Bayer string such as "RGGB".
    """
    if cfa == "mono":
        return ("mono",)
    if cfa in BAYER_CFAS:
        return ("R", "G", "B")
    raise ValueError(f"{named('cfa')}: expected 'mono' or one of {', '.join(BAYER_CFAS)}, got {cfa!r}.")


def cfa_tile(cfa: str) -> np.ndarray:
    """Channel index of each pixel of the array's unit cell: [[0]] for mono, [row, column] 2 x 2 for Bayer."""
    channels = channels_of(cfa)
    if cfa == "mono":
        return np.zeros((1, 1), int)
    return np.array([channels.index(letter) for letter in cfa]).reshape(2, 2)


def channel_index(cfa: str, shape: tuple[int, int]) -> np.ndarray:
    """Channel of each pixel of frames of this shape, [row, column]."""
    tile = cfa_tile(cfa)
    return np.tile(tile, (shape[0] // len(tile), shape[1] // len(tile)))


def check_shutter(shutter: str) -> None:
    """Raise ValueError unless `shutter` is "rolling" or "global"."""
    if shutter not in SHUTTERS:
        raise ValueError(f"{named('shutter')}: expected 'rolling' or 'global', got {shutter!r}.")


def is_traced(x) -> bool:
    """True if `x` has no value yet (inside jit, vmap or grad) and cannot be checked."""
    return isinstance(x, jax.core.Tracer)
