"""The paper's calibration of dark frames: rows normalised, clipping corrected, a straight line fitted.

Wang et al., "Enhancing Low Light Videos by Exploring High Sensitivity Camera Noise", ICCV 2019, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hsnoise.fitting.line_spectrum import band_means, spectrum_exponent
from hsnoise.likelihood.moments import model_of
from hsnoise.likelihood.parameters import numbers_of
from hsnoise.likelihood.summary import RowHistograms, Summary
from hsnoise.lut import clipped_moments, row_moments, unclip
from hsnoise.model import NoiseModel

ROUNDS, TOLERANCE = 60, 1e-5  # of gain -> correction -> line -> gain
LEAST_GAIN, MOST_GAIN = 0.02, 2.0  # relative to the gain at which all variance is shot noise
LEAST_ROW_SIGMA, MOST_ROW_VARIANCE = 0.01, 1.0
ABSENT = 1e-9  # weight of an exposure that a replicate leaves out
SURPRISE = 4.0  # standard errors


@dataclass(frozen=True)
class LineFit:
    """Parameters of the paper's model by its own procedure.

    Attributes:
        params: values, finite even if undetermined.
        standard_errors: by name, as in `params.table`; infinite if undetermined, 0 if given.
        notes: sentences that qualify the numbers.
    """

    params: NoiseModel
    standard_errors: dict[str, float]
    notes: tuple[str, ...]


class _Points(NamedTuple):
    """Statistics of the rows of each exposure, flats after darks: [replicate, channel, point].

    level (DN), variance within rows, power of row means about their frame's mean (DN^2); the numbers of pixels and
    rows behind them. bands [replicate, channel, dark, band]: the power of the darks by row frequency.
    """

    level: np.ndarray
    variance: np.ndarray
    power: np.ndarray
    pixels: np.ndarray
    rows: np.ndarray
    bands: np.ndarray


class _Setting(NamedTuple):
    """What all replicates share: row_pixels [channel, point]; whether the points span a line."""

    summary: Summary
    row_pixels: np.ndarray
    is_line: bool


class _Correction(NamedTuple):
    """Normalised and corrected points [replicate, channel, point].

    True mean (DN) and variance (DN^2) at a row gain of 1, weight in the line fit, response (DN) of row means to the row
    gain, noise variance of a row's measured gain, whether a distribution of the family has this mean and variance.
    """

    mean: np.ndarray
    variance: np.ndarray
    weight: np.ndarray
    response: np.ndarray
    noise: np.ndarray
    found: np.ndarray


class _Estimate(NamedTuple):
    """[replicate] or [replicate, channel]; variances may be negative."""

    gain: np.ndarray
    dark_current: np.ndarray
    read_variance: np.ndarray
    row_variance: np.ndarray
    exponent: np.ndarray
    black_level: np.ndarray


def line_fit(summary: Summary) -> LineFit:
    """Fit the paper's model by the paper's procedure, improved where possible.

    Each row is divided by its gain, its mean over its frame's mean. Mean E' and variance Var' of each exposure and
    colour are corrected for clipping (the tables of `lut`, evaluated at the measured pairs themselves).
    The gain is the slope of Var' against E', the dark current E' / (gain t), the read-noise variance
    Var' / gain^2 - E' / gain. The correction needs the gain, so the two alternate until it settles (3 to 10 rounds).

    Beyond the paper: the error of a row's gain is that of its mean (`_mean_square_gain`), measurement noise is
    subtracted from the spread of row means, points are weighted, and colours share dark current and read noise. Flats
    are further points on the line. Standard errors: jackknife over frames.

    Bias, in percent of the true value, over 64 simulated captures (4 frames of 96 x 128 pixels at 0.02, 0.05, 0.1 and
    0.2 s; in brackets the spread of single captures; R, G, B):

    | camera | gain | dark current | read noise | row gain sigma | exponent |
    |---|---|---|---|---|---|
    | Canon, black 0 | -1.7, -0.2, 1.1 (9, 3, 4) | 0.0 (2.5) | 0.0 (3) | -1.2, -1.4, 0.4 (4, 4, 5) | -1.2 (3) |
    | Canon, black 128 | -2.2, 0.1, 0.5 (8, 3, 4) | 0.1 (2) | 0.1 (2) | -1.3, -1.3, -0.2 (4, 5, 6) | -1.7 (4) |
    | Grasshopper, black 0 | -0.4, -0.1, 0.1 (2, 2, 2) | 0.1 (1) | 0.1 (2) | -0.2, -0.1, 0.2 (3, 2, 3) | |

    The gain of a strongly fluctuating colour (red) is slightly low, and its standard error from so few frames is too
    small by a fifth. Hot pixels and other outliers count in full: sums of squares are not robust.

    Raises:
        ValueError: if there are no darks, or a colour has fewer than two rows or two pixels per row.
    """
    if not summary.histograms:
        raise ValueError("summary: the line fit needs dark frames, got flats only")
    if any(h.row_sum.shape[-1] < 2 or h.row_pixels.max() < 2 for h in summary.histograms):
        raise ValueError(f"summary: the line fit needs two rows and columns of each colour, got frames {summary.shape}")
    points, setting, scale = _replicates(summary)
    estimate, correction, step = _estimate(points, setting)
    return _result(estimate, correction, setting, scale, step)


def _frame_statistics(histograms: RowHistograms, sensor_rows: int, ddof: int):
    """Level, variance within rows, power of row means [exposure, frame] and its bands [exposure, frame, band]."""
    n, rows = histograms.row_pixels.max(), histograms.row_sum.shape[-1]
    mean = histograms.row_sum / n
    variance = (histograms.row_sum_of_squares - n * mean**2) / (n - 1)
    level = mean.mean(-1)
    moving = mean - level[..., None]
    spectrum = np.abs(np.fft.rfft(moving, axis=-1)) ** 2 / rows
    return level, variance.mean(-1), (moving**2).sum(-1) / (rows - ddof), band_means(spectrum, sensor_rows)


def _frame_weights(n_frames: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Weights [replicate, exposure, frame], all frames first, and each replicate's factor in the variance [replicate].

    Jackknife: each replicate leaves out one frame, or the whole point of an exposure with only one frame.
    """
    full = np.zeros((len(n_frames), max(n_frames)))
    for e, n in enumerate(n_frames):
        full[e, :n] = 1.0
    replicates, scale = [full], [0.0]
    stratified = min(n_frames) > 1
    if stratified or len(n_frames) > 2:
        for e, f in np.argwhere(full > 0):
            lacking = full.copy()
            lacking[e, f] = 0.0 if n_frames[e] > 1 else ABSENT
            replicates.append(lacking)
            scale.append(1 - 1 / (n_frames[e] if stratified else sum(n_frames)))
    return np.stack(replicates), np.asarray(scale)


def _replicates(summary: Summary) -> tuple[_Points, _Setting, np.ndarray]:
    """Points of all frames and of the jackknife's replicates, and the weight of each replicate's deviation."""
    ddof = 0 if summary.shutter == "rolling" else 1
    weights, scale = _frame_weights(summary.n_frames)
    frames = weights.sum(-1)[:, None, :]
    share = weights / weights.sum(-1, keepdims=True)
    statistics = [_frame_statistics(h, summary.shape[0], ddof) for h in summary.histograms]
    level, variance, power, bands = (
        np.stack([np.einsum("xef,ef...->xe...", share, a) for a in s], 1) for s in zip(*statistics, strict=True)
    )
    rows = np.array([h.row_sum.shape[-1] for h in summary.histograms])
    row_pixels = np.array([h.row_pixels.max() for h in summary.histograms])
    points = _Points(
        level, variance, power, frames * (rows * row_pixels)[:, None], np.maximum(frames * rows[:, None], ABSENT), bands
    )
    row_pixels = np.broadcast_to(row_pixels[:, None], level.shape[1:])
    levels = len(np.unique(summary.exposure_s))
    if summary.flats is not None:
        flats = summary.flats.straightened()
        points, row_pixels, scale = _with_flats(points, row_pixels, scale, flats)
        levels += len(flats.exposure_s)
    return points, _Setting(summary, row_pixels, levels > 1), scale


def _with_flats(points: _Points, row_pixels, scale, flats):
    """Append the flats as points, and a replicate for each of their mean squares, shifted by its standard error."""
    columns = [flats.mean_dn, flats.variance_dn2, flats.row_power_dn2, flats.dof, flats.row_dof]
    columns = [np.asarray(a, np.float64).T for a in columns]  # [channel, level]
    moved = [(field, i) for field in (1, 2) for i in np.ndindex(columns[0].shape)]
    replicates = len(scale) + len(moved)
    joined = []
    for field, dark in enumerate(points[:5]):
        dark = np.concatenate([dark, np.repeat(dark[:1], len(moved), 0)])
        flat = np.repeat(columns[field][None], replicates, 0)
        for r, (other, i) in enumerate(moved, start=len(scale)):
            if other == field:
                flat[(r, *i)] *= 1 + np.sqrt(2 / columns[field + 2][i])
        joined.append(np.concatenate([dark, flat], -1))
    bands = np.concatenate([points.bands, np.repeat(points.bands[:1], len(moved), 0)])
    row_pixels = np.concatenate([row_pixels, np.asarray(flats.row_pixels, np.float64).T], -1)
    return _Points._make([*joined, bands]), row_pixels, np.concatenate([scale, np.ones(len(moved))])


def _straight_line(x, y, weight):
    """Slope and intercept of the weighted line of y against x, over the last axis."""
    weight = weight / weight.sum(-1, keepdims=True)
    x = np.broadcast_to(x, y.shape)
    centre = (weight * x).sum(-1)
    moved = x - centre[..., None]
    slope = (weight * moved * y).sum(-1) / np.maximum((weight * moved**2).sum(-1), 1e-300)
    return slope, (weight * y).sum(-1) - slope * centre


def _black_level(points: _Points, summary: Summary) -> np.ndarray:
    """The black level as given, or the intercept of mean against exposure [replicate, channel].

    A single exposure has no such line: as a placeholder, one standard deviation below its mean.
    """
    darks = len(summary.exposure_s)
    level, weight = points.level[..., :darks], (points.pixels / points.variance)[..., :darks]
    if summary.black_level_dn is not None:
        return np.broadcast_to(summary.black_level_dn, level.shape[:2])
    if np.ptp(summary.exposure_s) == 0:
        return np.maximum(level - np.sqrt(points.variance[..., :darks]), 0.0).mean(-1)
    return _straight_line(summary.exposure_s, level, weight)[1]


def _row_variance(power, noise, rows):
    """Variance of the row gain from squared spreads of row means and their noise [..., point], optimally weighted."""
    variance = np.full(power.shape[:-1], 0.01)
    for _ in range(20):
        weight = rows / (np.maximum(variance, 0.0)[..., None] + noise) ** 2
        variance = (weight * (power - noise)).sum(-1) / weight.sum(-1)
    return variance


def _mean_square_gain(power, noise, rows, variance):
    """Mean square gain of a point's rows, estimated from their means, and its relative variance.

    Given its mean, a row's gain is normal about a value between the measured gain (weight `share`) and 1.
    """
    variance = np.clip(variance, 0.0, MOST_ROW_VARIANCE)[..., None]
    share = variance / (variance + noise)
    hidden = (1 - share) * variance
    mean_square = 1 + share**2 * power + hidden
    return mean_square, (4 * hidden * (1 + variance) + 2 * hidden**2) / (rows * mean_square**2)


def _correct(
    points: _Points, setting: _Setting, gain, black, before: _Correction | None
) -> tuple[_Correction, np.ndarray]:
    """One round: rows normalised and clipping corrected with this gain; `before` is the previous round, or None."""
    camera = dict(gain=gain[..., None], black_level_dn=black[..., None], white_level_dn=setting.summary.white_level_dn)
    level, variance = points.level - black[..., None], points.variance
    least = 1e-2 * np.sqrt(variance)
    response = np.maximum(level if before is None else before.response, least)
    noise = variance / (setting.row_pixels * response**2)
    power = points.power / response**2
    row_variance = _row_variance(power, noise, points.rows)
    mean_square, scatter = _mean_square_gain(power, noise, points.rows, row_variance)
    s = np.clip(row_variance, 0.0, MOST_ROW_VARIANCE)[..., None]
    unit = variance / mean_square
    if before is not None:
        # Rows of different gain are clipped differently, unless black is the clipping level or far above it.
        sigma = np.sqrt(np.maximum(s, LEAST_ROW_SIGMA**2))
        level_one, variance_one = map(np.asarray, clipped_moments(before.mean, before.variance, **camera))
        rows = map(np.asarray, row_moments(before.mean, before.variance, sigma, **camera))
        level_rows, variance_rows, response = rows
        level = level - (level_rows - level_one)
        unit = unit * (1 + sigma**2) * variance_one / variance_rows
        response = np.maximum(response, least)
    mean, true_variance, solved = (np.asarray(a) for a in unclip(level, unit, **camera))
    relative = 2 / points.pixels * (1 + 6 * s + 3 * s**2) / (1 + s) ** 2 + scatter
    error = np.sqrt(relative)
    found = solved | (
        (true_variance != unit)  # otherwise `unclip` returned the pair unchanged
        & (mean > -SURPRISE * error * true_variance / np.sqrt(unit))
        & (true_variance - gain[..., None] * mean > -SURPRISE * error * true_variance**2 / unit)
    )
    weight = 1 / (relative * true_variance**2)
    return _Correction(mean, true_variance, weight, response, noise, found), row_variance


def _shot_noise_gain(mean, variance):
    """Gain that would make all variance shot noise."""
    return (variance / np.maximum(mean, 0.1 * np.sqrt(variance))).min(-1)


def _estimate(points: _Points, setting: _Setting) -> tuple[_Estimate, _Correction, np.ndarray]:
    """Estimates of all replicates, their points, and the relative step of the gain in the last round [channel]."""
    black = _black_level(points, setting.summary)
    gain = 0.5 * _shot_noise_gain(points.level - black[..., None], points.variance)
    correction, row_variance = _correct(points, setting, gain, black, None)
    step = np.zeros_like(gain)
    for count in range(ROUNDS):
        if setting.is_line:
            slope, _ = _straight_line(correction.mean, correction.variance, correction.weight)
            most = _shot_noise_gain(correction.mean, correction.variance)
            slope = np.clip(slope, LEAST_GAIN * most, MOST_GAIN * most)
            gain, step = slope, np.abs(slope / gain - 1)
        if count > 1 and step.max() < TOLERANCE:
            break
        correction, row_variance = _correct(points, setting, gain, black, correction)
    electrons, square = correction.mean / gain[..., None], correction.variance / gain[..., None] ** 2
    t, darks = setting.summary.exposure_s, len(setting.summary.exposure_s)
    weight = (points.pixels / correction.variance)[..., :darks] + 1e-300
    dark_current = (weight * t * electrons[..., :darks]).sum(-1) / np.maximum((weight * t * t).sum(-1), 1e-300)
    read_variance = (correction.weight * (square - electrons)).sum(-1) / correction.weight.sum(-1)
    # Both inherit the error of the gain: colours are weighted by how well they determine it.
    centre = (correction.weight * electrons).sum(-1, keepdims=True) / correction.weight.sum(-1, keepdims=True)
    trust = gain**4 * (correction.weight * (electrons - centre) ** 2).sum(-1) + 1e-12
    trust = trust / trust.sum(-1, keepdims=True)
    estimate = _Estimate(
        gain=gain,
        dark_current=(trust * dark_current).sum(-1),
        read_variance=(trust * read_variance).sum(-1),
        row_variance=row_variance,
        exponent=_exponent(points, correction, row_variance, setting),
        black_level=black,
    )
    return estimate, correction, step[0]


def _exponent(points: _Points, correction: _Correction, row_variance, setting: _Setting) -> np.ndarray:
    """Exponent of the spectrum of the row gain [replicate], exposures weighted by information; 0 if global."""
    summary = setting.summary
    if summary.shutter == "global":
        return np.zeros(len(row_variance))
    darks = points.bands.shape[2]
    response, noise = correction.response[..., :darks, None], correction.noise[..., :darks, None]
    share = points.rows[..., :darks, None] / (np.maximum(row_variance, 0.0)[..., None, None] + noise) ** 2
    noise = (share * noise).sum(2) / share.sum(2)
    power = (share * points.bands / response**2).sum(2) / share.sum(2) - noise
    strides = [h.row_stride for h in summary.histograms]
    return spectrum_exponent(power, noise, sum(summary.n_frames), summary.shape[0], strides)


def _result(estimate: _Estimate, correction: _Correction, setting: _Setting, scale, step) -> LineFit:
    """Values, standard errors from the replicates' deviations, notes."""
    summary = setting.summary
    value = _Estimate(*(a[0] for a in estimate))
    if len(scale) > 1:
        error = _Estimate(*(np.sqrt(np.tensordot(scale, (a - a[:1]) ** 2, 1)) for a in estimate))
    else:
        error = _Estimate(*(np.full_like(a, np.inf) for a in value))
    most = _shot_noise_gain(correction.mean, correction.variance)[0]
    has_gain = setting.is_line & (value.gain > 1.01 * LEAST_GAIN * most)
    has_black = summary.black_level_dn is not None or np.ptp(summary.exposure_s) > 0
    params = model_of(
        summary,
        gain=value.gain,
        dark_current=np.maximum(value.dark_current, 0.0),
        read_noise=np.sqrt(np.maximum(value.read_variance, 0.0)),
        row_gain=(np.sqrt(np.clip(value.row_variance, 0.0, MOST_ROW_VARIANCE)), value.exponent),
        black_level=np.array(value.black_level),
    )
    black_error = np.zeros(len(value.black_level)) if summary.black_level_dn is not None else error.black_level
    known = {
        ("gain", "value"): (has_gain, error.gain),
        ("dark_current", "rate"): (has_gain.any() & summary.exposure_s.any() & has_black, error.dark_current),
        ("read_noise", "sigma"): (has_gain.any(), _root_error(value.read_variance, error.read_variance)),
        ("row_gain", "sigma"): (has_black, _root_error(value.row_variance, error.row_variance)),
        ("row_gain", "exponent"): (True, error.exponent),
        ("black_level", "value"): (has_black, black_error),
    }
    errors = {n.name: float(np.where(*known[n.place], np.inf)[n.index]) for n in numbers_of(params) if n.place in known}
    notes = _notes(value, setting, correction, has_gain, has_black, len(scale) > 1, step)
    return LineFit(params, errors, notes)


def _root_error(variance, error):
    """Standard error of the root of a variance: error / (2 root) to first order, and sqrt(error) at 0."""
    root = np.sqrt(np.maximum(variance, 0.0))
    return np.where(np.isfinite(error), np.sqrt(root**2 + np.where(np.isfinite(error), error, 0.0)) - root, np.inf)


def _notes(value, setting, correction, has_gain, has_black, has_errors, step) -> tuple[str, ...]:
    summary, names = setting.summary, np.asarray(setting.summary.channels)
    darks = len(summary.exposure_s)
    clearance = ((correction.mean[0] + value.black_level[:, None]) / np.sqrt(correction.variance[0]))[:, :darks].min()
    raised = has_black and summary.black_level_dn is None and clearance < 2
    lost = names[setting.is_line & ~has_gain]
    cases = (
        (not setting.is_line, "The gain is not determined: a line needs darks of two exposures, or flats."),
        (not setting.is_line, "Gain, dark current and read noise are placeholders."),
        (len(lost), f"The gain of {', '.join(lost)} is not determined: the variance does not grow with the mean."),
        (not has_black, "The black level is not determined by one exposure: its value is a placeholder."),
        (raised, "The black level is the intercept of the means, which clipping at 0 raises: give black_level."),
        (not has_errors, "Standard errors are not determined: take two frames of each exposure, or three exposures."),
        (not summary.exposure_s.any(), "The dark current is not determined: all darks are bias frames of 0 s."),
        (value.dark_current < 0, "The mean of the darks falls with exposure: the dark current is set to 0."),
        (value.read_variance <= 0, "The variance is not above shot noise: the read noise is set to 0."),
        (step.max() > 100 * TOLERANCE, f"Gain and clip correction do not converge: gain moves by {step.max():.1%}."),
    )
    notes = [sentence for holds, sentence in cases if holds]
    exposures = [f"{t:g} s" for t in summary.exposure_s] + ["a flat"] * (correction.found.shape[-1] - darks)
    outside = [f"{names[c]} at {exposures[e]}" for c, e in np.argwhere(~correction.found[0])]
    if outside:
        notes.append(
            f"No Poisson plus normal noise has the clipped mean and variance of {', '.join(outside)}: the mean is below"
            " black, or the variance below shot noise; the correction for clipping is not reliable there."
        )
    return tuple(notes)
