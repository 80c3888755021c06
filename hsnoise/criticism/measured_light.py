"""How much light each pixel of one sensor catches, measured in flats: its photo response."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np

from hsnoise._core.types import cfa_tile
from hsnoise.criticism.measured_maps import Sensor
from hsnoise.effects import MeasuredMap
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import light_of, photoelectrons
from hsnoise.statistics.apart import Apart

MOST_LEVELS = 4  # of light: those that tell most
HOT = 0.1  # of the light: errors of so large a dark signal would be those of the response, and it may saturate
DARKEST = 0.1  # of the median light: below, what a pixel reads is not its response


def with_photo_response(model: NoiseModel, flats: FrameStack, rng: np.random.Generator) -> NoiseModel:
    """The model, which has a map of its pixels, with their response to light, in place of a law over pixels.

    flats: of two frames or more and of any light. The response is what a pixel has beside the smooth light of a flat;
    where that is darker than DARKEST of its median, and in pixels with a dark signal of HOT of it, it is taken as 1.
    """
    seen = [_relative(model, flats, i) for i in _telling(model, flats)]
    if not seen:
        return model
    step, response = len(cfa_tile(flats.cfa)), np.empty(flats.shape)
    sensor = Sensor(seen, rng, flats.window)
    for r, c in np.ndindex(step, step):
        at = (slice(r, None, step), slice(c, None, step))
        response[at], _ = sensor.levels(at)
    response = np.maximum(1 + response, 0)
    whole = cast(MeasuredMap, model["measured_map"])
    model = model.add(replace(whole, photo_response=(response / response.mean()).astype(np.float32)))
    return model.remove("photo_response_nonuniformity") if "photo_response_nonuniformity" in model else model


def _telling(model: NoiseModel, flats: FrameStack) -> list[int]:
    """The flats that tell most: the error of a response falls as the root of all electrons."""
    electrons = [n * float(light_of(model, flats, i).mean()) for i, n in enumerate(flats.n_frames)]
    lit = [i for i in range(flats.n_exposures) if electrons[i] > 0]
    return sorted(lit, key=lambda i: -electrons[i])[:MOST_LEVELS]


def _relative(model: NoiseModel, flats: FrameStack, exposure: int) -> Apart:
    """Frames of a flat, taken apart: what each pixel has in photoelectrons beside the light, relative to it."""
    light = light_of(model, flats, exposure)
    whole, exposure_s = model["measured_map"], float(flats.exposure_s[exposure])
    offset_dn, dark_e = np.asarray(whole.offset, float), np.zeros(flats.shape)
    if whole.growth is not None:
        offset_dn = offset_dn + exposure_s * np.asarray(whole.growth)
    if whole.dark_current is not None:
        dark_e = float(model["dark_current"].rate) * exposure_s * (np.asarray(whole.dark_current) - 1)
    is_lit = (light > DARKEST * np.median(light)) & (dark_e < HOT * light)
    light = np.where(is_lit, light, np.inf)

    def relative(frame: np.ndarray) -> np.ndarray:
        signal_e = photoelectrons(model, frame - offset_dn, exposure_s) - dark_e
        return (signal_e / light - is_lit).astype(np.float32)

    return Apart.of(np.stack([relative(frame) for frame in flats.frames(exposure)]), 0.0)
