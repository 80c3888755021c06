"""Offsets of pixels (DSNU) beside noise that looks alike in the frames of one exposure by chance."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise import FrameStack

SHAPE, EXPOSURES = (128, 192), np.geomspace(1e-4, 1e-2, 8)


@pytest.mark.parametrize("offset_dn", [0.0, 2.0])
def test_interference_of_pairs_of_frames_is_no_offset(rng, offset_dn):
    """A wave across the frame has another phase in each frame, and pairs share what is left of it by chance.

    In the frames of a CCD it passed for offsets of 0.3 DN, which no two exposures shared.
    """
    row, column = np.meshgrid(*map(np.arange, SHAPE), indexing="ij")
    offset = 100 + offset_dn * rng.standard_normal(SHAPE)

    def frame(first):
        phase = 2 * np.pi * (row / 3.7 + column / 5.3) + first
        return np.rint(offset + 2.0 * np.sin(phase) + 3.0 * rng.standard_normal(SHAPE)).astype(np.uint16)

    pairs = [np.stack([frame(first), frame(first + 0.4)]) for first in rng.uniform(0, 2 * np.pi, len(EXPOSURES))]
    fit = hsnoise.fit(FrameStack(pairs, EXPOSURES, shutter="global"))
    if offset_dn == 0:
        assert "dark_signal_nonuniformity" not in fit.params
    else:  # no gain: as DN
        value, error, _ = fit.shown["dark_signal_nonuniformity.sigma"]
        assert abs(value - offset_dn) < 4 * error < offset_dn


def test_offsets_are_not_lost_where_the_shortest_darks_have_as_much_dark_signal():
    rng, shape, offset_e, exposures_s = np.random.default_rng(3), (128, 192), 3.0, (1.0, 10.0)
    rate, offset = 20 * np.exp(0.5 * rng.standard_normal(shape) - 0.125), offset_e * rng.standard_normal(shape)
    darks = [rng.poisson(rate * t, (6, *shape)) + offset + 4 * rng.standard_normal((6, *shape)) for t in exposures_s]
    fit = hsnoise.fit([np.rint(200 + one).astype(np.uint16) for one in darks], exposure_s=exposures_s)
    sigma, error, _ = fit.table["dark_signal_nonuniformity.sigma"]
    assert abs(sigma - offset_e) < 4 * error and error < 0.1
