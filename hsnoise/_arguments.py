"""Arguments of a `FrameStack` and of `sample`, checked one by one; errors say what was expected and what came."""

from __future__ import annotations

import itertools
import operator
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._frames import LazyFrames
from hsnoise._types import StatedGain, Window, cfa_tile, is_traced

KINDS = ("dark", "flat")
MOSAIC_SIGMA, LEAST_PIXELS, MOST_PIXELS = 6.0, 1024, 1 << 20
MOSAIC_MEAN, MOSAIC_VARIANCE = 0.15, 0.04  # of a pixel's noise and variance: taps of a mono CCD leave 0.09, 0.01
MOSAIC = (
    "read as mono, but the four pixels of each 2 x 2 block differ, as those of a colour sensor do; if it is one, give"
    " its Bayer order: cfa='RGGB', say"
)
MOST_SEED = 2**31  # those of single draws are counted from it


def span(name: str, value: Any, size: int) -> slice:
    """A (start, stop) pair, a slice or None (all) as a slice within 0..size.

    Raises:
        ValueError: it is empty, reaches outside, or has a step.
    """
    ends = (None, None) if value is None else value
    if isinstance(ends, slice):
        ends = (ends.start, ends.stop) if ends.step in (None, 1) else ()
    ends = listed(name, ends, "(start, stop)")
    if len(ends) == 2:
        start, stop = (
            whole_number(name, default if end is None else end) for end, default in zip(ends, (0, size), strict=True)
        )
        if 0 <= start < stop <= size:
            return slice(start, stop)
    raise ValueError(f"{name}: expected (start, stop) with 0 <= start < stop <= {size}, got {value}")


def check_no_copies(prints: Iterable[Iterable[bytes]], exposure_s: Iterable[float]) -> None:
    """Raise ValueError if two frames are the same, told by what stands for each, `prints` [exposure, frame]."""
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
                    f"counts: {which} are identical; a copy tells nothing of the noise, so give each frame once"
                )
            seen[one] = number, seconds


def seed_of(name: str, value: Any) -> int:
    """A seed of random draws. Raises TypeError for what is no whole number, ValueError outside 0 to MOST_SEED."""
    seed = whole_number(name, value, 0)
    if seed > MOST_SEED:
        raise ValueError(f"{name}: expected at most {MOST_SEED}, got {value}")
    return seed


def whole_number(name: str, value: Any, least: int | None = None) -> int:
    """`value` as an int. Raises TypeError for what is no whole number, ValueError below `least`."""
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name}: expected a whole number, got {value!r}") from None
    if least is not None and number < least:
        raise ValueError(f"{name}: expected at least {least}, got {value}")
    return number


def listed(name: str, value: Any, expected: str) -> tuple[Any, ...]:
    """`value` as a tuple. Raises TypeError for what is no list."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise TypeError(f"{name}: expected {expected}, got {value!r}")
    return tuple(value)


def callback(name: str, function: Any) -> Callable[..., Any]:
    """A user's function, or for None one that does nothing. Raises TypeError for what cannot be called."""
    if function is not None and not callable(function):
        raise TypeError(f"{name}: expected a function or None, got {function!r}")
    return function or (lambda *told: None)


def counter(say: Callable[[str], Any], text: str, total: int | None = None) -> Callable[[], None]:
    """A function that says `text` and how often it was called: "Drawing: 12", "Drawing: 12 of 40"."""
    numbers, of = itertools.count(1), "" if total is None else f" of {total}"
    return lambda: say(f"{text}: {next(numbers)}{of}")


def warn_of_a_mosaic(frame: np.ndarray) -> None:
    """Warn if a frame [row, column], said to be mono, looks like a colour mosaic."""
    if looks_like_a_mosaic(frame):
        warnings.warn(f"cfa: {MOSAIC}", stacklevel=4)


def looks_like_a_mosaic(frame: np.ndarray) -> bool:
    """Whether the pixels of 2 x 2 blocks of a frame [row, column] differ as those of a colour mosaic do.

    What they differ by beyond offsets of rows and of columns is 0 on a mono sensor, in the mean and in the noise; gains
    of three colours leave both. A little of it, however significant, is a pattern of the readout.
    """
    rows, columns = (size // 2 * 2 for size in frame.shape)
    if rows * columns < LEAST_PIXELS:
        return False
    blocks_of_rows = frame[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2)
    # Some of a large frame: as floats all of it would take many times its memory.
    pixels = blocks_of_rows[:: -(-rows * columns // MOST_PIXELS)].astype(float)
    # Hot pixels would drown what all others have in common.
    low, high = np.quantile(pixels, (0.001, 0.999))
    pixels = np.clip(pixels, low, high)
    squares = (pixels - pixels.mean((0, 2), keepdims=True)) ** 2
    variance = max(float(squares.mean()), 1e-12)
    sign = np.array([[1, -1], [-1, 1]])[None, :, None, :]
    for values, least in ((pixels, MOSAIC_MEAN * np.sqrt(variance)), (squares, MOSAIC_VARIANCE * variance)):
        block = (sign * values).sum((1, 3)).ravel()
        mean, error = abs(float(block.mean())), max(float(block.std()) / np.sqrt(block.size), 1e-12)
        if mean > MOSAIC_SIGMA * error and mean > 4 * least:
            return True
    return False


def window_of(window: Any, shape: tuple[int, ...]) -> Window | None:
    """Four numbers that say where frames of `shape` lie on a sensor. Raises ValueError if they lie outside."""
    if window is None:
        return None
    numbers = tuple(whole_number("window", n) for n in listed("window", window, "four whole numbers"))
    if len(numbers) != 4 or min(numbers) < 0 or any(numbers[i] + shape[i] > numbers[i + 2] for i in (0, 1)):
        raise ValueError(
            f"window: expected (first row, first column, rows, columns) of a sensor that holds {shape[0]} x {shape[1]}"
            f" frames, got {window}"
        )
    return numbers[0], numbers[1], numbers[2], numbers[3]


def piece_of(window: Any, shape: tuple[int, ...], cfa: str) -> tuple[tuple[Any, Any], tuple[int, int]]:
    """First row and column of frames of `shape` on a sensor, which may be traced, and its rows and columns.

    Raises TypeError, ValueError for a window that is none or does not hold the frames, or begins at another colour.
    """
    numbers = listed("window", window, "four whole numbers")
    found = window_of([0 if is_traced(n) else n for n in numbers], shape)
    if cfa != "mono" and (found[0] % 2 or found[1] % 2):
        raise ValueError(f"window: expected even first rows and columns with a Bayer array ({cfa}), got {window}")
    row, column = (n if is_traced(n) else known for n, known in zip(numbers[:2], found, strict=False))
    return (row, column), found[2:]


def exposure_groups(counts: Any) -> tuple[Any, ...]:
    """Counts as one array-like `[frame, row, column]` an exposure, sizes not yet compared."""
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
        elif isinstance(array, np.ndarray):
            groups = tuple(array)
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
    """Raise ValueError unless all frames have one size that fits the colour filter array, and are enough."""
    sizes = {tuple(group.shape[1:]) for group in groups}
    if len(sizes) > 1:
        raise ValueError(f"counts: frames of all exposures must have one size, got {sorted(sizes)}")
    rows, columns = sizes.pop()
    numbers = [group.shape[0] for group in groups]
    if 0 in (rows, columns, *numbers):
        raise ValueError(f"counts: got {numbers} frames of {rows} x {columns} pixels; none may be empty")
    if sum(numbers) == 1:
        raise ValueError(
            "counts: a single frame does not tell noise from fixed pattern; give at least two frames, of the "
            "same exposure (better: eight or more) or of different exposures"
        )
    if cfa != "mono" and (rows % 2 or columns % 2):
        raise ValueError(
            f"counts: a Bayer sensor ({cfa}) needs even numbers of rows and columns, got {rows} x {columns}; "
            "crop the frames (hsnoise.load: roi=)"
        )


def one_of(name: str, value: Any, allowed: Sequence[Any]) -> Any:
    """The value, if it is one of those allowed."""
    if not isinstance(value, type(allowed[0])) or value not in allowed:
        raise ValueError(f"{name}: expected one of {', '.join(map(repr, allowed))}, got {value!r}")
    return value


def numbers(name: str, value: Any, length: int, per: str) -> np.ndarray:
    """Numbers as float64 `[length]`; a scalar will do for length 1."""
    try:
        array = np.atleast_1d(np.array(value, np.float64))
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name}: expected numbers, got {value!r}") from error
    if array.shape != (length,):
        raise ValueError(f"{name}: expected {length} (one for each {per}), got shape {array.shape}: {value!r}")
    array.setflags(write=False)
    return array


def not_negative(name: str, values: np.ndarray) -> np.ndarray:
    """The values, if all are finite and none is negative."""
    if not np.isfinite(values).all() or (values < 0).any():
        raise ValueError(f"{name}: expected finite numbers >= 0, got {values.tolist()}")
    return values


def positive(name: str, value: Any) -> float:
    """One finite number > 0 as a float."""
    number = float(not_negative(name, numbers(name, value, 1, "stack"))[0])
    if number == 0:
        raise ValueError(f"{name}: expected a number > 0, got {value!r}")
    return number


def exposures(exposure_s: Any, n: int) -> np.ndarray:
    """Exposure times `[exposure]`, s."""
    if exposure_s is None:
        raise ValueError(
            f"exposure_s is missing: give the exposure time in seconds of each of the {n} exposure(s), 0 for "
            "bias frames; dark current per second cannot be told without it"
        )
    return not_negative("exposure_s", numbers("exposure_s", exposure_s, n, "exposure"))


def kinds(kind: str | Sequence[str], n: int) -> tuple[str, ...]:
    """Kind of each exposure."""
    given = (kind,) * n if isinstance(kind, str) else listed("kind", kind, "'dark', 'flat' or a list of them")
    if len(given) != n:
        raise ValueError(f"kind: expected one, or {n} (one an exposure), got {len(given)}: {given}")
    for one in given:
        if one == "bias":
            raise ValueError("kind: got 'bias', expected 'dark' or 'flat'; a bias frame is a dark of 0 s")
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
    """A header's gain. Raises TypeError for what is no `StatedGain`, ValueError unless it is finite and above 0."""
    if stated_gain is None:
        return None
    if not isinstance(stated_gain, StatedGain):
        raise TypeError(f"stated_gain: expected a StatedGain or None, got {stated_gain!r}")
    positive("stated_gain", stated_gain.value_dn_per_e)
    return stated_gain


def sentences(assumed: Any) -> tuple[str, ...]:
    """What was assumed, a tuple of str. Raises TypeError for anything else."""
    given = listed("assumed", assumed, "a list of sentences")
    for one in given:
        if not isinstance(one, str):
            raise TypeError(f"assumed: expected sentences, got {one!r}")
    return given


def checked_light(clean, cfa: str):
    """The array, and its lowest and highest value; NaN if it is traced."""
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
    # Broadcast axes (all frames alike, no light at all) hold one number each.
    some = clean if isinstance(clean, jax.Array) else clean[tuple(slice(1 if s == 0 else None) for s in clean.strides)]
    with jax.ensure_compile_time_eval():  # inside jit, too, where arrays from outside have values
        low, high = float(some.min()), float(some.max())
    if not (low >= 0 and high <= float(np.finfo(np.float32).max)):
        raise ValueError(f"clean: expected finite photoelectrons >= 0, got values from {low} to {high}.")
    return clean, low, high


def checked_exposure(exposure_s):
    """The exposure in seconds, one number >= 0."""
    if np.ndim(exposure_s) != 0:
        raise ValueError(f"exposure_s: expected one number of seconds, got shape {np.shape(exposure_s)}.")
    if not is_traced(exposure_s) and not 0 <= float(exposure_s) < np.inf:
        raise ValueError(f"exposure_s: expected finite seconds >= 0, got {exposure_s}.")
    return exposure_s
