"""Even and odd columns that differ in light: by their response, or by the gains of two outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np

from hsnoise.fitting.pixel_flats import Responses, of_colours
from hsnoise.statistics.pixels.survey import Survey
from hsnoise.statistics.pixels.taps import Taps, alternating

PARITY_THERE = 5.0  # standard errors
RATHER = 9.0  # by which chi2 must be less for two gains than for two responses


class Lit(Protocol):
    """A colour, as far as its response to light goes."""

    photo_response: Responses


C = TypeVar("C", bound=Lit)


def outputs_by_light(found: Survey, taps: Taps | None, channels: list[C]) -> tuple[Taps | None, list[C]]:
    """The outputs, and the colours without that part of their column parity that is the outputs'.

    A gain multiplies variance over signal as it does the signal, a response only the signal: the columns' own photon
    transfer tells one from the other, and says response where it cannot.

    Reference: Janesick, *Photon Transfer*, SPIE 2007 (gain of each amplifier from its own photon transfer).
    """
    parity, error = of_colours([one.photo_response.column_parity for one in channels])
    if not abs(parity) > PARITY_THERE * error or (taps is not None and not taps.interleaved):
        return taps, channels
    both = alternating(found) if taps is None else taps
    if both is None or np.isnan(both.gain).any():
        return taps, channels
    mismatch, of_it = float(np.diff(both.gain[0])[0]), float(np.hypot(*both.gain_error[0]))
    if (mismatch / of_it) ** 2 - ((mismatch - parity) / of_it) ** 2 > RATHER:
        gain = np.array([[1 - parity / 2, 1 + parity / 2]])
        known = both._replace(gain=gain, gain_error=np.full_like(gain, error / np.sqrt(2)))
        return known, _with_parity(channels, (0.0, error))
    if taps is not None and taps.gains_differ:
        return taps, _with_parity(channels, (parity - mismatch, float(np.hypot(error, of_it))))
    return taps, channels


def _with_parity(channels: Sequence[C], parity: tuple[float, float]) -> list[C]:
    """The colours with that column parity."""
    wide = parity[0], parity[1] * np.sqrt(len(channels))
    return [replace(one, photo_response=one.photo_response._replace(column_parity=wide)) for one in channels]
