"""When `improve` stops, even if something is left."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from hsnoise._core.arguments import whole_number
from hsnoise.criticism.outcomes import Ended, Ending

MOST_STEPS = 8


class TimeIsUp(Exception):
    """The minutes of a limit are over, in the middle of a step."""


@dataclass(frozen=True)
class Limit:
    """When the loop stops, even if something is left: the time, s, and the number of additions."""

    began_s: float
    minutes: float
    steps: int

    @staticmethod
    def of(max_minutes: float | None, max_steps: int | None) -> Limit:
        """Raises ValueError for invalid limits."""
        minutes = np.inf if max_minutes is None else float(max_minutes)
        if not minutes > 0:
            raise ValueError(f"max_minutes: expected minutes above 0, got {max_minutes}")
        steps = MOST_STEPS if max_steps is None else whole_number("max_steps", max_steps, 0)
        return Limit(time.monotonic(), minutes, steps)

    @property
    def is_over(self) -> bool:
        """Whether the minutes have passed."""
        return time.monotonic() - self.began_s > 60 * self.minutes

    def reached(self, additions: int) -> Ending | None:
        """How the story ends where a limit is reached; None if none is."""
        if additions >= self.steps:
            return Ending(Ended.STEPS, additions)
        return Ending(Ended.MINUTES, self.minutes) if self.is_over else None


NO_LIMIT = Limit(0.0, np.inf, MOST_STEPS)
