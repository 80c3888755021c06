"""Ctrl-C on the command line: one line and exit status 130, whatever is going on, and nothing is left half written.

Python's own way, an exception out of the line that runs, does not do here. Imports and callbacks print it as a
traceback, or lose it; a pool waits for its threads; compiled work is not left before it is done; and threads of XLA
that still run while Python takes itself apart may crash. So the process is ended as it is, by a thread that no
computation holds up.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

STATUS = 128 + signal.SIGINT
CLEAN_LINE = "\r\x1b[2K\x1b[?25h"  # a line of progress is taken away, and the cursor that it hid comes back

_unfinished: set[str] = set()
_on_disk: list[str] = []
_ending = threading.Lock()


@contextmanager
def unfinished(path: str | os.PathLike) -> Iterator[None]:
    """While the file at `path` is being written: it is removed, unless it was moved to its place; after Ctrl-C, too."""
    _unfinished.add(os.fspath(path))
    try:
        yield
    finally:
        with suppress(FileNotFoundError):
            os.unlink(path)
        _unfinished.discard(os.fspath(path))


def on_disk(sentence: str) -> None:
    """What Ctrl-C leaves from now on, in words; empty for nothing."""
    _on_disk[:] = [sentence] if sentence else []


def message() -> str:
    """What a user is told after Ctrl-C."""
    return "; ".join(["hsnoise: interrupted", *_on_disk])


def end_at_once() -> None:
    """From now on Ctrl-C ends this process, if it is that of the command line. Others are left as they are."""
    ignored = signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    if not _is_command() or ignored or threading.current_thread() is not threading.main_thread():
        return
    signals, woken = socket.socketpair()
    woken.setblocking(False)
    signal.set_wakeup_fd(woken.detach(), warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, _interrupted)
    threading.Thread(target=_watch, args=(signals,), daemon=True).start()


@contextmanager
def as_exception() -> Iterator[None]:
    """Within, Ctrl-C is a KeyboardInterrupt, for work that keeps what it has."""
    before = signal.getsignal(signal.SIGINT)
    if before is not _interrupted:
        yield
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def nothing_left() -> None:
    """All work is done: Ctrl-C while Python takes itself apart changes nothing."""
    if signal.getsignal(signal.SIGINT) is _interrupted:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _is_command() -> bool:
    """Whether this process is `python -m hsnoise`, or the script `hsnoise`."""
    if sys.argv[:1] == ["-m"]:  # Python is on its way to the module: argv does not name it yet
        words = sys.orig_argv
        return "-m" in words and words[words.index("-m") + 1 :][:1] == ["hsnoise"]
    return bool(sys.argv) and os.path.splitext(os.path.basename(sys.argv[0]))[0] == "hsnoise"


def _watch(signals: socket.socket) -> None:
    while numbers := signals.recv(64):
        if signal.SIGINT in numbers and signal.getsignal(signal.SIGINT) is _interrupted:
            _end()


def _interrupted(*_) -> None:
    _end()


def _end() -> None:
    if not _ending.acquire(blocking=False):  # by the other thread, or by a second Ctrl-C
        return
    text = f"{CLEAN_LINE if os.isatty(2) else ''}{message()}\n"
    with suppress(OSError):  # nobody may listen
        os.write(2, text.encode())
    for path in tuple(_unfinished):
        with suppress(OSError):  # it may not be begun yet
            os.unlink(path)
    os._exit(STATUS)


end_at_once()  # before all that is slow to import
