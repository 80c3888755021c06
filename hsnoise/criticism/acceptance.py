"""Whether a step of `improve` is kept: it must fit better, also on held-out frames, and be beyond chance."""

from __future__ import annotations

import numpy as np

from hsnoise.criticism import rules
from hsnoise.criticism.outcomes import Refusal, Refused
from hsnoise.criticism.ranking import Candidate
from hsnoise.criticism.shares import largest_unexplained
from hsnoise.criticism.story import Step
from hsnoise.effects import AbstractEffect
from hsnoise.fitting.result import FitResult


def why_worse(step: Step, before: Step) -> Refusal | None:
    """In which way statistics or held-out frames fit worse with the added effect; None if they do not."""
    # Held-out frames are the last ones: effects that change from frame to frame are drawn as if they were the first.
    unseen = not (np.isnan(step.held_out) or any(effect.in_series for effect in step.fit.params))
    after, until_now = step.comparison, before.comparison
    errors = until_now.error, after.error
    if not step.fit.converged and after.error * rules.GROWTH > until_now.error and not until_now.fits:
        return Refusal(Refused.NOT_CONVERGED, *errors)
    left, left_until_now = _wrong(step), _wrong(before)
    if left > left_until_now + rules.BUDGET_GROWTH:
        return Refusal(Refused.BUDGET_WORSE, left_until_now, left)
    allowed = rules.WORSE
    if after.error > until_now.error:
        # The worst group may belong to another effect that is still missing, and may vary a little.
        less = sum(after.groups.values()) < rules.TOTAL_FALLS * sum(until_now.groups.values())
        if not less or after.error > rules.GROWTH * until_now.error:
            return Refusal(Refused.STATISTICS_WORSE, *errors)
        allowed = 0.0
    if unseen and step.held_out - before.held_out <= allowed:
        return Refusal(Refused.HELD_OUT_WORSE, before.held_out, step.held_out)
    return None


def _wrong(step: Step) -> float:
    """The largest share of the whole variance that a component is off by, beyond chance.

    Without the fixed pattern of pixels: a few hot pixels may hold most of its variance, and those of a draw are others.
    """
    worst = largest_unexplained([one for one in step.comparison.shares if one.component != "pixel"])
    return 0.0 if worst is None else worst.unexplained_of_total


def is_there(effect: AbstractEffect, result: FitResult) -> bool:
    """Whether an amplitude of the effect is beyond chance in a fit with it; if held in fits, whether it has an effect.

    For an effect that marks no amplitude, parameters with lower bound 0 and no upper bound count, or else those of
    either sign, or shares.
    """
    found = effect.parameters(result.params.channels)
    kinds = (
        [p for p in found if p.spec.amplitude],
        [p for p in found if p.spec.low == 0 and p.spec.high is None],
        [p for p in found if p.spec.low is None],
        [p for p in found if p.spec.low == 0],
    )
    amplitudes = next((some for some in kinds if some), [])
    rows = result.in_dn(effect.name)
    fitted = [p.spec.from_absent(*rows[p.name][:2]) for p in amplitudes if p.name in result.names]
    if not fitted:
        return not amplitudes or any(p.spec.from_absent(p.value)[0] != 0 for p in amplitudes)
    return any(abs(off) > rules.THERE_SIGMA * error for off, error in fitted)


def is_too_little(nearest: tuple[Candidate, ...], steps: list[Step]) -> bool:
    """Whether a further effect is too weak, given that the model fits and others were chosen from the same frames."""
    last = steps[-1]
    late = rules.evidence(len(last.diagnosis.ranking), rules.LATER_RATE)
    return len(steps) > 1 and last.comparison.fits and nearest[0].score < late
