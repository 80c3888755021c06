"""Parts of stacks, and stacks joined: every pixel keeps its colour, every exposure what is known of it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hsnoise._core.types import StatedGain
from hsnoise.frames.bayer import shift_cfa, transpose_cfa
from hsnoise.frames.lazy import LazyFrames
from hsnoise.frames.stack import FrameStack

BAYER = ("RGGB", "BGGR", "GRBG", "GBRG")


def dark_counts(*shape, mean=100):
    return np.random.default_rng(0).poisson(mean, shape).astype(np.uint16)


def lazy(counts):
    return LazyFrames([lambda i=i: counts[i] for i in range(len(counts))], counts.shape[1:], counts.dtype)


def colour_of(cfa, row, column):
    return cfa[2 * (row % 2) + column % 2]


def read_all(stack, exposure=0):
    return np.stack(list(stack.frames(exposure)))


@settings(max_examples=60, deadline=None)
@given(
    cfa=st.sampled_from(("mono", *BAYER)),
    row_axis=st.sampled_from((0, 1)),
    row=st.integers(0, 5),
    column=st.integers(0, 5),
    is_lazy=st.booleans(),
)
def test_select_keeps_every_pixel_in_its_colour(cfa, row_axis, row, column, is_lazy):
    counts = dark_counts(3, 10, 12)
    whole = FrameStack(lazy(counts) if is_lazy else counts, 1.0, cfa=cfa, row_axis=row_axis)
    part = whole.select(rows=(row, row + 4), columns=slice(column, column + 4))
    np.testing.assert_array_equal(read_all(part), read_all(whole)[:, row : row + 4, column : column + 4])
    if cfa != "mono":
        for i in range(2):
            for j in range(2):
                assert colour_of(part.cfa, i, j) == colour_of(whole.cfa, row + i, column + j)


def test_select_takes_other_frames_of_each_exposure():
    stack = FrameStack([dark_counts(n, 4, 6) for n in (5, 3, 2)], [1, 2, 3])
    part = stack.select(frames=[slice(1, None), slice(2)], exposures=[2, 0])
    assert part.n_frames == (1, 2)
    np.testing.assert_array_equal(part.frame(1, 1), stack.frame(0, 1))
    with pytest.raises(ValueError, match="frames: expected a slice for each of 3 exposures, got 2"):
        stack.select(frames=[slice(1), slice(2)])


def test_select_frames_and_exposures_keeps_what_is_known():
    counts = dark_counts(3, 4, 4, 6)
    stack = FrameStack(
        counts,
        [1, 2, 3],
        kind=["dark", "flat", "flat"],
        photons_e=[20, 30],
        temperature_c=[5, 6, 7],
        iso=200,
        shutter="global",
    )
    part = stack.select(frames=slice(1, None, 2), exposures=[2, 0])
    assert part.kind == ("flat", "dark") and part.iso == 200 and part.shutter == "global"
    assert part.exposure_s.tolist() == [3, 1] and part.temperature_c.tolist() == [7, 5]
    np.testing.assert_array_equal(part.photons_e, [30, np.nan])
    np.testing.assert_array_equal(read_all(part, 0), counts[2, 1::2])
    assert stack.select(exposures=[0]).photons_e is None


@pytest.mark.parametrize("rows", [(3, 3), (-1, 4), (0, 11), slice(0, 4, 2), (5, 2)])
def test_wrong_regions(rows):
    with pytest.raises(ValueError, match="rows: expected"):
        FrameStack(dark_counts(2, 10, 12), 1.0).select(rows=rows)


def test_odd_region_of_a_bayer_sensor():
    with pytest.raises(ValueError, match="even numbers"):
        FrameStack(dark_counts(2, 10, 12), 1.0, cfa="RGGB").select(rows=(0, 3))


def test_join_darks_and_flats():
    arguments = {"cfa": "GRBG", "row_axis": 1, "black_level": [10, 20, 30], "white_level": 4095}
    darks = FrameStack(dark_counts(2, 3, 4, 6), [1, 2], temperature_c=4, **arguments)
    flats = FrameStack(dark_counts(2, 4, 6, mean=900), 0.5, kind="flat", photons_e=1800, **arguments)
    both = FrameStack.join(darks, flats)
    assert both.kind == ("dark", "dark", "flat") and both.exposure_s.tolist() == [1, 2, 0.5]
    assert both.cfa == darks.cfa == "GBRG" and both.shape == (6, 4)
    np.testing.assert_array_equal(both.photons_e, [np.nan, np.nan, 1800])
    np.testing.assert_array_equal(both.temperature_c, [4, 4, np.nan])
    np.testing.assert_array_equal(read_all(both, 2), read_all(flats))


@pytest.mark.parametrize(
    "name, value",
    [
        ("cfa", "RGGB"),
        ("shutter", "global"),
        ("black_level", 5),
        ("white_level", 999),
        ("iso", 100),
        ("row_axis", 1),
    ],
)
def test_join_refuses_what_differs(name, value):
    one, two = FrameStack(dark_counts(2, 4, 4), 1.0), FrameStack(dark_counts(2, 4, 4), 2.0, **{name: value})
    with pytest.raises(ValueError, match=f"join: the stacks differ in {name}"):
        FrameStack.join(one, two)


EGAIN = StatedGain(0.5, "EGAIN 2 e-/DN", certain=True)


def known_darks():
    return FrameStack(
        dark_counts(2, 3, 8, 6), [0, 1], stated_gain=EGAIN, overscan_dn=[90, np.nan], assumed=["A dark is one"]
    )


def flats_of(rows, **keywords):
    return FrameStack(dark_counts(4, rows, 6, mean=900), 0.5, kind="flat", **keywords)


def test_what_loading_knows_is_kept():
    stack = FrameStack.join(known_darks(), flats_of(10, assumed=["A flat is one"]))
    part = stack.select(exposures=[1, 0], rows=(0, 4), frames=slice(2))
    drawn = part.with_counts([dark_counts(2, 4, 6)] * 2, None)
    for one in (stack, part, drawn):
        assert one.stated_gain == EGAIN and one.assumed == ("A dark is one", "A flat is one")
    for one in (stack, part):
        assert one.elsewhere.shape == (10, 6) and one.elsewhere.n_frames == (4,)
    assert drawn.elsewhere is None  # each draw would be measured with the same real flats
    np.testing.assert_array_equal(part.overscan_dn, [np.nan, 90])
    np.testing.assert_array_equal(FrameStack.join(known_darks(), flats_of(8)).overscan_dn, [90, np.nan, np.nan])


def test_flats_of_another_crop_lie_elsewhere():
    darks, flats = known_darks(), flats_of(10)
    for stack in (FrameStack.join(darks, flats), FrameStack.join(flats, darks)):
        assert stack.kind == ("dark", "dark") and stack.shape == (8, 6)
        np.testing.assert_array_equal(read_all(stack.elsewhere), read_all(flats))
        assert stack.elsewhere.assumed == ()
    assert "elsewhere on the sensor, 10 x 6 pixels:\n    flat       0.5 s  4 frames" in repr(stack)
    twice = FrameStack.join(stack, flats_of(10))
    assert twice.elsewhere.n_frames == (4, 4)
    with pytest.raises(ValueError, match=r"differ in shape or window \(8 x 6 and 10 x 6 and 12 x 6\)"):
        FrameStack.join(stack, flats_of(12))
    with pytest.raises(ValueError, match="differ in shutter"):
        FrameStack.join(darks, flats_of(10, shutter="global"))


def test_flats_of_one_size_and_another_window_lie_elsewhere():
    darks = known_darks().select(rows=(0, 8))
    there = flats_of(8, window=(2, 0, 20, 6))
    assert FrameStack.join(darks, there).elsewhere.window == (2, 0, 20, 6)


def test_headers_that_contradict_each_other_state_no_gain():
    other = flats_of(8, stated_gain=StatedGain(0.4, "EGAIN 2.5 e-/DN", certain=True))
    stack = FrameStack.join(known_darks(), other)
    assert stack.stated_gain is None and "EGAIN 2 e-/DN, EGAIN 2.5 e-/DN" in stack.assumed[-1]
    assert FrameStack.join(known_darks(), flats_of(8, stated_gain=EGAIN)).stated_gain == EGAIN


@pytest.mark.parametrize(
    "changes, error, message",
    [
        ({"stated_gain": 0.5}, TypeError, "stated_gain: expected a StatedGain"),
        ({"stated_gain": StatedGain(0.0, "EGAIN", True)}, ValueError, "stated_gain: expected a number > 0"),
        ({"overscan_dn": [1, 2, 3]}, ValueError, "overscan_dn: expected 2"),
        ({"elsewhere": 3}, TypeError, "elsewhere: expected a FrameStack"),
        ({"elsewhere": "darks"}, ValueError, "elsewhere: expected flats alone"),
        ({"assumed": "a sentence"}, TypeError, "assumed: expected a list"),
        ({"assumed": [1]}, TypeError, "assumed: expected sentences"),
    ],
)
def test_wrong_knowledge(changes, error, message):
    given = {name: known_darks() if value == "darks" else value for name, value in changes.items()}
    with pytest.raises(error, match=message):
        FrameStack(dark_counts(2, 2, 8, 6), [0, 1], **given)


def test_join_nothing():
    with pytest.raises(ValueError, match="at least one"):
        FrameStack.join()


@given(st.sampled_from(BAYER), st.integers(0, 9), st.integers(0, 9))
def test_bayer_orders_shift_and_transpose(cfa, rows, columns):
    assert shift_cfa(shift_cfa(cfa, rows, columns), rows, columns) == cfa
    assert shift_cfa(cfa, rows, columns) in BAYER
    assert all(colour_of(transpose_cfa(cfa), i, j) == colour_of(cfa, j, i) for i in range(2) for j in range(2))
