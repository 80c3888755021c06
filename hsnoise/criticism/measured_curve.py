"""The response of a sensor, measured from flats of several levels."""

from __future__ import annotations

import numpy as np

from hsnoise.effects import MeasuredResponse
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import black_level_of
from hsnoise.simulation.portion import is_saturated

FEWEST_LEVELS = 5  # of light; a straight line takes two
MOST_BENT = 0.1  # of the level: beyond, the light was not what it should have been
SURE = 5.0  # standard errors of the levels, from which the response is bent


def with_response(model: NoiseModel, stack: FrameStack) -> NoiseModel:
    """The model with the measured response, where flats show one.

    Light is `photons_e` where it is known of all flats, else it is taken as constant while exposures differ; a shutter
    that opens late then shifts all of them, which is no response. A model without flats of FEWEST_LEVELS levels, or
    whose levels are straight within SURE errors or bend by more than MOST_BENT, is returned as it is.
    """
    flats = [i for i, kind in enumerate(stack.kind) if kind == "flat" and not is_saturated(stack, i)]
    known = stack.photons_e is not None and np.isfinite(stack.photons_e[flats]).all()
    light = np.asarray(stack.photons_e if known else stack.exposure_s)[flats]
    if len(set(light)) < FEWEST_LEVELS:
        return model
    black = float(black_level_of(model).mean())
    frames = [np.array([frame.mean(dtype=np.float64) for frame in stack.frames(i)]) - black for i in flats]
    lights = np.unique(light)
    pooled = [np.concatenate([of for of, x in zip(frames, light, strict=True) if x == at]) for at in lights]
    level = np.array([of.mean() for of in pooled])
    if np.any(np.diff(level, prepend=0.0) <= 0):
        return model
    design = lights[:, None] if known else np.stack([lights, np.ones_like(lights)], 1)
    straight = design @ np.linalg.lstsq(design / level[:, None], np.ones_like(level), rcond=None)[0]
    bent = level - straight
    error = np.array([of.std(ddof=1) / np.sqrt(len(of)) if len(of) > 1 else np.inf for of in pooled])
    if np.max(np.abs(bent) / level) > MOST_BENT or np.max(np.abs(bent) / np.maximum(error, 1e-9)) < SURE:
        return model
    knots = np.concatenate([[0.0], straight])
    if np.any(np.diff(knots) <= 0):
        return model
    return model.add(MeasuredResponse(black + knots, np.concatenate([[0.0], bent])))
