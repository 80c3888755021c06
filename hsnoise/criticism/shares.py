"""How much of the noise the named effects explain, how much only measured components do, and how much neither does."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.stats import chi2, norm

from hsnoise._core.keys import named_key
from hsnoise._core.threads import in_threads
from hsnoise._core.types import RandomKey, cfa_tile, seconds
from hsnoise.criticism import rules
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import draw_capture
from hsnoise.statistics.decomposition import COMPONENTS, STATIC, Component, decomposed, mean_of

DRAWS, MORE = 4, 16  # of each model; where they scatter more than lines and pixels by themselves
EXCESS = 0.01  # probability in a capture that they seem to
CLEAR = 2.0  # standard errors, below which a difference is chance
IN_WORDS = {
    "frame": "offsets of frames",
    "row": "fixed rows",
    "column": "fixed columns",
    "row_x_frame": "rows that change from frame to frame",
    "column_x_frame": "columns that change from frame to frame",
    "pixel": "fixed pixels",
    "temporal": "temporal noise of pixels",
}
MOST_OF_IT = 0.95  # of the static variance, that the effects named in a sentence hold
TWICE = 2.0  # times the static variance: what is drawn beyond it is told in DN^2


class Share(NamedTuple):
    """One component of the noise budget at one exposure, in one colour.

    Attributes:
        measured_dn2: its variance in the frames, DN^2; error_dn2: standard error of its difference from the model's.
        closed_dn2, named_dn2: variance that the whole model and its named effects alone draw, DN^2; the same unless it
            is closed with measured components.
        total_dn2: variance of all components in the frames, DN^2.
    """

    exposure_s: float
    channel: str
    component: str
    measured_dn2: float
    error_dn2: float
    closed_dn2: float
    named_dn2: float
    total_dn2: float

    @property
    def of_total(self) -> float:
        """Its share of the variance of all components."""
        return max(self.measured_dn2, 0.0) / self.total_dn2

    @property
    def named(self) -> float:
        """Share that named effects explain."""
        return self._part(self.named_dn2)

    @property
    def only_measured(self) -> float:
        """Share that measured components explain beyond them."""
        return max(self._part(self.closed_dn2) - self.named, 0.0)

    @property
    def unexplained(self) -> float:
        """Distance of the model as a share of what was measured; 0 where it may be chance."""
        return self.unexplained_dn**2 / self.measured_dn2 if self.measured_dn2 > 0 else 0.0

    @property
    def in_words(self) -> str:
        """What the component is, in words."""
        return IN_WORDS[self.component]

    @property
    def off_dn(self) -> float:
        """`unexplained_dn` with a sign: below 0 where the model lacks it, above 0 where it draws too much."""
        return -self.unexplained_dn if self.closed_dn2 < self.measured_dn2 else self.unexplained_dn

    @property
    def off(self) -> str:
        """`off_dn` as printed; empty within chance."""
        return f"{self.off_dn:+.2g}" if self.unexplained_dn > 0 else ""

    @property
    def unexplained_of_total(self) -> float:
        """The same distance as a share of the variance of all components."""
        return self.unexplained_dn**2 / self.total_dn2

    @property
    def unexplained_dn(self) -> float:
        """The same distance as the rms, DN, that is missing or too much; 0 where it may be chance."""
        off = abs(self.measured_dn2 - self.closed_dn2)
        return float(np.sqrt(off)) if off > CLEAR * self.error_dn2 else 0.0

    def _part(self, drawn_dn2: float) -> float:
        return float(np.clip(drawn_dn2 / self.measured_dn2, 0, 1)) if self.measured_dn2 > 0 else 0.0


def shares_of(
    named: NoiseModel,
    frames: FrameStack,
    key: RandomKey,
    closed: NoiseModel | None = None,
    before: Sequence[int] = (),
) -> tuple[Share, ...]:
    """The shares of each component of the noise of dark `frames`, two or more of each exposure, by draws of the model.

    before: for each exposure, how many frames of the series come before these; default: none. Raises ValueError for an
    exposure of one frame.
    """
    whole, own = (named, named_key(key, "named")) if closed is None else (closed, named_key(key, "closed"))
    drawn = {"closed": _drawn(whole, frames, own, before)}
    drawn["named"] = drawn["closed"] if closed is None else _drawn(named, frames, named_key(key, "named"), before)
    measured, same_pixels = _components(frames), closed is not None
    found = _found(measured, frames, drawn, same_pixels=same_pixels)
    if largest_unexplained(found) is None or not _scatter_beyond(drawn["closed"], same_pixels=same_pixels):
        return found
    drawn["closed"] = drawn["closed"] + _drawn(whole, frames, own, before, range(DRAWS, MORE))
    return _found(measured, frames, drawn, same_pixels=same_pixels)


def _found(
    measured: Mapping[Place, Components],
    frames: FrameStack,
    drawn: Mapping[str, list[dict[Place, Components]]],
    *,
    same_pixels: bool,
) -> tuple[Share, ...]:
    found: list[Share] = []
    for (i, channel), of_frames in measured.items():
        parts = {name: [one[i, channel] for one in of] for name, of in drawn.items()}
        at = float(frames.exposure_s[i]), channel
        found += _shares(*at, of_frames, parts["named"], parts["closed"], same_pixels=same_pixels)
    return tuple(found)


def _scatter_beyond(drawn: list[dict[Place, Components]], *, same_pixels: bool) -> bool:
    """Whether a component scatters more from draw to draw than its lines or pixels do by themselves.

    A band whose phase is new in each frame scatters as a whole. Four draws show that it does, but not by how much.
    """
    ratios = [
        np.var([of[place][name].variance_dn2 for of in drawn], ddof=1) / error**2
        for place in drawn[0]
        for name in COMPONENTS
        if (error := _error(name, drawn[0][place][name], same_pixels)) > 0
    ]
    dof = len(drawn) - 1
    return max(ratios, default=0.0) > chi2.isf(EXCESS / max(len(ratios), 1), dof) / dof


Components = Mapping[str, Component]
Place = tuple[int, str]  # number of the exposure, colour


def _shares(
    exposure_s: float,
    channel: str,
    measured: Components,
    named: list[Components],
    closed: list[Components],
    *,
    same_pixels: bool,
) -> Iterator[Share]:
    total = sum(max(one.variance_dn2, 0.0) for one in measured.values())
    for name, one in measured.items():
        own = _error(name, one, same_pixels)
        of_draws = float(np.mean([_error(name, drawn[name], same_pixels) for drawn in closed]))
        # The error of what came out low by chance is too small, that of the model too large if it draws too much.
        error = np.hypot(max(own, np.sqrt(own * of_draws)), of_draws / np.sqrt(len(closed)))
        error = max(error, _error_by_draws(one.variance_dn2, np.array([drawn[name].variance_dn2 for drawn in closed])))
        whole, by_names = (_mean(name, of) for of in (closed, named))
        yield Share(exposure_s, channel, name, one.variance_dn2, float(error), whole, by_names, max(total, 1e-300))


def _components(frames: FrameStack) -> dict[Place, Components]:
    tile = cfa_tile(frames.cfa)
    step = len(tile)
    found: dict[Place, Components] = {}
    for i, exposure_s in enumerate(frames.exposure_s):
        counts = np.stack(list(frames.frames(i)))
        if len(counts) < 2:
            raise ValueError(f"stack: expected two frames or more of each exposure, got one of {seconds(exposure_s)}")
        for c, channel in enumerate(frames.channels):
            planes = [counts[:, row::step, column::step] for row, column in np.argwhere(tile == c)]
            of_planes = [decomposed(plane) for plane in planes]
            found[i, channel] = {name: mean_of([one[name] for one in of_planes]) for name in COMPONENTS}
    return found


def largest_unexplained(shares: Sequence[Share]) -> Share | None:
    """The component of which the largest part of the whole variance is unexplained, beyond chance; None without any.

    Of so many components, one is off by chance in rules.FALSE_ALARM_RATE of captures.
    """
    limit = norm.isf(rules.FALSE_ALARM_RATE / (2 * max(len(shares), 1)))
    off = [one for one in shares if one.unexplained_dn**2 > limit * one.error_dn2]
    return max(off, key=lambda share: share.unexplained_of_total, default=None)


def static_by_effect(named: NoiseModel, frames: FrameStack, key: RandomKey, effects: Iterable[str]) -> dict[str, float]:
    """Static variance, DN^2, that each effect of a model adds to `frames` of one exposure; means over the colours."""
    whole = _static(_drawn(named, frames, key))
    return {name: whole - _static(_drawn(named.remove(name), frames, key)) for name in effects if name in named}


def static_dn2(frames: FrameStack) -> float:
    """Static variance of frames of one exposure, DN^2, mean over the colours."""
    return _static([_components(frames)])


def _drawn(
    model: NoiseModel,
    like: FrameStack,
    key: RandomKey,
    before: Sequence[int] = (),
    numbers: Sequence[int] = range(DRAWS),
) -> list[dict[Place, Components]]:
    return in_threads(
        lambda number: _components(draw_capture(jax.random.fold_in(key, number), model, like, before)), numbers
    )


def _static(found: list[dict[Place, Components]]) -> float:
    return float(np.mean([sum(of[name].variance_dn2 for name in STATIC) for one in found for of in one.values()]))


def _mean(name: str, of: list[Components]) -> float:
    return float(np.mean([one[name].variance_dn2 for one in of]))


def _error_by_draws(measured: float, drawn: np.ndarray) -> float:
    """Standard error of the difference between a measured variance and those of draws, by how these scatter.

    Variances of few independent parts are chi-square, whose lower tail is thin and whose upper one is long: the error
    is that with which their cube roots are as far apart (Wilson and Hilferty, PNAS 17, 1931), wider where the farthest
    draw lies farther out than of a chi-square, as with a band that has one phase in two frames, or two opposite ones.
    """
    n, mean = len(drawn), float(drawn.mean())
    scatter = float(drawn.std(ddof=1) * np.sqrt(1 + 1 / n))
    if scatter >= mean or scatter == 0:  # next to nothing is drawn, or in less than two parts
        return scatter
    width = (scatter / mean / 3) ** 2
    z = (np.cbrt(np.maximum([measured, *drawn], 0.0) / mean) - 1 + width) / np.sqrt(width)
    farthest = norm.isf((1 - 0.5 ** (1 / n)) / 2)  # of n normal numbers, the median
    wider = max(1.0, float(np.abs(z[1:]).max() / farthest))
    return abs(measured - mean) / abs(z[0]) * wider if z[0] else scatter


def _error(name: str, of: Component, same_pixels: bool) -> float:
    """Standard error of a variance; of static ones only that by chance where the model has this sensor's maps."""
    return of.chance_dn2 if same_pixels and name in STATIC else of.standard_error_dn2


def in_words(by_effect: dict[str, float], static_dn2: float) -> str:
    """Which effects are how much of the static variance, in a sentence; empty if none adds any."""
    order = sorted((name for name in by_effect if by_effect[name] > 0), key=lambda name: -by_effect[name])
    total, said, held = sum(by_effect[name] for name in order), [], 0.0
    for name in order:
        said.append(name)
        held += by_effect[name]
        if held >= MOST_OF_IT * total:
            break
    if not said or static_dn2 <= 0:
        return "No named effect explains static variance."
    names = " and ".join([", ".join(said[:-1]), said[-1]] if len(said) > 1 else said)
    verb = "are" if len(said) > 1 else "is"
    if held > TWICE * static_dn2:
        draws = "draw" if len(said) > 1 else "draws"
        return (
            f"{names} {draws} {held:.2g} DN^2 of static variance; {static_dn2:.2g} DN^2 are measured in these frames."
        )
    if held > static_dn2:
        return f"{names} {verb} all of the static variance, and draw {100 * (held / static_dn2 - 1):.0f} % more."
    return f"{names} {verb} {100 * held / static_dn2:.0f} % of the static variance."


def as_table(shares: Iterable[Share]) -> Table:
    """The shares as a table, in per cent, and the rms that is missing (-) or too much; only what is there or drawn."""
    table = Table("at", "colour", "component", "DN²", "of all", "named", "only measured", "left", "left / DN")
    for one in shares:
        if max(one.measured_dn2, one.closed_dn2) > CLEAR * one.error_dn2:
            percent = [f"{100 * x:.1f} %" for x in (one.of_total, one.named, one.only_measured, one.unexplained)]
            variance = f"{max(one.measured_dn2, 0.0):.4g}"
            table.add_row(seconds(one.exposure_s), one.channel, one.component, variance, *percent, one.off)
    return table


def printed(shares: Iterable[Share]) -> str:
    """The table as text."""
    console = Console(file=io.StringIO(), width=100, color_system=None)
    console.print(as_table(shares))
    return console.file.getvalue().rstrip()
