"""Stuck and dead pixels: they are no noise, in compare as in fits, and nothing that is noise is taken for one."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise import FrameStack
from hsnoise.simulation.defects import MOST, without_defects
from hsnoise.statistics.pixels.flags import FLAGS, flags_of
from hsnoise.statistics.pixels.survey import survey

GAIN, READ_E, BLACK_DN, WHITE_DN, SHAPE = 0.5, 5.0, 64.0, 4095, (96, 128)
PRNU, DSNU_DN = 0.01, 2.0


def drawn(rng, lights=(0.0, 2000.0), frames=(8, 2), shape=SHAPE, read_dn=GAIN * READ_E):
    """Counts of each light [frame, row, column]."""
    response = 1 + PRNU * rng.standard_normal(shape)
    offset = BLACK_DN + DSNU_DN * rng.standard_normal(shape)
    out = []
    for light, n in zip(lights, frames, strict=True):
        electrons = rng.poisson(light * response, (n, *shape)) if light else np.zeros((n, *shape))
        counts = offset + GAIN * electrons + read_dn * rng.standard_normal(electrons.shape)
        out.append(np.clip(np.rint(counts), 0, WHITE_DN).astype(np.uint16))
    return out


def spoiled(rng, counts, share):
    """One half of the chosen pixels stuck at some count, the other half with the counts of the dark."""
    chosen = rng.random(counts[0].shape[1:]) < share
    stuck = chosen & (rng.random(chosen.shape) < 0.5)
    stuck_at = rng.integers(0, WHITE_DN, stuck.sum())
    for some in counts:
        some[:, chosen] = np.rint(BLACK_DN + GAIN * READ_E * rng.standard_normal((len(some), chosen.sum())))
        some[:, stuck] = stuck_at
    return chosen


@pytest.mark.parametrize("tile", [1, 2])
def test_stuck_and_dead_pixels_are_found_and_a_neighbour_of_their_colour_stands_in(rng, tile):
    counts = drawn(rng)
    colour = np.indices(SHAPE)[1] % tile
    for some in counts:
        some += (300 * colour).astype(np.uint16)
    before = [some.copy() for some in counts]
    bad = spoiled(rng, counts, 2e-3)
    changes = bad & np.any([(some != some[0]).any(0) for some in counts], axis=0)
    for some, clean in zip(counts, before, strict=True):
        some[:, changes] += (300 * colour[changes]).astype(np.uint16)
        assert np.array_equal(some[:, ~bad], clean[:, ~bad])
    out, said = without_defects(counts, ("dark", "flat"), tile)
    for some, given in zip(out, counts, strict=True):
        assert np.array_equal(some[:, ~bad], given[:, ~bad])
        assert (np.abs(some.mean(0) - given.mean((0, 1), where=~bad)) < 250).all()
    assert f"{bad.sum()} pixels" in said[0]


@pytest.mark.parametrize("read_dn", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("frames", [(2, 2), (16, 2)], ids=str)
def test_noise_that_is_narrow_by_chance_is_no_defect(rng, read_dn, frames):
    counts = drawn(rng, (0.0, 20.0), frames, read_dn=read_dn)
    out, said = without_defects(counts, ("dark", "flat"), 1)
    assert not said and all(np.array_equal(*pair) for pair in zip(out, counts, strict=True))


def test_too_many_to_be_exceptions_stay_and_are_told(rng):
    counts = drawn(rng)
    spoiled(rng, counts, 2 * MOST)
    out, said = without_defects(counts, ("dark", "flat"), 1)
    assert all(np.array_equal(*pair) for pair in zip(out, counts, strict=True)) and "too many" in said[0]


def test_a_whole_row_of_defects_has_no_stand_in_and_stays(rng):
    counts = drawn(rng)
    for some in counts:
        some[:, 40] = 30
    out, _ = without_defects(counts, ("dark", "flat"), 1)
    assert all(np.array_equal(*pair) for pair in zip(out, counts, strict=True))


def test_defects_and_saturated_levels_change_neither_the_fit_nor_the_verdict(rng):
    """A right fit was red with an error of 2800 for 0.02 %, the photo response 5 % and offsets 10 % too large."""
    lights = (0.0, *np.linspace(0.1, 1.3, 9) * (WHITE_DN - BLACK_DN) / GAIN)
    counts = drawn(rng, lights, (8, *[2] * 9))
    spoiled(rng, counts, 1e-3)
    kind, exposure_s = ["dark"] + ["flat"] * 9, np.linspace(0.01, 0.1, 10)
    stack = FrameStack(counts, exposure_s, kind=kind, shutter="global")
    fit = hsnoise.fit(stack)
    for name, truth in (
        ("gain", GAIN),
        ("read_noise.sigma", READ_E),
        ("photo_response_nonuniformity.sigma", PRNU),
        ("dark_signal_nonuniformity.sigma", DSNU_DN / GAIN),
        ("row_gain.sigma", 0.0),
    ):
        value, error = fit.table[name][:2]
        assert 1e-6 < error < max(0.03 * truth, 0.002) and abs(value - truth) < 4 * error, (name, value, error)
    flags = flags_of(survey(stack), 0)
    assert all((flags & FLAGS[name]).any() for name in ("stuck", "dead"))
    assert not ((flags & FLAGS["stuck"] > 0) & (flags & FLAGS["dead"] > 0)).any()  # one count in light and dark
    found = hsnoise.compare(fit, stack)
    assert found.error < 4 and any("stuck or dead" in sentence for sentence in found.skipped)


def test_many_frames_make_no_telegraph_pixels_of_pixels_that_differ():
    """The variance of pixels of one level differs visibly in 300 frames: by their offsets, and their noise by 10 %."""
    rng = np.random.default_rng(8)
    shape = (32, 48)
    signal, offset = rng.gamma(4, 5, shape), rng.normal(100, 2, shape)
    sigma = np.sqrt((4 * np.exp(rng.normal(0, 0.1, shape))) ** 2 + 4 * signal)
    counts = np.rint(offset + 2 * signal + sigma * rng.standard_normal((300, *shape))).astype(np.uint16)
    jumping = slice(0, 20)
    counts[:, 0, jumping] += (40 * (rng.random((300, 20)) < 0.3)).astype(np.uint16)
    found = flags_of(survey(hsnoise.FrameStack(counts, 1.0)), 0).reshape(shape) & FLAGS["telegraph"] > 0
    assert found[0, jumping].all() and found.sum() == 20
