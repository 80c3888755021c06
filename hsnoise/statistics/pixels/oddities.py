"""Sentences on frames, rows, columns and pixels of a capture that do not measure the sensor's noise."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hsnoise._core.naming import setting
from hsnoise._core.robust import robust_sigma
from hsnoise.statistics.pixels.flags import counts_of, flags_of
from hsnoise.statistics.pixels.survey import Group, Survey

ODD_LEVEL, ODD_NOISE = 8.0, 0.25  # deviations of a frame's level; share by which its noise differs from the others'
LEAST_LEVEL_DN = 0.5
MANY = {"stuck": 5e-4, "telegraph": 5e-4}  # shares of pixels that deserve a sentence
QUIET = 0.05  # of the other colours' noise: below it a colour is dead
LIT_DN, LIT_NOISES = 50.0, 3.0  # signal that may be light, in DN and in a pixel's noise
LEAST_SPREAD, MOST_SPREAD = 0.002, 0.15  # relative, of that signal over pixels: less is simulated, more is dark current
SMOOTHED = 0.1  # share of the noise that neighbouring pixels have in common
LIT = 1.0  # in units of a pixel's noise: a larger shift of a frame is not a wandering black level
HOT_NOISES, STILL_NOISES, FEWEST_HOT = 10.0, 3.0, 8  # signal over a pixel's noise: once, and again; pixels
LONGER, SWAPPED, WIDE_DN = 1.5, 0.7, 0.5  # ratios of exposures and of signals; noise, where levels are no codes
FEWEST = 3  # frames among which an odd one can be found
TWO_DN, TWO_SHARE = (
    50.0,
    0.5,
)  # gap between two kinds of frames, in DN and of the lower level: no black level jumps so far
WITHIN = 0.2  # of the gap: how much frames of a kind may differ


def oddities_of(found: Survey) -> tuple[str, ...]:
    """What is wrong with frames, rows, columns and colours, most important first."""
    return (*_lit_frames(found), *_averages(found), *_lines(found), *_colours(found), *_swapped(found))


def _swapped(found: Survey) -> Iterator[str]:
    """Exposures of which hot pixels say that the shorter one is the longer."""
    wide = [group for group in found.repeated_darks if group.noise_dn > WIDE_DN]
    darks = sorted(wide, key=lambda group: group.exposure_s)
    for short, long in zip(darks, darks[1:], strict=False):
        if long.exposure_s > LONGER * short.exposure_s and (growth := _hot_growth(short, long)) < SWAPPED:
            yield (
                f"Hot pixels of the {name_of(long)} have {growth:.0%} of the signal that they have at"
                f" {short.exposure_s:g} s: are the exposures swapped?"
            )


def _hot_growth(short: Group, long: Group) -> float:
    """Signal of hot pixels in longer darks over that in shorter ones, the median; NaN if few are hot in both."""
    ratios = []
    for one, other in zip(short.planes, long.planes, strict=True):
        a, b = (plane.halves.level_dn.mean(0) - np.median(plane.halves.level_dn) for plane in (one, other))
        hot = np.minimum(*one.halves.level_dn) - np.median(one.halves.level_dn) > HOT_NOISES * short.noise_dn
        hot &= b > STILL_NOISES * long.noise_dn
        ratios.append(b[hot] / a[hot])
    of_all = np.concatenate(ratios)
    return float(np.median(of_all)) if len(of_all) >= FEWEST_HOT else float("nan")


def brighter_kind(levels_dn: np.ndarray) -> np.ndarray | None:
    """Which frames [frame] are of the brighter of two kinds, of two frames or more each; None of one kind."""
    ranked = np.sort(levels_dn)
    if len(ranked) < 4:
        return None
    gaps = np.diff(ranked)
    k = int(gaps.argmax()) + 1
    gap, kinds = float(gaps[k - 1]), (ranked[:k], ranked[k:])
    apart = gap > max(TWO_DN, TWO_SHARE * abs(float(ranked[0])))
    if not apart or min(map(len, kinds)) < 2 or max(float(np.ptp(of)) for of in kinds) > WITHIN * gap:
        return None
    return levels_dn > ranked[k - 1]


def name_of(group: Group) -> str:
    return f"{group.kind} frames of {group.exposure_s:g} s"


def _called(group: Group, f: int) -> str:
    return f"{group.files[f]} ({name_of(group)})" if group.files else f"Frame {f} of the {name_of(group)}"


def _lit_frames(found: Survey) -> Iterator[str]:
    for group in found.darks:
        levels = np.mean([plane.frame_means_dn for plane in group.planes], axis=0)
        if (above := brighter_kind(levels)) is not None:
            off_dn = levels[above].mean() - levels[~above].mean()
            yield (
                f"{_called(group, int(above.argmax()))} and {int(above.sum()) - 1} more of {len(above)} are"
                f" {off_dn:.4g} DN brighter than the others: are they lit, or taken at another exposure or temperature?"
                " Fit one kind at a time, and give flats as such."
            )
    for group, f, off in _odd_levels(found):
        if abs(off) > LIT * group.noise_dn:
            yield (
                f"{_called(group, f)} is {abs(off):.3g} DN {_side(off)} than the others: is it lit, or taken at another"
                " exposure or temperature? Leave it out."
            )


def moved_frames(found: Survey, offsets_dn: float = 0.0) -> Iterator[str]:
    """Frames whose black level is another, by less than the noise of a pixel: nothing where frames are followed.

    offsets_dn: by how much levels of frames may differ.
    """
    for group, f, off in _odd_levels(found):
        if offsets_dn < abs(off) <= LIT * group.noise_dn:
            lag = ", or pixels keep some charge of the frame before" if off < 0 and group.exposure_s else ""
            why = f"settles after a pause{lag}" if f == 0 else "jumps"
            yield f"{_called(group, f)} is {abs(off):.3g} DN {_side(off)} than the others: the black level {why}."


def _side(off: float) -> str:
    return "brighter" if off > 0 else "darker"


def _odd_levels(found: Survey) -> Iterator[tuple[Group, int, float]]:
    """Dark frames whose level is far from that of the others, DN; flicker is removed from flats."""
    for group in found.darks:
        if group.n_frames < FEWEST:
            continue
        level = np.mean([p.halves.frame_means_dn for p in group.planes], axis=0)
        off = level - np.median(level)
        scatter = max(robust_sigma(off), LEAST_LEVEL_DN / ODD_LEVEL)
        pixel = float(np.median(_noise_of_frames(group)))
        for f in np.flatnonzero((np.abs(off) > ODD_LEVEL * scatter) & (np.abs(off) > 0.2 * pixel)):
            yield group, int(f), float(off[f])


def _averages(found: Survey) -> Iterator[str]:
    for group in found.groups:
        if group.n_frames < FEWEST:
            continue
        noise = _noise_of_frames(group)
        pixel = float(np.median(noise))
        for f in np.flatnonzero(noise < (1 - ODD_NOISE) * pixel):
            yield (
                f"{_called(group, int(f))} has {1 - noise[f] / pixel:.0%} less noise than the others: is it an"
                " average of frames (a masterdark)? Leave it out."
            )


def _noise_of_frames(group: Group) -> np.ndarray:
    return np.mean([p.halves.frame_noise_dn for p in group.planes], axis=0)


def _lines(found: Survey) -> Iterator[str]:
    for group in found.groups[:1]:
        odd = group.odd_lines
        if any(p.narrow_dn is not None for p in group.planes):
            return  # rows with a single count are normal here
        for what, lines in (("rows", odd.constant_rows), ("columns", odd.constant_columns)):
            if len(lines):
                yield f"{_listed(what, lines)} have a single count: they are dead, or padding. Crop them (roi)."
        if len(odd.repeated_rows):
            yield f"{_listed('rows', odd.repeated_rows)} repeat the row before: they are padding. Crop them (roi)."


def _listed(what: str, lines: np.ndarray) -> str:
    shown = ", ".join(str(n) for n in lines[:5])
    return f"{len(lines)} {what} ({shown}{', ...' if len(lines) > 5 else ''})"


def _colours(found: Survey) -> Iterator[str]:
    """Colours without noise."""
    if len(found.channels) == 1:
        return
    for group in found.darks[:1]:
        noise = [
            np.mean([p.components["temporal"].variance_dn2 for p in group.of(c)]) for c in range(len(found.channels))
        ]
        for c, name in enumerate(found.channels):
            if noise[c] < QUIET**2 * np.nanmax(noise):
                yield f"The colour {name} has no noise ({noise[c]:.2g} DN²): its channel is dead, or padding."


def smoothed(found: Survey) -> Iterator[str]:
    """Noise that neighbours share: a pixel's variance is then no measure of its electrons."""
    # Darks only: if light differs between two flats, their pattern changes, too.
    planes = [(plane.neighbours_share, group) for group in found.repeated_darks for plane in group.planes]
    wide = [one for one in planes if one[1].noise_dn > LEAST_LEVEL_DN]
    share, group = max(wide, key=lambda one: one[0], default=(0.0, None))
    if group is not None and share > SMOOTHED:
        yield smoothed_in_words(share, name_of(group))


def smoothed_in_words(share: float, name: str) -> str:
    """share: of the noise of neighbours in a row, more than SMOOTHED; name: of the frames."""
    return (
        f"Neighbouring pixels of a row share {share:.0%} of their noise ({name}): the frames were smoothed, denoised,"
        " resized or demosaiced, or the readout is slow. Gain and noise come out too small."
    )


def lit_darks(found: Survey) -> Iterator[str]:
    """Darks whose pixels rise almost equally, as under light; dark currents differ by far more."""
    first = found.shortest
    for c, channel in enumerate(found.channels if first is not None else ()):
        of = "" if channel == "mono" else f" of channel {channel}"
        unlit = _levels(first, c)
        for group in found.repeated_darks:
            signal = _levels(group, c) - unlit
            rise = float(np.median(signal))
            a, b = (one - np.median(one) for one in signal)
            width = float(np.quantile(np.abs(a + b) / 2, 0.99))
            common = float(np.mean(np.clip(a, -width, width) * np.clip(b, -width, width)))
            spread = np.sqrt(max(common, 0.0)) / max(rise, 1e-9)
            if rise > max(LIT_DN, LIT_NOISES * group.noise_dn) and LEAST_SPREAD < spread and width < MOST_SPREAD * rise:
                yield (
                    f"The pixels{of} of the {name_of(group)} rise by {rise:.3g} DN with a spread of only"
                    f" {spread:.2g} of that: dark currents differ by more. Did light get in, or are they flats"
                    f" ({setting('kind', 'flat')})?"
                )
                break


def _levels(group: Group, c: int) -> np.ndarray:
    """Level of each pixel of a channel in two halves of the frames [half, pixel], DN."""
    return group.pixels(c, "level_dn").astype(np.float64)


def pixels_apart(found: Survey, jumps: bool) -> Iterator[str]:
    """Shares of defective pixels: stuck, dead, and telegraph-like unless their `jumps` are known."""
    for c, channel in enumerate(found.channels):
        shares = counts_of(flags_of(found, c))
        of = "" if channel == "mono" else f" of channel {channel}"
        if shares["stuck"] > MANY["stuck"]:
            yield f"{100 * shares['stuck']:.2g} % of the pixels{of} never change: they are stuck, and not noise."
        if shares["telegraph"] > MANY["telegraph"] and not jumps:
            yield (
                f"{100 * shares['telegraph']:.2g} % of the pixels{of} are far noisier than others of their level"
                " (telegraph-like)."
            )
        if shares["dead"] > MANY["stuck"]:
            yield f"{100 * shares['dead']:.2g} % of the pixels{of} hardly respond to light: they are dead, or overscan."
