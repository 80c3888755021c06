"""How sentences call an argument: as in Python, or as the option of the command line that a user gave."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from types import MappingProxyType
from typing import Any

_OPTIONS: ContextVar[Mapping[str, str]] = ContextVar("_OPTIONS", default=MappingProxyType({}))


@contextmanager
def as_options(options: Mapping[str, str]) -> Iterator[None]:
    """Within it, sentences name these options (argument to option) in place of arguments."""
    token = _OPTIONS.set({**_OPTIONS.get(), **options})
    try:
        yield
    finally:
        _OPTIONS.reset(token)


def named(argument: str) -> str:
    """`black_level`, or `--black-level` on the command line."""
    return _OPTIONS.get().get(argument, argument)


def setting(argument: str, value: Any = None) -> str:
    """`black_level=512`, or `--black-level 512` on the command line; `black_level=` or the option without a value."""
    shown = "" if value is None else f"{value:g}" if isinstance(value, float) else repr(value)
    option = _OPTIONS.get().get(argument)
    return f"{argument}={shown}" if option is None else f"{option} {shown}".rstrip()
