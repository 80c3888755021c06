"""Which fit to believe: a likelihood of pooled pixels, or pixels over time."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from hsnoise.fitting.doubts._evidence import Evidence
from hsnoise.fitting.pixel_fit import PixelFit
from hsnoise.fitting.pixel_result import result_of
from hsnoise.fitting.result import FitResult, Method, Status
from hsnoise.statistics.pixels.structure import (
    can_be_transferred,
    fall_of,
    full_of_hits,
    has_patterns,
    responses_differ,
    variance_grows,
)

APART_SIGMAS, APART_SHARE = 5.0, 0.05  # standard errors and share by which two gains differ


def carries_no_gain(seen: Evidence, method: str) -> bool:
    """Whether darks of several exposures show no growth of signal, so that their likelihood cannot determine the gain.

    The likelihood would infer the gain from the shape of the distribution, which real pixels have for other reasons.
    Flats determine the gain without darks.
    """
    found, summary = seen.survey, seen.summary
    if method == "line" or not can_be_transferred(found):
        return False
    if not found.has_exposures:
        # A likelihood adds nothing where flats give the gain, and what the paper's model lacks changes the shapes.
        if summary.flats is not None:
            return has_patterns(found) or responses_differ(found)
        return has_patterns(found) or bool(found.waves) or found.comb is not None or bool(found.along)
    fell = fall_of(found) is not None  # pedestals that jump this far look like a signal
    if variance_grows(found) and not fell:
        return False
    return not seen.darks.determined and (fell or not _grows(seen.darks))


def confirmed(result: FitResult, seen: Evidence, model) -> FitResult:
    """The pooled fit, or pixel transfer if pixels over time contradict that fit or it did not converge."""
    found, summary = seen.survey, seen.summary
    failed = result.status == Status.LINE_INSTEAD
    if not can_be_transferred(found) or full_of_hits(found) or (result.method == Method.LINE and not failed):
        return result
    if not failed and (summary.flats is not None or not found.has_exposures):
        return result
    pixel = seen.measured(found) if failed else seen.darks
    if not pixel.determined and not (failed and not found.has_exposures):  # a line through one exposure says nothing
        return result
    other = partial(result_of, pixel, summary, model, result.stack)
    if failed:
        return replace(other(), status=Status.TRANSFER_INSTEAD, detail=result.detail)
    gain, error = np.asarray(result.params["gain"].value), _gain_errors(result)
    off = np.abs(gain - pixel.estimate[: len(gain)])
    apart = off > np.maximum(APART_SIGMAS * np.hypot(error, _errors(pixel)), APART_SHARE * gain)
    if not apart.any():
        return result
    return replace(other(), status=Status.CONTRADICTED, detail=f"{gain[apart][0]:.3g} DN/e-")


def _gain_errors(result: FitResult) -> np.ndarray:
    return np.array([error for _, error, _ in result.rows_of("gain").values()])


def _errors(pixel: PixelFit) -> np.ndarray:
    return np.sqrt(np.diagonal(pixel.covariance))[: len(pixel.channels)]


def _grows(pixel: PixelFit) -> bool:
    """Whether variance or mean of some colour grows with exposure beyond chance."""
    return any(c.values[2] > 3 * np.sqrt(c.covariance[2, 2]) for c in pixel.channels)
