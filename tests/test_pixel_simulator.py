"""The benchmark's second simulator against closed formulas: moments, populations, the renewal process."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.pixel_simulator import (
    DETERMINED,
    PARETO_EXPONENT,
    UNDETERMINED,
    Sensor,
    draw,
    hot_rates,
    ordinary_rates,
    two_step_counts,
)

PLAIN = Sensor((2.0,), 5.0, (1.0,), dark_e_per_s=30.0, frames=32, shape=(128, 192))


def near(values, expected, sigmas=5):
    """Whether the mean of independent values is that expected, by its standard error."""
    values = np.asarray(values, float).ravel()
    assert abs(values.mean() - expected) < sigmas * values.std() / np.sqrt(values.size), (values.mean(), expected)


@pytest.mark.parametrize("fano", [0.5, 0.7, 0.95, 1.0])
@pytest.mark.parametrize("mean", [0.3, 5.0, 300.0])
def test_two_steps_in_turn_have_the_moments_of_an_equilibrium_renewal_process(rng, mean, fano):
    counts = two_step_counts(np.full(200_000, mean), fano, rng)
    w = (1 - fano) / 2
    variance = mean if fano == 1 else mean - 2 * w * mean + 2 * w**2 * (1 - np.exp(-mean / w))
    near(counts, mean)
    near((counts - mean) ** 2, variance)


def test_two_steps_in_turn_come_as_a_step_by_step_simulation_says(rng):
    """The probability of each number, against waits that are added up one by one."""
    mean, fano, n = 3.0, 0.6, 200_000
    first = (1 + np.sqrt(2 * fano - 1)) / 2
    waits = rng.exponential(first, (n, 30)) + rng.exponential(1 - first, (n, 30))
    begun = rng.random(n) >= first
    waits[begun, 0] = rng.exponential(1 - first, int(begun.sum()))
    expected = np.bincount((np.cumsum(waits, 1) <= mean).sum(1), minlength=12)[:12]
    got = np.bincount(two_step_counts(np.full(n, mean), fano, rng), minlength=12)[:12]
    both = expected + got
    assert (((expected - got) ** 2)[both > 20] / both[both > 20]).sum() < 35  # at most 12 degrees of freedom


def test_times_that_differ_are_each_drawn_at_their_own_mean(rng):
    mean = np.repeat([0.0, 2.0, 900.0], 50_000)
    counts = two_step_counts(mean, 0.7, rng).reshape(3, -1)
    assert not counts[0].any()
    near(counts[1], 2.0)
    near(counts[2], 900.0)


@pytest.mark.parametrize("population", ["lognormal", "gamma"])
def test_ordinary_pixels_have_the_spread_asked_for(rng, population):
    rates = ordinary_rates(replace(PLAIN, population=population, spread=0.4, shape=(400, 500)), rng)
    near(rates, 30.0)
    if population == "lognormal":
        assert np.log(rates).std() == pytest.approx(0.4, rel=0.01)
        assert np.median(rates) == pytest.approx(30 * np.exp(-0.08), rel=0.01)
    else:
        assert rates.std() == pytest.approx(12.0, rel=0.01)
        near((rates - 30.0) ** 3, 2 * 0.4 * 12.0**3)  # skewness of a gamma law: twice its relative spread


def test_a_bimodal_population_is_two_groups(rng):
    sensor = replace(PLAIN, population="bimodal", spread=0.05, second_share=0.2, second_ratio=4.0, shape=(400, 500))
    rates = ordinary_rates(sensor, rng)
    near(rates, 30.0)
    second = rates > 30 / 1.6 * 2
    near(second, 0.2)
    assert rates[second].mean() / rates[~second].mean() == pytest.approx(4.0, rel=0.01)


@pytest.mark.parametrize("law", ["exponential", "pareto"])
def test_hot_pixels_have_the_share_mean_and_tail_asked_for(rng, law):
    sensor = replace(PLAIN, hot_share=0.1, hot_e_per_s=50.0, hot_law=law, shape=(800, 1000))
    rates = hot_rates(sensor, rng)
    near(rates > 0, 0.1)
    near(rates[rates > 0], 50.0)
    least = 50 * (PARETO_EXPONENT - 1) / PARETO_EXPONENT
    beyond = (300 / least) ** -PARETO_EXPONENT if law == "pareto" else np.exp(-6)
    near(rates[rates > 0] > 300, beyond)


def test_pixels_over_time_have_the_variance_of_photon_transfer(rng):
    sensor = replace(PLAIN, spread=0.5, read_noise_spread=0.3, hot_share=0.05, hot_e_per_s=200.0, hot_fano=0.6)
    got = draw(sensor, rng)
    counts = got["counts"][0].astype(float)
    shot = got["ordinary_e_per_s"] + (0.6 * got["hot_e_per_s"] + 2 * 0.2**2 * (got["hot_e_per_s"] > 0))
    near(counts.mean(0) - 1000 - 2 * (got["ordinary_e_per_s"] + got["hot_e_per_s"]), 0.0)
    near(counts.var(0, ddof=1) - 4 * (shot + got["read_noise_e"] ** 2), 1 / 12)
    assert np.sqrt((got["read_noise_e"] ** 2).mean()) == pytest.approx(5.0, rel=0.02)


def test_offsets_of_pixels_columns_rows_and_frames_are_added_in_dn(rng):
    sensor = Sensor(
        (1.0,),
        0.0,
        (0.0,) * 40,
        offset_spread_dn=3.0,
        column_pattern_dn=5.0,
        row_pattern_dn=4.0,
        row_noise_dn=2.0,
        frame_jitter_dn=6.0,
        pedestal_jump_dn=8.0,
        frames=40,
        shape=(100, 160),
    )
    counts = np.stack(draw(sensor, rng)["counts"]).astype(float)
    fixed = counts.mean((0, 1))
    assert fixed.mean(0).std() == pytest.approx(5.0, rel=0.3)
    assert fixed.mean(1).std() == pytest.approx(4.0, rel=0.35)
    assert (fixed - fixed.mean(0) - fixed.mean(1)[:, None]).std() == pytest.approx(3.0, rel=0.05)
    frames = counts.mean((2, 3))
    assert frames.std(1, ddof=1).mean() == pytest.approx(6.0, rel=0.1)
    assert frames.mean(1).std(ddof=1) == pytest.approx(8.0, rel=0.5)
    rows = counts.mean(3) - frames[..., None]
    assert (rows - rows.mean((0, 1))).std() == pytest.approx(2.0, rel=0.05)


def test_counts_are_whole_numbers_clipped_at_0_and_at_white(rng):
    got = draw(replace(PLAIN, black_dn=4.0, white_dn=80, read_noise_e=8.0, frames=4), rng)["counts"][0]
    assert got.dtype == np.uint16 and got.min() == 0 and got.max() == 80
    assert 0.05 < (got == 80).mean() < 0.5


def test_each_colour_has_its_own_gain(rng):
    got = draw(replace(PLAIN, gain_dn_per_e=(1.7, 1.0, 1.35), read_noise_e=1.0), rng)
    excess = got["counts"][0].astype(float) - 1000
    for (row, column), gain in {(0, 0): 1.7, (0, 1): 1.0, (1, 0): 1.0, (1, 1): 1.35}.items():
        near(excess[:, row::2, column::2], 30 * gain)
    assert got["cfa"] == "RGGB"


def test_the_same_seed_gives_the_same_frames():
    first, again = (draw(PLAIN, np.random.default_rng(3))["counts"][0] for _ in range(2))
    np.testing.assert_array_equal(first, again)


def test_kinds_are_what_the_benchmark_says_of_them(rng):
    """Shot noise of ordinary pixels near the read noise's; 0.1 to 5 % of the bias pixels clip in one kind only."""
    for name, sensor in DETERMINED.items():
        assert 0.9 < sensor.dark_e_per_s * max(sensor.exposure_s) / sensor.read_noise_e**2 < 2, name
        shortest = replace(sensor, exposure_s=sensor.exposure_s[:1], frames=2, shape=(128, 192))
        clipped = (draw(shortest, rng)["counts"][0] == 0).mean()
        assert (0.001 < clipped < 0.05) if name == "clipped at 0" else clipped == 0, name
    assert {sensor.population for sensor in DETERMINED.values()} == {"lognormal", "gamma", "bimodal"}
    assert len(DETERMINED) == 8 and len(UNDETERMINED) == 5


@pytest.mark.parametrize(
    "bad", [{"population": "normal"}, {"hot_law": "normal"}, {"hot_fano": 0.4}, {"gain_dn_per_e": (1.0, 2.0)}]
)
def test_what_no_sensor_can_be_is_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        replace(PLAIN, **bad)
