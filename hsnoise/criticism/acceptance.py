"""Whether a step of `improve` is kept: the model with it must predict frames that no fit has seen better."""

from __future__ import annotations

from collections.abc import Callable

from hsnoise.criticism import rules
from hsnoise.criticism.held_out import Judge
from hsnoise.criticism.outcomes import Improvement, Refusal, Refused
from hsnoise.criticism.ranking import Candidate
from hsnoise.criticism.story import Step
from hsnoise.fitting.result import FitResult
from hsnoise.fitting.simulated import Draft


def judged(
    judge: Judge, before: FitResult, after: FitResult | Draft, added: str, tick: Callable[[], None]
) -> Improvement | Refusal:
    """What a fit gains by an added effect, or why it is left out.

    The model must be better than the one before it, and also than itself without the effect: else only refitting the
    others has helped. tick: called after each draw.
    """
    numbers = len(after.names) - len(before.names)
    gain = judge.improvement(before.params, after.params, numbers, tick)
    if not gain.holds:
        return Refusal(Refused.NO_BETTER, gain)
    by_itself = judge.improvement(after.params.remove(added), after.params, numbers, tick)
    return gain if by_itself.holds else Refusal(Refused.NO_CHANGE, by_itself)


def is_too_little(nearest: tuple[Candidate, ...], steps: list[Step]) -> bool:
    """Whether a further effect is too weak, given that the model fits and others were chosen from the same frames."""
    last = steps[-1]
    late = rules.evidence(len(last.diagnosis.ranking), rules.LATER_RATE)
    return len(steps) > 1 and last.comparison.fits and nearest[0].score < late
