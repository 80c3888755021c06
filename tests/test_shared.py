"""What draws of several models have in common is drawn once, and they are the same as without."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.chain.shared import Shared, identity
from hsnoise.simulation.draws import draw_capture

SHAPE = (32, 48)
BASE = hsnoise.NoiseModel(
    [
        fx.ShotNoise(),
        fx.DarkCurrent(20.0),
        fx.HotPixels(0.05, 50.0),
        fx.ReadNoise(4.0),
        fx.Gain(0.5),
        fx.BlackLevel(64.0),
        fx.ADC(4095),
    ],
    cfa="mono",
    shutter="global",
    exposure_s=1.0,
)
MODELS = {
    "itself": BASE,
    "a late effect": BASE.add(fx.RowNoise(3.0)),
    "one after the gain": BASE.add(fx.RowNoise(3.0, after_gain=True)),
    "one that scales read noise": BASE.add(fx.ReadNoiseNonuniformity(0.5)),
    "one that scales dark current": BASE.add(fx.DarkCurrentNonuniformity(0.5)),
    "one before the photons": BASE.add(fx.PhotoResponseNonuniformity(0.1)),
    "one that scales light": BASE.add(fx.MeasuredMap(photo_response=np.linspace(0.9, 1.1, 32 * 48).reshape(SHAPE))),
    "another gain": BASE.with_value("gain", "value", 0.6),
    "another dark current": BASE.with_value("dark_current", "rate", 25.0),
}


@pytest.fixture(scope="module")
def like():
    lit = (300 + np.arange(2 * 32 * 48).reshape(2, *SHAPE) % 7).astype(np.uint16)
    dark = (64 + np.arange(2 * 32 * 48).reshape(2, *SHAPE) % 5).astype(np.uint16)
    return hsnoise.FrameStack(
        [dark, dark + np.uint16(9), lit],
        [0.1, 1.0, 0.1],
        kind=["dark", "dark", "flat"],
        cfa="mono",
        shutter="global",
    )


def test_draws_are_those_without_it(like):
    shared = Shared()
    for _ in range(2):  # at first it has only seen them
        for name, model in MODELS.items():
            for key in (0, 1):
                with_it = draw_capture(jax.random.key(key), model, like, shared=shared)
                for one, other in zip(
                    with_it.counts, draw_capture(jax.random.key(key), model, like).counts, strict=True
                ):
                    np.testing.assert_array_equal(one, other, err_msg=name)


def test_what_comes_again_is_drawn_no_more():
    shared, drawn = Shared(), []
    for name in ("one", "other", "one", "one", "one"):
        assert shared.get(name, lambda name=name: drawn.append(name) or name) == name
    assert drawn == ["one", "other", "one"]  # signals that came once are not kept


def test_identity_tells_values_kinds_and_settings_apart():
    one = fx.RowNoise(3.0)
    assert identity(one) == identity(fx.RowNoise(3.0))
    others = [fx.RowNoise(3.1), fx.RowNoise(3.0, after_gain=True), fx.RowNoise(3.0, 1.0), fx.ColumnNoise(3.0)]
    assert len({identity(one), *map(identity, others)}) == 5
    assert identity(jax.random.key(0)) != identity(jax.random.key(1))
