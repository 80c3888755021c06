"""HTML for notebooks: the conclusion, tables and sentences of a result.

Text is escaped only here. Colours are the notebook's, light or dark, except for the dot of a conclusion.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from html import escape
from typing import Any

from rich.table import Table

from hsnoise._core.conclusion import Conclusion, Light

COLOURS = {Light.GREEN: "#2da44e", Light.AMBER: "#d4920a", Light.RED: "#e5484d"}  # visible on white and on black
MOST_ROWS = 40  # of a table
LINE = "border-bottom:1px solid currentColor"
CELL = "padding:2px 8px"


def fragment(*pieces: str) -> str:
    """All non-empty pieces, one below the other."""
    return f'<div class="hsnoise" style="max-width:60em;overflow-x:auto">{"".join(pieces)}</div>'


def conclusion(of: Conclusion) -> str:
    """A dot in the colour of the light, and the sentence."""
    dot = (
        f'<span role="img" aria-label="{of.light}" title="{of.light}" style="color:{COLOURS[of.light]}">&#9679;</span>'
    )
    return f"<p>{dot} <strong>{escape(of.sentence)}</strong></p>"


def paragraph(text: str) -> str:
    """Text with its line breaks; empty for no text."""
    return f"<p>{escape(text).replace(chr(10), '<br>')}</p>" if text else ""


def sentences(given: Iterable[str], title: str = "") -> str:
    """A list below a title; empty for no sentences."""
    items = "".join(f"<li>{escape(one)}</li>" for one in given)
    return f"{paragraph(title)}<ul>{items}</ul>" if items else ""


def details(summary: str, *pieces: str) -> str:
    """A block that opens on a click; empty if all pieces are empty."""
    inside = "".join(pieces)
    return f"<details><summary>{escape(summary)}</summary>{inside}</details>" if inside else ""


def table(headings: Sequence[str], rows: Iterable[Sequence[Any]], words: Collection[str] = ()) -> str:
    """A table; columns whose heading is in `words` are aligned left, all others right.

    Longer tables are cut to their first MOST_ROWS rows, and the number of rows is stated.
    """
    rows = list(rows)
    left = [heading in words for heading in headings]
    head = _row("th", headings, [f"{CELL};text-align:{'left' if one else 'right'};{LINE}" for one in left])
    styles = [f"{CELL};text-align:left" if one else CELL for one in left]
    body = "".join(_row("td", row, styles) for row in rows[:MOST_ROWS])
    more = paragraph(f"{MOST_ROWS} of {len(rows)} rows") if len(rows) > MOST_ROWS else ""
    style = "border-collapse:collapse;margin:.5em 0;text-align:right"
    return f'<table style="{style}"><thead>{head}</thead><tbody>{body}</tbody></table>{more}'


def printed(of: Table) -> str:
    """A table as printed, with the same headings and cells; numbers are aligned right."""
    headings = [str(column.header).replace("\n", " ") for column in of.columns]
    columns = [[str(cell) for cell in column.cells] for column in of.columns]
    is_left = [
        one.justify == "left" and not all(map(_is_number, cells))
        for one, cells in zip(of.columns, columns, strict=True)
    ]
    words = [heading for heading, left in zip(headings, is_left, strict=True) if left]
    return table(headings, zip(*columns, strict=True), words)


def _is_number(cell: str) -> bool:
    try:
        float(cell.lstrip("< ") or 0)
    except ValueError:
        return False
    return True


def _row(tag: str, cells: Sequence[Any], styles: Sequence[str]) -> str:
    made = (f'<{tag} style="{style}">{escape(str(cell))}</{tag}>' for cell, style in zip(cells, styles, strict=True))
    return f"<tr>{''.join(made)}</tr>"
