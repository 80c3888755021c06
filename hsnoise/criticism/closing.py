"""A model closed with measured components: what no effect explains is measured, and drawn like any other effect.

The maps of this sensor take the place of the effects that draw the pattern of any sensor of the make. What changes from
frame to frame stays with the named effects as far as they are right; the rest is measured, by the difference between
measured frames and frames drawn from the model, until they agree.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from hsnoise._core.arguments import seed_of
from hsnoise.criticism.measured_maps import Sensor
from hsnoise.criticism.measured_noise import (
    ALLOWED,
    capture_like,
    mean_power,
    misfit,
    of_axis,
    with_distribution,
    with_hits,
    with_read_noise,
    with_spectra,
)
from hsnoise.frames.source import as_stack
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import check_fits, draw_capture
from hsnoise.simulation.simulator import Purpose, key_for
from hsnoise.statistics.apart import Apart

ROUNDS = 4  # draws that bring the model nearer
# What the maps, the distribution and the hits stand for. Effects that need light or a series of frames stay.
REPLACED = (
    "dark_signal_nonuniformity",
    "dark_current_nonuniformity",
    "read_noise_nonuniformity",
    "row_fixed_pattern",
    "column_fixed_pattern",
    "black_shading",
    "tap_offsets",
    "odd_even_pattern",
    "amplifier_glow",
    "hot_pixels",
    "random_telegraph_noise",
    "heavy_tailed_read_noise",
    "cosmic_rays",
    "measured_map",
    "measured_spectrum",
    "measured_distribution",
    "measured_hits",
)


def closed(model: Any, stack: Any, *, seed: int = 0, **keywords) -> NoiseModel:
    """The model closed with measured components."""
    params = getattr(model, "params", model)
    stack = as_stack(stack, **keywords)
    check_fits(params, stack, "model")
    chosen = [i for i, kind in enumerate(stack.kind) if kind == "dark" and stack.n_frames[i] > 1]
    if not chosen:
        raise ValueError("stack: expected two frames or more of a dark exposure, to tell what stays from what changes")
    darks = stack.select(exposures=chosen)
    with jax.enable_x64(True):
        return _Closing(darks, _apart(darks), seed_of("seed", seed)).closed(params)


def _apart(darks: FrameStack) -> tuple[Apart, ...]:
    return tuple(
        Apart.of(np.stack(list(darks.frames(i))), float(exposure_s)) for i, exposure_s in enumerate(darks.exposure_s)
    )


class _Closing:
    def __init__(self, darks: FrameStack, seen: tuple[Apart, ...], seed: int):
        self.darks, self.seen, self.key = darks, seen, key_for(seed, Purpose.CLOSE)
        self.sensor = Sensor(seen, np.random.default_rng(seed), darks.window)

    def closed(self, model: NoiseModel) -> NoiseModel:
        for name in REPLACED:
            if name in model:
                model = model.remove(name)
        model = self.named_that_hold(with_hits(self.sensor.with_map(model), self.sensor))
        for number in range(ROUNDS):
            drawn = self.drawn(model, number)
            before, model = mean_power(model), with_spectra(model, self.seen, drawn)
            model = with_read_noise(model, self.sensor, drawn, mean_power(model) - before)
            if number == 0:
                model = with_distribution(model, self.sensor)
        return model

    def drawn(self, model: NoiseModel, number: int) -> tuple[Apart, ...]:
        return _apart(draw_capture(jax.random.fold_in(self.key, number), model, self.darks))

    def named_that_hold(self, model: NoiseModel) -> NoiseModel:
        """The model without effects that overshoot in rows, columns or frames: their noise is measured whole."""
        like = capture_like(model, self.darks.shape, float(self.darks.exposure_s.max()))
        axes = ("gain", "row", "column", "frame")
        feeding = {axis: {one.name for one in model if of_axis(one, axis, like)} for axis in axes}
        bare = model
        for name in set().union(*feeding.values()):
            bare = bare.remove(name)
        with_named, without = self.drawn(model, ROUNDS), self.drawn(bare, ROUNDS)
        for axis, names in feeding.items():
            print(axis, names, misfit(axis, self.seen, with_named), misfit(axis, self.seen, without))
            if misfit(axis, self.seen, with_named) > misfit(axis, self.seen, without) + ALLOWED:
                for name in names & set(model.names):
                    model = model.remove(name)
        return model
