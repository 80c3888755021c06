"""The one place that draws, and the one cut of a capture."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.criticism.compare import compared
from hsnoise.criticism.diagnose import diagnosed
from hsnoise.criticism.held_out import Judge
from hsnoise.fitting.simulated import draft_synthetic
from hsnoise.frames.lazy import LazyFrames
from hsnoise.frames.stack import FrameStack
from hsnoise.simulation import portion as cutting
from hsnoise.simulation import simulator as drawing
from hsnoise.simulation.draws import _alike, _together, _without_spikes, draw_capture
from hsnoise.simulation.portion import LEAST_COLUMNS, LEAST_FRAMES, Portion
from hsnoise.simulation.simulator import Purpose, Simulator, key_for
from hsnoise.statistics.structure import Structure

MODEL = hsnoise.NoiseModel(
    [fx.ShotNoise(), fx.DarkCurrent(400.0), fx.ReadNoise(3.0), fx.Gain(2.0), fx.BlackLevel(100.0), fx.ADC()],
    cfa="mono",
    shutter="rolling",
    exposure_s=0.1,
)
EXPOSURE_S = (0.02, 0.1)
FEW = ("row_noise",)


def empty_stack(frames: int = 3, shape: tuple[int, int] = (32, 36)) -> FrameStack:
    """A stack that only says how a capture is taken."""
    counts = [np.random.default_rng(i).integers(90, 200, (frames, *shape), np.uint16) for i in range(2)]
    return FrameStack(counts, EXPOSURE_S)


def statistics(*values: np.ndarray) -> Structure:
    """The statistics with these values."""
    whole = np.concatenate([np.ravel(one) for one in values]).astype(float)
    return Structure(("",) * len(whole), ("",) * len(whole), whole, np.ones(len(whole)), ())


def all_counts(frames: FrameStack) -> Structure:
    """Every count is a statistic."""
    return statistics(*frames.counts)


def simulator(measure: Callable[[FrameStack], Structure], purpose: Purpose = Purpose.COMPARE, **more) -> Simulator:
    return Simulator(MODEL, Portion.of(empty_stack()), key_for(0, purpose), measure=measure, **more)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (MODEL, MODEL.add(fx.RowNoise(0.0))),
        (MODEL.add(fx.RowNoise(0.0, 0.0)), MODEL.add(fx.RowNoise(0.0, 1.0))),
        (MODEL.add(fx.AmplifierGlow(0.0, 0.3)), MODEL.add(fx.AmplifierGlow(0.0, 0.5, row=0.5))),
        (MODEL.add(fx.FrameOffset(1.0)), MODEL.add(fx.FrameOffset(1.0)).add(fx.DarkSignalNonuniformity(0.0))),
    ],
)
def test_what_does_not_matter_changes_no_draw(one, other):
    """Draws of one number have the same random numbers for all models."""
    of = simulator(all_counts)
    np.testing.assert_array_equal(of.draws(one, 2), of.draws(other, 2))
    assert not np.array_equal(*of.draws(one, 2))


def test_what_matters_changes_only_what_it_moves():
    of = simulator(all_counts)
    brighter = MODEL.with_value("black_level", "value", 107.0)
    np.testing.assert_array_equal(of.draws(brighter, 2) - of.draws(MODEL, 2), 7.0)


@pytest.mark.parametrize(("one", "other"), list(combinations(Purpose, 2)), ids=lambda purpose: purpose.value)
def test_draws_of_two_purposes_share_no_random_numbers(one, other):
    """Neither of frames nor of the sensor, for the same seed and number."""
    keys = [np.asarray(jax.random.key_data(key_for(0, purpose))) for purpose in (one, other)]
    assert not np.array_equal(*keys)
    sensor = MODEL.add(fx.DarkSignalNonuniformity(6.0))
    drawn = [simulator(all_counts, purpose).draws(sensor, 1)[0].reshape(2, -1) for purpose in (one, other)]
    for a, b in zip(*drawn, strict=True):  # exposures: what their pixels share is not the light
        assert abs(np.corrcoef(a, b)[0, 1]) < 0.1


def test_draws_of_one_purpose_come_again_and_those_of_another_seed_do_not():
    again = [simulator(all_counts).draws(MODEL, 1) for _ in range(2)]
    np.testing.assert_array_equal(*again)
    keys = [np.asarray(jax.random.key_data(key_for(seed, Purpose.COMPARE))) for seed in (0, 1)]
    assert not np.array_equal(*keys)


@pytest.mark.slow
def test_what_tunes_draws_nothing_that_judges(few_candidates, monkeypatch):
    """The loop itself: search and refit on the one side, comparison and held-out frames on the other."""
    real, seen = drawing.draw_capture, []

    def draw_capture(key, *rest):
        seen.append(np.asarray(jax.random.key_data(key)).tobytes())
        return real(key, *rest)

    def keys_of(work: Callable[[], object]) -> set[bytes]:
        seen.clear()
        work()
        return set(seen)

    monkeypatch.setattr(drawing, "draw_capture", draw_capture)
    truth = MODEL.add(fx.RowNoise(4.0))
    portion = Portion.of(real(5, truth, empty_stack(6, (32, 48))))
    base = hsnoise.fit(portion.frames, model=MODEL, pixels="alike")
    tuned = keys_of(lambda: diagnosed(MODEL, portion, draws=16, seed=0, tick=lambda: None))
    refitted = keys_of(lambda: draft_synthetic(base, portion, base.params.add(fx.RowNoise(3.0))).finished())
    judged = keys_of(lambda: compared(truth, portion, draws=8, seed=0))
    unseen = keys_of(lambda: Judge(portion, True, 0).score(truth))
    for one, other in combinations([tuned, refitted, judged, unseen], 2):
        assert one and other and not one & other


@pytest.mark.parametrize(
    ("needed", "drawn"),
    [
        ([4, 5, 5], [5, 5, 5]),
        ([8, 8], [8, 8]),
        ([20, 2, 13, 12], [20, 2, 13, 13]),
        ([10, 9, 7, 6, 5, 1], [10, 10, 10, 6, 6, 1]),
    ],
)
def test_exposures_of_almost_as_many_frames_share_programs(needed, drawn):
    assert _alike(needed) == drawn


@pytest.mark.parametrize(
    ("frames", "kinds", "pixels", "together"),
    [
        ([2, 2, 2], "ddd", 600, [(2, [0, 1, 2])]),
        ([2, 2, 2, 2, 2], "ddddd", 400, [(2, [0, 1]), (2, [2, 3]), (2, [4, 4])]),
        ([2, 2, 2, 2, 2, 2, 2], "dffffdd", 800, [(2, [0, 5, 6, 6]), (2, [1, 2, 3, 4])]),
        ([8, 2, 2], "dff", 10, [(8, [0]), (2, [1]), (2, [2])]),
    ],
)
def test_exposures_are_drawn_together_where_they_are_alike(monkeypatch, frames, kinds, pixels, together):
    monkeypatch.setattr("hsnoise.simulation.draws.TOGETHER", pixels)
    of = {"d": "dark", "f": "flat"}
    counts = [np.arange(100 * n, dtype=np.uint16).reshape(n, 10, 10) for n in frames]
    like = FrameStack(counts, [1.0 + e for e in range(len(frames))], kind=[of[kind] for kind in kinds])
    assert list(_together(frames, like)) == together


def test_frames_that_are_drawn_to_share_programs_are_left_out():
    """And those before the ones that are wanted; the others are the same frames."""
    whole = empty_stack(5)
    like = FrameStack([whole.counts[0][:4], whole.counts[1]], EXPOSURE_S)
    drawn, same = draw_capture(3, MODEL, like), draw_capture(3, MODEL, whole)
    assert drawn.n_frames == (4, 5)
    later = draw_capture(3, MODEL, like.select(frames=slice(0, 2)), before=(1, 3))
    for i in range(2):
        np.testing.assert_array_equal(drawn.counts[i], same.counts[i][: drawn.n_frames[i]])
        np.testing.assert_array_equal(later.counts[i], same.counts[i][(1, 3)[i] : (3, 5)[i]])


def test_nothing_is_drawn_twice():
    measured, ticks = [], []

    def measure(frames):
        measured.append(1)
        return statistics([float(frames.counts[0].mean())])

    of = simulator(measure, tick=lambda: ticks.append(1))
    row_noise = MODEL.add(fx.RowNoise(1.0))
    of.draws(MODEL, 3)
    assert len(measured) == 3
    of.draws(MODEL, 5)
    assert len(measured) == 5
    of.drawn([(row_noise, 2), (MODEL, 4), (row_noise, 2)])
    assert len(measured) == 6
    of.slopes(MODEL, [row_noise], [1.0], 4)  # 0, 1 and 3 of the other model
    assert len(measured) == 9
    of.reference(MODEL.remove("dark_current").add(MODEL["dark_current"]), 5)  # the same model, made anew
    of.draws(MODEL, 2, first=3)
    assert len(measured) == len(ticks) == 9
    of.draws(MODEL, 2, first=4)
    assert len(measured) == len(ticks) == 10
    assert of.measured is of.measured and len(measured) == 11


def test_slopes_of_linear_statistics_are_exact():
    def measure(frames):
        return statistics([counts.mean() for counts in frames.counts], [3 * frames.counts[0].mean()], [7.0])

    of = simulator(measure)
    steps = np.array([2.0, -5.0])
    moved = [MODEL.with_value("black_level", "value", 100.0 + step) for step in steps]
    slopes = of.slopes(MODEL, moved, steps, 3)
    assert slopes.shape == (3, 2, 4)
    np.testing.assert_allclose(slopes, np.broadcast_to([1.0, 1.0, 3.0, 0.0], slopes.shape), atol=1e-9)


def test_slopes_scatter_little_over_common_draws():
    """Dark current adds gain times exposure; draws of their own would scatter by much more than the change."""

    def measure(frames):
        return statistics([counts.mean() for counts in frames.counts])

    more = MODEL.with_value("dark_current", "rate", 410.0)
    slopes = simulator(measure).slopes(MODEL, [more], [10.0], 8)[:, 0]
    expected = 2.0 * np.array(EXPOSURE_S)
    np.testing.assert_allclose(slopes.mean(0), expected, rtol=0.2)
    apart = np.sqrt(2) * simulator(measure).draws(MODEL, 8).std(0, ddof=1) / 10.0
    assert np.all(slopes.std(0, ddof=1) < apart / 2)


def counted(frames: int, shape: tuple[int, int]) -> tuple[LazyFrames, list[int]]:
    """Frames that are read one at a time, and how often each was."""
    reads = [0] * frames

    def reader(number):
        def read():
            reads[number] += 1
            return np.random.default_rng([frames, number]).integers(90, 110, shape, np.uint16)

        return read

    return LazyFrames([reader(number) for number in range(frames)], shape, np.uint16), reads


def test_a_portion_is_loaded_once_and_no_more_than_it_holds(monkeypatch):
    monkeypatch.setattr(cutting, "MOST_PIXELS", 40_000)
    lazy, reads = zip(*(counted(frames, (32, 200)) for frames in (12, 10)), strict=True)
    portion = Portion.of(FrameStack(list(lazy), EXPOSURE_S))
    of = Simulator(MODEL, portion, key_for(0, Purpose.COMPARE), measure=all_counts)
    assert of.measured.values.shape == of.draws(MODEL, 1)[0].shape
    assert portion.darks is portion and Portion.of(portion.frames).frames.n_frames == (8, 8)
    assert reads == ([1] * 8 + [0] * 4, [1] * 8 + [0] * 2)
    assert not any(portion.frames.is_lazy(exposure) for exposure in range(2))


@pytest.mark.parametrize("frames", [3, 20])
@pytest.mark.parametrize("shape", [(32, 64), (32, 200), (60, 90)])
@pytest.mark.parametrize("kinds", [("dark",), ("dark", "flat", "dark")])
def test_a_portion_holds_no_more_than_its_limit_and_says_what_it_lacks(frames, shape, kinds, monkeypatch):
    monkeypatch.setattr(cutting, "MOST_PIXELS", 60_000)
    counts = [np.random.default_rng(i).integers(90, 200, (frames, *shape), np.uint16) for i in range(len(kinds))]
    portion = Portion.of(FrameStack(counts, np.arange(len(kinds)), kind=list(kinds)))
    held, (rows, columns) = portion.frames.n_frames[0], portion.frames.shape
    pixels = sum(one.size for one in portion.frames.counts)
    least = len(kinds) * min(frames, LEAST_FRAMES) * rows * min(LEAST_COLUMNS, shape[1])
    assert pixels <= max(60_000, least) and rows == shape[0] and columns % 2 == 0
    assert held >= min(frames, LEAST_FRAMES) and columns >= min(LEAST_COLUMNS, shape[1])
    said = "; ".join(portion.left_out)
    assert ("columns" in said) == (columns < shape[1]) and ("frames" in said) == (held < frames)
    assert len(portion.left_out) == (columns < shape[1]) + (held < frames)
    if columns < shape[1]:
        first = portion.frames.window[1]
        assert f"only columns {first} to {first + columns - 1} of {shape[1]}" in said
        assert portion.frames.window == (0, first, *shape)
        np.testing.assert_array_equal(portion.frames.frame(0, 2), counts[0][2][:, first : first + columns])
    if held < frames:
        assert f"only the first {held} frames" in said
    assert portion.darks.frames.kind == tuple(kind for kind in kinds if kind == "dark")
    assert portion.darks.left_out == portion.left_out and portion.darks is portion.darks


def test_large_captures_are_cut_but_keep_their_rows():
    big = np.random.default_rng(0).integers(60, 80, (1, 3, 1200, 1600)).astype(np.uint16)
    cut = Portion.of(FrameStack(big, [0.1], cfa="RGGB")).frames
    assert cut.shape[0] == 1200 and cut.shape[1] < 1600 and cut.shape[1] % 2 == 0 and cut.cfa == "RGGB"


def test_copies_and_flats_alone_are_refused():
    counts = np.array(empty_stack().counts)
    with pytest.raises(ValueError, match="expected dark frames, got flats only"):
        Portion.of(FrameStack(counts, EXPOSURE_S, kind="flat"))
    counts[1, 2] = counts[0, 1]
    with pytest.raises(ValueError, match=r"frame 1 of the 0.02 s exposure and frame 2 of the 0.1 s exposure"):
        Portion.of(FrameStack(counts, EXPOSURE_S))


def test_counts_of_dim_flats_are_no_spikes():
    """Where nearly all pixels have the same count, those with another one are noise; hot pixels are not."""
    plane = np.zeros((40, 50))
    plane[::3, ::2] = 1.0
    np.testing.assert_array_equal(_without_spikes(plane), plane)
    hot = plane + 300 * (np.arange(50) == 7) * (np.arange(40) == 9)[:, None]
    np.testing.assert_array_equal(_without_spikes(hot)[9, 7] < 2, True)
