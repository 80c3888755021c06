"""Time and peak memory of fit, budget, inspect and compare as captures grow in pixels and in frames.

    python -m benchmarks.scaling                     # writes 1.9 GB to --folder, once; half an hour
    python -m benchmarks.scaling --only fit,budget --largest 100

On Linux. Each capture lies in a mapped NumPy file, of a simulated sensor whose pixels differ; each job is a process of
its own. Prints a table and the exponents of growth, and draws the figure of docs/results.md (`--figure`).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

import hsnoise
from benchmarks.cluster import CAPTURE, JOBS, frame
from hsnoise._core.sheet import Sheet

BY_PIXELS = {1: (160, 200), 10: (480, 640), 100: (1536, 2048), 700: (3840, 5760)}  # Mpixel of 4 x 8 frames
BY_FRAMES = (2, 8, 32, 128, 512, 2000)  # of FRAME, at two exposures
FRAME = (240, 320)
FOUR_S, TWO_S = (0.02, 0.1, 0.5, 2.0), (0.1, 2.0)


def capture_of(folder: Path, exposure_s: tuple[float, ...], frames: int, shape: tuple[int, int]) -> Path:
    """A file of counts [exposure, frame, row, column], simulated unless it is there."""
    path = folder / f"{len(exposure_s)}x{frames}x{shape[0]}x{shape[1]}.npy"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        partial_file = path.with_suffix(".partial")
        out = np.lib.format.open_memmap(partial_file, "w+", np.uint16, (len(exposure_s), frames, *shape))
        for e, f in track(list(np.ndindex(len(exposure_s), frames)), description=path.stem):
            out[e, f] = frame(e, f, shape, exposure_s[e])
        out.flush()
        partial_file.rename(path)
    return path


def measure(job: str, path: Path) -> dict[str, float]:
    """Time in s and peak memory in MiB of a job in this process, which has done nothing else."""
    counts = np.load(path, mmap_mode="r")
    stack = hsnoise.FrameStack(list(counts), exposure_s=FOUR_S if len(counts) == 4 else TWO_S, **CAPTURE)
    model = hsnoise.NoiseModel.load(path.parent / "model.json") if job == "compare" else None
    run = partial(hsnoise.compare, model) if job == "compare" else getattr(hsnoise, job)
    began = time.monotonic()
    run(stack)
    return {"s": time.monotonic() - began, "mib": peak_mib()}


def peak_mib() -> float:
    """Largest resident memory of this process; `ru_maxrss` would begin with that of its parent."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def measured(job: str, path: Path) -> dict[str, float]:
    """`measure` in a fresh process."""
    words = [sys.executable, "-m", "benchmarks.scaling", "--job", job, "--file", str(path)]
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def exponent(sizes: list[float], times: list[float]) -> float:
    """Of time with size between the two largest."""
    return float(np.log(times[-1] / times[-2]) / np.log(sizes[-1] / sizes[-2]))


def figure(found: dict[tuple[str, str], tuple[list[float], list[dict[str, float]]]], path: Path) -> None:
    """Time and memory against pixels and against frames, a line for each job."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(9, 6.5), layout="constrained")
    axes: Any = drawn.subplots(2, 2, sharex="col", sharey="row")
    for (job, axis), (sizes, values) in found.items():
        column = 0 if axis == "Mpixel" else 1
        for row, name in enumerate(("s", "mib")):
            axes[row, column].loglog(sizes, [value[name] for value in values], "o-", label=job)
            axes[row, column].set_yscale("log" if name == "s" else "linear")
        axes[1, column].set_xlabel("pixels of 32 frames / Mpixel" if column == 0 else "frames of 240 x 320")
    for ax in axes[1]:
        ax.axhline(1024, color="0.5", ls=":")
        ax.set_ylim(0, 1200)
    axes[0, 0].set_ylabel("time / s")
    axes[1, 0].set_ylabel("peak memory / MiB")
    axes[0, 0].legend()
    drawn.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("build/scaling"))
    parser.add_argument("--only", default=",".join(JOBS), help=f"of {', '.join(JOBS)}")
    parser.add_argument("--largest", type=int, default=700, help="Mpixel")
    parser.add_argument("--figure", type=Path, help="where to draw the figure")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    parser.add_argument("--file", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.job:
        print(json.dumps(measure(arguments.job, arguments.file)))
        return
    by_pixels = {
        float(size): capture_of(arguments.folder, FOUR_S, 8, shape)
        for size, shape in BY_PIXELS.items()
        if size <= arguments.largest
    }
    by_frames = {float(n): capture_of(arguments.folder, TWO_S, n // 2, FRAME) for n in BY_FRAMES}
    hsnoise.fit(np.load(by_pixels[1.0]), exposure_s=FOUR_S, **CAPTURE).params.save(arguments.folder / "model.json")
    found = {}
    for job in arguments.only.split(","):
        for axis, paths in (("Mpixel", by_pixels), ("frames", by_frames)):
            values = [measured(job, path) for path in track(list(paths.values()), description=f"{job}, {axis}")]
            found[job, axis] = list(paths), values
    sheet = Sheet("Growth", ("job", "of", "time / s", "memory / MiB", "exponent"), left=2)
    for (job, axis), (sizes, values) in found.items():
        seconds = ", ".join(f"{size:g}: {value['s']:.1f}" for size, value in zip(sizes, values, strict=True))
        mib = ", ".join(f"{value['mib']:.0f}" for value in values)
        growth = exponent(sizes, [value["s"] for value in values])
        sheet.rows.append((job, axis, seconds, mib, f"{growth:.2f}"))
    Console().print(sheet.rich())
    if arguments.figure:
        figure(found, arguments.figure)


if __name__ == "__main__":
    main()
