"""Sums of squares of the decomposition: complete, and those of a direct computation in float64."""

from __future__ import annotations

import numpy as np
import pytest

from hsnoise.statistics.decomposition import COMPONENTS, PlaneSums, _sums_of_squares
from hsnoise.statistics.pixels.sample import covariance_of, halves_of
from hsnoise.statistics.pixels.structure import beside_neighbours, double_differences


def summed(counts):
    sums = PlaneSums(counts.shape[1:])
    for frame in counts:
        sums.add(frame)
    return sums


def direct(counts):
    """Effects by means, and the sum of their squares over all counts."""
    y = counts.astype(np.float64)
    mean = y.mean()
    f, r, c = (y.mean(axes, keepdims=True) - mean for axes in ((1, 2), (0, 2), (0, 1)))
    rf = y.mean(2, keepdims=True) - mean - f - r
    cf = y.mean(1, keepdims=True) - mean - f - c
    p = y.mean(0, keepdims=True) - mean - r - c
    effects = {"frame": f, "row": r, "column": c, "row_x_frame": rf, "column_x_frame": cf, "pixel": p}
    effects["temporal"] = y - mean - f - r - c - rf - cf - p
    return {name: float((np.broadcast_to(effect, y.shape) ** 2).sum()) for name, effect in effects.items()}


@pytest.mark.parametrize("shape", [(2, 5, 7), (5, 300, 11), (3, 64, 130)])
@pytest.mark.parametrize("level", [0, 1000, 60000])
def test_sums_of_squares_are_those_of_a_direct_computation(shape, level):
    rng = np.random.default_rng(1)
    counts = (level + rng.integers(0, 400, shape) + rng.integers(0, 50, (shape[0], shape[1], 1))).astype(np.uint16)
    found, expected = _sums_of_squares(summed(counts)), direct(counts)
    total = sum(expected.values())
    for name in COMPONENTS:
        assert found[name] == pytest.approx(expected[name], rel=1e-9, abs=1e-9 * total), name


def test_sums_of_squares_add_up_to_the_total():
    counts = np.random.default_rng(2).integers(0, 65536, (4, 40, 50)).astype(np.uint16)
    total = ((counts - counts.mean(dtype=np.float64)) ** 2).sum()
    assert sum(_sums_of_squares(summed(counts)).values()) == pytest.approx(total, rel=1e-12)


def test_variances_agree_with_the_means_of_a_two_way_layout():
    counts = np.random.default_rng(3).integers(100, 200, (6, 30, 40)).astype(np.uint16)
    mean = direct(counts)
    found = summed(counts).components()
    dof = (6 - 1) * (30 - 1) * (40 - 1)
    assert found["temporal"].variance_dn2 == pytest.approx(mean["temporal"] / dof, rel=1e-9)
    pixel = (mean["pixel"] / (29 * 39) - mean["temporal"] / dof) / 6
    assert found["pixel"].variance_dn2 == pytest.approx(pixel, rel=1e-6, abs=1e-9)


def test_means_are_those_of_the_counts():
    counts = np.random.default_rng(4).integers(0, 4096, (3, 20, 30)).astype(np.uint16)
    sums = summed(counts)
    np.testing.assert_allclose(sums.frame_means_dn, counts.mean((1, 2)), rtol=1e-12)
    np.testing.assert_allclose(sums.mean_map_dn(), counts.mean(0), rtol=1e-6)


@pytest.mark.parametrize("shape", [(1, 8, 8), (4, 1, 8), (4, 8, 1)])
def test_what_cannot_be_told_apart_is_nan(shape):
    found = summed(np.zeros(shape, np.uint16)).components()
    assert all(np.isnan(found[name].variance_dn2) for name in COMPONENTS)


@pytest.mark.parametrize("lines_off", [double_differences, beside_neighbours])
@pytest.mark.parametrize("frames", [2, 3, 16])
def test_two_halves_of_the_frames_share_the_pattern_alone(frames, lines_off):
    """Small responses to light were 5 % too small: the offsets of rows and columns left noise in both halves."""
    rng, shape, sigma, noise = np.random.default_rng(3), (48, 64), 3.0, 10.0
    found = []
    for _ in range(60):
        pattern = 500 + sigma * rng.standard_normal(shape)
        level = halves_of(pattern + noise * rng.standard_normal((frames, *shape))).level_dn
        found.append(covariance_of(*lines_off(level, shape[0]).astype(np.float64)))
    bias, error = np.mean(found) / sigma**2 - 1, np.std(found) / sigma**2 / np.sqrt(len(found))
    assert abs(bias) < 3 * error + 0.001


@pytest.mark.parametrize("split", [0, 1, 3])
def test_sums_of_some_frames_and_later_ones_are_those_of_all(split):
    counts = np.random.default_rng(4).integers(100, 2000, (5, 30, 40)) * np.arange(1, 6)[:, None, None]
    whole, parts = summed(counts), summed(counts[:split]).followed_by(summed(counts[split:]))
    np.testing.assert_array_equal(parts.pixel, whole.pixel)
    np.testing.assert_array_equal(parts.rows, whole.rows)
    np.testing.assert_array_equal(parts.columns, whole.columns)
    assert (parts.squares, parts.reference, parts.n_frames) == (whole.squares, whole.reference, 5)
