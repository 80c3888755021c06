"""The page's inline figures, as SVG in the colours of the page, and the rendered page."""

from __future__ import annotations

import io
import re
from typing import Any

import matplotlib
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullFormatter

from hsnoise._core.types import seconds
from hsnoise.criticism import Comparison, Diagnosis, Story
from hsnoise.criticism.budget import BudgetRow
from hsnoise.fitting.result import FitResult
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.plots._budget import CLEAR, LABELS, ORDER, SHADES
from hsnoise.plots._residuals import residuals
from hsnoise.plots._style import NAMES, new_figure, plain_log, tidy
from hsnoise.report import _measured
from hsnoise.report._measured import SEED_APART, Middle, Shown
from hsnoise.report._pictures import pictures
from hsnoise.statistics.structure import SHORT

SIZE_IN = (4.4, 3.1)  # of a panel: readable at the width of a phone
LINES = ("row", "column")
# In all figures: measured is black, which becomes the page's text colour; the page sets the other colours.
MEASURED, MODEL, BEFORE, BAND = "#000000", "#6a3d9a", "#777777", "#b9a5d3"
PAGE_COLOURS = {MEASURED: "currentColor", MODEL: "var(--model)", BEFORE: "var(--before)", BAND: "var(--band)"}
GRID = "#e6e6e6"  # as in the plots' style


def breakable(name: str) -> Markup:
    """A parameter's name that narrow columns may break after dots and underscores, not within words."""
    return Markup(str(escape(name)).replace(".", ".<wbr>").replace("_", "_<wbr>"))


def render(
    context: dict[str, Any],
    found: Comparison | Diagnosis | Story | FitResult,
    stack: FrameStack,
    fit: FitResult | NoiseModel,
    seed: int,
) -> str:
    """The page: `context` (see `_context`) and the figures in the template."""
    comparison = context["comparison"]
    # Where the model fails: effects missing from short exposures may drown in the dark current of long ones.
    shortest = comparison is not None and any(SHORT in sentence for sentence in comparison.worst[:1])
    model = fit.params if isinstance(fit, FitResult) else fit
    models = {"first model": found.steps[0].fit.params} if isinstance(found, Story) and len(found.steps) > 1 else {}
    models["last model" if models else "model"] = model
    at = _measured.shown(stack, model, seed, shortest=shortest)
    near = _measured.middle(stack, list(models.values()), seed, shortest=shortest)
    environment = Environment(
        loader=PackageLoader("hsnoise.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["breakable"] = breakable
    return environment.get_template("report.html").render(
        context,
        exposure=seconds(at.exposure_s),
        n_frames=len(at.measured),
        n_draws=len(at.drawn),
        models=list(models),
        pictures=pictures(near.frames, at.cfa, stack.shape),
        budget=inline(budget_panels(near, list(models)), "b"),
        residuals=inline(_where(comparison, model, stack, seed), "w"),
        figures=inline(panels(at), "f"),
    )


def _where(comparison: Comparison | None, model: NoiseModel, stack: FrameStack, seed: int) -> dict[str, Figure]:
    """Where and when the frames differ from a model that does not fit; none if it does, or no dark is repeated."""
    if comparison is None or comparison.fits or not stack.repeated_darks:
        return {}
    return {"where and when the frames differ from the model": residuals(model, stack, seed=seed + SEED_APART)}


def inline(figures: dict[str, Figure], prefix: str) -> list[Markup]:
    """Figures, by name, as elements of the page."""
    return [svg(figure, f"{prefix}{i}", name) for i, (name, figure) in enumerate(figures.items())]


def panels(at: Shown) -> dict[str, Figure]:
    """Counts, spectra of rows and columns, and frame means, for each colour."""
    made = {f"{NAMES[c]}, counts": histogram(at, c) for c in at.channels}
    made |= {f"{NAMES[c]}, {LINES[axis]} spectrum": spectrum(at, c, axis) for axis in (0, 1) for c in at.channels}
    if len(at.measured) > 1:
        made |= {f"{NAMES[c]}, frame means": frame_means(at, c) for c in at.channels}
    return made


def budget_panels(near: Middle, models: list[str]) -> dict[str, Figure]:
    """The noise budget of each exposure and colour, measured and of the models; none if all are single frames."""
    budgets = near.budgets
    if not budgets:
        return {}
    rows = [of for of in zip(*(one.rows for one in budgets), strict=True) if of[0].n_frames > 1]
    sigmas = [np.sqrt(max(c.variance_dn2, 0)) for of in rows for row in of for c in row.components.values()]
    sigmas = [sigma for sigma in sigmas if sigma > 0] or [1.0]  # frames without any noise
    limits = max(0.5 * min(sigmas), 1e-4 * max(sigmas)), 2 * max(sigmas)
    return {f"{_kind_of(of[0])}, noise budget": budget_panel(of, models, limits) for of in rows}


def _kind_of(row: BudgetRow) -> str:
    lit = "flat" if row.kind == "flat" else "dark"
    return f"{NAMES[row.channel]}, {lit} of {seconds(row.exposure_s)}"


def budget_panel(rows: tuple[BudgetRow, ...], models: list[str], limits: tuple[float, float]) -> Figure:
    """Noise components of an exposure and colour: measured (dots) and models (hollow); arrows: upper limits."""
    figure, axes = _panel(_kind_of(rows[0]), "standard deviation / DN", "")
    looks = {"measured": ("o", MEASURED, MEASURED, 30), "first model": ("D", "none", BEFORE, 34)}
    for name, row in zip(("measured", *models), rows, strict=True):
        marker, face, edge, size = looks.get(name, ("s", "none", MODEL, 62))
        parts = [row.components[component] for component in ORDER]
        value = np.array([part.variance_dn2 for part in parts])
        error = np.array([part.standard_error_dn2 for part in parts])
        clear, y = value > CLEAR * error, np.arange(len(ORDER))
        style = {"s": size, "c": face, "edgecolors": edge, "linewidths": 1.4}
        axes.scatter(np.sqrt(value[clear]), y[clear], marker=marker, label=name, zorder=3, **style)
        most = np.sqrt(np.maximum(value, 0) + CLEAR * error)
        axes.scatter(most[~clear], y[~clear], marker="<", zorder=2, **style)
    swatches = axes.get_yaxis_transform()
    axes.scatter(
        [-0.03] * len(ORDER), y, s=46, marker="s", c=[SHADES[c] for c in ORDER], transform=swatches, clip_on=False
    )
    axes.set_yticks(y, [LABELS[name] for name in ORDER])
    axes.tick_params(axis="y", length=0, pad=14)
    axes.set_ylim(len(ORDER) - 0.5, -0.5)
    axes.set_xscale("log")
    axes.set_xlim(*limits)
    plain_log(axes.xaxis)
    figure.legend(fontsize=9, loc="outside lower center", ncols=len(rows), frameon=False)
    return figure


def histogram(at: Shown, channel: str) -> Figure:
    """Counts of a colour, measured (filled) and drawn (line), on a logarithmic scale."""
    edges = _measured.histogram_edges(at, channel)
    measured = _measured.share(at.measured, at.cfa, channel, edges)
    drawn = np.mean([_measured.share(one, at.cfa, channel, edges) for one in at.drawn], axis=0)
    figure, axes = _panel(NAMES[channel], "count / DN", "share of pixels per DN")
    axes.stairs(measured, edges, color=MEASURED, fill=True, alpha=0.25)
    axes.stairs(measured, edges, color=MEASURED, linewidth=0.8, label="measured")
    axes.stairs(drawn, edges, baseline=None, color=MODEL, linewidth=1.6, label="model")
    axes.set_yscale("log")
    least = 0.5 / max(at.measured[..., ::2, ::2].size, 1) / np.diff(edges).max()
    axes.set_ylim(least, 3 * max(measured.max(), drawn.max()))
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    return _legend(figure, axes)


def spectrum(at: Shown, channel: str, axis: int) -> Figure:
    """Power of a colour's row or column means: measured (points) and draws (line: mean, band: range)."""
    k, power = _measured.line_spectrum(at.measured, at.cfa, channel, axis)
    drawn = np.stack([_measured.line_spectrum(one, at.cfa, channel, axis)[1] for one in at.drawn])
    name = LINES[axis]
    figure, axes = _panel(
        f"{NAMES[channel]}, {name}s", f"{name} frequency / cycles per frame", f"power of {name} means / DN²"
    )
    axes.fill_between(k, drawn.min(0), drawn.max(0), color=BAND, alpha=0.5, linewidth=0)
    axes.loglog(k, drawn.mean(0), color=MODEL, linewidth=1.6, label="model")
    axes.loglog(k, power, "o", color=MEASURED, markersize=4.5, label="measured")
    for along, values in ((axes.xaxis, k), (axes.yaxis, [*power, *drawn.ravel()])):
        _few_decades(along, min(values), max(values))
    return _legend(figure, axes)


def frame_means(at: Shown, channel: str) -> Figure:
    """Mean of each frame of a colour minus the mean of all: measured (points) and draws (lines)."""
    means = [_measured.frame_means(one, at.cfa, channel) for one in (at.measured, *at.drawn)]
    figure, axes = _panel(f"{NAMES[channel]}, frames", "frame number", "frame mean - mean of all / DN")
    number = np.arange(len(means[0]))
    for drawn in means[1:]:
        axes.plot(number, drawn, color=MODEL, linewidth=0.9, alpha=0.6)
    axes.plot([], [], color=MODEL, linewidth=0.9, label="model")
    axes.plot(number, means[0], "o", color=MEASURED, markersize=4.5, label="measured")
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    return _legend(figure, axes)


def _few_decades(axis: Axis, low: float, high: float) -> None:
    """Plain numbers on a logarithmic axis; also between decades if it spans fewer than two."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_formatter(NullFormatter())


def _panel(title: str, x: str, y: str) -> tuple[Figure, Axes]:
    figure = new_figure(*SIZE_IN, title)
    axes = figure.subplots()
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    tidy(axes)
    return figure, axes


def _legend(figure: Figure, axes: Axes) -> Figure:
    axes.legend(fontsize=9, loc="best", frameon=False)
    return figure


def svg(figure: Figure, prefix: str, label: str) -> Markup:
    """A figure as an element of the page: black becomes the colour of its text, ids begin with `prefix`."""
    buffer = io.StringIO()
    # The salt makes the output reproducible.
    with matplotlib.rc_context({"svg.hashsalt": "hsnoise"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    head, body = text[text.index("<svg") :].split(">", 1)
    box = re.search(r'viewBox="([^"]*)"', head).group(1)
    body = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", body, flags=re.DOTALL)
    body = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{prefix}-", body)
    for colour, of_page in {**PAGE_COLOURS, GRID: "var(--grid)"}.items():
        body = body.replace(colour, of_page)
    return Markup('<svg viewBox="{}" role="img" aria-label="{}">').format(box, label) + Markup(body)
