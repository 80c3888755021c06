"""What `diagnose` found."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.table import Table

from hsnoise._core import html as _html
from hsnoise._core.conclusion import Conclusion, Light
from hsnoise._core.data_frames import data_frame
from hsnoise.criticism import rules
from hsnoise.criticism import sentences as _sentences
from hsnoise.criticism.outcomes import Verdict
from hsnoise.criticism.ranking import Candidate
from hsnoise.effects import EFFECTS

WORST = 5


@dataclass(frozen=True)
class Unexplained:
    """What remains: the worst group's normal score, and the statistics that are far off, with their z.

    With the named effects in the model, or the nearest ones if they explain half of the misfit; else with neither.
    """

    misfit: float
    group: str
    statistics: tuple[str, ...]

    @property
    def stands_out(self) -> bool:
        """Whether a group as a whole is off by more than chance; single statistics among hundreds may be."""
        return self.misfit > rules.MISFIT_LEFT


@dataclass(frozen=True)
class Diagnosis:
    """What `diagnose` found.

    Attributes:
        ranking: candidates, best first; two that explain the capture only together come before all others.
        verdict: "nothing missing", "named", "ambiguous" or "unexplained".
        best: the first candidate if the verdict is "named" or "ambiguous", else None.
        names: those that the verdict names: two if it is "ambiguous", or if two effects are missing together.
        advice: the capture that would decide, or what to look at next.
        unexplained: what remains.
        nearest: if none explains the capture, the effects that explain most statistics, best first; `improve` tries
            them. The scores of the ranking then mean little.
        together: of these, the effects that explain most statistics if they are in the sensor together.
    """

    ranking: tuple[Candidate, ...]
    verdict: Verdict
    best: Candidate | None
    names: tuple[str, ...]
    advice: str
    unexplained: Unexplained
    nearest: tuple[Candidate, ...] = ()
    together: tuple[Candidate, ...] = ()

    @property
    def headline(self) -> str:
        """The verdict in a few words: "missing: row_noise and hot_pixels"."""
        return _sentences.headline(self.verdict, self.names)

    @property
    def conclusion(self) -> Conclusion:
        """Whether the model lacks something, and what."""
        lights = {Verdict.NOTHING_MISSING: Light.GREEN, Verdict.UNEXPLAINED: Light.RED}
        return Conclusion(lights.get(self.verdict, Light.AMBER), _sentences.judgement(self.verdict, self.names))

    @property
    def named(self) -> tuple[Candidate, ...]:
        """The candidates that the verdict names."""
        return tuple(c for c in self.ranking if c.name in self.names)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is named, with a first estimate of its parameters, and what to do next."""
        said = (
            *(_sentences.first_estimate(c.effect) for c in self.named),
            self.advice,
            _sentences.come_nearest(c.name for c in self.nearest[:WORST]) if self.nearest else "",
            *(_sentences.open_side(c.effect) for c in self.named),
            "" if self.best is None else _sentences.next_call(type(self.best.effect) not in EFFECTS),
        )
        return tuple(sentence for sentence in said if sentence)

    def plot(self):
        """A figure of the ranking: `hsnoise.plots.ranking`."""
        from hsnoise import plots  # matplotlib is slow to import

        return plots.ranking(self)

    def to_pandas(self) -> Any:
        """`ranking` as a pandas DataFrame: effect, score_nats, p, z_left (needs `hsnoise[pandas]`).

        Raises ImportError without pandas.
        """
        rows = ((c.name, c.score, c.p_value, c.misfit) for c in self.ranking)
        return data_frame(self, ("effect", "score_nats", "p", "z_left"), rows)

    def as_table(self) -> Table:
        """The top of the ranking, as printed."""
        table = Table("effect", "score / nats", "p", "z left")
        for c in self.ranking[:WORST]:
            table.add_row(c.name, f"{c.score:z.1f}", c.chance, f"{c.misfit:z.1f}")
        return table

    def __str__(self) -> str:
        console = Console(file=io.StringIO(), width=100, color_system=None)
        console.print(str(self.conclusion), markup=False, highlight=False)
        console.print(self.as_table())
        for sentence in (_sentences.LEGEND, *self.sentences, self.remains):
            if sentence:
                console.print(f"- {sentence}", highlight=False)
        return console.file.getvalue().rstrip()

    __repr__ = __str__

    def _repr_html_(self) -> str:
        remains = [sentence for sentence in (self.remains,) if sentence]
        return _html.fragment(
            _html.conclusion(self.conclusion),
            _html.printed(self.as_table()),
            _html.sentences(self.sentences),
            _html.details("What the columns mean, and what is left", _html.sentences((_sentences.LEGEND, *remains))),
        )

    @property
    def remains(self) -> str:
        """A sentence on what is still off with the named effects in the model; empty if nothing stands out."""
        if not self.names or not self.unexplained.stands_out:
            return ""
        left = self.unexplained
        return _sentences.still_off(self.names, left.group, left.misfit, left.statistics)
