"""Progress in the terminal: a bar while frames are read, a spinner while work of unknown length goes on."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from hsnoise.fit import fit
from hsnoise.model import NoiseModel
from hsnoise.result import FitResult
from hsnoise.stack import FrameStack


def fit_with_progress(
    stack: FrameStack, method: str, model: NoiseModel | None = None, pixels: str = "auto"
) -> FitResult:
    """`hsnoise.fit` with a bar while frames are read."""
    console = Console(stderr=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("Reading frames", total=sum(stack.n_frames))

        def tick() -> None:
            progress.advance(task)
            if progress.finished:
                progress.add_task("Fitting", total=None)

        return fit(stack, model=model, method=method, pixels=pixels, progress=tick)


@contextmanager
def busy(text: str) -> Iterator[Callable[[str], None]]:
    """A spinner with the time that has passed, or lines where there is no terminal; the value changes its text."""
    console = Console(stderr=True)
    if not console.is_terminal:
        print(text, file=sys.stderr, flush=True)
        told = {text}

        def tell(sentence: str) -> None:
            stage, _, number = sentence.rpartition(": ")
            stage = stage if number.isdigit() else sentence
            if stage not in told:
                told.add(stage)
                print(stage, file=sys.stderr, flush=True)

        yield tell
        return
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(text, total=None)
        yield lambda sentence: progress.update(task, description=sentence)
