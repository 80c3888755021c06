"""Notes on what a capture does not determine, and which capture would."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import numpy as np

from hsnoise._core.naming import setting
from hsnoise.fitting.flat_notes import flat_notes
from hsnoise.fitting.profile import WEAK
from hsnoise.fitting.result import FitResult
from hsnoise.likelihood.darks import black_level
from hsnoise.likelihood.parameters import Number, numbers_of
from hsnoise.likelihood.summary import RowHistograms

FALL_SIGMAS = 4.0  # standard errors of a level that falls with exposure
UNDETERMINED = 0.3  # relative standard error above which a parameter is reported as undetermined
LEAST_OUTLIERS = 5  # pixels; fewer may be chance
MISPLACED_FRACTION = 0.03
LIGHT_E_PER_S = 2e4  # a dark current above this looks like light
LIT_SIGMA = 5.0  # standard deviations of a pixel above black; no short dark reaches this level
WARMING, WARMING_SIGMA, FEWEST_IN_SERIES = 0.05, 8.0, 4  # share of the dark signal, standard errors, frames
DRIFT_SIGMA = 0.5  # standard deviations of a pixel: frame means of one exposure drift less


def closing_notes(result: FitResult) -> tuple[str, ...]:
    """All notes printed under the table of `result`."""
    misfit = _misfit_notes(result) if result.summary.histograms else flat_notes(result)
    circumstances = (note(result) for note in (_left_out_note, order_note, _warming_note, _light_note))
    return (*parameter_notes(result), *misfit, *chain.from_iterable(circumstances))


def pixel_notes(result: FitResult) -> tuple[str, ...]:
    """Notes under the table of a pixel-conditional fit, which has no histogram of pooled pixels."""
    told = (order_note, _warming_note, _light_note, _settings_note, _multiplication_note)
    circumstances = (note(result) for note in told)
    return (*parameter_notes(result), *chain.from_iterable(circumstances))


def _settings_note(result: FitResult) -> list[str]:
    """What measured effects have besides numbers: axes, sides, kinds."""
    of = [
        f"{name} " + ", ".join(f"{field} {value}" for field, value in settings.items())
        for name in result.added
        if (
            settings := {
                k: v for k, v in result.params[name].settings().items() if v != "" and v is not False and v is not None
            }
        )
    ]
    return [f"Besides the numbers of the table: {'; '.join(of)} (docs/effects.md)."] if of else []


def _multiplication_note(result: FitResult) -> list[str]:
    """What the numbers of a camera with a gain register refer to."""
    if "electron_multiplication" not in result.added:
        return []
    held = ""
    if result.table["electron_multiplication.excess"][1] == 0:
        flats = "; flats would test it" if result.summary.flats is None else ", with which the flats agree"
        held = f" The excess noise is that of a large multiplication{flats}."
    return [
        "This camera multiplies its electrons (EMCCD): the gain is that of an electron which enters the register, and"
        f" read noise is in such electrons.{held}"
    ]


def parameter_notes(result: FitResult) -> list[str]:
    """Parameters of the paper's effects that the capture does not determine."""
    table, numbers = result.table, numbers_of(result.params)
    return [note for number in numbers if (note := _note(number, table[number.name], result))]


def near_zero(name: str, value: float, error: float, unit: str = "") -> str:
    """The statement that a size is compatible with 0, with its upper limit."""
    return f"{name} is compatible with zero (below {f'{value + 2 * error:.2g} {unit}'.rstrip()})"


def _note(number: Number, row: tuple[float, float, str], result: FitResult) -> str | None:
    value, error, unit = row
    if np.isnan(value):  # withheld: the doubts say so
        return None
    name, relative = number.name, error / max(abs(value), 1e-30)
    match number.place:
        case "gain", _ if relative > UNDETERMINED:
            known = "" if np.isinf(error) else f" (standard error {error:.2g} {unit})"
            return f"{name} is not determined{known}: add flats, or darks of longer exposures."
        case "gain", _ if relative > WEAK:
            known = f"{name} is known only to {relative:.0%}, and so are read noise and dark current"
            return f"{known}: add flats, or longer darks."
        case "read_noise", "sigma" if relative > UNDETERMINED:
            if result.transfer is not None and result.has_gain:
                return f"{name} is not determined: add bias frames, or darks of shorter exposures."
            in_dn = value * float(np.mean(np.asarray(result.params["gain"].value)))
            return f"{name} is not determined in e-, because the gain is not; in DN it is {in_dn:.3g}."
        case "dark_current", "rate":
            return _dark_current_note(value, error, result)
        case "row_gain", _:
            return _row_gain_note(number, value, error, result)
        case "black_level", _ if name in result.names and error > 1.0 and not _has_bias(result):
            known = "" if np.isinf(error) else f" ({error:.2g} DN)"
            return f"{name} is not determined{known}: add bias frames (0 s), or give black_level."
    return None


def _row_gain_note(number: Number, value: float, error: float, result: FitResult) -> str | None:
    name, fitted = number.name, number.name in result.names
    # The estimate is of the variance, whose error is 2 value x error.
    if number.field == "sigma" and np.isinf(error):
        return f"{name} is not determined: add darks of longer exposures, or flats."
    if number.field == "sigma" and value < 4 * error:
        return f"{near_zero(name, value, error)}."
    if number.field == "exponent" and fitted and error > 0.4:
        return f"{name} is not determined: the row gain is too weak here, or too white, to have a spectrum."
    if number.field == "exponent" and fitted and abs(value) < 2 * error:
        return f"{name} is compatible with 0: rows of a frame fluctuate independently."
    if number.field == "white_share" and not fitted and value == 1:
        return f"{name} is 1: rows fluctuate independently and move the mean of their frame, as with a global shutter."
    if number.field == "white_share" and fitted and error > 0.1:
        return f"{name} and row_gain.exponent can hardly be separated, and their errors are rough: add frames."
    return None


def _has_bias(result: FitResult) -> bool:
    """Whether there are bias frames (darks of 0 s)."""
    return len(result.summary.exposure_s) > 0 and bool(result.summary.exposure_s.min() == 0)


def _dark_current_note(value: float, error: float, result: FitResult) -> str | None:
    exposures = result.summary.exposure_s
    if len(exposures) == 0:
        return "dark_current.rate is not determined: add dark frames."
    if not exposures.any():
        return "dark_current.rate is not determined: all darks are bias frames of 0 s; add darks of seconds to minutes."
    if np.isinf(error):
        return "dark_current.rate is not determined: add darks of other exposures, or flats."
    if value < 2 * error:
        longest = max(exposures)
        return (
            f"{near_zero('dark_current.rate', value, error, 'e-/s')};"
            f" darks longer than {longest:.3g} s would determine it."
        )
    return None


def outlier_fraction(result: FitResult) -> np.ndarray:
    """Fraction of the pixels of each dark exposure in bins where the model expects none."""
    outside, total = np.zeros(1), np.ones(1)
    for h, expected in zip(result.summary.histograms, result.expected_histograms(), strict=True):
        measured = h.counts.sum((1, 2), dtype=np.float64)
        outside = outside + np.where(expected < 0.01, measured, 0).sum(1)
        total = total + measured.sum(1)
    return np.where(outside < LEAST_OUTLIERS, 0.0, outside / total)


def _misfit_notes(result: FitResult) -> list[str]:
    """What the fitted histograms miss: outliers, and a shape that the model cannot produce."""
    notes = []
    outside = result.outliers
    if outside is not None:
        e = int(outside.argmax())
        notes.append(
            f"{100 * outside[e]:.2g} % of the pixels at {result.summary.exposure_s[e]:g} s do not follow this model"
            " (hot pixels, cosmic hits, ...): the fit excludes them, and the model does not reproduce them."
        )
    for h, (law, deviation) in zip(result.summary.histograms, result.expected_laws(), strict=True):
        e, misplaced, chance = _misplaced(h, law, deviation, result.summary)
        if misplaced > MISPLACED_FRACTION + 3 * chance:
            channel = "" if h.channel == "mono" else f" of channel {h.channel}"
            exposure_s = result.summary.exposure_s[e]
            notes.append(
                f"The model misplaces {misplaced:.0%} of the pixels{channel} at {exposure_s:g} s: it lacks an effect"
                " that these frames show, which may bias its parameters and standard errors."
            )
            break
    return notes + flat_notes(result)


def _misplaced(h, law: np.ndarray, deviation: np.ndarray, summary) -> tuple[int, float, float]:
    """The exposure with the worst histogram, the share of its pixels that is misplaced, and the share by chance."""
    measured = h.counts.sum((1, 2), dtype=np.float64)
    pixels = np.maximum(measured.sum(1, keepdims=True), 1)
    share = 0.5 * np.abs(measured / pixels - law).sum(1)
    rows = (h.row_pixels > 0).sum((1, 2))
    # Coloured row gains are correlated within a frame: count two independent rows per frame.
    independent = rows if summary.shutter == "global" else 2 * np.asarray(summary.n_frames)
    scatter = np.sqrt(deviation**2 / np.maximum(independent, 1)[:, None] + law / pixels)
    chance = 0.5 * np.sqrt(2 / np.pi) * scatter.sum(1)
    e = int((share - 3 * chance).argmax())
    return e, float(share[e]), float(chance[e])


def _left_out_note(result: FitResult) -> list[str]:
    """What was left out of the histograms to save memory."""
    summary = result.summary
    used, given = sum(summary.n_frames), sum(summary.n_frames) + sum(summary.left_out)
    step = min((h.row_stride for h in summary.histograms), default=1)
    if used == given and step == 1:
        return []
    frames = f"{used} of {given} dark frames, spread evenly over each exposure" if used < given else "all dark frames"
    rows = f", and one row in {step} of them" if step > 1 else ""
    return [f"To save memory, this fit uses {frames}{rows}; the standard errors are for the data used."]


def order_note(result: FitResult) -> list[str]:
    """Means that fall as the exposure grows."""
    for h in result.summary.histograms:
        order = np.argsort(result.summary.exposure_s, kind="stable")
        level, error = _levels([h])[order], _level_errors(h)[order]
        falls = np.diff(level) < -np.maximum(1.0, FALL_SIGMAS * np.hypot(error[1:], error[:-1]))
        if falls.any():
            e = int(np.where(falls, np.diff(level), 0.0).argmin())
            short, long = result.summary.exposure_s[order[[e, e + 1]]]
            described = "black_clamp" in result.params
            what = " (black_clamp)" if described else ", which this model does not describe"
            return [
                f"The mean count falls by {level[e] - level[e + 1]:.3g} DN from {short:g} s to {long:g} s: are the"
                f" exposures right? If so, the camera subtracts its dark signal{what}."
            ]
    return []


def _warming_note(result: FitResult) -> list[str]:
    """The strongest drift of the mean from the first frame of an exposure to the last."""
    found = [(abs(change), change, e) for e, change in enumerate(_drifts(result)) if abs(change) > WARMING]
    if not found:
        return []
    _, change, e = max(found)
    return [
        f"The dark signal {'rises' if change > 0 else 'falls'} by {abs(change):.0%} from the first frame at"
        f" {result.summary.exposure_s[e]:g} s to the last: the sensor temperature changes, or light gets in. Let the"
        " sensor settle before a series; hsnoise diagnose shows whether the drift matters."
    ]


def _drifts(result: FitResult) -> list[float]:
    """Relative change of the dark signal over the frames of each exposure, by a straight line; 0 if within chance."""
    summary, drifts = result.summary, []
    least = DRIFT_SIGMA * _noise_dn(result) if summary.histograms else 0.0  # smallest mean that counts as a signal
    black = float(np.mean(np.asarray(black_level(result.params))))
    for e, frames in enumerate(summary.n_frames if summary.histograms else ()):
        pixels = sum(h.row_pixels[e, :frames].sum(1) for h in summary.histograms)
        means = sum(h.row_sum[e, :frames].sum(1) for h in summary.histograms) / np.maximum(pixels, 1) - black
        drifts.append(_trend(means) / means.mean() if frames >= FEWEST_IN_SERIES and means.mean() > least else 0.0)
    return drifts


def _trend(values: np.ndarray) -> float:
    """Change from the first to the last of a series by a straight line; 0 if it is within the scatter about it."""
    time = np.arange(len(values)) - (len(values) - 1) / 2
    slope = float(time @ values / (time @ time))
    left = values - values.mean() - slope * time
    error = np.sqrt(left @ left / (len(values) - 2) / (time @ time))
    return slope * (len(values) - 1) if abs(slope) > WARMING_SIGMA * error else 0.0


def is_extraordinary(result: FitResult) -> bool:
    """Whether the dark current is larger than that of any sensor in the dark."""
    return bool(result.table.get("dark_current.rate", (0.0,))[0] >= LIGHT_E_PER_S)


def _light_note(result: FitResult) -> list[str]:
    exposures = result.summary.exposure_s
    if not len(exposures):
        return []
    levels = _levels(result.summary.histograms)
    if len(levels) > 1 and np.ptp(exposures) == 0 and np.ptp(levels) > DRIFT_SIGMA * _noise_dn(result):
        return [
            f"All exposures are given as {exposures[0]:g} s, but their means range from {levels.min():.4g} to"
            f" {levels.max():.4g} DN: check exposure_s, and whether the sensor warmed up."
        ]
    if _is_lit(result, levels):
        return [
            f"The frames have a mean of {levels.min():.4g} DN even at {exposures.min():g} s and are hardly brighter at"
            f" {exposures.max():g} s: if they saw light, they are flats; pass {setting('kind', 'flat')}."
        ]
    if not is_extraordinary(result):
        return []
    rate = result.table["dark_current.rate"][0]
    return [
        f"A dark current of {rate:.3g} e-/s would be extraordinary: if these frames saw light, they are flats;"
        f" pass {setting('kind', 'flat')}."
    ]


def _levels(histograms: Sequence[RowHistograms]) -> np.ndarray:
    """Mean count [exposure], DN, over all these channels."""
    total = sum(h.row_sum.sum((1, 2)) for h in histograms)
    return total / np.maximum(sum(h.counts.sum((1, 2, 3), dtype=np.float64) for h in histograms), 1)


def _level_errors(h: RowHistograms) -> np.ndarray:
    """Standard errors of the mean counts [exposure], DN, by how frames differ."""
    pixels = h.row_pixels.sum(2)
    frames = h.row_sum.sum(2) / np.maximum(pixels, 1)
    several = [of[there] for of, there in zip(frames, pixels > 0, strict=True)]
    scatter = np.sqrt(np.mean([of.var(ddof=1) for of in several if len(of) > 1] or [0.0]))
    return np.array([scatter / np.sqrt(max(len(of), 1)) for of in several])


def _noise_dn(result: FitResult) -> float:
    """Smallest standard deviation within rows of all dark exposures, DN."""
    h = result.summary.histograms[0]
    pixels = np.maximum(h.row_pixels, 1)
    variance = h.row_sum_of_squares / pixels - (h.row_sum / pixels) ** 2
    return float(np.sqrt(min(v[p > 1].mean() for v, p in zip(variance, h.row_pixels, strict=True))))


def _is_lit(result: FitResult, levels: np.ndarray) -> bool:
    """Whether the signal is far above a known black level and does not grow with exposure."""
    summary = result.summary
    if summary.black_level_dn is None or len(levels) < 2 or summary.exposure_s.max() < 1.5 * summary.exposure_s.min():
        return False
    signal = levels - float(np.mean(summary.black_level_dn))
    low, high = signal[summary.exposure_s.argmin()], signal[summary.exposure_s.argmax()]
    return bool(low > LIT_SIGMA * _noise_dn(result) and high < 1.2 * low)
