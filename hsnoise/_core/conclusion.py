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
    """What a reader should know first: the `light`, and one `sentence` that says why."""

    light: Light
    sentence: str

    def __str__(self) -> str:
        return f"[{self.light}] {self.sentence}"
