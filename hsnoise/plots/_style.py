"""Colours, markers and figures that all plots share."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator

from hsnoise.fit import without_likelihood
from hsnoise.fitting.result import FitResult

# Okabe and Ito's palette, distinct for all kinds of colour vision; markers distinguish channels without colour.
COLOURS = {"R": "#D55E00", "G": "#009E73", "B": "#0072B2", "mono": "#404040"}
MARKERS = {"R": "o", "G": "s", "B": "^", "mono": "o"}
NAMES = {"R": "red", "G": "green", "B": "blue", "mono": "all pixels"}
FIT = "black"
HOT = "#E69F00"  # hot pixels, beside a colour's own
DPI = 110
SHORT_DECADES = 2.5
TICKS_APART = 0.09  # of the axis, at least


def title_of(text: str, fit: FitResult) -> str:
    """A title that names the fitted effects which the likelihood, and so a figure of it, lacks."""
    lacking = without_likelihood(fit.params)
    return f"{text}; model without {', '.join(lacking)}" if lacking else text


class _ShownFigure(Figure):
    """A figure that notebooks show as they show pyplot's, without pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png")
        return buffer.getvalue()


def new_figure(width_in: float, height_in: float, title: str) -> Figure:
    """An empty figure with constrained layout."""
    figure = _ShownFigure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")
    figure.suptitle(title, fontsize=12, wrap=True)
    return figure


def bend_axis(axes: Axes, near: float, low: float, high: float) -> None:
    """Make the horizontal axis linear within about `near` of 0 and logarithmic beyond, smoothly; plain numbers."""
    axes.set_xscale("asinh", linear_width=near)
    decades = 10.0 ** np.arange(np.floor(np.log10(near)) - 1, np.ceil(np.log10(max(-low, high, near))) + 1)
    apart, ticks = TICKS_APART * (np.arcsinh(high / near) - np.arcsinh(low / near)), [0.0]
    for x in (f * sign * d for f in (1, 5, 2) for sign in (1, -1) for d in decades[::-1]):
        if low <= x <= high and np.abs(np.arcsinh(np.array(ticks) / near) - np.arcsinh(x / near)).min() > apart:
            ticks.append(x)
    axes.set_xticks(ticks, [f"{x:,g}" for x in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlim(low, high)


def plain_log(axis: Axis) -> None:
    """Plain numbers on a logarithmic axis, several per decade if it spans few."""
    low, high = axis.get_view_interval()
    short = np.log10(high / low) < SHORT_DECADES
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if short else (1.0,)))
    axis.set_major_formatter(lambda value, _: f"{value:,g}")
    axis.set_minor_formatter(NullFormatter())


def tidy(axes: Axes) -> None:
    """A light grid behind the data, and no frame at the top and right."""
    axes.grid(True, which="major", color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9)
