"""Colours, markers and figures that all plots share."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hsnoise.fit import without_likelihood
from hsnoise.result import FitResult

# Okabe and Ito's palette: told apart with any colour vision; the markers tell channels apart without colour.
COLOURS = {"R": "#D55E00", "G": "#009E73", "B": "#0072B2", "mono": "#404040"}
MARKERS = {"R": "o", "G": "s", "B": "^", "mono": "o"}
NAMES = {"R": "red", "G": "green", "B": "blue", "mono": "all pixels"}
FIT = "black"
HOT = "#E69F00"  # hot pixels, beside a colour's own
DPI = 110


def title_of(text: str, fit: FitResult) -> str:
    """A title, with the effects of the fit that its likelihood, and so a figure made of it, does not hold."""
    lacking = without_likelihood(fit.params)
    return f"{text}; model without {', '.join(lacking)}" if lacking else text


def new_figure(width_in: float, height_in: float, title: str) -> Figure:
    """An empty figure whose parts make room for each other."""
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")
    figure.suptitle(title, fontsize=12, wrap=True)
    return figure


def tidy(axes: Axes) -> None:
    """A light grid behind the data, no frame above and on the right."""
    axes.grid(True, which="major", color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9)
