"""What a refit by simulation varies and compares: coordinates of all numbers, score and structure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.naming import named
from hsnoise.effects import Stage
from hsnoise.fitting.covariances import SURE, given
from hsnoise.fitting.result import FitResult
from hsnoise.frames.stack import FrameStack
from hsnoise.likelihood.coordinates import Coordinates, coordinates_for
from hsnoise.likelihood.parameters import Parameters, parameters_of
from hsnoise.likelihood.score import Score
from hsnoise.likelihood.summary import coding_of, summarise
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import black_level_of
from hsnoise.simulation.portion import Portion
from hsnoise.statistics.structure import Structure, structure

PRIOR_SIGMA = 1.5  # of the logarithm of an effect's parameter: keeps what the data do not determine in place
MOST_SPREAD = 0.25  # variance of base parameters, relative to their size, above which they are unknown
LONGEST_STEP, LONGEST_OF_BASE = 1.5, 0.5  # in the logarithm of an effect's parameter; in sizes of a base parameter
UNKNOWN = 100.0  # standard error, in sizes, of what the base fit does not know
ON_SIGNAL = (Stage.COUPLING, Stage.MULTIPLICATION, Stage.READOUT, Stage.GAIN)  # the photon transfer line shows it
SCORE_ERROR = 0.3  # least error of the score in whitened units, whose deviation is 1 if the base fit is right


@dataclass(frozen=True)
class Problem:
    """A capture, its base fit, and the unknowns: y = (base in whitened units, effects unconstrained).

    given: the model that the caller passed; its base parameters are a second starting point.
    """

    portion: Portion
    base: FitResult
    model: NoiseModel
    extra: tuple[str, ...]
    given: NoiseModel

    @cached_property
    def coordinates(self) -> Coordinates:
        """Coordinates of the base fit, without shares of outliers: its likelihood gives the score."""
        with jax.enable_x64(True):
            return coordinates_for(self.base.summary, self.base.params)

    @cached_property
    def added(self) -> Parameters:
        """The numbers of the effects that the base fit lacks."""
        return parameters_of(self.model, self.extra)

    @cached_property
    def centre(self) -> np.ndarray:
        with jax.enable_x64(True):
            return np.asarray(self.coordinates.start())

    @cached_property
    def sizes(self) -> np.ndarray:
        """Unit for changes of each base coordinate: for example, the change that doubles the parameter."""
        with jax.enable_x64(True):
            return self.coordinates.sizes(self.centre)

    @cached_property
    def spread(self) -> tuple[np.ndarray, np.ndarray]:
        """Variances and directions of the covariance of the base coordinates over their sizes."""
        slope = np.maximum(np.abs(self.slope(self.centre)), 1e-12) * self.sizes
        covariance, unknown = self._base_covariance()
        covariance[unknown], covariance[:, unknown] = 0.0, 0.0
        covariance[unknown, unknown] = (UNKNOWN * slope[unknown]) ** 2
        covariance = covariance / slope[:, None] / slope[None, :]
        # Next to a deviation of millions, one of thousandths would lose all its digits.
        share = np.minimum(1.0, UNKNOWN / np.sqrt(np.diagonal(covariance)))
        return np.linalg.eigh(covariance * share[:, None] * share[None, :])

    @property
    def holds_gain(self) -> bool:
        """Whether the gain stays where pixels over time, or flats, have put it.

        Noise beside the signal does not bias it there. Statistics of all pixels would move it for whatever the model
        still lacks. A gain that is not determined is 1, so that electrons are DN.
        """
        effects = [self.model[name] for name in self.extra]
        on_signal = any(one.acts_at in ON_SIGNAL or one.confounded_with == "gain" for one in effects)
        return self.base.transfer is not None and not (self.base.has_gain and on_signal)

    @property
    def of_base(self) -> np.ndarray:
        """Covariance of the base fit, given the gain if that is not determined."""
        base = self.base
        if base.transfer is None or base.has_gain:
            return base.covariance
        return given(base.covariance, [base.names.index(name) for name in base.rows_of("gain") if name in base.names])

    def _base_covariance(self) -> tuple[np.ndarray, np.ndarray]:
        """Covariance of the base fit in the order of the coordinates, and which of these it did not fit."""
        names, fitted = self.coordinates.names, self.base.names
        covariance = np.diag(np.full(len(names), np.inf))
        here = [i for i, name in enumerate(names) if name in fitted]
        there = [fitted.index(names[i]) for i in here]
        covariance[np.ix_(here, here)] = self.of_base[np.ix_(there, there)]
        if self.holds_gain and self.base.has_gain:
            gains = self.coordinates.where("gain")
            covariance[gains] *= SURE
            covariance[:, gains] *= SURE
        return covariance, ~np.isfinite(np.diagonal(covariance))

    @cached_property
    def whiten(self) -> np.ndarray:
        """Square root of the covariance of the base coordinates, capped at MOST_SPREAD in directions without data."""
        values, vectors = self.spread
        return self.sizes[:, None] * vectors * np.sqrt(np.clip(values, 1e-16, MOST_SPREAD))

    @cached_property
    def prior(self) -> np.ndarray:
        """Inverse prior variances that keep numbers near the start: of effects, and of what the base fit left open."""
        base = np.where(self.spread[0] < MOST_SPREAD, 1e-6, 1.0)
        return np.concatenate([base, np.full(len(self.added.numbers), PRIOR_SIGMA**-2)])

    def slope(self, vector: np.ndarray) -> np.ndarray:
        """d parameter / d coordinate of the base."""
        with jax.enable_x64(True):
            return np.asarray(self.coordinates.slope(jnp.asarray(vector)))

    @cached_property
    def coding(self):
        return coding_of(self.portion.frames)

    @cached_property
    def score(self) -> Score:
        """Score of the base likelihood at the base fit."""
        return Score.of(self.coordinates, self.centre, summarise(self.portion.frames, coding=self.coding))

    @cached_property
    def start(self) -> np.ndarray:
        return np.concatenate([np.zeros(len(self.centre)), self.added.read(self.model)])

    @cached_property
    def other_start(self) -> np.ndarray | None:
        """A start at the base parameters of `given`, which may account for more effects than `base` does."""
        vector = self.coordinates.read(self.given)
        if not np.all(np.isfinite(vector)) or np.allclose(vector, self.centre, rtol=1e-6):
            return None
        return np.concatenate([np.linalg.solve(self.whiten, vector - self.centre), self.start[len(vector) :]])

    def base_vector(self, y: np.ndarray) -> np.ndarray:
        """The coordinates of the base."""
        n = len(self.centre)
        return self.centre + self.whiten @ y[:n]

    def at(self, y: np.ndarray) -> NoiseModel:
        """The model whose numbers are y."""
        return self.added.put(self.coordinates.put(self.model, self.base_vector(y)), y[len(self.centre) :])

    def in_float64(self, y: np.ndarray) -> NoiseModel:
        with jax.enable_x64(True):
            return self.at(y)

    def statistics(self, frames: FrameStack) -> Structure:
        """Score of the base likelihood in whitened units, and the structure of the frames."""
        found = structure(frames, black_level_of(self.base.params))
        score = self.whiten.T @ self.score(summarise(frames, coding=self.coding))
        return replace(
            found,
            names=(*(f"score: direction {i}" for i in range(len(score))), *found.names),
            groups=(*["score"] * len(score), *found.groups),
            values=np.concatenate([score, found.values]),
            error=np.concatenate([np.full(len(score), SCORE_ERROR), found.error]),
        )

    def share_of(self, step: np.ndarray) -> float:
        """The share of a step that may be taken at once: statistics are linear in the parameters only nearby."""
        n = len(self.centre)
        base, own = np.abs(self.whiten @ step[:n]) / self.sizes, np.abs(step[n:])
        longest = max(base.max() / LONGEST_OF_BASE, own.max(initial=0.0) / LONGEST_STEP)
        return min(1.0, 1 / max(longest, 1e-12))


def check_named(model: NoiseModel) -> None:
    """Raise ValueError for a model with measured components: maps of a sensor are not numbers that a fit moves."""
    measured = [effect.name for effect in model if effect.arrays()]
    if measured:
        raise ValueError(
            f"{named('model')}: expected effects with numbers to fit, got what was measured of one sensor"
            f" ({', '.join(measured)}); fit the named model that was closed (named.json of improve --close)"
        )
