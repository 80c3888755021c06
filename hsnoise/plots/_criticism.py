"""Figures of compare, diagnose and improve."""

from __future__ import annotations

import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, MultipleLocator, NullLocator

from hsnoise.fitting.result import number
from hsnoise.plots._groups import COLOUR_OF, INK, PLACE, WORDS, Part, parts_of
from hsnoise.plots._style import COLOURS, FIT, new_figure, tidy

MOST_BARS = 12
BAR, ALARM = COLOURS["B"], COLOURS["R"]
ALARM_AT, NOTABLE_Z = 2.0, 4.0  # as in the words of compare and on the page of report
MOST_TICKS = 3  # to either side of 0
MOST_LINES = 30  # powers of ten that each get a grid line
MOST_LETTERS = 34  # of a line of a model's name
LETTER = 0.0105  # width of a letter, as a share of a story's longest bar
LEAST_MISFIT = 0.1  # at the left end of the bars


def comparison(found) -> Figure:
    """Where a model fails: misfit of each group of statistics, and the worst statistics.

    Args:
        found: result of `hsnoise.compare`.
    """
    rows = sorted(found.table, key=lambda row: -abs(row[4]))[:MOST_BARS][::-1]
    height = 0.32 * max(len(found.groups), len(rows)) + 2.0
    figure = new_figure(11.0, height, f"Model against measurement: error {number(found.error)}")
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.1])
    groups = sorted(found.groups.items(), key=lambda item: item[1])
    misfits, own = np.array([misfit for _, misfit in groups]), found.own_misfit
    left.barh(
        [name for name, _ in groups], np.maximum(misfits, 1.1 * LEAST_MISFIT), color=_colours(misfits > ALARM_AT * own)
    )
    left.set_xscale("log")
    left.set_xlim(LEAST_MISFIT, 2 * max(misfits.max(), 10.0))
    left.axvline(1.0, color=FIT, linewidth=0.8)
    left.axvline(own, color=FIT, linewidth=0.8, linestyle="--")
    left.set_xlabel(
        f"misfit (line: 1, expected; dashed: the model's own\nsamples, {own:.2g}; orange: more than twice that)"
    )
    left.set_title("groups of statistics", fontsize=10)
    left.xaxis.set_major_locator(LogLocator(numticks=5))
    left.xaxis.set_major_formatter(_plain)
    tidy(left)
    z = np.array([row[4] for row in rows])
    right.barh([row[0] for row in rows], z, color=_colours(np.abs(z) > NOTABLE_Z))
    _wide_scale(right)
    right.set_xlabel("(measured - model) / σ of draws\n(orange: beyond 4)")
    right.set_title("worst statistics", fontsize=10)
    tidy(right)
    return figure


def _colours(alarming: np.ndarray) -> list[str]:
    return [ALARM if one else BAR for one in alarming]


def ranking(found) -> Figure:
    """Candidates by their log-likelihood ratio against "nothing missing".

    Args:
        found: result of `hsnoise.diagnose`.
    """
    chosen = found.ranking[:MOST_BARS][::-1]
    figure = new_figure(7.5, 0.32 * len(chosen) + 1.6, found.headline[0].upper() + found.headline[1:])
    axes = figure.subplots()
    colours = [ALARM if c.name in found.names else BAR for c in chosen]
    names = [f"{c.name}, z left {c.misfit:.1f}" for c in chosen]
    axes.barh(names, [c.score for c in chosen], color=colours)
    _wide_scale(axes)
    axes.set_xlabel(
        "log-likelihood ratio against nothing missing / nats\n"
        "(z left: worst statistics with the effect added; below 3.5 all fit)"
    )
    tidy(axes)
    return figure


def story(found) -> Figure:
    """Misfit of each group of statistics after each step of the loop, stacked, and the error.

    Args:
        found: result of `hsnoise.improve`.
    """
    names = [textwrap.fill(found.start, MOST_LETTERS), *(f"+ {step.added}" for step in found.steps[1:])]
    seen = [step.comparison for step in found.steps]
    if found.closed is not None:
        names.append("closed with\nmeasured components")
        seen.append(found.closed.comparison)
    steps = [parts_of(comparison) for comparison in seen]
    more_lines = sum(name.count("\n") for name in names)
    figure = new_figure(10.0, 0.42 * len(names) + 0.16 * more_lines + 1.9, "Misfit of the model, step by step")
    axes = figure.subplots()
    longest = max(1.0, *(sum(part.decades for part in parts) for parts in steps))
    for y, (parts, comparison) in enumerate(zip(steps, seen, strict=True)):
        _stack(axes, y, parts, longest)
        end = sum(part.decades for part in parts)
        fits = "" if parts else ": no group exceeds the model's own samples"
        axes.annotate(
            f"error {number(comparison.error)}{fits}", (end, y), (6, 0), textcoords="offset points", va="center"
        )
    axes.set_xlim(0, 1.16 * longest)  # room for the error
    axes.set_ylim(len(names) - 0.45, -0.55)
    axes.set_yticks(range(len(names)), names)
    axes.xaxis.set_major_locator(MultipleLocator(1 if longest < MOST_LINES else 5))
    axes.set_xlabel(
        "length of a part: powers of ten by which the misfit of its group of statistics\n"
        "exceeds that of the model's own samples; the error is that of the worst group"
    )
    tidy(axes)
    axes.grid(False, axis="y")
    there = {part.family for parts in steps for part in parts}
    handles = [Patch(color=COLOUR_OF[name], label=WORDS[name]) for name in PLACE if name in there]
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=9)
    return figure


def _stack(axes: Axes, y: int, parts: list[Part], longest: float) -> None:
    """One bar of parts side by side, named where there is room."""
    left = 0.0
    for part in parts:
        colour, ink = COLOUR_OF[part.family], INK[part.family]
        axes.barh(y, part.decades, 0.72, left=left, color=colour, edgecolor="white", linewidth=0.6)
        if part.decades > LETTER * len(part.group) * longest:
            axes.annotate(part.group, (left + part.decades / 2, y), ha="center", va="center", fontsize=8, color=ink)
        left += part.decades


def _wide_scale(axes: Axes) -> None:
    """Linear up to 5, logarithmic beyond, for both signs, with few and plain numbers."""
    low, high = 1.4 * min(axes.dataLim.x0, 0), 1.4 * max(axes.dataLim.x1, 0)
    far = max(high, -low)
    axes.set_xlim(low, high)
    if far > 10:
        axes.set_xscale("symlog", linthresh=5)
        decades = 10.0 ** np.arange(1, np.floor(np.log10(far)) + 1)
        ticks = [5, 20, 50] if far < 100 else decades[:: int(np.ceil(len(decades) / MOST_TICKS))]
        axes.set_xticks([x for x in [*(-t for t in ticks[::-1]), 0, *ticks] if low <= x <= high])
        axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(_plain)
    axes.axvline(0, color=FIT, linewidth=0.8)


def _plain(x: float, _=None) -> str:
    return f"{x:.0e}".replace("e+0", "e") if abs(x) >= 1e6 else f"{x:,g}"
