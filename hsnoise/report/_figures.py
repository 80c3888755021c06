"""Figures of the page, inline: SVG that takes the colours of the page, PNG for frames; and the page around them."""

from __future__ import annotations

import base64
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
from PIL import Image

from hsnoise import plots
from hsnoise._types import seconds
from hsnoise.criticism import Comparison, Diagnosis, Story
from hsnoise.model import NoiseModel
from hsnoise.plots._style import COLOURS, FIT, NAMES, new_figure, tidy
from hsnoise.report import _measured
from hsnoise.report._measured import Shown
from hsnoise.result import FitResult
from hsnoise.stack import FrameStack
from hsnoise.structure import SHORT

SIZE_IN = (4.4, 3.1)  # of a panel: its letters can be read at the width of a phone
STRETCH = (0.5, 99.5)  # percentiles of the measured frame that are black and white
LINES = ("row", "column")


def breakable(name: str) -> Markup:
    """A parameter's name that a narrow column may break after its dots and underscores, not within a word."""
    return Markup(str(escape(name)).replace(".", ".<wbr>").replace("_", "_<wbr>"))


def render(
    context: dict[str, Any],
    found: Comparison | Diagnosis | Story,
    stack: FrameStack,
    fit: FitResult | NoiseModel,
    seed: int,
) -> str:
    """The page: `context` (see `_context`) and the figures in the template."""
    comparison = context["comparison"]
    # Where the model fails: what is missing from short exposures may drown in the dark current of long ones.
    shortest = comparison is not None and any(SHORT in sentence for sentence in comparison.worst[:1])
    at = _measured.shown(stack, fit.params if isinstance(fit, FitResult) else fit, seed, shortest=shortest)
    figures = {f"{NAMES[c]}, counts": histogram(at, c) for c in at.channels}
    figures |= {f"{NAMES[c]}, {LINES[axis]} spectrum": spectrum(at, c, axis) for axis in (0, 1) for c in at.channels}
    if len(at.measured) > 1:
        figures |= {f"{NAMES[c]}, frame means": frame_means(at, c) for c in at.channels}
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
        frames=frames(at),
        figures={name: svg(figure, f"f{i}", name) for i, (name, figure) in enumerate(figures.items())},
        story_figure=svg(plots.story(found), "story", "error of each step") if isinstance(found, Story) else "",
    )


def frames(at: Shown) -> dict[str, Any]:
    """The middle of a measured and of a drawn frame as grey pictures at one stretch, and its limits in DN."""
    pair = [_measured.crop(one[0]) for one in (at.measured, at.drawn[0])]
    low, high = np.percentile(pair[0], STRETCH)
    high = max(high, low + 1)
    rows, columns = pair[0].shape
    part = f"{'All' if pair[0].shape == at.measured.shape[1:] else 'The middle'} {rows} x {columns} pixels"
    measured, drawn = (_png(np.clip((one - low) / (high - low), 0, 1)) for one in pair)
    return {"measured": measured, "drawn": drawn, "low": f"{low:.4g}", "high": f"{high:.4g}", "part": part}


def _png(grey: np.ndarray) -> str:
    """A picture [row, column] of 0 (black) to 1 as the address of an inline image."""
    buffer = io.BytesIO()
    Image.fromarray(np.round(255 * grey).astype(np.uint8)).save(buffer, format="png", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def histogram(at: Shown, channel: str) -> Figure:
    """Counts of a colour, measured (filled) and drawn (line), on a logarithmic scale."""
    edges = _measured.histogram_edges(at, channel)
    measured = _measured.share(at.measured, at.cfa, channel, edges)
    drawn = np.mean([_measured.share(one, at.cfa, channel, edges) for one in at.drawn], axis=0)
    figure, axes = _panel(NAMES[channel], "count / DN", "share of pixels per DN")
    axes.stairs(measured, edges, color=COLOURS[channel], fill=True, alpha=0.35)
    axes.stairs(measured, edges, color=COLOURS[channel], linewidth=1.0, label="measured")
    axes.stairs(drawn, edges, baseline=None, color=FIT, linewidth=1.4, label="model")
    axes.set_yscale("log")
    least = 0.5 / max(at.measured[..., ::2, ::2].size, 1) / np.diff(edges).max()
    axes.set_ylim(least, 3 * max(measured.max(), drawn.max()))
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    return _legend(figure, axes)


def spectrum(at: Shown, channel: str, axis: int) -> Figure:
    """Power of the mean rows or columns of a colour: measured (points), and of the draws (line, band: all draws)."""
    k, power = _measured.line_spectrum(at.measured, at.cfa, channel, axis)
    drawn = np.stack([_measured.line_spectrum(one, at.cfa, channel, axis)[1] for one in at.drawn])
    name = LINES[axis]
    figure, axes = _panel(
        f"{NAMES[channel]}, {name}s", f"{name} frequency / cycles per frame", f"power of {name} means / DN²"
    )
    axes.fill_between(k, drawn.min(0), drawn.max(0), color="0.6", alpha=0.4, linewidth=0)
    axes.loglog(k, drawn.mean(0), color=FIT, linewidth=1.4, label="model")
    axes.loglog(k, power, "o", color=COLOURS[channel], markersize=4.5, label="measured")
    for along, values in ((axes.xaxis, k), (axes.yaxis, [*power, *drawn.ravel()])):
        _few_decades(along, min(values), max(values))
    return _legend(figure, axes)


def frame_means(at: Shown, channel: str) -> Figure:
    """Mean of each frame of a colour over the mean of all: measured (points), and of all draws (lines)."""
    means = [_measured.frame_means(one, at.cfa, channel) for one in (at.measured, *at.drawn)]
    figure, axes = _panel(f"{NAMES[channel]}, frames", "frame number", "frame mean - mean of all / DN")
    number = np.arange(len(means[0]))
    for drawn in means[1:]:
        axes.plot(number, drawn, color=FIT, linewidth=0.9, alpha=0.6)
    axes.plot([], [], color=FIT, linewidth=0.9, label="model")
    axes.plot(number, means[0], "o", color=COLOURS[channel], markersize=4.5, label="measured")
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    return _legend(figure, axes)


def _few_decades(axis: Axis, low: float, high: float) -> None:
    """Plain numbers along a logarithmic axis, between the decades too if there are not even two."""
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
    # The salt makes the same figure the same text every time.
    with matplotlib.rc_context({"svg.hashsalt": "hsnoise"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    head, body = text[text.index("<svg") :].split(">", 1)
    box = re.search(r'viewBox="([^"]*)"', head).group(1)
    body = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", body, flags=re.DOTALL)
    body = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{prefix}-", body)
    # Black, and the grid's and mono's grey of the plots' style.
    body = body.replace("#000000", "currentColor").replace("#e6e6e6", "var(--grid)").replace("#404040", "var(--mono)")
    return Markup('<svg viewBox="{}" role="img" aria-label="{}">').format(box, label) + Markup(body)
