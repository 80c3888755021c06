"""Tables as pandas DataFrames; pandas is an extra."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any


def data_frame(source: Any, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> Any:
    """A pandas DataFrame of `rows` with the given `columns`, for the `to_pandas` method of `source`.

    Raises:
        ImportError: pandas is not installed.
    """
    try:
        import pandas
    except ImportError as error:
        name = type(source).__name__
        raise ImportError(f"{name}.to_pandas: needs pandas: pip install 'hsnoise[pandas]'") from error
    return pandas.DataFrame([tuple(row) for row in rows], columns=list(columns))


def table_to_pandas(source: Any) -> Any:
    """The `table` of a model or a fit as a DataFrame, one row per parameter. Raises as `data_frame`."""
    columns = ("parameter", "value", "standard_error", "unit")
    return data_frame(source, columns, ((name, *row) for name, row in source.table.items()))
