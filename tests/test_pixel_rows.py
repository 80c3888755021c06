"""Rows that share noise in a frame: one series or two banks of converters, from the pixels over time."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise._core.coloured import EXPONENTS, banks_of, fading_power, power_of_banks
from hsnoise.effects import (
    ADC,
    BlackLevel,
    DarkSignalNonuniformity,
    Gain,
    ReadNoise,
    RowBankNoise,
    RowNoise,
    ShotNoise,
)

ROWS, SENSOR = 192, 5


def darks(*effects) -> hsnoise.FrameStack:
    """Darks of a sensor whose pixels differ, too short for dark current."""
    sensor = (ShotNoise(), ReadNoise(5.0), DarkSignalNonuniformity(4.0), Gain(1.5), BlackLevel(200.0), ADC(4095))
    model = hsnoise.NoiseModel((*sensor, *effects), cfa="mono", shutter="rolling", exposure_s=1e-4)
    counts = hsnoise.sample_dark(jax.random.key(3), 12, (ROWS, 128), model, exposure_s=1e-4, sensor_key=SENSOR)
    return hsnoise.FrameStack(np.asarray(counts), 1e-4)


@pytest.mark.parametrize(("exponent", "shared"), [(0.7, 0.0), (1.2, 0.6), (1.5, 0.3)])
def test_banks_of_correlations_are_those_of_the_spectrum(exponent, shared):
    power = (1 - shared) * np.array(power_of_banks(ROWS, np.float64(exponent)))
    power += shared * np.array(fading_power(ROWS, np.float64(exponent)))
    power[0] = 0
    of = [float(power @ np.cos(2 * np.pi * lag * np.arange(ROWS) / ROWS) / power.sum()) for lag in (1, 2)]
    assert banks_of(*of, ROWS) == pytest.approx((exponent, shared), abs=0.01)


def test_what_no_banks_reach_is_at_a_bound():
    exponent, shared = banks_of(-0.2, -0.9, ROWS)
    assert exponent == 0.0 and shared < 0
    assert banks_of(0.999, 1.0, ROWS)[0] == EXPONENTS[1]


def test_two_banks_are_measured():
    fit = hsnoise.fit(darks(RowBankNoise(3.0, 1.2, 0.4)), pixels="differ")
    assert "row_bank_noise" in fit.added and "row_noise" not in fit.added
    for name, truth in (("exponent", 1.2), ("shared", 0.4)):
        value, error, _ = fit.table[f"row_bank_noise.{name}"]
        assert abs(value - truth) < 4 * error < 0.6
    asked = fit.params.remove("row_bank_noise").add(RowNoise(1.0))
    again = hsnoise.fit(darks(RowBankNoise(3.0, 1.2, 0.4)), model=asked)
    assert float(again.params["row_noise"].sigma) > 0 and "row_bank_noise" not in again.params


def test_one_series_over_all_rows_is_row_noise():
    fit = hsnoise.fit(darks(RowNoise(3.0, 1.0)), pixels="differ")
    assert "row_noise" in fit.added and "row_bank_noise" not in fit.added
