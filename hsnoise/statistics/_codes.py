"""The codes that a converter uses: finding a digital gain from the gaps between them."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from hsnoise.frames.stack import FrameStack

LEAST_STEP, MOST_STEP = 1.05, 4.0
TAILS = 1e-3  # share of the counts at either end that is ignored
INSIDE, ON_COMB = 0.999, 0.94  # shares of the central counts that must lie near and on the comb
FEWEST_CODES = 8
FINENESS = 32  # steps tried for a shift of the last code by one
TIES = 0.02  # tolerance of k g about half a code: how halves are rounded is unknown
LARGEST_DENOMINATOR = 20  # of a digital gain that a person chose
BLOCK, MOST_WORK = 4096, 200_000_000


def code_step(stack: FrameStack) -> float | None:
    """Digital gain g whose codes round(k g), k = 0, 1, ..., contain the counts of the darks; None if there is none.

    From 1.05 to 4, if codes between those that occur are missing. Of several, the largest simple fraction is returned.
    """
    histogram = np.zeros(1 << 16, np.int64)
    for i, kind in enumerate(stack.kind):
        if kind == "dark":
            for frame in stack.frames(i):
                histogram += np.bincount(np.minimum(frame.ravel(), len(histogram) - 1), minlength=len(histogram))
    share = np.cumsum(histogram) / histogram.sum()
    low, high = np.searchsorted(share, [TAILS, 1 - TAILS])
    weight, codes = histogram[low : high + 1], np.arange(low, high + 1)
    if (weight > 0).sum() < FEWEST_CODES or weight.all():
        return None
    steps = np.arange(LEAST_STEP, MOST_STEP, 1 / (FINENESS * high))
    if len(steps) * len(codes) > MOST_WORK:
        return None
    blocks = np.split(steps, range(BLOCK, len(steps), BLOCK))
    inside = np.concatenate([_near_comb(codes, some) @ weight for some in blocks])
    good = np.flatnonzero(inside >= INSIDE * weight.sum())
    found = []
    for run in np.split(steps[good], np.flatnonzero(np.diff(good) > 1) + 1) if len(good) else ():
        g = _simplest(float(run[0]), float(run[-1]), 1 / (FINENESS * high))
        if _on_comb(codes, weight, float(g)) >= ON_COMB * weight.sum():
            found.append(g)
    # A larger gain has fewer codes, all of which occur. After a black level, gains that differ by whole turns look
    # alike: a simple fraction is likelier to have been chosen.
    return float(max(found, key=lambda g: (g.denominator <= LARGEST_DENOMINATOR, g))) if found else None


def _simplest(low: float, high: float, apart: float) -> Fraction:
    """The simplest fraction between steps low..high (tried `apart`), or else their middle."""
    simple = Fraction((low + high) / 2).limit_denominator(LARGEST_DENOMINATOR)
    return simple if low - apart < simple < high + apart else Fraction((low + high) / 2)


def _near_comb(codes: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Whether each code is one of k g rounded either way, for each step g: [step, code]."""
    multiple = np.rint(codes / steps[:, None]) * steps[:, None]
    return np.abs(codes - multiple) <= 0.5 + TIES


def _on_comb(codes: np.ndarray, weight: np.ndarray, g: float) -> int:
    """Number of counts whose code is a k g, with halves rounded to even or up, whichever holds more counts."""
    multiple = np.rint(codes / g) * g
    return max(int(weight[rounded == codes].sum()) for rounded in (np.rint(multiple), np.floor(multiple + 0.5)))
