"""What differs from frame to frame: a level that settles, one that is new in each frame, a dark current that grows."""

from __future__ import annotations

import pytest

import hsnoise
from hsnoise import effects as fx

FEW = ("frame_settling", "frame_offset", "dark_current_drift", "frame_tilt", "image_lag")
EXPOSURES_S = (0.1, 1.0, 5.0, 20.0)
CAMERA = hsnoise.NoiseModel(
    [fx.ShotNoise(), fx.DarkCurrent(2.0), fx.ReadNoise(3.5), fx.Gain(2.0), fx.BlackLevel(100.0), fx.ADC(4095)],
    cfa="mono",
    shutter="global",
    exposure_s=1.0,
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "hidden",
    [
        fx.FrameSettling(2.0, 2.5),
        fx.FrameSettling(-1.0, 0.7, after_gain=True),
        fx.FrameSettling(0.5, 30.0),
        fx.FrameOffset(0.5),
        fx.DarkCurrentDrift(0.02),
    ],
    ids=repr,
)
def test_each_is_named_first(hidden, few_candidates):
    truth = CAMERA.add(hidden)
    counts = [
        hsnoise.sample_dark(20 + i, 8, (64, 96), truth, exposure_s=t, sensor_key=1) for i, t in enumerate(EXPOSURES_S)
    ]
    stack = hsnoise.FrameStack(counts, EXPOSURES_S, black_level=100, cfa="mono", shutter="global")
    found = hsnoise.diagnose(CAMERA, stack, draws=40)
    assert found.names == (hidden.name,)


@pytest.mark.slow
def test_a_settling_level_is_told_from_chance_in_bias_frames_alone(few_candidates):
    """One run of twenty frames: a random offset of each frame would hardly fall as smoothly."""
    truth = CAMERA.add(fx.FrameSettling(2.0, 4.0))
    counts = hsnoise.sample_dark(3, 20, (64, 96), truth, exposure_s=0.0)
    stack = hsnoise.FrameStack([counts], [0.0], black_level=100, cfa="mono", shutter="global")
    found = hsnoise.diagnose(CAMERA, stack, draws=40)
    assert found.ranking[0].name == "frame_settling"
