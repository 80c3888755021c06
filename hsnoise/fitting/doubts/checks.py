"""No number without a check: sentences on where a fit disagrees with its frames, and what is withheld.

`_drawn`: the components that determine a parameter, measured and in frames drawn from the fit. `_stated`: values from
headers and the user (gain, black and white level, shutter, colours). `_lines`: rows and columns that are no pattern.
`_taps`: outputs with gains of their own. `_shared`: noise that is not a pixel's own. `_few`: what two or three frames
leave open. `_pooled`: what pooled histograms hide. `_waiting`: dark signal without exposure, or subtracted. `_choice`:
which of two fits to believe. Here: a gain without growth of signal to support it, frames and pixels that measure
nothing, and the order of all checks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hsnoise._core.types import seconds
from hsnoise.fitting.doubts._choice import APART_SHARE, APART_SIGMAS, carries_no_gain, confirmed
from hsnoise.fitting.doubts._drawn import disagreements
from hsnoise.fitting.doubts._evidence import Evidence
from hsnoise.fitting.doubts._few import few_frames, single_frames
from hsnoise.fitting.doubts._lines import curves, defects
from hsnoise.fitting.doubts._pooled import of_pooling, offsets_dn
from hsnoise.fitting.doubts._register import of_register
from hsnoise.fitting.doubts._shared import shared_noise
from hsnoise.fitting.doubts._stated import header_gain, stated
from hsnoise.fitting.doubts._taps import columns_in_light, gains_differ, outputs, outputs_differ
from hsnoise.fitting.doubts._waiting import noise_alone, waiting
from hsnoise.fitting.flat_notes import flat_doubts, gain_notes
from hsnoise.fitting.notes import is_extraordinary, order_note, pixel_notes
from hsnoise.fitting.pixel_fit import PixelFit
from hsnoise.fitting.result import FitResult, Method, Status
from hsnoise.likelihood.parameters import numbers_of, read_noise_dn
from hsnoise.statistics.pixels.companding import companded
from hsnoise.statistics.pixels.oddities import lit_darks, moved_frames, oddities_of, pixels_apart
from hsnoise.statistics.pixels.structure import fall_of, noise_spread
from hsnoise.statistics.pixels.survey import Survey
from hsnoise.statistics.pixels.transfer import ROUNDING, Transfer

__all__ = ["Evidence", "carries_no_gain", "checked", "confirmed"]

OPEN = 1.0  # relative error of a gain above which it counts as unknown
ADD = "Add flats (pairs of evenly lit frames at several brightnesses), or darks long enough for their signal to show."
OFF_LINE = 3.0  # chi2 per degree of freedom
MANY_OUTLIERS, MOST_OUTLIERS = 3e-3, 0.05  # share of pixels that is reported; above which a fit is not trusted
CLIPPED_SHARE, NOISE_SPREAD = 1e-3, 0.2  # share of counts; of a pixel's temporal variance, relative deviation
MOST_CLIPPED = 0.02  # share of counts: where it is cut so near, the noise comes out 2 % too small
LONG_S = 0.5  # of the only dark exposure, from which its dark signal may show
LEAST_STEPS = 0.8  # of a step of the codes: with less noise rounding is no noise of its own
MANY_HOT = 0.15  # share of pixels
BELOW_ZERO = 4.0  # standard errors of a variance


def checked(result: FitResult, seen: Evidence) -> FitResult:
    """The result with its doubts, and notes on what it does not determine."""
    found, result = seen.survey, _without_open_gain(result)
    coarse, of_pixels = (_noise_below_a_step, _clipped), (_of_transfer, _below_zero, _falling, noise_alone, of_pooling)
    checks = (single_frames, *coarse, *of_pixels, disagreements)
    open_gain = [*_withheld(result, found)]
    grave = [sentence for check in checks for sentence in check(result, found)]
    odd = oddities_of(found)
    grave += [*stated(result, seen), *odd]
    moved, (much, little) = tuple(moved_frames(found, offsets_dn(result))), shared_noise(result, found)
    grave += moved if result.transfer is None else ()
    grave += much
    share = _outlier_share(result)
    alone = tuple(_by_shape_alone(result))
    grave += alone if is_extraordinary(result) else ()
    minor = (
        *alone,
        *of_register(result),
        *_fallen_back(result),
        *_coarse_codes(result, found),
        *_signal_of_one_exposure(result, found),
        *header_gain(result),
        *order_note(result),
        *pixels_apart(found, _has_noisy_pixels(result)),
        *little,
        *lit_darks(found),
        *moved,
        *_outliers(result),
        *_moved_pedestals(result),
        *_many_hot(result),
        *few_frames(result, found),
        *curves(result),
        *gains_differ(result, found),
        *flat_doubts(result),
        *companded(found),
    )
    doubts = tuple(dict.fromkeys([*odd, *open_gain, *grave, *minor]))  # first what makes all others pointless
    is_wrong = bool(grave) or share > MOST_OUTLIERS
    notes = result.notes
    if result.method == Method.TRANSFER:
        notes = (
            *pixel_notes(result),
            *defects(result),
            *outputs(result),
            *columns_in_light(result),
            *_of_codes(found),
            *_of_neighbours(result),
            *waiting(result, found),
            *_of_narrow(result, found),
            *_of_flats(result),
        )
    notes = tuple(note for note in notes if note not in doubts)
    return replace(result, doubts=doubts, grave=is_wrong or bool(open_gain), grave_in_dn=is_wrong, notes=notes)


def _without_open_gain(result: FitResult) -> FitResult:
    """The result; if a pooled fit leaves the gain unknown, with all parameters in electrons withheld."""
    gains = list(result.rows_of("gain").values())
    if result.transfer is not None or not result.has_gain or all(error < OPEN * value for value, error, _ in gains):
        return result
    names = tuple(number.name for number in numbers_of(result.params) if number.is_in_electrons)
    return replace(result, withheld=tuple(dict.fromkeys((*result.withheld, *names))))


def _withheld(result: FitResult, found: Survey) -> Iterator[str]:
    """Which parameters are withheld, what is known instead, and which capture would determine them."""
    if result.has_gain:
        return
    pixel: PixelFit | None = result.transfer
    if pixel is None:
        read_dn = read_noise_dn(result.params)
        yield f"The gain is not determined: these darks do not show it. Read noise is {read_dn:.4g} DN. {ADD}"
        return
    floor = float(np.mean([c.values[1] for c in pixel.channels]))
    error = float(np.sqrt(np.mean([c.covariance[1, 1] for c in pixel.channels]) / len(pixel.channels)))
    read_dn = np.sqrt(max(floor - ROUNDING, 0.0))
    hot = [c.transfer for c in pixel.channels if c.transfer is not None and np.isfinite(c.transfer.hot_gain)]
    bounds = [t for t in hot if t.hot_gain > 3 * t.hot_error]
    if bounds:
        low = max(min(t.hot_gain - 2 * t.hot_error for t in bounds), 0.0)
        high = 2 * max(t.hot_gain + 2 * t.hot_error for t in bounds)
        why = (
            "only hot pixels grow with exposure, and their noise is below Poisson by an unknown factor of 1 to 2. The"
            f" gain lies between {low:.3g} and {high:.3g} DN/e-"
        )
    elif not found.has_exposures:
        why = "darks of one exposure show no growth of signal"
    elif _grows(pixel, read_dn):
        why = "the noise of ordinary pixels does not grow with their dark signal as shot noise does"
    else:
        why = "the dark signal of ordinary pixels does not grow enough with exposure"
    yield (
        f"The gain is not determined: {why}. {_named_noise(found)} is {read_dn:.4g} ±"
        f" {error / max(2 * read_dn, 1e-9):.2g} DN. {ADD}"
    )


def _grows(pixel: PixelFit, read_dn: float) -> bool:
    """Whether the dark signal of ordinary pixels exceeds the noise without signal."""
    told = [t for c in pixel.channels if (t := c.transfer) is not None]
    return any(np.median(np.ptp(t.classes.level_dn[~t.classes.hot], axis=1)) > read_dn for t in told)


def _named_noise(found: Survey) -> str:
    """What to call the noise without signal; with one exposure it includes that exposure's dark shot noise."""
    shortest_s = found.shortest.exposure_s if found.shortest is not None else 0.0
    if found.has_exposures or shortest_s == 0:
        return "Read noise"
    return f"The noise at {shortest_s:g} s, shot noise included,"


def _of_transfer(result: FitResult, found: Survey) -> Iterator[str]:
    """Where pixels deviate from the photon transfer line, and where flats and darks disagree."""
    pixel = result.transfer
    if pixel is None:
        return
    for channel in pixel.channels:
        t: Transfer | None = channel.transfer
        of = "" if channel.name == "mono" else f" of {channel.name}"
        if t is None or not result.has_gain or pixel.flats is not None:
            continue  # the gain does not come from there
        if t.chi2 > OFF_LINE * max(t.dof, 1):
            yield (
                f"The variance of the pixels{of} is not linear in their level (chi2 {t.chi2:.0f} for {t.dof:.0f}"
                " degrees of freedom): telegraph noise, a nonlinear response, or charge that spreads."
            )
    if pixel.flats is not None:
        yield from _flats_against_darks(pixel)


def _below_zero(result: FitResult, found: Survey) -> Iterator[str]:
    """A variance that is less than nothing where the photon transfer line ends."""
    for channel in result.transfer.channels if result.transfer is not None and result.has_gain else ():
        left, error = channel.values[1] - ROUNDING, float(np.sqrt(channel.covariance[1, 1]))
        if left < -BELOW_ZERO * error:
            of = "" if channel.name == "mono" else f" of {channel.name}"
            yield (
                f"Without signal the variance of the pixels{of} would be {left:.3g} ± {error:.2g} DN^2, less than"
                " nothing: an exposure is not what the files say, or what grows with exposure is not all charge."
            )


def _moved_pedestals(result: FitResult) -> Iterator[str]:
    """Pedestals that moved; the gain then does not depend on them."""
    pixel = result.transfer
    if "black_clamp" in result.params or any(outputs_differ(result)):  # outputs of other gains look like a pedestal
        return
    for channel in pixel.channels if pixel is not None and pixel.flats is None and result.has_gain else ():
        t, of = channel.transfer, "" if channel.name == "mono" else f" of {channel.name}"
        if t is not None and t.moved.any():
            e = int(np.argmax(t.moved))
            yield (
                f"The pedestal{of} moved by {t.pedestal_dn[e]:+.2g} DN at {t.classes.exposure_s[e]:g} s, more than its"
                " frames differ: the gain at this exposure comes from differences between pixels."
            )


def _flats_against_darks(pixel: PixelFit) -> Iterator[str]:
    for c, channel in enumerate(pixel.channels):
        t = channel.transfer
        if t is None or not t.ordinary_error < 0.2 * abs(t.ordinary_gain):
            continue
        flat, error = pixel.flats.gain[c], pixel.flats.standard_error[c]
        if abs(flat - t.gain) > max(APART_SIGMAS * np.hypot(error, t.gain_error), 2 * APART_SHARE * flat):
            yield (
                f"Flats give a gain of {flat:.4g} ± {error:.2g} DN/e-, darks {t.gain:.4g} ± {t.gain_error:.2g}: one of"
                " them is wrong (another gain setting, a nonlinear response, moving pedestals)."
            )


def _by_shape_alone(result: FitResult) -> Iterator[str]:
    """A gain from the likelihood of one exposure: no growth of the signal supports it."""
    summary = result.summary
    if result.method != Method.ML or not result.has_gain or summary.flats is not None:
        return
    if np.unique(summary.exposure_s).size == 1:
        yield (
            "All darks have one exposure, so the gain rests on the shape of their distribution and on how rows differ;"
            " other skewed noise or row noise would change it as well. Confirm it with a pair of flats, or darks of a"
            " second exposure."
        )


def _clipped(result: FitResult, found: Survey) -> Iterator[str]:
    """Clipping of pixels whose noise differs: the correction assumes one noise for all pixels of a class.

    Without a gain there are no classes, and noise and level are those of the clipped counts.
    """
    if result.transfer is None:
        return
    for c, _ in enumerate(found.channels):
        clipped = max((group.clipped_share[c] for group in found.repeated_darks), default=0.0)
        if not result.has_gain and clipped > MOST_CLIPPED:
            yield (
                f"{100 * clipped:.2g} % of the counts are clipped at 0: read noise comes out too small, the black level"
                " too high, and growth with exposure is hidden. Raise the black level."
            )
            return
        if result.has_gain and clipped > CLIPPED_SHARE and noise_spread(found, c) > NOISE_SPREAD:
            yield (
                f"{100 * clipped:.2g} % of the counts are clipped at 0 and pixels differ in noise: the correction for"
                " clipping is uncertain, and gain and read noise may be off by several percent. Raise the black level."
            )
            return


def _falling(result: FitResult, found: Survey) -> Iterator[str]:
    """A level that falls with exposure by more than a pixel's noise: swapped exposures, or a subtracted dark."""
    fallen = fall_of(found)
    # If single pixels grow all the same, exposures are not swapped.
    if fallen is not None and not (result.has_gain and "black_clamp" in result.params):
        one, other, fall = fallen
        yield (
            f"The level falls by {fall:.3g} DN from {one.exposure_s:g} s to {other.exposure_s:g} s, more than a"
            " pixel's noise: exposures are swapped, or the camera subtracts its dark signal."
        )


def _outlier_share(result: FitResult) -> float:
    """Largest share of pixels that were excluded for an outlier."""
    channels = result.transfer.channels if result.transfer is not None else ()
    return max((float(c.transfer.classes.outlier_share.max()) for c in channels if c.transfer is not None), default=0.0)


def _many_hot(result: FitResult) -> Iterator[str]:
    """A population that the effects of the model do not describe."""
    share = result.table.get("hot_pixels.fraction", (0.0,))[0]
    if share > MANY_HOT:
        yield (
            f"{100 * share:.2g} % of the pixels came out as hot: dark currents are not log-normal with a few hot pixels"
            " above. The model's mean over all pixels is right, but its distribution is only rough."
        )


def _fallen_back(result: FitResult) -> Iterator[str]:
    if result.status == Status.LINE_INSTEAD:
        yield (
            f"Maximum likelihood did not converge ({result.detail}): these are the numbers of the line fit, which does"
            " not separate dark current from read noise at a single exposure, and takes no account of outliers."
        )


def _signal_of_one_exposure(result: FitResult, found: Survey) -> Iterator[str]:
    """That the shot noise of a dark signal is in the read noise, where no other exposure tells how much."""
    if result.transfer is None or not result.has_gain or found.shortest is None or found.has_exposures:
        return
    if found.shortest.exposure_s > LONG_S and "electron_multiplication" not in result.params:
        single = [seconds(group.exposure_s) for group in found.darks if group.exposure_s != found.shortest.exposure_s]
        of_them = f"All darks{' of two frames or more' if single else ''} are of {seconds(found.shortest.exposure_s)}"
        more = f" (of {', '.join(single)} there is one frame)" if single else ""
        yield (
            f"{of_them}, and the shot noise of their dark signal is in the read noise: add bias frames, or darks of"
            f" another exposure{more}."
        )


def _noise_below_a_step(result: FitResult, found: Survey) -> Iterator[str]:
    if result.transfer is None or found.code_step == 1:
        return
    sigma = float(np.sqrt(min(channel.values[1] for channel in result.transfer.channels)))
    if sigma < LEAST_STEPS * found.code_step:
        yield (
            f"All counts are multiples of {found.code_step} DN, and the noise, {sigma:.3g} DN, is less: divide counts"
            f" and levels by {found.code_step}, and fit again."
        )


def _coarse_codes(result: FitResult, found: Survey) -> Iterator[str]:
    if result.transfer is None and found.code_step > 1 and "missing_codes" not in result.params:
        yield (
            f"All counts are multiples of {found.code_step} DN, and this fit takes their rounding for read noise:"
            f" {found.code_step / np.sqrt(12):.2g} DN rms. Divide counts and levels by {found.code_step}, if its codes"
            " are that far apart because they were shifted."
        )


def _of_codes(found: Survey) -> Iterator[str]:
    if found.code_step > 1:
        yield f"All counts are multiples of {found.code_step} DN; the noise of their rounding is not in the read noise."


def _has_noisy_pixels(result: FitResult) -> bool:
    """Whether an effect of the model draws pixels that are far noisier than others, always or in a frame."""
    of = result.params["read_noise_nonuniformity"] if "read_noise_nonuniformity" in result.params else None
    by_name = {"random_telegraph_noise", "electron_multiplication"} & set(result.params.names)
    return bool(by_name) or (of is not None and float(of.tail) > 0)


def _outliers(result: FitResult) -> Iterator[str]:
    """Pixels that were excluded because of an outlier in some frame."""
    pixel = result.transfer
    for channel in pixel.channels if pixel is not None and not _has_noisy_pixels(result) else ():
        share = 0.0 if channel.transfer is None else float(channel.transfer.classes.outlier_share.max())
        if share > MANY_OUTLIERS:
            of = "" if channel.name == "mono" else f" of {channel.name}"
            yield (
                f"{100 * share:.2g} % of the pixels{of} have an outlier in some frame (cosmic rays, telegraph jumps):"
                " the fit excludes them."
            )


def _of_flats(result: FitResult) -> list[str]:
    pixel = result.transfer
    if pixel.flats is None:
        return []
    return gain_notes(pixel.flats, result.summary.flats, result.summary.channels, [one.bend for one in pixel.channels])


def _of_neighbours(result: FitResult) -> Iterator[str]:
    """What correlated read noise means for neighbours."""
    ringing = result.transfer.ringing if result.transfer is not None else None
    if ringing is not None and "correlated_read_noise" in result.params:
        share = ringing.share[0] * ringing.memory[0] * np.cos(2 * np.pi * ringing.frequency[0])
        unlit = result.summary.flats is None and not result.summary.exposure_s.any()
        signal = "; whether their signal is, too, only lit frames show" if unlit else "; their shot noise is not"
        yield (
            f"The read noise of neighbours along a row is correlated by {100 * share:+.2g} %{signal}"
            " (correlated_read_noise)."
        )


def _of_narrow(result: FitResult, found: Survey) -> Iterator[str]:
    """An upper limit of read noise that is narrower than a count."""
    planes = found.shortest.planes if found.shortest is not None else ()
    bounds = [plane.narrow_dn[1] for plane in planes if plane.narrow_dn]
    if not bounds or not np.isfinite(max(bounds)):
        return
    bound, gain = max(bounds), float(np.mean(np.asarray(result.params["gain"].value)))
    electrons = f", {bound / gain:.3g} e-" if result.has_gain else ""
    yield (
        f"The noise of the darks is narrower than a count, and rounding hides most of it: read noise is below"
        f" {bound:.2g} DN{electrons}. A higher gain setting, or more bits, would show it."
    )
