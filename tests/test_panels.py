"""What is static over the frame is panels, which outputs may make, or it is not."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise.statistics.panels import may_be_outputs

SHAPE, FRAMES = (96, 128), 8
ROW, COLUMN = (x / n for x, n in zip(np.mgrid[: SHAPE[0], : SHAPE[1]], SHAPE, strict=True))


def stack(static, seed=0, cfa="mono"):
    rng = np.random.default_rng(seed)
    counts = [500 + scale * static + 4 * rng.standard_normal((FRAMES, *SHAPE)) for scale in (0.0, 1.0)]
    return hsnoise.FrameStack([np.rint(x).astype(np.uint16) for x in counts], [0.0, 1.0], cfa=cfa)


def panels(rows, columns):
    number = np.floor(ROW * rows) * columns + np.floor(COLUMN * columns)
    return np.random.default_rng(7).standard_normal(rows * columns)[number.astype(int)]


@pytest.mark.parametrize("cfa", ["mono", "RGGB"])
@pytest.mark.parametrize("layout", [(1, 2), (1, 4), (1, 8), (2, 1), (2, 2)])
def test_panels_may_be_outputs(layout, cfa):
    for size in (0.3, 3.0):
        assert may_be_outputs(stack(size * panels(*layout), cfa=cfa), [stack(0 * ROW, seed) for seed in (1, 2)])


@pytest.mark.parametrize(
    "static",
    [3 * COLUMN, 3 * (ROW - 0.5) ** 2 + 3 * (COLUMN - 0.5) ** 2, 3 * np.exp(-3 * (ROW + COLUMN)), panels(16, 16)],
    ids=["slope", "vignette", "glow", "blocks"],
)
def test_what_else_lies_over_the_frame_is_none(static):
    drawn = [stack(0 * ROW, seed) for seed in (1, 2)]
    assert not may_be_outputs(stack(static), drawn)
    # What the model has is no longer there.
    assert may_be_outputs(stack(static + panels(1, 2)), [stack(static, seed) for seed in (1, 2, 3, 4)])
