"""Are the errors of refits by simulation right? Pulls and coverage over simulated captures with an effect each.

    python -m benchmarks.refits --captures 20
    python -m benchmarks.refits --effects row_noise,hot_pixels --out build/refits.jsonl
    python -m benchmarks.refits --improve 2 --captures 10    # the whole loop, which is not told what is hidden

Captures are drawn by hsnoise itself, small ones, so that a hundred take an hour. Standard errors are tested, not
physics. A pull is (estimate - truth) / standard error; its root mean square should be 1, and 95 % lie within 1.96.
Finished captures are lines of `--out`, and are not run again.
"""

from __future__ import annotations

import argparse
import json
import time
import zlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import hsnoise
from hsnoise import effects as fx
from hsnoise._core.conclusion import Light

EFFECTS = {
    "row_noise": fx.RowNoise(1.0),
    "column_noise": fx.ColumnNoise(0.8),
    "frame_offset": fx.FrameOffset(0.4),
    "dark_signal_nonuniformity": fx.DarkSignalNonuniformity(1.5),
    "crosstalk": fx.Crosstalk(0.02),
}
OF_THE_LOOP = EFFECTS | {
    "column_fixed_pattern": fx.ColumnFixedPattern(1.0),
    "row_fixed_pattern": fx.RowFixedPattern(1.0),
    "heavy_tailed_read_noise": fx.HeavyTailedReadNoise(6.0),
    "read_noise_nonuniformity": fx.ReadNoiseNonuniformity(0.2),
    "correlated_read_noise": fx.CorrelatedReadNoise(0.3, 0.25, 0.5),
}
EXPOSURE_S, FRAMES, SHAPE = (0.02, 0.05, 0.1, 0.2), 6, (64, 96)
WITHIN = 1.96


def pulls(name: str, number: int, improve_minutes: float | None = None) -> tuple[dict[str, float], str]:
    """Pull of each number of the refit of capture `number`, or of what `improve` makes of it; and the light of that."""
    camera = hsnoise.cameras.grasshopper3(black_level_dn=64)
    truth = camera.add(OF_THE_LOOP[name])
    key = jax.random.key(zlib.crc32(f"{name} {number}".encode()))
    counts = [
        np.asarray(hsnoise.sample_dark(jax.random.fold_in(key, i), FRAMES, SHAPE, truth, exposure_s=t, sensor_key=key))
        for i, t in enumerate(EXPOSURE_S)
    ]
    stack = hsnoise.FrameStack(counts, EXPOSURE_S, black_level=64, white_level=65535, cfa="RGGB", shutter="global")
    if improve_minutes is None:
        fit = hsnoise.fit(stack, model=truth, pixels="alike")
        light = fit.conclusion.light
    else:
        story = hsnoise.improve(stack, max_minutes=improve_minutes, seed=number)
        fit, light = story.fit, story.conclusion.light
    found = {
        parameter: (value - truth.table[parameter][0]) / error
        for parameter, (value, error, _) in fit.table.items()
        if parameter in fit.names and parameter in truth.table and parameter not in fit.withheld and np.isfinite(error)
    }
    return found, str(light)


Record = dict[str, Any]


def read(out: Path) -> dict[tuple[str, int], Record]:
    """Finished captures of the file."""
    lines = map(json.loads, out.read_text().splitlines()) if out.exists() else ()
    return {(one["effect"], one["number"]): one for one in lines}


def report(found: dict[tuple[str, int], Record]) -> Table:
    """Root mean square and coverage by effect, of the base parameters and of its own, of results that may be used."""
    table = Table("effect", "captures", "red", "base: rms pull", "within 1.96", "own: rms pull", "within 1.96 ")
    for name in (*OF_THE_LOOP, "all"):
        some = [one for (effect, _), one in found.items() if name in (effect, "all")]
        used = [(one["effect"], one["pulls"]) for one in some if one["light"] != str(Light.RED)]
        is_own = [(pull, parameter.split(".")[0] == effect) for effect, of in used for parameter, pull in of.items()]
        own, base = (np.array([pull for pull, its in is_own if its == wanted]) for wanted in (True, False))
        if used:
            table.add_row(name, f"{len(used)}", f"{len(some) - len(used)}", *_in_words(base), *_in_words(own))
    return table


def _in_words(values: np.ndarray) -> tuple[str, str]:
    if not len(values):
        return "", ""
    return f"{np.sqrt(np.mean(values**2)):.2f}", f"{100 * np.mean(np.abs(values) < WITHIN):.0f} %"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=20, help="of each effect (default 20)")
    parser.add_argument("--effects", help=f"of {', '.join(OF_THE_LOOP)}; default: the first five, of the loop all")
    parser.add_argument("--improve", type=float, metavar="MINUTES", help="run `improve` for so long instead of a refit")
    parser.add_argument("--minutes", type=float, default=np.inf, help="start no new capture after this time")
    parser.add_argument("--out", type=Path, default=Path("build/refits.jsonl"))
    arguments = parser.parse_args()
    end = time.monotonic() + 60 * arguments.minutes
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    found = read(arguments.out)
    names = arguments.effects.split(",") if arguments.effects else EFFECTS if arguments.improve is None else OF_THE_LOOP
    wanted = [(name, number) for number in range(arguments.captures) for name in names]
    with arguments.out.open("a") as file:
        for name, number in track([one for one in wanted if one not in found], console=Console(stderr=True)):
            if time.monotonic() > end:
                break
            of, light = pulls(name, number, arguments.improve)
            found[name, number] = {"effect": name, "number": number, "pulls": of, "light": light}
            file.write(json.dumps(found[name, number]) + "\n")
            file.flush()
    Console(width=110).print(report(found))


if __name__ == "__main__":
    main()
