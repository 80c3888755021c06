"""Progress: the stage, elapsed time, and time left. In a terminal one line that is kept up to date; elsewhere a line
for each new stage, and one every half minute.
"""

from __future__ import annotations

import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import Progress, ProgressColumn, SpinnerColumn, Task
from rich.text import Text

from hsnoise.fit import fit
from hsnoise.fitting.result import FitResult
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel

EVERY_S = 30.0  # without a terminal
SPINNER = 2  # columns, including the space after it
LEAST_S = 5.0  # of a stage, before its rate predicts its end
_COUNTED = re.compile(r"(.*): (\d+)(?: of (\d+))?")


class Account:
    """The current stage, for a line of progress.

    Called with the sentences that `improve` and others report: "Adding row_noise", or "Adding row_noise: 12" and
    "Adding row_noise: 12 of 60" after the 12th draw. Text after a semicolon stays at the end of the line.
    """

    def __init__(
        self, stage: str, minutes: float | None = None, of: str = "draw", clock: Callable[[], float] = time.monotonic
    ):
        """minutes: time limit of the work; of: the unit that is counted."""
        self._of, self._clock, self._began = of, clock, clock()
        self._ends = None if minutes is None else self._began + 60 * minutes
        self._stage, self._stage_began, self._done, self._total = stage, self._began, 0, 0
        self._lock = threading.Lock()  # every drawing thread reports progress

    def tell(self, sentence: str) -> bool:
        """Record a sentence; returns whether it begins a new stage."""
        found = _COUNTED.fullmatch(sentence)
        stage, done, total = (found[1], int(found[2]), int(found[3] or 0)) if found else (sentence, 0, 0)
        with self._lock:
            is_new = stage != self._stage
            if is_new:
                self._stage, self._stage_began, self._done = stage, self._clock(), 0
            self._done, self._total = max(self._done, done), total  # threads may overtake each other
        return is_new

    def line(self, columns: int | None = None) -> str:
        """For example "[2:30] Adding row_noise, draw 34 of 60; error 26.3; about 1:10 left".

        The middle part is left out if the line would exceed `columns`.
        """
        what, *beside = self._stage.split("; ")
        if self._done:
            what += f", {self._of} {self._done}" + (f" of {self._total}" if self._total else "")
        first, left = f"[{_clock(self._clock() - self._began)}] {what}", self._left()
        whole = "; ".join([first, *beside, *left])
        return whole if columns is None or len(whole) <= columns else "; ".join([first, *left])

    def _left(self) -> list[str]:
        """The time left in words, if it can be estimated."""
        now = self._clock()
        # Work that is always finished may run past the limit, for an unknown time.
        until_end = [] if self._ends is None or self._ends <= now else [self._ends - now]
        taken = now - self._stage_began
        if self._total > self._done > 0 and taken >= LEAST_S:
            return [f"about {_clock(min([taken / self._done * (self._total - self._done), *until_end]))} left"]
        return [f"at most {_clock(one)} left" for one in until_end]


@contextmanager
def busy(stage: str, minutes: float | None = None, of: str = "draw") -> Iterator[Callable[[str], Any]]:
    """Show the current stage; the value takes the sentences of later stages (see `Account`)."""
    account, console = Account(stage, minutes, of), Console(stderr=True)
    if console.is_terminal:
        with Progress(
            SpinnerColumn(), _Line(account, console.width - SPINNER), console=console, transient=True
        ) as progress:
            progress.add_task("", total=None)
            yield account.tell
        return

    def say() -> None:
        print(account.line(), file=sys.stderr, flush=True)

    def tell(sentence: str) -> None:
        if account.tell(sentence):
            say()

    say()
    with _repeated(say):
        yield tell


def fit_with_progress(
    stack: FrameStack, method: str, model: NoiseModel | None = None, pixels: str = "auto"
) -> FitResult:
    """`hsnoise.fit` with progress: the frames read, and the time of the fit."""
    frames = sum(stack.n_frames)
    done = 0

    with busy("Reading frames", of="frame") as say:

        def tick() -> None:
            nonlocal done
            done += 1
            say(f"Reading frames: {done} of {frames}" if done < frames else "Fitting")

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
