"""What `improve` returns: the steps that a model took."""

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
from hsnoise.criticism import rules, sentences, shares
from hsnoise.criticism.closing import ClosedModel
from hsnoise.criticism.compare import Comparison, nearer
from hsnoise.criticism.finding import Diagnosis
from hsnoise.criticism.outcomes import Ended, Ending, Verdict
from hsnoise.fit import without_likelihood
from hsnoise.fitting.result import FitResult, number
from hsnoise.model import NoiseModel

CLOSED = "closed with measured components"


@dataclass(frozen=True)
class Step:
    """One turn of the loop.

    Attributes:
        fit, comparison, diagnosis: of the model at the start of this step (diagnosis None at the end).
        added: name of the effect that was added to reach this model; None for the first.
        held_out: log score of the held-out frames, nats; NaN without any.
        moved: base parameters that changed by more than two standard errors in this step, in words.
        ahead: by how much what was added is likelier on its side of the gain than on the other, nats; NaN without.
        held_out_error: standard error of the change of `held_out` from the step before, by its simulation, nats.
        gained: nats that frames of the fit gained by what was added, where they judged it; NaN if held-out ones did.
        beside: names of the effects that were fitted together with what was added.
    """

    fit: FitResult
    comparison: Comparison
    diagnosis: Diagnosis | None
    added: str | None
    held_out: float = float("nan")
    moved: tuple[str, ...] = ()
    ahead: float = float("nan")
    held_out_error: float = float("nan")
    gained: float = float("nan")
    beside: tuple[str, ...] = ()

    @property
    def sizes(self) -> tuple[str, ...]:
        """What was fitted of the effect that was added, and what was chosen for it, in words."""
        if self.added is None:
            return ()
        effect = self.fit.params[self.added]
        sizes = sentences.sizes(self.fit.in_dn(self.added), effect, self.ahead < rules.SIDES_APART)
        return sizes if np.isnan(self.gained) else (*sizes, sentences.by_fitted(self.gained))


@dataclass(frozen=True)
class Story:
    """The history of `improve`.

    Attributes:
        steps: from the first fit to the last that was kept.
        ending: how it ended; `ended` is that in a sentence.
        split: which frames were fitted and which were held out, in a sentence; empty if all were fitted.
        closed: the last model closed with measured components, if that was asked for and came nearer.
        left_open: why it is not closed, in a sentence, if that was asked for in vain.
        seed: of all draws.
    """

    steps: tuple[Step, ...]
    ending: Ending
    split: str = ""
    closed: ClosedModel | None = None
    left_open: str = ""
    seed: int = 0

    @property
    def fit(self) -> FitResult:
        """The last fit that was kept."""
        return self.steps[-1].fit

    @property
    def params(self) -> NoiseModel:
        """The model: closed with measured components if that was asked for, else that of the last fit."""
        return self.fit.params if self.closed is None else self.closed.params

    @property
    def finished(self) -> bool:
        """Whether nothing significant was left at the end."""
        return self.ending.why == Ended.FINISHED

    @property
    def ended(self) -> str:
        """Why it ended, in a sentence."""
        found = self.steps[-1].diagnosis
        headline, advice = ("", "") if found is None else (found.headline, found.advice)
        return sentences.ended(self.ending, self.errors[-1], headline, advice)

    @property
    def conclusion(self) -> Conclusion:
        """Whether the last model can be used, and how the error changed."""
        error, last = self.errors[-1], self.fit.conclusion
        if last.light == Light.RED or error >= rules.CLOSE:
            light = Light.RED
        else:
            light = last.light if self.finished and self.steps[-1].comparison.fits else Light.AMBER
        doubt = "" if last.light == Light.GREEN else last.sentence
        if (light, last.light) == (Light.RED, Light.AMBER):
            doubt = last.rest  # its head, "usable", would contradict the light
        found = self.steps[-1].diagnosis
        ended = sentences.ended_in_short(self.ending, "" if found is None else found.headline)
        added = [step.added for step in self.steps if step.added]
        if self.closed is not None:
            named = sentences.added_in_short(added, self.errors[0], error) if added else ""
            if last.light == Light.RED:  # its head would contradict a light that is of the frames
                doubt = f"Do not use its numbers: {last.rest or 'the fit did not converge.'}"
            rest = " ".join(part for part in (named, f"{ended}.", doubt) if part)
            return Conclusion(_light_of_closed(self.closed, last.light), self.closed.summary, rest)
        if not added:
            return Conclusion(light, f"{ended} (error {number(error)}).", doubt)
        head = sentences.added_in_short(added, self.errors[0], error)
        return Conclusion(light, head, f"{ended}. {doubt}".rstrip())

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
        said = []
        for i, step in enumerate(self.steps):
            reason = self._reason(i)
            said += [f"- {reason}"] if reason else []
            said += [f"  {sentence}" for sentence in (*step.sizes, *step.moved)]
        return tuple(said)

    def _reason(self, i: int) -> str:
        """Why step `i` was taken; empty for the first."""
        step, before = self.steps[i], self.steps[i - 1]
        if not step.added:
            return ""
        errors = before.comparison.error, step.comparison.error
        return sentences.added(i, step.added, _because(before, step), *errors, together(before, step))

    @property
    def _closing(self) -> tuple[str, ...]:
        """How it ended, and what to bear in mind."""
        return tuple(sentence for sentence in (self.ended, self.care, self.split, *self.measured) if sentence)

    @property
    def measured(self) -> tuple[str, ...]:
        """The part of the noise that is not reproduced; with measured components, or why they were left out."""
        if self.closed is not None:
            return self.closed.summary, self.closed.static
        left = self.steps[-1].comparison.unexplained
        return tuple(f"{one[0].upper()}{one[1:]}" for one in (left and f"{left}.", self.left_open) if one)

    @property
    def care(self) -> str:
        """A warning about the last fit; empty if it converged."""
        return "" if self.fit.converged else sentences.with_care(self.fit.outcome)

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
            found = step.comparison
            yield i, step.added or self.start, found.error, step.held_out, found.worst_group

    def as_table(self) -> Table:
        """The steps, as they are printed."""
        table = Table("step", "added", "error", "held-out / nats", "worst group")
        for i, added, error, held_out, worst in self._rows():
            table.add_row(str(i), added, f"{error:.2f}", "" if np.isnan(held_out) else f"{held_out:.1f}", worst)
        if self.closed is not None:
            found = self.closed.comparison
            table.add_row(str(len(self.steps)), CLOSED, f"{found.error:.2f}", "", found.worst_group)
        return table

    def __str__(self) -> str:
        console = Console(file=io.StringIO(), width=100, color_system=None)
        console.print(str(self.conclusion), self.as_table(), sep="\n", highlight=False, markup=False)
        if self.closed is not None:
            console.print(shares.as_table(self.closed.shares))
        for sentence in (*self.details, *self._closing):
            console.print(sentence, highlight=False, markup=False)
        return console.file.getvalue().rstrip()

    __repr__ = __str__

    def _repr_html_(self) -> str:
        steps = [(self._reason(i), (*step.sizes, *step.moved)) for i, step in enumerate(self.steps)]
        return _html.fragment(
            _html.conclusion(self.conclusion),
            _html.printed(self.as_table()),
            "" if self.closed is None else _html.printed(shares.as_table(self.closed.shares)),
            _html.details("Why each effect was added", *(_html.sentences(told, reason) for reason, told in steps)),
            _html.details("How it ended", _html.sentences(self._closing)),
        )


def _light_of_closed(closed: ClosedModel, of_fit: Light) -> Light:
    """A closed model may be used if either error is small; its electrons are no surer than the gain of the fit."""
    error, worst = closed.comparison.error, closed.largest_unexplained
    if error >= rules.CLOSE and worst is not None and worst.unexplained_of_total > rules.CLOSED_SHARE:
        return Light.RED
    return Light.GREEN if closed.comparison.fits and of_fit == Light.GREEN else Light.AMBER


def together(before: Step, after: Step) -> str:
    """What fell, in words, where an addition was kept although the error, that of the worst group, did not fall."""
    if after.comparison.error <= before.comparison.error:
        return ""
    return sentences.fell_together(*(step.comparison.total for step in (before, after)))


def _because(before: Step, after: Step) -> str:
    found, ranking = before.diagnosis, () if before.diagnosis is None else before.diagnosis.ranking
    score = next((one.score for one in ranking if one.name == after.added), 0.0)
    is_nearest = found is not None and found.verdict == Verdict.UNEXPLAINED and not after.comparison.fits
    return sentences.because(nearer(before.comparison, after.comparison), score, is_nearest, after.beside)


def moved(before: FitResult, after: FitResult) -> tuple[str, ...]:
    """Base parameters that changed by more than two standard errors from one fit to another, in words."""
    found = []
    for name in before.names:
        (old, error, unit), (new, new_error, _) = before.table[name], after.table[name]
        if abs(new - old) > rules.MOVED_SIGMA * max(error, new_error) > 0:
            found.append(sentences.moved(name, (old, error), (new, new_error), unit))
    return tuple(found)
