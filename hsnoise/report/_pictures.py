"""Frames on the page: grey pictures with a common stretch, each with the means of its rows and columns."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from PIL import Image

from hsnoise._core.types import cfa_tile

STRETCH = (0.5, 99.5)  # percentiles of the measured frame shown as black and white
REACH = 1.1  # of the largest row or column mean, at the ends of the strips


def pictures(frames: Sequence[np.ndarray], cfa: str, whole: tuple[int, int]) -> dict[str, Any]:
    """Frames [row, column] of one exposure as pictures with strips; limits and region in words.

    Each colour's median in the first frame is subtracted from all frames, to show noise instead of the mosaic.
    """
    tile = cfa_tile(cfa)
    level = np.zeros(frames[0].shape)
    for r, c in np.ndindex(*tile.shape):
        planes = (slice(r, None, len(tile)), slice(c, None, len(tile)))
        level[planes] = np.median(frames[0][planes])
    above = [frame - level for frame in frames]
    low, high = np.percentile(above[0], STRETCH)
    high = max(high, low + 1)
    lines = [[_lines(frame, axis, len(tile)) for axis in (0, 1)] for frame in above]
    reach = [REACH * max(1e-9, *(np.abs(pair[axis]).max() for pair in lines)) for axis in (0, 1)]
    rows, columns = frames[0].shape
    return {
        "shown": [
            {
                "address": _png(np.clip((frame - low) / (high - low), 0, 1)),
                "rows": _strip(of_rows, reach[0], upright=True),
                "columns": _strip(of_columns, reach[1], upright=False),
                "scatter": f"rows {of_rows.std():.3g} DN, columns {of_columns.std():.3g} DN",
            }
            for frame, (of_rows, of_columns) in zip(above, lines, strict=True)
        ],
        "low": f"{low:+.3g}",
        "high": f"{high:+.3g}",
        "reach": [f"{one:.2g}" for one in reach],
        "part": f"{'All' if level.shape == whole else 'The middle'} {rows} x {columns} pixels",
    }


def _lines(frame: np.ndarray, axis: int, step: int) -> np.ndarray:
    """Means of rows (0) or columns (1) minus the mean of all with the same colours, DN."""
    means = frame.mean(1 - axis)
    for first in range(step):
        means[first::step] -= means[first::step].mean()
    return means


def _strip(means: np.ndarray, largest: float, upright: bool) -> Markup:
    """A curve as wide, or as high, as the picture beside it; the page stretches it to fit."""
    along = np.arange(len(means)) + 0.5
    across = 50 + 50 * means / largest
    points = zip(across, along, strict=True) if upright else zip(along, 100 - across, strict=True)
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    box = f"0 0 100 {len(means)}" if upright else f"0 0 {len(means)} 100"
    middle = f"M50 0V{len(means)}" if upright else f"M0 50H{len(means)}"
    return Markup(
        '<svg viewBox="{}" preserveAspectRatio="none" aria-hidden="true"><path class="middle" d="{}"/>'
        '<polyline points="{}"/></svg>'
    ).format(box, middle, path)


def _png(grey: np.ndarray) -> str:
    """A picture [row, column] from 0 (black) to 1 as a data URL."""
    buffer = io.BytesIO()
    Image.fromarray(np.round(255 * grey).astype(np.uint8)).save(buffer, format="png", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
