"""A first estimate of the gain from flats, and of where counts clip or saturate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hsnoise._core.naming import setting
from hsnoise._core.robust import robust_sigma
from hsnoise._core.types import StatedGain
from hsnoise.criticism.budget import BudgetRow, NoiseBudget
from hsnoise.criticism.inspection._facts import Facts, GroupFacts

CLIPPED = 1e-4  # share of counts at 0 or at white that is reported
SATURATED = 1e-3  # share of pixels at the highest count
PRECISE = 0.05  # largest relative error of the gain of a level that is used
LOW_SIGNAL = 0.05, 0.5  # of the brightest level, between which the gain is measured: above, the response may bend
BRIGHT = 0.7  # of the brightest level, where the response is tested for bending: above, sensors saturate
BENT = 0.1  # of the gain at low signal
DISAGREES = 0.1  # of the gain that a header states
NEAR_LIGHT = 1.5  # largest ratio of the signals of two single frames that are compared
FAR = 4.0  # deviations beyond which a difference of pixels is dust or a cosmic ray
NAMED = 4  # groups named in one finding


@dataclass(frozen=True)
class Gain:
    """The gain from flats, DN/e-, its source, and variance over signal of bright flats."""

    dn_per_e: float
    source: str
    bright_dn_per_e: float

    def __str__(self) -> str:
        return f"about {self.dn_per_e:.3g} DN/e- ({1 / self.dn_per_e:.3g} e-/DN)"


@dataclass(frozen=True)
class _Level:
    """One level of light: signal, DN; gain, DN/e-, and its relative error."""

    signal_dn: float
    gain: float
    relative_error: float


def gain_of_flats(dark: NoiseBudget | None, lit: NoiseBudget | None, facts: Facts) -> Gain | None:
    """Photon transfer of flats against the shortest dark, for a mono sensor or the green of a Bayer sensor.

    From flats in pairs, or single frames of about the same light; at low signal, where the response is linear.

    Args:
        dark, lit: budgets of the darks and of the flats; facts: those of the flats.
    """
    if dark is None or lit is None:
        return None
    channel = "G" if any(row.channel == "G" for row in lit.rows) else "mono"
    several = [row for row in dark.rows if row.kind == "dark" and row.channel == channel and row.n_frames > 1]
    if not several:
        return None
    zero = min(several, key=lambda row: row.exposure_s)
    flats = [row for row in lit.rows if row.kind == "flat" and row.channel == channel]
    levels = [_level(row, zero) for row in flats if row.n_frames > 1]
    source = "repeated flats"
    if not _precise(levels) and channel == "mono":
        levels, source = _pairs(facts, zero), "single flats, compared in pairs"
    levels = _precise(levels)
    if not levels:
        return None
    brightest = levels[-1].signal_dn
    low = [one for one in levels if LOW_SIGNAL[0] * brightest < one.signal_dn < LOW_SIGNAL[1] * brightest] or levels[:1]
    bright = min(levels, key=lambda one: abs(one.signal_dn - BRIGHT * brightest))
    source = f"{len(low)} level{'s' if len(low) > 1 else ''} of {source}"
    if len(low) < len(levels):
        source = f"{source} (the dim ones of {len(levels)})"
    return Gain(float(np.median([one.gain for one in low])), source, bright.gain)


def _precise(levels: Sequence[_Level]) -> list[_Level]:
    """Levels whose gain is known well, dim ones first."""
    known = [one for one in levels if one.gain > 0 and one.signal_dn > 0 and one.relative_error < PRECISE]
    return sorted(known, key=lambda one: one.signal_dn)


def _level(row: BudgetRow, zero: BudgetRow) -> _Level:
    signal, temporal = row.mean_dn - zero.mean_dn, row.components["temporal"]
    excess = temporal.variance_dn2 - zero.components["temporal"].variance_dn2
    return _Level(signal, excess / signal if signal else 0.0, temporal.standard_error_dn2 / max(excess, 1e-12))


def _pairs(facts: Facts, zero: BudgetRow) -> list[_Level]:
    """Pairs of single frames of the same exposure and about the same light; each is scaled to the mean of both.

    Differences of neighbouring columns remove gradients of the light, but not all of the fixed pattern.
    """
    if facts.region is None:
        return []
    levels, region = [], facts.region
    for i in range(region.n_exposures - 1):
        is_pair = region.kind[i] == region.kind[i + 1] == "flat" and region.exposure_s[i] == region.exposure_s[i + 1]
        if not is_pair or max(region.n_frames[i : i + 2]) > 1:
            continue
        frames = [region.frame(j, 0) - np.float64(zero.mean_dn) for j in (i, i + 1)]
        a, b = (float(frame.mean()) for frame in frames)
        if not 0 < max(a, b) < NEAR_LIGHT * min(a, b):
            continue
        difference = np.diff(frames[0] / a - frames[1] / b, axis=1).ravel()
        limit = FAR * robust_sigma(difference)
        variance = float(np.mean(difference[np.abs(difference) < limit] ** 2)) / 2
        read = zero.components["temporal"].variance_dn2 * (1 / a**2 + 1 / b**2)
        error = (2 * 1.5 / difference.size) ** 0.5  # neighbours share a pixel
        levels.append(_Level((a + b) / 2, (variance - read) / (1 / a + 1 / b), error * variance / (variance - read)))
    return levels


def about_gain(gain: Gain | None, stated: StatedGain | None) -> list[str]:
    """Whether the header's gain agrees with that of the flats, and whether the latter falls with the light."""
    if gain is None:
        return []
    said = []
    if gain.bright_dn_per_e < (1 - BENT) * gain.dn_per_e:
        fall = f"from {gain.dn_per_e:.3g} to {gain.bright_dn_per_e:.3g} DN/e-"
        said.append(
            f"Variance over signal of the flats falls {fall} as they get brighter: the response bends, charge spreads,"
            " or they saturate; dim flats determine the gain"
        )
    if stated is None:
        return said
    if abs(gain.dn_per_e / stated.value_dn_per_e - 1) > DISAGREES:
        return [*said, f"The header states {stated.source}, but the flats give {gain}: the header is wrong or nominal"]
    return [*said, f"The header's {stated.source} agrees with the flats: {gain}"]


def clipping(groups: Sequence[GroupFacts], white_known: bool) -> list[str]:
    """Sentences about counts at 0, at white, and at a highest count that may be white."""
    at_zero = [(float(np.mean([frame.clipped_share for frame in g.frames])), g) for g in groups]
    at_white = [(float(np.mean([frame.saturated_share for frame in g.frames])), g) for g in groups]
    said = []
    for shares, what in ((at_zero, "0 (black is clipped)"), (at_white, "the white level")):
        named = [f"{100 * share:.2g} % of the {group.name}" for share, group in shares if share > CLIPPED]
        if named:
            more = f" and of {len(named) - NAMED} more groups" if len(named) > NAMED else ""
            said.append(f"Counts at {what}: {', '.join(named[:NAMED])}{more}")
    highest = {frame.highest_dn for g in groups for frame in g.frames if frame.highest_share > SATURATED}
    if not white_known and len(highest) == 1 and any(group.kind == "flat" for group in groups):
        said.append(
            f"Many pixels reach exactly {highest.pop()} DN: if counts saturate there, give it as"
            f" {setting('white_level')}"
        )
    return said
