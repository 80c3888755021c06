"""Summaries of a stack: row histograms against counting row by row, photon transfer of flats against its law."""

from __future__ import annotations

import weakref

import hypothesis.strategies as st
import jax
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis.extra.numpy import arrays

from hsnoise._core.types import BAYER_CFAS
from hsnoise.frames.bayer import channel_rows
from hsnoise.frames.lazy import LazyFrames
from hsnoise.frames.stack import FrameStack
from hsnoise.likelihood import summary as statistics
from hsnoise.likelihood.summary import (
    MOST_BINS,
    every_nth_row,
    round_up,
    row_stride,
    some_frames,
    summarise,
    without_counts,
)

CFAS = ("mono", *BAYER_CFAS)
BLACK_DN, GAIN, READ_E = 64.0, 1.3, 4.0
PRNU, FLICKER, ROW_SIGMA = 0.02, 0.01, 0.005


def dark_counts(rng, frames, shape, *, mean=40.0, sigma=6.0, highest=65535):
    row_gain = np.maximum(1 + 0.2 * rng.standard_normal((frames, shape[0], 1)), 0)
    counts = row_gain * rng.normal(mean, sigma, (frames, *shape))
    return np.clip(np.rint(counts), 0, highest).astype(np.uint16 if highest < 65536 else np.uint32)


def lazy(counts):
    return LazyFrames([lambda frame=frame: frame for frame in counts], counts.shape[1:], counts.dtype)


def pixels_of_rows(frame, cfa, channel):
    """Pixels of a channel, row by row, from the definition of a Bayer array."""
    if cfa == "mono":
        return list(frame)
    sites = [(r, c) for r in range(len(frame)) for c in (0, 1) if cfa[2 * (r % 2) + c] == channel]
    return [frame[r, c::2] for r, c in sites]


def count_one_by_one(row, edges_dn):
    ends = [-np.inf, *edges_dn, np.inf]
    return [int(((row > low) & (row < high)).sum()) for low, high in zip(ends, ends[1:], strict=False)]


@pytest.mark.parametrize("cfa", CFAS)
@pytest.mark.parametrize(
    ("mean", "sigma", "white_level", "wide"),
    [
        pytest.param(3.0, 2.5, None, False, id="clipped at 0"),
        pytest.param(600.0, 40.0, None, True, id="coarse bins"),
        pytest.param(90.0, 40.0, 120, True, id="clipped at 0 and at the white level"),
        pytest.param(1e6, 2e3, None, True, id="31 bits"),
    ],
)
def test_row_histograms_are_what_counting_gives(rng, cfa, mean, sigma, white_level, wide):
    highest = white_level or (65535 if mean < 1e5 else 2**31 - 1)
    frames, shape = (3, 1), (8, 12)
    counts = [dark_counts(rng, n, shape, mean=mean, sigma=sigma, highest=highest) for n in frames]
    stack = FrameStack(counts, [0.1, 0.2], cfa=cfa, white_level=white_level)
    summary = summarise(stack)
    assert tuple(h.channel for h in summary.histograms) == stack.channels
    for h in summary.histograms:
        assert (np.diff(h.edges_dn).max() > 1) == wide
        for e, f in np.ndindex(2, 3):
            naive = pixels_of_rows(counts[e][f], cfa, h.channel) if f < frames[e] else []
            got = slice(None) if naive else slice(0)
            expected = [count_one_by_one(row, h.edges_dn[e]) for row in naive]
            np.testing.assert_array_equal(h.counts[e, f][got], np.reshape(expected, h.counts[e, f][got].shape))
            whole = [row.astype(np.int64) for row in naive]
            np.testing.assert_array_equal(h.row_sum[e, f][got], [row.sum() for row in whole])
            np.testing.assert_array_equal(h.row_sum_of_squares[e, f][got], [(row**2).sum() for row in whole])
        # The exposure of one frame is padded with frames that have no pixels.
        assert not h.counts[1, 1:].any() and not h.row_sum[1, 1:].any() and not h.row_sum_of_squares[1, 1:].any()
        row_pixels = (shape[1] if cfa == "mono" else shape[1] // 2) * np.array([[1, 1, 1], [1, 0, 0]])
        np.testing.assert_array_equal(h.row_pixels, np.broadcast_to(row_pixels[..., None], h.row_sum.shape))


@pytest.mark.parametrize("cfa", CFAS)
def test_codes_at_the_white_level_are_in_the_last_bin_and_code_0_in_the_first(rng, cfa):
    counts = dark_counts(rng, 2, (8, 40), mean=60.0, sigma=40.0, highest=100)
    assert (counts == 0).any() and (counts == 100).any()
    for h in summarise(FrameStack(counts, 0.1, cfa=cfa, white_level=100)).histograms:
        assert (h.edges_dn[:, 0] >= 0.5).all() and (h.edges_dn[:, -1] == 99.5).all()
        for f, frame in enumerate(counts):
            rows = np.stack(pixels_of_rows(frame, cfa, h.channel))
            np.testing.assert_array_equal(h.counts[0, f, :, -1], (rows == 100).sum(1))
            np.testing.assert_array_equal(h.counts[0, f, :, 0], (rows < h.edges_dn[0, 0]).sum(1))


@pytest.mark.parametrize("cfa", BAYER_CFAS)
def test_red_and_blue_use_every_second_row_green_all_and_each_one_pixel_a_cell(cfa):
    frame = np.arange(6 * 8).reshape(6, 8)
    used = []
    for channel, stride in zip("RGB", (2, 1, 2), strict=True):
        rows = channel_rows(frame, cfa, channel)
        assert row_stride(cfa, channel) == stride and rows.shape == (6 // stride, 4)
        np.testing.assert_array_equal(rows, pixels_of_rows(frame, cfa, channel))
        np.testing.assert_array_equal(np.diff(rows[:, 0] // 8), stride)
        used += rows.ravel().tolist()
    assert sorted(used) == frame.ravel().tolist()


def test_the_summary_tells_darks_from_flats_and_holds_what_is_known(rng):
    counts = [dark_counts(rng, n, (8, 12), mean=mean) for n, mean in ((2, 300), (1, 40), (3, 50))]
    kind, photons_e = ("flat", "dark", "dark"), [120.0, np.nan, np.nan]
    stack = FrameStack(
        counts, [0.3, 0.1, 0.2], kind=kind, cfa="GBRG", shutter="global", black_level=20, photons_e=photons_e
    )
    ticks = []
    summary = summarise(stack, progress=lambda: ticks.append(1))
    assert len(ticks) == 6
    np.testing.assert_array_equal(summary.exposure_s, [0.1, 0.2])
    np.testing.assert_array_equal(summary.flats.exposure_s, [0.3])
    np.testing.assert_array_equal(summary.flats.photons_e, [120.0])
    np.testing.assert_array_equal(summary.black_level_dn, [20.0] * 3)
    assert summary.n_frames == (1, 3) and summary.shape == (8, 12) and summary.channels == ("R", "G", "B")
    assert summary.cfa == "GBRG" and summary.shutter == "global" and summary.white_level_dn is None
    assert summarise(stack.select(exposures=[0])).histograms == ()
    assert summarise(stack.select(exposures=[1, 2])).flats is None


def test_outliers_lie_at_and_above_the_median(rng):
    counts = dark_counts(rng, 2, (32, 64))
    (h,) = summarise(FrameStack(counts, 0.1)).histograms
    np.testing.assert_allclose(h.outlier_law.sum(-1), 1.0)
    assert (h.outlier_law >= 0).all() and (h.outlier_law[0, h.edges_dn.shape[1] :] > 0).all()
    assert not h.outlier_law[0, :-1][h.edges_dn[0] <= np.median(counts) - 1].any()


@pytest.mark.parametrize("cfa", ["mono", "BGGR"])
def test_lazy_stacks_give_the_same_summary(rng, cfa):
    counts = [dark_counts(rng, n, (8, 12), mean=mean) for n, mean in ((3, 40), (1, 60), (2, 300))]
    keywords = {"exposure_s": [0.1, 0.2, 0.1], "kind": ("dark", "dark", "flat"), "cfa": cfa, "white_level": 4095}
    stacks = [FrameStack([read(c) for c in counts], **keywords) for read in (np.asarray, lazy)]
    assert [stack.is_lazy(0) for stack in stacks] == [False, True]
    in_memory, from_lazy = map(summarise, stacks)
    assert jax.tree.structure(in_memory) == jax.tree.structure(from_lazy)
    jax.tree.map(np.testing.assert_array_equal, in_memory, from_lazy)


@pytest.mark.parametrize("cfa", ["mono", "RGGB"])
@pytest.mark.parametrize(("kind", "ends"), [("dark", 2), ("flat", 0)])
def test_frames_are_read_once_and_one_at_a_time(rng, cfa, kind, ends):
    """Beside the pass, the range of the bins is taken from the first and last frame."""
    alive, most, reads = 0, 0, 0

    def read():
        nonlocal alive, most, reads
        frame = dark_counts(rng, 1, (8, 12))[0]
        alive, reads = alive + 1, reads + 1
        most = max(most, alive)
        weakref.finalize(frame, gone)
        return frame

    def gone():
        nonlocal alive
        alive -= 1

    summarise(FrameStack(LazyFrames([read] * 9, (8, 12), np.uint16), 0.1, kind=kind, cfa=cfa))
    assert reads == 9 + ends
    assert alive == 0 and most <= 2  # the one before is let go when the next one has been read, at the latest


@st.composite
def any_counts(draw):
    low = draw(st.integers(0, 2**31 - 3))
    high = draw(st.integers(low + 1, min(low + draw(st.sampled_from([2, 100, 70_000, 2**31])), 2**31 - 1)))
    shape = draw(st.integers(2, 3)), *(2 * draw(st.integers(1, 3)) for _ in range(2))
    counts = draw(arrays(np.uint32, shape, elements=st.integers(low, high)))
    white_level = draw(st.none() | st.integers(low + 1, high + 1))
    assume((np.ptp(counts, axis=(1, 2)) > 0).all())
    assume(white_level is None or (counts >= white_level).mean((1, 2)).max() <= 0.5)
    return counts, white_level


@given(any_counts(), st.sampled_from(CFAS))
@pytest.mark.slow
def test_every_pixel_is_counted_once_whatever_the_range(capture, cfa):
    counts, white_level = capture
    summary = summarise(FrameStack(counts, 0.1, cfa=cfa, white_level=white_level))
    assert sum(h.counts.sum(dtype=np.int64) for h in summary.histograms) == counts.size
    assert all(h.counts.shape[-1] <= MOST_BINS for h in summary.histograms)
    assert sum(h.row_sum.sum() for h in summary.histograms) == counts.sum(dtype=np.int64)


@pytest.mark.parametrize("size", range(1, 200, 7))
def test_sizes_are_rounded_up_by_less_than_half(size):
    rounded = round_up(size)
    assert size <= rounded <= max(1.5 * size, 32)
    assert rounded in {2**k for k in range(4, 9)} | {3 * 2**k for k in range(3, 8)}


def test_some_frames_are_those_of_each_exposure(rng):
    counts = [dark_counts(rng, n, (8, 12)) for n in (4, 1, 2)]
    flat = dark_counts(rng, 3, (8, 12), mean=300)
    keywords = {"exposure_s": [0.1, 0.2, 0.3, 0.1], "kind": ("dark",) * 3 + ("flat",), "cfa": "RGGB"}
    summary = summarise(FrameStack([*counts, flat], **keywords))
    few = some_frames(summary, 0, 2)
    assert few.n_frames == (2, 1, 2)
    assert few.flats is summary.flats
    for cut, h in zip(few.histograms, summary.histograms, strict=True):
        assert cut.counts.shape == (3, 2, *h.counts.shape[2:])
        for e, one in enumerate(counts):
            for f, frame in enumerate(one[:2]):
                rows = pixels_of_rows(frame, "RGGB", h.channel)
                np.testing.assert_array_equal(cut.counts[e, f], [count_one_by_one(r, h.edges_dn[e]) for r in rows])
                np.testing.assert_array_equal(cut.row_sum[e, f], [r.sum() for r in rows])
        assert cut.outlier_law is h.outlier_law and cut.edges_dn is h.edges_dn
    jax.tree.map(np.testing.assert_array_equal, some_frames(summary, 0, 4), summary)
    late = some_frames(summary, 3, 5)  # one frame of the first exposure is left, and one of padding
    assert late.n_frames == (1, 0, 0)
    for cut, h in zip(late.histograms, summary.histograms, strict=True):
        np.testing.assert_array_equal(cut.counts[:, 0], h.counts[:, 3])
        assert cut.counts.shape[1] == 2 and not cut.counts[:, 1].any()


def test_every_nth_row_thins_the_rows_of_each_colour(rng):
    summary = summarise(FrameStack(dark_counts(rng, 2, (16, 12)), 0.1, cfa="RGGB"))
    thin = every_nth_row(summary, 4)
    for cut, h in zip(thin.histograms, summary.histograms, strict=True):
        np.testing.assert_array_equal(cut.counts, h.counts[:, :, ::4])
        assert cut.row_stride == 4 * h.row_stride


@pytest.mark.parametrize(
    ("cfa", "rows", "frames", "kept", "step"),
    [
        ("mono", 32, (9, 3), ([0, 3, 5, 8], [0, 1, 2]), 1),
        ("RGGB", 128, (4, 2), ([0, 3], [0, 1]), 4),
        ("RGGB", 126, (4, 2), ([0, 3], [0, 1]), 3),
    ],
)
def test_what_would_fill_memory_is_thinned_evenly(rng, monkeypatch, cfa, rows, frames, kept, step):
    counts = [dark_counts(rng, n, (rows, 12), mean=mean) for n, mean in zip(frames, (40, 60), strict=True)]
    stack = FrameStack(counts, [0.1, 0.2], cfa=cfa)
    whole = summarise(stack)
    mib = sum(h.counts.nbytes for h in whole.histograms) / 2**20
    monkeypatch.setattr(statistics, "MOST_MIB", mib * len(kept[0]) / frames[0] / step)
    summary = summarise(stack)
    assert summary.n_frames == tuple(map(len, kept))
    assert np.array_equal(np.add(summary.n_frames, summary.left_out), frames)
    for h, of in zip(summary.histograms, whole.histograms, strict=True):
        assert h.row_stride == step * of.row_stride
        for e, chosen in enumerate(kept):
            np.testing.assert_array_equal(h.row_sum[e, : len(chosen)], of.row_sum[e, chosen, ::step])
            np.testing.assert_array_equal(h.row_pixels[e, : len(chosen)], of.row_pixels[e, chosen, ::step])
    assert sum(h.counts.nbytes for h in summary.histograms) <= statistics.MOST_MIB * 2**20


def test_without_counts_all_else_remains(rng):
    summary = summarise(FrameStack(dark_counts(rng, 2, (8, 12)), 0.1, cfa="RGGB", black_level=8))
    light = without_counts(summary)
    for h, full in zip(light.histograms, summary.histograms, strict=True):
        assert h.counts is None and h.row_sum is None and h.row_sum_of_squares is None
        assert h.edges_dn is full.edges_dn and h.outlier_law is full.outlier_law
        assert (h.channel, h.row_stride) == (full.channel, full.row_stride)
    assert light.exposure_s is summary.exposure_s and light.n_frames == summary.n_frames


def simulated_flats(rng, cfa, light_e, frames, shape):
    """Counts [frame, row, column] of pixels that differ by PRNU, a lamp that flickers, white row gains by colour.

    Also the light of each frame and channel, e-, averaged over the pixels: [frame, channel].
    """
    channels = "RGB" if cfa != "mono" else ("mono",)
    tile = np.array([channels.index(c) for c in cfa]).reshape(2, 2) if cfa != "mono" else np.zeros((2, 2), int)
    channel = np.tile(tile, (shape[0] // 2, shape[1] // 2))
    response = 1 + PRNU * rng.standard_normal(shape)
    lamp = 1 + FLICKER * rng.standard_normal(frames)
    electrons = lamp[:, None, None] * (response * np.asarray(light_e)[channel])
    row_gain = 1 + ROW_SIGMA * rng.standard_normal((frames, shape[0], len(channels)))
    gain = GAIN * np.take_along_axis(row_gain, np.broadcast_to(channel, electrons.shape), 2)
    counts = BLACK_DN + gain * (rng.poisson(electrons) + READ_E * rng.standard_normal(electrons.shape))
    mean_e = np.stack([electrons[:, channel == c].mean(1) for c in range(len(channels))], axis=1)
    return np.rint(counts).astype(np.uint16), mean_e


@pytest.mark.parametrize(("cfa", "light_e"), [("mono", (4000.0,)), ("GRBG", (2500.0, 5000.0, 1200.0))])
def test_photon_transfer_of_flats_is_unbiased(rng, cfa, light_e):
    """Two levels; mean, variance within rows and power of row means, by their standard errors."""
    frames, shape = (8, 5), (160, 200)
    lights_e = np.outer((1.0, 0.2), light_e)
    flats = [simulated_flats(rng, cfa, one, n, shape) for n, one in zip(frames, lights_e, strict=True)]
    stack = FrameStack([counts for counts, _ in flats], [0.1, 0.02], kind="flat", cfa=cfa, black_level=BLACK_DN)
    measured = summarise(stack).flats
    planes = [pixels_of_rows(np.zeros(shape), cfa, c) for c in stack.channels]
    rows, pixels = np.array([(len(p), len(p[0])) for p in planes]).T
    for i, (n, (_, electrons)) in enumerate(zip(frames, flats, strict=True)):
        mean = BLACK_DN + GAIN * electrons.mean(0)
        variance = GAIN**2 * (1 + ROW_SIGMA**2) * (electrons.mean(0) + READ_E**2) + 1 / 12
        row_power = (GAIN * ROW_SIGMA) ** 2 * (electrons**2).mean(0) + variance / pixels
        np.testing.assert_allclose(measured.dof[i], (rows - 1) * (pixels - 1) * (n - 1))
        np.testing.assert_array_equal(measured.row_dof[i], (rows - 1) * (n - 1))
        np.testing.assert_array_equal(measured.row_pixels[i], pixels)
        errors = (
            (measured.mean_dn[i] - mean) / np.sqrt(row_power / (rows * n)),
            (measured.variance_dn2[i] / variance - 1) / np.sqrt(2 / measured.dof[i]),
            (measured.row_power_dn2[i] / row_power - 1) / np.sqrt(2 / measured.row_dof[i]),
        )
        np.testing.assert_array_less(np.abs(errors), 5.0)


def test_a_flat_of_one_frame_is_set_aside(rng):
    counts = [dark_counts(rng, 2, (8, 12)), dark_counts(rng, 1, (8, 12), mean=300)]
    stack = FrameStack(counts, [0.1, 0.25], kind=("dark", "flat"))
    flats = summarise(stack).flats
    assert flats.mean_dn.shape == (0, 1) and "0.25 s) is set aside: a single frame" in flats.set_aside[0]
    singles = [dark_counts(rng, 1, (8, 12), mean=mean) for mean in (300, 900)]
    with pytest.raises(ValueError, match="flats: none can be used"):
        summarise(FrameStack(singles, [0.1, 0.25], kind="flat"))
