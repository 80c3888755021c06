"""How far long work is, for whoever shows it: numbers, and the sentence that users' callbacks are given."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any


@dataclass(frozen=True)
class Event:
    """A stage of long work, and how far it is.

    Attributes:
        stage: what is being done.
        beside: what else to know of it, said after it.
        done: how many parts are done; 0 before the first.
        total: of how many; None where nobody knows.
    """

    stage: str
    beside: str = ""
    done: int = 0
    total: int | None = None

    def __str__(self) -> str:
        """For example "Step 1: adding row_noise; error 26.3: 12 of 60"."""
        said = f"{self.stage}; {self.beside}" if self.beside else self.stage
        if not self.done:
            return said
        return f"{said}: {self.done}" if self.total is None else f"{said}: {self.done} of {self.total}"


def counter(tell: Callable[[Event], Any], of: Event, total: int | None = None) -> Callable[[], None]:
    """A function that tells the event with the number of times that it was called."""
    numbers = itertools.count(1)
    return lambda: tell(replace(of, done=next(numbers), total=total))
