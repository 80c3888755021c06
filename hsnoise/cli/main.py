"""The command line: `hsnoise demo`, `inspect`, `fit`, `compare`, `diagnose`, `improve`, `sample` and the others."""

from __future__ import annotations

import argparse
import shlex
import sys
import warnings
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any, cast

from rich.console import Console

import hsnoise
from hsnoise import report
from hsnoise._core import interrupting as _interrupting
from hsnoise._core.conclusion import Light
from hsnoise._core.events import Event, counter
from hsnoise._core.folders import made
from hsnoise._core.naming import as_options
from hsnoise._core.output import write_figure
from hsnoise.cli import demo as _demo
from hsnoise.cli import enhance as _enhance
from hsnoise.cli import options as _options
from hsnoise.cli import sample as _sample
from hsnoise.cli.as_json import as_json
from hsnoise.cli.compiled import keep_compiled_programs
from hsnoise.cli.loading import load_capture, model_of, same_capture
from hsnoise.cli.progress import busy, fit_with_progress
from hsnoise.cli.results import check_folder, improve_with_progress, keep, story_in, write_results
from hsnoise.cli.streams import Unfailing, drop_unwritten
from hsnoise.cli.telling import (
    Page,
    page_of_comparison,
    page_of_diagnosis,
    page_of_fit,
    page_of_inspection,
    page_of_story,
    tell,
)
from hsnoise.criticism import Comparison, Story
from hsnoise.criticism.compare import DRAWS
from hsnoise.criticism.limit import MOST_STEPS
from hsnoise.criticism.outcomes import Ended, Verdict
from hsnoise.fitting.result import Method
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import check_fits
from hsnoise.simulation.portion import Portion
from hsnoise.statistics.pixels.maps import check_path

MEANING = """\
One electron adds `gain` DN to a count. A pixel collects `dark_current.rate` electrons per second without light, and \
reading it adds noise of `read_noise.sigma` electrons. The gain fluctuates from row to row and from frame to frame by \
`row_gain.sigma` of itself (streaks): white noise if the exponent is 0, 1/f noise if it is 1. The standard errors \
do not say whether the model is right."""
ASSUMED = 4  # assumptions about the capture that are printed before the work
LOOK = dict.fromkeys(Method, "Look at the residuals in histograms.png, and run {}")
LOOK[Method.SYNTHETIC] = "Run {}, which draws them. Figures of the fit are left out: they would lack the added effects."
# Arguments of the library, and what its sentences call them here.
OPTIONS = {
    "exposure_s": "--exposure",
    "black_level": "--black-level",
    "white_level": "--white-level",
    "cfa": "--cfa",
    "roi": "--roi",
    "overscan": "--overscan",
    "hdu": "--hdu",
    "shutter": "--shutter",
    "kind": "--kind",
    "flats": "--flats",
    "report": "--report",
    "model": "--model",
    "params": "--model",
    "seed": "--seed",
    "resume": "--resume",
}
BROKEN_PIPE = 128 + 13  # a shell's exit code for a process ended by SIGPIPE


def main(argv: list[str] | None = None) -> int:
    """Run a command. Exit codes: 0; 1 if the result should not be used; 2 after an error, printed in a sentence.

    141 if the reader of the output is gone; 130 after Ctrl-C. docs/command-line.md says more.
    """
    _interrupting.on_disk("")
    out, words = sys.stdout or StringIO(), cast(Any, Unfailing(sys.stderr or StringIO()))  # they may be closed
    with redirect_stdout(out), redirect_stderr(words):
        try:
            return _run(argv)
        except BrokenPipeError:
            return BROKEN_PIPE
        except KeyboardInterrupt:
            print(_interrupting.message(), file=sys.stderr)
            return _interrupting.STATUS
        finally:
            drop_unwritten(out)
            words.flush()
            _interrupting.nothing_left()


def _run(argv: list[str] | None) -> int:
    parser = _options.parser()
    args = parser.parse_args(argv)
    if args.command is None:
        parser.print_help()
        return 2
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    try:
        with warnings.catch_warnings(), as_options(OPTIONS):
            warnings.simplefilter("once")
            warnings.showwarning = lambda message, *_, **__: console.print(
                f"Note: {message}.", style="yellow", markup=False
            )
            keep_compiled_programs()
            status = RUN[args.command](args) or 0
            sys.stdout.flush()  # notice here that it cannot be written
            return status
    except BrokenPipeError:
        raise
    except (ValueError, TypeError, OSError, RuntimeError, ImportError) as error:
        if args.debug:
            raise
        console.print(f"hsnoise: {_sentence(error)}", markup=False)
        return 2


def _sentence(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return " ".join(str(error).split())


# Commands


def _inspect(args: argparse.Namespace) -> int:
    stack = load_capture(args.paths, args)
    with busy("Looking at the frames", of="frame") as say:
        found = hsnoise.inspect(stack, progress=counter(say, Event("Looking at the frames")))
    _tell(args, page_of_inspection(found), found)
    return _status(found)


def _fit(args: argparse.Namespace) -> int:
    check_folder(args.out)
    if args.maps is not None:
        with as_options({"path": "--maps"}):
            check_path(args.maps, made=args.out)
    model, stack = None if args.model is None else model_of(args.model), _load(args)
    made(args.out)  # fail before the long work
    fit = fit_with_progress(stack, args.method, model, args.pixels)
    written = write_results(fit, args.out, {"files": args.paths})
    files = [args.out / name for name in written]
    if args.maps is not None:
        fit.pixels.save(args.maps)
        written.append(str(args.maps))
        files.append(args.maps)
    command = f"hsnoise compare {same_capture(args)} --model {args.out / 'model.json'}"
    page = page_of_fit(fit, rest=(str(stack), MEANING))
    foot = (f"Written to {args.out}/: {', '.join(written)}", LOOK[fit.method].format(command))
    _tell(args, page, fit, foot, files)
    return _status(fit)


def _compare(args: argparse.Namespace) -> None:
    _check_outputs(args)
    model, stack = model_of(args.model), _load(args)
    check_fits(model, stack)
    made(args.out)
    found = _compared(model, stack, args.seed)
    last = []
    if found.conclusion.light != Light.GREEN:
        capture = same_capture(args)
        last = [
            f"What is missing: hsnoise diagnose {capture} --model {shlex.quote(args.model)}",
            f"To add it: hsnoise improve {capture} --model {shlex.quote(args.model)}",
            f"If the model is not of these frames, its numbers may be wrong: hsnoise fit {capture}",
        ]
    off = None if found.fits else model
    _show(args, found, page_of_comparison(found), "comparison.png", stack, off=off, fit=model, last=last)


def _diagnose(args: argparse.Namespace) -> None:
    _check_outputs(args)
    stack = _load(args)
    Portion.of(stack)  # rejects a capture of flats alone before the fit
    made(args.out)
    fitted = fit_with_progress(stack, args.method) if args.model is None else model_of(args.model)
    text = "Drawing each effect that may be missing"
    with busy(text) as say:
        found = hsnoise.diagnose(fitted, stack, seed=args.seed, progress=counter(say, Event(text)))
    more: dict[str, Any] = {"fit": fitted}
    if args.report is not None:
        more["comparison"] = _compared(getattr(fitted, "params", fitted), stack, args.seed)
    off = getattr(fitted, "params", fitted) if found.verdict == Verdict.UNEXPLAINED else None
    _show(args, found, page_of_diagnosis(found), "ranking.png", stack, off=off, **more)


def _improve(args: argparse.Namespace) -> int:
    _check_outputs(args)
    stack = _load(args)
    made(args.out)
    start, source = None if args.model is None else model_of(args.model), {"files": args.paths}
    limits = {"max_minutes": args.max_minutes, "max_steps": args.max_steps, "close": args.close}
    if args.resume:
        limits["resume"] = story_in(args.out)
    if limits.get("resume") is None:
        _interrupting.on_disk("no model was kept yet, from which --resume could go on")
    story = improve_with_progress(stack, args.seed, args.out, source, start, args.report, **limits)
    written = keep(story, args.out, source)
    last = []
    if story.ending.why in (Ended.MINUTES, Ended.STEPS):
        last = [f"To go on: hsnoise improve {same_capture(args)}{_same_story(args, story)} --resume"]
    off = None if story.steps[-1].comparison.fits else story.params
    _show(args, story, page_of_story(story), "story.png", stack, off=off, written=written, last=last)
    return _status(story)


# Work


def _load(args: argparse.Namespace) -> FrameStack:
    """The capture, checked; prints what was assumed about it."""
    stack = load_capture(args.paths, args)
    stack.check()
    shown = stack.assumed if args.verbose else stack.assumed[:ASSUMED]
    for sentence in shown:
        print(f"- {sentence}", file=sys.stderr)
    if len(stack.assumed) > len(shown):
        more = len(stack.assumed) - len(shown)
        print(f"- {more} more assumption{'s' if more > 1 else ''}: --verbose", file=sys.stderr)
    return stack


def _compared(model, stack: FrameStack, seed: int) -> Comparison:
    text = "Drawing from the model"
    with busy(text) as say:
        return hsnoise.compare(model, stack, seed=seed, progress=counter(say, Event(text), DRAWS))


def _show(
    args: argparse.Namespace,
    found,
    page: Page,
    figure: str,
    stack: FrameStack,
    *,
    off: NoiseModel | None = None,
    written: Sequence[str] = (),
    last: Sequence[str] = (),
    **more: Any,
) -> None:
    """Draw the figures of a result, write its report, and print its page.

    off: a model from which the frames differ, whose residuals are drawn; written: other files; last: lines of the page.
    """
    drawn = [args.out / figure]
    write_figure(drawn[0], found.plot())
    if off is not None and stack.repeated_darks:
        from hsnoise import plots  # matplotlib is slow to import

        drawn.append(args.out / "residuals.png")
        write_figure(drawn[1], plots.residuals(off, stack, seed=args.seed))
        last = [f"Where and when the frames differ: {drawn[1]}", *last]
    _write_report(args, found, stack, **more)
    foot = [f"Written to {args.out}/: {', '.join(written)}"] if written else []
    reported = [] if args.report is None else [args.report]
    foot += [f"Figure: {drawn[0]}", *(f"Report: {one}" for one in reported), *last]
    _tell(args, page, found, foot, [*(args.out / name for name in written), *drawn, *reported])


def _same_story(args: argparse.Namespace, story: Story) -> str:
    """The options with which a story goes on, beside those of its capture; in more minutes, as a search begins anew."""
    more = 2.0 if story.ending.why == Ended.MINUTES else 1.0
    minutes = None if args.max_minutes is None else f"{more * args.max_minutes:g}"
    given = {
        "--out": args.out,
        "--model": args.model,
        "--seed": args.seed or None,
        "--report": args.report,
        "--max-minutes": minutes,
        "--max-steps": story.ending.limit + MOST_STEPS if story.ending.why == Ended.STEPS else None,
    }
    words = [word for name, value in given.items() if value is not None for word in (name, str(value))]
    return " " + shlex.join(words + ["--close"] * args.close)


def _tell(args: argparse.Namespace, page: Page, found, foot: Sequence[str] = (), files: Sequence[Path] = ()) -> None:
    """Print the page of a result; with --json the result itself, and the page to standard error."""
    tell(page, foot, args.verbose, sys.stderr if args.json else sys.stdout)
    if args.json:
        print(as_json(found, args.command, map(str, files)), flush=True)


def _status(found) -> int:
    """The exit code: 1 for a result that should not be used."""
    return 1 if found.conclusion.light == Light.RED else 0


def _write_report(args: argparse.Namespace, found, stack: FrameStack, **keywords: Any) -> None:
    """Write the page if --report asks for it."""
    if args.report is None:
        return
    with busy("Writing the report"):
        report.write_report(args.report, found, stack, files=args.paths, seed=args.seed, **keywords)


# Output


def _check_outputs(args: argparse.Namespace) -> None:
    """Raise errors about outputs before the long work."""
    check_folder(args.out)
    if args.report is not None:
        report.check_path(args.report, made=args.out)


def _train(args: argparse.Namespace) -> None:
    from hsnoise.enhance.training.train import run  # optax and matplotlib are slow to import

    with _interrupting.as_exception():  # it keeps the last checkpoint
        run(args, Console(stderr=True, highlight=False, soft_wrap=True))


def _evaluate(args: argparse.Namespace) -> None:
    from hsnoise.enhance.training.evaluate import run

    run(args)


RUN = {
    "demo": _demo.run,
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
