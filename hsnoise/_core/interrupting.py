"""Ctrl-C on the command line: always one line of text and exit status 130, and no file is left half written.

Python's KeyboardInterrupt is not enough here. Imports and callbacks print it as a traceback or lose it, a pool waits
for its threads, compiled code runs to its end, and XLA threads that are still running while Python shuts down may
crash. So a thread that no computation blocks ends the process at once.
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
CLEAN_LINE = "\r\x1b[2K\x1b[?25h"  # erases the progress line and shows the cursor that it hid

_unfinished: set[str] = set()
_on_disk: list[str] = []
_ending = threading.Lock()


@contextmanager
def unfinished(path: str | os.PathLike) -> Iterator[None]:
    """While the file at `path` is being written. On exit, also by Ctrl-C, it is removed unless it was moved away."""
    _unfinished.add(os.fspath(path))
    try:
        yield
    finally:
        with suppress(FileNotFoundError):
            os.unlink(path)
        _unfinished.discard(os.fspath(path))


def on_disk(sentence: str) -> None:
    """From now on, the message after Ctrl-C says what is left on disk: `sentence`, empty for nothing."""
    _on_disk[:] = [sentence] if sentence else []


def message() -> str:
    """The message after Ctrl-C."""
    return "; ".join(["hsnoise: interrupted", *_on_disk])


def end_at_once() -> None:
    """From now on Ctrl-C ends this process, if it runs the command line. Other processes are not changed."""
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
    """Inside this context Ctrl-C raises KeyboardInterrupt, for work that saves its state."""
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
    """All work is done: Ctrl-C while Python shuts down has no effect."""
    if signal.getsignal(signal.SIGINT) is _interrupted:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _is_command() -> bool:
    """Whether this process is `python -m hsnoise`, or the script `hsnoise`."""
    if sys.argv[:1] == ["-m"]:  # Python is still looking for the module: argv does not name it yet
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
    if not _ending.acquire(blocking=False):  # the other thread or an earlier Ctrl-C is at it
        return
    text = f"{CLEAN_LINE if os.isatty(2) else ''}{message()}\n"
    with suppress(OSError):  # stderr may be closed
        os.write(2, text.encode())
    for path in tuple(_unfinished):
        with suppress(OSError):  # it may not exist yet
            os.unlink(path)
    os._exit(STATUS)


end_at_once()  # before the slow imports
