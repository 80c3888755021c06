"""Parameters of a candidate brought closer to a capture."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.criticism.fingerprint import Bench
from hsnoise.criticism.gaussian import shrunk
from hsnoise.criticism.ranking import Evidence
from hsnoise.criticism.reference import measure, reference
from hsnoise.criticism.refine import refined
from hsnoise.frames.stack import FrameStack
from hsnoise.simulation.draws import draw_capture

CAMERA = hsnoise.cameras.grasshopper3(black_level_dn=64)
EXPOSURE_S = (0.05, 0.1, 0.2)


def nothing() -> None:
    pass


@pytest.fixture(scope="module")
def like():
    counts = np.zeros((3, 6, 64, 96), np.uint16) + np.arange(96, dtype=np.uint16)
    return FrameStack(counts, EXPOSURE_S, black_level=64, white_level=65535, cfa="RGGB", shutter="global")


@pytest.mark.parametrize(
    ("hidden", "start", "within"),
    [
        (fx.DarkSignalNonuniformity(1.5), fx.DarkSignalNonuniformity(0.6), {"sigma": 0.1}),
        (
            fx.AmplifierGlow(300.0, 0.3, 0.0, 1.0, 1.5),
            fx.AmplifierGlow(150.0, 0.5, 0.0, 1.0),
            {"scale": 0.3, "rate": 0.3},
        ),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_parameters_come_close_to_those_hidden(hidden, start, within, like):
    darks = draw_capture(7, CAMERA.add(hidden), like)
    bench = Bench(CAMERA, darks, reference(CAMERA, darks, 24, 100), 100, nothing)
    null = shrunk(bench.base.own_z(), bench.slopes())
    z = bench.base.z(measure(darks, CAMERA).values)
    (found,) = refined([start], bench, Evidence(z, null, bench.base.names, bench.base.groups, 1))
    for name, share in within.items():
        assert float(getattr(found, name)) == pytest.approx(float(getattr(hidden, name)), rel=share)


def test_settings_and_bounds_are_kept(like):
    darks = draw_capture(8, CAMERA, like)
    bench = Bench(CAMERA, darks, reference(CAMERA, darks, 24, 100), 100, nothing)
    null = shrunk(bench.base.own_z(), bench.slopes())
    evidence = Evidence(np.zeros(len(bench.base.names)), null, bench.base.names, bench.base.groups, 1)
    (found,) = refined([fx.TapOffsets(1.0, taps=4)], bench, evidence)
    assert found.taps == 4
    assert 0 <= float(found.sigma) < 0.8  # no offsets in this capture


def test_an_effect_that_holds_all_its_numbers_stays_as_it_is(like):
    darks = draw_capture(8, CAMERA, like)
    bench = Bench(CAMERA, darks, reference(CAMERA, darks, 24, 100), 100, nothing)
    null = shrunk(bench.base.own_z(), bench.slopes())
    evidence = Evidence(np.zeros(len(bench.base.names)), null, bench.base.names, bench.base.groups, 1)
    (found,) = refined([fx.MissingCodes(1.6)], bench, evidence)
    assert float(found.gain) == pytest.approx(1.6)
