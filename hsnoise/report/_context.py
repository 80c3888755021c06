"""The page's content: words and numbers for the template, from a result."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date
from importlib.metadata import version
from typing import Any

import numpy as np

from hsnoise._core.conclusion import Conclusion, Light
from hsnoise._core.types import seconds, unit_in_words
from hsnoise.criticism import Comparison, Diagnosis, Step, Story, sentences
from hsnoise.criticism.compare import nearer
from hsnoise.criticism.outcomes import Ended, Verdict
from hsnoise.criticism.story import together
from hsnoise.fitting.result import FitResult, number, rounded
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.plots._groups import COLOUR_OF, INK, PLACE, WORDS, Part, family_of, parts_of
from hsnoise.statistics.structure import explained

ALARM = 2.0  # times the worst group of the model's own samples
LEAST_SHOWN = 0.1  # misfit at the left end of the bars
YARDSTICK = "1.0 would be as close as the model's own samples"
MOST_CANDIDATES, MOST_FILES, MOST_SHARES = 10, 3, 8
TITLES = {
    Comparison: "Model against measurement",
    Diagnosis: "What is missing",
    Story: "How the model was improved",
    FitResult: "A model fitted to these frames",
}
LIGHTS = {Light.GREEN: "Fits", Light.AMBER: "With doubts", Light.RED: "Do not use this"}
LIGHTS_OF_COMPARISON = {Light.GREEN: "Fits", Light.AMBER: "Comes close", Light.RED: "Does not fit"}
LETTER = 0.95  # width in percent of a desktop's bar, of a name within a part of it


def context(
    found: Comparison | Diagnosis | Story | FitResult,
    stack: FrameStack,
    fit: FitResult | NoiseModel,
    comparison: Comparison | None,
    files: Sequence[str],
    seed: int,
) -> dict[str, Any]:
    """Everything that the template needs, except figures."""
    diagnosis = found if isinstance(found, Diagnosis) else None
    story = found if isinstance(found, Story) else None
    if isinstance(found, Comparison):
        comparison = found
    elif story is not None:
        comparison, diagnosis = story.steps[-1].comparison, story.steps[-1].diagnosis
    said = conclusion(found, comparison)
    return {
        "title": TITLES[type(found)],
        "made": f"hsnoise {version('hsnoise')}, {date.today().isoformat()}, seed {seed}",
        "conclusion": said,
        "light": (LIGHTS_OF_COMPARISON if isinstance(found, Comparison) else LIGHTS)[said.light],
        "said": (said.head, said.rest),
        "capture": capture(stack, files),
        "parameters": parameters(fit),
        "doubts": fit.doubts if isinstance(fit, FitResult) else (),
        "notes": fit.notes if isinstance(fit, FitResult) else (),
        "outcome": fit.outcome if isinstance(fit, FitResult) else "",
        "bars": None if comparison is None else bars(comparison),
        "comparison": comparison,
        "shares": () if comparison is None else left_by(comparison, story),
        "words": () if comparison is None else explained(comparison.worst),
        "diagnosis": diagnosis,
        "ranking": [] if diagnosis is None else ranking(diagnosis),
        "story": None if story is None else steps(story),
        "stacked": None if story is None else stacked(story),
        "unfinished": story is not None and story.ending.why == Ended.UNFINISHED,
        "ended": "" if story is None else story.ended,
        "split": "" if story is None else story.split,
    }


def conclusion(found: Comparison | Diagnosis | Story | FitResult, comparison: Comparison | None) -> Conclusion:
    """The conclusion in one sentence; for a diagnosis, with the error of the model."""
    said = found.conclusion
    if not isinstance(found, Diagnosis) or comparison is None:
        return said
    error = f"error {number(comparison.error)}"
    if found.verdict != Verdict.NOTHING_MISSING:
        return Conclusion(said.light, said.head, f"{error.capitalize()}, {YARDSTICK}.")
    if not comparison.fits:
        text = f"No effect stands out, but the model does not fit these frames ({error}): is it a fit of this capture?"
        return Conclusion(Light.RED, text)
    return Conclusion(said.light, f"Nothing significant is missing ({error}).")


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
    """Rows of the parameter table, with the effects' settings; "error" only for a FitResult."""
    model = fit if isinstance(fit, NoiseModel) else fit.params
    settings = [(e.name, n, v) for e in model.effects for n, v in e.settings().items() if v is not None]
    chosen = [
        {"name": f"{name}.{field}", "value": f"{value:g}" if isinstance(value, float) else f"{value}", "unit": ""}
        for name, field, value in settings
    ]
    if isinstance(fit, NoiseModel):
        found = [(name, f"{value:.5g}", unit_in_words(unit)) for name, (value, _, unit) in fit.table.items()]
        return [*(dict(zip(("name", "value", "unit"), row, strict=True)) for row in found), *chosen]
    cells = [(name, *rounded(value, error), unit_in_words(unit)) for name, (value, error, unit) in fit.told.items()]
    rows = [dict(zip(("name", "value", "error", "unit"), row, strict=True)) for row in cells]
    return [*rows, *({**row, "error": "held"} for row in chosen)]


def stacked(story: Story) -> dict[str, Any]:
    """A bar for each step of a story, with a part per group of statistics; positions in percent of the width."""
    bars = [parts_of(step.comparison) for step in story.steps]
    longest = max(1.0, *(sum(part.decades for part in parts) for parts in bars))
    names = [story.start, *(f"+ {step.added}" for step in story.steps[1:])]
    there = {part.family for parts in bars for part in parts}
    return {
        "decade": f"{100 / longest:.4f}%",
        "steps": [
            {"name": name, "error": number(error), "parts": [_part(part, longest) for part in parts]}
            for name, error, parts in zip(names, story.errors, bars, strict=True)
        ],
        "legend": [(COLOUR_OF[family], WORDS[family]) for family in PLACE if family in there],
    }


def _part(part: Part, longest: float) -> dict[str, Any]:
    width = 100 * part.decades / longest
    return {
        "group": part.group,
        "times": number(part.times),
        "width": f"{width:.3f}%",
        "colour": COLOUR_OF[part.family],
        "ink": INK[part.family],
        "named": width > LETTER * len(part.group) + 1,
    }


def bars(comparison: Comparison) -> dict[str, Any]:
    """Misfit of each group as a bar on a logarithmic scale, worst first; positions in percent of the width.

    `own`: misfit of the worst group on the model's own samples.
    """
    groups = sorted(comparison.groups.items(), key=lambda item: -item[1])
    own = comparison.own_misfit
    largest = 1.1 * max(groups[0][1], own, 10.0)
    shown = [
        {
            "name": g,
            "misfit": f"{m:.2f}" if m < 10 else number(m),
            "width": _along(m, LEAST_SHOWN, largest),
            "colour": COLOUR_OF[family_of(g)],
            "alarm": m > ALARM * own,
        }
        for g, m in groups
    ]
    ends = LEAST_SHOWN, largest
    return {"groups": shown, "one": _along(1.0, *ends), "own": _along(own, *ends), "own_misfit": number(own)}


def left_by(comparison: Comparison, story: Story | None) -> list[dict[str, str]]:
    """The components of the noise budget that the model is furthest from, that of most of the variance first."""
    shares = comparison.shares if story is None or story.closed is None else story.closed.shares
    off = sorted((one for one in shares if one.unexplained_dn > 0), key=lambda one: -one.unexplained_of_total)
    return [
        {
            "component": one.in_words,
            "where": " ".join(("" if one.channel == "mono" else one.channel, seconds(one.exposure_s))).strip(),
            "measured": f"{max(one.measured_dn2, 0.0):.3g}",
            "model": f"{max(one.closed_dn2, 0.0):.3g}",
            "off": one.off.replace("-", "\N{MINUS SIGN}"),
            "share": f"{100 * one.unexplained_of_total:.2g} %",
        }
        for one in off[:MOST_SHARES]
    ]


def _along(value: float, low: float, high: float) -> str:
    """The position of a value on a logarithmic scale, in percent of the width."""
    return f"{100 * max(np.log(max(value, low) / low) / np.log(high / low), 0.005):.2f}%"


def ranking(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Rows of the ranking table; `width` is the length of a score's bar in percent."""
    shown = diagnosis.ranking[:MOST_CANDIDATES]
    largest = max(10.0, *(c.score for c in shown))  # keeps bars of chance scores short
    return [
        {
            "name": c.name,
            "score": f"{c.score:z.1f}",
            "width": f"{100 * max(c.score / largest, 0.005):.2f}%",
            "p": c.chance,
            "misfit": f"{c.misfit:z.1f}",
            "named": c.name in diagnosis.names,
        }
        for c in shown
    ]


def steps(story: Story) -> list[dict[str, Any]]:
    """The steps of a story: the added effect, why, the error before and after, changed parameters."""
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
    beside = [f"it was fitted together with {sentences.all_of(after.beside)}"] if after.beside else []
    return [*nearer(before.comparison, after.comparison)[:2], *score, *beside]


def _gain(before: Step, after: Step) -> str:
    change = after.held_out - before.held_out
    if not np.isfinite(change) or np.isfinite(after.gained):
        return ""
    return sentences.gained(change, after.held_out_error) if after.held_out_error > 0 else f"{change:+.1f} nats"
