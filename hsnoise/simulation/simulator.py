"""The one place that draws captures of a model, to see how its statistics scatter and what moves them."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import jax
import numpy as np

from hsnoise._core.keys import key_of, named_key
from hsnoise._core.threads import in_threads, number_of_threads
from hsnoise._core.types import RandomKey
from hsnoise.chain.shared import Shared, identity
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import black_level_of, draw_capture
from hsnoise.simulation.portion import Portion
from hsnoise.simulation.reference import Reference
from hsnoise.statistics.structure import Structure, structure


class Purpose(enum.StrEnum):
    """What draws are for. Each purpose has random numbers of its own: draws that tune are never draws that judge."""

    COMPARE = "compare"
    DIAGNOSE = "diagnose"
    CHANCE = "chance"
    REFIT = "refit"
    SIDE = "side of the gain"
    HELD_OUT = "held out"
    LINES = "lines"
    CLOSE = "close"
    SHARES = "shares"


def key_for(seed: RandomKey | int, purpose: Purpose) -> RandomKey:
    """The random key of the draws for one purpose, from the seed of a user."""
    return named_key(key_of("seed", seed), purpose.value)


@dataclass(frozen=True)
class Simulator:
    """Draws of a model, and of models near it, under the conditions of a portion; measured by their statistics.

    Draw `number` uses the same random numbers for all models, so draws differ only by what differs between the models.
    Draws are kept for reuse.

    Attributes:
        model: whose black level counts are measured from.
        portion: what draws are like.
        key: of all draws; see `key_for`.
        tick: called after each draw.
        measure: statistics of a capture; by default those of its structure.
        kept: what was drawn, by model and number.
    """

    model: NoiseModel
    portion: Portion
    key: RandomKey
    tick: Callable[[], None] = lambda: None
    measure: Callable[[FrameStack], Structure] | None = None
    kept: dict[tuple, Structure] = field(default_factory=dict)

    @cached_property
    def measured(self) -> Structure:
        """The statistics of the portion itself."""
        return self._statistics(self.portion.frames)

    def draws(self, model: NoiseModel, count: int, first: int = 0) -> np.ndarray:
        """Statistics of `count` draws of a model [draw, statistic], from number `first` on."""
        return self.drawn([(model, first + number) for number in range(count)])

    def drawn(self, wanted: Sequence[tuple[NoiseModel, int]]) -> np.ndarray:
        """Statistics of draws, by model and number [draw, statistic]; those not drawn yet are drawn in threads."""
        return np.stack([one.values for one in self._all(wanted)])

    def reference(self, model: NoiseModel, count: int, first: int = 0) -> Reference:
        """How the statistics of draws of a model scatter."""
        found = self._all([(model, first + number) for number in range(count)])
        values = np.stack([one.values for one in found])
        return Reference.of(found[0].names, found[0].groups, values, np.median([one.error for one in found], axis=0))

    def slopes(
        self, at: NoiseModel, moved: Iterable[NoiseModel], steps: Sequence[float] | np.ndarray, count: int
    ) -> np.ndarray:
        """Change of the statistics per step of each moved model [draw, model, statistic], over common draws."""
        moved = list(moved)
        wanted = [(one, number) for number in range(count) for one in (at, *moved)]
        values = self.drawn(wanted).reshape(count, 1 + len(moved), -1)
        return (values[:, 1:] - values[:, :1]) / np.asarray(steps, float)[:, None]

    def _all(self, wanted: Sequence[tuple[NoiseModel, int]]) -> list[Structure]:
        names = [(identity(model), number) for model, number in wanted]
        new = {name: task for name, task in zip(names, wanted, strict=True) if name not in self.kept}
        for found in in_threads(lambda some: self._draw_alike(some, new), _alike(new, number_of_threads())):
            self.kept.update(found)
        return [self.kept[name] for name in names]

    def _draw_alike(self, some: Sequence[tuple], tasks: dict) -> dict[tuple, Structure]:
        """Draws of one number, by name: one after the other, as they have much in common."""
        shared, found = Shared() if len(some) > 1 else None, {}
        for name in some:
            model, number = tasks[name]
            found[name] = self._draw(model, number, shared)
            self.tick()
        return found

    def _draw(self, model: NoiseModel, number: int, shared: Shared | None) -> Structure:
        own = jax.random.fold_in(self.key, number)
        return self._statistics(draw_capture(own, model, self.portion.frames, self.portion.before, shared))

    def _statistics(self, frames: FrameStack) -> Structure:
        return structure(frames, black_level_of(self.model)) if self.measure is None else self.measure(frames)


def _alike(names: Iterable[tuple], threads: int) -> list[list[tuple]]:
    """The names (of model, number) in pieces of one number each, in order; at least one piece a thread if possible."""
    groups: dict[int, list[tuple]] = {}
    for name in names:
        groups.setdefault(name[1], []).append(name)
    parts = -(-threads // max(len(groups), 1))
    return [some for group in groups.values() for i in range(parts) if (some := group[i::parts])]
