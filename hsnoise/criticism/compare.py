"""`compare`: where a model fails to describe a capture, and by how much."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from hsnoise._core import html as _html
from hsnoise._core.arguments import callback, seed_of, whole_number
from hsnoise._core.conclusion import Conclusion, Light
from hsnoise._core.data_frames import data_frame
from hsnoise._core.forking import check_not_forked
from hsnoise._core.threads import in_threads
from hsnoise.criticism import rules, sentences, shares
from hsnoise.criticism.shares import Share
from hsnoise.fitting.result import FitResult
from hsnoise.frames.source import as_stack
from hsnoise.likelihood.joint import log_likelihood
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import check_effects, check_fits
from hsnoise.simulation.portion import Portion
from hsnoise.simulation.reference import misfits
from hsnoise.simulation.simulator import Purpose, Simulator, key_for
from hsnoise.statistics.structure import OF_FLATS, explained

DRAWS = 40
WORST = 5  # statistics described in words


@dataclass(frozen=True)
class Comparison:
    """What `compare` found.

    Attributes:
        error: misfit of the worst group over the median that the worst group takes on the model's own draws;
            1.0: as close to the measurement as the model's own samples are.
        groups: misfit (chi-square per degree of freedom) of each group of statistics.
        table: a row for each statistic: name, group, measured, model (mean of its draws), z.
        worst: the statistics that fail most, in words.
        p_value: how often the worst group of the model's own draws is as far off (at least 1 / (draws + 1)).
        log_likelihood_per_pixel: of the capture under the model, nats; NaN for a model with effects that state no
            likelihood. It is held out if the model was fitted to other frames.
        skipped: statistics that this capture does not allow, and why.
        max_z_p_value: how often the largest |z| of the model's own draws is as large as `max_z`.
        whole_budget: whether `shares` are of all dark exposures: there are two frames of each.
        shares: of each component of the noise budget of the darks, what the model does not reproduce, in per cent of
            its variance and in DN; empty without two darks of an exposure.
    """

    error: float
    groups: dict[str, float]
    table: tuple[tuple[str, str, float, float, float], ...]
    worst: tuple[str, ...]
    p_value: float
    log_likelihood_per_pixel: float
    skipped: tuple[str, ...]
    max_z_p_value: float = float("nan")
    shares: tuple[Share, ...] = ()
    whole_budget: bool = False

    @property
    def fits(self) -> bool:
        """Whether the capture could have been drawn from the model: its error is one that right models have."""
        return rules.fits(self.error, self.max_z)

    @property
    def max_z(self) -> float:
        """The largest |z| of all statistics: one that fails is lost in the mean of a large group."""
        return max((abs(row[4]) for row in self.table), default=0.0)

    @property
    def worst_group(self) -> str:
        """The group of statistics with the largest misfit."""
        return max(self.groups, key=self.groups.__getitem__)

    @property
    def total(self) -> float:
        """The misfits of all groups together: the error is that of the worst alone."""
        return sum(self.groups.values())

    @property
    def largest_unexplained(self) -> Share | None:
        """The component of which the largest part of the whole variance is not reproduced beyond chance, if any."""
        return shares.largest_unexplained(self.shares)

    @property
    def conclusion(self) -> Conclusion:
        """Whether the model describes the capture, and in which group of statistics it fails most."""
        if self.fits:
            return Conclusion(Light.GREEN, sentences.describes(self.error))
        is_close = self.error < rules.CLOSE
        light = Light.AMBER if is_close else Light.RED
        if self.error < rules.FITS:
            return Conclusion(light, sentences.fails_in_one(self.error, self.max_z, self.worst[0]))
        # Flats and levels are not in the budget, nor single frames.
        is_told = self.whole_budget and self.worst_group not in ("level", *OF_FLATS.values())
        right = sentences.right_in_variance(self.largest_unexplained) if is_told else ""
        return Conclusion(light, sentences.fails(self.error, self.worst_group, is_close), right)

    @property
    def own_misfit(self) -> float:
        """The misfit that the worst group takes on the model's own draws, their median: what `error` is measured by."""
        return max(self.groups.values()) / self.error if self.error > 0 else 1.0

    @property
    def measure(self) -> str:
        """What the error is, in words."""
        return sentences.measure(self.error, max(self.groups.values()), self.own_misfit)

    @property
    def unexplained(self) -> str:
        """The largest part of the noise that the model does not reproduce, in a sentence; empty if it is not known."""
        return "" if not self.shares else sentences.unexplained(self.largest_unexplained)

    def plot(self):
        """A figure of where the model fails: `hsnoise.plots.comparison`."""
        from hsnoise import plots  # matplotlib is slow to import

        return plots.comparison(self)

    def to_pandas(self) -> Any:
        """`table` as a pandas DataFrame: statistic, group, measured, model, z (needs `hsnoise[pandas]`).

        Raises ImportError without pandas.
        """
        return data_frame(self, ("statistic", "group", "measured", "model", "z"), self.table)

    def as_table(self) -> Table:
        """Misfit of each group, the worst first, as it is printed."""
        table = Table("group of statistics", "misfit")
        for name, misfit in sorted(self.groups.items(), key=lambda item: -item[1]):
            table.add_row(name, f"{misfit:.2f}")
        return table

    def __str__(self) -> str:
        console = Console(file=io.StringIO(), width=100, color_system=None)
        console.print(str(self.conclusion), markup=False, highlight=False)
        console.print(self.measure, highlight=False)
        console.print(self.as_table())
        for sentence in (*self.worst, *explained(self.worst), self.unexplained, *self.skipped):
            if sentence:
                console.print(f"- {sentence}", highlight=False)
        return console.file.getvalue().rstrip()

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return _html.fragment(
            _html.conclusion(self.conclusion),
            _html.paragraph(self.measure),
            _html.printed(self.as_table()),
            _html.sentences((*self.worst, self.unexplained) if self.unexplained else self.worst),
            "" if not self.shares else _html.details("Noise budget", _html.printed(shares.as_table(self.shares))),
            _html.details("About the statistics", _html.sentences((*explained(self.worst), *self.skipped))),
        )


def compare(
    params: NoiseModel | FitResult, stack, *, draws: int = DRAWS, seed: int = 0, progress=None, **keywords
) -> Comparison:
    """Compare a model with measured frames, darks and flats, statistic by statistic, against the model's own draws.

    Args:
        params: any NoiseModel, fitted or from a file; or a fit, whose `params` it stands for.
        stack: a path or a list of paths, with the keywords of `hsnoise.load`; a FrameStack; or an array of counts with
            FrameStack's keywords.
        draws: captures that are drawn from the model as yardstick.
        seed: of the draws; progress: called with no argument after each.

    Raises:
        FileNotFoundError, TypeError, ValueError: what `load` or `FrameStack` refuse; model and stack do not fit
            together, no darks, fewer than 8 draws.
    """
    draws, seed = whole_number("draws", draws, 8), seed_of("seed", seed)
    tick = callback("progress", progress)
    check_not_forked()
    stack = as_stack(stack, **keywords)
    params = params.params if isinstance(params, FitResult) else params
    check_fits(params, stack)
    portion = Portion.of(stack)
    check_effects(params, portion.frames)
    found = compared(params, portion, draws=draws, seed=seed, tick=tick)
    return with_shares(found, params, portion, seed)


def with_shares(found: Comparison, params: NoiseModel, portion: Portion, seed: int) -> Comparison:
    """A comparison with the shares of the noise budget that the model does not reproduce."""
    darks = portion.darks.frames
    repeated = darks.repeated_darks
    if not repeated:
        return found
    key, whole = key_for(seed, Purpose.SHARES), len(repeated) == darks.n_exposures
    of_budget = () if whole else ("the noise budget leaves out exposures of a single frame",)
    known = shares.shares_of(params, darks.select(exposures=repeated), key)
    return replace(found, shares=known, whole_budget=whole, skipped=(*found.skipped, *of_budget))


def compared(
    params: NoiseModel, portion: Portion, *, draws: int = DRAWS, seed: int, tick: Callable[[], None] = lambda: None
) -> Comparison:
    """What `compare` finds on a portion that is checked."""
    simulator = Simulator(params, portion, key_for(seed, Purpose.COMPARE), tick)
    own, per_pixel = in_threads(  # the likelihood is compiled while captures are drawn
        lambda work: work(), [lambda: simulator.reference(params, draws), lambda: _per_pixel(params, portion.darks)]
    )
    measured = simulator.measured
    z = own.z(measured.values)
    groups = misfits(z, own.groups)
    worst = max(groups.values())
    own_z = own.own_z()
    worst_of_draws = np.array([max(misfits(one, own.groups).values()) for one in own_z])
    table = zip(own.names, own.groups, measured.values, own.mean, z, strict=True)
    return Comparison(
        error=worst / float(np.median(worst_of_draws)),
        groups=groups,
        table=tuple((name, group, float(a), float(b), float(c)) for name, group, a, b, c in table),
        worst=_in_words(own.names, measured.values, own.mean, z),
        p_value=_rank(worst_of_draws, worst),
        log_likelihood_per_pixel=per_pixel,
        skipped=(*measured.skipped, *portion.left_out),
        max_z_p_value=_rank(np.abs(own_z).max(1), np.abs(z).max()),
    )


def _rank(of_draws: np.ndarray, measured: float) -> float:
    """Probability of a value as large, by its rank among draws [draw] and itself."""
    return float((1 + (of_draws >= measured).sum()) / (len(of_draws) + 1))


def _in_words(names: tuple[str, ...], measured: np.ndarray, model: np.ndarray, z: np.ndarray) -> tuple[str, ...]:
    order = np.argsort(-np.abs(z))[:WORST]
    return tuple(
        sentences.off(names[i], float(measured[i]), float(model[i]), float(z[i]))
        for i in order
        if abs(z[i]) > rules.NOTABLE_Z
    )


def nearer(before: Comparison, after: Comparison) -> tuple[str, ...]:
    """The statistics that another model describes better, in words, those first that came nearest in deviations.

    What is off by fewer deviations only because draws scatter more is not among them.
    """
    now, gains = {name: (model, z) for name, _, _, model, z in after.table}, []
    for row in before.table:
        name, _, measured, model, z = row
        if name in now and z:
            came = (abs(measured - model) - abs(measured - now[name][0])) / abs(measured - model) * abs(z)
            gains.append((min(came, abs(z) - abs(now[name][1])), row))
    gains.sort(key=lambda gain: -gain[0])
    return tuple(
        sentences.brought_nearer(name, measured, (model, z), now[name])
        for gain, (name, _, measured, model, z) in gains[:WORST]
        if gain > rules.NOTABLE_GAIN
    )


def _per_pixel(params: NoiseModel, darks: Portion) -> float:
    frames = darks.frames
    try:
        value = float(log_likelihood(params, frames))
    except ValueError:  # an effect that states no likelihood
        return float("nan")
    return value / (sum(frames.n_frames) * frames.shape[0] * frames.shape[1])
