"""What `improve` returns: the steps that a model took, and how the story is told."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from hsnoise._core import html as _html
from hsnoise._core.conclusion import Conclusion, Light
from hsnoise._core.data_frames import data_frame
from hsnoise._core.types import unit_in_words
from hsnoise.criticism.compare import CLOSE, FITS, Comparison, nearer
from hsnoise.criticism.finding import Diagnosis
from hsnoise.fit import without_likelihood
from hsnoise.fitting.result import FitResult, number, rounded
from hsnoise.model import NoiseModel

CHANCE_ERROR = 2.0  # of a right model, rarely exceeded
SIDES_APART = 6.0  # nats from which frames tell on which side of the gain an effect is
FINISHED = "Nothing significant is left"


@dataclass(frozen=True)
class Step:
    """One turn of the loop.

    Attributes:
        fit, comparison, diagnosis: of the model at the start of this step (diagnosis None at the end).
        added: name of the effect that was added to reach this model; None for the first.
        held_out: synthetic log-likelihood of the held-out frames, nats; NaN without any.
        moved: base parameters that changed by more than two standard errors in this step, in words.
        ahead: by how much what was added is likelier on its side of the gain than on the other, nats; NaN without.
    """

    fit: FitResult
    comparison: Comparison
    diagnosis: Diagnosis | None
    added: str | None
    held_out: float
    moved: tuple[str, ...]
    ahead: float = float("nan")

    @property
    def sizes(self) -> tuple[str, ...]:
        """What was fitted of the effect that was added, and what was chosen for it, in words."""
        if self.added is None:
            return ()
        open_ = f"{self.added} fits as well on the other side of the gain: these frames do not tell which it is on."
        return (*_sizes(self.fit, self.added), *([open_] if self.ahead < SIDES_APART else []))


@dataclass(frozen=True)
class Story:
    """The history of `improve`.

    Attributes:
        steps: from the first fit to the last that was kept.
        ended: why it ended, in a sentence.
        split: which frames were fitted and which were held out, in a sentence; empty if all were fitted.
    """

    steps: tuple[Step, ...]
    ended: str
    split: str = ""

    @property
    def fit(self) -> FitResult:
        """The last fit that was kept."""
        return self.steps[-1].fit

    @property
    def params(self) -> NoiseModel:
        return self.fit.params

    @property
    def finished(self) -> bool:
        """Whether nothing significant was left at the end."""
        return self.ended.startswith(FINISHED)

    @property
    def conclusion(self) -> Conclusion:
        """Whether the last model may be used, and what became of the error."""
        error, last = self.errors[-1], self.fit.conclusion
        if last.light == Light.RED or error >= CLOSE:
            light = Light.RED
        else:
            light = last.light if self.finished and error < FITS else Light.AMBER
        doubt = "" if last.light == Light.GREEN else f" {last.sentence}"
        return Conclusion(light, f"{self._in_short()}{doubt}")

    def _in_short(self) -> str:
        """What was added, what became of the error, why the story ended."""
        added = [step.added for step in self.steps if step.added]
        head, _, _ = self.ended.partition(". ")  # the rest, what was tried in vain, is in `ended`
        head = head.partition(": ")[0].removesuffix(".").replace(f" (error {self.errors[-1]:.2f})", "")
        if not added:
            return f"{head} (error {number(self.errors[-1])})."
        first, last = self.errors[0], self.errors[-1]
        how = "fell" if last < first else "went"
        ended = head[0].lower() + head[1:]
        return f"Added {', '.join(added)}, and the error {how} from {number(first)} to {number(last)}; {ended}."

    @property
    def start(self) -> str:
        """The first model in words: effects beyond the paper's by their names."""
        return " + ".join(["the paper's model", *without_likelihood(self.steps[0].fit.params)])

    @property
    def errors(self) -> tuple[float, ...]:
        """`error` of each step."""
        return tuple(step.comparison.error for step in self.steps)

    @property
    def details(self) -> tuple[str, ...]:
        """What was added in each step, why, how large it is, and what else moved, in sentences."""
        told = []
        for i, step in enumerate(self.steps):
            reason = self._reason(i)
            told += [f"- {reason}"] if reason else []
            told += [f"  {sentence}" for sentence in (*step.sizes, *step.moved)]
        return tuple(told)

    def _reason(self, i: int) -> str:
        """Why step `i` was taken; empty for the first."""
        step, before = self.steps[i], self.steps[i - 1]
        if not step.added:
            return ""
        errors = f"{before.comparison.error:.2f} -> {step.comparison.error:.2f}"
        return (
            f"Step {i}: added {step.added}, because {_because(before, step)}; error {errors}{together(before, step)}."
        )

    @property
    def _closing(self) -> tuple[str, ...]:
        """How it ended, and what to bear in mind."""
        return tuple(sentence for sentence in (self.ended, self.care, self.split) if sentence)

    @property
    def care(self) -> str:
        """What to mind of the last fit; empty if it converged."""
        return "" if self.fit.converged else f"Read its numbers with care, the last fit has {self.fit.outcome}."

    def plot(self):
        """A figure of the error falling: `hsnoise.plots.story`."""
        from hsnoise import plots  # matplotlib is slow to import

        return plots.story(self)

    def to_pandas(self) -> Any:
        """The steps as a pandas DataFrame: step, added, error, held_out_nats, worst_group (needs `hsnoise[pandas]`).

        `added` of the first is the model it began with. Raises ImportError without pandas.
        """
        return data_frame(self, ("step", "added", "error", "held_out_nats", "worst_group"), self._rows())

    def _rows(self) -> Iterator[tuple[int, str, float, float, str]]:
        for i, step in enumerate(self.steps):
            worst = max(step.comparison.groups, key=step.comparison.groups.__getitem__)
            yield i, step.added or self.start, step.comparison.error, step.held_out, worst

    def as_table(self) -> Table:
        """The steps, as they are printed."""
        table = Table("step", "added", "error", "held-out / nats", "worst group")
        for i, added, error, held_out, worst in self._rows():
            table.add_row(str(i), added, f"{error:.2f}", "" if np.isnan(held_out) else f"{held_out:.1f}", worst)
        return table

    def __str__(self) -> str:
        console = Console(file=io.StringIO(), width=100, color_system=None)
        console.print(str(self.conclusion), self.as_table(), sep="\n", highlight=False, markup=False)
        for sentence in (*self.details, *self._closing):
            console.print(sentence, highlight=False, markup=False)
        return console.file.getvalue().rstrip()

    __repr__ = __str__

    def _repr_html_(self) -> str:
        steps = [(self._reason(i), (*step.sizes, *step.moved)) for i, step in enumerate(self.steps)]
        return _html.fragment(
            _html.conclusion(self.conclusion),
            _html.printed(self.as_table()),
            _html.details("Why each effect was added", *(_html.sentences(told, reason) for reason, told in steps)),
            _html.details("How it ended", _html.sentences(self._closing)),
        )


def together(before: Step, after: Step) -> str:
    """What fell, in words, where an addition was kept although the error, that of the worst group, did not fall."""
    if after.comparison.error <= before.comparison.error:
        return ""
    sums = [sum(step.comparison.groups.values()) for step in (before, after)]
    return f", misfit of all groups together {number(sums[0])} -> {number(sums[1])}"


def _sizes(result: FitResult, name: str) -> tuple[str, ...]:
    rows = [(n, row) for n, row in result.table.items() if n == name or n.startswith(f"{name}.")]
    told = []
    for label, (value, error, unit) in rows:
        size, of = rounded(value, error)
        of = f"± {of}" if error > 0 and np.isfinite(error) else f"({of})"
        told.append(f"{label} = {size} {of} {unit_in_words(unit)}".rstrip())
    chosen = result.params[name].settings().items()
    told += [f"{name}.{field}: {value}" for field, value in chosen if value is not None]
    return tuple(f"{sentence}." for sentence in told)


def _because(before: Step, after: Step) -> str:
    found, reasons = before.diagnosis, nearer(before.comparison, after.comparison)
    if reasons:
        reason = reasons[0]
    else:
        score = next((one.score for one in found.ranking if one.name == after.added), 0.0) if found else 0.0
        reason = f"its fingerprint is in the statistics (score {score:.0f} nats)"
    if found is not None and found.verdict == "unexplained" and after.comparison.error > CHANCE_ERROR:
        return f"{reason} (no effect explains all that is off; this one comes nearest)"
    return reason
