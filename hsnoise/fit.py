"""`fit`: from dark frames (and flats) to a camera's parameters with honest standard errors."""

from __future__ import annotations

import logging
from dataclasses import replace

import jax
import numpy as np

from hsnoise._core.forking import check_not_forked
from hsnoise._core.naming import named
from hsnoise.fitting.doubts.checks import Evidence, carries_no_gain, checked, confirmed
from hsnoise.fitting.line import line_fit
from hsnoise.fitting.maximise import maximise
from hsnoise.fitting.notes import closing_notes, outlier_fraction
from hsnoise.fitting.pixel_flats import flats_need_pixels
from hsnoise.fitting.pixel_register import has_register
from hsnoise.fitting.pixel_result import followed, result_of
from hsnoise.fitting.problem import check_named
from hsnoise.fitting.profile import profile_errors
from hsnoise.fitting.result import FitResult, Method, Status
from hsnoise.fitting.simulated import draft_synthetic
from hsnoise.frames.arguments import check_no_copies
from hsnoise.frames.mosaics import warn_of_a_mosaic
from hsnoise.frames.source import as_stack
from hsnoise.likelihood.coordinates import Coordinates, coordinates_for
from hsnoise.likelihood.darks import dark_current, flat_gain_of
from hsnoise.likelihood.flat_gain import judged
from hsnoise.likelihood.moments import start_model
from hsnoise.likelihood.parameters import within_bounds
from hsnoise.likelihood.summary import Summary, far_outliers, summarise
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import check_effects, check_fits
from hsnoise.simulation.portion import Portion
from hsnoise.statistics.pixels.probe import all_of, surveyed
from hsnoise.statistics.pixels.structure import can_be_transferred, pixels_differ, rows_dominate
from hsnoise.statistics.pixels.survey import Survey

log = logging.getLogger(__name__)

OUTLIERS_FROM = 1e-4
SMALLEST = 8  # rows and columns; fewer say nothing about rows
METHODS = ("auto", "ml", "line", "transfer")
PIXELS = ("auto", "alike", "differ")
WHITE_SIGMA, WHITE_BELOW = 3.0, 0.5  # standard errors, and what they are at most, within which rows may be white
LIKELIER = float(np.log(20))  # nats by which they are preferred: odds of 20 to 1
EDGE_DN = 0.5  # from the middle of a count to where it is rounded to the next
AT_EDGE = (
    "{} lies at a step of the likelihood, where rows whose gain the model clips at 0 are rounded to the next count: it"
    " is known only to half a count. Such rows suggest that the model lacks an effect: run hsnoise.compare."
)


def without_likelihood(model: NoiseModel) -> tuple[str, ...]:
    """The effects of a model that only simulated statistics can fit."""
    return tuple(effect.name for effect in model if not effect.in_likelihood)


def fit(
    stack,
    *,
    model: NoiseModel | None = None,
    method: str = "auto",
    pixels: str = "auto",
    progress=None,
    **keywords,
) -> FitResult:
    """Estimate all parameters of the paper's noise model jointly.

    If pixels differ in the dark, as in real sensors, the fit is conditional on the pixel (`hsnoise.pixel_fit`), and
    their population becomes effects of the model. Otherwise the pixels of a row are pooled in the exact likelihood. A
    test on the frames decides.

    Args:
        stack: a path or a list of paths, with the keywords of `hsnoise.load`; a FrameStack, or a `Summary` of one; or
            with FrameStack's keywords (exposure_s, black_level, white_level, cfa, shutter, kind, ...) an array
            [frame, row, column] or [exposure, frame, row, column], or a list of arrays [frame, row, column], one an
            exposure.
        model: which effects to fit, for example `hsnoise.cameras.canon_5d3().remove("row_gain")`. Its values are not
            used, except `row_gain.white_share`: 0 and 1 are held, and any other value is where its search starts.
            Default: all of the paper's, with a white row gain where the likelihood prefers one. Effects beyond the
            paper's are fitted by simulated statistics, together with all others (`hsnoise.synthetic`); their values are
            where the search starts.
        method: "ml" joint maximum likelihood; "line" the paper's line fit with clip-correction tables; "transfer" pixel
            transfer alone; "auto" is "ml", and if that does not converge, "transfer" or "line", as the result then
            states. With effects beyond the paper's it is the method of the fit before the simulation.
        pixels: "alike" always pools the pixels, "differ" never does, "auto" tests whether they differ.
        progress: called with no argument after each frame that has been read.

    Returns:
        FitResult: `print` it for the table; `params` goes to `hsnoise.sample`.

    Raises:
        FileNotFoundError, TypeError, ValueError: for bad input, before any long work; ValueError for effects that
            cannot be fitted.
        RuntimeError: if method="ml" does not converge; in a process that was forked after JAX had started.

    Reference: Wang et al., "Enhancing Low Light Videos by Exploring High Sensitivity Camera Noise", ICCV 2019; the
    likelihood is derived in docs/likelihood.md.
    """
    if method not in METHODS:
        raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
    if pixels not in PIXELS:
        raise ValueError(f"pixels: expected one of {', '.join(PIXELS)}, got {pixels!r}")
    if model is not None and not isinstance(model, NoiseModel):
        raise TypeError(f"{named('model')}: expected a NoiseModel, got {type(model).__name__}")
    check_not_forked()
    source = stack if isinstance(stack, Summary) else as_stack(stack, **keywords)
    if isinstance(source, Summary) and (method == "transfer" or pixels == "differ"):
        raise ValueError("stack: pixel transfer needs the frames themselves, got a Summary of them")
    if model is not None:
        check_fits(model, source, "model")  # before the frames are read
        check_named(model)
    if not isinstance(source, Summary):
        _check_size(source)
    extra = () if model is None else without_likelihood(model)
    found = None if isinstance(source, Summary) or "dark" not in source.kind else surveyed(source)
    measurable = found is not None and (model is None or "black_clamp" not in model)
    differ = measurable and _is_conditional(found, method, pixels)
    seen = None
    of_pixels = followed(found) if measurable and extra else set()
    if measurable and not differ and pixels == "auto" and not of_pixels.isdisjoint(extra):
        seen = Evidence(found, _summary_of(source, progress))
        differ = carries_no_gain(seen, method)  # what single pixels tell is not to be simulated
    simulated = tuple(name for name in extra if not (differ and name in of_pixels))
    if simulated:
        result = replace(_with_effects(source, model, simulated, method, pixels, progress), stack=source)
        return _ended(result if found is None else checked(result, Evidence(found, result.summary)))
    if model is not None:
        _check_complete(model)
    if found is None:
        summary = source if isinstance(source, Summary) else _summary_of(source, progress)
        return _ended(_pooled(summary, model, method))
    seen = seen or Evidence(found, _summary_of(source, progress))
    summary = seen.summary
    if differ or measurable and pixels == "auto" and carries_no_gain(seen, method):
        log.info("Following each pixel over time: %s", "pixels differ" if differ else "pooled, they show no gain")
        return _ended(checked(result_of(seen.measured(all_of(source, found)), summary, model, source), seen))
    result = replace(_pooled(summary, model, method), stack=source)
    return _ended(checked(confirmed(result, seen, model) if pixels == "auto" and method != "line" else result, seen))


def _ended(result: FitResult) -> FitResult:
    log.info("Fit: %s", result.conclusion)
    log.debug("%s", result)
    return result


def _pooled(summary: Summary, model: NoiseModel | None, method: str) -> FitResult:
    """The exact likelihood, or the line fit, with the pixels of a row pooled."""
    with_row_gain = model is None or "row_gain" in model
    with_clamp = model is not None and "black_clamp" in model
    if with_clamp:
        _check_clamp(summary, method)
    white_share = _white_share(model)
    if white_share is not None and method == "line":
        raise ValueError("method: the line fit has no row_gain.white_share, which the model has; use ml")
    if not summary.histograms and summary.black_level_dn is None:
        raise ValueError(
            f"{named('black_level')}: flats alone cannot separate the black level from read noise; give"
            f" {named('black_level')} or add dark frames"
        )
    with jax.enable_x64(True):
        start = start_model(summary, with_row_gain, with_clamp)
        summary = _with_judged_flats(summary, start)
        if model is not None and "dark_current" not in model:
            start = start.remove("dark_current")
        if white_share is not None:
            start = start.with_value("row_gain", "white_share", white_share)
            start = start if white_share < 1 else start.with_value("row_gain", "exponent", 0.0)
        if method == "line":
            return _by_line(summary, model, Status.LINE)
        log.info("Maximising the likelihood of rows, pixels pooled")
        # Pixels that do not follow this model could make the fit meaningless unless they have their own component.
        outside = far_outliers(summary)
        result, converged = _by_likelihood(summary, model, start, _set_apart(outside))
        if (outside <= OUTLIERS_FROM).all():
            outside = outlier_fraction(result)
            if (outside > OUTLIERS_FROM).any():
                result, converged = _by_likelihood(summary, model, start, _set_apart(outside))
        if converged:
            return result if model is not None else _white_if_likelier(result, summary, outside)
        if method == "ml" or with_clamp or white_share is not None:
            raise RuntimeError(f"fit: maximum likelihood did not converge: {result.detail}")
        return _by_line(summary, model, Status.LINE_INSTEAD, result.detail)


def _with_judged_flats(summary: Summary, start: NoiseModel) -> Summary:
    """The summary with the curve of the flats' variance and the levels' weights, which the likelihood needs."""
    if summary.flats is None:
        return summary
    return replace(summary, flats=judged(summary.flats, flat_gain_of(start, summary.flats)))


def _set_apart(share: np.ndarray) -> np.ndarray | None:
    """Where a component for outliers starts [exposure]; None if they are few."""
    return None if (share <= OUTLIERS_FROM).all() else np.clip(share, OUTLIERS_FROM, 0.2)


def _with_effects(stack, model: NoiseModel, extra: tuple[str, ...], method: str, pixels: str, progress) -> FitResult:
    """A fit of the base effects, then of all together by simulated statistics."""
    if isinstance(stack, Summary):
        raise ValueError(f"stack: fitting {', '.join(extra)} needs the frames themselves, got a Summary of them")
    portion = Portion.of(stack)
    check_effects(model, portion.frames)
    log.info("Effects beyond the paper's, by simulated statistics after a fit of the others: %s", ", ".join(extra))
    bare = model
    for name in extra:
        bare = bare.remove(name)
    base = fit(stack, model=bare, method=method, pixels=pixels, progress=progress)
    return draft_synthetic(base, portion, model).finished()


def rechecked(result: FitResult, stack) -> FitResult:
    """The result with the doubts of its own model, instead of those of the fit that it started from."""
    return checked(result, Evidence(surveyed(stack), result.summary))


def _is_conditional(found: Survey, method: str, pixels: str) -> bool:
    """Whether the fit is conditional on the pixel."""
    if (always := method == "transfer" or pixels == "differ") or method == "line" or pixels == "alike":
        return always
    needed = pixels_differ(found) or rows_dominate(found) or flats_need_pixels(found)
    return (needed and can_be_transferred(found)) or has_register(found)


def _check_size(stack) -> None:
    """Raise ValueError for frames that cannot be fitted, before any long work."""
    stack.check()
    rows, columns = stack.shape
    if min(rows, columns) < SMALLEST:
        raise ValueError(
            f"counts: a fit needs frames of at least {SMALLEST} x {SMALLEST} pixels, got {rows} x {columns}"
        )


def _summary_of(stack, progress) -> Summary:
    log.info("Reading %d frames of %d x %d pixels", sum(stack.n_frames), *stack.shape)
    if stack.cfa == "mono":
        warn_of_a_mosaic(stack.frame(int(np.argmax(stack.exposure_s)), 0))
    summary = summarise(stack, progress)
    _check_copies(summary)
    return summary


def _check_copies(summary: Summary) -> None:
    def prints(e: int, n: int):
        sums = [(h.row_sum[e, :n], h.row_sum_of_squares[e, :n]) for h in summary.histograms]
        return (frame.tobytes() for frame in np.concatenate([x for pair in sums for x in pair], axis=1))

    check_no_copies((prints(e, n) for e, n in enumerate(summary.n_frames)), summary.exposure_s)


def _check_complete(model: NoiseModel) -> None:
    """Raise ValueError for a model without the effects that every fit needs."""
    missing = [name for name in ("shot_noise", "read_noise", "gain", "adc") if name not in model]
    if missing:
        raise ValueError(f"{named('model')}: has no {', '.join(missing)}, without which it cannot be fitted")


def _white_share(model: NoiseModel | None) -> np.ndarray | None:
    """The white share of a model's row gain; None for 0."""
    if model is None or "row_gain" not in model:
        return None
    share = np.asarray(model["row_gain"].white_share, np.float64)
    return share if share > 0 else None


def _check_clamp(summary: Summary, method: str) -> None:
    if method == "line":
        raise ValueError("method: the line fit gets the dark signal from means, where black_clamp hides it; use ml")
    if not summary.histograms or np.ptp(summary.exposure_s) == 0:
        raise ValueError(f"{named('model')}: black_clamp needs darks of two or more exposures, which this stack lacks")


def _by_likelihood(summary: Summary, model, start: NoiseModel, outliers) -> tuple[FitResult, bool]:
    log.debug("Start of the likelihood: %s", start)
    coordinates = coordinates_for(summary, start, outliers)
    maximum = maximise(coordinates, summary)
    log.info("Maximum likelihood, %d iterations: %s", maximum.iterations, maximum.outcome)
    covariance = _covariance(maximum.information)
    if maximum.converged:
        deviation = np.sqrt(np.diagonal(covariance))
        grown = np.maximum(profile_errors(coordinates, maximum, summary) / deviation, 1.0)
        covariance = covariance * grown[:, None] * grown[None, :]
        covariance = covariance + _of_hidden_dark_level(covariance, coordinates, maximum.model, summary)
    edges = _edges(covariance, coordinates, maximum.model, summary)
    grown = np.where(edges, EDGE_DN / np.sqrt(np.diagonal(covariance)), 1.0)
    covariance = covariance * grown[:, None] * grown[None, :]
    kept = [i for i, number in enumerate(coordinates.numbers) if not number.is_nuisance]
    result = FitResult(
        params=_fitted(maximum.model, model, start.exposure_s),
        outliers=maximum.outliers,
        names=tuple(coordinates.names[i] for i in kept),
        covariance=covariance[np.ix_(kept, kept)],
        method=Method.ML,
        status=Status.CONVERGED if maximum.converged else Status.NOT_CONVERGED,
        detail=maximum.outcome,
        iterations=maximum.iterations,
        log_likelihood=maximum.log_likelihood,
        notes=(),
        summary=summary,
    )
    at_edges = tuple(AT_EDGE.format(name) for name, edge in zip(coordinates.names, edges, strict=True) if edge)
    return result.with_notes((*at_edges, *closing_notes(result))), maximum.converged


def _white_if_likelier(result: FitResult, summary: Summary, outside: np.ndarray) -> FitResult:
    """The fit with a white row gain, where the exponent is compatible with 0 and the likelihood prefers white rows.

    Both spectra are flat, but only white rows move the mean of a frame, which would pass for another effect.
    """
    exponent, error, _ = result.table["row_gain.exponent"]
    if "row_gain.exponent" not in result.names or not abs(exponent) < WHITE_SIGMA * error < WHITE_BELOW:
        return result
    start = result.params.with_value("row_gain", "white_share", 1.0).with_value("row_gain", "exponent", 0.0)
    white, converged = _by_likelihood(summary, None, start, _set_apart(outside))
    return white if converged and white.log_likelihood > result.log_likelihood + LIKELIER else result


def _edges(covariance: np.ndarray, coordinates: Coordinates, found: NoiseModel, summary: Summary) -> np.ndarray:
    """Which parameters are black levels that seem better known than the mean of all pixels allows [parameter].

    Rows whose gain the model clips at 0 have all their pixels on one count, and the likelihood jumps where the black
    level would be rounded to another count. Near such a step its curvature says nothing about the error.
    """
    edges = np.zeros(len(coordinates.numbers), bool)
    for i in np.flatnonzero(coordinates.where("black_level")):
        (c,) = coordinates.numbers[i].index
        noise_dn = float(found["gain"].value[c] * found["read_noise"].sigma)
        if noise_dn > EDGE_DN:  # smaller noise does show where the steps are
            pixels = summary.histograms[c].row_pixels.sum()
            edges[i] = np.sqrt(covariance[i, i]) < 0.3 * noise_dn / np.sqrt(pixels)
    return edges


def _of_hidden_dark_level(
    covariance: np.ndarray, coordinates: Coordinates, found: NoiseModel, summary: Summary
) -> np.ndarray:
    """Covariance of black levels from a dark current within its error of 0.

    Black level and dark signal cannot be separated there, and the curvature at the bound does not show it.
    """
    deviation, moved = np.sqrt(np.diagonal(covariance)), np.zeros(len(covariance))
    blacks, gains = coordinates.where("black_level"), coordinates.where("gain")
    for error in deviation[coordinates.where("dark_current")]:
        if blacks.any() and np.isfinite(error) and dark_current(found) < error:
            gain = np.hypot(found["gain"].value, deviation[gains])
            moved[blacks] = gain * summary.exposure_s.min() * error
    return np.outer(moved, moved)


def _by_line(summary: Summary, model, status: Status, detail: str = "") -> FitResult:
    log.info("Line fit: %s", status)
    line = line_fit(summary)
    names = coordinates_for(summary, line.params).names
    result = FitResult(
        params=_fitted(line.params, model, line.params.exposure_s),
        names=names,
        covariance=np.diag([line.standard_errors[name] ** 2 for name in names]),
        method=Method.LINE,
        status=status,
        detail=detail,
        iterations=0,
        log_likelihood=float("nan"),
        notes=(),
        summary=summary,
    )
    return result.with_notes((*line.notes, *closing_notes(result)))


def _covariance(information: np.ndarray) -> np.ndarray:
    """Inverse of the observed information; directions without any get a large, finite variance."""
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diagonal(information)), 1e-30))
    eigenvalues, vectors = np.linalg.eigh(information * scale[:, None] * scale[None, :])
    eigenvalues = np.maximum(eigenvalues, 1e-13)
    return scale[:, None] * (vectors / eigenvalues) @ vectors.T * scale[None, :]


def _fitted(found: NoiseModel, model: NoiseModel | None, exposure_s: float) -> NoiseModel:
    """The fitted values of the effects in `model` (None: all)."""
    wanted = [found[name] for name in (found.names if model is None else model.names)]
    return within_bounds(NoiseModel(wanted, cfa=found.cfa, shutter=found.shutter, exposure_s=exposure_s))
