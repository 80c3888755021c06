"""Pixels that do not follow the model must not lead a fit astray: a saturated percent, and a thousandth."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise.likelihood.summary import far_outliers, summarise

MODEL = hsnoise.cameras.grasshopper3(cfa="RGGB", black_level_dn=64)
EXPOSURE_S = (0.05, 0.4)


def capture(share, value=65535):
    """Darks in which a share of the pixels holds one value."""
    counts = []
    for e, exposure_s in enumerate(EXPOSURE_S):
        key = jax.random.key(40 + e)
        drawn = np.asarray(hsnoise.sample_dark(key, 6, (96, 160), MODEL, exposure_s=exposure_s)).astype(np.uint16)
        counts.append(np.where(np.random.default_rng(e).random(drawn.shape) < share, np.uint16(value), drawn))
    return hsnoise.FrameStack(counts, EXPOSURE_S, black_level=64, cfa=MODEL.cfa, shutter=MODEL.shutter)


@pytest.mark.parametrize("share", [1e-3, 1e-2, 3e-2])
def test_bins_are_those_of_the_others_and_the_law_that_of_the_outliers(share):
    clean, dirty = (summarise(capture(s)) for s in (0.0, share))
    for one, other in zip(clean.histograms, dirty.histograms, strict=True):
        assert np.abs(one.edges_dn[:, 0] - other.edges_dn[:, 0]).max() <= 2
        assert (np.diff(other.edges_dn)[:, 0] <= 3 * np.diff(one.edges_dn)[:, 0]).all()  # not a thousand times
        assert (one.outlier_law[:, -1] < 0.2).all() and (other.outlier_law[:, -1] > 0.9).all()
        np.testing.assert_allclose(other.outlier_law.sum(1), 1.0)
    assert (far_outliers(clean) == 0).all()
    np.testing.assert_allclose(far_outliers(dirty), share, rtol=0.15)


@pytest.fixture(scope="module")
def clean_fit():
    return hsnoise.fit(capture(0.0))


@pytest.mark.slow
@pytest.mark.parametrize("share", [1e-3, 1e-2, 3e-2])
def test_saturated_pixels_leave_the_parameters_alone(share, clean_fit):
    result = hsnoise.fit(capture(share))
    truth = MODEL.table
    assert result.method == "ml"
    for name in result.names:
        value, error, _ = result.table[name]
        assert abs(value - truth[name][0]) < 4 * error, name
    for name in ("gain.G", "read_noise.sigma"):  # not half a standard error from where they would be
        assert abs(result.table[name][0] - clean_fit.table[name][0]) < 0.5 * clean_fit.table[name][1]
    assert any("do not follow this model" in note for note in result.notes)
