"""Cells of the grid of hidden effects: the captures, and the measurements on each."""

from __future__ import annotations

import json
import math
import time
import zlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import hsnoise
from benchmarks.simulator import CAMERAS, EXPOSURE_S, Camera, capture
from hsnoise.criticism.diagnose import Diagnosis
from hsnoise.fitting.result import FitResult

CLEAN = "none"
TOP = 3
OTHER_KEY = 1000  # added to the seed of a second run of `improve` on the same capture
# Clean captures for false alarms: camera, black level DN, rolling, exposures, frames, shape.
LAYOUTS = (
    ("canon", 0, True, 4, 4, (96, 128)),
    ("grasshopper", 64, False, 1, 8, (256, 384)),
    ("mono", 64, True, 4, 8, (160, 240)),
    ("canon", 64, True, 1, 16, (128, 192)),
    ("grasshopper", 0, False, 4, 8, (160, 240)),
    ("mono", 0, False, 2, 16, (128, 192)),
    ("canon", 64, False, 2, 64, (64, 96)),
    ("grasshopper", 64, True, 2, 16, (128, 192)),
    ("mono", 64, False, 8, 64, (64, 96)),
    ("canon", 0, True, 8, 8, (128, 192)),
    ("grasshopper", 64, False, 8, 4, (96, 128)),
    ("mono", 0, True, 1, 4, (512, 768)),
    ("canon", 64, True, 4, 4, (512, 768)),
    ("grasshopper", 0, True, 4, 32, (64, 96)),
)


@dataclass(frozen=True)
class Cell:
    """One capture: its description, and `make`, which gives its FrameStack and its true base parameters.

    `about` holds key (unlike that of any other cell), kind ("grid", "layout" or "case"), camera, layout, effect
    ("a+b" for two at once), amplitude and seed.
    """

    about: dict[str, Any]
    make: Callable[[], tuple[hsnoise.FrameStack, dict[str, float]]]

    @property
    def hidden(self) -> list[str]:
        return hidden_in(self.about["effect"])


def hidden_in(effect: str) -> list[str]:
    """Names of the effects in a cell's `effect`."""
    return [] if effect == CLEAN else effect.split("+")


def grid_cells(
    cameras: Sequence[str],
    effects: Sequence[str],
    amplitudes: Sequence[float],
    seeds: Iterable[int],
    frames: int,
    shape: tuple[int, int],
) -> list[Cell]:
    """Cells with seeds outermost, so that a run that stops early still covers all effects."""
    # Clean captures have no amplitude: one per seed.
    wanted = dict.fromkeys(
        (seed, 0.0 if effect == CLEAN else amplitude, effect, name)
        for seed in seeds
        for amplitude in amplitudes
        for effect in effects
        for name in cameras
    )
    return [
        _simulated("grid", name, CAMERAS[name], effect, amplitude, seed, frames, shape, EXPOSURE_S)
        for seed, amplitude, effect, name in wanted
    ]


def layout_cells(seeds: Iterable[int]) -> list[Cell]:
    """Clean captures of `LAYOUTS`."""
    cells = []
    for seed in seeds:
        for name, black, rolling, exposures, frames, shape in LAYOUTS:
            camera = replace(CAMERAS[name], black=float(black), rolling=rolling)
            exposure_s = np.geomspace(0.02, 0.2, exposures).round(4) if exposures > 1 else [0.1]
            cells.append(_simulated("layout", name, camera, CLEAN, 0.0, seed, frames, shape, exposure_s))
    return cells


def _simulated(kind, name, camera: Camera, effect, amplitude, seed, frames, shape, exposure_s) -> Cell:
    shutter = "rolling" if camera.rolling else "global"
    layout = f"black {camera.black:g}, {shutter}, {len(exposure_s)} x {frames} x {shape[0]} x {shape[1]}"
    key = f"{name}, {effect}, {amplitude:g}, seed {seed}, {layout}"

    def make():
        rng = np.random.default_rng([seed, zlib.crc32(key.encode())])  # captures share no random numbers
        counts = capture(
            camera, tuple(hidden_in(effect)), amplitude, rng, frames=frames, shape=shape, exposure_s=exposure_s
        )
        stack = hsnoise.FrameStack(
            counts,
            exposure_s,
            black_level=camera.black,
            white_level=65535,
            cfa="mono" if len(camera.gain) == 1 else "RGGB",
            shutter=shutter,
        )
        return stack, true_parameters(camera)

    about = {"key": key, "kind": kind, "camera": name, "layout": layout}
    return Cell({**about, "effect": effect, "amplitude": amplitude, "seed": seed}, make)


def case_cells(folder: Path) -> list[Cell]:
    """Captures case_*.npz of a folder whose answers.json lists what is hidden in them."""
    answers = json.loads((folder / "answers.json").read_text())
    return [_case(folder / f"{name}.npz", answer) for name, answer in sorted(answers.items())]


def _case(path: Path, answer: dict) -> Cell:
    def make():
        with np.load(path) as data:
            stack = hsnoise.FrameStack(
                data["counts"],
                data["exposure_s"],
                black_level=data["black_level"],
                white_level=float(data["white_level"]),
                cfa=str(data["cfa"]),
                shutter=str(data["shutter"]),
            )
        return stack, _true_of_case(answer["base"])

    about = {"key": path.stem, "kind": "case", "camera": path.stem, "layout": "", "amplitudes": answer["amplitude"]}
    effect = "+".join(answer["hidden"]) or CLEAN
    return Cell({**about, "effect": effect, "amplitude": None, "seed": 0}, make)


def true_parameters(camera: Camera) -> dict[str, float]:
    """Base parameters of a simulated camera under the names of the fit's table."""
    suffixes = [""] if len(camera.gain) == 1 else [".R", ".G", ".B"]
    return {
        **{f"gain{s}": g for s, g in zip(suffixes, camera.gain, strict=True)},
        "dark_current.rate": camera.dark,
        "read_noise.sigma": camera.read,
        **{f"row_gain.sigma{s}": r for s, r in zip(suffixes, camera.row_sigma, strict=True)},
        "row_gain.exponent": float(camera.rolling),
    }


def _true_of_case(base: dict) -> dict[str, float]:
    return {
        **{f"gain.{c}": g for c, g in base["gain_dn_per_e"].items()},
        "dark_current.rate": base["dark_current_e_per_s"],
        "read_noise.sigma": base["read_noise_e"],
        **{f"row_gain.sigma.{c}": r for c, r in base["row_gain_sigma"].items()},
        "row_gain.exponent": base["row_spectrum_exponent"],
    }


def measure(cell: Cell, refit: bool, improve_minutes: float | None = None) -> dict[str, Any]:
    """The record of a cell; after an exception, the measurements so far and the error's text."""
    record: dict[str, Any] = {**cell.about, "refit": refit, "seconds": {}, "failure": None}
    try:
        _measure(cell, refit, record)
        if improve_minutes is not None:
            _improve(cell, improve_minutes, record)
    except Exception as problem:  # a failed cell must not stop the grid
        record["failure"] = f"{type(problem).__name__}: {problem}"
    return _plain(record)


def _measure(cell: Cell, refit: bool, record: dict[str, Any]) -> None:
    seed, seconds = cell.about["seed"], record["seconds"]
    with _timed(seconds, "simulate"):
        stack, truth = cell.make()
    record["truth"] = truth
    with _timed(seconds, "fit"):
        fitted = hsnoise.fit(stack)
    record["base_before"] = _estimates(fitted, truth)
    with _timed(seconds, "compare"):
        record["error_before"] = hsnoise.compare(fitted.params, stack, seed=seed).error
    with _timed(seconds, "diagnose"):
        found = hsnoise.diagnose(fitted, stack, seed=seed)
    record.update(_told(found, cell.hidden))
    if not refit or found.best is None:
        return
    with _timed(seconds, "refit"):
        again = hsnoise.fit(stack, model=fitted.params.add(found.best.effect))
    record["base_after"] = _estimates(again, truth)
    added = f"{found.best.name}."
    record["added"] = {n: [value, error] for n, (value, error, _) in again.table.items() if n.startswith(added)}
    with _timed(seconds, "compare again"):
        record["error_after"] = hsnoise.compare(again.params, stack, seed=seed).error


def _improve(cell: Cell, minutes: float, record: dict[str, Any]) -> None:
    """What the whole loop makes of the capture: what it added, how it ended, where that left the base parameters."""
    stack, truth = cell.make()
    with _timed(record["seconds"], "improve"):
        story = hsnoise.improve(stack, max_minutes=minutes, seed=cell.about["seed"])
    other = hsnoise.improve(stack, max_minutes=minutes, seed=cell.about["seed"] + OTHER_KEY)
    record["improved"] = {
        "added": [step.added for step in story.steps if step.added],
        "with_another_key": [step.added for step in other.steps if step.added],
        "ended": story.ending.why,
        "light": story.conclusion.light,
        "error": story.errors[-1],
        "base": {name: one for name, one in _estimates(story.fit, truth).items() if name not in story.fit.withheld},
    }


def _told(found: Diagnosis, hidden: list[str]) -> dict[str, Any]:
    order = [candidate.name for candidate in found.ranking]
    ranks = {name: order.index(name) + 1 if name in order else None for name in hidden}
    return {
        "verdict": found.verdict,
        "names": list(found.names),
        "ranks": ranks,
        "rank": min((rank for rank in ranks.values() if rank), default=None),
        "top": [[candidate.name, candidate.score] for candidate in found.ranking[:TOP]],
        "misfit": found.unexplained.misfit,
        "misfit_group": found.unexplained.group,
    }


def _estimates(fitted: FitResult, truth: dict[str, float]) -> dict[str, list[float]]:
    """Value and standard error of the base parameters that were fitted."""
    return {name: list(fitted.table[name][:2]) for name in truth if name in fitted.names}


@contextmanager
def _timed(seconds: dict[str, float], stage: str):
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[stage] = round(time.perf_counter() - start, 3)


def _plain(value: Any) -> Any:
    """`value` in types that JSON can hold: Python numbers, and None for numbers that are not finite."""
    if isinstance(value, dict):
        return {name: _plain(v) for name, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value
