"""The command line: `hsnoise demo`, `inspect`, `fit`, `compare`, `diagnose`, `improve`, `sample` and the others."""

from __future__ import annotations

import argparse
import csv
import io
import re
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import hsnoise
from hsnoise import _enhance, _options, _sample, cameras, report
from hsnoise._arguments import counter
from hsnoise._loading import load_capture, model_of, same_capture
from hsnoise._output import frames_file, write_atomically, write_figure
from hsnoise._progress import busy, fit_with_progress
from hsnoise._sample import draw, metadata_of
from hsnoise._table import table_of
from hsnoise.criticism import Story
from hsnoise.draws import check_fits, part_of
from hsnoise.effects import RowNoise
from hsnoise.model import NoiseModel
from hsnoise.result import TITLES, FitResult
from hsnoise.stack import FrameStack

DEMO_EXPOSURES_S, DEMO_FRAMES, DEMO_SHAPE, DEMO_SEED = (0.05, 0.1, 0.2, 0.4), 8, (96, 160), 0
DEMO_HIDDEN = RowNoise(1.5)
DEMO_MINUTES = 5.0  # for frames of a user's own

OPTIONS = {
    "exposure_s": "--exposure",
    "black_level": "--black-level",
    "white_level": "--white-level",
    "cfa": "--cfa",
    "roi": "--roi",
    "overscan": "--overscan",
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
LOOK = dict.fromkeys(("ml", "line", "transfer"), "Look at the residuals in histograms.png, and run {}.")
LOOK["synthetic"] = "Run {}, which draws them. Figures of the fit would lack the added effects, and are left out."


def main(argv: list[str] | None = None) -> int:
    """Run a command; returns the exit code: 0, 1 if a capture makes no fit, or 2 after an error, told in a sentence."""
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
            return RUN[args.command](args) or 0
    except (ValueError, TypeError, OSError, RuntimeError, ImportError) as error:
        if args.debug:
            raise
        console.print(f"hsnoise: {_sentence(error)}", markup=False)
        return 2
    except KeyboardInterrupt:
        print("hsnoise: interrupted", file=sys.stderr)
        return 130


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
        stack, truth, source = load_capture(args.data, args), None, {"files": args.data}
        stack.check()
    else:
        stack, truth, source = *_simulated(args.out), {"simulated": "canon_5d3 with row noise", "seed": DEMO_SEED}
    args.out.mkdir(parents=True, exist_ok=True)
    if truth is None and not _can_be_improved(stack, args.out, source):
        return
    print(f"{stack}\nFitting them, finding what the model lacks, and fitting again: a few minutes ...")
    limit = None if truth is not None else DEMO_MINUTES
    page = args.out / "report.html"
    story = _improve_with_progress(stack, DEMO_SEED, args.out, source, page, max_minutes=limit)
    _tell(story, args.out, source, truth)
    report.write_report(page, story, stack, files=args.data or (), seed=DEMO_SEED)
    if truth is not None:
        print("off by: (value - truth) / standard error; beyond 3 only by rare chance. Gains, dark current and read")
        print("noise are off together: their ratios are known better than themselves.")
        print(f"Hidden in these frames was {DEMO_HIDDEN.name}. They are in {args.out / 'capture.npz'}.")
    added = ", ".join(step.added for step in story.steps if step.added) or "nothing"
    print(f"All of this is on one page, for a browser: {page}")
    print(f"Added: {added}. Error before {story.errors[0]:.1f}, after {story.errors[-1]:.1f}.")


def _can_be_improved(stack: FrameStack, out: Path, source: dict[str, Any]) -> bool:
    """Fit a user's frames and print the result; False where they do not determine the gain, and no loop makes sense."""
    fit = fit_with_progress(stack, "auto")
    written = _write_results(fit, out, source)
    print(stack)
    _tell_fit(fit, Console(highlight=False, soft_wrap=True))
    print(f"Written to {out}/: {', '.join(written)}\n")
    return fit.has_gain


def _simulated(out: Path) -> tuple[FrameStack, NoiseModel]:
    """Darks with a hidden effect, kept as capture.npz, and the model that they are drawn from."""
    truth = cameras.canon_5d3().add(DEMO_HIDDEN)
    rows, columns = DEMO_SHAPE
    print(f"Simulating {len(DEMO_EXPOSURES_S) * DEMO_FRAMES} dark frames of {rows} x {columns} pixels ...")
    counts = draw(truth, DEMO_EXPOSURES_S, DEMO_FRAMES, np.zeros(DEMO_SHAPE, np.float32), DEMO_SEED)
    metadata = metadata_of(truth, DEMO_EXPOSURES_S, "dark")
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / "capture.npz", frames_file(".npz", counts, metadata))
    return FrameStack(counts, **metadata), truth


def _inspect(args: argparse.Namespace) -> int:
    stack = load_capture(args.paths, args)
    with busy("Looking at the frames"):
        found = hsnoise.inspect(stack)
    print(_with_options(str(found)))
    return 0 if found.fit_makes_sense else 1


def _fit(args: argparse.Namespace) -> None:
    _check_folder(args.out)
    model, stack = None if args.model is None else model_of(args.model), load_capture(args.paths, args)
    stack.check()
    console, out = Console(highlight=False, soft_wrap=True), args.out
    out.mkdir(parents=True, exist_ok=True)  # before the long work, so that it cannot be in vain
    console.print(str(stack), markup=False)
    fit = fit_with_progress(stack, args.method, model, args.pixels)
    written = _write_results(fit, out, {"files": args.paths})
    if args.maps is not None:
        fit.pixels.save(args.maps)
        written.append(str(args.maps))
    _tell_fit(fit, console)
    console.print(f"\nWritten to {out}/: {', '.join(written)}\n", markup=False, soft_wrap=True)
    compare = f"hsnoise compare {same_capture(args)} --model {out / 'model.json'}"
    console.print(MEANING.format(LOOK[fit.method].format(compare)), markup=False)


def _tell_fit(fit: FitResult, console: Console, truth: NoiseModel | None = None) -> None:
    """Print a fit: what is doubtful first, then the table, how it ended, and what it does not determine."""
    for doubt in fit.doubts:
        console.print(f"! {doubt}", style="bold red" if fit.grave else "yellow", markup=False)
    console.print(table_of(fit, truth))
    console.print(f"{TITLES[fit.method]}: {fit.outcome}", markup=False)
    for note in fit.notes:
        console.print(f"- {note}", style="yellow", markup=False)


def _compare(args: argparse.Namespace) -> None:
    _check_outputs(args)
    model, stack = model_of(args.model), _load(args)
    check_fits(model, stack)
    args.out.mkdir(parents=True, exist_ok=True)
    with busy("Drawing from the model") as say:
        found = hsnoise.compare(model, stack, seed=args.seed, progress=counter(say, "Drawing from the model"))
    _show(found, args.out / "comparison.png")
    _write_report(args, found, stack, fit=model)


def _diagnose(args: argparse.Namespace) -> None:
    _check_outputs(args)
    stack = _load(args)
    part_of(stack)  # flats alone are no capture to diagnose: said before the fit
    args.out.mkdir(parents=True, exist_ok=True)
    fitted = fit_with_progress(stack, args.method) if args.model is None else model_of(args.model)
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
    stack = _load(args)
    args.out.mkdir(parents=True, exist_ok=True)
    start, source = None if args.model is None else model_of(args.model), {"files": args.paths}
    limits = {"max_minutes": args.max_minutes, "max_steps": args.max_steps}
    story = _improve_with_progress(stack, args.seed, args.out, source, args.report, start, **limits)
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
    _tell_fit(story.fit, Console(highlight=False, soft_wrap=True), truth)
    print(f"Written to {out}/: {', '.join(_keep(story, out, source))}")


# Work


def _load(args: argparse.Namespace) -> FrameStack:
    """The capture; what was assumed about it is printed."""
    stack = load_capture(args.paths, args)
    for sentence in stack.assumed:
        print(f"- {_with_options(sentence)}", file=sys.stderr)
    return stack


def _improve_with_progress(
    stack: FrameStack,
    seed: int,
    out: Path,
    source: dict[str, Any],
    page: Path | None,
    start: NoiseModel | None = None,
    **limits: Any,
) -> Story:
    """The loop; each model that it keeps is written to `out`, and the story so far to `page`, if there is to be one."""

    def keep(story: Story) -> None:
        _keep(story, out, source)
        if page is not None:
            report.write_report(page, story, stack, files=source.get("files", ()), seed=seed)

    with busy("Fitting the first model") as say:
        return hsnoise.improve(stack, model=start, seed=seed, progress=say, keep=keep, **limits)


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
        "trustworthy": fit.trustworthy,
        "doubts": list(fit.doubts),
        "withheld": list(fit.withheld),
        "standard_errors": {name: error for name, (_, error, _) in fit.table.items() if 0 < error < np.inf},
    }
    fit.params.save(out / "model.json", provenance=provenance)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["parameter", "value", "standard_error", "unit"])
    # 0: held, not fitted; inf: not determined.
    writer.writerows([name, value, error, unit] for name, (value, error, unit) in fit.table.items())
    write_atomically(out / "table.csv", text.getvalue().encode())
    drawings = plots.of_fit(fit) if figures else {}
    for name, figure in drawings.items():
        write_figure(out / f"{name}.png", figure)
    return ["model.json", "table.csv", *(f"{name}.png" for name in drawings)]


def _train(args: argparse.Namespace) -> None:
    from hsnoise.training.train import run  # optax and matplotlib are slow to import

    run(args, Console(highlight=False, soft_wrap=True))


def _evaluate(args: argparse.Namespace) -> None:
    from hsnoise.training.evaluate import run

    run(args)


RUN = {
    "demo": _demo,
    "inspect": _inspect,
    "fit": _fit,
    "compare": _compare,
    "diagnose": _diagnose,
    "improve": _improve,
    "sample": _sample.run,
    "enhance": lambda args: _enhance.run(args, args.camera and model_of(args.camera, "--camera")),
    "train": _train,
    "evaluate": _evaluate,
}
