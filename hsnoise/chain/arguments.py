"""Arguments of `sample`, checked before anything is drawn."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.arguments import listed, window_of
from hsnoise._core.naming import named
from hsnoise._core.types import cfa_tile, is_traced


def piece_of(window: Any, shape: tuple[int, ...], cfa: str) -> tuple[tuple[Any, Any], tuple[int, int]]:
    """First row and column of frames of `shape` on a sensor (may be traced), and the sensor's rows and columns.

    Raises TypeError or ValueError for an invalid window, one that does not fit the frames, or begins at another colour.
    """
    numbers = listed("window", window, "four whole numbers")
    found = window_of([0 if is_traced(n) else n for n in numbers], shape)
    if cfa != "mono" and (found[0] % 2 or found[1] % 2):
        raise ValueError(f"window: expected even first rows and columns with a Bayer array ({cfa}), got {window}")
    row, column = (n if is_traced(n) else known for n, known in zip(numbers[:2], found, strict=False))
    return (row, column), found[2:]


def checked_light(clean, cfa: str):
    """The array and its lowest and highest values (NaN if traced)."""
    clean = clean if isinstance(clean, jax.Array) else np.asarray(clean)
    if not (jnp.issubdtype(clean.dtype, jnp.integer) or jnp.issubdtype(clean.dtype, jnp.floating)):
        raise TypeError(f"clean: expected real numbers (photoelectrons), got dtype {clean.dtype}.")
    if clean.ndim < 2 or clean.size == 0:
        raise ValueError(f"clean: expected photoelectrons [..., row, column], got shape {clean.shape}.")
    period = len(cfa_tile(cfa))
    if clean.shape[-2] % period or clean.shape[-1] % period:
        raise ValueError(f"clean: expected even rows and columns for cfa {cfa}, got {clean.shape[-2:]}.")
    if is_traced(clean):
        return clean, np.nan, np.nan
    # A broadcast axis (all frames alike, no light at all) holds one number.
    some = clean if isinstance(clean, jax.Array) else clean[tuple(slice(1 if s == 0 else None) for s in clean.strides)]
    with jax.ensure_compile_time_eval():  # also inside jit, where arrays from outside have values
        low, high = float(some.min()), float(some.max())
    if not (low >= 0 and high <= float(np.finfo(np.float32).max)):
        raise ValueError(f"clean: expected finite photoelectrons >= 0, got values from {low} to {high}.")
    return clean, low, high


def _as_float(value) -> float:
    """A number, infinite if it is too large for a float."""
    try:
        return float(value)
    except OverflowError:
        return np.inf


def checked_exposure(exposure_s):
    """The exposure in seconds, checked to be one number >= 0 that float32 can hold."""
    if np.ndim(exposure_s) != 0:
        raise ValueError(f"{named('exposure_s')}: expected one number of seconds, got shape {np.shape(exposure_s)}.")
    if isinstance(exposure_s, bool | str):
        raise TypeError(f"{named('exposure_s')}: expected a number of seconds, got {exposure_s!r:.60}.")
    if not is_traced(exposure_s) and not 0 <= _as_float(exposure_s) <= float(np.finfo(np.float32).max):
        raise ValueError(f"{named('exposure_s')}: expected finite seconds >= 0, got {exposure_s!s:.60}.")
    return exposure_s
