"""Standard output and standard error that cannot be written: a full disk, a reader that is gone."""

from __future__ import annotations

import os
from typing import Any


def drop_unwritten(stream: Any) -> None:
    """Write what a stream still holds, or drop it: Python would try again while it shuts down, and exit with 120."""
    try:
        stream.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class Unfailing:
    """A stream of words about the work. If they cannot be written, the work goes on, and its exit status stays."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            self._stream.write(text)
        except OSError:
            drop_unwritten(self._stream)
        return len(text)

    def flush(self) -> None:
        drop_unwritten(self._stream)
