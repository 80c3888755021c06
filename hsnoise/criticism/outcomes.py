"""What `diagnose` and `improve` come to, by name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

from hsnoise.criticism import rules
from hsnoise.effects import AbstractEffect


class Verdict(StrEnum):
    """What `diagnose` says of a model."""

    NOTHING_MISSING = "nothing missing"
    NAMED = "named"
    AMBIGUOUS = "ambiguous"  # several names, and the capture that would decide
    UNEXPLAINED = "unexplained"  # by any effect of the library


class Ended(StrEnum):
    """Why `improve` ended."""

    FINISHED = "finished"  # nothing significant is left
    WEAK_LEFT = "weak left"  # no effect stands out, but the error is above what chance gives
    AS_CHANCE = "as chance"  # nothing more could be added, and the error is what chance gives
    NOT_HELD = "not held"  # an effect is named, but no refit with it held
    UNEXPLAINED = "unexplained"  # by any effect of the library
    MINUTES = "minutes over"
    STEPS = "steps over"
    UNFINISHED = "unfinished"  # the story so far


class Refused(StrEnum):
    """Why a candidate was left out."""

    NOT_FITTED = "not fitted"
    NO_BETTER = "no better"  # are frames predicted with it
    NO_CHANGE = "no change by itself"


@dataclass(frozen=True)
class Improvement:
    """By how much one model predicts frames better than another.

    Attributes:
        nats: difference of their log scores; error: its standard error, by how the simulation of both scatters.
        cost: nats that it has to exceed, for numbers that were fitted to some of the same frames.
    """

    nats: float
    error: float
    cost: float

    @property
    def holds(self) -> bool:
        """Whether it is beyond the scatter of its simulation, and beyond chance."""
        return self.nats - self.cost > rules.PREDICTS + rules.PREDICTS_SIGMA * self.error

    @property
    def is_open(self) -> bool:
        """Whether it is beyond chance, but not beyond the scatter of its simulation: more draws would tell."""
        return not self.holds and self.nats - self.cost > rules.PREDICTS


@dataclass(frozen=True)
class Refusal:
    """Why a candidate was left out; improvement: what it would have gained, None if it was not fitted."""

    why: Refused
    improvement: Improvement | None = None


@dataclass(frozen=True)
class Ending:
    """How a story ended.

    Attributes:
        why: by name.
        limit: minutes or additions after which it stopped; NaN without.
        following: the effect that would be next, and its score, nats; None without.
        refused: what was tried last and left out.
    """

    why: Ended
    limit: float = math.nan
    following: tuple[str, float] | None = None
    refused: Mapping[str, Refusal] = field(default_factory=dict)


class Side(StrEnum):
    """Where an offset arises: in electrons, before the gain, or in DN, after it."""

    BEFORE = "before the gain"
    AFTER = "after the gain"


def has_sides(effect: AbstractEffect) -> bool:
    """Whether an effect may arise on either side of the gain."""
    return hasattr(effect, "after_gain")


def side_shows(effect: AbstractEffect, cfa: str) -> bool:
    """Whether frames tell the side of an effect that may arise on either: they need colours of different gains."""
    return has_sides(effect) and cfa != "mono"


def side_of(effect: AbstractEffect) -> Side:
    """The side of an effect; before the gain for one that has no choice."""
    return Side.AFTER if getattr(effect, "after_gain", False) else Side.BEFORE


def on_side(effect: AbstractEffect, side: Side) -> AbstractEffect:
    """An effect that may arise on either side, on this one."""
    return replace(effect, **{"after_gain": side == Side.AFTER})
