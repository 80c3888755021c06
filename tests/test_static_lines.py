"""Fixed levels of columns: a pattern of each by itself, a drift of the black level, curves and defects."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise._core.conclusion import Light

SHAPE, EXPOSURES_S, GAIN, READ_E = (96, 160), (0.1, 1.0, 4.0, 10.0), 0.5, 4.0
COLUMN = np.arange(SHAPE[1]) / SHAPE[1]
CURVES_DN = {
    "none": 0 * COLUMN,
    "edge": 6 * np.exp(-COLUMN / 0.012),
    "drift": 6 * np.exp(-COLUMN / 0.075),
    "line": 6 * COLUMN,
    "parabola": 24 * (COLUMN - 0.5) ** 2,
    "two drifts": 6 * (np.exp(-COLUMN / 0.02) + 0.5 * np.exp(-COLUMN / 0.25)),
}


def darks(curve: str, pattern_e: float, defects: int = 0, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rate = rng.lognormal(np.log(3), 0.6, SHAPE)
    offset = CURVES_DN[curve] + GAIN * pattern_e * rng.standard_normal(SHAPE[1])
    offset[rng.choice(SHAPE[1], defects, replace=False)] += 40.0
    frames = [
        rng.poisson(rate * t, (4, *SHAPE)) + READ_E * rng.standard_normal((4, *SHAPE)) + offset / GAIN
        for t in EXPOSURES_S
    ]
    return np.rint(200 + GAIN * np.stack(frames)).astype(np.uint16)


def fitted(*what) -> hsnoise.FitResult:
    return hsnoise.fit(darks(*what), exposure_s=EXPOSURES_S)


def told(sentences: tuple[str, ...], what: str) -> bool:
    return any(what in sentence for sentence in sentences)


@pytest.mark.parametrize(
    ("curve", "pattern_e"),
    [
        ("drift", 0.4),
        pytest.param("none", 0.4, marks=pytest.mark.slow),
        *(pytest.param(curve, size, marks=pytest.mark.slow) for curve in ("edge", "line") for size in (0.0, 0.4)),
        pytest.param("drift", 0.0, marks=pytest.mark.slow),
    ],
)
def test_columns_are_measured_beside_a_drift(curve, pattern_e):
    found = fitted(curve, pattern_e)
    sigma, error, _ = found.table.get("column_fixed_pattern.sigma", (0.0, 0.1, "e-"))
    assert abs(sigma - pattern_e) < 4 * error and error < 0.15
    assert ("black_shading" in found.added) == (curve != "none")
    assert found.conclusion.light == Light.GREEN and not told(found.doubts, "curve")


def coloured(exponent: float, seed: int) -> np.ndarray:
    """A series over the columns of variance 1 and power k^-exponent."""
    n = SHAPE[1]
    power = np.append(0.0, np.arange(1, n // 2 + 1.0) ** -exponent)
    turns = np.random.default_rng(seed).standard_normal((2, len(power)))
    series = np.fft.irfft((turns[0] + 1j * turns[1]) * np.sqrt(power), n)
    return series / series.std()


@pytest.mark.parametrize("exponent", [0.0, 1.0])
def test_columns_that_resemble_their_neighbours_have_a_spectrum(exponent):
    """In bias frames of six sensors, but for those whose slow series looks like a drift."""
    sizes, exponents = [], []
    for seed in range(6):
        noise = np.random.default_rng(seed).standard_normal((8, *SHAPE))
        frames = 200 + 2 * noise + 0.75 * coloured(exponent, 100 + seed)
        found = hsnoise.fit(np.rint(frames).astype(np.uint16), exposure_s=[0.0])
        if "black_shading" not in found.added:
            pattern = found.params["column_fixed_pattern"]
            sizes.append(float(pattern.sigma))
            exponents.append(float(pattern.exponent))
    assert len(sizes) >= 3
    np.testing.assert_allclose(sizes, 0.75, rtol=0.1)
    assert abs(np.mean(exponents) - exponent) < 0.3


@pytest.mark.parametrize("curve", ["none", pytest.param("drift", marks=pytest.mark.slow)])
def test_stuck_pixels_are_no_pattern_and_hide_no_drift(curve):
    counts = darks(curve, 0.0)
    stuck = np.random.default_rng(3).choice(COLUMN.size * SHAPE[0], 16, replace=False)
    stuck[0] = 0  # in the first column, as a steep drift would be
    counts.reshape(*counts.shape[:2], -1)[..., stuck] = 4095
    found = hsnoise.fit(counts, exposure_s=EXPOSURES_S)
    assert {"row_fixed_pattern", "column_fixed_pattern"}.isdisjoint(found.added)
    assert ("black_shading" in found.added) == (curve != "none")


@pytest.mark.parametrize("curve", ["two drifts", pytest.param("parabola", marks=pytest.mark.slow)])
def test_a_curve_that_no_drift_describes_is_a_doubt(curve):
    """It is drawn as columns, because that is the nearest, and green would say that it is right."""
    found = fitted(curve, 0.2)
    assert "column_fixed_pattern" in found.added
    assert found.conclusion.light == Light.AMBER and told(found.doubts, "The fixed levels of columns differ by")
    gain, error, _ = found.table["gain"]
    assert abs(gain - GAIN) < 4 * error


@pytest.mark.parametrize("curve", [pytest.param("none", marks=pytest.mark.slow), "line"])
def test_columns_with_a_defect_are_no_pattern_of_all(curve):
    found = fitted(curve, 0.4, 3)
    sigma, error, _ = found.table["column_fixed_pattern.sigma"]
    assert abs(sigma - 0.4) < 4 * error
    assert told(found.notes, "3 columns lie far off the others in all frames, by up to 4")


def of_even_and_odd(rows_e: float, columns_e: float, first_row: int = 0) -> hsnoise.FrameStack:
    """Darks whose even and odd rows and columns differ, beside fixed ones; the first row is this one of the sensor."""
    rng, n = np.random.default_rng(3), 8
    rate = rng.lognormal(np.log(3), 0.6, SHAPE)
    rows, columns = ((np.arange(size) % 2 - 0.5) for size in SHAPE)
    pixels = (
        rng.standard_normal(SHAPE) + 0.4 * rng.standard_normal(SHAPE[0])[:, None] + 0.3 * rng.standard_normal(SHAPE[1])
    )
    pixels += rows_e * (-1) ** first_row * rows[:, None] + columns_e * columns
    frames = [
        rng.poisson(rate * t, (n, *SHAPE)) + READ_E * rng.standard_normal((n, *SHAPE)) + pixels for t in EXPOSURES_S
    ]
    counts = [np.rint(200 + GAIN * of).astype(np.uint16) for of in frames]
    window = None if not first_row else (first_row, 0, 2 * SHAPE[0], SHAPE[1])
    return hsnoise.FrameStack(counts, EXPOSURES_S, cfa="mono", shutter="global", white_level=4095, window=window)


@pytest.mark.parametrize(
    ("rows_e", "columns_e", "first_row"),
    [pytest.param(1.5, 0.0, 0, marks=pytest.mark.slow), (-1.2, 0.0, 3), (0.0, 0.0, 0)],
)
def test_even_and_odd_rows_that_differ_are_measured(rows_e, columns_e, first_row):
    stack = of_even_and_odd(rows_e, columns_e, first_row)
    fit = hsnoise.fit(stack)
    value, error, _ = fit.table["row_fixed_pattern.parity"]
    assert abs(value - rows_e) <= 4 * error < 0.6 and (error > 0) == (rows_e != 0)
    sigma, of_sigma, _ = fit.table["row_fixed_pattern.sigma"]
    assert abs(sigma - 0.4) < 4 * of_sigma < 0.4  # it had been half the difference, on top
    assert fit.table["column_fixed_pattern.parity"][1] == 0
    assert fit.conclusion.light == Light.GREEN


@pytest.mark.slow
def test_frames_with_even_and_odd_rows_that_differ_are_like_the_measured_ones():
    """The parity of static rows had no effect in the library: EMVA 1288 set 002 was 62 deviations off."""
    stack = of_even_and_odd(1.5, 0.0)
    assert hsnoise.compare(hsnoise.fit(stack), stack, draws=20).error < 3
