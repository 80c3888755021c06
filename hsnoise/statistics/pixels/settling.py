"""The course of the black level over a run of frames, if it is the same in all exposures: one decay, or two."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import f as f_distribution

FEWEST_FRAMES = 6  # of an exposure that tells a course
LEAST_DOF = 5  # frames beyond the numbers that are fitted
RARE = (1e-6, 1e-4)  # chance of a first decay, the best of many, among offsets that are new in each frame; of a second
ALIKE = 1e-3  # chance, at least, of the differences between exposures
CERTAIN = 5.0  # standard errors of an amplitude
FASTEST, STEPS = 0.3, 12  # frames; time constants that are tried


class _Fit(NamedTuple):
    """Sum of squares that decays with these time constants leave, their amplitudes and errors, DN."""

    left: float
    amplitude: np.ndarray
    errors: np.ndarray
    taus: tuple[float, ...]


class Settling(NamedTuple):
    """offset_dn * exp(-f / frames) + slow_dn * exp(-f / slow_frames) in frame f, DN; errors of the two amplitudes.

    left_dn2: variance of frames about it, DN^2, and its degrees of freedom.
    """

    offset_dn: tuple[float, float]
    frames: float
    slow_dn: tuple[float, float]
    slow_frames: float
    left_dn2: float
    dof: int

    def mean_dn(self, frames: int) -> tuple[float, float]:
        """Mean offset of the first frames of a run, and its error, DN.

        What has not settled by the last frame counts as an error: how it goes on is not measured.
        """
        size, errors = np.array([self.offset_dn, self.slow_dn]).T
        decays = np.exp(-np.arange(frames) / np.array([[self.frames], [self.slow_frames]]))
        mean = decays.mean(1)
        return float(size @ mean), float(np.linalg.norm([*(errors * mean), size @ decays[:, -1]]))


def settling_of(means_dn: Sequence[np.ndarray], is_bias: bool) -> Settling | None:
    """The course that the frame means [frame] of all exposures share, DN; None if offsets of frames explain them.

    is_bias: whether no signal can be in the frames; else one exposure does not tell a black level from a dark current.
    """
    runs = [run - run.mean() for run in means_dn if len(run) >= FEWEST_FRAMES]
    if not runs or (len(runs) == 1 and not is_bias):
        return None
    longest = max(map(len, runs))
    taus = np.geomspace(FASTEST, longest, STEPS)
    tried = [(tau,) for tau in taus] + [(one, other) for one in taus for other in taus if other > 3 * one]
    fits = {n: min((_fitted(runs, of) for of in tried if len(of) == n), key=lambda fit: fit.left) for n in (1, 2)}
    best = _Fit(float(sum(run @ run for run in runs)), np.zeros(0), np.zeros(0), ())
    free = sum(map(len, runs)) - len(runs)
    for n in (1, 2):
        more, dof = n - len(best.taus), free - 2 * n
        if dof >= LEAST_DOF and _chance(best.left, fits[n].left, 2 * more, dof) < RARE[len(best.taus)]:
            best = fits[n]
    left, amplitude, errors, chosen = best
    if not (np.abs(amplitude) > CERTAIN * errors).any() or not _is_alike(runs, best):
        return None
    pairs = [(float(a), float(e)) for a, e in zip(amplitude, errors, strict=True)] + [(0.0, 0.0)]
    dof = free - 2 * len(chosen)
    return Settling(pairs[0], float(chosen[0]), pairs[1], float([*chosen, longest][1]), left / dof, dof)


def _fitted(runs: list[np.ndarray], taus: tuple[float, ...]) -> _Fit:
    """Decays with these time constants, the same in all runs, each at its level."""
    design = np.concatenate([_decays(len(run), taus) for run in runs])
    values = np.concatenate(runs)
    inverse = np.linalg.pinv(design.T @ design)
    amplitude = inverse @ (design.T @ values)
    left = float(((values - design @ amplitude) ** 2).sum())
    dof = max(len(values) - len(runs) - 2 * len(taus), 1)
    return _Fit(left, amplitude, np.sqrt(np.diagonal(inverse) * left / dof), taus)


def _decays(frames: int, taus: tuple[float, ...]) -> np.ndarray:
    """Decays [frame, number] about their means."""
    decays = np.exp(-np.arange(frames)[:, None] / np.array(taus))
    return decays - decays.mean(0)


def _chance(before: float, after: float, numbers: int, dof: int) -> float:
    """The chance that so many more numbers take so much of a sum of squares (F test)."""
    return float(f_distribution.sf((before - after) / numbers / max(after / dof, 1e-300), numbers, dof))


def _is_alike(runs: list[np.ndarray], best: _Fit) -> bool:
    """Whether one course describes all runs: amplitudes of their own leave hardly less."""
    apart = sum(_fitted([run], best.taus).left for run in runs)
    more = (len(runs) - 1) * len(best.taus)
    dof = sum(map(len, runs)) - len(runs) * (1 + len(best.taus))
    return more == 0 or dof < 1 or _chance(best.left, apart, more, dof) > ALIKE
