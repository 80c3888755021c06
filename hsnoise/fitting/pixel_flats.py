"""What flats tell of a sensor's pixels: how their response to light differs (PRNU)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # its parts are imported when they are used

from hsnoise.fitting.pixel_response import Bend
from hsnoise.likelihood.flat_gain import FlatGain, relative_slope, variance_curve
from hsnoise.statistics.pixels.flags import is_dead
from hsnoise.statistics.pixels.line_response import LineResponse, LitPlane, line_response
from hsnoise.statistics.pixels.population import root_of, shared_variance
from hsnoise.statistics.pixels.sample import without_outliers
from hsnoise.statistics.pixels.structure import plane_rows, within_blocks
from hsnoise.statistics.pixels.survey import Group, Survey

LEAST_SIGNAL_DN = 1.0  # of a flat: with less, rounding is all that differs
LEAST_LIT = 0.2  # of the mean signal of a flat: corners that get less tell little
SAME_LIGHT = 1.01  # signals of one level above black levels that were reckoned apart
SIDES = 2, 8  # pixels of a block
MORE_SIGMAS = 2.0  # by which large blocks may show more: it is light that varies within them
SURELY = 5.0  # standard errors
LEAST_RESPONSE = 5e-4  # relative: shot noise of a million electrons is larger
LEAST_OF_LINES = 1e-4  # relative, of rows and columns
MOST_SATURATED = 0.01  # share of a flat's pixels that reach its highest count
CONTRADICTION = 1e-3  # chance of levels of light that scatter so much beyond their errors
NONE = (0.0, np.inf)


class Responses(NamedTuple):
    """Relative differences of the response to light (PRNU), each with its error; infinite where nothing tells.

    sigma, row_sigma, column_sigma: standard deviation over pixels, and over what whole rows and columns share.
    row_parity, column_parity: odd rows (columns) less even ones.
    """

    sigma: tuple[float, float] = NONE
    row_sigma: tuple[float, float] = NONE
    column_sigma: tuple[float, float] = NONE
    row_parity: tuple[float, float] = NONE
    column_parity: tuple[float, float] = NONE


def photo_response(
    found: Survey, c: int, black_dn: float, offset_dn: float, flats: FlatGain | None, bend: Bend
) -> Responses:
    """How pixels, rows and columns of a channel differ in their response to light.

    From flats of the range that determines the gain: charge that spills over evens out pixels that are nearly full. A
    response that bends and electrons that spread even them out, too, which is taken off.
    """
    levels = [] if flats is None else _levels(found, c, black_dn, offset_dn, flats, bend)
    if not levels:
        return Responses()
    sound = np.split(~(is_dead(found, c) | found.stuck(c)), len(levels[0].planes))
    sigma = _of_pixels(levels, sound, black_dn, len(found.sampled_rows) * plane_rows(found))
    planes = [_lit(found, c, p, levels, black_dn) for p in range(len(sound))]
    rows, columns = (_of_lines(found, planes, sigma[0] ** 2, axis) for axis in (0, 1))
    return Responses(sigma, root_of(*rows.variance), root_of(*columns.variance), rows.parity, columns.parity)


def _levels(found: Survey, c: int, black_dn: float, offset_dn: float, flats: FlatGain, bend: Bend) -> list[Level]:
    """The levels of light that tell how pixels respond."""
    brightest = np.where(flats.used[:, c], flats.signal_dn[:, c], 0.0).max()
    signals = [g.mean_dn(c) - black_dn for g in found.repeated_flats]
    return [
        Level(
            g,
            [p.halves.level_dn for p in g.of(c)],
            signal,
            offset_dn / signal,
            *_evened(flats, c, bend, signal),
        )
        for g, signal in zip(found.repeated_flats, signals, strict=True)
        if LEAST_SIGNAL_DN <= signal <= SAME_LIGHT * brightest and not saturates(g.pixels(c, "highest"))
    ]


def _of_pixels(levels: list[Level], sound: list[np.ndarray], black_dn: float, rows: float) -> tuple[float, float]:
    """Relative standard deviation over pixels of the response, within blocks of pixels, and its error.

    Dust and vignetting hardly vary within a block, whose own signal counts; if they vary within the large ones, the
    small ones count. Dead and stuck pixels are left out. If the levels disagree, the error holds their scatter.
    """
    small, large = (_variance(levels, sound, black_dn, rows, side) for side in SIDES)
    apart = np.sqrt(max(small[1] ** 2 - large[1] ** 2, 0.0)) if np.isfinite(large[1]) else 0.0
    return root_of(*(large if large[0] - small[0] < MORE_SIGMAS * apart else small))


def _of_lines(found: Survey, planes: list[list[LitPlane]], pixel_variance: float, axis: int) -> LineResponse:
    """The response of rows (axis 0) or columns (1) of a channel, mean over its planes [plane][level]."""
    step = 1 if found.cfa == "mono" else 2
    places = found.sampled_rows[::step] if axis == 0 else np.arange(0, found.shape[1], step)
    adjacent = axis == 1 or len(found.sampled_rows) == found.shape[0]
    numbers = (places + found.origin[axis]) // step if adjacent else None
    several = [line_response(levels, pixel_variance, axis=axis, numbers=numbers) for levels in planes]
    return LineResponse(*(of_colours(list(of)) for of in zip(*several, strict=True)))


def _lit(found: Survey, c: int, p: int, levels: list[Level], black_dn: float) -> list[LitPlane]:
    """A plane of each level of light above the darks, pixel by pixel."""
    shape = int(len(found.sampled_rows) * plane_rows(found)), -1
    dark, of_dark = (black_dn, np.zeros(3)) if found.shortest is None else _mean_and_noise(found.shortest, c, p)
    planes = []
    for level in levels:
        mean, noise = _mean_and_noise(level.group, c, p)
        of_pixels, of_rows, of_columns = (noise + of_dark).tolist()
        planes.append(LitPlane((mean - dark).reshape(shape), of_pixels, (of_rows, of_columns), level.evened))
    return planes


def _mean_and_noise(group: Group, c: int, p: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean of a plane over its frames [pixel], DN, and the variance by chance of pixels, rows and columns in it."""
    plane = group.of(c)[p]
    of_pixels = without_outliers(plane.halves.pair_variance_dn2, group.n_frames)[0]
    of_lines = (max(plane.components[name].variance_dn2, 0.0) for name in ("row_x_frame", "column_x_frame"))
    return plane.halves.level_dn.mean(0), np.array([of_pixels, *of_lines]) / group.n_frames


def of_colours(pairs: list[tuple[float, float]]) -> tuple[float, float]:
    """Mean of values over the colours, or planes, and its error; infinite errors are those of values of 0."""
    values, errors = np.array(pairs, float).T
    return float(values.mean()), float(np.sqrt((errors**2).sum()) / len(pairs))


def _evened(flats: FlatGain, c: int, bend: Bend, signal_dn: float) -> tuple[float, float]:
    """The factor by which a bend of the response, or electrons that spread, even out pixels at this signal, and the
    correlation with each of the four neighbours that they leave."""
    if not bend.spreads:
        return (float(relative_slope(flats, c, signal_dn)) if bend.is_curved else 1.0), 0.0
    share = bend.spread_per_e[0] * signal_dn / float(flats.gain[c])
    variance = float(variance_curve(flats, c, signal_dn))
    return float(np.sqrt(variance)), 2 * share * (1 - 4 * share) / variance


def flats_need_pixels(found: Survey) -> bool:
    """Whether flats show what pooled pixels hide: responses that differ, or against darks narrower than a count, whose
    variance rounding changes."""
    narrow = found.shortest is not None and any(plane.narrow_dn is not None for plane in found.shortest.planes)
    return bool(found.repeated_flats) and (narrow or _responses_differ(found))


def _responses_differ(found: Survey) -> bool:
    """Whether pixels of some colour differ in what they add to a level of light, by more than chance."""
    rows = len(found.sampled_rows) * plane_rows(found)
    for group in found.repeated_flats:
        for c in range(len(found.channels)):
            if saturates(group.pixels(c, "highest")):
                continue
            blocks = [within_blocks(plane.halves.level_dn, rows, SIDES[0])[0] for plane in group.of(c)]
            variance, error = shared_variance(np.concatenate(blocks, axis=1).reshape(2, -1))
            if variance > max(SURELY * error * SIDES[0], (LEAST_RESPONSE * group.mean_dn(c)) ** 2):
                return True
    return False


class Level(NamedTuple):
    """A level of light: its group, planes [half, pixel], DN, and signal, DN.

    of_offsets: the spread of offsets, relative to the signal. evened, alike: of the differences of pixels, the factor
    by which they are evened out, and the correlation of neighbours.
    """

    group: Group
    planes: list[np.ndarray]
    signal_dn: float
    of_offsets: float
    evened: float
    alike: float


def saturates(highest: np.ndarray) -> bool:
    return bool((highest == highest.max()).mean() > MOST_SATURATED)


def _variance(levels: list[Level], sound: list[np.ndarray], black_dn: float, rows: float, side: int):
    """Relative variance over pixels of the response, within blocks of this side, and its error; infinite without any.

    sound [plane][pixel]: which pixels count; blocks with others do not.
    """
    whole = [within_blocks(np.stack([of, of]).astype(np.float32), rows, side)[1][0] == 1 for of in sound]
    found, most = [], 0
    for level in levels:
        blocks = [within_blocks(of, rows, side) for of in level.planes]
        signal = np.concatenate([mean.mean(0) for _, mean in blocks]) - black_dn
        lit = np.concatenate(whole) & (signal > LEAST_LIT * level.signal_dn)
        if not lit.any():
            continue
        apart = np.concatenate([values for values, _ in blocks], axis=1)[:, lit] / signal[lit, None]
        variance, error = shared_variance(apart.reshape(2, -1))
        # Rows and columns of a block take more of a pattern in which neighbours are alike.
        seen = level.evened**2 * (1 - 4 * level.alike / side)
        found.append(((variance - level.of_offsets**2) / seen, max(error * side / (side - 1) / seen, 1e-12)))
        most = max(most, int(lit.sum()) * (side - 1) ** 2)
    if not found:
        return 0.0, np.inf
    scatter = between(*np.array(found).T)
    # Variances, not their roots, are averaged: a root of what may be negative is too large on average.
    mean, error = weighted_mean([(of, float(np.hypot(error, scatter))) for of, error in found])
    # All levels show the same pixels: more of them do not make up for how few these are.
    return mean, max(error, abs(mean) * float(np.sqrt(2 / most)))


def between(values: np.ndarray, errors: np.ndarray) -> float:
    """Standard deviation of what differs between values with these errors; 0 unless they contradict each other.

    Reference: Paule, Mandel, "Consensus values and weighting factors", J. Research NBS 87 (1982).
    """
    dof = len(values) - 1

    def misfit(between: float) -> float:
        weight = 1 / (errors**2 + between**2)
        return float(weight @ (values - weight @ values / weight.sum()) ** 2)

    if not dof or scipy.stats.chi2.sf(misfit(0.0), dof) > CONTRADICTION:
        return 0.0
    return scipy.optimize.brentq(lambda between: misfit(between) - dof, 0.0, 2 * np.ptp(values))


def weighted_mean(pairs: list[tuple[float, float]]) -> tuple[float, float]:
    """Mean of values with these errors, weighted by their inverse variances, and its error."""
    values, errors = np.array(pairs, float).T
    weight = errors**-2
    return float(weight @ values / weight.sum()), float(weight.sum() ** -0.5)


def bends_of(bends: Sequence[Bend]) -> dict[str, dict[str, tuple[float, float]]]:
    """What bends the photon transfer curve, if it does in all colours; that it does is known from the curve itself."""
    curvature, spread = (of_colours(list(of)) for of in zip(*(one[:2] for one in bends), strict=True))
    found = {"nonlinearity": {"curvature": curvature}} if np.isfinite(curvature[1]) else {}
    return found | ({"brighter_fatter": {"strength": spread}} if np.isfinite(spread[1]) else {})
