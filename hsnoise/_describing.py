"""A `FrameStack` in words: what `print` and the command line show of it."""

from __future__ import annotations

from typing import Any

import numpy as np


def described(stack: Any) -> str:
    """Size, levels and groups of a `FrameStack`, a line each, and what was assumed when it was loaded."""
    rows, columns = stack.shape
    black = "to be estimated" if stack.black_level is None else f"{np.round(stack.black_level, 3)} DN"
    white = "unknown" if stack.white_level is None else f"{stack.white_level:g} DN"
    stated = "" if stack.stated_gain is None else f", header {stack.stated_gain.source}"
    lines = [
        f"FrameStack: {sum(stack.n_frames)} frames of {rows} rows x {columns} columns, "
        f"{stack.cfa}, {stack.shutter} shutter" + ("" if stack.iso is None else f", ISO {stack.iso:g}"),
        f"  black level {black}, white level {white}{stated}",
        *(_group(stack, i) for i in range(stack.n_exposures)),
    ]
    if stack.elsewhere is not None:
        other = stack.elsewhere
        lines.append("  elsewhere on the sensor, {} x {} pixels:".format(*other.shape))
        lines += [f"  {_group(other, i)}" for i in range(other.n_exposures)]
    return "\n".join([*lines, *(f"  {sentence}" for sentence in stack.assumed)])


def _group(stack: Any, i: int) -> str:
    n = stack.n_frames[i]
    line = f"  {stack.kind[i]} {stack.exposure_s[i]:9.6g} s  {n} frame{'s' if n > 1 else ''}"
    if stack.photons_e is not None and np.isfinite(stack.photons_e[i]):
        line += f", {stack.photons_e[i]:g} photoelectrons per pixel"
    if stack.temperature_c is not None and np.isfinite(stack.temperature_c[i]):
        line += f", {stack.temperature_c[i]:.1f} degrees Celsius"
    if stack.overscan_dn is not None and np.isfinite(stack.overscan_dn[i]):
        line += f", overscan {stack.overscan_dn[i]:.1f} DN"
    return line
