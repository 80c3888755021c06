"""Even and odd columns that differ in light: by their response, or by the gains of two outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from hsnoise.fitting.pixel_flats import Responses, of_colours
from hsnoise.statistics.pixels.line_response import PARITY_THERE
from hsnoise.statistics.pixels.survey import Survey
from hsnoise.statistics.pixels.taps import GAINS_APART, Taps, alternating

CONTRADICTS = 2.0  # standard errors
SMALL = 2e-3  # differences in light of which it does not matter where they come from
RATHER = 9.0  # by which chi2 must be less for two gains than for two responses, or the reverse


class Lit(Protocol):
    """A colour, as far as its response to light goes."""

    photo_response: Responses


C = TypeVar("C", bound=Lit)


class Outputs(NamedTuple):
    """The outputs, the colours, and whether noise tells what makes even and odd columns differ in light."""

    taps: Taps | None
    channels: list[Any]
    told: bool = True


def outputs_by_light(found: Survey, taps: Taps | None, channels: list[C]) -> Outputs:
    """The outputs, and the colours without that part of their column parity that is the outputs'.

    A gain multiplies variance over signal as it does the signal, a response only the signal: the columns' own photon
    transfer tells one from the other. Where it cannot, the difference is called a response, and is not told.

    Reference: Janesick, *Photon Transfer*, SPIE 2007 (gain of each amplifier from its own photon transfer).
    """
    parity, error = of_colours([one.photo_response.column_parity for one in channels])
    if not abs(parity) > PARITY_THERE * error or (taps is not None and not taps.interleaved):
        return Outputs(taps, channels)
    as_it_is = Outputs(taps, channels, told=abs(parity) < SMALL)
    both = alternating(found) if taps is None else taps
    if both is None or np.isnan(both.gain).any():
        return as_it_is
    mismatch, of_it = float(np.diff(both.gain[0])[0]), float(np.hypot(*both.gain_error[0]))
    as_gain, as_response = ((mismatch - parity) / of_it) ** 2, (mismatch / of_it) ** 2
    if max(as_gain, as_response) < RATHER:
        return as_it_is
    if as_response < as_gain and as_response < CONTRADICTS**2:
        return Outputs(None if taps is None else _known(taps, 0.0, of_it), channels)
    if as_gain < CONTRADICTS**2:
        return Outputs(_known(both, parity, error), _with_parity(channels, (0.0, error)))
    if abs(mismatch) < GAINS_APART * of_it:
        return as_it_is
    rest = parity - mismatch, float(np.hypot(error, of_it))
    return Outputs(_known(both, mismatch, of_it), _with_parity(channels, rest))


def _known(taps: Taps, mismatch: float, error: float) -> Taps:
    """The outputs with that mismatch of their gains."""
    gain = np.array([[1 - mismatch / 2, 1 + mismatch / 2]])
    return taps._replace(gain=gain, gain_error=np.full_like(gain, error / np.sqrt(2)))


def _with_parity(channels: Sequence[C], parity: tuple[float, float]) -> list[C]:
    """The colours with that column parity, such that their mean has its error."""
    wide = parity[0], parity[1] * np.sqrt(len(channels))
    return [replace(one, photo_response=one.photo_response._replace(column_parity=wide)) for one in channels]
