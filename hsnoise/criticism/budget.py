"""The noise budget: what of a capture's counts is noise, of which kind, and how it grows with exposure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hsnoise._core.arguments import callback
from hsnoise._core.data_frames import data_frame
from hsnoise._core.robust import robust_sigma
from hsnoise.criticism.budget_table import as_html, printed
from hsnoise.frames.source import as_stack
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import check_fits, draw_capture
from hsnoise.simulation.portion import middle_of
from hsnoise.statistics.decomposition import COMPONENTS, Component, mean_of
from hsnoise.statistics.pixels.classes import levels_of, slope_over
from hsnoise.statistics.pixels.flags import FLAGS, counts_of, flags_of
from hsnoise.statistics.pixels.sample import covariance_of
from hsnoise.statistics.pixels.survey import Group, Survey, survey

TOP_SHARE, FEWEST_TOP = 1e-3, 10  # of the pixels, that are the tail


class TableRow(NamedTuple):
    """One component of one exposure and colour; variances in DN^2, `share` of the sum of all components."""

    exposure_s: float
    kind: str
    channel: str
    component: str
    variance_dn2: float
    standard_error_dn2: float
    share: float


@dataclass(frozen=True)
class BudgetRow:
    """One exposure and colour: mean (DN), shares of clipped and saturated counts, and the components by name."""

    exposure_s: float
    kind: str
    channel: str
    n_frames: int
    mean_dn: float
    clipped_share: float
    saturated_share: float
    components: Mapping[str, Component]

    @property
    def total_dn2(self) -> float:
        """Sum of the components, DN^2; NaN with one frame."""
        return float(sum(max(c.variance_dn2, 0.0) for c in self.components.values()))


@dataclass(frozen=True)
class PixelSpread:
    """How one number differs between pixels, the noise of its estimation taken off.

    Attributes:
        median: of all pixels.
        spread: standard deviation of the core.
        tail: by how much the highest 0.1 % of the pixels typically exceed the median: they are chosen in one half of
            the frames and measured in the other.
        unit: of all three.
    """

    median: float
    spread: float
    tail: float
    unit: str


@dataclass(frozen=True)
class NoiseBudget:
    """The three-dimensional noise decomposition of a stack; made by `hsnoise.budget`.

    Attributes:
        rows: one for each exposure and colour, in the order of the stack.
        growth: (colour, component) to slope and standard error over the dark exposures, DN^2/s.
        pixels: (colour, what) to how it differs between pixels: "offset", "dark signal", "temporal noise".
        flags: colour to the share of pixels that are stuck, dead, hot, telegraph-like (NaN: unknown).
        survey: what the pass over the pixels kept.
        stack: the frames, for `under`.
    """

    rows: tuple[BudgetRow, ...]
    growth: Mapping[tuple[str, str], tuple[float, float]]
    pixels: Mapping[tuple[str, str], PixelSpread]
    flags: Mapping[str, Mapping[str, float]]
    survey: Survey
    stack: FrameStack

    @property
    def table(self) -> tuple[TableRow, ...]:
        """All components as rows of numbers."""
        return tuple(
            TableRow(row.exposure_s, row.kind, row.channel, name, c.variance_dn2, c.standard_error_dn2, c.share)
            for row in self.rows
            for name, c in row.components.items()
        )

    def to_pandas(self) -> Any:
        """`table` as a pandas DataFrame, its columns the fields of `TableRow` (needs `hsnoise[pandas]`).

        Raises ImportError without pandas.
        """
        return data_frame(self, TableRow._fields, self.table)

    def under(self, model: NoiseModel) -> NoiseBudget:
        """The budget of a capture drawn from `model` as this one was taken; of large frames the middle is drawn.

        Raises:
            TypeError, ValueError: a model of another sensor, or one that makes no counts.
        """
        check_fits(model, self.stack, "model")
        return budget(draw_capture(0, model, middle_of(self.stack)))

    def plot(self, model: NoiseModel | None = None) -> Any:
        """Figure of `hsnoise.plots.budget`: the components, with `model` its own beside them."""
        from hsnoise import plots  # brings matplotlib, which is slow to import

        return plots.budget(self, model)

    def __str__(self) -> str:
        return printed(self)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return as_html(self)

    def sentences(self) -> list[str]:
        """Pixels that are stuck, dead, hot, or telegraph-like."""
        said = []
        for channel, shares in self.flags.items():
            of = "" if channel == "mono" else f", {channel}"
            listed = [f"{name} {100 * share:.2g} %" for name, share in shares.items() if share > 0]
            if listed:
                said.append(f"Defective pixels{of}: {', '.join(listed)}.")
        return said


def budget(stack: Any, *, progress=None, **keywords) -> NoiseBudget:
    """Split the counts of each exposure and colour into the components of the three-dimensional noise decomposition.

    One pass over the frames, one in memory at a time; statistics of single pixels come from evenly spread rows of
    sensors above 2 Mpixel, or 1 Mpixel where there are more than two exposures.

    Args:
        stack: a path or a list of paths, with the keywords of `hsnoise.load`; a FrameStack; or with FrameStack's
            keywords an array [frame, row, column] or [exposure, frame, row, column], or a list of arrays [frame, row,
            column].
        progress: called with no argument after each frame.

    Returns:
        NoiseBudget: `print` it for the table; variances are unbiased and may be below 0 where there is none. For
        an exposure of one frame all are NaN: static and temporal parts cannot be separated.

    Raises:
        FileNotFoundError, TypeError, ValueError: what `load` or `FrameStack` refuse.

    Reference: D'Agostino and Webb, SPIE 1488, 1991.
    """
    tick = callback("progress", progress)
    stack = as_stack(stack, **keywords)
    stack.check()
    return budget_of(survey(stack, tick), stack)


def budget_of(found: Survey, stack: FrameStack) -> NoiseBudget:
    """The budget of a survey of `stack`."""
    rows = tuple(_row(found, group, c) for group in found.groups for c in range(len(found.channels)))
    flags = {name: _told_flags(found, c) for c, name in enumerate(found.channels)}
    pixels = {}
    for c, name in enumerate(found.channels):
        pixels.update({(name, what): one for what, one in _spreads(found, c).items()})
    return NoiseBudget(rows, _growth(rows), pixels, flags, found, stack)


def _row(found: Survey, group: Group, channel: int) -> BudgetRow:
    planes = group.of(channel)
    components = {name: mean_of([p.components[name] for p in planes]) for name in COMPONENTS}
    return BudgetRow(
        exposure_s=group.exposure_s,
        kind=group.kind,
        channel=found.channels[channel],
        n_frames=group.n_frames,
        mean_dn=float(np.mean([p.frame_means_dn.mean() for p in planes])),
        clipped_share=float(group.clipped_share[channel]),
        saturated_share=float(group.saturated_share[channel]),
        components=components,
    )


def _growth(rows: tuple[BudgetRow, ...]) -> dict[tuple[str, str], tuple[float, float]]:
    """Weighted straight lines of the components over the dark exposures."""
    found = {}
    for channel in dict.fromkeys(row.channel for row in rows):
        dark = [row for row in rows if row.channel == channel and row.kind == "dark" and row.n_frames > 1]
        t = np.array([row.exposure_s for row in dark])
        if len(dark) < 2 or np.ptp(t) == 0:
            continue
        for name in COMPONENTS:
            y = np.array([row.components[name].variance_dn2 for row in dark])
            weight = 1 / np.maximum(np.array([row.components[name].standard_error_dn2 for row in dark]), 1e-12) ** 2
            centred = t - weight @ t / weight.sum()
            information = weight @ centred**2
            found[channel, name] = float(weight * centred @ y / information), float(information**-0.5)
    return found


def _told_flags(found: Survey, channel: int) -> dict[str, float]:
    shares = counts_of(flags_of(found, channel))
    if not any(g.kind == "flat" and g.n_frames > 1 for g in found.groups):
        shares["dead"] = float("nan")
    if levels_of(found, channel) is None:
        shares["hot"] = float("nan")
    return {name: shares[name] for name in FLAGS}


def _spreads(found: Survey, channel: int) -> dict[str, PixelSpread]:
    """How offset, dark signal and temporal noise differ between the sampled pixels."""
    darks = sorted(found.repeated_darks, key=lambda g: g.exposure_s)
    if not darks:
        return {}
    spreads = {"offset": _spread(darks[0].pixels(channel, "level_dn"), "DN")}
    pixels = levels_of(found, channel)
    if pixels is not None:
        spreads["dark signal"] = _spread(slope_over(pixels.exposure_s, pixels.level), "DN/s")
    if min(darks[0].of(channel)[0].halves.n_frames) > 1:
        noise = darks[0].pixels(channel, "variance_dn2")
        one = _spread(noise, "DN²")
        sigma = np.sqrt(float(noise.mean(dtype=np.float64)))
        tail = np.sqrt(max(one.median + one.tail, 0.0)) - np.sqrt(max(one.median, 0.0))
        spreads["temporal noise"] = PixelSpread(sigma, one.spread / (2 * sigma) if sigma > 0 else 0.0, tail, "DN")
    return spreads


def _spread(values: np.ndarray, unit: str) -> PixelSpread:
    """Of values in two halves of the frames [half, pixel]: what both share is free of the noise of estimation."""
    mean = values.mean(0, dtype=np.float64)
    median = float(np.median(mean))
    width = 5 * robust_sigma(mean - median) + 1e-12
    a, b = np.clip(values.astype(np.float64), median - width, median + width)
    covariance = covariance_of(a, b)
    few = min(max(FEWEST_TOP, int(TOP_SHARE * len(mean))), len(mean))
    top = [np.median(values[1 - half][np.argpartition(values[half], -few)[-few:]]) for half in (0, 1)]
    return PixelSpread(median, float(np.sqrt(max(covariance, 0.0))), max(float(np.mean(top)) - median, 0.0), unit)
