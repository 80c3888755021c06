"""Descriptions of a `FrameStack` for `print`, notebooks and the command line."""

from __future__ import annotations

from typing import Any

import numpy as np

from hsnoise._core import html as _html

COLUMNS = ("kind", "exposure_s", "frames", "photons_e", "temperature_c", "overscan_dn")
HEADINGS = ("kind", "exposure / s", "frames", "photoelectrons", "degrees C", "overscan / DN")
Group = tuple[str, float, int, float, float, float]


def groups_of(stack: Any) -> list[Group]:
    """The values of COLUMNS for each exposure group of a `FrameStack`; NaN where unknown."""
    known = [stack.photons_e, stack.temperature_c, stack.overscan_dn]
    columns = [np.full(stack.n_exposures, np.nan) if values is None else values for values in known]
    numbers = np.stack(columns, 1).tolist()
    return [
        (kind, float(seconds), n, *rest)
        for kind, seconds, n, rest in zip(stack.kind, stack.exposure_s, stack.n_frames, numbers, strict=True)
    ]


def described(stack: Any) -> str:
    """Size, levels and groups of a `FrameStack`, one per row, and what was assumed when it was loaded."""
    lines = [f"FrameStack: {size_of(stack)}", f"  {levels_of(stack)}", *map(_line, groups_of(stack))]
    if stack.elsewhere is not None:
        lines.append(f"  {_elsewhere(stack)}")
        lines += [f"  {_line(group)}" for group in groups_of(stack.elsewhere)]
    return "\n".join([*lines, *(f"  {sentence}" for sentence in stack.assumed)])


def as_html(stack: Any) -> str:
    """The same for a notebook."""
    pieces = [_html.paragraph(f"{size_of(stack)}\n{levels_of(stack)}"), _table(stack)]
    if stack.elsewhere is not None:
        pieces += [_html.paragraph(_elsewhere(stack)), _table(stack.elsewhere)]
    n = len(stack.assumed)
    assumed = _html.details(f"What was assumed: {n} sentence{'s' if n != 1 else ''}", _html.sentences(stack.assumed))
    return _html.fragment(*pieces, assumed)


def size_of(stack: Any) -> str:
    """Numbers of frames, rows and columns; colours, shutter and ISO."""
    rows, columns = stack.shape
    iso = "" if stack.iso is None else f", ISO {stack.iso:g}"
    n = sum(stack.n_frames)
    return f"{n} frames of {rows} rows x {columns} columns, {stack.cfa}, {stack.shutter} shutter{iso}"


def levels_of(stack: Any) -> str:
    """Black and white level, and the gain that a header states."""
    black = "to be estimated" if stack.black_level is None else f"{np.round(stack.black_level, 3)} DN"
    white = "unknown" if stack.white_level is None else f"{stack.white_level:g} DN"
    stated = "" if stack.stated_gain is None else f", header {stack.stated_gain.source}"
    return f"black level {black}, white level {white}{stated}"


def _elsewhere(stack: Any) -> str:
    return "elsewhere on the sensor, {} x {} pixels:".format(*stack.elsewhere.shape)


def _line(group: Group) -> str:
    kind, seconds, n, photons_e, temperature_c, overscan_dn = group
    line = f"  {kind} {seconds:9.6g} s  {n} frame{'s' if n > 1 else ''}"
    line += f", {photons_e:g} photoelectrons per pixel" if np.isfinite(photons_e) else ""
    line += f", {temperature_c:.1f} degrees Celsius" if np.isfinite(temperature_c) else ""
    return line + (f", overscan {overscan_dn:.1f} DN" if np.isfinite(overscan_dn) else "")


def _table(stack: Any) -> str:
    """The groups as HTML, without columns that are unknown throughout."""
    groups = groups_of(stack)
    shown = [i for i in range(len(COLUMNS)) if i < 3 or any(np.isfinite(group[i]) for group in groups)]
    digits = ("", ".6g", "", "g", ".1f", ".1f")
    rows = [["-" if group[i] != group[i] else f"{group[i]:{digits[i]}}" for i in shown] for group in groups]
    return _html.table([HEADINGS[i] for i in shown], rows, words=("kind",))
