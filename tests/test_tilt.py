"""Frames that are tilted, each in its own way: told from slow noise of rows, and measured beside it."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise.effects import FrameTilt
from hsnoise.fitting.pixel_tilt import straightened, tilted_in
from hsnoise.simulation.draws import draw_capture
from hsnoise.statistics.pixels.survey import survey
from hsnoise.statistics.pixels.tilt import FEWEST_FRAMES, FEWEST_LINES, share_of_a_line, tilt_of

LINES = 160


def slow_noise(rng, frames: int, exponent: float, sigma: float) -> np.ndarray:
    """Lines [frame, line] cut from series four times as long, which need not end where they begin."""
    k = np.abs(np.fft.fftfreq(4 * LINES, 1 / (4 * LINES)))
    power = np.where(k > 0, np.maximum(k, 1.0) ** -exponent, 0.0)
    series = np.fft.rfft(rng.standard_normal((frames, 4 * LINES)))
    series *= np.sqrt(power * len(power) / power.sum())[: 2 * LINES + 1]
    return sigma * np.fft.irfft(series, 4 * LINES)[:, :LINES]


def tilted(rng, frames: int, slope: float) -> np.ndarray:
    return slope * rng.standard_normal((frames, 1)) * np.linspace(-0.5, 0.5, LINES)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 1.5, 2.0])
@pytest.mark.parametrize("frames", [FEWEST_FRAMES, 8, 24])
def test_slow_noise_alone_is_no_tilt(exponent, frames, rng):
    for _ in range(8):
        noise = slow_noise(rng, frames, exponent, 0.5) + 0.1 * rng.standard_normal((frames, LINES))
        assert share_of_a_line([tilt_of(noise)]) == share_of_a_line(4 * [tilt_of(noise)], alike=4) == 0


@pytest.mark.parametrize("sigma", [0.0, 0.3])
def test_a_tilt_is_told_from_slow_noise_beside_it(sigma, rng):
    slope, frames, found = 2.0, 24, []
    for _ in range(12):
        means = slow_noise(rng, frames, 1.0, sigma) + 0.1 * rng.standard_normal((frames, LINES))
        one = tilt_of(means + tilted(rng, frames, slope))
        found.append(share_of_a_line([one]) * one.slope_dn2)
    assert min(found) > 0
    assert np.mean(found) == pytest.approx(slope**2, abs=3 * slope**2 * np.sqrt(2 / (frames - 1) / len(found)))


def test_two_exposures_show_a_tilt_that_one_hides(rng):
    of = [slow_noise(rng, 8, 1.0, 0.3) + 0.1 * rng.standard_normal((8, LINES)) + tilted(rng, 8, 1.5) for _ in range(6)]
    alone, together = share_of_a_line([tilt_of(of[0])]), share_of_a_line([tilt_of(one) for one in of])
    assert alone == 0 and 0.5 < together <= 1


def test_too_few_frames_or_lines_tell_nothing(rng):
    assert tilt_of(rng.standard_normal((FEWEST_FRAMES - 1, LINES))) is None
    assert tilt_of(rng.standard_normal((FEWEST_FRAMES, FEWEST_LINES - 1))) is None
    assert share_of_a_line([tilt_of(np.zeros((8, LINES)))]) == 0


def capture(rng, axis: str, slope_e: float, rows_e: float, exponent=1.0, exposure_s=(1.0, 30.0, 120.0)):
    """A capture, and the rms of the slopes that its frames happen to have about those of their exposure."""
    counts, squares, shape = [], [], (LINES, 200)
    for t in exposure_s:
        electrons = rng.poisson(0.5 * t, (8, *shape)) + 6 * rng.standard_normal((8, *shape))
        electrons += slow_noise(rng, 8, exponent, rows_e)[:, :, None]
        x = np.linspace(-0.5, 0.5, shape[axis == "column"])
        slopes = slope_e * rng.standard_normal((8, 1, 1))
        squares.append(slopes.var(ddof=1))
        electrons += slopes * (x[:, None] if axis == "row" else x)
        counts.append(np.rint(500 + 1.5 * electrons).astype(np.uint16))
    return hsnoise.FrameStack(counts, exposure_s), np.sqrt(np.mean(squares))


@pytest.mark.parametrize(("axis", "rows_e"), [("row", 0.0), ("row", 1.0), ("column", 0.0)])
def test_a_fit_measures_a_tilt_and_what_is_left_without_it(axis, rows_e, rng):
    stack, rms_e = capture(rng, axis, 7.0, rows_e)
    fit = hsnoise.fit(stack, pixels="differ")
    there = {"frame_tilt"} | ({"row_noise"} if rows_e else set())
    assert there <= set(fit.added) <= there | ({"frame_offset"} if rows_e else set())
    assert fit.params["frame_tilt"].axis == axis
    value, error, unit = fit.table["frame_tilt.sigma"]
    assert value == pytest.approx(rms_e, rel=0.02 if rows_e == 0 else 0.1) and unit == "e-"
    least = value / np.sqrt(2 * 21)
    assert 0.99 * least < error < (1.05 if rows_e == 0 else 1.5) * least
    if rows_e:
        value, error, _ = fit.table["row_noise.sigma"]
        assert abs(value - rows_e) < 4 * error and error < 0.1 * value
        assert fit.table["row_noise.exponent"][0] == pytest.approx(1.0, abs=0.3)
    assert fit.table["gain"][0] == pytest.approx(1.5, abs=4 * fit.table["gain"][1])


@pytest.mark.parametrize("exponent", [1.0, 2.5])
def test_slow_noise_of_rows_stays_row_noise(exponent, rng):
    """What is left of it in the mean of a few frames is no pattern of rows."""
    fit = hsnoise.fit(capture(rng, "row", 0.0, 1.5, exponent)[0], pixels="differ")
    assert set(fit.added) <= {"row_noise", "frame_offset"} and "row_noise" in fit.added


@pytest.mark.parametrize("after_gain", [False, True])
def test_colours_tell_on_which_side_of_the_gain_it_arises(after_gain):
    exposure_s = (0.01, 0.2, 0.5)
    counts = np.arange(64, 192, dtype=np.uint16) * np.ones((3, 20, 96, 1), np.uint16)
    like = hsnoise.FrameStack(counts, exposure_s, cfa="RGGB", shutter="global")
    truth = hsnoise.cameras.grasshopper3(black_level_dn=64).add(FrameTilt(8.0, "row", after_gain))
    fit = hsnoise.fit(draw_capture(3, truth, like), pixels="differ")
    one = fit.params["frame_tilt"]
    value, error, _ = fit.table["frame_tilt.sigma"]
    assert one.axis == "row" and one.after_gain == after_gain and abs(value - 8.0) < 3 * error


def test_a_part_of_a_sensor_has_a_part_of_the_slope(rng):
    whole, _ = capture(rng, "row", 7.0, 0.0, exposure_s=(1.0,))
    part = hsnoise.FrameStack([whole.counts[0][:, 40:120]], [1.0], window=(40, 0, LINES, 200))
    sizes = [float(hsnoise.fit(stack, pixels="differ").params["frame_tilt"].sigma) for stack in (whole, part)]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.1)


def test_a_straightened_survey_has_only_the_rest(rng):
    tilt, plain = (survey(capture(np.random.default_rng(5), "row", slope, 0.5)[0]) for slope in (7.0, 0.0))
    found = tilted_in(tilt)
    left = straightened(tilt, found)
    assert tilted_in(plain) is None
    for one, other in zip(left.groups, plain.groups, strict=True):
        for name in ("row_x_frame", "frame"):
            rest, truth = one.planes[0].components[name], other.planes[0].components[name]
            assert abs(rest.variance_dn2 - truth.variance_dn2) < 3 * truth.standard_error_dn2
            assert rest.standard_error_dn2 < 1.5 * truth.standard_error_dn2 + 1e-3


@pytest.mark.parametrize("cfa", ["mono", "RGGB"])
def test_colours_tell_no_more_about_offsets_of_frames_than_one(cfa, rng):
    counts = []
    for t in (1.0, 30.0, 120.0):
        electrons = rng.poisson(0.5 * t, (8, 96, 128)) + 6 * rng.standard_normal((8, 96, 128))
        counts.append(np.rint(500 + 1.5 * (electrons + 2 * rng.standard_normal((8, 1, 1)))).astype(np.uint16))
    fit = hsnoise.fit(hsnoise.FrameStack(counts, (1.0, 30.0, 120.0), cfa=cfa), pixels="differ")
    value, error, _ = fit.table["frame_offset.sigma"]
    assert error / value == pytest.approx(1 / np.sqrt(2 * 3 * 7), rel=0.15)  # three exposures of eight frames
