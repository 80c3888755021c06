"""What public functions accept as a capture: a path, a stack, or bare arrays."""

from __future__ import annotations

import inspect
from os import PathLike
from typing import Any

from hsnoise.frames.io.load import load
from hsnoise.frames.stack import FrameStack

OF_LOAD = [name for name in inspect.signature(load).parameters if name not in ("path", "progress")]
OF_STACK = [name for name in inspect.signature(FrameStack).parameters if name != "counts"]


def as_stack(source: Any, **keywords: Any) -> FrameStack:
    """The argument of a public function as a `FrameStack`.

    Args:
        source: a FrameStack, returned as it is; a path or a list of paths, for `load`; else counts, for `FrameStack`.
        keywords: those of `load` (except progress), or those of `FrameStack`.

    Raises:
        TypeError: unknown keywords, or any beside a `FrameStack`, which holds them already; a source that is neither
            path, stack nor array, or paths and arrays in one list.
        FileNotFoundError, ValueError: errors of `load` or `FrameStack`.
    """
    is_path = _is_path(source)
    known = OF_LOAD if is_path else OF_STACK
    unknown = [name for name in keywords if name not in known]
    if unknown:
        raise TypeError(f"{', '.join(unknown)}: expected keywords among {', '.join(known)}")
    if isinstance(source, FrameStack):
        if keywords:
            raise TypeError(f"{', '.join(keywords)}: only go with a path or an array; a FrameStack holds them already")
        return source
    if is_path:
        return load(source, **keywords)
    if not hasattr(source, "__len__") and not hasattr(source, "shape"):
        raise TypeError(f"stack: expected a path, a FrameStack or an array of counts, got {type(source).__name__}")
    return FrameStack(source, **keywords)


def _is_path(source: Any) -> bool:
    """Whether it is a path or a list of paths. Raises TypeError if only some of a list are paths."""
    if not isinstance(source, list | tuple):
        return isinstance(source, str | PathLike)
    paths = [isinstance(one, str | PathLike) for one in source]
    if any(paths) and not all(paths):
        raise TypeError("stack: expected a list of paths or a list of arrays, got both in one list")
    return bool(paths) and all(paths)
