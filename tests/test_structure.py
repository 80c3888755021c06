"""Statistics that tell effects apart: the same for every capture of one layout, zero where nothing is, and sharp."""

from __future__ import annotations

import time
from functools import cache

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise.effects import (
    AdcNonuniformity,
    AmplifierGlow,
    BlackClamp,
    BlackShading,
    ColumnFixedPattern,
    ColumnNoise,
    CosmicRays,
    Crosstalk,
    DarkCurrentNonuniformity,
    DarkSignalNonuniformity,
    FrameOffset,
    FrameTilt,
    HeavyTailedReadNoise,
    HotPixels,
    ImageLag,
    MissingCodes,
    OddEvenPattern,
    PeriodicBanding,
    RandomTelegraphNoise,
    ReadNoiseNonuniformity,
    ReadoutBandwidth,
    ReadoutOvershoot,
    RowBankNoise,
    RowFixedPattern,
    RowGroupNoise,
    RowNoise,
    SharedRowGain,
    TapOffsets,
)
from hsnoise.model import NoiseModel
from hsnoise.statistics import _anova
from hsnoise.statistics.structure import code_step, moving_line, places, structure

SHAPE, FRAMES, EXPOSURE_S = (96, 128), 6, (0.01, 0.03, 0.1, 0.2)
CLEAN = 12
CAMERAS = {
    "grasshopper3": (hsnoise.cameras.grasshopper3(black_level_dn=64.0), 64.0),
    "canon_5d3": (hsnoise.cameras.canon_5d3(), 0.0),
}


def model_with(camera, effect):
    """The camera, with one effect more: it leaves the draws of the others as they are."""
    model, _ = CAMERAS[camera]
    return model if effect is None else model.add(effect)


def draw(camera, effect=None, seed=0):
    model, black = model_with(camera, effect), CAMERAS[camera][1]
    key, sensor = jax.random.key(seed), jax.random.key(1000 + seed)
    counts = []
    for i, t in enumerate(EXPOSURE_S):
        of = jax.random.fold_in(key, i)
        frames = hsnoise.sample_dark(of, FRAMES, SHAPE, model, exposure_s=np.float32(t), sensor_key=sensor)
        counts.append(np.asarray(frames))
    stack = hsnoise.FrameStack(counts, EXPOSURE_S, black_level=black, cfa="RGGB", shutter=model.shutter)
    return structure(stack, np.full(3, black))


@cache
def clean(camera):
    """(mean, spread) of the statistics of clean draws, by name."""
    draws = [draw(camera, seed=seed) for seed in range(CLEAN)]
    values = np.stack([d.values for d in draws])
    spread = np.maximum(values.std(0, ddof=1), draws[0].error)
    return draws[0].names, values.mean(0), spread


def noise(rng, frames, shape, cfa="mono", *, mean=100.0, sigma=4.0, exposure_s=None, black=64.0):
    """A capture of independent normal pixels, DN."""
    counts = [np.clip(np.rint(rng.normal(mean, sigma, (n, *shape))), 0, None).astype(np.uint16) for n in frames]
    times = np.arange(1, len(frames) + 1) / 100 if exposure_s is None else exposure_s
    return hsnoise.FrameStack(counts, times, black_level=black, cfa=cfa)


LAYOUTS = {
    "mono": ((4, 4), (64, 96), "mono"),
    "one exposure": ((9,), (64, 64), "GBRG"),
    "one exposure, two frames": ((2,), (66, 70), "RGGB"),
    "single frames": ((1, 1, 1), (64, 64), "BGGR"),
    "two single frames, mono": ((1, 1), (65, 71), "mono"),
    "ragged": ((1, 2, 3, 7, 12), (64, 82), "GRBG"),
    "eight exposures": ((3,) * 8, (64, 64), "RGGB"),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_names_depend_on_the_layout_only(name, rng):
    frames, shape, cfa = LAYOUTS[name]
    captures = [
        (noise(rng, frames, shape, cfa), 64.0),
        (noise(rng, frames, shape, cfa, mean=-3.0, black=0.0), 0.0),  # clipped: most counts are zero
        (noise(rng, frames, shape, cfa, mean=6e4, sigma=3e3, black=0.0), 0.0),
        (noise(rng, frames, shape, cfa, mean=64.0, sigma=0.2), 64.0),  # coarse codes
    ]
    found = [structure(stack, np.array(black)) for stack, black in captures]
    for one in found:
        assert one.names == found[0].names and one.groups == found[0].groups and one.skipped == found[0].skipped
        assert len(set(one.names)) == len(one.names) == len(one.groups) == len(one.values) == len(one.error)
        assert np.isfinite(one.values).all() and np.isfinite(one.error).all() and (one.error > 0).all()


@pytest.mark.parametrize("cfa", ["mono", "RGGB", "BGGR", "GRBG", "GBRG"])
def test_white_noise_is_within_its_errors(cfa, rng):
    """Normal pixels: log ratios and correlations lie around zero, by about their analytic errors."""
    found = structure(noise(rng, (8, 8, 8), (96, 128), cfa), np.array(64.0))
    some = [i for i, n in enumerate(found.names) if any(w in n for w in ("correlation", "away", " / ", "coherence"))]
    z = found.values[some] / found.error[some]
    assert len(z) > 50 and np.abs(z).max() < 5.5
    assert np.sqrt(np.mean(z**2)) < 1.6


def test_flats_change_nothing_of_darks_and_darks_are_sorted(rng):
    one = noise(rng, (4, 3, 5), (64, 64), "RGGB", exposure_s=[0.3, 0.1, 0.2])
    sorted_ = one.select(exposures=[1, 2, 0])
    flat = hsnoise.FrameStack(one.counts[0] + 500, [0.1], black_level=64.0, cfa="RGGB", kind="flat")
    expected = structure(sorted_, np.full(3, 64.0))
    for stack in (one, hsnoise.FrameStack.join(flat, one)):
        found = structure(stack, np.full(3, 64.0))
        darks = [i for i, group in enumerate(found.groups) if not group.startswith("flats")]
        assert tuple(found.names[i] for i in darks) == expected.names
        np.testing.assert_array_equal(found.values[darks], expected.values)


def test_no_dark_exposure_is_refused(rng):
    flat = hsnoise.FrameStack(noise(rng, (2,), (64, 64)).counts, [0.1], kind="flat")
    with pytest.raises(ValueError, match="dark exposure"):
        structure(flat, np.array(64.0))


def test_large_captures_are_cut_and_say_so(rng, monkeypatch):
    stack = noise(rng, (9, 9), (96, 160), "RGGB")
    monkeypatch.setattr(_anova, "MOST_FRAME_PIXELS", 64 * 96)
    monkeypatch.setattr(_anova, "MOST_PIXELS", 6 * 64 * 96)
    layout = _anova.layout_of(stack)
    rows, columns = layout.rows, layout.columns
    assert (rows.stop - rows.start) * (columns.stop - columns.start) <= 64 * 96
    assert all(n % 4 == 0 for n in (rows.start, rows.stop, columns.start, columns.stop))
    said = " ".join(structure(stack, np.full(3, 64.0)).skipped)
    assert "columns" in said and "frames" in said


def test_colours_and_levels_are_those_of_the_planes(rng):
    """A Bayer capture whose colours differ gives each colour its own mean, in every order."""
    level = {"R": 80.0, "G": 90.0, "B": 120.0}
    for cfa in ("RGGB", "BGGR", "GRBG", "GBRG"):
        tile = np.array([level[letter] for letter in cfa]).reshape(2, 2)
        counts = np.rint(rng.normal(np.tile(tile, (32, 32)), 2.0, (3, 64, 64))).astype(np.uint16)
        found = structure(hsnoise.FrameStack(counts, [0.1], cfa=cfa), np.array([60.0, 64.0, 70.0]))
        values = dict(zip(found.names, found.values, strict=True))
        got = [values[f"level: mean above black, DN, {c}, all frames"] for c in "RGB"]
        np.testing.assert_allclose(got, [20.0, 26.0, 50.0], atol=0.15)


@pytest.mark.parametrize(
    "camera", [pytest.param(name, marks=pytest.mark.slow if name == "grasshopper3" else ()) for name in CAMERAS]
)
def test_clean_draws_have_no_correlations(camera):
    names, mean, spread = clean(camera)
    words = ("correlation of exposures", "correlation, same", " away", "coherence")
    some = [i for i, name in enumerate(names) if any(word in name for word in words)]
    # Row gains weigh rows: what a sum of zero takes from correlations is then known to a few thousandths only.
    z = np.abs(mean[some]) / (4.5 * spread[some] / np.sqrt(CLEAN) + 0.004)
    assert len(z) > 40
    assert z.max() < 1, names[some[int(np.argmax(z))]]


# Effect, the statistic that must react, and its direction.
REACTIONS = [
    (SharedRowGain(0.3, 1.0), "row x frame: correlation, same row of G-R, long exposures", 1),
    (RowNoise(1.5), "row x frame: correlation, same row of G-R, short exposures", 1),
    (RowBankNoise(1.5, 1.2), "row x frame: correlation with the next row but one of the colour, short exposures", 1),
    (RowGroupNoise(1.5, 0.0, 8, 2), "row x frame: rows read together, short exposures", 1),
    (FrameTilt(2.0), "row x frame: tilt of the frames, short exposures", 1),
    (FrameTilt(2.0, "column"), "column x frame: tilt of the frames, short exposures", 1),
    (ColumnNoise(1.0), "column x frame: correlation, same column, short exposures", 1),
    (RowFixedPattern(1.0), "static rows: correlation of exposures, profile, short and short", 1),
    (ColumnFixedPattern(0.6), "static columns: correlation of exposures, profile, short and long", 1),
    (FrameOffset(0.6), "frames over time: frame mean / pixel, short exposures", 1),
    (DarkSignalNonuniformity(1.5), "static pixels: correlation of exposures, map, short and short", 1),
    (HotPixels(0.005, 2000.0), "static pixels: pixels of the map above 7 sigma, long exposures", 1),
    (AmplifierGlow(40.0, 0.3), "blocks: static map, mixed low-order shape, long exposures", 1),
    (DarkCurrentNonuniformity(0.2), "static pixels: pixel / residual, long exposures", 1),
    (RandomTelegraphNoise(0.05, 12.0, 0.4), "pixels over time: correlation of exposures, variance, short and short", 1),
    (HeavyTailedReadNoise(4.0), "tails: log kurtosis, G, short exposures", 1),
    (ReadNoiseNonuniformity(0.4), "pixels over time: correlation of exposures, log variance, short and short", 1),
    (PeriodicBanding(1.5, 0.13), "row spectrum: peak of the spectrum, short exposures", 1),
    (Crosstalk(0.04), "spatial lags: residual, 1 row away, long exposures", 1),
    (ReadoutOvershoot(0.06), "spatial lags: residual, 1 column away, short exposures", -1),
    (ReadoutBandwidth(0.06), "spatial lags: residual, 1 column away, short exposures", 1),
    (ImageLag(0.1), "pixels over time: residual, next frame, long exposures", 1),
    (OddEvenPattern(1.0), "static columns: parity, short exposures", 1),
    (TapOffsets(1.0, taps=4), "static columns: steps of 8, short exposures", 1),
    (BlackShading(1.0, 0.4), "static columns: low-order shape, short exposures", 1),
    (AdcNonuniformity(0.3), "codes: roughness of the histogram, long exposures", 1),
    (MissingCodes(1.7), "codes: roughness of the histogram, long exposures", 1),
    (CosmicRays(1500.0, 500.0), "pixels over time: pixels with 1 outliers", 1),
    (BlackClamp([70.0, 60.0, 65.0]), "level: mean above black, DN, G, long exposures", -1),
]


# In seconds each; other tests draw their effects.
LONG = ("shared_row_gain",)


@pytest.mark.parametrize(
    ("effect", "name", "sign"),
    [pytest.param(*one, id=one[0].name, marks=[pytest.mark.slow] if one[0].name in LONG else []) for one in REACTIONS],
)
def test_statistic_reacts_to_its_effect(effect, name, sign):
    names, mean, spread = clean("grasshopper3")
    found = draw("grasshopper3", effect, seed=100)
    i = names.index(name)
    assert found.names == names
    assert sign * (found.values[i] - mean[i]) > 5 * spread[i]


def test_noise_that_comes_in_bursts_of_rows_is_told(rng):
    shape = (96, 128)
    plain = noise(rng, (8, 8), shape)
    counts = []
    for exposure in plain.counts:
        row, start = np.arange(shape[0])[None, :, None], rng.integers(0, 80, (8, 1, 1))
        burst = (row >= start) & (row < start + 15)
        counts.append(np.rint(exposure + burst * rng.normal(0, 3.0, exposure.shape)).clip(0).astype(np.uint16))
    hit = hsnoise.FrameStack(counts, plain.exposure_s, black_level=64.0)
    found, clean = structure(hit, np.array(64.0)), structure(plain, np.array(64.0))
    for what, least in (("spread", 5), ("next row", 5)):
        i = found.names.index(f"blocks: noise of rows, {what}, short exposures")
        assert abs(clean.values[i]) < 4 * clean.error[i]
        assert found.values[i] > least * found.error[i]


def test_frames_that_remember_the_one_before_are_told(rng):
    plain = noise(rng, (8, 8), (96, 128))
    offset = 2.0 * (-1.0) ** np.arange(8)[:, None, None]
    counts = [np.rint(exposure + offset).clip(0).astype(np.uint16) for exposure in plain.counts]
    hit = hsnoise.FrameStack(counts, plain.exposure_s, black_level=64.0)
    found, clean = structure(hit, np.array(64.0)), structure(plain, np.array(64.0))
    i = found.names.index("frames over time: frame mean, next frame, short exposures")
    assert abs(clean.values[i]) < 3 * clean.error[i]
    assert found.values[i] < -3 * found.error[i]


# At half a cycle a line, the colours of a Bayer sensor see an offset, not a line.
LINES = [(cfa, *line) for cfa in ("mono", "RGGB") for line in (("row", 0.288), ("column", 0.041), ("column", 0.3333))]


@pytest.mark.parametrize(("cfa", "axis", "frequency"), [*LINES, ("mono", "row", 0.5), ("RGGB", "row", 0.48)])
def test_the_strongest_line_is_found_to_a_part_of_a_cycle(cfa, axis, frequency, rng):
    capture = noise(rng, (6, 6), (94, 110), cfa, sigma=8.0)
    n = capture.shape[0 if axis == "row" else 1]
    phase = rng.uniform(0, 2 * np.pi, (2, 6, 1))
    if frequency == 0.5:  # a phase in between would be a smaller amplitude
        phase = np.pi * np.rint(phase / np.pi)
    wave = 6 * np.cos(2 * np.pi * frequency * np.arange(n) + phase)
    wave = wave[..., :, None] if axis == "row" else wave[..., None, :]
    counts = [np.rint(capture.counts[i] + wave[i]).clip(0).astype(np.uint16) for i in range(2)]
    draws = [noise(rng, (6, 6), (94, 110), cfa, sigma=8.0) for _ in range(6)]
    found = moving_line(hsnoise.FrameStack(counts, (0.01, 0.02), black_level=64.0, cfa=cfa), draws, np.array(64.0))
    assert found[0] == axis
    assert abs(found[1] - frequency) < 0.15 / n


@pytest.mark.parametrize("cfa", ["mono", "RGGB"])
@pytest.mark.parametrize("spot", [(0.0, 1.0), (1.0, 0.0), (0.5, 0.0), (1.0, 0.5)])
def test_a_glow_is_found_in_its_corner_beside_hot_pixels(cfa, spot, rng):
    capture = noise(rng, (4, 4), (96, 128), cfa, sigma=8.0)
    r, c = np.mgrid[:96, :128]
    far = np.hypot(r - spot[0] * 95, c - spot[1] * 127) / np.hypot(96, 128)
    light = 12 * np.exp(-far / 0.25) + 300 * (rng.random((96, 128)) < 0.01)
    counts = [np.rint(capture.counts[i] + share * light).astype(np.uint16) for i, share in enumerate((0.1, 1.0))]
    assert places(hsnoise.FrameStack(counts, (0.01, 0.1), black_level=64.0, cfa=cfa)).glow == spot


@pytest.mark.parametrize("cfa", ["mono", "RGGB"])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_chain_that_reads_more_is_found(cfa, sign, rng):
    capture = noise(rng, (4, 4), (96, 128), cfa, sigma=8.0)
    model = NoiseModel([OddEvenPattern(sign * 1.0)], cfa=cfa, shutter="global", exposure_s=0.1)
    drawn = np.asarray(hsnoise.sample_dark(jax.random.key(0), 1, (96, 128), model))
    counts = [np.rint(frames + drawn).astype(np.uint16) for frames in capture.counts]
    assert places(hsnoise.FrameStack(counts, (0.01, 0.1), black_level=64.0, cfa=cfa)).second_chain == sign


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("time_constant", [0.5, 20.0])
def test_the_sign_of_a_level_that_settles_is_found(sign, time_constant, rng):
    capture = noise(rng, (5, 5), (48, 64), "mono", sigma=8.0)
    level = sign * 6 * np.exp(-np.arange(5) / time_constant)[:, None, None]
    counts = [np.rint(frames + level).astype(np.uint16) for frames in capture.counts]
    assert places(hsnoise.FrameStack(counts, (0.01, 0.1), black_level=64.0, cfa="mono")).settling == sign


@pytest.mark.parametrize("cfa", ["mono", "RGGB"])
@pytest.mark.parametrize("axis", ["row", "column"])
@pytest.mark.parametrize(("start", "above"), [("first", True), ("first", False), ("last", True)])
def test_shading_is_found_with_its_side_and_direction(cfa, axis, start, above, rng):
    capture = noise(rng, (4, 4), (94, 110), cfa, sigma=8.0)
    n = capture.shape[0 if axis == "row" else 1]
    bent = np.exp(-np.arange(n) / (0.1 * n))[:: 1 if start == "first" else -1]
    bent = 8 * bent * (1 if above else -1)
    bent = bent[:, None] if axis == "row" else bent[None]
    counts = [np.rint(capture.counts[i] + bent).clip(0).astype(np.uint16) for i in range(2)]
    found = places(hsnoise.FrameStack(counts, (0.01, 0.02), black_level=64.0, cfa=cfa)).shading
    assert found[:3] == (axis, start, above)
    assert 0.05 < found[3] < 0.2


def test_a_weak_line_is_found_beside_the_alternation_of_colours():
    """Rows of a Bayer sensor whose colours have 1/f gains of their own: their spectrum rises to half a cycle."""
    model, black, times = CAMERAS["canon_5d3"][0], np.zeros(3), (0.02, 0.1)

    def darks(of, seed):
        keys = jax.random.split(jax.random.key(seed), 2)
        drawn = [hsnoise.sample_dark(k, 8, (160, 128), of, exposure_s=t) for k, t in zip(keys, times, strict=True)]
        counts = [np.asarray(frames) for frames in drawn]
        return hsnoise.FrameStack(counts, times, black_level=0.0, cfa="RGGB")

    draws = [darks(model, seed) for seed in range(6)]
    for seed, frequency in ((10, 0.113), (11, 0.241), (12, 0.377)):
        axis, found = moving_line(darks(model.add(PeriodicBanding(0.5, frequency)), seed), draws, black)
        assert (axis, abs(found - frequency) < 0.3 / 160) == ("row", True)


@pytest.mark.parametrize("step", [1.1, 1.3, 1.6, 2.0, 2.75])
@pytest.mark.parametrize("black", [0.0, 512.0])
def test_the_distance_of_codes_is_found(step, black, rng):
    whole = noise(rng, (4, 4), (64, 64), mean=black + 40.0, sigma=12.0, black=black)
    counts = [np.rint(np.rint(c.astype(float) / step) * step).astype(np.uint16) for c in whole.counts]
    found = code_step(hsnoise.FrameStack(counts, (0.01, 0.02), black_level=black, cfa="mono"))
    assert found is not None
    assert abs(found - step) < 1 / (black + 60)
    assert code_step(whole) is None


def test_crosstalk_is_seen_both_ways_and_bandwidth_along_the_row_only():
    names, mean, spread = clean("grasshopper3")
    lags = ("1 column", "1 row")
    along, across = (names.index(f"spatial lags: residual, {lag} away, long exposures") for lag in lags)
    for effect, both in ((Crosstalk(0.04), True), (ReadoutBandwidth(0.06), False)):
        z = (draw("grasshopper3", effect, seed=100).values - mean) / spread
        assert z[along] > 5
        assert (z[across] > 5) == both


@pytest.mark.slow
def test_row_gain_of_all_colours_grows_with_signal_and_row_noise_does_not():
    names, mean, spread = clean("grasshopper3")
    low, high = (
        names.index(f"row x frame: correlation, same row of G-R, {half} exposures") for half in ("short", "long")
    )
    noise_, gain = (draw("grasshopper3", e, seed=100).values - mean for e in (RowNoise(1.5), SharedRowGain(0.3)))
    assert noise_[low] > noise_[high] + 5 * spread[high]
    assert gain[high] > gain[low] + 5 * spread[high]


@pytest.mark.benchmark
def test_a_small_capture_takes_a_moment(rng):
    stack = noise(rng, (8,) * 4, (160, 240), "RGGB")
    structure(stack, np.full(3, 64.0))
    start = time.process_time()
    structure(stack, np.full(3, 64.0))
    assert time.process_time() - start < 0.08
