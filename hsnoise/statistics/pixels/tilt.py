"""Frames that are tilted, each in its own way: a line over the rows or columns, told from slow noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy  # its parts are imported when they are used

from hsnoise.statistics.decomposition import Component, of_neighbouring_rows

FEWEST_FRAMES, FEWEST_LINES = 4, 32
SLOWEST = 12  # cosines over the lines, by which slow noise is told from a line
STEEPEST = 2.0  # exponent of the power of slow noise: a random walk
CERTAIN = 7.0  # nats: where there is none, one of 10 000 captures seems to have it (half a chi-square of one)
BESIDE = 3.0  # nats, from which there is slow noise beside a line
EXPONENTS = (0.5, 1.0, 1.5)  # at which the search for it starts
NOTHING = -50.0  # logarithm of a power, DN^2
SURE = 6.0  # standard errors, by what lines scatter, of the variance of slopes


class Tilt(NamedTuple):
    """How the means of one plane's rows or columns are tilted from frame to frame, by slow noise or by a line.

    slope_dn2: variance over frames of the slope, DN from the first line to the last, squared; noise_dn2: the part of it
    that independent lines make, which is subtracted. frames, lines: how many. power [SLOWEST]: mean squares of the
    frames' slowest cosines, DN^2. together, error_dn2: of the lines less their slopes, the covariance of one with the
    next and with the next but one, and the error of their variance by how it differs from frame to frame.
    """

    slope_dn2: float
    noise_dn2: float
    frames: int
    lines: int
    power: np.ndarray
    together: tuple[Component, Component]
    error_dn2: float

    def of_lines(self, slope_dn2: float, apart: int = 0) -> float:
        """Covariance of lines so far apart that slopes of a variance make, DN^2; of 0 their variance."""
        x = _along(self.lines)
        return slope_dn2 * float(x[apart:] @ x[: self.lines - apart]) / (self.lines - max(apart, 1))


def tilt_of(means_dn: np.ndarray) -> Tilt | None:
    """The tilts of means of rows or columns [frame, line], DN; None of too few."""
    frames, lines = means_dn.shape
    if frames < FEWEST_FRAMES or lines < FEWEST_LINES:
        return None
    left = means_dn - means_dn.mean(0)
    left -= left.mean(1, keepdims=True)
    x = _along(lines)
    slopes = left @ x / (x @ x)
    straight = left - slopes[:, None] * x
    unbiased = frames / (frames - 1)
    noise_dn2 = unbiased * float(np.square(straight).sum(1).mean()) / (lines - 2) / float(x @ x)
    power = unbiased * np.square(scipy.fft.dct(left, norm="ortho", axis=1)[:, 1 : SLOWEST + 1]).mean(0)
    together = of_neighbouring_rows(straight), of_neighbouring_rows(straight, 2)
    error = float((straight.var(1) * unbiased).std(ddof=1) / np.sqrt(frames))
    return Tilt(unbiased * float(np.mean(slopes**2)) - noise_dn2, noise_dn2, frames, lines, power, together, error)


def share_of_a_line(planes: Sequence[Tilt], alike: int = 1) -> float:
    """The part of the variance of slopes that a line makes which is new in each frame; 0 where slow noise may make all.

    Slow noise, of power k^-exponent on a white floor, has more than the lowest cosine (a likelihood ratio of mean
    squares: Whittle, J. R. Stat. Soc. B 19, 1957). planes: of all colours and exposures; alike: planes of a frame,
    which may share all of it.
    """
    freedom = np.array([(one.frames - 1.0) / alike for one in planes])
    slope, noise, *power = np.average([(one.slope_dn2, one.noise_dn2, *one.power) for one in planes], 0, freedom)
    if slope < SURE * noise * np.sqrt(2 / freedom.sum()) or min(power) <= 0:
        return 0.0
    k = np.arange(1.0, SLOWEST + 1)
    ramp = scipy.fft.dct(_along(planes[0].lines), norm="ortho")[1 : SLOWEST + 1] ** 2

    def misfit(numbers: np.ndarray) -> float:
        floor, line, slow, exponent = numbers
        expected = np.exp(floor) + np.exp(line) * ramp + np.exp(slow) * k**-exponent
        return float(freedom.sum() / 2 * np.sum(np.log(expected) + power / expected))

    least, most, of_line = (float(np.log(of)) for of in (min(power), max(power), slope))
    floors, lines, none = (least - 5, most + 1), (of_line - 5, of_line + 1), (NOTHING, NOTHING)
    noises = (least - 5, most + 3), (0.0, STEEPEST)
    slow = _best(misfit, [(least, NOTHING, most, e) for e in EXPONENTS], [floors, none, *noises])
    rest = float(np.log(max(power[1:])))
    both = _best(misfit, [(least, of_line, rest, e) for e in EXPONENTS], [floors, lines, *noises])
    if slow.fun - both.fun < CERTAIN:
        return 0.0
    line = _best(misfit, [(least, of_line, NOTHING, 0.0)], [floors, lines, none, (0.0, 0.0)])
    return 1.0 if line.fun - both.fun < BESIDE else min(float(np.exp(both.x[1] - of_line)), 1.0)


def _best(misfit: Callable[[np.ndarray], float], starts: list[tuple[float, ...]], bounds: list[tuple[float, float]]):
    found = [scipy.optimize.minimize(misfit, start, bounds=bounds, method="L-BFGS-B") for start in starts]
    return min(found, key=lambda one: one.fun)


def _along(lines: int) -> np.ndarray:
    """-1/2 at the first of lines to 1/2 at the last, as in `FrameTilt`."""
    return np.linspace(-0.5, 0.5, lines)
