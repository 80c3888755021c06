"""The parameter table of the command line."""

from __future__ import annotations

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from hsnoise._core.types import unit_in_words
from hsnoise.fitting.result import FitResult, rounded
from hsnoise.model import NoiseModel


def table_of(fit: FitResult, truth: NoiseModel | None = None) -> Table:
    """The parameters of a fit beside the true ones, if known."""
    table = Table(box=SIMPLE_HEAD)
    table.add_column("parameter", no_wrap=True)
    for name in ("value", "standard error"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("unit")
    true_values = {} if truth is None else truth.table
    if truth is not None:
        table.add_column("truth", justify="right", no_wrap=True)
        table.add_column("off by", justify="right", no_wrap=True)
    for name, (value, error, unit) in (fit.told if truth is None else fit.in_order).items():
        cells = [name, *rounded(value, error), unit_in_words(unit)]
        if name in true_values:
            true_value = true_values[name][0]
            known = error > 0 and np.isfinite(error)
            cells += [rounded(true_value, error)[0], f"{(value - true_value) / error:+.1f} s.e." if known else ""]
        table.add_row(*cells)
    return table
