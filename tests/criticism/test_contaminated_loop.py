"""Captures with something in them that is no noise of the sensor, in compare, sample, diagnose and improve.

Numbers are finite, a model counts as right only if it describes what is in the capture, and no effect is named that
only the contamination imitates.
"""

from __future__ import annotations

import math
import re
from functools import cache

import jax
import numpy as np
import pytest

import hsnoise
from benchmarks.contaminated import EXPOSURE_S, MEASURED, ROWS, SHAPE, WHITE_DN, Row
from hsnoise.criticism.outcomes import Ended, Verdict

NOT_FINITE = re.compile(r"\b(nan|inf|infinity)\b", re.IGNORECASE)
TELLING = {"one lit frame"}  # the others are slow
MARKED = [pytest.param(row, id=str(row), marks=[pytest.mark.slow] * (str(row) not in TELLING)) for row in ROWS]
IMPROVED = ("stuck at a constant, 0.1 %",)  # a minute each
BULK_DN, BULK_SPREAD = 1.0, 0.15  # by which the median of drawn counts may be off, and relative, their spread


@cache
def fitted(row: Row) -> tuple[hsnoise.FrameStack, hsnoise.FitResult]:
    """The contaminated capture and its fit; skips those that are refused, as tests/test_contaminated.py asks."""
    stack = row.capture("differ").stack()
    try:
        return stack, hsnoise.fit(stack)
    except ValueError as refusal:
        pytest.skip(f"refused: {refusal}")


def bulk(counts) -> tuple[float, float]:
    """Median, and the spread of the middle two thirds, DN."""
    low, middle, high = np.percentile(counts, [16, 50, 84])
    return float(middle), float(high - low)


@pytest.mark.parametrize("row", MARKED)
def test_only_what_is_described_is_called_right(row):
    stack, fit = fitted(row)
    found = hsnoise.compare(fit, stack, draws=8)
    numbers = [x for line in found.table for x in line[2:]]
    assert np.isfinite([*numbers, *found.groups.values(), found.error, found.p_value, found.max_z_p_value]).all()
    assert np.isfinite([x for one in found.shares for x in one if isinstance(x, float)]).all()
    assert not NOT_FINITE.search(str(found))
    left_out = any("stuck or dead" in sentence for sentence in found.skipped)
    assert not found.fits or left_out or MEASURED.get(row.name) in fit.params


@pytest.mark.parametrize("row", MARKED)
def test_most_of_what_is_drawn_is_as_measured(row):
    stack, fit = fitted(row)
    for counts, t in zip(stack.counts, EXPOSURE_S, strict=True):
        drawn = np.asarray(hsnoise.sample_dark(jax.random.key(3), 4, SHAPE, fit.params, exposure_s=t))
        assert drawn.dtype == np.uint16 and drawn.max() <= WHITE_DN
        (level, spread), (measured, of_measured) = bulk(drawn), bulk(counts)
        near = abs(level - measured) <= BULK_DN and abs(spread / of_measured - 1) < BULK_SPREAD
        assert near or any(re.search(row.words, doubt) for doubt in fit.doubts if fit.grave), (t, level, spread)


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS, ids=str)
def test_nothing_that_is_not_there_is_named(row):
    stack, fit = fitted(row)
    found = hsnoise.diagnose(fit, stack)
    assert all(math.isfinite(x) for one in found.ranking for x in (one.score, one.p_value, one.misfit))
    assert not NOT_FINITE.search(str(found))
    if found.verdict == Verdict.NAMED:
        assert set(found.names) <= {MEASURED.get(row.name)}


@pytest.mark.slow
@pytest.mark.parametrize("row", [row for row in ROWS if str(row) in IMPROVED], ids=str)
def test_a_story_ends_and_names_nothing_that_is_not_there(row):
    stack, first = fitted(row)
    story = hsnoise.improve(stack, max_minutes=1)
    assert story.ending.why != Ended.UNFINISHED
    assert not NOT_FINITE.search(str(story)) and all(math.isfinite(step.comparison.error) for step in story.steps)
    measured = {*first.added, MEASURED.get(row.name)}
    assert {step.added for step in story.steps if step.added} <= measured
