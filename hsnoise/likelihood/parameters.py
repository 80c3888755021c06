"""The one mapping between the numbers of a noise model and the vectors that fits move.

A `Number` holds everything about one number: effect, field, channel, name in tables, unit, bounds, the
transform to an unconstrained coordinate and the prior on it. `Parameters` are the numbers that one search moves.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise.effects import ParameterSpec
from hsnoise.likelihood import transforms
from hsnoise.likelihood.transforms import Transform
from hsnoise.model import NoiseModel

SMALL = 0.01  # a number without bounds that starts below this is small in its unit: its steps are measured by itself,
# unless it has no unit: an exponent that starts close to 0 may end at 1
OUTLIERS = "outliers"
OF_OUTLIERS = ParameterSpec("1", 0.0, 1.0, False, "share of the pixels of an exposure that follow no model", False)


@dataclass(frozen=True)
class Number:
    """One number of a model, or of the nuisances beside it.

    Attributes:
        name: in tables, such as "gain.R".
        effect, field, index: its place: effect and field, and index of the channel, () where all share it. Shares of
            outliers, which belong to no effect, have the index of the exposure.
        spec: unit, bounds and meaning, as the effect declares them.
        transform: what stands for it in a search.
        prior_sigma, prior_centre: of a Gaussian on the coordinate; None: centred where the fit starts.
        reach: how far the coordinate may go before the rows' quadrature has to be planned anew.
    """

    name: str
    effect: str
    field: str
    index: tuple[int, ...]
    spec: ParameterSpec
    transform: Transform
    prior_sigma: float = np.inf
    prior_centre: float | None = None
    reach: float = np.inf

    @property
    def place(self) -> tuple[str, str]:
        """Effect and field."""
        return self.effect, self.field

    @property
    def bounds(self) -> tuple[float, float]:
        """Lower and upper bound, infinite where there is none."""
        return bounds_of(self.spec)

    @property
    def is_nuisance(self) -> bool:
        """Whether it belongs to no effect."""
        return self.effect == OUTLIERS

    @property
    def is_in_electrons(self) -> bool:
        """Whether it has no value without the gain: its unit says so."""
        return "e-" in self.spec.unit

    def value_in(self, model: NoiseModel) -> float:
        """Its value in a model."""
        return float(np.asarray(getattr(model[self.effect], self.field))[self.index])

    def put_in(self, model: NoiseModel, value: float) -> NoiseModel:
        """The model with another value of it."""
        values = np.array(getattr(model[self.effect], self.field), float)
        values[self.index] = value
        return model.with_value(self.effect, self.field, values)


def bounds_of(spec: ParameterSpec) -> tuple[float, float]:
    """Lower and upper bound, infinite where there is none."""
    return -np.inf if spec.low is None else spec.low, np.inf if spec.high is None else spec.high


def numbers_of(model: NoiseModel, effects: Iterable[str] | None = None) -> list[Number]:
    """All numbers of the effects called `effects` (None: of all), in the order of `model.table`.

    Their transforms follow from their bounds: a logarithm above a lower one, a logit between two, else the value.
    """
    found = []
    for name in model.names if effects is None else effects:
        effect = model[name]
        labels = iter(p.name for p in effect.parameters(model.channels))
        for field, spec in effect.specs().items():
            transform = transforms.of_bounds(spec.low, spec.high)
            for index in [(i,) for i in range(len(model.channels))] if spec.per_channel else [()]:
                found.append(Number(next(labels), name, field, index, spec, transform))
    return found


def read_noise_dn(model: NoiseModel) -> float:
    """Read noise at the mean gain of the channels, DN."""
    return float(np.mean(np.asarray(model["gain"].value))) * float(model["read_noise"].sigma)


def within_bounds(model: NoiseModel) -> NoiseModel:
    """The model in float64 with its numbers within the bounds that effects declare, which a search may have left."""
    with jax.enable_x64(True):
        for effect in model:
            for field, spec in effect.specs().items():
                model = model.with_value(effect.name, field, np.clip(getattr(effect, field), *bounds_of(spec)))
    return model


class Motion(NamedTuple):
    """How a field of an effect moves in a fit by likelihood: see `Number`."""

    transform: Transform
    prior_sigma: float = np.inf
    prior_centre: float | None = None
    reach: float = np.inf


# In the order of the vector. Weak priors hold a direction in which the data say nothing, and move a parameter known to
# 2 % by 1e-4 of its standard error. What may be zero bends to it within what the data resolve.
IN_LIKELIHOOD = {
    ("gain", "value"): Motion(transforms.LOGARITHM, 4.0, reach=2.0),
    ("read_noise", "sigma"): Motion(transforms.LOGARITHM, 4.0, reach=2.0),
    ("dark_current", "rate"): Motion(transforms.SOFTPLUS, 300.0),
    ("row_gain", "sigma"): Motion(transforms.SOFTPLUS, 300.0, reach=5.0),
    ("row_gain", "exponent"): Motion(transforms.IDENTITY, 2.0, prior_centre=0.5, reach=2.0),
    ("row_gain", "white_share"): Motion(transforms.SOFTPLUS_BETWEEN, 300.0),
    ("black_level", "value"): Motion(transforms.IDENTITY),
    ("black_clamp", "rate"): Motion(transforms.IDENTITY),
    (OUTLIERS, "share"): Motion(transforms.LOGARITHM, 4.0, reach=2.0),
}


def likelihood_numbers(model: NoiseModel, exposures: int) -> list[Number]:
    """The numbers of a model that the likelihood knows, and the shares of outliers of so many exposures."""
    shares = [
        Number(f"{OUTLIERS}.{e}", OUTLIERS, "share", (e,), OF_OUTLIERS, transforms.LOGARITHM) for e in range(exposures)
    ]
    known = {place: [] for place in IN_LIKELIHOOD}
    for number in (*numbers_of(model), *shares):
        if number.place in known:
            known[number.place].append(replace(number, **IN_LIKELIHOOD[number.place]._asdict()))
    return [number for numbers in known.values() for number in numbers]


class Parameters(eqx.Module):
    """Numbers that a search moves, and unconstrained coordinates for them: vectors [number], in one order.

    scale [number]: what the coordinate of a number is measured in, if its transform has a scale; else it is 1.
    """

    scale: jax.Array
    numbers: tuple[Number, ...] = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Their names in tables."""
        return tuple(number.name for number in self.numbers)

    def where(self, effect: str, field: str | None = None) -> np.ndarray:
        """Which of the numbers are of this effect, or of one field of it [number]."""
        return np.array([n.effect == effect and field in (None, n.field) for n in self.numbers], bool)

    def coordinates(self, values) -> jax.Array:
        """The coordinates that stand for `values`."""
        return self._converted("forward", values)

    def values(self, vector) -> jax.Array:
        """The values that coordinates stand for."""
        return self._converted("inverse", vector)

    def slope(self, vector) -> jax.Array:
        """d value / d coordinate."""
        return jax.jvp(self.values, (vector,), (jnp.ones_like(vector),))[1]

    def read(self, model: NoiseModel) -> np.ndarray:
        """The coordinates of the numbers in a model, float64."""
        with jax.enable_x64(True):
            return np.asarray(self.coordinates(np.array([number.value_in(model) for number in self.numbers])))

    def put(self, model: NoiseModel, vector: np.ndarray) -> NoiseModel:
        """The model with the values of the vector, within their bounds; numbers of effects that it lacks are left."""
        with jax.enable_x64(True):
            values = np.asarray(self.values(jnp.asarray(vector, jnp.float64)))
        for (effect, field), own in self._fields():
            if effect in model:
                moved = np.array(getattr(model[effect], field), float)
                for i in own:
                    moved[self.numbers[i].index] = values[i]
                model = model.with_value(effect, field, np.clip(moved, *self.numbers[own[0]].bounds))
        return model

    def _fields(self) -> list[tuple[tuple[str, str], list[int]]]:
        """Places of numbers that follow one another in one field: (effect, field), numbers."""
        numbered = groupby(enumerate(self.numbers), key=lambda pair: pair[1].place)
        return [(place, [i for i, _ in own]) for place, own in numbered]

    def _converted(self, way: str, x) -> jax.Array:
        """`x` through each number's own transform."""
        low, high = np.array([n.bounds for n in self.numbers]).reshape(-1, 2).T
        # Transforms that need no bounds get finite ones, so that what is not chosen below has a derivative.
        low = np.where(np.isfinite(low), low, 0.0)
        high = np.where(np.isfinite(high), high, low + 1)
        out = x = jnp.asarray(x)
        for transform in dict.fromkeys(n.transform for n in self.numbers):
            own = np.array([n.transform == transform for n in self.numbers])
            out = jnp.where(own, getattr(transform, way)(x, low, high, self.scale), out)
        return out


def parameters_of(model: NoiseModel, effects: Iterable[str]) -> Parameters:
    """The numbers of the effects called `effects`, less those held, as searches by simulated draws move them."""
    return of_numbers(model, [n for n in numbers_of(model, effects) if not n.spec.holds(n.value_in(model))])


def of_numbers(model: NoiseModel, numbers: Iterable[Number]) -> Parameters:
    """Parameters of these numbers; one without bounds that is small in its unit is measured by itself."""
    numbers = tuple(numbers)
    sizes = [abs(number.value_in(model)) for number in numbers]
    scale = [
        size if n.transform == transforms.IDENTITY and n.spec.unit != "1" and 0 < size < SMALL else 1.0
        for n, size in zip(numbers, sizes, strict=True)
    ]
    return Parameters(np.array(scale), numbers)
