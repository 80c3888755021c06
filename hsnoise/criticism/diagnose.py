"""`diagnose`: which physical effect is missing, by the statistics that it would move.

Every candidate is drawn on top of the fitted model: its fingerprint is how it shifts and spreads the statistics. What
another choice of the base parameters could absorb is projected out. Candidates are ranked by a Gaussian synthetic
log-likelihood ratio against "nothing missing" (Wood, "Statistical inference for noisy nonlinear ecological dynamic
systems", Nature 466, 2010), and a verdict is given only if the winner also explains what is left.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from hsnoise.criticism.candidates import Maker, built_in, given, made
from hsnoise.criticism.fingerprint import GRID, Fingerprint, base_slopes, fingerprint
from hsnoise.criticism.gaussian import Gaussian, shrunk
from hsnoise.criticism.reference import Reference, measure, reference
from hsnoise.draws import check_fits, darks_of
from hsnoise.effects import AbstractEffect
from hsnoise.model import NoiseModel
from hsnoise.result import FitResult
from hsnoise.stack import as_stack

DRAWS = 64
EVIDENCE = 3.0  # log-likelihood ratio from which an effect is there
MISFIT = 4.5  # normal score of the worst group from which something is there
# What the winner may leave of it: fingerprints of strong effects are known to some percent only.
MISFIT_LEFT, SHARE_LEFT = 3.5, 0.08
AMBIGUOUS = 3.0  # log-likelihood ratio between two names
WORST = 5
# Effects that change darks as another gain, dark current and read noise would; and the capture that decides.
ALIKE = {"black_clamp": ("gain", "flats (evenly lit frames of two or more brightnesses) measure the gain by itself")}


@dataclass(frozen=True)
class Candidate:
    """An effect that may be missing.

    Attributes:
        name: of the effect; effect: ready to add, with a first estimate of its parameters.
        score: log-likelihood ratio against "nothing missing", nats.
        p_value: chance of such a score if nothing is missing, over the whole ranking.
        misfit: normal score of the group of statistics that fits worst with this effect in the model.
    """

    name: str
    effect: AbstractEffect
    score: float
    p_value: float
    misfit: float


@dataclass(frozen=True)
class Unexplained:
    """What remains beyond the best candidate: the worst group's normal score, and the statistics that carry it."""

    misfit: float
    group: str
    statistics: tuple[str, ...]


@dataclass(frozen=True)
class Diagnosis:
    """What `diagnose` found.

    Attributes:
        ranking: candidates, best first.
        verdict: "nothing missing", "named", "ambiguous" or "unexplained".
        best: the first candidate if the verdict is "named" or "ambiguous", else None.
        names: those that the verdict names (several if it is "ambiguous").
        advice: the capture that would decide, or what to look at next.
        unexplained: what remains.
    """

    ranking: tuple[Candidate, ...]
    verdict: str
    best: Candidate | None
    names: tuple[str, ...]
    advice: str
    unexplained: Unexplained

    def plot(self):
        """A figure of the ranking: `hsnoise.plots.ranking`."""
        from hsnoise import plots  # matplotlib is slow to import

        return plots.ranking(self)

    def __str__(self) -> str:
        title = {"named": f"missing: {', '.join(self.names)}", "ambiguous": f"missing: {' or '.join(self.names)}"}
        table = Table("effect", "score / nats", "p", "misfit left", title=title.get(self.verdict, self.verdict))
        for c in self.ranking[:WORST]:
            table.add_row(c.name, f"{c.score:.1f}", f"{c.p_value:.2g}", f"{c.misfit:.1f}")
        console = Console(file=io.StringIO(), width=100, color_system=None)
        console.print(table)
        if self.advice:
            console.print(f"- {self.advice}", highlight=False)
        return console.file.getvalue().rstrip()

    __repr__ = __str__


def diagnose(
    fit: FitResult, stack, *, candidates: Any = (), draws: int = DRAWS, seed: int = 0, progress=None, **keywords
) -> Diagnosis:
    """Name the physical effect that a fitted model lacks.

    Args:
        fit: result of `hsnoise.fit` on this capture, or one like it (a NoiseModel is taken, too).
        stack: FrameStack, or a bare array with FrameStack's keywords; its dark frames are used.
        candidates: effects of your own, ready-made instances, that take part beside the built-in ones.
        draws: captures drawn from the fitted model; seed: of all draws.
        progress: called with no argument after each capture that is drawn.

    Raises:
        TypeError, ValueError: fit and stack do not belong together; a candidate is no effect, or is in the model.
    """
    tick = progress or (lambda: None)
    stack = as_stack(stack, **keywords)
    model = fit.params if isinstance(fit, FitResult) else fit
    if not isinstance(model, NoiseModel):
        raise TypeError(f"fit: expected a result of hsnoise.fit or a NoiseModel, got {type(fit).__name__}")
    check_fits(model, stack)
    own = _own(candidates, model)
    darks = darks_of(stack)
    makers = built_in(model, darks) | own
    base = reference(model, darks, draws, seed, tick)
    z = base.z(measure(darks, model).values)
    slopes = base_slopes(model, darks, base, seed, tick)
    null = shrunk(base.own_z(), slopes)
    prints = [fingerprint(name, maker, model, darks, base, seed, tick) for name, maker in makers.items()]
    ranking = _ranking(prints, z, null, base)
    return _verdict(ranking, z, null, base)


def _own(candidates: Any, model) -> dict[str, Maker]:
    makers = {}
    for effect in candidates:
        if not isinstance(effect, AbstractEffect):
            raise TypeError(f"candidates: expected effects (instances of AbstractEffect), got {effect!r}")
        if effect.name in model:
            raise ValueError(f"candidates: {effect.name} is in the model already")
        makers[effect.name] = given(effect)
    return makers


def _ranking(prints: list[Fingerprint], z: np.ndarray, null: Gaussian, base: Reference) -> tuple[Candidate, ...]:
    """Candidates by their log-likelihood ratio at their best amplitude."""
    nothing = null.log_density(z)
    found = []
    for of in prints:
        laws = [of.law(amplitude, null) for amplitude in GRID]
        scores = np.array([law.log_density(z) for law in laws]) - nothing
        i = int(scores.argmax())
        closest = [Gaussian(shift, laws[i].covariance).log_density(z) for shift in of.at(GRID[i])]
        found.append(
            Candidate(
                name=of.name,
                effect=made(of.maker, float(GRID[i]), int(np.argmax(closest))),
                score=float(scores[i]),
                # A likelihood ratio exceeds c by chance at most once in exp(c) (Markov), in any of the candidates.
                p_value=float(min(1.0, len(prints) * np.exp(-max(scores[i], 0.0)))),
                misfit=max(laws[i].normal_scores(z, base.groups).values()),
            )
        )
    return tuple(sorted(found, key=lambda c: -c.score))


def _verdict(ranking: tuple[Candidate, ...], z: np.ndarray, null: Gaussian, base: Reference) -> Diagnosis:
    scores = null.normal_scores(z, base.groups)
    first, second = ranking[0], ranking[1] if len(ranking) > 1 else None
    there = first.score > EVIDENCE
    names: tuple[str, ...] = ()
    if not there and max(scores.values()) <= MISFIT:
        verdict = "nothing missing"
    elif not there or first.misfit > max(MISFIT_LEFT, SHARE_LEFT * max(scores.values())):
        verdict = "unexplained"
    elif first.name in ALIKE or (second is not None and first.score - second.score < AMBIGUOUS):
        names = (first.name, ALIKE[first.name][0] if first.name in ALIKE else second.name)
        verdict = "ambiguous"
    else:
        verdict, names = "named", (first.name,)
    group = max(scores, key=scores.__getitem__)
    order = [i for i in np.argsort(-np.abs(z)) if abs(z[i]) > 3][:WORST]
    left = first.misfit if names else max(scores.values())
    return Diagnosis(
        ranking=ranking,
        verdict=verdict,
        best=first if names else None,
        names=names,
        advice=_advice(verdict, names, first, group),
        unexplained=Unexplained(left, group, tuple(f"{base.names[i]} (z = {z[i]:+.1f})" for i in order)),
    )


def _advice(verdict: str, names: tuple[str, ...], first: Candidate, group: str) -> str:
    if verdict == "ambiguous":
        return ALIKE[first.name][1] if first.name in ALIKE else f"more frames would tell {names[0]} from {names[1]}"
    if verdict == "unexplained":
        near = f"; {first.name} comes nearest" if first.score > EVIDENCE else ""
        return f"none of the effects in the library explains the {group} statistics{near}"
    return ""
