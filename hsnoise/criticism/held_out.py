"""Frames that no fit of `improve` has seen: the guard against over-fitting."""

from __future__ import annotations

import numpy as np

from hsnoise.criticism import sentences
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.portion import Portion
from hsnoise.simulation.simulator import Purpose, Simulator, key_for

SHARE, LEAST_HELD_OUT, LEAST_FITTED = 0.25, 2, 4  # of the dark frames of an exposure
DRAWS = 40  # of the likelihood


def split_frames(darks: FrameStack, stack: FrameStack) -> tuple[FrameStack, FrameStack | None]:
    """The stack without the last frames of its darks, and those; all and None if there are too few to spare."""
    spared = [max(LEAST_HELD_OUT, int(SHARE * n)) for n in darks.n_frames]
    kept = [n - some for n, some in zip(darks.n_frames, spared, strict=True)]
    if min(kept) < LEAST_FITTED:
        return stack, None
    of_darks = iter(kept)
    frames = [slice(next(of_darks)) if kind == "dark" else slice(None) for kind in stack.kind]
    return stack.select(frames=frames), darks.select(frames=[slice(n, None) for n in kept])


def split_in_words(fitted: FrameStack, held_out: FrameStack | None) -> str:
    """Which frames were fitted and which held out, in words."""
    if held_out is None:
        return ""
    kept = [n for n, kind in zip(fitted.n_frames, fitted.kind, strict=True) if kind == "dark"]
    return sentences.frames_apart(kept, held_out.n_frames)


def log_likelihood(
    model: NoiseModel, portion: Portion | None, seed: int, purpose: Purpose = Purpose.HELD_OUT, draws: int = DRAWS
) -> float:
    """Gaussian synthetic log-likelihood of the statistics of a portion, by draws that no fit has seen, nats.

    NaN without a portion: there were too few frames to hold some out.
    """
    if portion is None:
        return float("nan")
    simulator = Simulator(model, portion, key_for(seed, purpose))
    own = simulator.reference(model, draws)
    z = own.z(simulator.measured.values)
    return float(own.distribution.log_density(z) - np.log(own.deviation).sum())
