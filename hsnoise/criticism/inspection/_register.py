"""Whether darks look like those of a camera that multiplies its electrons (EMCCD)."""

from __future__ import annotations

import numpy as np

from hsnoise.criticism.inspection._facts import Facts
from hsnoise.statistics.pixels.register import FEWEST_FRAMES, register_of

MOST_FRAMES = 16  # of an exposure


def about_register(facts: Facts) -> list[str]:
    """A sentence where single bright pixels look like multiplied electrons: gains by variance are then others."""
    region = facts.region
    if region is None or region.cfa != "mono":
        return []
    steps = []
    for i, (kind, frames) in enumerate(zip(region.kind, region.n_frames, strict=True)):
        if kind == "dark" and frames >= FEWEST_FRAMES:
            found = register_of(np.stack([region.frame(i, f) for f in range(min(frames, MOST_FRAMES))]))
            steps += [] if found is None else [found.step_dn[0]]
    if not steps:
        return []
    return [
        "Single bright pixels of the darks look like electrons that a register multiplied (EMCCD), about"
        f" {steps[0]:.3g} DN each: variance over signal, here and in flats, is then twice the gain, and short darks are"
        " quieter. Where the camera has no register they are hits or glitches; hsnoise fit tells, if there are flats or"
        " long darks"
    ]
