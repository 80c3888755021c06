"""Histograms and sums of rows, against a count one by one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hsnoise.likelihood import counting as _counting
from hsnoise.likelihood.counting import Bins, count_rows


def expected(frame, bins, number):
    """Counts [row, column of the pattern, bin] and sums [2, row, column of the pattern], pixel by pixel."""
    step = len(bins.low)
    counts, sums = np.zeros((len(frame), step, number), int), np.zeros((2, len(frame), step))
    for (row, column), code in np.ndenumerate(frame.astype(object)):
        place = row % step, column % step
        low, width, end = (int(x[place]) for x in bins)
        at = number - 1 if code >= end else min(max((code - low) // width + 1, 0), number - 1)
        counts[row, place[1], at] += 1
        sums[:, row, place[1]] += code, code**2
    return counts, sums


def check(frame, bins, number):
    for found, right in zip(count_rows(frame, bins, number), expected(frame, bins, number), strict=True):
        np.testing.assert_array_equal(found, right)


def bins_of(low, width, number, white=None):
    end = low + width * (number - 2)
    return Bins(low, width, end if white is None else np.minimum(end, white))


@given(
    seed=st.integers(0, 2**32 - 1),
    step=st.sampled_from([1, 2]),
    highest=st.sampled_from([1, 30, 300, 65535]),
    dtype=st.sampled_from([np.uint16, np.int32]),
    white=st.one_of(st.none(), st.integers(202, 300)),
)
def test_any_counts_in_any_bins(seed, step, highest, dtype, white):
    rng = np.random.default_rng(seed)
    bins = bins_of(rng.integers(1, 200, (step, step)), rng.integers(1, 9, (step, step)), 40, white)
    check(rng.integers(0, highest, (4, 6), endpoint=True).astype(dtype), bins, 40)


@pytest.mark.parametrize("width", [1, 3, 7, 1000, 400_000])
def test_the_edges_of_wide_bins_are_exact(width):
    """Quotients are rounded in float32, or in float64 where that is too coarse."""
    low, number = 5, 4096
    inside = low + width * np.arange(number - 2)
    frame = np.concatenate([inside - 1, inside, inside + width - 1])[None].astype(np.int32)
    bins = bins_of(np.full((1, 1), low), np.full((1, 1), width), number)
    counts, _ = count_rows(frame, bins, number)
    at = np.clip((frame.astype(np.int64) - low) // width + 1, 0, number - 1)
    np.testing.assert_array_equal(counts[0, 0], np.bincount(at.ravel(), minlength=number))


@pytest.mark.parametrize("rows", [2, 6, 8, 14])
def test_blocks_make_no_difference(rows, monkeypatch):
    frame = np.random.default_rng(rows).poisson(20, (rows, 10)).astype(np.uint16)
    bins = bins_of(np.full((2, 2), 10), np.full((2, 2), 1), 24)
    monkeypatch.setattr(_counting, "BLOCK_PIXELS", 60)  # six rows at a time
    check(frame, bins, 24)
