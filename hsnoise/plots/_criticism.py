"""Figures of compare, diagnose and improve."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator

from hsnoise.plots._style import COLOURS, FIT, new_figure, tidy
from hsnoise.result import number

MOST_BARS = 12
BAR, ALARM = COLOURS["B"], COLOURS["R"]
ALARM_AT, NOTABLE_Z = 2.0, 4.0  # as in the words of compare and on the page of report
MOST_TICKS = 3  # to either side of 0
MOST_DECADES = 4  # named below the errors of a story
SHORT_RANGE = 30.0  # of errors, that needs more than decades
LEAST_MISFIT = 0.1  # at the left end of the bars


def comparison(found) -> Figure:
    """Where a model fails: misfit of each group of statistics, and the statistics that are furthest off.

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
    right.set_title("statistics that are furthest off", fontsize=10)
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
    """The error of each step of the loop, and what was added.

    Args:
        found: result of `hsnoise.improve`.
    """
    names = [found.start, *(f"+ {step.added}" for step in found.steps[1:])]
    figure = new_figure(5.2, 0.5 * len(names) + 1.7, "Error of the model, step by step")
    axes = figure.subplots()
    y = np.arange(len(names))
    axes.plot(found.errors, y, "o-", color=BAR, markersize=8)
    for at, error in zip(y, found.errors, strict=True):
        axes.annotate(number(error), (error, at), xytext=(9, -9), textcoords="offset points", fontsize=10)
    axes.axvline(1.0, color=FIT, linewidth=0.8, linestyle=":")
    axes.set_xscale("log")
    low, high = min(0.5, 0.7 * min(found.errors)), max(2.0, *found.errors)
    axes.set_xlim(low, high * (high / low) ** 0.22)  # room for the last number
    within = (1.0, 2.0, 5.0) if high < SHORT_RANGE * low else (1.0,)
    axes.xaxis.set_major_locator(LogLocator(subs=within, numticks=MOST_DECADES))
    axes.xaxis.set_major_formatter(_plain)
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(len(names) - 0.5, -0.6)
    axes.set_yticks(y, names)
    axes.set_xlabel("error (dotted: 1, the model's own samples)")
    tidy(axes)
    return figure


def _wide_scale(axes: Axes) -> None:
    """Linear up to 5, logarithmic beyond, either sign, with plain numbers and not too many of them."""
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
