"""Figures of compare, diagnose and improve."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from hsnoise.plots._style import COLOURS, FIT, new_figure, tidy

MOST_BARS = 12
BAR, ALARM = COLOURS["B"], COLOURS["R"]
NOTABLE = 3.0


def comparison(found) -> Figure:
    """Where a model fails: misfit of each group of statistics, and the statistics that are furthest off.

    Args:
        found: result of `hsnoise.compare`.
    """
    rows = sorted(found.table, key=lambda row: -abs(row[4]))[:MOST_BARS]
    height = 0.32 * max(len(found.groups), len(rows)) + 1.6
    figure = new_figure(11.0, height, f"Model against measurement: error {found.error:.2f}")
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.3])
    groups = sorted(found.groups.items(), key=lambda item: item[1])
    _bars(left, [name for name, _ in groups], np.sqrt([misfit for _, misfit in groups]))
    left.set_xlabel("rms deviation / σ of the model's own draws")
    left.set_title("groups of statistics", fontsize=10)
    _bars(right, [row[0] for row in rows][::-1], np.array([row[4] for row in rows][::-1]))
    right.set_xlabel("(measured - model) / σ")
    right.set_title("statistics that are furthest off", fontsize=10)
    return figure


def ranking(found) -> Figure:
    """Candidates by their log-likelihood ratio against "nothing missing".

    Args:
        found: result of `hsnoise.diagnose`.
    """
    chosen = found.ranking[:MOST_BARS][::-1]
    figure = new_figure(7.5, 0.32 * len(chosen) + 1.6, found.headline[0].upper() + found.headline[1:])
    axes = figure.subplots()
    colours = [ALARM if c.name in found.names else BAR for c in chosen]
    axes.barh([c.name for c in chosen], [c.score for c in chosen], color=colours)
    _wide_scale(axes)
    axes.set_xlabel("log-likelihood ratio against nothing missing / nats")
    tidy(axes)
    return figure


def story(found) -> Figure:
    """The error of each step of the loop, and what was added.

    Args:
        found: result of `hsnoise.improve`.
    """
    figure = new_figure(max(5.0, 1.8 * len(found.steps) + 2.5), 4.2, "Error of the model, step by step")
    axes = figure.subplots()
    names = ["the paper's model", *(f"+ {step.added}" for step in found.steps[1:])]
    x = np.arange(len(names))
    axes.plot(x, found.errors, "o-", color=BAR, markersize=8)
    for at, error in zip(x, found.errors, strict=True):
        axes.annotate(f"{error:.3g}", (at, error), xytext=(6, 8), textcoords="offset points", fontsize=10)
    axes.axhline(1.0, color=FIT, linewidth=0.8, linestyle=":")
    axes.set_yscale("log")
    axes.set_ylim(min(0.5, 0.7 * min(found.errors)), 2.5 * max(found.errors))
    axes.set_xlim(-0.4, len(names) - 0.4)
    axes.set_xticks(x, names)
    axes.set_ylabel("error (dotted: the model's own samples)")
    tidy(axes)
    return figure


def _bars(axes: Axes, names: list[str], values: np.ndarray) -> None:
    axes.barh(names, values, color=[ALARM if abs(v) > NOTABLE else BAR for v in values])
    _wide_scale(axes)
    tidy(axes)


def _wide_scale(axes: Axes) -> None:
    """Linear up to 5, logarithmic beyond, either sign, with plain numbers and not too many of them."""
    low, high = axes.dataLim.x0, axes.dataLim.x1
    axes.set_xscale("symlog", linthresh=5)
    axes.set_xlim(min(1.4 * low, 0), max(1.4 * high, 0))
    far = max(high, -low)
    ticks = [5, 10, 20, 50, 100, 200] if far < 300 else [5.0 * 10**k for k in range(0, 9, 1 if far < 1e4 else 2)]
    axes.set_xticks(
        [x for x in [*(-t for t in ticks[::-1]), 0, *ticks] if 1.4 * min(low, 0) <= x <= 1.4 * max(high, 0)]
    )
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:,.0f}")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.axvline(0, color=FIT, linewidth=0.8)
