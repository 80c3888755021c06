"""Numbers of effects as unconstrained ones, for searches that move them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hsnoise.model import NoiseModel

OFF_BOUNDS = 0.02  # share of the range between two bounds
SMALL = 0.01  # a number without bounds that starts below this is small in its unit: its steps are measured by itself,
# unless it has no unit: an exponent that starts close to 0 may end at 1


@dataclass(frozen=True)
class Knob:
    """One number of an added effect: name in tables, its place, bounds, and for one without bounds its size."""

    label: str
    effect: str
    field: str
    index: tuple[int, ...]
    low: float | None
    high: float | None
    size: float = 1.0

    def forward(self, value: float) -> float:
        """The unconstrained number: a logarithm above a lower bound, a logit between two, else the value in sizes."""
        if self.low is None:
            return value / self.size
        if self.high is None:
            return float(np.log(max(value - self.low, 1e-9)))
        share = (value - self.low) / (self.high - self.low)
        share = OFF_BOUNDS if share < 1e-6 else min(share, 1 - OFF_BOUNDS)  # at a bound itself nothing could move it
        return float(np.log(share / (1 - share)))

    def inverse(self, x: float) -> float:
        if self.low is None:
            return float(x * self.size)
        grown = np.exp(np.clip(x, -25, 25))
        return float(self.low + (grown if self.high is None else (self.high - self.low) * grown / (1 + grown)))

    def read(self, model: NoiseModel) -> float:
        """The unconstrained number in `model`."""
        return self.forward(float(np.asarray(getattr(model[self.effect], self.field))[self.index]))

    def put(self, model: NoiseModel, x: float) -> NoiseModel:
        """`model` with this number."""
        moved = np.array(getattr(model[self.effect], self.field), float)
        moved[self.index] = self.inverse(x)
        return model.with_value(self.effect, self.field, moved)

    def slope(self, x: float) -> float:
        """d value / d x."""
        if self.low is None:
            return self.size
        grown = float(np.exp(np.clip(x, -25, 25)))
        return grown if self.high is None else (self.high - self.low) * grown / (1 + grown) ** 2


def knobs(model: NoiseModel, extra: tuple[str, ...]) -> list[Knob]:
    """The numbers of the effects called `extra`, less those that are held."""
    found = []
    for name in extra:
        effect = model[name]
        labels = iter(p.name for p in effect.parameters(model.channels))
        for field, spec in effect.specs().items():
            for place in [(i,) for i in range(len(model.channels))] if spec.per_channel else [()]:
                label = next(labels)
                value = float(np.asarray(getattr(effect, field))[place])
                size = abs(value) if spec.unit != "1" and 0 < abs(value) < SMALL else 1.0
                if not spec.holds(value):
                    found.append(Knob(label, name, field, place, spec.low, spec.high, size))
    return found
