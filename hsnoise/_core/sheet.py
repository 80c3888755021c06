"""A table of results, for the terminal and for Markdown."""

from __future__ import annotations

from dataclasses import dataclass, field

from rich.console import Group
from rich.table import Table
from rich.text import Text


@dataclass(frozen=True)
class Sheet:
    """A table for the terminal and for Markdown; the first `left` columns are text."""

    title: str
    headings: tuple[str, ...]
    rows: list[tuple[str, ...]] = field(default_factory=list)
    left: int = 1

    def rich(self) -> Group:
        table = Table()
        for i, heading in enumerate(self.headings):
            table.add_column(heading, justify="left" if i < self.left else "right")
        for row in self.rows:
            table.add_row(*row)
        return Group(Text(self.title, style="italic"), table)  # Table's own title is wrapped to the table's width

    def markdown(self) -> str:
        rule = ["---" if i < self.left else "---:" for i in range(len(self.headings))]
        lines = ["| " + " | ".join(cells) + " |" for cells in (self.headings, rule, *self.rows)]
        return "\n".join([f"## {self.title}", "", *lines, ""])
