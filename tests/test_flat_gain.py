"""The gain of flats: straight and bent responses drawn from their law, with coverage; sensors that follow no curve."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from hsnoise.likelihood.flat_gain import flat_gain, local_gain
from hsnoise.likelihood.flats import FlatMoments

GAIN, READ_DN2, BLACK_DN, FULL_E, PIXELS, SEEDS = 0.42, 5.0, 100.0, 9000.0, 60_000, 60
LIGHT_E = np.geomspace(60, FULL_E, 12)


def moments(rng, light_e, *, gain=GAIN, short=0.0, scatter=0.0, row_sigma=0.0):
    """FlatMoments [level, 1] of a response that falls `short` at FULL_E, levels off by a relative `scatter`."""
    signal = gain * light_e * (1 - short * light_e / FULL_E)
    slope = gain * (1 - 2 * short * light_e / FULL_E)
    variance = (slope**2 * light_e + READ_DN2) * (1 + row_sigma**2) * (1 + scatter * rng.standard_normal(len(light_e)))
    dof = np.full(len(light_e), float(PIXELS))
    rows, row_pixels = 200.0, 300.0
    power = (variance / row_pixels + (row_sigma * signal) ** 2) * rng.chisquare(rows, len(light_e)) / rows
    columns = (BLACK_DN + signal, variance * rng.chisquare(dof) / dof, dof, power, 0 * dof + rows, 0 * dof + row_pixels)
    unknown = np.full((len(light_e), 1), np.nan)
    return FlatMoments(
        light_e / 1000,
        *(x[:, None] for x in columns),
        photons_e=None,
        **dict.fromkeys(("dark_dn", "dark_variance_dn2", "dark_error_dn2"), unknown),
        overscan_dn=unknown[:, 0],
        curve=np.ones_like(unknown),
        weight=dof[:, None],
    )


def fitted(flats, row_sigma=0.0):
    return flat_gain(flats, [BLACK_DN], [READ_DN2 * (1 + row_sigma**2)])


def changed(flats, **fields):
    return dataclasses.replace(flats, **fields)


@pytest.mark.parametrize(
    ("options", "bent"),
    [({}, False), ({"short": 0.02}, True), ({"short": -0.02}, True), ({"row_sigma": 0.1}, False)],
    ids=["straight", "falls short", "expands", "row gain"],
)
def test_the_gain_at_low_signal_is_covered_by_its_error(rng, options, bent):
    found = [fitted(moments(rng, LIGHT_E, **options), options.get("row_sigma", 0.0)) for _ in range(SEEDS)]
    assert all(one.described[0] for one in found)
    assert np.mean([one.bend.any() == bent for one in found]) > 0.95
    gain, error = (np.array([getattr(one, name)[0] for one in found]) for name in ("gain", "standard_error"))
    pull = (gain - GAIN) / error
    assert abs(pull.mean()) < 4 / np.sqrt(SEEDS) and 0.75 < pull.std() < 1.3
    assert error.mean() < (0.01 if bent or options else 0.003) * GAIN


def test_the_local_gain_is_that_of_the_response(rng):
    found = fitted(moments(rng, LIGHT_E, short=0.02))
    signal = GAIN * LIGHT_E * (1 - 0.02 * LIGHT_E / FULL_E)
    np.testing.assert_allclose(local_gain(found, 0, signal), GAIN * (1 - 0.04 * LIGHT_E / FULL_E), rtol=0.01)


def test_scatter_beyond_chance_widens_the_error(rng):
    found = [fitted(moments(rng, LIGHT_E, scatter=0.02)) for _ in range(SEEDS)]
    pull = [(one.gain[0] - GAIN) / one.standard_error[0] for one in found]
    assert 0.5 < np.std(pull) < 1.3


def test_levels_on_no_curve_give_the_line_of_the_standard(rng):
    light = np.geomspace(60, FULL_E, 12)
    steps = np.where(light < 1500, 0.95, 1.0)  # two gain stages
    flats = moments(rng, light)
    signal = flats.mean_dn - BLACK_DN
    flats = changed(flats, variance_dn2=flats.variance_dn2 * steps[:, None])
    found = fitted(flats)
    assert not found.described[0] and not found.bend.any()
    assert signal[found.used].max() <= 0.7 * signal.max()
    assert found.gain[0] == pytest.approx(GAIN, rel=0.01) and found.standard_error[0] > 0.01 * GAIN


def test_saturated_levels_are_left_out(rng):
    flats = moments(rng, LIGHT_E)
    variance = flats.variance_dn2.copy()
    variance[-2:] *= [[0.5], [0.001]]
    found = fitted(changed(flats, variance_dn2=variance))
    np.testing.assert_array_equal(found.used[:, 0], [True] * 10 + [False] * 2)
    assert found.gain[0] == pytest.approx(GAIN, rel=0.01)


def test_the_weights_give_the_gain_and_its_error(rng):
    for scatter in (0.0, 0.05):
        flats = moments(rng, LIGHT_E, scatter=scatter)
        found = fitted(flats)
        relative = found.gain * found.signal_dn / flats.variance_dn2  # the row gain is 0
        information = (found.weight / 2 * relative**2).sum()
        assert information**-0.5 == pytest.approx(found.standard_error[0] / found.gain[0], rel=0.05)


def test_flats_without_light_give_no_gain(rng):
    found = flat_gain(moments(rng, LIGHT_E), [BLACK_DN], [1e6])
    assert np.isnan(found.gain[0]) and np.isinf(found.standard_error[0]) and not found.used.any()
