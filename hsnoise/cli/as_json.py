"""Results for other programs: what `--json` prints. docs/command-line.md describes it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import singledispatch
from importlib.metadata import version
from typing import Any

import numpy as np

from hsnoise.criticism import Comparison, Diagnosis, Story
from hsnoise.criticism.inspection.inspect import Inspection
from hsnoise.criticism.shares import Share
from hsnoise.fitting.result import FitResult

SCHEMA_VERSION = 1  # raised when a name goes or changes its meaning; new names may come without


def as_json(found: Any, command: str, files: Iterable[str]) -> str:
    """A result as one line of JSON; numbers that are not known are null. files: what the command wrote."""
    whole = {
        "schema_version": SCHEMA_VERSION,
        "hsnoise": version("hsnoise"),
        "command": command,
        "light": found.conclusion.light,
        "conclusion": found.conclusion.sentence,
        "files": list(files),
        **content(found),
    }
    return json.dumps(_plain(whole), allow_nan=False)


@singledispatch
def content(found: Any) -> dict[str, Any]:
    """What belongs to a result of this kind."""
    raise TypeError(f"found: expected a result of hsnoise, got {type(found).__name__}")


@content.register
def _(found: FitResult) -> dict[str, Any]:
    return {
        "method": found.method,
        "converged": found.converged,
        "trustworthy": found.trustworthy,
        "parameters": _parameters(found),
        "doubts": found.doubts,
        "notes": found.notes,
    }


@content.register
def _(found: Comparison) -> dict[str, Any]:
    names = ("statistic", "group", "measured", "model", "z")
    return {
        "fits": found.fits,
        "error": found.error,
        "p_value": found.p_value,
        "max_z": found.max_z,
        "max_z_p_value": found.max_z_p_value,
        "log_likelihood_per_pixel_nats": found.log_likelihood_per_pixel,
        "groups": found.groups,
        "worst": found.worst,
        "shares": [_share(one) for one in found.shares],
        "unexplained": found.unexplained,
        "statistics": [dict(zip(names, row, strict=True)) for row in found.table],
        "skipped": found.skipped,
    }


@content.register
def _(found: Diagnosis) -> dict[str, Any]:
    ranking = [
        {"effect": one.name, "score_nats": one.score, "p_value": one.p_value, "z_left": one.misfit}
        for one in found.ranking
    ]
    return {"verdict": found.verdict, "names": found.names, "ranking": ranking, "advice": found.advice}


@content.register
def _(found: Story) -> dict[str, Any]:
    steps = [
        {
            "added": step.added,
            "error": step.comparison.error,
            "worst_group": step.comparison.worst_group,
            "held_out_nats": step.held_out,
            "held_out_error_nats": step.held_out_error,
        }
        for step in found.steps
    ]
    closed = None
    if found.closed is not None:
        closed = {"error": found.closed.comparison.error, "shares": [_share(one) for one in found.closed.shares]}
    return {
        "finished": found.finished,
        "ended": found.ended,
        "steps": steps,
        "shares": [_share(one) for one in found.steps[-1].comparison.shares],
        "closed": closed,
        "fit": content(found.fit),
    }


@content.register
def _(found: Inspection) -> dict[str, Any]:
    return {
        "fit_makes_sense": found.fit_makes_sense,
        "findings": found.findings,
        "determined": found.determined,
        "next_capture": found.next_capture,
    }


def _parameters(found: FitResult) -> dict[str, dict[str, Any]]:
    """Value, standard error and unit of each parameter; `state` says what null means."""
    return {
        name: {"value": value, "standard_error": error, "unit": unit, "state": _state(value, error)}
        for name, (value, error, unit) in found.table.items()
    }


def _state(value: float, error: float) -> str:
    if not (np.isfinite(value) and np.isfinite(error)):
        return "not determined"
    return "fitted" if error > 0 else "held"


def _share(one: Share) -> dict[str, Any]:
    return {
        "exposure_s": one.exposure_s,
        "channel": one.channel,
        "component": one.component,
        "measured_dn2": one.measured_dn2,
        "model_dn2": one.closed_dn2,
        "unexplained_dn": one.off_dn,
        "unexplained_of_total": one.unexplained_of_total,
    }


def _plain(value: Any) -> Any:
    """What JSON knows: lists, strings and finite numbers."""
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    return None if isinstance(value, float) and not np.isfinite(value) else value
