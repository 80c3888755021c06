"""The gain register of an EMCCD, seen in darks: single electrons that scatter exponentially, in all pixels alike."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize, nnls

from hsnoise.statistics.pixels.sample import CORE_SIGMAS, MOST_OF_SPREAD

FEWEST_FRAMES = 6  # of which a comparison holds out two of eight
FAR = 6.0  # deviations beyond which a change is no read noise
LEAST_FAR = 2e-4  # share of such changes from which a register is looked for
EVEN = 0.8  # of the pixels that would have such changes if chance spread them; defects gather in few
DOWNWARD = 0.1  # of the far changes: telegraph noise jumps both ways
LEFT_OUT = 0.01  # of the pixels: those that may be hot
LEAST_ELECTRONS, LEAST_STEP = 5e-4, 2.5  # a pixel and frame; multiplied electron over read noise
FEWEST_FAR, BY_CHANCE = 100, 1.63  # far changes; distance of their law from the true one by chance, in 1 of 100
MOST_OFF = 0.03  # of that distance, beyond chance
LEAST_KNOWN = 0.25  # relative error of the step
CODES_A_DEVIATION = 4  # of the histogram
FEWEST_IN_BIN = 20.0
SINGULAR = 1e10  # condition of the information of the logarithms
FINELY = {"xatol": 1e-5, "fatol": 1e-12}


Number = tuple[float, float]  # with its standard error


class Register(NamedTuple):
    """Of one exposure, each value with its error: what an electron that enters adds on average, and the read noise,
    DN (rounding and noise of lines included); mean electrons that enter, of dark current and clocks, in a pixel and
    frame.

    together: by what power of another step the electrons change if the step is known better.
    """

    step_dn: Number
    read_noise_dn: Number
    electrons: Number
    together: float

    def with_step(self, step_dn: Number) -> Number:
        """Electrons where the step is this one."""
        (value, error), own = self.electrons, self.step_dn[1] / self.step_dn[0]
        alone = np.sqrt(max((error / value) ** 2 - (self.together * own) ** 2, 0.0))
        changed = value * (step_dn[0] / self.step_dn[0]) ** self.together
        return changed, changed * float(np.hypot(alone, self.together * step_dn[1] / step_dn[0]))


def register_of(counts: np.ndarray) -> Register | None:
    """A gain register in the darks [frame, row, column] of one exposure; None if they do not show one.

    Changes from frame to frame are free of a pixel's offset. Their distribution is that of two pixels with read noise
    and a Poisson number of exponentially multiplied electrons (Hirsch et al., PLoS ONE 8, 2013), one subtracted.
    Hot pixels, hits and telegraph noise gather in few pixels or have another distribution.
    """
    if len(counts) < FEWEST_FRAMES or _far(_changes(counts[:2]))[1].mean() < LEAST_FAR / 2:
        return None  # most sensors: one change tells
    changes = _changes(counts[: len(counts) // 2 * 2])
    sigma, far = _far(changes)
    if far.mean() < LEAST_FAR:
        return None
    if not _is_even(far.sum(0)) or not _is_upward(counts, sigma / np.sqrt(2)):
        return None
    half = len(changes) // 2
    # Without hot pixels, which other frames tell: chance in these does not choose.
    cool = [changes[of][:, _is_cool(counts[other])] for of, other in _crosswise(half)]
    return _fitted(np.abs(np.concatenate([one.ravel() for one in cool])), sigma / np.sqrt(2))


def common_of(several: list[Register]) -> tuple[Number, Number]:
    """Step and read noise of registers of several exposures, DN."""
    return mean_of([one.step_dn for one in several]), mean_of([one.read_noise_dn for one in several])


def rate_and_clocks(entered: list[tuple[float, Number]]) -> tuple[Number, Number]:
    """Electrons a second, and whatever the exposure, from those of each exposure, s.

    Electrons of one exposure are those of clocks: nothing tells when they came.
    """
    t = np.array([exposure_s for exposure_s, _ in entered])
    value, error = np.array([electrons for _, electrons in entered]).T
    columns = [np.ones_like(t), *([t] if np.ptp(t) > 0 else [])]
    design = np.stack(columns, 1) / error[:, None]
    solved, _ = nnls(design, value / error)
    errors = np.sqrt(np.diagonal(np.linalg.inv(design.T @ design)))
    clocks, *rate = ((float(v), float(e)) for v, e in zip(solved, errors, strict=True))
    return rate[0] if rate else (0.0, np.inf), clocks


def mean_of(pairs: list[Number]) -> Number:
    """Weighted mean, its error widened by the scatter."""
    values, errors = np.array(pairs, float).T
    weight = errors**-2.0
    mean = float(weight @ values / weight.sum())
    chi2 = float(weight @ (values - mean) ** 2) / max(len(pairs) - 1, 1)
    return mean, float(weight.sum() ** -0.5 * np.sqrt(max(chi2, 1.0)))


def _changes(counts: np.ndarray) -> np.ndarray:
    """Differences of neighbouring frames [pair, pixel] without the offsets of the frames."""
    changes = counts[1::2].astype(np.float32) - counts[::2]
    changes -= np.median(changes, axis=(1, 2), keepdims=True)
    most = CORE_SIGMAS * _spread(changes)
    # The means, as medians of counts are counts, and changes would lie on a grid.
    changes -= np.clip(changes, -most, most).mean(axis=(1, 2), keepdims=True)
    return changes.reshape(len(changes), -1)


def _far(changes: np.ndarray) -> tuple[float, np.ndarray]:
    """Typical deviation of changes [pair, pixel], DN, and which are too far for read noise; none where it is 0."""
    sigma = _spread(changes)
    return sigma, np.abs(changes) > (FAR * sigma if sigma > 0 else np.inf)


def _spread(changes: np.ndarray) -> float:
    """Half the distance between the quantiles of a deviation below and above."""
    thin = changes.ravel()[:: max(1, changes.size // MOST_OF_SPREAD)]
    return float(np.diff(np.quantile(thin, (0.1587, 0.8413)))[0]) / 2


def _is_even(in_pixel: np.ndarray) -> bool:
    """Whether as many pixels have far changes as if chance spread them."""
    return bool((in_pixel > 0).mean() > EVEN * -np.expm1(-in_pixel.mean()))


def _crosswise(half: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """The first pairs with the frames of the others, and the others with those of the first."""
    return (slice(half), slice(2 * half, None)), (slice(half, None), slice(2 * half))


def _is_cool(counts: np.ndarray) -> np.ndarray:
    """Pixels that are not among the brightest, on average over frames [frame, row, column]."""
    level = counts.mean(0, dtype=np.float64).ravel()
    return level <= np.quantile(level, 1 - LEFT_OUT)


def _is_upward(counts: np.ndarray, sigma: float) -> bool:
    """Whether counts are far above the median of their pixel, and hardly ever far below."""
    off = counts - np.median(counts, axis=0).astype(np.float32)
    off -= np.median(off, axis=(1, 2), keepdims=True)
    above, below = ((sign * off > FAR * sigma).mean() for sign in (1, -1))
    return bool(below < DOWNWARD * above)


def _fitted(sizes: np.ndarray, sigma: float) -> Register | None:
    """The likeliest register for these sizes of changes, DN; None if its distribution is another, or hardly known."""
    width = 2 * np.floor(sigma / CODES_A_DEVIATION / 2) + 1  # odd: each bin holds as many codes
    length = 1 << int(np.ceil(np.log2(2 * (float(sizes.max()) / width + 2))))
    index = np.rint(sizes.ravel() / width).astype(np.int64)
    found = np.bincount(index, minlength=length // 2).astype(float)[: length // 2]
    of_far = (sizes > FAR * np.sqrt(2) * sigma).mean()
    beyond = sizes[sizes > FAR * np.sqrt(2) * sigma]
    step = float(beyond.mean()) - FAR * np.sqrt(2) * sigma
    start = np.log([max(step, sigma), sigma, max(of_far, LEAST_ELECTRONS)])

    def log_shares(theta: np.ndarray) -> np.ndarray:
        return np.log(_shares(np.exp(theta), width, length))

    best = minimize(lambda theta: -found @ log_shares(theta) / found.sum(), start, method="Nelder-Mead", options=FINELY)
    shares = np.exp(log_shares(best.x))
    slopes = np.stack([(log_shares(best.x + h) - log_shares(best.x - h)) / 2e-4 for h in 1e-4 * np.eye(3)], 1)
    information = found.sum() * (slopes.T * shares) @ slopes
    if not np.linalg.cond(information) < SINGULAR:
        return None
    covariance = np.linalg.inv(information)
    expected = found.sum() * shares
    off, far = found - expected, np.arange(length // 2) * width > FAR * np.sqrt(2) * np.exp(best.x[1])
    told = expected > FEWEST_IN_BIN
    chi2 = float((off[told] ** 2 / expected[told]).sum()) / max(int(told.sum()) - 3, 1)
    errors = np.sqrt(np.diagonal(covariance) * max(chi2, 1.0))
    step_dn, noise_dn, electrons = ((float(v), float(v * e)) for v, e in zip(np.exp(best.x), errors, strict=True))
    # Largest distance between the distributions of the far changes, as Kolmogorov and Smirnov have it.
    number = float(found[far].sum())
    laws = [np.cumsum(of[far]) / max(float(of[far].sum()), 1e-9) for of in (found, expected)]
    left = float(np.abs(laws[0] - laws[1]).max()) - BY_CHANCE / np.sqrt(max(number, 1.0))
    is_one = (
        left < MOST_OFF
        and number > FEWEST_FAR
        and electrons[0] > LEAST_ELECTRONS
        and step_dn[0] > LEAST_STEP * noise_dn[0]
    )
    together = float(covariance[0, 2] / covariance[0, 0])
    return Register(step_dn, noise_dn, electrons, together) if is_one and errors[0] < LEAST_KNOWN else None


def _shares(values: np.ndarray, width: float, length: int) -> np.ndarray:
    """Share of each bin in the sizes of changes, for a step and read noise, DN, and a mean number of electrons.

    The inverse Fourier transform of |phi|^2, with phi that of one pixel: exp(-(sigma w)^2 / 2 + n (1/(1 - i w K) - 1)).
    """
    step, sigma, electrons = values
    w = 2 * np.pi * np.fft.rfftfreq(length, width)
    log_phi2 = -((sigma * w) ** 2) + 2 * electrons * (1 / (1 + (w * step) ** 2) - 1)
    of_bin = np.fft.irfft(np.exp(log_phi2) * np.sinc(w * width / (2 * np.pi)), length)[: length // 2]
    folded = of_bin * np.where(np.arange(length // 2) == 0, 1, 2)
    return np.maximum(folded, 1e-15) / np.maximum(folded, 1e-15).sum()
