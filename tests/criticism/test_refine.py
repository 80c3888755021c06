"""Parameters of a candidate brought closer to a capture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.criticism.fingerprint import Bench
from hsnoise.criticism.ranking import Evidence
from hsnoise.criticism.refine import refined
from hsnoise.frames.stack import FrameStack
from hsnoise.simulation.draws import draw_capture
from hsnoise.simulation.gaussian import shrunk
from hsnoise.simulation.portion import Portion
from hsnoise.simulation.simulator import Purpose, Simulator, key_for

CAMERA = hsnoise.cameras.grasshopper3(black_level_dn=64)
EXPOSURE_S = (0.05, 0.1, 0.2)


def judged_by(darks: FrameStack) -> tuple[Bench, Evidence]:
    """What candidates are drawn on, and the evidence of a capture."""
    bench = Bench.of(Simulator(CAMERA, Portion.of(darks), key_for(0, Purpose.DIAGNOSE)), 24)
    null = shrunk(bench.base.own_z(), bench.slopes())
    return bench, Evidence(bench.z, null, bench.base.names, bench.base.groups, 1)


@pytest.fixture(scope="module")
def like():
    counts = np.zeros((3, 6, 64, 96), np.uint16) + np.arange(96, dtype=np.uint16)
    return FrameStack(counts, EXPOSURE_S, black_level=64, white_level=65535, cfa="RGGB", shutter="global")


@pytest.mark.parametrize(
    ("hidden", "start", "within"),
    [
        (fx.DarkSignalNonuniformity(1.5), fx.DarkSignalNonuniformity(0.6), {"sigma": 0.1}),
        pytest.param(
            fx.AmplifierGlow(300.0, 0.3, 0.0, 1.0, 1.5),
            fx.AmplifierGlow(150.0, 0.5, 0.0, 1.0),
            {"scale": 0.3, "rate": 0.3},
            marks=pytest.mark.slow,
        ),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_parameters_come_close_to_those_hidden(hidden, start, within, like):
    (found,) = refined([start], *judged_by(draw_capture(7, CAMERA.add(hidden), like)))
    for name, share in within.items():
        assert float(getattr(found, name)) == pytest.approx(float(getattr(hidden, name)), rel=share)


@pytest.mark.slow
def test_settings_and_bounds_are_kept(like):
    bench, evidence = judged_by(draw_capture(8, CAMERA, like))
    typical = replace(evidence, z=np.zeros(len(evidence.names)))
    (found,) = refined([fx.TapOffsets(1.0, taps=4)], bench, typical)
    assert found.taps == 4
    assert 0 <= float(found.sigma) < 0.8  # no offsets in this capture


def test_an_effect_that_holds_all_its_numbers_stays_as_it_is(like):
    bench, evidence = judged_by(draw_capture(8, CAMERA, like))
    typical = replace(evidence, z=np.zeros(len(evidence.names)))
    (found,) = refined([fx.MissingCodes(1.6)], bench, typical)
    assert float(found.gain) == pytest.approx(1.6)
