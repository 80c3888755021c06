"""What `compare`, `diagnose` and `improve` found, in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from hsnoise._core.types import seconds, unit_in_words
from hsnoise.criticism import rules
from hsnoise.criticism.outcomes import Ended, Ending, Refusal, Refused, Verdict, has_sides, side_of
from hsnoise.effects import AbstractEffect
from hsnoise.fitting.result import number, rounded

if TYPE_CHECKING:
    from hsnoise.criticism.shares import Share

LEGEND = (
    "score: log-likelihood ratio of this effect alone against nothing missing (similar effects score, too: the first"
    " is the one named); z left: how far off the worst group of statistics is with the effect in the model, in normal"
    " standard deviations (below 3.5 is chance); p: probability of this score if nothing is missing"
)
ENDED_IN_SHORT = {
    Ended.FINISHED: "Nothing significant is left",
    Ended.WEAK_LEFT: "No effect stands out, but something weak may be left",
    Ended.AS_CHANCE: "Nothing more could be added, and the error is within chance",
    Ended.NOT_HELD: "Still {headline}, but no refit with it was kept",
    Ended.UNEXPLAINED: "Something is left that no effect of the library explains",
    Ended.MINUTES: "It stopped after {limit}; something may be left",
    Ended.STEPS: "It stopped after {limit}; something may be left",
    Ended.UNFINISHED: "Not finished",
}
NEGLIGIBLE = 1e-3  # of the variance: a component that is off by less is not told
UNITS = {Ended.MINUTES: "minute", Ended.STEPS: "addition"}  # of a limit
REFUSED = {
    Refused.NOT_FITTED: "could not be fitted",
    Refused.NO_BETTER: "predicts the frames no better",
    Refused.NO_CHANGE: "made no difference by itself",
}


# Comparisons


def describes(error: float) -> str:
    """The sentence for a model that fits."""
    return f"The model describes these frames: error {number(error)} (1.0: as close as its own samples)."


def fails(error: float, worst: str, is_close: bool) -> str:
    """The sentence for a model that does not fit, with the worst group of statistics."""
    how = "comes close to these frames, but does not fit" if is_close else "does not describe these frames"
    close = "1.0 would be as close as its own samples"
    return f"The model {how}; {worst} is worst: error {number(error)}, {close}."


def fails_in_one(error: float, max_z: float, worst: str) -> str:
    """The sentence for a model whose groups of statistics fit, but not a single statistic."""
    return f"The model fits but for one statistic, {max_z:.3g} deviations off (error {number(error)}): {worst}."


def unexplained(worst: Share | None) -> str:
    """The largest part of the noise that a model does not reproduce."""
    if worst is None:
        return "no component of the noise budget of the darks differs from the model's beyond chance"
    does = "lacks" if worst.off_dn < 0 else "adds"
    where = seconds(worst.exposure_s) + ("" if worst.channel == "mono" else f", {worst.channel}")
    share = worst.unexplained_of_total
    if share < NEGLIGIBLE:
        return (
            f"no component of the noise budget of the darks is off by more than {100 * NEGLIGIBLE:g} % of the variance"
        )
    much = f"{100 * share:.2g} %" if share < 1 else f"{number(share)} times"
    return (
        f"the noise budget of the darks differs most in {worst.in_words} ({where}): the model {does}"
        f" {number(worst.unexplained_dn)} DN rms in quadrature, {much} of the measured variance"
    )


def right_in_variance(worst: Share | None) -> str:
    """What a model that does not fit has right: the variance of each component; empty if it has not."""
    if worst is None:
        return (
            "In the darks the variance of each component of the noise is right within chance; their structure differs."
        )
    share = worst.unexplained_of_total
    if share > rules.CLOSED_SHARE:
        return ""
    return f"In the darks the variance of each component of the noise is right within {100 * share:.1g} % of the whole."


def measure(error: float, misfit: float, own: float) -> str:
    """What the error is: a misfit divided by the model's own."""
    return (
        f"error {error:.2f} (1.0: like the model's own samples): the worst misfit below, {misfit:.2f}, divided by that"
        f" of the model's own samples, {own:.2f}"
    )


def columns_compared(first: int, last: int, columns: int) -> str:
    """Which columns of large frames were compared."""
    return f"only columns {first} to {last} of {columns} were compared: the frames are large"


def off(name: str, measured: float, model: float, z: float) -> str:
    """A statistic that the model gets wrong."""
    return f"{name}: measured {measured:.3g}, the model gives {model:.3g} ({_deviations(z)})"


def brought_nearer(name: str, measured: float, old: tuple[float, float], new: tuple[float, float]) -> str:
    """A statistic that a new model gives better; old, new: its value under either model, and how far that is off."""
    (model, z), (now, left) = old, new
    before = f"measured {measured:.3g}, the model gave {model:.3g} ({_deviations(z)})"
    return f"{name}: {before}, with the effect {now:.3g} (off by {abs(left):.1f})"


def _deviations(z: float) -> str:
    return f"{abs(z):.0f} standard deviations {'above' if z > 0 else 'below'}"


# Diagnoses


def headline(verdict: Verdict, names: Sequence[str]) -> str:
    """A verdict in a few words: "missing: row_noise and hot_pixels"."""
    if not names:
        return str(verdict)
    return f"missing: {(' or ' if verdict == Verdict.AMBIGUOUS else ' and ').join(names)}"


def judgement(verdict: Verdict, names: Sequence[str]) -> str:
    """A verdict as a sentence."""
    if verdict == Verdict.NOTHING_MISSING:
        return "Nothing significant is missing."
    if verdict == Verdict.UNEXPLAINED:
        return "Something is left that no effect of the library explains."
    return f"{_capital(headline(verdict, names))}."


def first_estimate(effect: AbstractEffect) -> str:
    """What an effect is, and the first estimate of its parameters."""
    values = []
    for field, spec in effect.specs().items():
        value = " ".join(f"{x:.3g}" for x in np.asarray(getattr(effect, field)).ravel())
        values.append(f"{field} {value} {unit_in_words(spec.unit)}".rstrip())
    values += [f"{name} {value}" for name, value in effect.settings().items() if value is not None]
    return f"{effect.name}: {effect.about()} First estimate (a fit adds its error): {', '.join(values)}."


def open_side(effect: AbstractEffect) -> str:
    """A note that the side of the gain is a guess; empty for an effect with only one side."""
    if not has_sides(effect):
        return ""
    return (
        f"whether {effect.name} arises before or after the gain is a first guess, which only colours of different gains"
        " can correct: improve fits both and keeps the likelier side"
    )


def come_nearest(names: Iterable[str]) -> str:
    """The effects that come nearest where none explains everything."""
    nearest = ", ".join(names)
    return f"these effects would explain the most statistics, but none explains all (improve tries them): {nearest}"


def next_call(of_users: bool) -> str:
    """How to go on from a diagnosis; of_users: whether the effect is one of the user's own."""
    loop = "hsnoise.improve(stack, candidates=[...]), or " if of_users else "hsnoise improve, or in Python "
    return f"next: {loop}hsnoise.fit(stack, model=fit.params.add(found.best.effect))"


def still_off(names: Iterable[str], group: str, misfit: float, statistics: Iterable[str]) -> str:
    """What is off with these effects in the model."""
    return (
        f"still off with {' and '.join(names)} at the first estimate (the worst group, {group}, by {misfit:.1f}"
        f" deviations; a refit may leave less): {'; '.join(statistics)}"
    )


def partly_explained(names: Iterable[str], blamed: str, left: str) -> str:
    """Advice where effects explain a part; blamed, left: the worst groups of statistics without and with them."""
    rest = "the rest" if left == blamed else f"the remaining misfit in the {left} statistics"
    by = f"{' and '.join(names)} would explain part of the {blamed} statistics"
    return f"{by}; no effect in the library explains {rest}"


def not_explained(blamed: str) -> str:
    """Advice where no effect comes near."""
    return f"none of the effects in the library explains the {blamed} statistics, and none comes close"


def more_frames(names: Sequence[str]) -> str:
    """Advice where two effects look alike."""
    return f"more frames would distinguish {names[0]} from {names[1]}"


# Stories


def errors_so_far(errors: Sequence[float]) -> str:
    """How the error has changed so far; empty before the first fit."""
    ends = dict.fromkeys(number(errors[i]) for i in (0, -1)) if errors else ()
    return f"error {' -> '.join(ends)}" if ends else ""


def refusal(of: Refusal) -> str:
    """Why a candidate was left out."""
    if of.improvement is None:
        return REFUSED[of.why]
    cost = f", of which chance gives {of.improvement.cost:.0f}" if of.improvement.cost else ""
    return f"{REFUSED[of.why]} ({gained(of.improvement.nats, of.improvement.error)}{cost})"


def gained(nats: float, error: float) -> str:
    """By how much frames are predicted better."""
    return f"{nats:+.1f} ± {error:.1f} nats"


def by_fitted(nats: float) -> str:
    """Why frames of the fit judged an addition, and what they gained by it."""
    return (
        "What passes from frame to frame hardly shows in so few frames held out; those of the fit are predicted better"
        f" by {nats:.1f} nats."
    )


def ended_in_short(ending: Ending, missing: str) -> str:
    """How a story ended, without a full stop; missing: what the last diagnosis named."""
    unit = f"{UNITS.get(ending.why, '')}{'' if ending.limit == 1 else 's'}"
    return ENDED_IN_SHORT[ending.why].format(headline=missing, limit=f"{ending.limit:g} {unit}")


def ended(ending: Ending, error: float, missing: str, advice: str) -> str:
    """How a story ended, in full: with the error of the last model, what would be next, and what was tried."""
    short, of_error = ended_in_short(ending, missing), f"(error {error:.2f})"
    match ending.why:
        case Ended.UNFINISHED:
            said = f"{short}: the last diagnosis is still running."
        case Ended.MINUTES | Ended.STEPS:
            said = f"{short}."
        case Ended.WEAK_LEFT:
            said = f"{short}: the error is {error:.2f}."
        case Ended.AS_CHANCE:
            said = f"Nothing more could be added, and the error is {error:.2f}, within chance."
        case Ended.UNEXPLAINED:
            said = f"{short} {of_error}: {advice}." if advice else f"{short} {of_error}."
        case _:
            said = f"{short} {of_error}{_following(ending)}."
    tried = "; ".join(f"{name} {refusal(why)}" for name, why in ending.refused.items())
    return f"{said} Tried and rejected: {tried}." if tried else said


def _following(ending: Ending) -> str:
    if ending.following is None:
        return ""
    name, score = ending.following
    return f": {name} would be next, with {score:.0f} nats, within chance among so many candidates"


def added_in_short(names: Iterable[str], first: float, last: float) -> str:
    """What was added, and how the error changed."""
    how = "fell" if last < first else "went"
    return f"Added {', '.join(names)}, and the error {how} from {number(first)} to {number(last)}."


def sizes(rows: Mapping[str, tuple[float, float, str]], effect: AbstractEffect, sides_open: bool) -> tuple[str, ...]:
    """The fitted parameters of an effect, its settings, and whether its side of the gain is still open."""
    said = []
    for label, (value, error, unit) in rows.items():
        size, of = rounded(value, error)
        of = f"± {of}" if error > 0 and np.isfinite(error) else f"({of})"
        how = f"{size} {of} {unit_in_words(unit)}" if np.isfinite(value) else size
        said.append(f"{label} = {how}".rstrip() + ".")
    chosen = effect.settings().items()
    said += [
        f"{effect.name}.{field}: {value}." for field, value in chosen if value is not None and field != "after_gain"
    ]
    if has_sides(effect):
        said.append(f"{effect.name} arises {side_of(effect)}.")
    if sides_open:
        said.append(
            f"{effect.name} fits equally well on the other side of the gain: these frames do not determine the side."
        )
    return tuple(said)


def moved(name: str, old: tuple[float, float], new: tuple[float, float], unit: str) -> str:
    """A parameter that changed; old, new: value and standard error."""
    return f"{name} moved from {rounded(*old)[0]} to {rounded(*new)[0]} {unit_in_words(unit)}".rstrip() + "."


def fell_together(before: float, after: float) -> str:
    """The total misfit, for steps where it fell but the error did not; before, after: of all groups together."""
    return f", total misfit of all groups {number(before)} -> {number(after)}"


def all_of(names: Sequence[str]) -> str:
    """Names as a sentence lists them: "a, b and c"."""
    return " and ".join(part for part in (", ".join(names[:-1]), *names[-1:]) if part)


def because(nearer: Sequence[str], score: float, is_nearest: bool, beside: Sequence[str]) -> str:
    """Why an effect was added: the statistics that it improved, or else its score, nats.

    is_nearest: whether no effect explains everything that was off; beside: effects that were fitted at once with it.
    """
    if beside:
        reason = nearer[0] if nearer else "frames are predicted worse without it"
        return f"{reason} (fitted together with {all_of(beside)})"
    reason = nearer[0] if nearer else f"its fingerprint is in the statistics (score {score:.0f} nats)"
    return f"{reason} (no effect explains everything; this one comes nearest)" if is_nearest else reason


def added(step: int, name: str, reason: str, before: float, after: float, fell: str) -> str:
    """Why a step was taken, and how the error changed; fell: what else fell."""
    return f"Step {step}: added {name}, because {reason}; error {number(before)} -> {number(after)}{fell}."


def closed(error: float, named: float, worst: Share | None) -> str:
    """How near a model closed with measured components comes; named: the error without them, in the same frames."""
    head = f"Closed with measured components: error {error:.3g} ({named:.3g} with the names alone)"
    if worst is None:
        return f"{head}, no component of the noise differs beyond chance."
    left = f"{100 * worst.unexplained_of_total:.2g} % of the variance at {seconds(worst.exposure_s)}"
    return f"{head}; the most that it leaves unexplained is {left}, in {worst.component}."


def left_open(named: float, closed: float) -> str:
    """Why a model was not closed: its misfits of all groups without and with measured components."""
    return (
        f"Not closed with measured components: with them the total misfit of frames held out is {number(closed)},"
        f" without {number(named)}."
    )


def cannot_be_closed(error: Exception) -> str:
    """Why a model could not be closed."""
    return f"Not closed with measured components: {error}."


def replaced(by_maps: Sequence[str], overshot: Sequence[str]) -> str:
    """Which named effects measured components stand for; empty if none."""
    said = []
    if by_maps:
        said.append(f"Measured on this sensor instead of drawn for any sensor of its make: {', '.join(by_maps)}.")
    if overshot:
        said.append(f"Measured whole, because the named effect does not match: {', '.join(overshot)}.")
    return " ".join(said)


def with_care(outcome: str) -> str:
    """A warning about a fit that did not converge."""
    return f"Treat its numbers with caution: the last fit has {outcome}."


def frames_apart(fitted: Sequence[int], held_out: Sequence[int]) -> str:
    """Which frames were fitted and which held out; fitted, held_out: dark frames of each exposure."""
    return (
        f"The first {_span(fitted)} dark frames of each exposure were fitted and compared. held-out: log-likelihood of"
        f" the statistics of the other {_span(held_out)}, in nats (one more: 2.7 times as probable). To fit all frames:"
        " hsnoise.fit(stack, model=story.fit.params), or hsnoise fit --model model.json (named.json of a closed model)."
    )


def _span(numbers: Sequence[int]) -> str:
    return f"{min(numbers)}" if min(numbers) == max(numbers) else f"{min(numbers)} to {max(numbers)}"


def _capital(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}"
