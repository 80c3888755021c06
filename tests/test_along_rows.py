"""Temporal noise that neighbours in a row share: of the read noise, or of the signal."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.criticism.candidates import built_in, facts_of
from hsnoise.fitting.problem import Problem
from hsnoise.simulation.draws import draw_capture
from hsnoise.simulation.portion import Portion
from hsnoise.statistics.pixels.along_rows import (
    Along,
    Ringing,
    along_rows,
    limits_of_the_signal,
    of_read_noise,
    of_the_signal,
)

READ_DN2 = (12.0 * 0.5) ** 2


def drawn(effect, exposure_s, *, seed=5, frames=8, shape=(200, 256), more=()):
    """A capture of a CCD whose dark current is as noisy as its readout after a minute."""
    camera = [fx.ShotNoise(), fx.DarkCurrent(2.4), fx.ReadNoise(12.0), fx.Gain(0.5), fx.BlackLevel(900.0), fx.ADC(None)]
    model = hsnoise.NoiseModel([*camera, effect, *more], cfa="mono", shutter="rolling", exposure_s=60.0)
    empty = [np.arange(frames * np.prod(shape), dtype=np.uint16).reshape(frames, *shape) for _ in exposure_s]
    return draw_capture(seed, model, hsnoise.FrameStack(empty, exposure_s))


def groups(stack):
    return [along_rows(np.stack(list(stack.frames(i))), 1) for i in range(stack.n_exposures)]


@pytest.mark.parametrize(("frequency", "memory"), [(0.5, 0.3), (0.0, 0.7), (0.21, 0.8)])
def test_a_part_of_the_read_noise_is_found_with_its_size(frequency, memory):
    stack = drawn(fx.CorrelatedReadNoise(0.25, frequency, memory), (0.0, 60.0))
    found = of_read_noise(groups(stack), READ_DN2)
    assert found is not None
    for (value, error), true in zip(found, (0.25, frequency, memory), strict=True):
        assert abs(value - true) <= 4 * error + 0.005  # half a step of the grid


@pytest.mark.parametrize("effect", [fx.ReadoutBandwidth(0.06), fx.ReadoutOvershoot(0.06), fx.RowNoise(1.0)])
def test_what_acts_on_the_signal_or_on_rows_is_not_read_noise(effect):
    for exposure_s in ((0.0, 60.0), (0.0,)):
        assert of_read_noise(groups(drawn(effect, exposure_s)), READ_DN2) is None


@pytest.mark.parametrize(
    "effect",
    [
        fx.ReadoutBandwidth(0.06),
        *(pytest.param(one, marks=pytest.mark.slow) for one in (fx.ReadoutOvershoot(0.06), fx.FrameOffset(0.0))),
    ],
)
def test_a_coupled_signal_is_doubted_with_the_error_of_its_gain(effect):
    stack = drawn(effect, (0.0, 20.0, 60.0), more=(fx.HotPixels(0.02, 20.0), fx.DarkCurrentNonuniformity(0.3)))
    own = getattr(effect, "fraction", 0.0) * (-1 if effect.name == "readout_overshoot" else 1)
    shared = own * (1 - own) / ((1 - own) ** 2 + own**2)
    assert abs(of_the_signal(groups(stack))[0] - shared) < 0.03
    result = hsnoise.fit(stack)
    told = [doubt for doubt in result.doubts if "of their shot noise" in doubt]
    assert bool(told) == (own != 0) and result.grave >= bool(told)
    if told:
        stated = float(told[0].rpartition("by about ")[2].partition("%")[0]) / 100
        assert ("too large" in told[0]) == (own < 0) and abs(stated - 2 * abs(shared)) < 0.05


def test_a_signal_that_spreads_to_all_sides_is_shared_with_the_pixel_above_too():
    """Of capacitive coupling half was stated: a gain 11 % too small was "too small by up to 6 %", at half of this."""
    leak = 0.03
    stack = drawn(fx.Crosstalk(leak), (0.0, 20.0, 60.0), more=(fx.DarkCurrentNonuniformity(0.3),))
    shared = 2 * leak * (1 - 4 * leak) / ((1 - 4 * leak) ** 2 + 4 * leak**2)
    assert np.abs(np.array(of_the_signal(groups(stack))) - shared).max() < 0.025  # five errors
    (told,) = [doubt for doubt in hsnoise.fit(stack).doubts if "of their shot noise" in doubt]
    stated = float(told.rpartition("by about ")[2].partition("%")[0]) / 100
    assert "those above each other" in told and "too small" in told and abs(stated - 4 * shared) < 0.05


@pytest.mark.parametrize(
    ("frequency", "memory"),
    [(0.0, 0.5), *(pytest.param(*one, marks=pytest.mark.slow) for one in ((0.0, 0.8), (0.5, 0.4)))],
)
def test_it_does_not_pass_for_row_noise_or_for_smoothing(frequency, memory):
    hot = fx.HotPixels(0.02, 20.0), fx.DarkCurrentNonuniformity(0.3)
    result = hsnoise.fit(drawn(fx.CorrelatedReadNoise(0.3, frequency, memory), (0.0, 20.0, 60.0), more=hot))
    assert "correlated_read_noise" in result.added and "row_noise" not in result.added
    assert not any("smoothed" in doubt for doubt in result.doubts)


def test_tracks_of_particles_are_no_correlated_read_noise():
    counts = np.stack(list(drawn(fx.FrameOffset(0.0), (0.0,)).frames(0)))
    rng = np.random.default_rng(8)
    for frame in counts:
        for _ in range(15):
            r, c = rng.integers(0, 180), rng.integers(0, 240)
            track = np.arange(12)
            frame[r + track // 2, c + track] += rng.exponential(60.0, 12).astype(np.uint16)
    assert of_read_noise([along_rows(counts, 1)], READ_DN2) is None


def test_correlations_that_are_no_ringing_are_left_alone():
    ccd = Along(281.1, np.array([-48.8, 37.6, 18.6, 6.6]), 0.6)  # bias frames of a SITe 2k
    assert of_read_noise([ccd], 281.0) is None
    assert of_read_noise([ccd._replace(covariance_dn2=np.array([-48.8, 17.6, -6.6, 2.6]))], 281.0) is not None


def test_bias_frames_alone_show_it_where_it_reaches_two_pixels_far():
    far, near = (
        drawn(fx.CorrelatedReadNoise(share, 0.5, memory), (0.0,)) for share, memory in ((0.2, 0.6), (0.9, 0.1))
    )
    assert of_read_noise(groups(far), READ_DN2) is not None
    assert of_read_noise(groups(near), READ_DN2) is None


def test_columns_of_two_amplifiers_are_no_neighbours():
    rng = np.random.default_rng(3)
    noise = rng.normal(0, 3, (8, 200, 256)) + np.repeat(rng.normal(0, 1, (8, 200, 2)), 128, axis=2)
    noise += np.tile(rng.normal(0, 1, (8, 200, 2)), 128)  # even and odd columns of a row wander apart
    assert of_read_noise([along_rows(np.rint(noise + 900).astype(np.uint16), 1)], 9.0) is None


@pytest.mark.parametrize("counts", [np.zeros((1, 40, 80)), np.zeros((4, 40, 30)), np.zeros((4, 40, 80))])
def test_frames_that_cannot_show_it_give_nothing(counts):
    assert along_rows(counts.astype(np.uint16), 1) is None


def test_flats_beside_single_darks_do_not_show_it():
    """Without repeated darks nobody knows how large the read noise is, of which it is a share."""
    camera = [fx.ShotNoise(), fx.ReadNoise(30.0), fx.Gain(0.5), fx.BlackLevel(900.0), fx.ADC(None)]
    model = hsnoise.NoiseModel(
        [*camera, fx.CorrelatedReadNoise(0.5, 0.5, 0.6)], cfa="mono", shutter="rolling", exposure_s=1.0
    )
    light = (0.0, 30.0, 400.0, 2000.0)
    counts = [
        np.asarray(hsnoise.sample(i, np.full((1 if i == 0 else 6, 120, 256), x), model, sensor_key=1))
        for i, x in enumerate(light)
    ]
    kinds = ["dark", *["flat"] * 3]
    result = hsnoise.fit(hsnoise.FrameStack(counts, [1.0] * 4, kind=kinds), method="transfer")
    assert result.transfer is not None and result.transfer.ringing is None


def test_a_fit_adds_it_and_keeps_gain_and_read_noise():
    hot = fx.HotPixels(0.02, 20.0), fx.DarkCurrentNonuniformity(0.3)
    stack = drawn(fx.CorrelatedReadNoise(0.3, 0.5, 0.4), (0.0, 20.0, 60.0), more=hot)
    result = hsnoise.fit(stack)
    assert "correlated_read_noise" in result.added
    (told,) = (note for note in result.notes if "neighbours along a row is correlated by -" in note)
    assert abs(float(told.partition("correlated by ")[2].partition(" %")[0]) + 100 * 0.3 * 0.4) < 2
    truth = {"gain": 0.5, "read_noise.sigma": 12.0, "correlated_read_noise.share": 0.3}
    for name, true in truth.items():
        value, error, _ = result.table[name]
        assert abs(value - true) < 4 * error + 0.005, (name, value, error)


@pytest.mark.parametrize(
    ("extra", "held"),
    [
        (fx.RowNoise(2.0), True),
        pytest.param(fx.CosmicRays(2.0, 500.0), True, marks=pytest.mark.slow),
        (fx.Crosstalk(0.02), False),
    ],
)
def test_a_refit_holds_a_gain_of_pixels_over_time_unless_the_signal_is_changed(extra, held):
    stack = drawn(fx.HotPixels(0.02, 20.0), (0.0, 20.0, 60.0), more=(fx.DarkCurrentNonuniformity(0.3),))
    base = hsnoise.fit(stack)
    model = base.params.add(extra)
    problem = Problem(Portion.of(stack), base, model, (extra.name,), model)
    far = problem.at(problem.start + 100.0)
    value, error, _ = base.table["gain"]
    assert problem.holds_gain == held
    assert (abs(float(far["gain"].value[0]) - value) < 0.01 * error) == held


def test_a_refit_without_a_gain_leaves_it_at_one_and_knows_noise_in_dn():
    """Without one only products with it are known; a gain that moved would take all electrons along."""
    stack = drawn(fx.ColumnFixedPattern(3.0), (0.0,), more=(fx.FrameOffset(2.0),))
    base = hsnoise.fit(stack)
    assert not base.has_gain and base.params["gain"].value[0] == 1
    model = base.params.add(fx.HeavyTailedReadNoise(8.0))
    problem = Problem(Portion.of(stack), base, model, ("heavy_tailed_read_noise",), model)
    assert float(problem.at(problem.start + 100.0)["gain"].value[0]) == pytest.approx(1, abs=0.01)
    of_read = base.names.index("read_noise.sigma")
    _, error, unit = base.shown["read_noise.sigma"]
    assert unit == "DN" and np.sqrt(problem.of_base[of_read, of_read]) == pytest.approx(error, rel=1e-3)


@pytest.mark.parametrize(("off", "told"), [(1.0, True), (3.0, False)])
def test_exposures_that_scatter_by_chance_hide_no_coupled_signal(off, told):
    """Of 3 % crosstalk in small frames, 7 of 20 captures were not told; bands scatter more than chance allows."""
    variance, error, apart = np.array([10.0, 12.0, 16.0, 26.0]), 0.12, np.array([1.0, -1.0, -1.0, 1.0])
    shared = 0.06 * (variance - 10.0) + off * error * apart
    some = [Along(v, np.array([s, 0.0, 0.0, 0.0]), error, 0.0) for v, s in zip(variance, shared, strict=True)]
    along, down = of_the_signal(some)
    assert (along > 0.05) is told and down == 0.0


def test_shot_noise_has_limits_of_what_neighbours_share():
    def of(share, read=0.0):
        variance = np.array([10.0, 12.0, 16.0, 26.0])
        return [Along(v, np.array([read + share * v, 0.0, 0.0, 0.0]), 0.02 * v**0.5, 0.0) for v in variance]

    low, high = limits_of_the_signal(of(0.03), None).along
    assert low < 0.03 < high and high - low < 0.06
    assert limits_of_the_signal(of(0.03)[:1], None) == ((-np.inf, np.inf), (-np.inf, np.inf))
    ringing = Ringing((0.1, 0.01), (0.3, 0.01), (0.8, 0.02))
    assert limits_of_the_signal(of(0.001, read=0.4), ringing).along == (0.0, 0.0)
    assert limits_of_the_signal(of(0.05), ringing).along == limits_of_the_signal(of(0.05), None).along
    assert limits_of_the_signal(of(0.001, read=0.4), ringing).down[0] < 0


def test_ringing_read_noise_does_not_pass_for_a_coupled_signal_in_diagnoses():
    """The SBIG ST-8 rings in several tones: what one of them left was taken for coupling, with 2 % of gain."""
    more = fx.HotPixels(0.02, 20.0), fx.DarkCurrentNonuniformity(0.3)
    for effect, may in ((fx.CorrelatedReadNoise(0.3, 0.21, 0.8), False), (fx.ReadoutBandwidth(0.06), True)):
        stack = drawn(effect, (0.0, 20.0, 60.0), more=more)
        fit = hsnoise.fit(stack)
        assert ("correlated_read_noise" in fit.params) is not may
        facts = facts_of(fit.params, Portion.of(stack), 0, fit.transfer)
        assert facts.pixels_followed and ("readout_bandwidth" in built_in(facts)) is may
