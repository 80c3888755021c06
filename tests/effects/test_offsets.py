"""Laws of the offsets of rows, columns, frames, pixels and taps: size, distribution, which pixels share one."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy import stats

from hsnoise.effects import (
    BlackShading,
    ColumnFixedPattern,
    ColumnNoise,
    DarkSignalNonuniformity,
    FrameOffset,
    FrameSettling,
    FrameTilt,
    PeriodicBanding,
    RowBankNoise,
    RowFixedPattern,
    RowGroupNoise,
    RowNoise,
    TapGains,
    TapOffsets,
)
from hsnoise.model import NoiseModel, sample_dark

KEY = jax.random.key(29)
P_VALUE = 1e-5


def darks(effect, frames, shape, cfa="RGGB", exposure_s=0.05):
    model = NoiseModel([effect], cfa=cfa, shutter="rolling", exposure_s=0.05)
    return np.asarray(sample_dark(KEY, frames, shape, model, exposure_s=exposure_s))


# Which of [frame, row, column] an offset depends on; it is the same along the others, whatever the colour.
@pytest.mark.parametrize(
    ("effect", "depends", "shape"),
    [
        (RowNoise(2.0), (True, True, False), (100, 40, 4)),
        (ColumnNoise(2.0), (True, False, True), (100, 4, 40)),
        (RowFixedPattern(2.0), (False, True, False), (2, 4000, 4)),
        (ColumnFixedPattern(2.0), (False, False, True), (2, 4, 4000)),
        (FrameOffset(2.0), (True, False, False), (4000, 2, 2)),
        (DarkSignalNonuniformity(2.0), (False, True, True), (2, 60, 60)),
    ],
    ids=lambda x: getattr(x, "name", ""),
)
def test_offsets_are_normal_and_shared_by_the_right_pixels(effect, depends, shape):
    drawn = darks(effect, shape[0], shape[1:])
    own = drawn[tuple(slice(None) if varies else slice(1) for varies in depends)]
    np.testing.assert_array_equal(drawn, np.broadcast_to(own, shape))
    assert stats.kstest(own.ravel() / 2, "norm").pvalue > P_VALUE
    assert abs(own.var() / 4 - 1) < 5 * np.sqrt(2 / own.size)
    for axis in np.flatnonzero(depends):  # neighbours are independent
        left, right = np.take(own, range(own.shape[axis] - 1), axis), np.take(own, range(1, own.shape[axis]), axis)
        assert abs(np.mean(left * right)) / 4 < 5 / np.sqrt(left.size)
    np.testing.assert_array_equal(darks(effect, *[shape[0], shape[1:]], exposure_s=1.0), drawn)


@pytest.mark.parametrize(("effect", "axis"), [(RowNoise(2.0, 1.0), 1), (ColumnNoise(2.0, 1.0), 2)])
def test_coloured_offsets_have_the_spectrum(effect, axis):
    frames, n = 400, 64
    drawn = darks(effect, frames, (n, 2) if axis == 1 else (2, n))
    series = drawn[:, :, 0] if axis == 1 else drawn[:, 0]
    power = np.abs(np.fft.rfft(series) / n) ** 2
    k = np.minimum(np.arange(n), n - np.arange(n))
    expected = np.where(k > 0, 1 / np.maximum(k, 1), 0)
    expected = 4 * expected / expected.sum()
    np.testing.assert_allclose(power[:, 0], 0, atol=1e-20)
    relative = power[:, 1 : n // 2] / expected[1 : n // 2]
    assert stats.kstest(relative.ravel(), "expon").pvalue > P_VALUE
    squares = np.mean(series**2, axis=1)
    assert abs(squares.mean() - 4) < 5 * squares.std() / np.sqrt(frames)


@pytest.mark.parametrize("rows", [64, 65])
def test_banks_take_turns(rows):
    """Rows of one bank are 1/f, and the other bank knows nothing of them but what is shared."""
    frames = 3000

    def correlations(effect):
        drawn = darks(effect, frames, (rows, 2), cfa="mono")
        np.testing.assert_array_equal(drawn, np.broadcast_to(drawn[:, :, :1], drawn.shape))
        series = drawn[:, :, 0]
        squares = np.mean(series**2, axis=1)
        assert abs(squares.mean() - 4) < 5 * squares.std() / np.sqrt(frames)
        return np.array([np.mean(series[:, lag:] * series[:, : rows - lag]) for lag in range(1, 5)]) / 4

    own, both, common = (correlations(RowBankNoise(2.0, 1.0, shared)) for shared in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(own[::2], 0, atol=0.03)
    np.testing.assert_allclose(both, (own + common) / 2, atol=0.03)
    rho = correlations(RowNoise(2.0, 1.0))
    np.testing.assert_allclose(common, rho, atol=0.03)
    # A bank is a series of half the length: its neighbours are nearly as alike as those of all rows.
    assert 0.4 < own[1] < rho[0] and both[1] > both[0] + 0.1 and both[3] > both[2] + 0.05


@pytest.mark.parametrize(("row_banks", "column_banks"), [(1, 1), (2, 1), (1, 2), (2, 2)])
def test_rows_of_a_group_share_their_offset(row_banks, column_banks):
    """A group of six rows from row 4 on: a bank has one offset in it, other banks a share, the next group nothing."""
    frames, shared = 4000, 0.4
    effect = RowGroupNoise(2.0, shared, 6, 4, row_banks, column_banks)
    drawn = darks(effect, frames, (16, 4), cfa="mono")
    first, last = drawn[:, 4:6], drawn[:, 8:10]
    np.testing.assert_array_equal(first, last)
    np.testing.assert_array_equal(drawn[..., :2], drawn[..., 2:])
    error = 5 * 4 * np.sqrt(2 / frames)

    def product(row, column):
        return np.mean(drawn[:, 4, 0] * drawn[:, row, column])

    assert abs(product(4, 0) - 4) < error
    for row, column, banks in ((5, 0, row_banks), (4, 1, column_banks), (5, 1, row_banks * column_banks)):
        assert abs(product(row, column) - (4 if banks == 1 else 4 * shared)) < error
    assert abs(product(10, 0)) < error and abs(product(3, 1)) < error


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"rows": 1}, "rows: expected a whole number from 2 to 65536, got 1"),
        ({"rows": 4, "start": 4}, "start: expected a whole number from 0 to 3, got 4"),
        ({"column_banks": 3}, "column_banks: expected a whole number from 1 to 2, got 3"),
        ({"row_banks": 1.5}, "row_banks: expected a whole number from 1 to 2, got 1.5"),
    ],
)
def test_groups_that_no_sensor_has_are_refused(wrong, message):
    with pytest.raises(ValueError, match=f"row_group_noise.{message}"):
        RowGroupNoise(1.0, **wrong)


@pytest.mark.parametrize(("columns", "taps"), [(64, 4), (64, 2), (50, 3)])
def test_taps_are_blocks_of_columns(columns, taps):
    drawn = darks(TapOffsets(2.0, taps), 2, (4, columns))
    np.testing.assert_array_equal(drawn, np.broadcast_to(drawn[:1, :1], drawn.shape))
    widths = np.diff(np.concatenate([[0], np.flatnonzero(np.diff(drawn[0, 0])) + 1, [columns]]))
    assert len(widths) == taps and np.ptp(widths) <= 1


def test_tap_offsets_are_normal():
    drawn = darks(TapOffsets(2.0, taps=2000), 1, (2, 2000))[0, 0]
    assert stats.kstest(drawn / 2, "norm").pvalue > P_VALUE


@pytest.mark.parametrize("axis", ["row", "column"])
def test_banding_is_a_sinusoid_of_new_phase(axis):
    frames, n, frequency = 300, 40, 0.13
    drawn = darks(PeriodicBanding(3.0, frequency, axis), frames, (n, 6) if axis == "row" else (6, n))
    drawn = drawn if axis == "row" else drawn.swapaxes(1, 2)
    np.testing.assert_array_equal(drawn, np.broadcast_to(drawn[:, :, :1], drawn.shape))
    turns = 2 * np.pi * frequency * np.arange(n)
    basis = np.stack([np.sin(turns), np.cos(turns)], 1)
    solution, residual, *_ = np.linalg.lstsq(basis, drawn[:, :, 0].T, rcond=None)
    np.testing.assert_allclose(residual, 0, atol=1e-20)
    np.testing.assert_allclose(np.hypot(*solution), 3.0, rtol=1e-10)
    phase = np.arctan2(solution[1], solution[0]) / (2 * np.pi) % 1
    assert stats.kstest(phase, "uniform").pvalue > P_VALUE


@pytest.mark.parametrize("axis", ["row", "column"])
def test_tilt_is_a_line_of_new_slope(axis):
    frames, n = 2000, 10
    drawn = darks(FrameTilt(2.0, axis), frames, (n, 4) if axis == "row" else (4, n))
    drawn = drawn if axis == "row" else drawn.swapaxes(1, 2)
    np.testing.assert_array_equal(drawn, np.broadcast_to(drawn[:, :, :1], drawn.shape))
    slope = drawn[:, -1, 0] - drawn[:, 0, 0]
    np.testing.assert_allclose(drawn[:, :, 0], slope[:, None] * np.linspace(-0.5, 0.5, n), atol=1e-6)
    assert stats.kstest(slope / 2, "norm").pvalue > P_VALUE
    assert abs(slope.var() / 4 - 1) < 5 * np.sqrt(2 / frames)
    assert abs(np.mean(slope[1:] * slope[:-1])) / 4 < 5 / np.sqrt(frames)  # frames are independent
    variance = 4 * (n + 1) / (n - 1) / 12
    np.testing.assert_allclose(np.square(drawn).mean(), variance, rtol=5 * np.sqrt(2 / frames))


def test_a_single_line_is_not_tilted():
    np.testing.assert_array_equal(darks(FrameTilt(2.0), 3, (1, 4), cfa="mono"), 0)


@pytest.mark.parametrize(("amplitude", "frames"), [(3.0, 2.5), (-3.0, 0.4)])
def test_a_level_settles_alike_in_every_run(amplitude, frames):
    drawn = darks(FrameSettling(amplitude, frames), 8, (4, 6))
    expected = amplitude * np.exp(-np.arange(8) / frames)
    np.testing.assert_allclose(drawn, np.broadcast_to(expected[:, None, None], drawn.shape), rtol=1e-6)
    np.testing.assert_array_equal(darks(FrameSettling(amplitude, frames), 5, (4, 6), exposure_s=1.0), drawn[:5])


@pytest.mark.parametrize("length", [0.1, 0.6, 1e4])
@pytest.mark.parametrize(("axis", "start", "above"), [("column", "first", True), ("row", "last", False)])
def test_shading_decays_from_one_side(length, axis, start, above):
    drawn = darks(BlackShading(2.0, length, axis, start, above), 2, (40, 60))
    lines = drawn[0, 0] if axis == "column" else drawn[0, :, 0]
    lines = lines if start == "first" else lines[::-1]
    there = drawn[:1, :1] if axis == "column" else drawn[:1, :, :1]
    np.testing.assert_array_equal(drawn, np.broadcast_to(there, drawn.shape))
    # float32 keeps seven digits of a decay of 1e-4
    np.testing.assert_allclose([lines.mean(), lines.std()], [0, 2], atol=1e-3)
    steps = np.diff(lines)
    assert np.all(steps < 0 if above else steps > 0)
    ratio = np.exp(-1 / (length * (len(lines) - 1)))
    np.testing.assert_allclose(steps[1:] / steps[:-1], ratio, rtol=0.02)


def test_impossible_settings_are_refused():
    for wrong in ({"axis": "x"}, {"start": "left"}, {"above": 0.5}):
        with pytest.raises(ValueError, match=rf"black_shading.{next(iter(wrong))}: expected .* or .*, got"):
            BlackShading(1.0, 0.5, **wrong)
    with pytest.raises(ValueError, match=r"periodic_banding.axis: expected 'row' or 'column', got 'x'"):
        PeriodicBanding(1.0, 0.1, "x")
    with pytest.raises(ValueError, match=r"frame_tilt.axis: expected 'row' or 'column', got 'x'"):
        FrameTilt(1.0, "x")
    for taps in (0, 2.5, True, 10**12):
        with pytest.raises(ValueError, match=r"tap_offsets.taps: expected a whole number from 1 to 65536"):
            TapOffsets(1.0, taps)
    with pytest.raises(ValueError, match=r"tap_gains.taps: expected at least 2 outputs"):
        TapGains(0.1, 1)
