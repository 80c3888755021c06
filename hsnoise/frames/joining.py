"""Joining several stacks of one camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hsnoise._core.types import StatedGain


def replaced(stack: Any, **changes: Any) -> Any:
    """A copy of a `FrameStack` with some arguments changed; `cfa` is that of the stored frames."""
    return type(stack)(**{**stack._arguments(), **changes})


def joined(stacks: Sequence[Any]) -> Any:
    """The work of `FrameStack.join`."""
    if not stacks:
        raise ValueError("join: expected at least one FrameStack, got none")
    place = _place(next((stack for stack in stacks if "dark" in stack.kind), stacks[0]))
    main = _in_one_place([stack for stack in stacks if _place(stack) == place])
    apart = [stack.elsewhere for stack in stacks if stack.elsewhere is not None]
    apart += [stack for stack in stacks if _place(stack) != place]
    return main if not apart else _with_elsewhere(main, apart)


def _with_elsewhere(main: Any, apart: Sequence[Any]) -> Any:
    """`main` with flats of another region; raises ValueError unless all are flats of one region."""
    if any("dark" in stack.kind or _place(stack) != _place(apart[0]) for stack in apart):
        sizes = " and ".join("{} x {}".format(*one.shape) for one in (main, *apart))
        raise ValueError(f"join: the stacks differ in shape or window ({sizes}); flats may, all in the same way")
    for other in apart:
        _check_same(main, other, ("shutter", "black_level", "white_level", "iso"))
    flats = _in_one_place(apart)
    gain, told = _common_gain([main, flats])
    assumed = _once([*main.assumed, *flats.assumed, *told])
    return replaced(main, elsewhere=replaced(flats, assumed=()), stated_gain=gain, assumed=assumed)


def _place(stack: Any) -> tuple[Any, ...]:
    """The frames' region of the sensor: stacks for which it agrees have the same pixels."""
    return stack.shape, stack.window


def _check_same(one: Any, other: Any, names: Sequence[str]) -> None:
    for name in names:
        first, second = getattr(one, name), getattr(other, name)
        if not np.array_equal(first, second):
            raise ValueError(f"join: the stacks differ in {name}: {first} and {second}")


def _in_one_place(stacks: Sequence[Any]) -> Any:
    """Stacks of one region joined."""
    first = stacks[0]
    for other in stacks[1:]:
        _check_same(first, other, ("row_axis", "cfa", "shutter", "black_level", "white_level", "iso"))
    gain, told = _common_gain(stacks)
    return replaced(
        first,
        counts=[counts for stack in stacks for counts in stack.counts],
        exposure_s=np.concatenate([stack.exposure_s for stack in stacks]),
        kind=[kind for stack in stacks for kind in stack.kind],
        photons_e=_concatenate([stack.photons_e for stack in stacks], stacks),
        temperature_c=_concatenate([stack.temperature_c for stack in stacks], stacks),
        overscan_dn=_concatenate([stack.overscan_dn for stack in stacks], stacks),
        stated_gain=gain,
        elsewhere=None,
        assumed=_once([sentence for stack in stacks for sentence in stack.assumed] + told),
    )


def _common_gain(stacks: Sequence[Any]) -> tuple[StatedGain | None, list[str]]:
    """The gain that the headers state, and a sentence if they contradict each other."""
    gains = list(dict.fromkeys(stack.stated_gain for stack in stacks if stack.stated_gain is not None))
    if len(gains) < 2:
        return (gains[0] if gains else None), []
    return None, [f"Headers state different gains ({', '.join(one.source for one in gains)}): none of them is used"]


def _once(texts: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(texts))


def _concatenate(values: list[np.ndarray | None], stacks: Sequence[Any]) -> np.ndarray:
    """Per-exposure values of several stacks in one array, NaN where unknown."""
    pairs = zip(values, stacks, strict=True)
    return np.concatenate([np.full(stack.n_exposures, np.nan) if v is None else v for v, stack in pairs])
