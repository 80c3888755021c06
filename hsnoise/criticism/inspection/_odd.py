"""Sentences about frames that look out of place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hsnoise._core.robust import robust_sigma
from hsnoise.criticism.inspection._facts import Facts, GroupFacts
from hsnoise.statistics.pixels.memory import LEAST_NOISE_DN, together
from hsnoise.statistics.pixels.oddities import SMOOTHED, brighter_kind, smoothed_in_words
from hsnoise.statistics.pixels.structure import MOST_DN_PER_E

FAR = 6.0  # robust deviations from which a frame is odd
LEAST_DN, LEAST_SHARE = 0.3, 0.15  # and at least this, in DN and in units of a pixel's noise
LIT = 1.0  # in units of a pixel's noise: a larger shift is not a wandering black level
SIGNIFICANT = 4.0  # standard errors of a drift
FEWEST = 5  # frames that can show a drift
QUIETER, NOISIER = 0.7, 1.4  # of the usual noise of a frame
AVERAGED = 0.6  # of the variance of a shorter exposure
BRIGHTER = 1.3  # hot pixels of a shorter exposure against a longer one's
FLICKER = 0.02  # of a flat's level
OFF_LINE = 0.05  # of the light of flats
DIM = 0.05  # of the brightest flat: the light of dimmer ones is not compared
ALIKE = 0.15  # of the signal: darks whose pixels differ less are lit


def odd_frames(facts: Facts, *, multiplies: bool = False) -> list[str]:
    """Sentences about unreadable, identical, odd, averaged and disordered frames.

    multiplies: whether a register may make the noise of an electron larger than in any other camera.
    """
    darks = [group for group in facts.groups if group.kind == "dark"]
    said = [f"Not usable: {one}" for one in facts.unreadable]
    said += _identical(facts.groups)
    for group in facts.groups:
        said += [*_levels(group, darks), *_noises(group)]
    return [
        *said,
        *_order(facts.groups),
        *([] if multiplies else _averaged(darks)),
        *_lit(darks),
        *_swapped(darks),
        *_unlit(facts.groups),
        *_off_line(facts.groups),
        *_filtered(darks),
        *_smoothed(darks),
    ]


def _filtered(darks: Sequence[GroupFacts]) -> list[str]:
    """Noise of a pixel that is in the next frame, too."""
    clear = [
        group
        for group in darks
        if group.temporal_dn > LEAST_NOISE_DN and len({frame.fingerprint for frame in group.frames}) == group.n_frames
    ]
    told = [(group.memory, group.temporal_dn) for group in clear if group.memory is not None]
    quiet_dn = min((group.temporal_dn for group in darks if group.temporal_dn > 0), default=0.0)
    memory = together(told, quiet_dn)
    return [] if memory is None else [memory.sentence.rstrip(".")]


def _smoothed(darks: Sequence[GroupFacts]) -> list[str]:
    """Noise of a pixel that its neighbours have, too."""
    wide = [group for group in darks if group.temporal_dn > LEAST_NOISE_DN and group.neighbours_share > SMOOTHED]
    most = max(wide, key=lambda group: group.neighbours_share, default=None)
    return [] if most is None else [smoothed_in_words(most.neighbours_share, most.name).rstrip(".")]


def _identical(groups: Sequence[GroupFacts]) -> list[str]:
    seen: dict[bytes, str] = {}
    said = []
    for group in groups:
        for frame in group.frames:
            if frame.fingerprint in seen:
                said.append(
                    f"{frame.name} ({group.name}) and {seen[frame.fingerprint]} are identical: drop one of them"
                )
            else:
                seen[frame.fingerprint] = f"{frame.name} ({group.name})"
    return said


def _levels(group: GroupFacts, darks: Sequence[GroupFacts]) -> Iterator[str]:
    """Frames whose level differs from the others, drift and settling."""
    levels = group.levels_dn
    if group.kind == "flat":
        spread = np.ptp(levels) / max(np.mean(levels), 1.0)
        if spread > FLICKER and np.ptp(levels) > np.nan_to_num(group.temporal_dn, nan=0.0):
            yield f"The light of the {group.name} changes by {100 * spread:.0f} % of the level"
        return
    if len(levels) < 3:
        if len(levels) == 2 and abs(levels[1] - levels[0]) > max(LIT * group.temporal_dn, LEAST_DN):
            yield f"The two {group.name} differ in level: {levels[0]:.1f} and {levels[1]:.1f} DN"
        return
    above = brighter_kind(levels)
    if above is not None:
        first, off_dn = group.in_time[int(above.argmax())].name, levels[above].mean() - levels[~above].mean()
        yield (
            f"{first} and {int(above.sum()) - 1} more of the {len(levels)} {group.name} lie {off_dn:.0f} DN above the"
            " others: light got in, or their exposure or temperature differs; give flats as such, and leave others out"
        )
        return
    rest = levels - (_line(levels) if len(levels) >= FEWEST else np.median(levels))
    spread = robust_sigma(rest - np.median(rest))
    far = np.abs(rest) > max(FAR * spread, LEAST_DN, LEAST_SHARE * group.temporal_dn)
    usual = np.flatnonzero(~far)
    for j in np.flatnonzero(far):
        yield _odd_level(group, int(j), float(levels[j] - np.median(levels[usual])), darks)
    yield from _drift(group, usual)


def _odd_level(group: GroupFacts, j: int, off_dn: float, darks: Sequence[GroupFacts]) -> str:
    where = f"{group.in_time[j].name} ({group.name}) lies {abs(off_dn):.1f} DN {'above' if off_dn > 0 else 'below'} the"
    level = group.in_time[j].level_dn
    for other in darks:
        apart = abs(other.level_dn - group.level_dn)
        if other is not group and apart > 2 * LEAST_DN and abs(other.level_dn - level) < 0.1 * apart:
            return f"{where} others, at the level of the {other.name}: is its exposure right?"
    if off_dn > LIT * group.temporal_dn:
        return f"{where} others: light got in, or its exposure or temperature differs; leave it out"
    if j == 0:
        lag = ", or pixels keep some charge of the frame before (image lag)" if off_dn < 0 and group.exposure_s else ""
        return f"{where} later ones: the black level settles after a pause{lag}; leave the first frame out"
    return f"{where} others: the black level jumps"


def _drift(group: GroupFacts, usual: np.ndarray) -> Iterator[str]:
    levels = group.levels_dn[usual]
    if len(levels) < FEWEST:
        return
    x = usual - usual.mean()
    slope = float(x @ levels / (x @ x))
    rest = levels - levels.mean() - slope * x
    error = np.sqrt(rest @ rest / (len(levels) - 2) / (x @ x))
    moved = slope * np.ptp(x)
    if abs(moved) > max(LEAST_DN, LEAST_SHARE * group.temporal_dn) and abs(slope) > SIGNIFICANT * error:
        what = "rises" if moved > 0 else "falls"
        yield f"The level of the {group.name} {what} from {levels[0]:.1f} to {levels[-1]:.1f} DN over the run: a drift"


def _line(levels: np.ndarray) -> np.ndarray:
    """A straight line through levels [frame], robust to single frames: median of slopes, median of the rest."""
    number = np.arange(len(levels))
    first, second = np.triu_indices(len(levels), 1)
    slope = np.median((levels[second] - levels[first]) / (second - first))
    return slope * number + np.median(levels - slope * number)


def _noises(group: GroupFacts) -> Iterator[str]:
    """Frames with less or more noise than the others."""
    if len(group.frames) < 3:
        return
    for frame in group.frames:
        ratio, name = frame.noise_dn / max(group.temporal_dn, 1e-6), f"{frame.name} ({group.name})"
        if ratio < QUIETER:
            yield f"{name} has {ratio:.2f} times the noise of the others: an average of frames?"
        elif ratio > NOISIER:
            yield f"{name} has {ratio:.1f} times the noise of the others: another gain, light, or bands?"


def _order(groups: Sequence[GroupFacts]) -> Iterator[str]:
    names = [group.name for group in groups if group.in_time != group.frames]
    if names:
        yield f"The file names of the {', '.join(names)} are not in the order of the times in their headers"


def _averaged(darks: Sequence[GroupFacts]) -> Iterator[str]:
    """Groups whose temporal variance is far below that of the others: averages."""
    several = [group for group in darks if group.n_frames > 1]
    for i, group in enumerate(several):
        variance = group.temporal_dn**2
        shorter = max((one.temporal_dn**2 for one in several[:i]), default=0.0)
        if variance < AVERAGED * shorter:
            ratio = shorter / max(variance, 1e-9)
            yield f"The {group.name} have {ratio:.3g} times less temporal variance than shorter ones: averages?"
    for one, other in zip(several, several[1:], strict=False):
        grown = other.temporal_dn**2 - one.temporal_dn**2
        signal = max(other.level_dn - one.level_dn, 0.0)
        if other.temporal_dn**2 > 3 * one.temporal_dn**2 and signal * MOST_DN_PER_E < grown:
            yield (
                f"The temporal variance of the {one.name} is {other.temporal_dn**2 / max(one.temporal_dn**2, 1e-9):.3g}"
                f" times less than that of the {other.name}, without a signal that explains it: averages of frames?"
            )


def _lit(darks: Sequence[GroupFacts]) -> Iterator[str]:
    """Darks whose pixels all rise by the same amount, unlike with dark current."""
    if len(darks) < 2:
        return
    first = min(darks, key=lambda group: group.level_dn)
    for group in darks:
        signal = group.level_dn - first.level_dn
        noise = np.nan_to_num(group.temporal_dn, nan=0.0)
        if signal > max(50.0, 3 * noise) and group.hot_dn - first.hot_dn < ALIKE * signal:
            yield (
                f"The {group.name} lie {signal:.0f} DN above the {first.name}, and their pixels hardly differ:"
                " light got in, they are flats, or all pixels have the same dark current"
            )


def _swapped(darks: Sequence[GroupFacts]) -> Iterator[str]:
    """Pairs of groups whose hot pixels contradict their exposures."""
    for i, short in enumerate(darks):
        for long in darks[i + 1 :]:
            noise = 2 * np.nan_to_num(max(short.temporal_dn, long.temporal_dn), nan=0.0)
            if short.hot_dn > BRIGHTER * long.hot_dn + noise and short.level_dn > long.level_dn - LEAST_DN:
                yield (
                    f"Hot pixels of the {short.name} are brighter ({short.hot_dn:.0f} DN) than those of the {long.name}"
                    f" ({long.hot_dn:.0f} DN): are their exposures swapped?"
                )


def _unlit(groups: Sequence[GroupFacts]) -> Iterator[str]:
    darks = [group.level_dn for group in groups if group.kind == "dark"]
    for group in groups:
        if group.kind == "flat" and darks and group.level_dn < min(darks) + LEAST_DN:
            yield f"The {group.name} are as dark as the darks"


def _off_line(groups: Sequence[GroupFacts]) -> Iterator[str]:
    """Flats whose light is not proportional to exposure, if that of most others is."""
    flats = [group for group in groups if group.kind == "flat" and group.exposure_s > 0]
    if len(flats) < 4:
        return
    darks = [group.level_dn for group in groups if group.kind == "dark"]
    signal = np.array([group.level_dn for group in flats]) - (min(darks) if darks else 0.0)
    rate = signal / np.array([group.exposure_s for group in flats])
    off = (np.abs(rate / np.median(rate) - 1) > OFF_LINE) & (signal > DIM * signal.max())
    if off.sum() <= len(flats) // 4:
        for group, one in zip(np.array(flats, object)[off], rate[off], strict=True):
            yield (
                f"The {group.name} hold {one / np.median(rate):.2f} times the light expected from the other flats:"
                " another lamp, or a wrong exposure?"
            )
