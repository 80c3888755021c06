"""How the statistics of a model's own draws scatter: the yardstick of every comparison."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hsnoise._core.threads import in_threads
from hsnoise.criticism.gaussian import Gaussian, shrunk
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import black_level_of, draw_capture, floored_variance
from hsnoise.statistics.structure import Structure, structure


@dataclass(frozen=True)
class Reference:
    """Statistics of a model's draws.

    Attributes:
        names, groups: of each statistic.
        draws [draw, statistic]: the statistics of the draws.
        mean, deviation [statistic]: over the draws; the deviation is kept from vanishing by an analytic error, so
            that no statistic explodes because the draws hardly vary.
        floor [statistic]: that analytic error, squared.
    """

    names: tuple[str, ...]
    groups: tuple[str, ...]
    draws: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray
    floor: np.ndarray

    def z(self, values: np.ndarray) -> np.ndarray:
        """(values - mean) / deviation, the error of the mean included."""
        return (values - self.mean) / (self.deviation * np.sqrt(1 + 1 / len(self.draws)))

    @cached_property
    def law(self) -> Gaussian:
        """Law of z of the model's own draws, all parameters held."""
        return shrunk(self.own_z(), np.zeros((1, len(self.mean))))

    def own_z(self) -> np.ndarray:
        """z of each draw against all others [draw, statistic]."""
        n = len(self.draws)
        others = (self.draws.sum(0) - self.draws) / (n - 1)
        squares = (self.draws**2).sum(0) - self.draws**2
        variance = np.maximum(squares - (n - 1) * others**2, 0) / (n - 2)
        deviation = _deviation(variance, n - 2, self.floor)
        return (self.draws - others) / (deviation * np.sqrt(1 + 1 / (n - 1)))


def measure(stack: FrameStack, model: NoiseModel) -> Structure:
    """Statistics of a stack, counts taken above the black level of `model`."""
    return structure(stack, black_level_of(model))


def reference(model: NoiseModel, like: FrameStack, draws: int, seed: int, tick=lambda: None) -> Reference:
    """Statistics of `draws` captures drawn from `model` as `like` was taken."""
    drawn = in_threads(lambda i: measure(draw_capture(seed + i, model, like), model), range(draws), tick)
    values = np.stack([one.values for one in drawn])
    floor = np.median([one.error for one in drawn], axis=0) ** 2
    deviation = _deviation(values.var(0, ddof=1), draws - 1, floor)
    return Reference(drawn[0].names, drawn[0].groups, values, values.mean(0), deviation, floor)


def _deviation(variance: np.ndarray, dof: int, floor: np.ndarray) -> np.ndarray:
    """Deviation of statistics. Half of the analytic variance stays however many draws there are: of a rare event that
    no draw has, one in a capture is still no wonder.
    """
    return np.sqrt(np.maximum(floored_variance(variance, dof, floor), floor / 2))


def misfits(z: np.ndarray, groups: tuple[str, ...]) -> dict[str, float]:
    """Chi-square per degree of freedom of each group, from z [statistic]."""
    labels = np.asarray(groups)
    return {group: float(np.mean(z[labels == group] ** 2)) for group in dict.fromkeys(groups)}
