"""The command line: `hsnoise demo`, `fit`, `compare`, `diagnose`, `improve`, `sample` and `enhance`."""

from __future__ import annotations

import argparse
import csv
import io
import re
import sys
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import track

import hsnoise
from hsnoise import _enhance, _options, cameras, report
from hsnoise._arguments import counter
from hsnoise._frames import LazyFrames
from hsnoise._options import CAMERAS
from hsnoise._output import FRAME_FORMATS, frames_file, read_image, write_atomically, write_figure
from hsnoise._progress import busy, fit_with_progress
from hsnoise._table import table_of
from hsnoise._types import cfa_tile
from hsnoise.criticism import Story
from hsnoise.draws import check_fits, part_of
from hsnoise.effects import RowNoise
from hsnoise.model import NoiseModel
from hsnoise.photometry import scale_to_photoelectrons
from hsnoise.result import TITLES, FitResult
from hsnoise.stack import FrameStack

SAMPLE_SHAPE = (480, 640)
DEMO_EXPOSURES_S, DEMO_FRAMES, DEMO_SHAPE, DEMO_SEED = (0.05, 0.1, 0.2, 0.4), 8, (96, 160), 0
DEMO_HIDDEN = RowNoise(1.5)

OPTIONS = {
    "exposure_s": "--exposure",
    "black_level": "--black-level",
    "white_level": "--white-level",
    "cfa": "--cfa",
    "roi": "--roi",
    "shutter": "--shutter",
    "kind": "--kind",
    "flats": "--flats",
    "report": "--report",
    "model": "--model",
    "params": "--model",
    "seed": "--seed",
}

MEANING = """\
One electron adds `gain` DN to a count; a pixel collects `dark_current.rate` electrons per second without light, and \
reading it adds noise of `read_noise.sigma` electrons. From row to row, and anew in each frame, the gain fluctuates by \
`row_gain.sigma` of itself (streaks), in white noise if the exponent is 0, in 1/f noise if it is 1. What the standard \
errors do not say: whether the model is right. {}"""
LOOK = dict.fromkeys(("ml", "line"), "Look at the residuals in histograms.png, and run {}.")
LOOK["synthetic"] = "Run {}, which draws them. Figures of the fit would lack the added effects, and are left out."


def main(argv: list[str] | None = None) -> int:
    """Run a command; returns the exit code: 0, or 2 after an error, which is reported in one sentence."""
    parser = _options.parser()
    args = parser.parse_args(argv)
    if args.command is None:
        parser.print_help()
        return 2
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("once")
            warnings.showwarning = lambda message, *_, **__: console.print(
                f"Note: {_with_options(str(message))}.", style="yellow", markup=False
            )
            RUN[args.command](args)
    except (ValueError, TypeError, OSError, RuntimeError, ImportError) as error:
        if args.debug:
            raise
        console.print(f"hsnoise: {_sentence(error)}", markup=False)
        return 2
    except KeyboardInterrupt:
        print("hsnoise: interrupted", file=sys.stderr)
        return 130
    return 0


def _sentence(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return _with_options(" ".join(str(error).split()))


def _with_options(text: str) -> str:
    """A message of the library for users of the command line, who know its options, not arguments."""
    argument, colon, rest = text.partition(":")
    text = f"{OPTIONS[argument]}{colon}{rest}" if argument in OPTIONS else text
    with_value = re.compile(r"\b(\w+)=(?=(['\"\d])|\W|$)")
    return with_value.sub(lambda m: f"{OPTIONS[m[1]]}{' ' if m[2] else ''}" if m[1] in OPTIONS else m[0], text)


# Commands


def _demo(args: argparse.Namespace) -> None:
    _check_folder(args.out)
    if args.data:
        stack, truth, source = _load(args.data, args), None, {"files": args.data}
        stack.check()
    else:
        stack, truth, source = *_simulated(args.out), {"simulated": "canon_5d3 with row noise", "seed": DEMO_SEED}
    args.out.mkdir(parents=True, exist_ok=True)
    print(f"{stack}\nFitting them, finding what the model lacks, and fitting again: a few minutes ...")
    story = _improve_with_progress(stack, DEMO_SEED, args.out, source)
    _tell(story, args.out, source, truth)
    if truth is not None:
        print("off by: (value - truth) / standard error; beyond 3 only by rare chance. Gains, dark current and read")
        print("noise are off together: their ratios are known better than themselves.")
        print(f"Hidden in these frames was {DEMO_HIDDEN.name}. They are in {args.out / 'capture.npz'}.")
    added = ", ".join(step.added for step in story.steps if step.added) or "nothing"
    print(f"Added: {added}. Error before {story.errors[0]:.1f}, after {story.errors[-1]:.1f}.")


def _simulated(out: Path) -> tuple[FrameStack, NoiseModel]:
    """Darks with a hidden effect, kept as capture.npz, and the model that they are drawn from."""
    truth = cameras.canon_5d3().add(DEMO_HIDDEN)
    rows, columns = DEMO_SHAPE
    print(f"Simulating {len(DEMO_EXPOSURES_S) * DEMO_FRAMES} dark frames of {rows} x {columns} pixels ...")
    counts = _draw(truth, DEMO_EXPOSURES_S, DEMO_FRAMES, np.zeros(DEMO_SHAPE, np.float32), DEMO_SEED)
    metadata = _metadata(truth, DEMO_EXPOSURES_S, "dark")
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / "capture.npz", frames_file(".npz", counts, metadata))
    return FrameStack(counts, **metadata), truth


def _fit(args: argparse.Namespace) -> None:
    _check_folder(args.out)
    model, stack = None if args.model is None else _model(args.model), _load(args.paths, args)
    stack.check()
    console, out = Console(highlight=False), args.out
    out.mkdir(parents=True, exist_ok=True)  # before the long work, so that it cannot be in vain
    console.print(str(stack), markup=False)
    fit = fit_with_progress(stack, args.method, model)
    console.print(table_of(fit))
    console.print(f"{TITLES[fit.method]}: {fit.outcome}", markup=False)
    for note in fit.notes:
        console.print(f"- {note}", style="yellow", markup=False)
    written = _write_results(fit, out, {"files": args.paths}, figures=fit.method != "synthetic")
    console.print(f"\nWritten to {out}/: {', '.join(written)}\n", markup=False, soft_wrap=True)
    compare = f"hsnoise compare {args.paths[0]}{' ...' if args.paths[1:] else ''} --model {out / 'model.json'}"
    console.print(MEANING.format(LOOK[fit.method].format(compare)), markup=False)


def _compare(args: argparse.Namespace) -> None:
    _check_outputs(args)
    model, stack = _model(args.model), _load(args.paths, args)
    check_fits(model, stack)
    args.out.mkdir(parents=True, exist_ok=True)
    with busy("Drawing from the model") as say:
        found = hsnoise.compare(model, stack, seed=args.seed, progress=counter(say, "Drawing from the model"))
    _show(found, args.out / "comparison.png")
    _write_report(args, found, stack, fit=model)


def _diagnose(args: argparse.Namespace) -> None:
    _check_outputs(args)
    stack = _load(args.paths, args)
    part_of(stack)  # flats alone are no capture to diagnose: said before the fit
    args.out.mkdir(parents=True, exist_ok=True)
    fitted = fit_with_progress(stack, args.method) if args.model is None else _model(args.model)
    with busy("Drawing every effect that may be missing") as say:
        tick = counter(say, "Drawing every effect that may be missing")
        found = hsnoise.diagnose(fitted, stack, seed=args.seed, progress=tick)
    _show(found, args.out / "ranking.png")
    if args.report is not None:
        with busy("Comparing with the model's own samples"):
            comparison = hsnoise.compare(getattr(fitted, "params", fitted), stack, seed=args.seed)
        _write_report(args, found, stack, fit=fitted, comparison=comparison)


def _improve(args: argparse.Namespace) -> None:
    _check_outputs(args)
    stack = _load(args.paths, args)
    args.out.mkdir(parents=True, exist_ok=True)
    start, source = None if args.model is None else _model(args.model), {"files": args.paths}
    story = _improve_with_progress(stack, args.seed, args.out, source, start)
    _tell(story, args.out, source, None)
    _write_report(args, story, stack)


def _keep(story: Story, out: Path, source: dict[str, Any]) -> list[str]:
    """Write the last model and the story to `out`; returns the names of the files."""
    written = _write_results(story.fit, out, {**source, "errors": list(story.errors)}, figures=False)
    write_atomically(out / "story.txt", f"{story}\n".encode())
    return [*written, "story.txt"]


def _tell(story: Story, out: Path, source: dict[str, Any], truth: NoiseModel | None) -> None:
    """Print the story and its last fit, and write both."""
    _show(story, out / "story.png")
    console = Console(highlight=False)
    console.print(table_of(story.fit, truth))
    for note in story.fit.notes:
        console.print(f"- {note}", style="yellow", markup=False)
    print(f"Written to {out}/: {', '.join(_keep(story, out, source))}")


def _sample(args: argparse.Namespace) -> None:
    suffix = args.out.suffix.lower()
    if suffix not in FRAME_FORMATS:
        raise ValueError(f"--out: expected a file ending in {', '.join(FRAME_FORMATS)}, got {args.out}")
    if not args.out.parent.is_dir():
        raise ValueError(f"--out: there is no folder {args.out.parent}")
    if args.mean_e is not None and args.clean is None:
        raise ValueError("--mean-e: goes with --clean, the image that it scales")
    if args.mean_e is not None and not args.mean_e > 0:
        raise ValueError(f"--mean-e: expected photoelectrons above 0, got {args.mean_e:g}")
    if args.shape is not None and args.clean is not None:
        raise ValueError("--shape: goes with dark frames; those of --clean have the shape of the image")
    model = _model(args.model)
    exposures_s = args.exposure or [model.exposure_s]
    dark = np.zeros(args.shape or SAMPLE_SHAPE, np.float32)
    clean = dark if args.clean is None else _clean(args.clean, args.mean_e, model)
    counts = _draw(model, exposures_s, args.frames, clean, args.seed)
    metadata = _metadata(model, exposures_s, "flat" if args.clean else "dark")
    write_atomically(args.out, frames_file(suffix, counts, metadata))
    n, frames, rows, columns = counts.shape
    exposed, codes = " and ".join(f"{t:g} s" for t in exposures_s), f"counts {counts.min()} to {counts.max()} DN"
    print(f"{args.out}: {n * frames} frames of {rows} x {columns} pixels, exposed {exposed}, {codes}")


# Work


def _load(paths: list[str], args: argparse.Namespace) -> FrameStack:
    """Darks, and flats if there are any, as one stack."""
    options = {
        "cfa": args.cfa,
        "black_level": _one_or_list(args.black_level),
        "white_level": args.white_level,
        "shutter": args.shutter,
        "row_axis": args.row_axis,
        "roi": args.roi,
    }
    groups = _captures(paths, exposure_s=_one_or_list(args.exposure), kind=args.kind, **options)
    if args.exposure is not None and len(args.exposure) > 1:
        for group in groups:
            _tell_exposures(group)
    if args.flats:
        try:
            groups += _captures(args.flats, exposure_s=_one_or_list(args.flats_exposure), kind="flat", **options)
        except FileNotFoundError as error:
            raise FileNotFoundError(f"--flats: {str(error).removeprefix('path: ')}") from error
    return groups[0] if len(groups) == 1 else FrameStack.join(*groups)


def _tell_exposures(stack: FrameStack) -> None:
    """Which files the exposures of the command line were given to, with the mean of the first frame of each."""
    for i, (counts, exposure_s) in enumerate(zip(stack.counts, stack.exposure_s, strict=True)):
        if isinstance(counts, LazyFrames):
            more = f" and {len(counts.names) - 1} more" if len(counts.names) > 1 else ""
            mean_dn = stack.frame(i, 0).mean()
            print(f"{exposure_s:g} s: {counts.names[0]}{more}, mean {mean_dn:.1f} DN", file=sys.stderr)


def _captures(paths: list[str], **options: Any) -> list[FrameStack]:
    """Several files are one capture, several folders or patterns one each."""
    if len(paths) > 1 and all(Path(path).is_file() for path in paths):
        return [hsnoise.load(paths, **options)]
    return [hsnoise.load(path, **options) for path in paths]


def _improve_with_progress(
    stack: FrameStack, seed: int, out: Path, source: dict[str, Any], start: NoiseModel | None = None
) -> Story:
    """The loop; each model that it keeps is written to `out`."""
    with busy("Fitting the first model") as say:
        return hsnoise.improve(
            stack, model=start, seed=seed, progress=say, keep=lambda story: _keep(story, out, source)
        )


def _show(found, path: Path) -> None:
    """Print a finding and draw its figure."""
    print(found)
    write_figure(path, found.plot())
    print(f"Drawn in {path}")


def _write_report(args: argparse.Namespace, found, stack: FrameStack, **keywords: Any) -> None:
    """Write the page that --report asks for, if it does."""
    if args.report is None:
        return
    with busy("Writing the report"):
        report.write_report(args.report, found, stack, files=args.paths, seed=args.seed, **keywords)
    print(f"Reported in {args.report}")


def _model(name: str, argument: str = "model") -> NoiseModel:
    if name in CAMERAS:
        return CAMERAS[name]()
    if not Path(name).is_file():
        raise ValueError(f"{argument}: expected a model.json or one of {', '.join(CAMERAS)}, and there is no {name}")
    return NoiseModel.load(name)


def _one_or_list(numbers: list[float] | None) -> Any:
    return numbers[0] if numbers is not None and len(numbers) == 1 else numbers


def _draw(model: NoiseModel, exposures_s: Any, n_frames: int, clean: np.ndarray, seed: int) -> np.ndarray:
    """Counts `[exposure, frame, row, column]`, frame by frame unless what happens in one depends on those before."""
    key = jax.random.key(seed)
    at_once = n_frames if any(effect.in_series for effect in model) else 1
    tasks = [(e, f) for e in range(len(exposures_s)) for f in range(0, n_frames, at_once)]
    clean = np.broadcast_to(clean, (at_once, *clean.shape))
    console = Console(stderr=True)
    frames = []
    for e, f in track(tasks, "Drawing frames", console=console, transient=True, disable=not console.is_terminal):
        own = jax.random.fold_in(jax.random.fold_in(key, e), f)
        frames.append(np.asarray(hsnoise.sample(own, clean, model, exposure_s=exposures_s[e], sensor_key=key)))
    counts = np.stack(frames).reshape(len(exposures_s), n_frames, *clean.shape[1:])
    return counts.astype(np.uint16) if counts.max() <= np.iinfo(np.uint16).max else counts


def _metadata(model: NoiseModel, exposures_s: Any, kind: str) -> dict[str, Any]:
    metadata = {"exposure_s": np.asarray(exposures_s, float), "kind": kind, "cfa": model.cfa, "shutter": model.shutter}
    black_level = np.asarray(model["black_level"].value, float) if "black_level" in model else np.zeros(1)
    metadata["black_level"] = black_level if np.ptp(black_level) > 0 else float(black_level[0])
    if "adc" in model and model["adc"].white_level_dn is not None:
        metadata["white_level"] = float(model["adc"].white_level_dn)
    return metadata


def _clean(path: str, mean_e: float | None, model: NoiseModel) -> np.ndarray:
    """Expected photoelectrons `[row, column]`: of an image in R, G, B each pixel keeps its own colour."""
    image = read_image(path).astype(np.float32)
    if image.ndim == 3:
        if model.cfa == "mono":
            raise ValueError(f"{path}: a colour image, but the sensor is mono; give an image [row, column]")
        tile = cfa_tile(model.cfa)
        row, column = np.indices(image.shape[:2])
        image = image[row, column, tile[row % 2, column % 2]]
    return image if mean_e is None else np.asarray(scale_to_photoelectrons(image, mean_e))


# Output


def _check_folder(path: Path) -> None:
    if path.exists() and not path.is_dir():
        raise ValueError(f"--out: expected a folder, but {path} is a file")


def _check_outputs(args: argparse.Namespace) -> None:
    """Before long work, so that it cannot be in vain."""
    _check_folder(args.out)
    if args.report is not None:
        report.check_path(args.report, made=args.out)


def _write_results(fit: FitResult, out: Path, source: dict[str, Any], figures: bool = True) -> list[str]:
    """model.json, table.csv and, unless told otherwise, the figures; returns their names."""
    from hsnoise import plots  # matplotlib is slow to import

    provenance = {
        **source,
        "method": fit.method,
        "outcome": fit.outcome,
        "standard_errors": {name: error for name, (_, error, _) in fit.table.items() if 0 < error < np.inf},
    }
    fit.params.save(out / "model.json", provenance=provenance)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["parameter", "value", "standard_error", "unit"])
    # 0: held, not fitted; inf: not determined.
    writer.writerows([name, value, error, unit] for name, (value, error, unit) in fit.table.items())
    write_atomically(out / "table.csv", text.getvalue().encode())
    drawings = {"photon_transfer.png": plots.photon_transfer} if figures else {}
    if figures and fit.summary.histograms:
        drawings["histograms.png"] = plots.histograms
        if fit.physics.row_sigma is not None:
            drawings["row_spectrum.png"] = plots.row_spectrum
    for name, draw in drawings.items():
        write_figure(out / name, draw(fit))
    return ["model.json", "table.csv", *drawings]


RUN = {
    "demo": _demo,
    "fit": _fit,
    "compare": _compare,
    "diagnose": _diagnose,
    "improve": _improve,
    "sample": _sample,
    "enhance": lambda args: _enhance.run(args, args.camera and _model(args.camera, "--camera")),
}
