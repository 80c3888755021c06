"""How long the loop takes: compare, diagnose, refit and improve on simulated captures of 4 x 8 x 160 x 240.

    python -m benchmarks.loop
    python -m benchmarks.loop --effects row_noise,image_lag --no-improve

Times exclude the first compilation in the process: one capture is processed before the clock starts. The yardstick is
the time NumPy takes for 20 Mpixel of Poisson plus normal draws on the same machine, one thread, in the same run.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from rich.console import Console
from rich.table import Table

import hsnoise
from benchmarks._grid_cells import grid_cells

# Weak and strong effects, within a frame and between frames, and one that the library lacks.
EFFECTS = (
    "row_noise",
    "column_fixed_pattern",
    "hot_pixels",
    "image_lag",
    "random_telegraph_noise",
    "amplifier_glow",
    "crosstalk",
    "row_noise+hot_pixels",
    "ramp_37_rows",
)
FIRST = "frame_offset"  # processed before the clock starts
YARDSTICK_PIXELS = 20_000_000


def yardstick_s() -> float:
    """Seconds of NumPy for YARDSTICK_PIXELS draws of Poisson plus normal."""
    rng = np.random.default_rng(0)
    start = time.perf_counter()
    rng.poisson(5.0, YARDSTICK_PIXELS) + 3 * rng.standard_normal(YARDSTICK_PIXELS, np.float32)
    return time.perf_counter() - start


def timed(run):
    start = time.perf_counter()
    value = run()
    return value, time.perf_counter() - start


def one(effect: str, camera: str, seed: int, improve: bool) -> dict[str, float | str]:
    """Seconds of each stage on one capture."""
    (cell,) = grid_cells([camera], [effect], [1.0], [seed], 8, (160, 240))
    stack, _ = cell.make()
    out: dict[str, float | str] = {"effect": effect}
    fit, out["fit"] = timed(lambda: hsnoise.fit(stack))
    _, out["compare"] = timed(lambda: hsnoise.compare(fit.params, stack))
    found, out["diagnose"] = timed(lambda: hsnoise.diagnose(fit, stack))
    out["verdict"] = found.headline
    if found.best is not None:
        model = fit.params.add(found.best.effect)
        _, out["refit"] = timed(lambda: hsnoise.fit(stack, model=model))
    if improve:
        story, out["improve"] = timed(lambda: hsnoise.improve(stack))
        out["story"] = " -> ".join(f"{step.comparison.error:.2f}" for step in story.steps)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effects", default=",".join(EFFECTS), help="hidden effects, one capture each")
    parser.add_argument("--camera", default="canon")
    parser.add_argument("--seed", type=int, default=21)
    parser.add_argument("--no-improve", action="store_true", help="leave out improve, which takes the longest")
    arguments = parser.parse_args()
    console = Console(width=140)
    before_s = yardstick_s()
    one(FIRST, arguments.camera, arguments.seed, improve=False)
    stages = ("fit", "compare", "diagnose", "refit", "improve")
    table = Table("hidden", *[f"{stage} / s" for stage in stages], "verdict", "error in improve")
    rows = []
    for effect in arguments.effects.split(","):
        rows.append(one(effect, arguments.camera, arguments.seed, not arguments.no_improve))
        row = rows[-1]
        seconds = [f"{row[stage]:.1f}" if stage in row else "" for stage in stages]
        table.add_row(effect, *seconds, str(row["verdict"]), str(row.get("story", "")))
        console.print(f"{effect}: {row}", highlight=False)
    for label, q in (("median", 0.5), ("90 %", 0.9)):
        found = [[float(row[stage]) for row in rows if stage in row] for stage in stages]
        table.add_row(label, *[f"{np.quantile(of, q):.1f}" if of else "" for of in found], "", "")
    console.print(table)
    print(f"NumPy, 20 Mpixel of Poisson plus normal: {before_s:.2f} s before, {yardstick_s():.2f} s after")


if __name__ == "__main__":
    main()
