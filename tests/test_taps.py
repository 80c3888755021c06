"""Outputs that read blocks of the frame, found and measured by fits that follow each pixel; frames by NumPy alone."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise

SHAPE, FRAMES = (120, 256), 8


def blocks(values):
    """Values [block row, block column] of each pixel."""
    values = np.asarray(values)
    row, column = (np.arange(n) * of // n for n, of in zip(SHAPE, values.shape, strict=True))
    return values[row[:, None], column]


def camera(gains, offsets, rng, *, light=(), exposures=(0.0,), cfa="mono", more=0.0, gain=None):
    """Darks of some exposures and flats of a sensor with 8 e- of read noise and pixels that differ."""
    gain, offset = blocks(gains) if gain is None else gain, blocks(offsets) + rng.normal(0, 0.5, SHAPE) + more
    dark, response = rng.lognormal(0, 0.5, SHAPE), 1 + 0.01 * rng.standard_normal(SHAPE)

    def frames(signal, n):
        electrons = rng.poisson(np.broadcast_to(signal, (n, *SHAPE))) + 8 * rng.standard_normal((n, *SHAPE))
        return np.round(500 + offset + gain * electrons).astype(np.uint16)

    counts = [frames(dark * t, FRAMES) for t in exposures] + [frames(response * e, 2) for e in light]
    kind = ["dark"] * len(exposures) + ["flat"] * len(light)
    return hsnoise.FrameStack(counts, [*exposures, *[1.0] * len(light)], kind=kind, cfa=cfa)


QUARTERS = [[0.80, 0.92], [0.68, 0.84]]


@pytest.mark.parametrize(
    "known",
    [
        {"light": (2000, 8000)},
        pytest.param({"exposures": (0.0, 30.0, 300.0)}, marks=pytest.mark.slow),
        pytest.param({"light": (2000, 8000), "cfa": "RGGB"}, marks=pytest.mark.slow),
    ],
    ids=["flats", "darks", "Bayer"],
)
def test_the_gain_of_each_quarter(known, rng):
    fit = hsnoise.fit(camera(QUARTERS, [[0, 20], [-20, 10]], rng, **known))
    taps, truth = fit.transfer.taps, np.array(QUARTERS) / np.mean(QUARTERS)
    assert (taps.rows, taps.columns) == (2, 2)
    assert (np.abs(taps.gain - truth) < 4 * taps.gain_error).all() and taps.gain_error.max() < 0.03
    assert np.abs(taps.offset_dn - [[-2.5, 17.5], [-22.5, 7.5]]).max() < 1.0  # of the dark signal, where there is some
    assert {"tap_offsets", "tap_gains"} <= set(fit.added)
    assert not {"row_fixed_pattern", "column_fixed_pattern", "black_shading"} & set(fit.added)
    assert (fit.params["tap_gains"].taps, fit.params["tap_gains"].row_taps) == (2, 2)
    doubt = next(one for one in fit.doubts if "gains differ" in one)
    assert doubt.startswith("2 x 2 outputs") and "--roi 0:60,0:128" in doubt


def test_uneven_light_is_no_gain(rng):
    """Light that falls by half over each output, in another direction, and columns that see none."""
    x = np.arange(SHAPE[1]) / SHAPE[1]
    light = (
        np.array([2000, 8000])[:, None, None]
        * (1 - 0.5 * (x > 0.5) * (2 * x - 1))
        * np.linspace(1, 0.6, SHAPE[0])[:, None]
    )
    light[..., :6] = light[..., 126:130] = 0
    stack = camera(np.ones((2, 2)), [[0, 200], [-150, 60]], rng, light=list(light))
    fit = hsnoise.fit(stack)
    assert np.abs(fit.transfer.taps.gain - 1).max() < 4 * fit.transfer.taps.gain_error.max() < 0.06
    assert "tap_gains" not in fit.added
    assert abs(fit.table["gain"][0] - 1) < 4 * fit.table["gain"][1]


@pytest.mark.parametrize("layout", [(1, 4), (2, 2)])
def test_outputs_that_wander_from_frame_to_frame(layout):
    """Each on its own; no row, column or frame noise is left of it, and none is seen where outputs keep still."""
    wander, n = 4.0, 12
    for sigma in (wander, 0.0):
        rng = np.random.default_rng(7)
        static = 500 + blocks(30 * rng.standard_normal(layout)) + rng.normal(0, 0.5, SHAPE)
        moving = np.array([blocks(sigma * rng.standard_normal(layout)) for _ in range(n)])
        counts = np.rint(static + moving + 8 * rng.standard_normal((n, *SHAPE))).astype(np.uint16)
        flats = np.rint(static + rng.poisson(2000, (2, *SHAPE)) + 8 * rng.standard_normal((2, *SHAPE)))
        stack = hsnoise.FrameStack([counts, flats.astype(np.uint16)], [0.0, 1.0], kind=["dark", "flat"])
        fit = hsnoise.fit(stack)
        taps = fit.params["tap_offsets"]
        assert (taps.row_taps, taps.taps) == layout
        if sigma == 0:
            assert float(taps.frame_sigma) == 0 and "tap_offsets.frame_sigma" not in fit.names
            continue
        value, error, unit = fit.table["tap_offsets.frame_sigma"]
        assert unit == "e-" and abs(value - wander) < 4 * error < 4.0
        for name in ("row_noise", "column_noise", "frame_offset"):
            assert name not in fit.added or fit.table[f"{name}.sigma"][0] < 0.4 * wander


def test_single_darks_beside_repeated_ones_show_no_signal_that_is_not_there(rng):
    """Offsets of outputs lie far apart: half of the pixels above the gap, half below."""
    stack = camera(np.ones((2, 2)), [[-50, 180], [40, -170]], rng, exposures=(1.0, 12.0), light=(2000,), gain=1.0)
    counts, drift = [stack.counts[0], stack.counts[1][:1], stack.counts[2]], np.rint(3 * rng.standard_normal(FRAMES))
    counts[0] = (counts[0] + drift[:, None, None]).astype(np.uint16)
    fit = hsnoise.fit(hsnoise.FrameStack(counts, [1.0, 12.0, 1.0], kind=["dark", "dark", "flat"]))
    rate, error = fit.table["dark_current.rate"][:2]
    assert abs(rate - 1.0) < 4 * error < 2.0
    assert "hot_pixels" not in fit.added


def test_outputs_that_are_alike_but_for_offsets_are_no_doubt(rng):
    """Beside columns that differ, too."""
    columns = rng.normal(0, 0.5, (1, SHAPE[1]))
    fit = hsnoise.fit(camera([[0.8] * 4], [[0, 6, -4, 3]], rng, light=(2000, 8000), more=columns))
    assert "tap_offsets" in fit.added and "tap_gains" not in fit.added
    assert not any("outputs" in doubt for doubt in fit.doubts)
    assert any(note.startswith("1 x 4 outputs read blocks") for note in fit.notes)
    value, error, _ = fit.table["column_fixed_pattern.sigma"]
    assert abs(value - columns.std() / 0.8) < 4 * error


@pytest.mark.parametrize("more", ["drift", "columns", "step elsewhere", "nothing"])
def test_one_output_has_no_seam(more, rng):
    column = np.arange(SHAPE[1])
    shapes = {
        "drift": 30 * np.exp(-column / 40),
        "columns": rng.normal(0, 5, SHAPE[1]),
        "step elsewhere": 10.0 * (column > 140),
        "nothing": 0.0 * column,
    }
    fit = hsnoise.fit(camera([[0.8]], [[0.0]], rng, more=shapes[more]), pixels="differ")
    assert fit.transfer.taps is None


@pytest.mark.parametrize("window", [None, (0, 40, *SHAPE)], ids=["unknown", "known"])
def test_a_part_of_the_sensor_has_no_halves(window, rng):
    whole = camera(QUARTERS, [[0, 20], [-20, 10]], rng)
    part = whole.select(rows=(0, 100), columns=(40, 192) if window is None else (40, 216))
    stack = part if window is None else part.with_counts(part.counts, window)
    assert hsnoise.fit(stack, pixels="differ").transfer.taps is None


@pytest.mark.parametrize("known", [{"light": (2000, 8000)}, {"exposures": (0.0, 30.0, 300.0)}], ids=["flats", "darks"])
def test_even_and_odd_columns_of_two_converters(known, rng):
    """Their gains are 8 % below and above the mean; the noise differs, too."""
    odd = np.broadcast_to(np.arange(SHAPE[1]) % 2, SHAPE)
    fit = hsnoise.fit(camera([[0.8]], [[0.0]], rng, gain=np.where(odd, 0.864, 0.736), more=1.5 * odd, **known))
    value, error, _ = fit.table["odd_even_pattern.gain_mismatch"]
    assert abs(value - 0.16) < 4 * error < 0.1
    assert abs(fit.params["odd_even_pattern"].offset - 1.5 / 0.8) < 0.3
    assert "column_fixed_pattern" not in fit.added
    assert any("Even and odd columns differ as if outputs of their own read them" in doubt for doubt in fit.doubts)


@pytest.mark.parametrize("seed", range(3))
def test_levels_on_a_lattice_have_no_seam(seed):
    """Medians of means of six counts are all the same; a step of 5e-6 DN had been larger than any other (IMX541)."""
    rng = np.random.default_rng(seed)
    offsets = 10.3 + 0.07 * rng.standard_normal((160, 400))
    counts = np.round(offsets + 0.87 * rng.standard_normal((6, 160, 400))).clip(0).astype(np.uint16)
    assert hsnoise.fit(counts, exposure_s=0.0, pixels="differ").transfer.taps is None
