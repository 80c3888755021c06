"""How much faster a cluster is: fit, budget, inspect and compare of frames that its workers read.

    python -m benchmarks.cluster                  # one worker, then two, on this machine
    python -m benchmarks.cluster --frames 2500 --read-ms 0 --only fit --workers 2   # 10 000 frames

The frames are simulated when they are read, four exposures of a sensor whose pixels differ, and each read also waits
for `--read-ms`, as a disk would let it. Each frame that is read is counted.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.console import Console

import hsnoise
from benchmarks.hidden_effect import shape as shape_of
from hsnoise._core.sheet import Sheet

EXPOSURE_S = (0.02, 0.1, 0.5, 2.0)
CAPTURE: dict[str, Any] = {"black_level": 100, "white_level": 4095, "cfa": "mono", "shutter": "global"}
JOBS = ("fit", "budget", "inspect", "compare")
GAIN_DN, READ_NOISE_DN, DARK_CURRENT_E = 2.0, 4.0, 15.0


@lru_cache(maxsize=1)
def pixels(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Dark current, e-/s, and offset, DN, of each pixel."""
    rng = np.random.default_rng(0)
    rate_e = (DARK_CURRENT_E / 4) * rng.standard_gamma(4.0, shape, np.float32)
    return rate_e, 2 * rng.standard_normal(shape, np.float32)


def frame(exposure: int, number: int, shape: tuple[int, int], exposure_s: float) -> np.ndarray:
    """Counts [row, column] of a camera whose pixels differ; shot noise is normal, which is faster."""
    rate_e, offset_dn = pixels(shape)
    signal_e = rate_e * np.float32(exposure_s)
    noise = np.random.default_rng([1, exposure, number]).standard_normal(shape, np.float32)
    counts = 100 + offset_dn + GAIN_DN * signal_e + np.sqrt(READ_NOISE_DN**2 + GAIN_DN**2 * signal_e) * noise
    return np.clip(np.rint(counts), 0, 4095).astype(np.uint16)


def read(exposure: int, number: int, shape: tuple[int, int], read_s: float, log: Path) -> np.ndarray:
    """A frame as a block [exposure, frame, row, column]; a byte in `log` tells that it was read."""
    time.sleep(read_s)
    with (log / f"{exposure}_{number}").open("ab") as file:
        file.write(b".")
    return frame(exposure, number, shape, EXPOSURE_S[exposure])[None, None]


def frames_of(frames: int, shape: tuple[int, int], read_s: float, log: Path) -> Any:
    """A Dask array [exposure, frame, row, column] of frames that are made where they are read."""
    import dask
    import dask.array as da

    one = dask.delayed(read, pure=True)
    rows = [
        [da.from_delayed(one(e, f, shape, read_s, log), (1, 1, *shape), np.uint16) for f in range(frames)]
        for e in range(len(EXPOSURE_S))
    ]
    return da.concatenate([da.concatenate(row, axis=1) for row in rows])


def timed(name: str, counts: Any, model: hsnoise.NoiseModel | None, log: Path) -> tuple[Any, float, Counter[int]]:
    """What the job returns, its time in s, and how many frames were read how often."""
    for path in log.iterdir():
        path.unlink()
    stack = hsnoise.FrameStack(counts, exposure_s=EXPOSURE_S, **CAPTURE)
    job = partial(hsnoise.compare, model) if name == "compare" else getattr(hsnoise, name)
    began = time.monotonic()
    found = job(stack)
    took_s = time.monotonic() - began
    return found, took_s, Counter(path.stat().st_size for path in log.iterdir())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", default="1,2", help="processes, by turns (default 1,2)")
    parser.add_argument("--frames", type=int, default=64, help="of each of the four exposures (default 64)")
    parser.add_argument("--shape", type=shape_of, default="160x240", help="rows x columns")
    parser.add_argument("--read-ms", type=float, default=100, help="that a frame takes to be read, beside its making")
    parser.add_argument("--only", default=",".join(JOBS), help=f"of {', '.join(JOBS)}")
    arguments = parser.parse_args()
    from distributed import Client, LocalCluster

    sheet = Sheet("Frames read on a cluster", ("job", "workers", "time / s", "read once, twice, more", "mean"))
    jobs, model = arguments.only.split(","), None
    total = len(EXPOSURE_S) * arguments.frames
    for workers in (int(n) for n in arguments.workers.split(",")):
        with (
            TemporaryDirectory() as folder,
            LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster,
            Client(cluster),
        ):
            counts = frames_of(arguments.frames, arguments.shape, arguments.read_ms / 1e3, Path(folder))
            if model is None and "compare" in jobs:  # and all is compiled and imported
                model = hsnoise.fit(counts, exposure_s=EXPOSURE_S, **CAPTURE).params
            for name in jobs:
                found, took_s, reads = timed(name, counts, model, Path(folder))
                several = sum(n for times, n in reads.items() if times > 2)
                mean = sum(times * n for times, n in reads.items()) / total
                of_frames = f"{reads[1]}, {reads[2]}, {several} of {total}"
                sheet.rows.append((name, str(workers), f"{took_s:.1f}", of_frames, f"{mean:.2f}"))
                if name == "fit":
                    Console().print(str(found.conclusion), markup=False)
    Console().print(sheet.rich())


if __name__ == "__main__":
    main()
