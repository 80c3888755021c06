"""The command `hsnoise demo`: find an effect hidden in simulated frames, or examine a user's own frames."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from hsnoise import report
from hsnoise._core.folders import made
from hsnoise._core.output import frames_file, write_atomically, write_figure
from hsnoise.cli.loading import load_capture
from hsnoise.cli.progress import fit_with_progress
from hsnoise.cli.results import check_folder, improve_with_progress, keep, write_results
from hsnoise.cli.sample import draw, metadata_of
from hsnoise.cli.telling import page_of_fit, page_of_story, tell
from hsnoise.effects import RowNoise
from hsnoise.frames import examples
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation import cameras

EXPOSURES_S, FRAMES, SHAPE, SEED = (0.05, 0.1, 0.2, 0.4), 8, (96, 160), 0
HIDDEN = RowNoise(1.5)
MINUTES = 5.0  # for frames of a user's own
OFF_BY = (
    "off by: (value - truth) / standard error; beyond 3 only by rare chance. Gains, dark current and read",
    "noise are off together: their ratios are known better than themselves.",
)


def run(args: argparse.Namespace) -> None:
    check_folder(args.out)
    limits = {"max_minutes": args.max_minutes, "max_steps": args.max_steps}
    if args.real:
        if args.data:
            raise ValueError("--real: uses the frames that come with hsnoise, so it does not go with --data")
        night = str(examples.st8(args.out / "night"))
        _say(f"The frames of an SBIG ST-8, an astronomical CCD camera, are in {night}. So is their licence: CC0.")
        args.data = [night]
    if args.data:
        _on_frames(args, load_capture(args.data, args), {"files": args.data}, limits)
        return
    stack, truth = simulated(args.out)
    _improved(args, stack, {"simulated": "canon_5d3 with row noise", "seed": SEED}, limits, truth)


def _on_frames(
    args: argparse.Namespace, stack: FrameStack, source: dict[str, Any], limits: dict[str, float | None]
) -> None:
    """The loop on frames without a known truth; only a fit if they do not determine the gain."""
    stack.check()
    made(args.out)
    _say(str(stack))
    fit = fit_with_progress(stack, "auto")
    if fit.has_gain:
        _improved(args, stack, source, {**limits, "max_minutes": limits["max_minutes"] or MINUTES})
        return
    written = write_results(fit, args.out, source)
    tell(page_of_fit(fit), [f"Written to {args.out}/: {', '.join(written)}"], args.verbose)


def _improved(
    args: argparse.Namespace,
    stack: FrameStack,
    source: dict[str, Any],
    limits: dict[str, float | None],
    truth: NoiseModel | None = None,
) -> None:
    page = args.out / "report.html"
    _say(f"Fitting them, finding what the model lacks, and fitting again: a few minutes. Open {page}")
    _say("in a browser for the story so far, with figures; it is updated after each step.")
    story = improve_with_progress(stack, SEED, args.out, source, page=page, **limits)
    foot = [f"Written to {args.out}/: {', '.join([*keep(story, args.out, source), 'story.png'])}"]
    write_figure(args.out / "story.png", story.plot())
    report.write_report(page, story, stack, files=source.get("files", ()), seed=SEED)
    if truth is not None:
        foot = [*OFF_BY, *foot]
        foot.append(f"The hidden effect was {HIDDEN.name}. The frames are in {args.out / 'capture.npz'}.")
    foot.append(f"All of this is on one page with figures; open it in a browser: {page}")
    added = ", ".join(step.added for step in story.steps if step.added) or "nothing"
    foot.append(f"Added: {added}. Error before {story.errors[0]:.1f}, after {story.errors[-1]:.1f}.")
    tell(page_of_story(story, truth), foot, args.verbose)


def simulated(out: Path) -> tuple[FrameStack, NoiseModel]:
    """Darks with a hidden effect, saved as capture.npz, and the model they are drawn from."""
    truth = cameras.canon_5d3().add(HIDDEN)
    rows, columns = SHAPE
    _say(f"Simulating {len(EXPOSURES_S) * FRAMES} dark frames of {rows} x {columns} pixels ...")
    counts = draw(truth, EXPOSURES_S, FRAMES, np.zeros(SHAPE, np.float32), SEED)
    metadata = metadata_of(truth, EXPOSURES_S, "dark")
    made(out)
    write_atomically(out / "capture.npz", frames_file(".npz", counts, metadata))
    return FrameStack(counts, **metadata), truth


def _say(sentence: str) -> None:
    """Print words about the work to come, beside the result."""
    print(sentence, file=sys.stderr, flush=True)
