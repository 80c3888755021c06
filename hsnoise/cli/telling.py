"""Results in the terminal: the light with a sentence, doubts, a table, and whatever else fits on the screen."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TextIO

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hsnoise._core.conclusion import Conclusion, Light
from hsnoise.cli.table import table_of
from hsnoise.criticism import Comparison, Diagnosis, Story, shares
from hsnoise.criticism.inspection.inspect import Inspection
from hsnoise.criticism.sentences import LEGEND
from hsnoise.fitting.result import TITLES, FitResult
from hsnoise.model import NoiseModel
from hsnoise.statistics.structure import explained

LINES, COLUMNS = 40, 100  # assumed without a terminal; LINES is also the maximum
WORDS = ("added", "effect", "group of statistics", "worst group")  # headings of columns of text
COLOURS = {Light.GREEN: "green", Light.AMBER: "yellow", Light.RED: "red"}


@dataclass(frozen=True)
class Page:
    """The printed parts of a result, in this order.

    Attributes:
        conclusion: the light and the sentence.
        doubts: sentences above the table.
        tables: tables, or lines of text.
        notes: further sentences, as many as fit.
        rest: printed only with --verbose.
        colour: of the doubts.
    """

    conclusion: Conclusion
    doubts: tuple[str, ...] = ()
    tables: tuple[Table | tuple[str, ...], ...] = ()
    notes: tuple[str, ...] = ()
    rest: tuple[str, ...] = ()
    colour: str = "yellow"


def tell(page: Page, foot: Iterable[str] = (), verbose: bool = False, to: TextIO | None = None) -> None:
    """Print a page: what fits on one screen, the number of lines left out, and the whole `foot`; or everything.

    to: where; None: standard output.
    """
    console = screen(to)
    doubts = [Text(f"! {one}", page.colour) for one in page.doubts]
    head = [_printed(one, console) for one in (_light(page.conclusion, console), *doubts)]
    tables = [one for table in page.tables for one in _rows(table, console)]
    notes, rest = ([_printed(Text(one), console) for one in part] for part in (page.notes, page.rest))
    last = [_printed(Text(one), console) for one in foot]
    everything = [*head, *tables, *notes, *rest]
    room = LINES - _count(last) - 1
    small = min(room, console.height - 1 - _count(last) - 1)
    shown = everything if verbose else _fitting(head, tables, notes, room, small)
    left_out = _count(everything) - _count(shown)
    more = [f"{left_out} more line{'s' if left_out > 1 else ''}: --verbose"] if left_out else []
    # In one piece: a reader that is gone is no reason to break off in the middle.
    print("\n".join([*(text for text, _ in shown), *more, *(text for text, _ in last)]), file=to, flush=True)


def screen(to: TextIO | None = None) -> Console:
    """The terminal, or a file in which sentences are not wrapped."""
    console = Console(highlight=False, file=to)
    return console if console.is_terminal else Console(highlight=False, file=to, width=COLUMNS, height=LINES + 1)


def page_of_fit(fit: FitResult, rest: tuple[str, ...] = (), truth: NoiseModel | None = None) -> Page:
    """rest: what else --verbose prints."""
    return Page(
        conclusion=fit.conclusion,
        doubts=fit.further_doubts,
        tables=(table_of(fit, truth),),
        notes=(f"{TITLES[fit.method]}: {fit.outcome}", *(f"- {note}" for note in fit.notes)),
        rest=rest,
        colour="bold red" if fit.grave else "yellow",
    )


def page_of_comparison(found: Comparison) -> Page:
    sentences = (*found.worst, *explained(found.worst), *found.skipped)
    return Page(
        found.conclusion,
        tables=(_plain(found.as_table()),),
        notes=tuple(f"- {one}" for one in (*found.worst, found.unexplained) if one),
        rest=(found.measure, *(f"- {one}" for one in sentences[len(found.worst) :])),
    )


def page_of_diagnosis(found: Diagnosis) -> Page:
    rest = (found.remains, LEGEND)
    return Page(
        found.conclusion,
        tables=(_plain(found.as_table()),),
        notes=tuple(f"- {one}" for one in found.sentences),
        rest=tuple(f"- {one}" for one in rest if one),
    )


def page_of_story(story: Story, truth: NoiseModel | None = None) -> Page:
    """A page of the steps and the last fit."""
    fit = page_of_fit(story.fit, truth=truth)
    return Page(
        conclusion=story.conclusion,
        doubts=story.fit.further_doubts,
        tables=(_plain(story.as_table()), *_shares(story), *fit.tables),
        notes=tuple(one for one in (*story.measured, story.care, *fit.notes) if one),
        rest=tuple(one for one in (*story.details, story.ended, story.split) if one),
        colour=fit.colour,
    )


def _shares(story: Story) -> tuple[Table, ...]:
    return () if story.closed is None else (_plain(shares.as_table(story.closed.shares)),)


def page_of_inspection(found: Inspection) -> Page:
    parts = found.parts
    return Page(
        conclusion=found.conclusion,
        doubts=found.findings,
        tables=(("", *parts["capture"], ""), (*parts["groups"], "")),
        notes=(*parts["determined"], *parts["next"], *parts["assumed"]),
        rest=parts["budget"],
    )


def _light(conclusion: Conclusion, console: Console) -> Text:
    """A coloured disc and the sentence; without colour the light is a word."""
    if console.color_system is None or console.no_color or console.options.ascii_only:
        return Text(str(conclusion))
    return Text.assemble(("● ", f"bold {COLOURS[conclusion.light]}"), (conclusion.sentence, "bold"))


def _plain(table: Table) -> Table:
    """A result's table without grid, numbers aligned right."""
    table.box = SIMPLE_HEAD
    for column in table.columns:
        column.justify = "left" if column.header in WORDS else "right"
    return table


Printed = tuple[str, int]  # printed text and its number of screen lines


def _printed(text: Text, console: Console) -> Printed:
    """A sentence; outside a terminal it stays one line, for searching."""
    lines = _lines(text, console)
    if console.is_terminal:
        return "\n".join(lines), len(lines)
    return text.plain, len(lines)


def _rows(table: Table | tuple[str, ...], console: Console) -> list[Printed]:
    if isinstance(table, Table):
        return [(line, 1) for line in _lines(table, console)]
    return [(line, -(-len(line) // console.width) or 1) for line in table]


def _lines(one: Table | Text, console: Console) -> list[str]:
    with console.capture() as printed:
        console.print(one)
    return [line.rstrip() for line in printed.get().splitlines()]


def _count(some: Iterable[Printed]) -> int:
    return sum(lines for _, lines in some)


def _fitting(head: list[Printed], tables: list[Printed], notes: list[Printed], room: int, small: int) -> list[Printed]:
    """Whole sentences and rows that fit: the head in at most half the room, then the tables, then notes.

    small: room on a small screen, where notes are left out and tables scroll rather than being cut.
    """
    shown, used = head[:1], head[0][1]
    for part, most in ((head[1:], room // 2), (tables, room), (notes, small)):
        for one in part:
            if used + one[1] > most:
                break
            shown.append(one)
            used += one[1]
    return shown
