"""Rows that are read together, found in row means and measured by fits."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise.effects import (
    ADC,
    BlackLevel,
    DarkSignalNonuniformity,
    Gain,
    PeriodicBanding,
    ReadNoise,
    RowBankNoise,
    RowGroupNoise,
    RowNoise,
    ShotNoise,
)
from hsnoise.statistics.pixels.row_groups import row_groups_of

SHAPE, FRAMES = (192, 128), 10


def means(rng, rows=8, start=4, row_banks=2, column_banks=2, shared=0.2, sigma=1.0, noise=0.3, n=SHAPE[0]):
    """Means [frame, row, 2] of even and odd columns, drawn in NumPy."""
    groups = n // rows + 2
    own = rng.standard_normal((FRAMES, groups, row_banks, column_banks))
    banks = sigma * (np.sqrt(1 - shared) * own + np.sqrt(shared) * rng.standard_normal((FRAMES, groups, 1, 1)))
    row = np.arange(n)
    drawn = banks[:, (row + rows - start) // rows, row % row_banks][..., np.arange(2) % column_banks]
    return drawn + noise * rng.standard_normal(drawn.shape)


@pytest.mark.parametrize(
    ("rows", "start", "row_banks", "column_banks"),
    [(8, 4, 2, 2), (8, 3, 2, 1), (4, 0, 1, 2), (2, 1, 1, 1), (6, 5, 2, 2), (16, 9, 1, 1)],
)
def test_the_layout_is_found(rng, rows, start, row_banks, column_banks):
    found = row_groups_of(means(rng, rows, start, row_banks, column_banks))
    assert found.layout == (rows, start, row_banks, column_banks)
    assert abs(found.variance_dn2[0] - 1) < 4 * found.variance_dn2[1] < 1.2
    if max(row_banks, column_banks) > 1:
        assert abs(found.shared[0] - 0.2) < 4 * found.shared[1] < 0.8


def test_the_first_row_of_a_window_is_counted(rng):
    assert row_groups_of(means(rng)[:, 3:], first_row=3).layout == (8, 4, 2, 2)


def test_rows_without_groups_have_none(rng):
    """White rows, slow ones, ones that alternate, a sinusoid, and single rows that are noisy."""
    n = 200
    white = rng.standard_normal((FRAMES, n, 2)) + rng.standard_normal((FRAMES, n, 1))
    slow = np.cumsum(white, 1)
    wave = np.sin(2 * np.pi * 0.125 * np.arange(n)[:, None] + rng.uniform(0, 6, (FRAMES, 1, 1)))
    loud = white * np.where(np.arange(n) % 16 == 3, 5.0, 1.0)[:, None]
    for one in (white, slow, white + slow[:, ::2].repeat(2, 1) * (-1.0) ** np.arange(n)[:, None], wave + white, loud):
        assert row_groups_of(one) is None


def darks(*effects, cfa="mono") -> hsnoise.FrameStack:
    """Darks of a sensor whose pixels differ, too short for dark current."""
    sensor = (ShotNoise(), ReadNoise(5.0), DarkSignalNonuniformity(4.0), Gain(1.5), BlackLevel(200.0), ADC(4095))
    model = hsnoise.NoiseModel((*sensor, *effects), cfa=cfa, shutter="rolling", exposure_s=1e-4)
    counts = hsnoise.sample_dark(jax.random.key(3), FRAMES, SHAPE, model, exposure_s=1e-4, sensor_key=5)
    return hsnoise.FrameStack(np.asarray(counts), 1e-4, cfa=cfa)


@pytest.mark.parametrize("cfa", ["mono", pytest.param("RGGB", marks=pytest.mark.slow)])
def test_groups_are_measured(cfa):
    fit = hsnoise.fit(darks(RowGroupNoise(4.0, 0.3, 8, 4, 2, 2), cfa=cfa), pixels="differ")
    assert "row_group_noise" in fit.added and not {"row_noise", "row_bank_noise"} & set(fit.added)
    assert fit.params["row_group_noise"].settings() == RowGroupNoise(4.0, 0.3, 8, 4, 2, 2).settings()
    table = fit.in_dn("row_group_noise")
    for name, truth in (("row_group_noise.sigma", 4.0 * 1.5), ("row_group_noise.shared", 0.3)):
        value, error, _ = table[name]
        assert abs(value - truth) < 4 * error < 1.2
    value, error, _ = fit.in_dn("read_noise")["read_noise.sigma"]
    assert abs(value - 5.0 * 1.5) < 4 * error < 0.6


def test_a_sinusoid_is_told_from_the_groups():
    fit = hsnoise.fit(darks(RowGroupNoise(3.0, 0.0, 8, 4, 2, 2), PeriodicBanding(3.0, 0.0521)), pixels="differ")
    assert {"row_group_noise", "periodic_banding"} <= set(fit.added)
    value, error, _ = fit.in_dn("row_group_noise")["row_group_noise.sigma"]
    assert abs(value - 3.0 * 1.5) < 4 * error < 1.0


@pytest.mark.parametrize(
    "effect",
    [pytest.param(RowNoise(3.0, 1.0), marks=pytest.mark.slow), RowBankNoise(3.0, 1.2, 0.4)],
    ids=lambda effect: effect.name,
)
def test_other_noise_of_rows_has_no_groups(effect):
    assert "row_group_noise" not in hsnoise.fit(darks(effect), pixels="differ").added


@pytest.mark.slow
def test_groups_are_named_where_pixels_are_alike(key):
    alike = hsnoise.cameras.grasshopper3(black_level_dn=64)
    hidden = alike.add(RowGroupNoise(1.5, 0.1, 8, 4, 2, 2))
    counts = [
        np.asarray(hsnoise.sample_dark(jax.random.fold_in(key, i), 6, (96, 128), hidden, exposure_s=t))
        for i, t in enumerate((0.02, 0.1))
    ]
    stack = hsnoise.FrameStack(counts, (0.02, 0.1), black_level=64, white_level=65535, cfa="RGGB", shutter="global")
    assert hsnoise.diagnose(alike, stack).names == ("row_group_noise",)


@pytest.mark.data
def test_the_imx541_reads_eight_rows_at_a_time(shared_data):
    with np.load(shared_data / "data" / "imx541_mono_emva.npz") as data:
        stack = hsnoise.FrameStack(data["dark_000081us"], 81e-6)
    fit = hsnoise.fit(stack, pixels="differ")
    assert fit.params["row_group_noise"].settings()["rows"] == 8
    assert fit.in_dn("row_group_noise")["row_group_noise.sigma"][0] == pytest.approx(0.13, abs=0.02)


def test_waves_and_odd_groups_of_two_banks(rng):
    """A wave of any period goes on from group to group; three rows of two banks are not six."""
    row = np.arange(192)[:, None]
    for period in (3, 4, 5.5, 8, 16, 192 / 23):
        phase = rng.uniform(0, 2 * np.pi, (FRAMES, 1, 1))
        for wave in (np.sin(2 * np.pi * row / period + phase), np.sign(np.sin(2 * np.pi * row / period + phase))):
            assert row_groups_of(wave + 0.1 * rng.standard_normal((FRAMES, 192, 2))) is None
    assert row_groups_of(means(rng, 3, 1, 2, 1, shared=0.0)).layout == (3, 1, 2, 1)
    assert row_groups_of(means(rng, 5, 1, 2, 1, shared=0.0)).layout == (5, 1, 2, 1)


@pytest.mark.slow
def test_groups_leave_no_offset_of_frames():
    """So few groups do not cancel in the mean of a frame; that is no offset of its own."""
    fit = hsnoise.fit(darks(RowGroupNoise(5.0, 0.0, 16, 4)), pixels="differ")
    assert "row_group_noise" in fit.added and "frame_offset" not in fit.added
