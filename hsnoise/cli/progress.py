"""Progress: the stage, elapsed time, and time left. In a terminal one line that is kept up to date; elsewhere a line
for each new stage, and one every half minute.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from rich.console import Console
from rich.progress import Progress, ProgressColumn, SpinnerColumn, Task
from rich.text import Text

from hsnoise._core.events import Event, counter
from hsnoise.fit import fit
from hsnoise.fitting.result import FitResult
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel

EVERY_S = 30.0  # without a terminal
SPINNER = 2  # columns, including the space after it
LEAST_S = 5.0  # of a stage, before its rate predicts its end


class Account:
    """The current stage, for a line of progress."""

    def __init__(
        self, stage: Event, minutes: float | None = None, of: str = "draw", clock: Callable[[], float] = time.monotonic
    ):
        """minutes: time limit of the work; of: the unit that is counted."""
        self._of, self._clock, self._began = of, clock, clock()
        self._ends = None if minutes is None else self._began + 60 * minutes
        self._now, self._stage_began = stage, self._began
        self._lock = threading.Lock()  # every drawing thread reports progress

    def tell(self, event: Event) -> bool:
        """Record an event; returns whether it begins a new stage."""
        with self._lock:
            is_new = (event.stage, event.beside) != (self._now.stage, self._now.beside)
            if is_new:
                self._now, self._stage_began = event, self._clock()
            else:  # threads may overtake each other
                self._now = replace(event, done=max(self._now.done, event.done))
        return is_new

    def line(self, columns: int | None = None) -> str:
        """For example "[2:30] Adding row_noise, draw 34 of 60; error 26.3; about 1:10 left".

        The middle part is left out if the line would exceed `columns`.
        """
        now = self._now
        what = f"[{_clock(self._clock() - self._began)}] {now.stage}"
        if now.done:
            what += f", {self._of} {now.done}" + ("" if now.total is None else f" of {now.total}")
        left = self._left()
        whole = "; ".join([what, *filter(None, [now.beside]), *left])
        return whole if columns is None or len(whole) <= columns else "; ".join([what, *left])

    def _left(self) -> list[str]:
        """The time left in words, if it can be estimated."""
        now = self._clock()
        # Work that is always finished may run past the limit, for an unknown time.
        until_end = [] if self._ends is None or self._ends <= now else [self._ends - now]
        taken, done, total = now - self._stage_began, self._now.done, self._now.total or 0
        if total > done > 0 and taken >= LEAST_S:
            return [f"about {_clock(min([taken / done * (total - done), *until_end]))} left"]
        return [f"at most {_clock(one)} left" for one in until_end]


@contextmanager
def busy(stage: str, minutes: float | None = None, of: str = "draw") -> Iterator[Callable[[Event], Any]]:
    """Show the current stage; the value takes the events of later stages."""
    account, console = Account(Event(stage), minutes, of), Console(stderr=True)
    if console.is_terminal:
        with Progress(
            SpinnerColumn(), _Line(account, console.width - SPINNER), console=console, transient=True
        ) as progress:
            progress.add_task("", total=None)
            yield account.tell
        return

    def say() -> None:
        print(account.line(), file=sys.stderr, flush=True)

    def tell(event: Event) -> None:
        if account.tell(event):
            say()

    say()
    with _repeated(say):
        yield tell


def fit_with_progress(
    stack: FrameStack, method: str, model: NoiseModel | None = None, pixels: str = "auto"
) -> FitResult:
    """`hsnoise.fit` with progress: the frames read, and the time of the fit."""
    frames = sum(stack.n_frames)
    reading = Event("Reading frames")

    with busy(reading.stage, of="frame") as say:

        def read(event: Event) -> None:
            say(event if event.done < frames else Event("Fitting"))

        tick = counter(read, reading, frames)
        return fit(stack, model=model, method=method, pixels=pixels, progress=tick)


class _Line(ProgressColumn):
    """The progress line of an account."""

    def __init__(self, account: Account, columns: int):
        super().__init__()
        self._account, self._columns = account, columns

    def render(self, task: Task) -> Text:
        return Text(self._account.line(self._columns), no_wrap=True, overflow="ellipsis")


@contextmanager
def _repeated(say: Callable[[], None]) -> Iterator[None]:
    """Call `say` every half minute inside this context."""
    ended = threading.Event()

    def repeat() -> None:
        while not ended.wait(EVERY_S):
            say()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _clock(seconds: float) -> str:
    """2:30, or 1:02:30."""
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes}:{rest:02}" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02}:{rest:02}"
