"""Frames that are a piece of a larger sensor."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hsnoise.effects import (
    AmplifierGlow,
    BlackShading,
    FrameTilt,
    Gain,
    MeasuredMap,
    OddEvenPattern,
    RowGroupNoise,
    TapOffsets,
)
from hsnoise.model import NoiseModel, sample

SENSOR = (48, 96)
PLACED = [
    TapOffsets(3.0, taps=6),
    TapOffsets(3.0, taps=3, row_taps=2),
    BlackShading(4.0, 0.1),
    BlackShading(4.0, 0.1, axis="row"),
    OddEvenPattern(2.0),
    FrameTilt(8.0),
    FrameTilt(8.0, "column"),
    RowGroupNoise(3.0, 0.2, 6, 5, 2, 2),
    MeasuredMap(np.arange(48.0)[:, None] + 100 * np.arange(96.0)),
]


def model_of(*effects, cfa="mono"):
    return NoiseModel([Gain(2.0), *effects], cfa=cfa, shutter="rolling", exposure_s=1.0)


@pytest.mark.parametrize(
    "effect",
    PLACED,
    ids=["taps", "quarters", "columns", "rows", "odd-even", "tilted rows", "tilted columns", "groups", "map"],
)
@pytest.mark.parametrize(("first", "shape"), [((0, 0), (48, 96)), ((20, 31), (8, 40)), ((47, 0), (1, 96))])
def test_a_piece_is_cut_out_of_the_sensor(effect, first, shape):
    model, sensor = model_of(effect), jax.random.key(1)
    whole = sample(jax.random.key(0), np.zeros((1, *SENSOR)), model, sensor_key=sensor)
    piece = sample(jax.random.key(0), np.zeros((1, *shape)), model, sensor_key=sensor, window=(*first, *SENSOR))
    (row, column), (rows, columns) = first, shape
    assert np.ptp(whole) > 1
    np.testing.assert_allclose(piece, whole[:, row : row + rows, column : column + columns], rtol=1e-5, atol=1e-6)


def test_a_glow_stays_in_its_corner():
    model = model_of(AmplifierGlow(1e4, 0.1, row=0.0, column=0.0))
    near, far = (
        sample(jax.random.key(0), np.zeros((4, 8, 8)), model, window=(*first, *SENSOR)).mean()
        for first in ((0, 0), (40, 88))
    )
    assert near > 1e3 and far < 10


def test_pieces_at_random_places_share_a_program():
    model, traced = model_of(TapOffsets(3.0, taps=6)), []

    @jax.jit
    def draw(key, row, column):
        traced.append(1)
        return sample(key, jnp.zeros((1, 4, 16)), model, sensor_key=jax.random.key(1), window=(row, column, *SENSOR))

    places = [(0, 0), (44, 80), (3, 7)]
    found = [draw(jax.random.key(0), *place) for place in places]
    known = [
        sample(jax.random.key(0), np.zeros((1, 4, 16)), model, sensor_key=jax.random.key(1), window=(*place, *SENSOR))
        for place in places
    ]
    np.testing.assert_array_equal(found, known)
    assert len(traced) == 1
    rows, columns = (jnp.array(of) for of in zip(*places, strict=True))
    np.testing.assert_array_equal(jax.vmap(draw, (None, 0, 0))(jax.random.key(0), rows, columns), known)


@pytest.mark.parametrize(
    ("window", "cfa", "error", "message"),
    [
        ((0, 0, 48), "mono", ValueError, "window: expected .first row"),
        ((41, 0, *SENSOR), "mono", ValueError, "holds 8 x 8 frames"),
        ((-1, 0, *SENSOR), "mono", ValueError, "window: expected"),
        ((0, 0, 4, 96), "mono", ValueError, "holds 8 x 8 frames"),
        ((0.5, 0, *SENSOR), "mono", TypeError, "window: expected a whole number"),
        ("all", "mono", TypeError, "window: expected four whole numbers"),
        ((1, 0, *SENSOR), "RGGB", ValueError, "window: expected even first rows"),
    ],
)
def test_wrong_windows_are_named(window, cfa, error, message):
    with pytest.raises(error, match=message):
        sample(jax.random.key(0), np.zeros((1, 8, 8)), model_of(cfa=cfa), window=window)
