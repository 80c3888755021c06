"""Offsets that whole frames share: all darks tell their size, unless longer ones differ by more than the shortest."""

from __future__ import annotations

import numpy as np

import hsnoise

SHAPE, GAIN = (96, 128), 0.8


def drawn(sigma_e, frames=6, exposures_s=(0.001, 0.5, 1.0, 2.0), seed=0):
    """A fit of darks whose pixels differ; sigma_e [exposure]: of the offsets of their frames."""
    rng = np.random.default_rng(seed)
    offset, rate = rng.normal(0, 4, SHAPE), rng.lognormal(1.8, 0.5, SHAPE)
    counts = []
    for exposure_s, sigma in zip(exposures_s, sigma_e, strict=True):
        electrons = rng.poisson(rate * exposure_s, (frames, *SHAPE)) + rng.normal(0, 5, (frames, *SHAPE))
        electrons = electrons + offset + sigma * rng.normal(size=(frames, 1, 1))
        counts.append(np.rint(200 + GAIN * electrons).astype(np.uint16))
    return hsnoise.fit(counts, exposure_s=list(exposures_s), white_level=4095, shutter="global")


def test_all_darks_tell_how_large_offsets_are():
    sigma, error, _ = drawn([3.0] * 4).table["frame_offset.sigma"]
    assert 0.8 < error / (3 / np.sqrt(2 * 4 * 5)) < 1.4  # from 24 frames; from six it is twice as large
    assert abs(sigma - 3) < 3 * error


def test_offsets_that_grow_with_the_exposure_are_not_mixed_with_those_of_the_shortest():
    sigma, error, _ = drawn([1.5, 1.5, 12.0, 12.0], frames=12).table["frame_offset.sigma"]
    assert abs(sigma - 1.5) < 3 * error and error < 0.6
