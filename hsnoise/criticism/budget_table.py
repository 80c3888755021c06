"""A `NoiseBudget` as text: variances, shares, how pixels differ; at most 100 columns wide."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from hsnoise._core import html as _html
from hsnoise._core.types import seconds
from hsnoise.statistics.decomposition import COMPONENTS, Component

HEADINGS = {"row_x_frame": "row x\nframe", "column_x_frame": "column\nx frame"}
ABOUT = (
    "Noise budget: variances in DN², in brackets the standard error of the last digit. Row, column and\n"
    "pixel stay as they are from frame to frame, the others change."
)
ABOUT_SHARES = "Their share of the total in per cent; σ is the root of the total"
ABOUT_PIXELS = "How pixels differ, noise of estimation taken off"
WIDTH = 100
CLEAR = 2.0  # standard errors; below it a variance is given as an upper limit
SMALL, LARGE = 1e-3, 1e4  # beyond which powers of ten are shorter


def printed(budget: Any) -> str:
    """The whole budget, for `print`."""
    console = Console(file=io.StringIO(), width=WIDTH, color_system=None, highlight=False)
    console.print(ABOUT)
    console.print(variances(budget))
    console.print(ABOUT_SHARES)
    console.print(shares(budget))
    if budget.pixels:
        console.print(ABOUT_PIXELS)
        console.print(spreads(budget))
    for sentence in budget.sentences():
        console.print(f"- {sentence}")
    lines = (line.rstrip() for line in console.file.getvalue().rstrip().splitlines())
    return "\n".join(line for line in lines if line)


def as_html(budget: Any) -> str:
    """The same tables for a notebook, of shares first: they show at a glance what matters."""
    pixels = [_html.paragraph(ABOUT_PIXELS), _html.printed(spreads(budget))] if budget.pixels else []
    return _html.fragment(
        _html.paragraph("Noise budget: shares of the total variance in per cent; σ is the root of the total"),
        _html.printed(shares(budget)),
        _html.sentences(budget.sentences()),
        _html.details("Variances", _html.paragraph(ABOUT.replace("\n", " ")), _html.printed(variances(budget))),
        _html.details("Pixels", *pixels),
    )


def variances(budget: Any) -> Table:
    """Variances of all components with their standard errors, and how they grow."""
    table = _table("exposure", *_colour(budget), "mean\nDN", *(HEADINGS.get(name, name) for name in COMPONENTS))
    for row in budget.rows:
        cells = (_cell(row.components[name]) for name in COMPONENTS)
        table.add_row(*_first(budget, row), f"{row.mean_dn:.1f}", *cells)
    grown = dict.fromkeys(channel for channel, _ in budget.growth)
    if grown:
        table.add_section()
    for channel in grown:
        cells = (concise(*budget.growth[channel, name]) for name in COMPONENTS)
        table.add_row("per s", *([channel] if _colour(budget) else []), "", *cells)
    return table


def shares(budget: Any) -> Table:
    """The total and the share of each component; of clipped and saturated counts where there are any."""
    extremes = {"at 0": "clipped_share", "at\nwhite": "saturated_share"}
    shown = {name: field for name, field in extremes.items() if any(getattr(row, field) > 0 for row in budget.rows)}
    headings = (HEADINGS.get(name, name) for name in COMPONENTS)
    table = _table("exposure", *_colour(budget), "σ\nDN", *headings, *shown)
    for row in budget.rows:
        cells = (_share(row.components[name], row.total_dn2) for name in COMPONENTS)
        ends = (_percent(getattr(row, field)) for field in shown.values())
        table.add_row(
            *_first(budget, row), f"{np.sqrt(row.total_dn2):.3g}" if row.total_dn2 > 0 else "-", *cells, *ends
        )
    return table


def spreads(budget: Any) -> Table:
    """Offset, dark signal and temporal noise of single pixels."""
    table = _table("", *_colour(budget), "median", "spread", "top 0.1 %\nmedian +", "unit")
    for (channel, what), one in budget.pixels.items():
        numbers = (f"{x:.4g}" for x in (one.median, one.spread, one.tail))
        table.add_row(what, *([channel] if _colour(budget) else []), *numbers, one.unit)
    return table


def concise(value: float, error: float) -> str:
    """Value and, in brackets, the standard error of its last digit: 45.5(3) is 45.5 ± 0.3, 270(50) is 270 ± 50."""
    if not (np.isfinite(value) and np.isfinite(error)):
        return "-"
    if error <= 0:
        return f"{value:.3g}"
    size = max(abs(value), error)
    power = 0 if SMALL <= size < LARGE else int(np.floor(np.log10(size)))
    value, error = value / 10.0**power, error / 10.0**power
    place = int(np.floor(np.log10(float(f"{error:.0e}"))))
    digit = round(error, -place) if place > 0 else error / 10.0**place
    return f"{round(value, -place) + 0.0:.{max(-place, 0)}f}({digit:.0f})" + (f"e{power}" if power else "")


def _cell(one: Component) -> str:
    if one.variance_dn2 < CLEAR * one.standard_error_dn2:
        return f"<{_plain(_most(one))}"
    return concise(one.variance_dn2, one.standard_error_dn2)


def _most(one: Component) -> float:
    return max(one.variance_dn2, 0.0) + CLEAR * one.standard_error_dn2


def _share(one: Component, total_dn2: float) -> str:
    if one.variance_dn2 < CLEAR * one.standard_error_dn2:
        most = min(_most(one) / total_dn2, 1.0)
        return f"<{_percent(max(most, 1e-3))}"
    return _percent(one.share)


def _percent(share: float) -> str:
    if not np.isfinite(share):
        return "-"
    if share <= 0:
        return "0"
    return f"{100 * share:.0f}" if share >= 0.0995 else f"{100 * share:.1f}" if share >= 1e-3 else "<0.1"


def _plain(value: float) -> str:
    """Two or three digits, with a power of ten only where it is shorter."""
    if not np.isfinite(value):
        return "-"
    if value >= LARGE or 0 < value < SMALL:
        return f"{value:.0e}".replace("e+0", "e").replace("e-0", "e-").replace("e+", "e")
    return f"{value:.0f}" if value >= 20 else f"{value:.1f}" if value >= 10 else f"{value:.2g}"


def _first(budget: Any, row: Any) -> list[str]:
    lit = "flat " if row.kind == "flat" else ""
    return [f"{lit}{seconds(row.exposure_s)}", *([row.channel] if _colour(budget) else [])]


def _colour(budget: Any) -> list[str]:
    return ["colour"] if len({row.channel for row in budget.rows}) > 1 else []


def _table(*headings: str) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in headings:
        left = heading in ("", "unit")
        table.add_column("" if heading == "colour" else heading, justify="left" if left else "right", no_wrap=True)
    return table
