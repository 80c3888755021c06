"""Whether a step of `improve` is kept: the model with it must predict frames that no fit has seen better."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from hsnoise.criticism import rules
from hsnoise.criticism.held_out import Judge
from hsnoise.criticism.outcomes import Improvement, Refusal, Refused
from hsnoise.criticism.ranking import Candidate
from hsnoise.criticism.story import Step
from hsnoise.effects import AbstractEffect
from hsnoise.fitting.result import FitResult
from hsnoise.fitting.simulated import Draft
from hsnoise.likelihood.parameters import parameters_of


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


class Held(NamedTuple):
    """Effects that were fitted together and each hold.

    fit: with all of them; names: the one that gains most beside the others first; gain: by all.
    """

    fit: FitResult | Draft
    names: tuple[str, ...]
    gain: Improvement


def those_that_hold(
    judge: Judge,
    before: FitResult,
    effects: Sequence[AbstractEffect],
    fitted: Callable[[Sequence[AbstractEffect]], FitResult | Draft | None],
    tell: Callable[[str, Refusal], Any],
    tick: Callable[[], None],
) -> Held | None:
    """Of several effects, those with which the model is better, and also than itself without any one of them.

    Those that do not hold beside the others are taken out, and the others fitted again. None if no fit holds.

    fitted: the model before with some effects more, or None if it cannot be fitted; tell: called with the name of each
    that is taken out, and why; tick: called after each draw.
    """
    while effects:
        found = fitted(effects)
        if found is None:
            return None
        gains = {}
        for effect in effects:
            numbers = len(parameters_of(found.params, (effect.name,)).names)
            gains[effect.name] = judge.improvement(found.params.remove(effect.name), found.params, numbers, tick)
        if all(gain.holds for gain in gains.values()):
            whole = judge.improvement(before.params, found.params, len(found.names) - len(before.names), tick)
            names = sorted(gains, key=lambda name: gains[name].cost - gains[name].nats)
            return Held(found, tuple(names), whole) if whole.holds else None
        for name, gain in gains.items():
            if not gain.holds:
                tell(name, Refusal(Refused.NO_CHANGE, gain))
        effects = [found.params[name] for name, gain in gains.items() if gain.holds]
    return None


def is_too_little(nearest: tuple[Candidate, ...], steps: list[Step]) -> bool:
    """Whether a further effect is too weak, given that the model fits and others were chosen from the same frames."""
    last = steps[-1]
    late = rules.evidence(len(last.diagnosis.ranking), rules.LATER_RATE)
    return len(steps) > 1 and last.comparison.fits and nearest[0].score < late
