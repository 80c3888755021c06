"""How much of the noise the named effects explain, how much only measured components do, and how much neither does."""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from hsnoise._core.keys import named_key
from hsnoise._core.types import RandomKey, seconds
from hsnoise.criticism.budget import NoiseBudget, budget
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import draw_capture
from hsnoise.statistics.decomposition import COMPONENTS, STATIC, Component

DRAWS = 2  # of each model
CLEAR = 2.0  # standard errors, below which a difference is chance
MOST_OF_IT = 0.95  # of the static variance, that the effects named in a sentence hold


class Share(NamedTuple):
    """One component of the noise budget at one exposure, in one colour.

    Attributes:
        measured_dn2: its variance in the frames, DN^2; error_dn2: standard error of its difference from the model's.
        closed_dn2, named_dn2: variance that the closed model and the named effects alone draw, DN^2.
        of_total: its share of the variance of all components.
    """

    exposure_s: float
    channel: str
    component: str
    measured_dn2: float
    error_dn2: float
    closed_dn2: float
    named_dn2: float
    of_total: float

    @property
    def named(self) -> float:
        """Share that named effects explain."""
        return self._part(self.named_dn2)

    @property
    def only_measured(self) -> float:
        """Share that the closed model explains beyond them."""
        return max(self._part(self.closed_dn2) - self.named, 0.0)

    @property
    def unexplained(self) -> float:
        """Distance of the closed model as a share of what was measured; 0 where it may be chance."""
        off = abs(self.measured_dn2 - self.closed_dn2)
        return off / self.measured_dn2 if off > CLEAR * self.error_dn2 and self.measured_dn2 > 0 else 0.0

    @property
    def unexplained_of_total(self) -> float:
        """The same distance as a share of the variance of all components."""
        return self.unexplained * self.of_total

    def _part(self, drawn_dn2: float) -> float:
        return float(np.clip(drawn_dn2 / self.measured_dn2, 0, 1)) if self.measured_dn2 > 0 else 0.0


def shares_of(named: NoiseModel, closed: NoiseModel, frames: FrameStack, key: RandomKey) -> tuple[Share, ...]:
    """The shares of each component of the noise budget of dark `frames`, by draws of both models."""
    measured = budget(frames)
    models = {"named": named, "closed": closed}
    drawn = {name: _drawn(model, frames, named_key(key, name)) for name, model in models.items()}
    rows = []
    for i, row in enumerate(measured.rows):
        for component in COMPONENTS:
            parts = {name: [found.rows[i].components[component] for found in of] for name, of in drawn.items()}
            one = row.components[component]
            error = np.hypot(_chance(component, one), _chance(component, parts["closed"][0]) / np.sqrt(DRAWS))
            means = {name: float(np.mean([part.variance_dn2 for part in of])) for name, of in parts.items()}
            share = max(one.variance_dn2, 0.0) / row.total_dn2
            rows.append(
                Share(
                    row.exposure_s,
                    row.channel,
                    component,
                    one.variance_dn2,
                    error,
                    means["closed"],
                    means["named"],
                    share,
                )
            )
    return tuple(rows)


def static_by_effect(named: NoiseModel, frames: FrameStack, key: RandomKey, effects: Iterable[str]) -> dict[str, float]:
    """Static variance, DN^2, that each effect of a model adds to `frames` of one exposure; means over the colours."""
    whole = _static(_drawn(named, frames, key))
    return {name: whole - _static(_drawn(named.remove(name), frames, key)) for name in effects if name in named}


def _drawn(model: NoiseModel, like: FrameStack, key: RandomKey) -> list[NoiseBudget]:
    return [budget(draw_capture(jax.random.fold_in(key, number), model, like)) for number in range(DRAWS)]


def _static(found: list[NoiseBudget]) -> float:
    return float(np.mean([static_dn2(one) for one in found]))


def static_dn2(found: NoiseBudget) -> float:
    """Static variance of the budget of one exposure, DN^2, mean over the colours."""
    return float(np.mean([sum(row.components[name].variance_dn2 for name in STATIC) for row in found.rows]))


def _chance(name: str, of: Component) -> float:
    """Standard error of a variance; of static ones only that by chance, as the pixels are the same."""
    return of.chance_dn2 if name in STATIC else of.standard_error_dn2


def in_words(by_effect: dict[str, float], static_dn2: float) -> str:
    """Which effects are how much of the static variance, in a sentence; empty if none adds any."""
    order = sorted((name for name in by_effect if by_effect[name] > 0), key=lambda name: -by_effect[name])
    total, said, held = sum(by_effect[name] for name in order), [], 0.0
    for name in order:
        said.append(name)
        held += by_effect[name]
        if held >= MOST_OF_IT * total:
            break
    if not said or static_dn2 <= 0:
        return "No named effect explains static variance."
    names = " and ".join([", ".join(said[:-1]), said[-1]] if len(said) > 1 else said)
    verb = "are" if len(said) > 1 else "is"
    if held > static_dn2:
        return f"{names} {verb} all of the static variance, and draw {100 * (held / static_dn2 - 1):.0f} % more."
    return f"{names} {verb} {100 * held / static_dn2:.0f} % of the static variance."


def as_table(shares: Iterable[Share]) -> Table:
    """The shares as a table, in per cent."""
    table = Table("exposure", "colour", "component", "DN²", "of all", "named", "only measured", "unexplained")
    for one in shares:
        if one.measured_dn2 > CLEAR * one.error_dn2:
            percent = (f"{100 * x:.1f} %" for x in (one.of_total, one.named, one.only_measured, one.unexplained))
            table.add_row(seconds(one.exposure_s), one.channel, one.component, f"{one.measured_dn2:.4g}", *percent)
    return table


def printed(shares: Iterable[Share]) -> str:
    """The table as text."""
    console = Console(file=io.StringIO(), width=100, color_system=None)
    console.print(as_table(shares))
    return console.file.getvalue().rstrip()
