"""What a fit by pooled histograms mistakes for noise, unless its model has an effect that draws it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hsnoise.fitting.doubts._choice import APART_SIGMAS
from hsnoise.fitting.result import FitResult, Method
from hsnoise.statistics.pixels.structure import static_of
from hsnoise.statistics.pixels.survey import Survey

STATIC = {  # effects that draw pixels which differ
    "dark_signal_nonuniformity",
    "dark_current_nonuniformity",
    "hot_pixels",
    "random_telegraph_noise",
    "measured_map",
}
OFFSETS = 4.0  # standard deviations of the offsets of frames in the model, by which frames may differ
STATIC_SHARE = 0.03  # static variance that a pooled fit mistakes for noise, over the temporal variance


def offsets_dn(result: FitResult) -> float:
    """By how much frames may differ in the offsets that a fit by pooled histograms was given, DN."""
    if result.method == Method.TRANSFER or "frame_offset" not in result.params:
        return 0.0
    gain = float(np.mean(np.asarray(result.params["gain"].value)))
    return OFFSETS * float(result.params["frame_offset"].sigma) * gain


def of_pooling(result: FitResult, found: Survey) -> Iterator[str]:
    """Static structure that a fit by pooled histograms mistakes for noise."""
    if result.method == Method.TRANSFER or not STATIC.isdisjoint(result.params.names):
        return
    worst = 0.0
    for c in range(len(found.channels)):
        for group in found.darks:
            one = static_of(found, group, c)
            if one is not None and one.variance_dn2 > APART_SIGMAS * one.error_dn2:
                worst = max(worst, one.variance_dn2 / max(one.temporal_dn2, 1e-12))
    if worst > STATIC_SHARE:
        yield (
            f"Pixels differ: their static variance is up to {worst:.0%} of the temporal one, and this fit mistakes it"
            " for noise. Gain, dark current and read noise may be off by as much; hsnoise improve finds what is"
            " missing."
        )
