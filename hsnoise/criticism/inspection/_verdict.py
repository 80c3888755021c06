"""What these frames determine, whether a fit makes sense, and which capture is worth taking next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hsnoise._core.naming import setting
from hsnoise.criticism.budget import NoiseBudget
from hsnoise.criticism.inspection._facts import Facts, GroupFacts
from hsnoise.criticism.inspection._gain import Gain

MOSTLY_CLIPPED = 0.3  # share of pixels at 0
CERTAIN, ROUGH = 0.1, 0.5  # relative errors of a gain
BEYOND_DOUBT = 20.0  # standard errors of a growth
RISES_DN = 0.2  # of the mean, from the shortest to the longest exposure
HOTTER_DN, HOTTER = 5.0, 1.5  # by which hot pixels rise
NOTABLE = 0.5  # rms of what rows or columns share, over that of single pixels, that is told beside the noise
SHARED = {"row_x_frame": "rows", "column_x_frame": "columns"}


@dataclass(frozen=True)
class Judgement:
    """Sentences about what can and cannot be determined, the verdict, and the next capture worth taking."""

    determined: tuple[str, ...]
    verdict: str
    fit_makes_sense: bool
    next_capture: str


def judged(
    facts: Facts,
    elsewhere: Facts | None,
    budget: NoiseBudget | None,
    gain: Gain | None,
    *,
    is_mosaic: bool,
    knows_black: bool,
) -> Judgement:
    """What can be determined from these frames; knows_black: whether the black level is given."""
    darks = [group for group in facts.groups if group.kind == "dark"]
    flats = [group for one in (facts, elsewhere) if one is not None for group in one.groups if group.kind == "flat"]
    repeated = [group for group in darks if group.n_frames > 1]
    against = _against_a_fit(facts, darks, flats, repeated, is_mosaic=is_mosaic, knows_black=knows_black)
    relative = growth_error(budget)
    determined = (
        _gain_sentence(gain, flats, relative, repeated),
        _read_noise_sentence(repeated, gain is not None or relative < CERTAIN, budget),
        _dark_current_sentence(repeated, relative),
    )
    following = against[1] if against else _next_capture(gain, flats, darks, repeated, relative)
    if against:
        return Judgement(determined, f"A fit makes no sense: {against[0]}.", False, following)
    has_gain = gain is not None or relative < CERTAIN
    what = "gain and read noise in electrons" if has_gain else "noise in DN, but no gain: nothing in electrons"
    current = ", and dark current" if has_gain and relative < ROUGH else ""
    return Judgement(determined, f"A fit makes sense: it gives {what}{current}.", True, following)


def growth_error(budget: NoiseBudget | None) -> float:
    """Relative standard error of the growth of the darks' temporal variance, smallest over colours; inf if none.

    Growth without a rise of the mean counts only if it is beyond doubt: the camera may subtract its dark current.
    """
    if budget is None:
        return float("inf")
    least = BEYOND_DOUBT if not mean_rises(budget) else 0.0
    growths = [one for (_, name), one in budget.growth.items() if name == "temporal"]
    return min((error / slope for slope, error in growths if slope > least * error), default=float("inf"))


def mean_rises(budget: NoiseBudget) -> bool:
    """Whether the mean of the darks of any colour rises with exposure."""
    means: dict[str, list[tuple[float, float]]] = {}
    for row in budget.rows:
        if row.kind == "dark" and row.n_frames > 1:
            means.setdefault(row.channel, []).append((row.exposure_s, row.mean_dn))
    return any(max(of)[1] > min(of)[1] + RISES_DN for of in means.values())


def about_growth(budget: NoiseBudget | None) -> list[str]:
    """Noise that grows with exposure under a mean that does not."""
    if budget is None or mean_rises(budget) or growth_error(budget) > CERTAIN:
        return []
    return ["The noise of the darks grows with exposure, but not their mean: does the camera subtract dark current?"]


def about_shared_noise(budget: NoiseBudget | None) -> list[str]:
    """Rows or columns that vary more over time than single pixels."""
    parts = _shared_noise(budget)
    if parts is None:
        return []
    pixel, shared = parts
    return [
        f"{what.capitalize()} of the shortest darks change from frame to frame by {noise:.3g} DN as a whole, single"
        f" pixels only by {pixel:.3g} DN"
        for what, noise in shared.items()
        if noise > pixel
    ]


def _shared_noise(budget: NoiseBudget | None) -> tuple[float, dict[str, float]] | None:
    """Noise of single pixels of the shortest repeated darks, and what lines share, if notable, DN; mean of colours."""
    rows = [] if budget is None else [row for row in budget.rows if row.kind == "dark" and row.n_frames > 1]
    if not rows:
        return None
    shortest = min(row.exposure_s for row in rows)
    rows = [row for row in rows if row.exposure_s == shortest]
    rms = {
        name: max(float(np.mean([row.components[name].variance_dn2 for row in rows])), 0.0) ** 0.5
        for name in ("temporal", *SHARED)
    }
    pixel = rms.pop("temporal")
    return pixel, {SHARED[name]: noise for name, noise in rms.items() if noise > NOTABLE * pixel}


def _against_a_fit(
    facts: Facts,
    darks: Sequence[GroupFacts],
    flats: Sequence[GroupFacts],
    repeated: Sequence[GroupFacts],
    *,
    is_mosaic: bool,
    knows_black: bool,
) -> tuple[str, str] | None:
    """Why a fit makes no sense, and what to do; None if it does."""
    if not facts.groups:
        return "no frame can be used", "Raw frames, neither averaged nor calibrated nor scaled."
    if not repeated and not any(group.n_frames > 1 for group in flats) and len(flats) < 2:
        return (
            "no exposure has two frames, so noise and fixed pattern cannot be separated",
            "The same exposures again, eight frames of each.",
        )
    if not darks and not flats:
        return "there are neither darks nor flats", "Darks of several exposures, eight frames of each."
    if not darks and not knows_black:
        return (
            "flats alone cannot separate the black level from the read noise",
            f"Eight bias frames or short darks at the same gain; or {setting('black_level', 200)}, if you know it.",
        )
    clipped = [g for g in darks if np.mean([frame.clipped_share for frame in g.frames]) > MOSTLY_CLIPPED]
    if darks and len(clipped) == len(darks):
        return (
            "too many counts of the darks are clipped at 0",
            "The same darks with a higher offset (black level) of the camera.",
        )
    prints = [frame.fingerprint for group in facts.groups for frame in group.frames]
    if len(set(prints)) <= len(facts.groups) and len(prints) > len(facts.groups):
        return "the frames of each exposure are copies of one", "Frames with a separate exposure each."
    if repeated and all(group.temporal_dn < 1e-3 for group in repeated):
        return "nothing changes from frame to frame", "Raw frames, at a higher gain if the noise is below one count."
    if is_mosaic:
        return (
            "a colour mosaic is read as mono",
            f"The same frames with their Bayer order, for example {setting('cfa', 'RGGB')}.",
        )
    return None


def _gain_sentence(gain: Gain | None, flats: Sequence[GroupFacts], relative: float, repeated) -> str:
    if gain is not None:
        return f"Gain: yes, from {gain.source}, {gain}"
    if relative < CERTAIN:
        return f"Gain: yes, from the growth of the noise of darks, to about {100 * relative:.1g} % at best"
    if relative < ROUGH:
        return f"Gain: roughly, from the growth of the noise of darks, to about {100 * relative:.0f} % at best"
    why = "the noise of the darks does not grow with exposure" if len(repeated) > 1 else "there is nothing to compare"
    if not any(group.n_frames > 1 for group in flats):
        of_flats = "there are no flats in pairs"
    else:
        of_flats = "the flats do not show it" if repeated else "there are no repeated darks beside the flats"
    return f"Gain: no; {of_flats}, and {why}"


def _read_noise_sentence(repeated: Sequence[GroupFacts], has_gain: bool, budget: NoiseBudget | None) -> str:
    if not repeated:
        return "Read noise: no; no dark exposure has two frames"
    first = min(repeated, key=lambda group: group.exposure_s)
    unit = "in DN and in electrons" if has_gain else "in DN only, since the gain is unknown"
    parts = _shared_noise(budget)
    if parts is None or not parts[1]:
        return f"Read noise: yes, {unit}; the noise of the {first.name} is {first.temporal_dn:.3g} DN"
    pixel, shared = parts
    rest = " and ".join(f"{noise:.3g} DN shared by {what}" for what, noise in shared.items())
    return f"Read noise: yes, {unit}; the noise of the {first.name} is {pixel:.3g} DN of single pixels, beside {rest}"


def _dark_current_sentence(repeated: Sequence[GroupFacts], relative: float) -> str:
    exposures = {group.exposure_s for group in repeated}
    if len(exposures) < 2:
        return "Dark current: no; it needs two darks or more at each of two exposures"
    first, last = min(repeated, key=lambda g: g.exposure_s), max(repeated, key=lambda g: g.exposure_s)
    if relative >= ROUGH and last.hot_dn > max(HOTTER * first.hot_dn, first.hot_dn + HOTTER_DN):
        return "Dark current: only of hot pixels, which grow with exposure; most pixels hardly do"
    if relative >= ROUGH:
        return "Dark current: at most an upper bound; neither mean nor noise clearly grows with exposure"
    if last.level_dn <= first.level_dn:
        return "Dark current: only what the camera does not subtract; the mean does not rise"
    rise = (last.level_dn - first.level_dn) / (last.exposure_s - first.exposure_s)
    return f"Dark current: yes; the level rises by about {rise:.2g} DN/s"


def _next_capture(
    gain: Gain | None,
    flats: Sequence[GroupFacts],
    darks: Sequence[GroupFacts],
    repeated: Sequence[GroupFacts],
    relative: float,
) -> str:
    """The single most informative capture."""
    if gain is None and relative >= CERTAIN:
        return "Flats: two to four frames at each of five brightnesses up to half of saturation; they give the gain."
    if not repeated:
        return "Darks: bias frames (0 s) and two longer exposures, eight frames of each."
    single = [group.name for group in darks if group.n_frames == 1]
    if single:
        return f"Eight frames of the {', '.join(single)} instead of one, which cannot show noise."
    if len({group.exposure_s for group in darks}) < 2:
        return "Darks of a long exposure (30 to 300 s on a cooled camera), eight frames: dark current and hot pixels."
    few = [group.name for group in darks if group.n_frames < 8]
    if few:
        return f"Eight or more frames each of the {', '.join(few[:3])}: they show what changes from frame to frame."
    if gain is None:
        return "Flats in pairs at five brightnesses: they would confirm the gain from the darks."
    if relative >= ROUGH:
        return "Longer darks, until their noise grows: dark current and hot pixels would show."
    return "More of the same would only sharpen the numbers; 32 frames of each exposure show rare and small effects."
