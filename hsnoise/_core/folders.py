"""Folders of results: one process at a time, and without the remains of processes that were killed."""

from __future__ import annotations

import errno
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

LOCK = ".lock"
TEMPORARY = f".*.{'[0-9a-f]' * 32}.tmp*"  # as `write_atomically` and `write_video` name them
OLD_S = 86400.0  # beyond the time that a video takes to be written
TAKEN = (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)

if sys.platform == "win32":
    import msvcrt

    def _lock(file: IO[bytes]) -> None:
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _lock(file: IO[bytes]) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def made(folder: Path) -> None:
    """Make a folder for results, and sweep it if it is there."""
    folder.mkdir(parents=True, exist_ok=True)
    sweep(folder)


def sweep(folder: Path) -> None:
    """Remove the half-written files of processes that were killed: by their names ours, and too old to be in work."""
    for path in folder.glob(TEMPORARY):
        with suppress(OSError):  # another process sweeps, too, or may not remove it
            if path.is_file() and time.time() - path.stat().st_mtime > OLD_S:
                path.unlink()


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """No other process is inside this context with the same folder; the lock ends with the process, however it ends.

    Raises:
        ValueError: another process is.
    """
    with open(folder / LOCK, "ab") as file:
        try:
            _lock(file)
        except OSError as error:  # others: a file system that knows no locks
            if error.errno in TAKEN:
                raise ValueError(
                    f"--out: another process is at work in {folder}; wait until it ends, or give another folder"
                ) from error
        yield
