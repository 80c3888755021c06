"""How the statistics of a model's own draws scatter: the yardstick of every comparison."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hsnoise.simulation.gaussian import Gaussian, floored_variance, shrunk


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

    @staticmethod
    def of(names: tuple[str, ...], groups: tuple[str, ...], draws: np.ndarray, error: np.ndarray) -> Reference:
        """The reference of draws [draw, statistic] whose analytic error is `error` [statistic]."""
        deviation = _deviation(draws.var(0, ddof=1), len(draws) - 1, error**2)
        return Reference(names, groups, draws, draws.mean(0), deviation, error**2)

    def of_draws(self, numbers: np.ndarray) -> Reference:
        """The reference of some of the draws alone."""
        return Reference.of(self.names, self.groups, self.draws[numbers], np.sqrt(self.floor))

    def z(self, values: np.ndarray) -> np.ndarray:
        """(values - mean) / deviation, the error of the mean included."""
        return (values - self.mean) / (self.deviation * np.sqrt(1 + 1 / len(self.draws)))

    @cached_property
    def distribution(self) -> Gaussian:
        """Distribution of z of the model's own draws, all parameters held."""
        return shrunk(self.own_z(), np.zeros((1, len(self.mean))))

    def own_z(self) -> np.ndarray:
        """z of each draw against all others [draw, statistic]."""
        n = len(self.draws)
        others = (self.draws.sum(0) - self.draws) / (n - 1)
        squares = (self.draws**2).sum(0) - self.draws**2
        variance = np.maximum(squares - (n - 1) * others**2, 0) / (n - 2)
        deviation = _deviation(variance, n - 2, self.floor)
        return (self.draws - others) / (deviation * np.sqrt(1 + 1 / (n - 1)))


def _deviation(variance: np.ndarray, dof: int, floor: np.ndarray) -> np.ndarray:
    """Deviation of statistics.

    Half of the analytic variance stays however many draws there are: a rare event that no draw shows is no surprise
    in one capture.
    """
    return np.sqrt(np.maximum(floored_variance(variance, dof, floor), floor / 2))


def misfits(z: np.ndarray, groups: tuple[str, ...]) -> dict[str, float]:
    """Chi-square per degree of freedom of each group, from z [statistic]."""
    labels = np.asarray(groups)
    return {group: float(np.mean(z[labels == group] ** 2)) for group in dict.fromkeys(groups)}
