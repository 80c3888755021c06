"""The conclusion in one sentence, with a traffic light: can the result be used?"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Light(StrEnum):
    """Whether a result can be used."""

    GREEN = "green"  # it fits
    AMBER = "amber"  # with doubts
    RED = "red"  # do not use this


@dataclass(frozen=True)
class Conclusion:
    """What a reader should know first: `light`, and why, in a sentence (`head`) and what belongs to it (`rest`)."""

    light: Light
    head: str
    rest: str = ""

    @property
    def sentence(self) -> str:
        """Head and rest."""
        return f"{self.head} {self.rest}" if self.rest else self.head

    def __str__(self) -> str:
        return f"[{self.light}] {self.sentence}"
