"""Arguments of a `FrameStack`, checked one by one; errors say what was expected and what was given."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np

from hsnoise._core.arguments import listed, not_negative, numbers, one_of, positive
from hsnoise._core.naming import named, setting
from hsnoise._core.types import StatedGain
from hsnoise.frames.lazy import LazyFrames, is_dask

KINDS = ("dark", "flat")


def check_no_copies(prints: Iterable[Iterable[bytes]], exposure_s: Iterable[float], name: str = "counts") -> None:
    """Raise ValueError if two frames are identical, judged by their `prints` [exposure, frame]; name: what they are."""
    seen: dict[bytes, tuple[int, float]] = {}
    for of_exposure, seconds in zip(prints, exposure_s, strict=True):
        for number, one in enumerate(of_exposure):
            if one in seen:
                first, earlier = seen[one]
                which = (
                    f"frames {first} and {number} of the {seconds:g} s exposure"
                    if earlier == seconds
                    else f"frame {first} of the {earlier:g} s exposure and frame {number} of the {seconds:g} s exposure"
                )
                raise ValueError(
                    f"{name}: {which} are identical; copies hold no information on noise, so give each frame once"
                )
            seen[one] = number, seconds


def exposure_groups(counts: Any) -> tuple[Any, ...]:
    """Counts as one array-like `[frame, row, column]` per exposure; their sizes are not compared yet."""
    if isinstance(counts, np.ma.MaskedArray) or (
        isinstance(counts, list | tuple) and any(isinstance(one, np.ma.MaskedArray) for one in counts)
    ):
        raise TypeError("counts: expected arrays of whole frames, got a masked array; its mask would be ignored")
    if isinstance(counts, list | tuple):
        groups = tuple(_as_array(group) for group in counts)
    else:
        array = _as_array(counts)
        if len(array.shape) != 4:
            groups = (array,)
        elif isinstance(array, np.ndarray) or is_dask(array):
            groups = tuple(array[i] for i in range(array.shape[0]))
        else:
            groups = tuple(_lazy_exposure(array, i) for i in range(array.shape[0]))
    if not groups:
        raise ValueError("counts: expected at least one exposure, got none")
    for group in groups:
        if len(group.shape) != 3:
            raise ValueError(
                "counts: expected [frame, row, column], [exposure, frame, row, column] or a list of "
                f"[frame, row, column] arrays, got {type(counts).__name__} with shape {tuple(group.shape)}"
            )
    return groups


def _lazy_exposure(array: Any, exposure: int) -> LazyFrames:
    readers = [partial(array.__getitem__, (exposure, i)) for i in range(array.shape[1])]
    names = [f"counts: frame {i} of exposure {exposure}" for i in range(array.shape[1])]
    return LazyFrames(readers, array.shape[2:], array.dtype, names)


def _as_array(counts: Any) -> Any:
    """NumPy and lazy arrays as they are; JAX arrays and nested lists as NumPy arrays."""
    is_array = all(hasattr(counts, name) for name in ("shape", "dtype", "__getitem__"))
    array = counts if is_array and not isinstance(counts, jax.Array) else np.asarray(counts)
    if np.dtype(array.dtype).kind not in "uif":
        raise TypeError(
            f"counts: expected integers (DN), got dtype {array.dtype}; exposures with different numbers of "
            "frames go in a list of [frame, row, column] arrays"
        )
    return array


def check_sizes(groups: tuple[Any, ...], cfa: str) -> None:
    """Raise ValueError unless there are enough frames, all of one size that fits the colour filter array."""
    sizes = {tuple(group.shape[1:]) for group in groups}
    if len(sizes) > 1:
        raise ValueError(f"counts: frames of all exposures must have one size, got {sorted(sizes)}")
    rows, columns = sizes.pop()
    numbers = [group.shape[0] for group in groups]
    if 0 in (rows, columns, *numbers):
        raise ValueError(f"counts: got {numbers} frames of {rows} x {columns} pixels; none may be empty")
    if sum(numbers) == 1:
        raise ValueError(
            "counts: a single frame cannot separate noise from fixed pattern; give at least two frames, of the "
            "same exposure (better: eight or more) or of different exposures"
        )
    if cfa != "mono" and (rows % 2 or columns % 2):
        raise ValueError(
            f"counts: a Bayer sensor ({cfa}) needs even numbers of rows and columns, got {rows} x {columns}; "
            f"crop the frames (hsnoise.load: {setting('roi')})"
        )


def exposures(exposure_s: Any, n: int) -> np.ndarray:
    """Exposure times `[exposure]`, s."""
    if exposure_s is None:
        raise ValueError(
            f"exposure_s is missing: give the exposure time in seconds of each of the {n} exposure(s), 0 for "
            "bias frames; dark current per second is unknown without it"
        )
    return not_negative("exposure_s", numbers("exposure_s", exposure_s, n, "exposure"))


def kinds(kind: str | Sequence[str], n: int) -> tuple[str, ...]:
    """Kind of each exposure."""
    given = (kind,) * n if isinstance(kind, str) else listed("kind", kind, "'dark', 'flat' or a list of them")
    if len(given) != n:
        raise ValueError(f"{named('kind')}: expected one, or {n} (one an exposure), got {len(given)}: {given}")
    for one in given:
        if one == "bias":
            raise ValueError(f"{named('kind')}: got 'bias', expected 'dark' or 'flat'; a bias frame is a dark of 0 s")
        one_of("kind", one, KINDS)
    return given


def levels(
    black_level: Any, white_level: Any, channels: tuple[str, ...]
) -> tuple[float | np.ndarray | None, float | None]:
    """Black level (None, a float or `[channel]`) and white level (None or a float), DN."""
    white = None if white_level is None else positive("white_level", white_level)
    if black_level is None:
        return None, white
    n = len(channels) if np.size(black_level) > 1 else 1
    black = not_negative("black_level", numbers("black_level", black_level, n, "channel"))
    if white is not None and black.max() >= white:
        raise ValueError(f"black_level must lie below white_level ({white:g} DN), got {black.max():g} DN")
    return (black if n > 1 else float(black[0])), white


def photons(photons_e: Any, kind: tuple[str, ...]) -> np.ndarray | None:
    """Expected photoelectrons `[exposure]`, NaN where unknown; None if all are."""
    if photons_e is None:
        return None
    n, flat = len(kind), np.array([one == "flat" for one in kind])
    given = numbers("photons_e", photons_e, n if np.size(photons_e) == n else flat.sum(), "flat exposure")
    spread = np.full(n, np.nan)
    spread[slice(None) if given.size == n else flat] = given
    if np.isfinite(spread[~flat]).any():
        raise ValueError(f"photons_e: belongs to flat exposures only, got {given.tolist()} for kind {kind}")
    if (spread < 0).any() or np.isinf(spread).any():
        raise ValueError(f"photons_e: expected finite numbers >= 0 (NaN: unknown), got {given.tolist()}")
    spread.setflags(write=False)
    return None if np.isnan(spread).all() else spread


def temperatures(temperature_c: Any, n: int) -> np.ndarray | None:
    """Temperatures `[exposure]`, degrees Celsius, NaN where unknown; None if all are."""
    value = np.full(n, temperature_c) if temperature_c is not None and np.ndim(temperature_c) == 0 else temperature_c
    return _known("temperature_c", value, n)


def overscan(overscan_dn: Any, n: int) -> np.ndarray | None:
    """Overscan means `[exposure]`, DN, NaN where unknown; None if all are."""
    return _known("overscan_dn", overscan_dn, n)


def _known(name: str, value: Any, n: int) -> np.ndarray | None:
    array = None if value is None else numbers(name, value, n, "exposure")
    return None if array is None or np.isnan(array).all() else array


def stated(stated_gain: Any) -> StatedGain | None:
    """A header's gain. Raises TypeError unless it is a `StatedGain`, ValueError unless finite and above 0."""
    if stated_gain is None:
        return None
    if not isinstance(stated_gain, StatedGain):
        raise TypeError(f"stated_gain: expected a StatedGain or None, got {stated_gain!r}")
    positive("stated_gain", stated_gain.value_dn_per_e)
    return stated_gain


def sentences(assumed: Any) -> tuple[str, ...]:
    """`assumed` as a tuple of str. Raises TypeError for anything else."""
    given = listed("assumed", assumed, "a list of sentences")
    for one in given:
        if not isinstance(one, str):
            raise TypeError(f"assumed: expected sentences, got {one!r}")
    return given
