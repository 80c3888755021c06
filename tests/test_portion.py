"""Which exposures of a long series are drawn and compared."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise.criticism.held_out import Judge, split_frames
from hsnoise.simulation.portion import MOST_LEVELS, Portion

DARK, FLAT = 26, 17


def series(dark_frames=2, darks=DARK, flats=FLAT) -> hsnoise.FrameStack:
    """Darks and flats in the order in which a series alternates them; the last of the darks is the shortest."""
    rng = np.random.default_rng(0)
    of = [("dark", 0.01 * (1 + (i + 1) % darks), 100.0) for i in range(darks)]
    of += [("flat", 0.01 * (1 + i), 300.0 + 40 * i) for i in range(flats)]
    frames = [dark_frames if kind == "dark" else 2 for kind, *_ in of]
    frames[7] += 4
    counts = [rng.poisson(level, (n, 32, 48)).astype(np.uint16) for n, (*_, level) in zip(frames, of, strict=True)]
    kinds, times, _ = zip(*of, strict=True)
    return hsnoise.FrameStack(counts, times, kind=kinds, shutter="global")


def test_of_many_exposures_some_are_drawn_from_the_shortest_to_the_longest():
    stack = series()
    portion = Portion.of(stack)
    part = portion.frames
    assert [part.kind.count(kind) for kind in ("dark", "flat")] == [MOST_LEVELS, MOST_LEVELS]
    np.testing.assert_array_equal(part.exposure_s, stack.exposure_s[list(portion.chosen)])
    for kind, most in (("dark", DARK), ("flat", FLAT)):
        times = sorted(t for t, one in zip(part.exposure_s, part.kind, strict=True) if one == kind)
        assert times[0] == pytest.approx(0.01) and times[-1] == pytest.approx(0.01 * most)
        assert max(np.diff(times)) < 2 * 0.01 * most / MOST_LEVELS
    assert max(part.n_frames) == 6  # of those that could stand for one another, that of most frames
    assert "20 of 43 exposures were compared, from the shortest to the longest" in portion.left_out
    assert portion.darks.chosen == tuple(i for i in portion.chosen if i < DARK)
    again = Portion.of(part)
    assert again.frames.n_frames == part.n_frames and not again.left_out


def test_few_exposures_are_all_drawn():
    portion = Portion.of(series(darks=MOST_LEVELS, flats=3))
    assert portion.chosen == tuple(range(MOST_LEVELS + 3)) and not portion.left_out


def test_frames_are_held_out_of_the_exposures_that_are_drawn():
    stack = series(dark_frames=8)
    portion = Portion.of(stack)
    fitted, held_out = split_frames(portion, stack)
    assert held_out is not None and held_out.n_frames.count(2) >= MOST_LEVELS - 1
    assert fitted.kind.count("dark") == MOST_LEVELS and fitted.kind.count("flat") == FLAT
    darks = [i for i, kind in enumerate(fitted.kind) if kind == "dark"]
    np.testing.assert_array_equal(fitted.exposure_s[darks], held_out.exposure_s)
    for i, unseen, whole in zip(darks, held_out.counts, portion.darks.frames.counts, strict=True):
        np.testing.assert_array_equal(np.concatenate([fitted.counts[i], unseen]), whole)
    judge = Judge.of(fitted, held_out, 0)
    assert judge.portion.before == tuple(fitted.n_frames[i] for i in darks) + (0,) * MOST_LEVELS
    # Two frames of each are too few to spare any: then all exposures are fitted.
    assert split_frames(Portion.of(series()), series())[1] is None


def test_a_long_series_is_compared_and_diagnosed():
    stack = series(darks=14, flats=12)
    model = hsnoise.NoiseModel(
        [
            hsnoise.effects.ShotNoise(),
            hsnoise.effects.ReadNoise(10.0),
            hsnoise.effects.Gain(1.0),
            hsnoise.effects.BlackLevel(100.0),
            hsnoise.effects.ADC(),
        ],
        cfa="mono",
        shutter="global",
        exposure_s=0.1,
    )
    report = hsnoise.compare(model, stack, draws=8)
    assert np.isfinite(report.error) and any("20 of 26 exposures" in sentence for sentence in report.skipped)
