"""Waves that cross the frame and move from frame to frame: measured, drawn, and told from what resembles them."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
import hsnoise.effects as fx
from hsnoise.statistics.pixels.waves import middle_of_frame, spectrum_of, waves_of

SHAPE, FRAMES, READ_E, GAIN = (160, 200), 8, 4.0, 2.0
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]]


def waves(rng, frames, row, column, amplitude):
    phase = 2 * np.pi * rng.random((frames, 1, 1))
    return amplitude * np.sin(2 * np.pi * (row * ROWS + column * COLUMNS) + phase)


def capture(row, column, amplitude_e, seed=0, cfa="mono"):
    """Darks of pixels that all differ, of a simulator of NumPy alone."""
    rng = np.random.default_rng(seed)
    rate, counts, exposures_s = 30 * rng.lognormal(0, 0.4, SHAPE), [], (0.01, 1.0, 4.0)
    for t in exposures_s:
        electrons = rng.poisson(rate * t, (FRAMES, *SHAPE)) + READ_E * rng.standard_normal((FRAMES, *SHAPE))
        counts.append(np.rint(200 + GAIN * (electrons + waves(rng, FRAMES, row, column, amplitude_e))))
    return hsnoise.FrameStack([of.astype(np.uint16) for of in counts], exposures_s, cfa=cfa, shutter="global")


def found_in(*frames):
    return next(iter(waves_of([spectrum_of([middle_of_frame(frame) for frame in of], 1) for of in frames])), None)


@pytest.mark.parametrize(
    ("row", "column"), [(0.1234, 0.3456), (-0.333, 0.05), (0.25, 0.5), (0.5, 0.25), (0.5, 0.5), (-0.027, 0.49)]
)
def test_frequencies_and_variance_are_found(row, column):
    rng, frames = np.random.default_rng(1), 40
    found = found_in(100 + 3 * rng.standard_normal((frames, *SHAPE)) + waves(rng, frames, row, column, 0.5))
    off = (found.row_frequency - row + 0.5) % 1 - 0.5, found.column_frequency - column
    if column == 0.5:  # a wave and its mirror image are one
        off = min(abs(off[0]), abs((found.row_frequency + row + 0.5) % 1 - 0.5)), off[1]
    assert np.abs(off).max() < 0.05 / min(SHAPE)
    assert abs(found.variance_dn2 - 0.125) < 4 * found.error_dn2 and found.error_dn2 < 0.03


def noise(scale=3.0):
    return scale * np.random.default_rng(2).standard_normal((FRAMES, *SHAPE))


def of_lines(axis):
    """Rows or columns that share noise, and those of one parity that do."""
    shape = (FRAMES, SHAPE[0], 1) if axis == "row" else (FRAMES, 1, SHAPE[1])
    shared = np.random.default_rng(3).standard_normal(shape)
    odd = (COLUMNS if axis == "row" else ROWS) % 2
    return shared + shared[::-1] * odd


RARE = np.where(np.random.default_rng(4).random((FRAMES, *SHAPE)) < 1e-3, 1e4, 0.0)


@pytest.mark.parametrize(
    "frames",
    [
        noise(),
        noise() + of_lines("row"),
        noise() + of_lines("column"),
        noise() + np.cumsum(noise(0.3), 2),
        noise() + waves(np.random.default_rng(0), 1, 0.1, 0.2, 2.0),  # the same in all frames
        noise() + waves(np.random.default_rng(0), FRAMES, 0.1, 0.2, 0.05),
        noise() + waves(np.random.default_rng(0), FRAMES, 0.1, 0.0, 2.0),  # bands
        noise() + RARE,
    ],
    ids=["white", "rows", "columns", "drifting rows", "static", "weak", "bands", "hits"],
)
def test_what_is_no_wave(frames):
    assert found_in(frames) is None


def test_small_frames_and_single_ones_show_none():
    assert spectrum_of([np.zeros(SHAPE)], 1) is None and spectrum_of([np.zeros((32, 200))] * 4, 1) is None
    assert waves_of([]) == ()
    assert middle_of_frame(np.zeros((2001, 47))).shape == (512, 46)


@pytest.mark.parametrize(
    ("amplitude_e", "cfa"), [pytest.param(1.0, "mono", marks=pytest.mark.slow), (1.0, "RGGB"), (3.0, "mono")]
)
def test_a_fit_measures_it_and_its_frames_look_alike(amplitude_e, cfa):
    stack = capture(0.1234, 0.3456, amplitude_e, cfa=cfa)
    fit = hsnoise.fit(stack)
    # Noise that neighbours share is the wave's, and not named as well.
    assert set(fit.added) == {"interference", "dark_current_nonuniformity"}
    wave = fit.params["interference"]
    assert (float(wave.row_frequency), float(wave.column_frequency)) == pytest.approx((0.1234, 0.3456), abs=3e-4)
    for name, truth in (("interference.amplitude", amplitude_e), ("read_noise.sigma", READ_E)):
        value, error, _ = fit.table[name]
        assert abs(value - truth) < 4 * error and error < 0.15 * truth
    if amplitude_e == 1.0:
        assert hsnoise.compare(fit, stack, draws=16).error < 2


@pytest.mark.slow
def test_without_it_frames_do_not_look_alike_and_it_is_proposed():
    stack = capture(-0.07, 0.21, 1.5)
    fit = hsnoise.fit(stack)
    bare = hsnoise.fit(stack, model=fit.params.remove("interference"))
    assert hsnoise.compare(bare, stack, draws=16).error > 5
    best = hsnoise.diagnose(bare, stack).best
    assert best.name == "interference" and float(best.effect.amplitude) == pytest.approx(1.5, rel=0.2)


def test_colours_that_swing_together_are_no_wave():
    """In a Bayer sensor, a wave of alternating pixels is an offset of each colour."""
    assert "interference" not in hsnoise.fit(capture(0.5, 0.5, 1.0, cfa="RGGB")).added


def test_it_is_a_sinusoid_of_new_phase_along_rows_and_columns():
    model = hsnoise.NoiseModel([fx.Interference(3.0, -0.21, 0.37)], cfa="mono", shutter="global", exposure_s=1.0)
    drawn = np.asarray(hsnoise.sample_dark(0, 200, (30, 40), model), float)
    turns = 2 * np.pi * (-0.21 * np.arange(30)[:, None] + 0.37 * np.arange(40))
    basis = np.stack([np.sin(turns).ravel(), np.cos(turns).ravel()], 1)
    sizes = np.linalg.lstsq(basis, drawn.reshape(200, -1).T, rcond=None)[0]
    np.testing.assert_allclose((basis @ sizes).T.reshape(drawn.shape), drawn, atol=1e-4)
    np.testing.assert_allclose(np.hypot(*sizes), 3.0, rtol=1e-4)
    assert abs(np.exp(1j * np.arctan2(*sizes)).mean()) < 4 / np.sqrt(200)


def harmonics(number, of_row=0.137, of_column=0.271):
    """Frequencies of a clock's harmonics on a sensor whose rows are read one after the other."""
    return [((k * of_row + 0.5) % 1 - 0.5, k * of_column % 1) for k in range(1, number + 1)]


@pytest.mark.slow
def test_harmonics_of_a_clock_are_found_beside_the_first_and_drawn():
    rng, frames, sizes = np.random.default_rng(3), 12, (1.2, 0.8, 0.6, 0.5)
    places = [(row, c) if c <= 0.5 else (-row, 1 - c) for row, c in harmonics(4)]
    counts = 500 + 4 * rng.standard_normal((frames, *SHAPE))
    counts += sum(waves(rng, frames, *place, size) for place, size in zip(places, sizes, strict=True))
    counts += 0.5 * rng.standard_normal((1, *SHAPE)) + 0.5 * rng.standard_normal((1, 1, SHAPE[1]))
    stack = hsnoise.FrameStack([np.rint(counts).astype(np.uint16)], [0.0])
    fit = hsnoise.fit(stack)
    effect = fit.params["interference"]
    found = {(float(effect.row_frequency), float(effect.column_frequency)): float(effect.amplitude)}
    found |= {(row, column): size * float(effect.amplitude) for size, row, column in effect.others}
    assert len(found) == len(places)
    for (row, column), size in zip(places, sizes, strict=True):
        near = min(found, key=lambda of: abs(of[0] - row) + abs(of[1] - column))
        assert abs(near[0] - row) + abs(near[1] - column) < 0.002
        assert abs(found[near] - size) < 0.15
    value, error, _ = fit.shown["read_noise.sigma"]
    assert abs(value - 4) < 4 * error + 0.01
    drawn = np.asarray(hsnoise.sample_dark(1, 16, SHAPE, fit.params), float)
    again = waves_of([spectrum_of([middle_of_frame(frame) for frame in drawn], 1)])
    assert len(again) == len(places)
    assert hsnoise.compare(fit.params, stack, seed=2).error < 2


@pytest.mark.parametrize("row", [0.5, 0.2, -0.31])
def test_a_wave_of_half_a_cycle_per_column_is_one_wave(row):
    rng, frames = np.random.default_rng(5), 16
    moving = 100 + 3 * rng.standard_normal((frames, *SHAPE)) + waves(rng, frames, row, 0.5, 1.0)
    (found,) = waves_of([spectrum_of([middle_of_frame(frame) for frame in moving], 1)])
    assert abs(found.variance_dn2 - 0.5) < 4 * found.error_dn2 < 0.8


@pytest.mark.parametrize(
    "others",
    [
        ((1.0, 0.1),),
        ("abc",),
        ((1.0, 0.1, float("inf")),),
        3,
        ((-1.0, 0.1, 0.2),),
        ((1.0, 0.7, 0.2),),
        ((True, 0.1, 0.2),),
    ],
)
def test_wrong_further_waves_are_named(others):
    with pytest.raises(ValueError, match="interference.others: expected for each its amplitude"):
        fx.Interference(1.0, 0.1, 0.2, False, others)


def test_a_file_keeps_further_waves(tmp_path):
    effect = fx.Interference(1.0, 0.1, 0.2, False, ((0.5, 0.2, 0.4), (0.25, -0.3, 0.1)))
    sensor = (fx.ReadNoise(2.0), fx.Gain(1.0), fx.BlackLevel(100.0), fx.ADC())
    model = hsnoise.NoiseModel([*sensor, effect], cfa="mono", shutter="global", exposure_s=1.0)
    model.save(tmp_path / "model.json")
    assert hsnoise.NoiseModel.load(tmp_path / "model.json")["interference"].others == effect.others
