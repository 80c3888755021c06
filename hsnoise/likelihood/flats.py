"""Photon transfer of flats: mean, temporal variance and the common part of rows of each level.

Flats have a fixed pattern of light and of response: only changes between frames of the same light are noise
(Janesick, *Photon Transfer*, 2007; EMVA 1288). Frames are divided by their own mean above black, because lamps flicker
and skies darken, and what remains in rows and columns is subtracted, because sky gradients turn. The temporal variance
of frames of different light S_f is then K S + V_read, to first order for any ratio, where S is their harmonic mean: two
single flats of a twilight series therefore make a level.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial, reduce
from typing import NamedTuple

import equinox as eqx
import numpy as np
import scipy  # its parts are imported when they are used

from hsnoise.frames.arguments import check_no_copies
from hsnoise.frames.bayer import channel_rows
from hsnoise.frames.stack import FrameStack
from hsnoise.likelihood.flat_pairs import Shot, pairs_of_singles
from hsnoise.statistics.pixels.clipping import unclipped

FLICKER = 0.5  # of the mean: more is a change of light
OUTLIERS = 1e-7  # chance that an ordinary pixel is taken for a cosmic ray
CLEAR_SIGMAS = 5.0  # between a pixel's mean and the clipping level
DARK_CLEAR_SIGMAS = 3.0  # likewise, of darks: a thousandth of them clipped changes their variance by 1 %
PILED_UP = 1e-3  # share of the pixels at the highest count that makes it the saturation level
FEWEST_PILED = 10  # likewise, in pixels
FEWEST_PIXELS = 0.5  # share of a level's pixels that must not saturate
CLEAR_DARKS = 0.98  # share of the pixels of darks that must not clip
FEW_CLIPPED = 0.02  # of the counts of darks: corrected as for normal noise
SAME_EXPOSURE = 0.01
SAMPLE_PIXELS = 100_000  # for typical values
OUTER = 1e-3  # of the pixels on each side
NARROW_DN2 = 0.25  # variance below which many pixels hold the highest count
MOST_DARKS = 16  # frames from which a level of darks is measured


class FlatMoments(eqx.Module):
    """Photon transfer of the flats: [level, channel] mean, temporal variance within rows, degrees of freedom.

    `row_power` is the mean square of row means of frame differences over 2, `row_dof` its degrees of freedom.
    dark_dn, dark_variance_dn2, dark_error_dn2 [level, channel]: mean and variance, measured in the same way, of darks
    of the level's own exposure or else the shortest, and the variance's error; NaN without darks or if they clip.
    overscan_dn, photons_e [level] NaN if unknown. curve [level, channel]: variance over signal relative to low signal;
    weight [level, channel]: degrees of freedom that the likelihood gives a level, 0 for none. Before `flat_gain`
    judges the levels, curve is 1 and weight is `dof`. set_aside: sentences about levels that could not be used.
    """

    exposure_s: np.ndarray
    mean_dn: np.ndarray
    variance_dn2: np.ndarray
    dof: np.ndarray
    row_power_dn2: np.ndarray
    row_dof: np.ndarray
    row_pixels: np.ndarray
    photons_e: np.ndarray | None
    dark_dn: np.ndarray
    dark_variance_dn2: np.ndarray
    dark_error_dn2: np.ndarray
    overscan_dn: np.ndarray
    curve: np.ndarray
    weight: np.ndarray
    set_aside: tuple[str, ...] = eqx.field(static=True, default=())

    def straightened(self) -> FlatMoments:
        """The levels in use, with the variance of a linear response, and with `weight` as `dof`."""
        used = (self.weight > 0).any(1)
        dark = np.nan_to_num(self.dark_variance_dn2)
        variance = dark + (self.variance_dn2 - dark) / self.curve
        straight = replace(self, variance_dn2=variance, dof=np.maximum(self.weight, 1.0), curve=np.ones_like(variance))
        return replace(straight, **{k: v[used] for k, v in vars(straight).items() if isinstance(v, np.ndarray)})


class Measured(NamedTuple):
    """One level, or darks: mean and temporal variance [channel], as in FlatMoments, and the share of pixels kept."""

    mean_dn: np.ndarray
    variance_dn2: np.ndarray
    dof: np.ndarray
    row_power_dn2: np.ndarray
    row_dof: np.ndarray
    row_pixels: np.ndarray
    kept: np.ndarray


def flat_moments(stack: FrameStack, tick) -> FlatMoments | None:
    """Photon transfer of the flats of a stack and of those `elsewhere`, None without any.

    `tick` is called after each frame of the stack.

    Raises ValueError if frames of a group differ in light, or if no level is left and there are no darks.
    """
    darks = _dark_levels(stack)
    parts, aside = [], []
    for place, step in ((stack, tick), (stack.elsewhere, lambda: None)):
        if place is not None and "flat" in place.kind:
            found, sentences = _of_place(place, darks, step)
            parts += found
            aside += sentences
    if not parts and aside and not darks:
        raise ValueError(f"flats: none can be used. {' '.join(aside)}")
    if not parts and not aside:
        return None
    return _joined(parts, tuple(aside), len(stack.channels))


def _joined(parts: list[dict], aside: tuple[str, ...], channels: int) -> FlatMoments:
    names = [name for name in FlatMoments.__dataclass_fields__ if name not in ("set_aside", "curve", "weight")]
    of_level = {"exposure_s", "overscan_dn", "photons_e"}
    shape = {name: (len(parts),) if name in of_level else (len(parts), channels) for name in names}
    arrays = {n: np.array([p[n] for p in parts], np.float64).reshape(shape[n]) for n in names}
    photons = arrays.pop("photons_e")
    known = None if np.isnan(photons).all() else photons
    curve = np.ones_like(arrays["dof"])
    return FlatMoments(**arrays, photons_e=known, curve=curve, weight=arrays["dof"].copy(), set_aside=aside)


def _of_place(stack: FrameStack, darks: list[tuple[float, Measured]], tick) -> tuple[list[dict], list[str]]:
    """The levels of one place of the sensor, and sentences on those that cannot be used."""
    flats = [i for i, kind in enumerate(stack.kind) if kind == "flat"]
    dark = {i: _dark_of(stack.exposure_s[i], darks, len(stack.channels)) for i in flats}
    black = {i: _black(stack, dark[i]) for i in flats}
    series = [[Shot(i, n) for n in range(stack.n_frames[i])] for i in flats if stack.n_frames[i] > 1]
    pairs, lone = pairs_of_singles(stack, [Shot(i, 0) for i in flats if stack.n_frames[i] == 1], black)
    unlit, clipped, found = [], {}, []
    for shots in series + pairs:
        group = shots[0].group
        level = _measure(stack, shots, black, dark[group], tick)
        if (level.kept >= FEWEST_PIXELS).all():
            found.append(_fields(stack, shots, level, dark[group]))
        elif (level.kept == 0).any():
            unlit.append(group)
        else:
            clipped[group] = 1 - level.kept.min()
    return found, _set_aside(stack, [one.group for one in lone], unlit, clipped)


def _set_aside(stack: FrameStack, lone: list[int], unlit: list[int], clipped: dict[int, float]) -> list[str]:
    """Sentences on the levels that cannot be used; clipped: the share of their pixels that clip."""
    low, high = (f"{of(clipped.values(), default=0.0):.0%}" for of in (min, max))
    reasons = (
        (lone, "a single frame, and no other in similar light"),
        (unlit, "no light"),
        (list(clipped), f"{low if low == high else f'{low} to {high}'} of the pixels clip"),
    )
    return [f"{_named(stack, groups)} set aside: {why}." for groups, why in reasons if groups]


def _named(stack: FrameStack, groups: list[int]) -> str:
    times = [f"{stack.exposure_s[group]:g}" for group in groups]
    if len(groups) == 1:
        return f"Flat level {groups[0]} ({times[0]} s) is"
    return f"Flat levels {', '.join(map(str, groups[:-1]))} and {groups[-1]} ({', '.join(times)} s) are"


def _fields(stack: FrameStack, shots: list[Shot], level: Measured, dark: Measured) -> dict:
    """The fields of FlatMoments for one level."""
    groups = sorted({shot.group for shot in shots})

    def known(values):
        return np.nan if values is None else float(len(groups) / np.sum(1 / np.maximum(values[groups], 1e-30)))

    over = None if stack.overscan_dn is None else float(np.mean(stack.overscan_dn[groups]))
    return {
        **{name: value for name, value in level._asdict().items() if name != "kept"},
        "exposure_s": float(np.mean(stack.exposure_s[groups])),
        "photons_e": known(stack.photons_e),
        "overscan_dn": np.nan if over is None else over,
        "dark_dn": dark.mean_dn,
        "dark_variance_dn2": dark.variance_dn2,
        "dark_error_dn2": dark.variance_dn2 * np.sqrt(2 / dark.dof),
    }


def _black(stack: FrameStack, dark: Measured) -> np.ndarray:
    """Count without light [channel], above which frames are scaled: from darks, as given, or 0."""
    given = 0.0 if stack.black_level is None else stack.black_level
    return np.where(np.isfinite(dark.mean_dn), dark.mean_dn, np.broadcast_to(given, len(stack.channels)))


def _dark_levels(stack: FrameStack) -> list[tuple[float, Measured]]:
    """Exposure and photon transfer of the darks that flats are measured against, the shortest first."""
    places = [stack] if stack.elsewhere is None else [stack, stack.elsewhere]
    lit = np.array([t for p in places for t, kind in zip(p.exposure_s, p.kind, strict=True) if kind == "flat"])
    darks = [i for i, kind in enumerate(stack.kind) if kind == "dark" and stack.n_frames[i] > 1]
    darks.sort(key=lambda i: stack.exposure_s[i])
    wanted = [i for n, i in enumerate(darks) if n == 0 or _close(stack.exposure_s[i], lit).any()] if lit.size else []
    out = []
    for i in wanted:
        shots = [Shot(i, n) for n in range(min(stack.n_frames[i], MOST_DARKS))]
        level = _measure(stack, shots, {}, None, lambda: None)
        if (level.kept > CLEAR_DARKS).all():
            out.append((float(stack.exposure_s[i]), level))
    return out


def _close(exposure_s, others):
    return np.abs(others - exposure_s) <= SAME_EXPOSURE * np.maximum(others, exposure_s)


def _dark_of(exposure_s: float, darks: list[tuple[float, Measured]], channels: int) -> Measured:
    """Darks of this exposure, else the shortest; NaN without any."""
    unknown = Measured(*np.full((7, channels), np.nan))
    same = [level for t, level in darks if _close(t, exposure_s)]
    return (same or [level for _, level in darks[:1]] or [unknown])[0]


class _Sums(NamedTuple):
    """Sums over frames of one channel of counts relative to the frame's light.

    relative, squares [row, pixel]: counts, and squares of their residuals from rows and columns; rows [row], columns
    [pixel]: row and column means; row_means [frame, row] DN; light [frame]: mean above black, DN (1 for darks);
    lowest, highest: extreme counts; at_highest: how many pixels hold the highest.
    """

    relative: np.ndarray
    squares: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    row_means: np.ndarray
    light: np.ndarray
    lowest: float
    highest: float
    at_highest: int


def _sums(frame: np.ndarray, cfa: str, channels: tuple[str, ...], black: np.ndarray | None) -> dict[str, _Sums]:
    """The sums of one frame; darks (black None) are not divided by their light."""
    out = {}
    for n, c in enumerate(channels):
        y = channel_rows(frame, cfa, c).astype(np.float32)
        low, high = float(y.min()), float(y.max())
        at_highest = int((y == high).sum())
        within = _within_reach(y)
        row_means = within.mean(1, dtype=np.float64)
        zero = row_means.mean() if black is None else black[n]
        light = 1.0 if black is None else float(row_means.mean() - zero)
        scale = 1 / light if light > 0 else 0.0
        y -= np.float32(zero)
        y *= np.float32(scale)
        rows = (row_means - zero) * scale
        columns = (within.mean(0, dtype=np.float64) - row_means.mean()) * scale
        left = y - rows[:, None].astype(np.float32)
        left -= columns.astype(np.float32)
        np.square(left, out=left)
        out[c] = _Sums(y, left, rows, columns, row_means[None], np.array([light]), low, high, at_highest)
    return out


def _within_reach(y: np.ndarray) -> np.ndarray:
    """Counts, with outliers clipped to near the range of the others: one cosmic ray would shift its row's mean."""
    low, high = np.quantile(y.ravel()[:: max(y.size // SAMPLE_PIXELS, 1)], (OUTER, 1 - OUTER))
    margin = max((high - low) / 2, 1.0)
    return np.clip(y, np.float32(low - margin), np.float32(high + margin))


def _added(a: dict[str, _Sums], b: dict[str, _Sums]) -> dict[str, _Sums]:
    """The sums over the frames of both."""
    return {c: _added_channel(a[c], b[c]) for c in a}


def _added_channel(a: _Sums, b: _Sums) -> _Sums:
    highest = max(a.highest, b.highest)
    return _Sums(
        relative=a.relative + b.relative,
        squares=a.squares + b.squares,
        rows=a.rows + b.rows,
        columns=a.columns + b.columns,
        row_means=np.concatenate([a.row_means, b.row_means]),
        light=np.concatenate([a.light, b.light]),
        lowest=min(a.lowest, b.lowest),
        highest=highest,
        at_highest=sum(one.at_highest for one in (a, b) if one.highest == highest),
    )


def _measure(
    stack: FrameStack, shots: list[Shot], black: dict[int, np.ndarray], dark: Measured | None, tick
) -> Measured:
    """Photon transfer of frames that are one level, or of darks (dark is None)."""
    totals = reduce(_added, _read(stack, shots, black, dark is not None, tick))
    columns = []
    for n, c in enumerate(stack.channels):
        if dark is not None:
            _check_same_light(list(totals[c].row_means.mean(1)), stack, shots)
            _check_no_copies(totals[c], stack, shots)
        zero = totals[c].row_means.mean() if dark is None else float(np.mean([black[s.group][n] for s in shots]))
        read = 0.0 if dark is None else float(np.nan_to_num(dark.variance_dn2[n]))
        columns.append(_moments(totals[c], zero, read, stack.white_level, dark is None))
    return Measured(*(np.array(x, np.float64) for x in zip(*columns, strict=True)))


def _read(stack: FrameStack, shots: list[Shot], black: dict[int, np.ndarray], lit: bool, tick):
    """The sums of the frames, some of them already added up."""
    for group in dict.fromkeys(shot.group for shot in shots):
        numbers = [shot.number for shot in shots if shot.group == group]
        reduced = partial(_sums, cfa=stack.cfa, channels=stack.channels, black=black[group] if lit else None)
        yield from stack.map_frames(group, reduced, _added, numbers)
        for _ in numbers:
            tick()


def _check_same_light(levels: list[float], stack: FrameStack, shots: list[Shot]) -> None:
    """Frames of a flat group must be of the same light: a lamp may flicker, not change."""
    group = shots[0].group
    if all(shot.group == group for shot in shots) and max(levels) - min(levels) > FLICKER * np.mean(levels):
        raise ValueError(
            f"flats: frames of exposure group {group} ({stack.exposure_s[group]:g} s) differ in mean, from"
            f" {min(levels):.4g} to {max(levels):.4g} DN; a group holds frames of the same light, so give each"
            " brightness its own group (its own array, or its own exposure_s)"
        )


def _check_no_copies(sums: _Sums, stack: FrameStack, shots: list[Shot]) -> None:
    """Frames of one level must differ, unless most of their pixels are saturated."""
    if sums.at_highest > FEWEST_PIXELS * sums.relative.size * len(shots):
        return
    groups = dict.fromkeys(shot.group for shot in shots)
    rows = iter(sums.row_means)  # in the order in which frames were read
    prints = [[next(rows).tobytes() for shot in shots if shot.group == group] for group in groups]
    check_no_copies(prints, [float(stack.exposure_s[group]) for group in groups], "flats")


def _moments(sums: _Sums, zero_dn: float, read_dn2: float, white_level: float | None, is_dark: bool) -> tuple:
    """The fields of Measured for one channel."""
    n, (rows, pixels) = len(sums.light), sums.relative.shape
    if (sums.light <= 0).any():
        return zero_dn, *np.full(5, np.nan), 0.0
    light = n / (1 / sums.light).sum()
    relative = sums.relative / n
    left = sums.relative - (sums.rows[:, None] + sums.columns[None]).astype(np.float32)
    variance = np.maximum(sums.squares - left * left / n, 0) * np.float32(light**2 / (n - 1))
    kept = _ordinary(variance, np.maximum(relative, 1.0), n)
    typical = float(variance[kept].mean(dtype=np.float64))
    centred = (1 - 1 / rows) * (1 - 1 / pixels)
    if is_dark and sums.lowest <= 0 and (whole := _without_clipping(zero_dn + relative[kept], typical / centred, n)):
        level, corrected, growth = whole
        return level, corrected, kept.sum() * centred * (n - 1) / growth**2, *_of_rows(sums, zero_dn, light), 1.0
    clear = kept & _unclipped(sums, zero_dn + light * relative, typical, white_level, is_dark)
    # With frames of unequal light the read noise has a weight above 1.
    more = n * (1 / sums.light**2).sum() / (1 / sums.light).sum() ** 2 - 1
    if not clear.any():
        return zero_dn, *np.full(5, np.nan), 1e-9
    return (
        zero_dn + light * float(relative[clear].mean(dtype=np.float64)),
        float(variance[clear].mean(dtype=np.float64)) / centred - more * read_dn2,
        clear.sum() * centred * (n - 1),
        *_of_rows(sums, zero_dn, light),
        clear.sum() / max(kept.sum(), 1),
    )


def _of_rows(sums: _Sums, zero_dn: float, light: float) -> tuple[float, float, float]:
    """Mean square of the changes of row means, DN^2, its degrees of freedom, and pixels in a row."""
    series = (sums.row_means - zero_dn) * (light / sums.light[:, None])
    moving = series - series.mean(1, keepdims=True)  # the lamp may flicker from frame to frame
    moving -= moving.mean(0, keepdims=True)
    frames, rows = series.shape
    dof = (rows - 1) * (frames - 1)
    return float((moving**2).sum() / dof), dof, sums.relative.shape[1]


def _without_clipping(level: np.ndarray, variance: float, frames: int) -> tuple[float, float, float] | None:
    """Mean (DN) and temporal variance (DN^2) of darks, corrected for few counts at 0, and the growth of an error.

    level: mean of each pixel over the frames. None where more than a few counts clip: their noise need not be normal.
    """
    low, middle, high = np.quantile(level, (0.1587, 0.5, 0.8413))
    scatter = np.sqrt(max(((high - low) / 2) ** 2 - variance / frames, 0.0))
    if scipy.special.ndtr((0.5 - middle) / np.hypot(np.sqrt(variance), scatter)) > FEW_CLIPPED:
        return None
    found = unclipped(float(level.mean(dtype=np.float64)), variance, float(scatter))
    return found if np.isfinite(found[1]) else None


def _ordinary(variance: np.ndarray, relative: np.ndarray, frames: int) -> np.ndarray:
    """Pixels whose temporal variance is within chance [row, pixel]: no cosmic ray, no jump between levels."""
    some = variance.ravel()[:: max(variance.size // SAMPLE_PIXELS, 1)]
    typical = some[some <= np.quantile(some, 0.99)].mean(dtype=np.float64)
    limit = scipy.stats.chi2.isf(OUTLIERS, frames - 1) / (frames - 1)
    return variance <= np.float32(limit * typical) * relative


def _unclipped(sums: _Sums, level: np.ndarray, variance: float, white_level: float | None, is_dark: bool) -> np.ndarray:
    """Pixels whose counts stay clear of 0 and white [row, pixel]; chosen by their mean, which is independent of the
    variance of normal noise."""
    white = np.inf if white_level is None else white_level
    many = max(PILED_UP * level.size * len(sums.light), FEWEST_PILED)
    if not is_dark and variance > NARROW_DN2 and sums.at_highest > many:
        white = min(white, sums.highest)
    reach = (DARK_CLEAR_SIGMAS if is_dark else CLEAR_SIGMAS) * np.sqrt(variance)
    clear = level + reach < white if sums.highest >= white else np.ones(level.shape, bool)
    return clear & (level - reach > 0) if sums.lowest <= 0 else clear
