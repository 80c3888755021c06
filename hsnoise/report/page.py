"""One page of HTML on a capture and a model: the result of `fit`, `compare`, `diagnose` or `improve`, with figures.

The page contains its figures and styles, needs no network, and is written whole or not at all.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from hsnoise._core.naming import named
from hsnoise._core.output import check_file, write_atomically
from hsnoise.criticism import Comparison, Diagnosis, Story
from hsnoise.fitting.result import FitResult
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel

Found = Comparison | Diagnosis | Story | FitResult

__all__ = ["check_path", "page", "write_report"]


def check_path(path: str | os.PathLike, *, made: str | os.PathLike | None = None) -> None:
    """Raise ValueError unless a page can be written to `path`; call before long work.

    Args:
        path: ends in .html, in a folder that exists.
        made: a folder that may not exist yet, because the caller will create it.
    """
    path = Path(path)
    if path.suffix.lower() != ".html":
        raise ValueError(f"{named('report')}: expected a file ending in .html, got {path}")
    check_file("report", path, made)


def page(
    found: Found,
    stack: FrameStack,
    *,
    fit: FitResult | NoiseModel | None = None,
    comparison: Comparison | None = None,
    files: Sequence[str] = (),
    seed: int = 0,
) -> str:
    """The page as text.

    Args:
        found: result of `hsnoise.compare`, `diagnose`, `improve` or `fit`.
        stack: the capture; its dark frames are shown beside draws of the model.
        fit: the model that was compared or diagnosed, with standard errors if it is a FitResult; not for a Story
            or a fit, which have their own.
        comparison: for a Diagnosis, the comparison of its model; without it, bars and worst statistics are left out.
        files: names of the capture's files.
        seed: seed of the draws that are shown.

    Raises:
        TypeError, ValueError: no fit with a Comparison or Diagnosis, or one that does not match the stack; no darks.
    """
    from hsnoise.report._context import context  # Jinja2 and matplotlib are slow to import
    from hsnoise.report._figures import render

    if isinstance(found, Story | FitResult):
        fit = found.fit if isinstance(found, Story) else found
    if not isinstance(fit, FitResult | NoiseModel):
        raise TypeError(f"fit: expected a FitResult or a NoiseModel, got {type(fit).__name__}")
    return render(context(found, stack, fit, comparison, files, seed), found, stack, fit, seed)


def write_report(path: str | os.PathLike, found: Found, stack: FrameStack, **keywords) -> None:
    """Write the page of `page(found, stack, **keywords)` to a file.

    Raises:
        ValueError: a path that `check_path` rejects; TypeError, ValueError: see `page`.
        OSError: the file cannot be written; an existing file is left as it was.
    """
    check_path(path)
    write_atomically(path, page(found, stack, **keywords).encode())
