"""Sentences on flats: levels set aside, a bent response, a black level that falls, a header's gain that is wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hsnoise._core.types import StatedGain
from hsnoise.fitting.pixel_fit import PixelFit
from hsnoise.fitting.pixel_response import STRAIGHT, Bend
from hsnoise.fitting.result import FitResult
from hsnoise.likelihood.darks import flat_gain_of
from hsnoise.likelihood.flat_gain import LINE_RANGE, FlatGain, variance_curve
from hsnoise.likelihood.flats import FlatMoments
from hsnoise.statistics.pixels.transfer import Transfer

FALLING_BLACK = 0.005  # of the signal, by which the overscan differs from darks
BLACK_SIGMAS = 5.0
TOLD = 0.1  # relative error of the gain that darks tell, below which flats of one level are not alone
WRONG, WRONG_SIGMAS = 0.08, 3.0  # of a stated gain: relative difference, standard errors


def flat_notes(result: FitResult) -> list[str]:
    """Notes on the flats of a fit."""
    flats = result.summary.flats
    if flats is None:
        return []
    return gain_notes(flat_gain_of(result.params, flats), flats, result.summary.channels)


def flat_doubts(result: FitResult) -> list[str]:
    """What the flats leave in doubt about the gain."""
    flats, pixel, channels = result.summary.flats, result.transfer, result.summary.channels
    if flats is None:
        return []
    found = flat_gain_of(result.params, flats) if pixel is None else pixel.flats
    if found is None:
        return []
    doubts = scattered(found, channels)
    if pixel is None or not pixel.determined or pixel.channels[0].register is not None:
        return doubts
    doubts += _lone_level(found, pixel, channels)
    if all(one.transfer is None for one in pixel.channels):  # darks of one exposure tell no gain
        return doubts
    gain = np.broadcast_to(np.asarray(result.params["gain"].value), len(channels))
    return doubts + _contradicted(found, flats, gain, channels)


def gain_notes(
    found: FlatGain, flats: FlatMoments, channels: tuple[str, ...], bends: Sequence[Bend] | None = None
) -> list[str]:
    """Notes on the gain from flats; bends: what bends the curve of each channel, where pixels were followed."""
    notes = list(flats.set_aside)
    for c, channel in enumerate(channels):
        notes += _undetermined(found, flats, c, _of(channel)) + _left_out(found, c, _of(channel))
        notes += _bent(found, c, _of(channel), STRAIGHT if bends is None else bends[c])
    return notes + scattered(found, channels) + _falling_black(found, flats)


def scattered(found: FlatGain, channels: tuple[str, ...]) -> list[str]:
    """Sentences on flats that no smooth curve describes."""
    return [note for c, channel in enumerate(channels) for note in _scattered(found, c, _of(channel))]


def _lone_level(found: FlatGain, pixel: PixelFit, channels: tuple[str, ...]) -> list[str]:
    """A sentence if one level alone determines the gain; darks that tell it would show whether it is right."""
    lone = [c for c in range(len(channels)) if found.used[:, c].sum() == 1 and not _told(pixel.channels[c].transfer)]
    if not lone:
        return []
    of = _of(channels[lone[0]]) if len(lone) < len(channels) else ""
    return [
        f"One level of flats{of} determines the gain, and nothing shows whether the response bends or saturates there:"
        " two or more levels, or dark exposures whose signal grows, would."
    ]


def _told(darks: Transfer | None) -> bool:
    """Whether darks tell the gain well enough to contradict flats."""
    return darks is not None and darks.gain_error < TOLD * darks.gain


def _contradicted(found: FlatGain, flats: FlatMoments, gain: np.ndarray, channels: tuple[str, ...]) -> list[str]:
    """Sentences on flats that do not determine the gain, and vary less than this gain [channel], DN/e-, says."""
    signal, excess = flats.mean_dn - flats.dark_dn, flats.variance_dn2 - flats.dark_variance_dn2
    chance = gain * signal * np.sqrt(2 / flats.dof)
    notes = []
    for c in np.flatnonzero(~np.isfinite(found.gain)):
        below = (gain * signal - excess > BLACK_SIGMAS * np.hypot(chance, flats.dark_error_dn2))[:, c]
        if below.any():
            brightest = np.nanargmax(np.where(below, signal[:, c], np.nan))
            share = max(excess[brightest, c] / (gain[c] * signal[brightest, c]), 0.0)
            notes.append(
                f"The flats{_of(channels[c])} vary over time by {100 * share:.2g} % of what the darks' gain makes of"
                f" their {signal[brightest, c]:.4g} DN of signal: they are saturated, or the gain is wrong."
            )
    return notes


def _of(channel: str) -> str:
    return "" if channel == "mono" else f" of channel {channel}"


def _undetermined(found: FlatGain, flats: FlatMoments, c: int, of: str) -> list[str]:
    if np.isfinite(found.gain[c]):
        return []
    if np.isnan(flats.dark_variance_dn2[:, c]).all():
        return [f"The flats{of} do not determine the gain: there are no darks that tell level and noise without light."]
    return [f"No flat level{of} has a variance above that of the darks: the flats do not determine the gain."]


def _left_out(found: FlatGain, c: int, of: str) -> list[str]:
    """Levels past saturation, or where the smooth curve of those below them ends."""
    signal = found.signal_dn[:, c]
    if not found.used[:, c].any():
        return []
    top = signal[found.used[:, c]].max() if found.described[c] else found.full_scale_dn[c]
    above = signal[signal > top]
    if not above.size:
        return []
    return [
        f"The variance of the flats{of} leaves its curve above {top:.4g} DN of signal, as it does near saturation:"
        f" {above.size} level{'s' * (above.size > 1)} from {above.min():.4g} DN on left out."
    ]


def _bent(found: FlatGain, c: int, of: str, bend: Bend) -> list[str]:
    if not found.bend[c].any():
        return []
    top = found.full_scale_dn[c]
    off = float(variance_curve(found, c, top)) - 1
    gain = "The gain is given for low signal."
    if found.bend[c, 1] and bend.is_curved:
        gain += " The curve is not quite that of nonlinearity, x - curvature x^2."
    if bend.spreads:
        rest = "; the response bends, too (nonlinearity.curvature)" if bend.is_curved else ""
        return [
            f"Variance over signal of the flats{of} changes by {off:+.1%} up to {top:.4g} DN, and a pixel shares"
            f" {bend.shared:.1%} of its variance there with its neighbours: electrons spread as pixels fill"
            f" (brighter_fatter){rest}. {gain}"
        ]
    held = " (nonlinearity.curvature)" if bend.is_curved else ""
    return [
        f"The response{of} bends{held}: variance over signal changes by {off:+.1%} from low signal to {top:.4g} DN,"
        f" and the gain by about {off * 2 / 3:+.1%}. {gain}"
    ]


def _scattered(found: FlatGain, c: int, of: str) -> list[str]:
    """Levels that no smooth curve describes."""
    if found.described[c] or not found.used[:, c].any():
        return []
    used = found.used[:, c]
    levels, top = found.level_gain[used, c], found.signal_dn[used, c].max()
    return [
        f"Neither a line nor a smooth curve describes the flats{of} (chi2 {found.chi2[c]:.0f} for {found.dof[c]}"
        f" degrees of freedom). The gain is from EMVA 1288's line through the {used.sum()} levels up to {top:.4g} DN,"
        f" below {100 * LINE_RANGE:.0f} % of where the variance leaves its curve; their variance over signal is"
        f" {levels.min():.4g} to {levels.max():.4g} DN/e-, and the error of the gain is their scatter."
    ]


def _falling_black(found: FlatGain, flats: FlatMoments) -> list[str]:
    """An overscan that departs from the level of the darks when the pixels are lit."""
    off = flats.overscan_dn - flats.dark_dn.mean(1)
    signal = found.signal_dn.mean(1)
    known = np.isfinite(off) & (signal > 0)
    if not known.any():
        return []
    noise = np.sqrt(flats.dark_variance_dn2.mean(1) / flats.row_pixels.mean(1))
    i = int(np.argmax(np.where(known, np.abs(off), -1)))
    if abs(off[i]) < max(BLACK_SIGMAS * noise[i], FALLING_BLACK * signal[i]):
        return []
    share = float(np.median((off / signal)[known & found.used.any(1)])) if found.used.any() else off[i] / signal[i]
    words = "falls" if off[i] < 0 else "rises"
    return [
        f"The black level {words} with the signal: the overscan lies {off[i]:+.4g} DN from the darks' level at"
        f" {signal[i]:.4g} DN. The gain uses the level of the darks as black; with the overscan as black it would"
        f" differ by {1 / (1 - share) - 1:+.0%}."
    ]


def stated_gain_note(stated: StatedGain | None, gain_dn_per_e: float, error: float) -> list[str]:
    """A note if the gain in the headers disagrees with the frames; none if they agree or state no gain."""
    if stated is None or not np.isfinite(gain_dn_per_e):
        return []
    off = abs(stated.value_dn_per_e - gain_dn_per_e)
    if off <= max(WRONG * stated.value_dn_per_e, WRONG_SIGMAS * error):
        return []
    kind = "is wrong or nominal" if stated.certain else "is wrong, or not a gain in e-/DN"
    return [
        f"The header states {stated.source}, but these frames say {1 / gain_dn_per_e:.3g} e-/DN"
        f" ({gain_dn_per_e:.4g} ± {error:.2g} DN/e-): the header's value {kind}."
    ]
