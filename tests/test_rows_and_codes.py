"""Banks of rows and unequal codes are told from what looks like them: row noise, and codes that are left out."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.statistics.structure import structure

EXPOSURE_S, SHAPE = (0.02, 0.2), (96, 128)
MONO = hsnoise.NoiseModel(
    [fx.ShotNoise(), fx.DarkCurrent(60.0), fx.ReadNoise(3.5), fx.Gain(2.5), fx.BlackLevel(64.0), fx.ADC(4095)],
    cfa="mono",
    shutter="global",
    exposure_s=0.1,
)
BAYER = hsnoise.cameras.grasshopper3(black_level_dn=64)


def normal(rng, mean=100.0, sigma=4.0):
    """Counts of independent normal pixels of two exposures, DN."""
    return [np.rint(rng.normal(mean, sigma, (8, *SHAPE))).astype(np.uint16) for _ in EXPOSURE_S]


def test_rows_of_two_banks_resemble_the_next_but_one(rng):
    model = hsnoise.NoiseModel([fx.RowBankNoise(2.0, 1.2)], cfa="mono", shutter="rolling", exposure_s=0.1)
    drawn = [np.asarray(hsnoise.sample_dark(jax.random.key(i), 8, SHAPE, model)) for i in range(2)]
    counts = [np.rint(c + d).astype(np.uint16) for c, d in zip(normal(rng), drawn, strict=True)]
    found = structure(hsnoise.FrameStack(counts, EXPOSURE_S, black_level=64.0), np.array(64.0))
    one, two = (
        found.names.index(f"row x frame: correlation with the next row{but}, short exposures")
        for but in ("", " but one")
    )
    assert found.values[two] > 12 * found.error[two]
    assert abs(found.values[one]) < 0.35  # scatters by 0.1: each bank varies slowly


def test_codes_that_are_left_out_are_told_from_narrow_ones(rng):
    def left_out(counts):
        found = structure(hsnoise.FrameStack(counts, EXPOSURE_S, black_level=64.0), np.array(64.0))
        return found.values[found.names.index("codes: share of codes left out, short exposures")]

    counts = normal(rng, 200.0, 12.0)
    assert left_out(counts) == 0
    # Every fourth of the counts with an odd code reads one less: odd codes are narrower.
    narrow = [c - ((c % 2 == 1) & (rng.random(c.shape) < 0.25)).astype(np.uint16) for c in counts]
    assert left_out(narrow) == 0
    assert left_out([np.rint(np.rint(c / 1.25) * 1.25).astype(np.uint16) for c in counts]) > 0.3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("camera", "hidden"),
    [
        (MONO, fx.RowBankNoise(1.0, 1.0, 0.3)),
        (BAYER, fx.RowBankNoise(1.0, 1.0, 0.3)),
        (MONO, fx.RowNoise(1.0, 1.0)),
        (MONO, fx.AdcNonuniformity(0.12)),
        (BAYER, fx.AdcNonuniformity(0.2, 8)),
        (MONO, fx.MissingCodes(1.1)),
        (MONO, None),
        (BAYER, None),
    ],
    ids=lambda x: x.cfa if isinstance(x, hsnoise.NoiseModel) else getattr(x, "name", "clean"),
)
def test_what_is_hidden_is_named(camera, hidden):
    truth, sensor = camera if hidden is None else camera.add(hidden), jax.random.key(103)
    counts = [
        np.asarray(hsnoise.sample_dark(jax.random.key(30 + i), 8, (64, 96), truth, exposure_s=t, sensor_key=sensor))
        for i, t in enumerate(EXPOSURE_S)
    ]
    stack = hsnoise.FrameStack(counts, EXPOSURE_S, black_level=64, cfa=camera.cfa, shutter="global")
    found = hsnoise.diagnose(camera, stack)
    assert found.names == (() if hidden is None else (hidden.name,))
    assert hidden is None or found.ranking[0].name == hidden.name
