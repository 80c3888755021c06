"""What the page says: words and numbers for the template, from what was found."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from importlib.metadata import version
from typing import Any

import numpy as np

from hsnoise._conclusion import Conclusion, Light
from hsnoise._types import unit_in_words
from hsnoise.criticism import Comparison, Diagnosis, Step, Story
from hsnoise.criticism.compare import FITS, nearer
from hsnoise.criticism.story import together
from hsnoise.model import NoiseModel
from hsnoise.result import FitResult, number, rounded
from hsnoise.stack import FrameStack
from hsnoise.structure import explained

ALARM = 2.0  # times the worst group of the model's own samples
LEAST_SHOWN = 0.1  # misfit at the left end of the bars
YARDSTICK = "1.0 would be as close as the model's own samples"
MOST_CANDIDATES, MOST_FILES = 10, 3
TITLES = {Comparison: "Model against measurement", Diagnosis: "What is missing", Story: "How the model was improved"}


def context(
    found: Comparison | Diagnosis | Story,
    stack: FrameStack,
    fit: FitResult | NoiseModel,
    comparison: Comparison | None,
    files: Sequence[str],
    seed: int,
) -> dict[str, Any]:
    """All that the template needs but figures."""
    diagnosis = found if isinstance(found, Diagnosis) else None
    story = found if isinstance(found, Story) else None
    if isinstance(found, Comparison):
        comparison = found
    elif story is not None:
        comparison, diagnosis = story.steps[-1].comparison, story.steps[-1].diagnosis
    return {
        "title": TITLES[type(found)],
        "made": f"hsnoise {version('hsnoise')}, {date.today().isoformat()}, seed {seed}",
        "conclusion": conclusion(found, comparison),
        "capture": capture(stack, files),
        "parameters": parameters(fit),
        "notes": fit.notes if isinstance(fit, FitResult) else (),
        "outcome": fit.outcome if isinstance(fit, FitResult) else "",
        "bars": None if comparison is None else bars(comparison),
        "comparison": comparison,
        "words": () if comparison is None else explained(comparison.worst),
        "diagnosis": diagnosis,
        "ranking": [] if diagnosis is None else ranking(diagnosis),
        "story": None if story is None else steps(story),
        "ended": "" if story is None else story.ended,
        "split": "" if story is None else story.split,
    }


def conclusion(found: Comparison | Diagnosis | Story, comparison: Comparison | None) -> Conclusion:
    """The finding in one sentence, with the error of the model that a diagnosis is about."""
    said = found.conclusion
    if not isinstance(found, Diagnosis) or comparison is None:
        return said
    error = f"error {number(comparison.error)}"
    if found.verdict == "nothing missing" and comparison.error >= FITS:
        text = f"No effect stands out, but the model does not fit these frames ({error}): is it a fit of this capture?"
        return Conclusion(Light.RED, text)
    after = f" ({error})" if found.verdict == "nothing missing" else f"; {error}, {YARDSTICK}"
    return Conclusion(said.light, f"{said.sentence.removesuffix('.')}{after}.")


def capture(stack: FrameStack, files: Sequence[str]) -> dict[str, Any]:
    """Files, size and exposures of a capture."""
    rows, columns = stack.shape
    more = [f"and {len(files) - MOST_FILES} more"] if len(files) > MOST_FILES else []
    groups = [
        f"{n} {kind}{'s' if n > 1 else ''} of {exposure:g} s"
        for n, kind, exposure in zip(stack.n_frames, stack.kind, stack.exposure_s, strict=True)
    ]
    return {
        "files": ", ".join([*files[:MOST_FILES], *more]),
        "frames": f"{rows} x {columns} pixels, {stack.cfa}, {stack.shutter} shutter",
        "groups": groups,
    }


def parameters(fit: FitResult | NoiseModel) -> list[dict[str, str]]:
    """Rows of the parameter table, with what was chosen for effects; "error" only for a FitResult."""
    model = fit if isinstance(fit, NoiseModel) else fit.params
    settings = [(e.name, n, v) for e in model.effects for n, v in e.settings().items() if v is not None]
    chosen = [
        {"name": f"{name}.{field}", "value": f"{value:g}" if isinstance(value, float) else f"{value}", "unit": ""}
        for name, field, value in settings
    ]
    if isinstance(fit, NoiseModel):
        found = [(name, f"{value:.5g}", unit_in_words(unit)) for name, (value, _, unit) in fit.table.items()]
        return [*(dict(zip(("name", "value", "unit"), row, strict=True)) for row in found), *chosen]
    cells = [(name, *rounded(value, error), unit_in_words(unit)) for name, (value, error, unit) in fit.table.items()]
    rows = [dict(zip(("name", "value", "error", "unit"), row, strict=True)) for row in cells]
    return [*rows, *({**row, "error": "held"} for row in chosen)]


def bars(comparison: Comparison) -> dict[str, Any]:
    """Misfit of each group as a bar on a logarithmic scale, worst first; positions in percent of the width.

    `own`: misfit that the worst group takes on the model's own samples.
    """
    groups = sorted(comparison.groups.items(), key=lambda item: -item[1])
    own = comparison.own_misfit
    span = np.log(1.1 * max(groups[0][1], own, 10.0) / LEAST_SHOWN)

    def at(misfit: float) -> str:
        return f"{100 * max(np.log(max(misfit, LEAST_SHOWN) / LEAST_SHOWN) / span, 0.005):.2f}%"

    shown = [
        {"name": g, "misfit": f"{m:.2f}" if m < 10 else number(m), "width": at(m), "alarm": m > ALARM * own}
        for g, m in groups
    ]
    return {"groups": shown, "one": at(1.0), "own": at(own), "own_misfit": number(own)}


def ranking(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Rows of the ranking table."""
    return [
        {
            "name": c.name,
            "score": f"{c.score:z.1f}",
            "p": c.chance,
            "misfit": f"{c.misfit:z.1f}",
            "named": c.name in diagnosis.names,
        }
        for c in diagnosis.ranking[:MOST_CANDIDATES]
    ]


def steps(story: Story) -> list[dict[str, Any]]:
    """The additions of a story: what, why, the error before and after, what moved."""
    return [
        {
            "added": after.added,
            "what": after.fit.params[after.added].about(),
            "sizes": after.sizes,
            "why": _why(before, after),
            "before": number(before.comparison.error),
            "after": number(after.comparison.error),
            "together": together(before, after).replace("->", "\N{RIGHTWARDS ARROW}"),
            "held_out": _gain(before, after),
            "moved": after.moved,
        }
        for before, after in zip(story.steps[:-1], story.steps[1:], strict=True)
    ]


def _why(before: Step, after: Step) -> list[str]:
    """Reasons to add the effect, the strongest statistics first."""
    ranking = () if before.diagnosis is None else before.diagnosis.ranking
    score = [f"its log-likelihood ratio is {one.score:.0f}" for one in ranking if one.name == after.added]
    return [*nearer(before.comparison, after.comparison)[:2], *score]


def _gain(before: Step, after: Step) -> str:
    change = after.held_out - before.held_out
    return f"{change:+.1f} nats" if np.isfinite(change) else ""
