"""Output files of a fit or a story: model.json, table.csv, story.txt and figures."""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path
from typing import Any

import numpy as np

from hsnoise import report
from hsnoise._core import interrupting as _interrupting
from hsnoise._core.output import write_atomically, write_figure
from hsnoise.cli.progress import busy
from hsnoise.criticism import Story, write_story
from hsnoise.criticism.improve import improved
from hsnoise.fitting.result import FitResult
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel

STORY = "story.json"  # from which `--resume` goes on


def check_folder(path: Path) -> None:
    if path.exists() and not path.is_dir():
        raise ValueError(f"--out: expected a folder, but {path} is a file")


def improve_with_progress(
    stack: FrameStack,
    seed: int,
    out: Path,
    source: dict[str, Any],
    start: NoiseModel | None = None,
    page: Path | None = None,
    **limits: Any,
) -> Story:
    """The loop; writes each model that it keeps to `out`, and the story so far to `page` if given."""

    def kept(story: Story) -> None:
        keep(story, out, source)
        if page is not None:
            report.write_report(page, story, stack, files=source.get("files", ()), seed=seed)

    with busy("Fitting the first model", limits.get("max_minutes")) as say:
        return improved(stack, say, model=start, seed=seed, keep=kept, **limits)


def keep(story: Story, out: Path, source: dict[str, Any]) -> list[str]:
    """Write the last model and the story to `out`; returns the names of the files.

    Of a model that is closed with measured components, that of the last fit is kept as named.json.
    """
    written = write_results(story.fit, out, {**source, "errors": list(story.errors)}, figures=False)
    if story.closed is not None:
        story.fit.params.save(out / "named.json", provenance=source)
        story.params.save(out / "model.json", provenance={**source, "closed": story.closed.summary})
        written += ["model.npz", "named.json"]
    write_atomically(out / "story.txt", f"{story}\n".encode())
    if not any(effect.arrays() for effect in story.fit.params):
        write_story(out / STORY, story)
        written.append(STORY)
    _interrupting.on_disk(f"the model so far is in {out / 'model.json'}")
    return [*written, "story.txt"]


def story_in(out: Path) -> Path | None:
    """The story that an earlier run left in a folder; None, and a sentence on standard error, without one."""
    if (out / STORY).exists():
        return out / STORY
    print(f"- {out / STORY} is not there: starting from the beginning", file=sys.stderr)
    return None


def write_results(fit: FitResult, out: Path, source: dict[str, Any], figures: bool = True) -> list[str]:
    """Write model.json, table.csv and, by default, the figures; returns their names."""
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
    writer.writerows([name, value, error, unit] for name, (value, error, unit) in fit.shown.items())
    write_atomically(out / "table.csv", text.getvalue().encode())
    drawings = plots.of_fit(fit) if figures else {}
    for name, figure in drawings.items():
        write_figure(out / f"{name}.png", figure)
    return ["model.json", "table.csv", *(f"{name}.png" for name in drawings)]
