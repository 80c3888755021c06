"""Time and peak memory of fitting a stack that should not be held in memory: 32 frames of 22 Mpixel on disk.

    python -m benchmarks.large_stack

Writes 1.4 GB of simulated raw frames (Canon numbers, four exposures) to `--folder`, once, fits them from the
memory-mapped files, and prints the time of the pass over the pixels and of the fit, and the peak resident memory.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np
from rich.progress import track

import hsnoise
from hsnoise.likelihood.summary import channel_planes

EXPOSURE_S = (0.02, 0.05, 0.1, 0.2)


def simulate(folder: Path, frames: int, shape: tuple[int, int]) -> None:
    """Write one .npy file per exposure, made in blocks of rows with NumPy."""
    camera = hsnoise.cameras.canon_5d3(black_level_dn=128)
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    for e, exposure in enumerate(EXPOSURE_S):
        path = folder / f"dark_{e}.npy"
        if path.exists():
            continue
        partial = path.with_suffix(".partial")
        out = np.lib.format.open_memmap(partial, "w+", np.uint16, (frames, *shape))
        for f in track(range(frames), description=f"simulating {exposure:g} s"):
            electrons = rng.poisson(51.7 * exposure, shape) + np.float32(12.5**0.5) * rng.standard_normal(
                shape, dtype=np.float32
            )
            for c, channel in enumerate(camera.channels):
                spectrum = np.zeros(shape[0] // 2 + 1)
                spectrum[1:] = np.arange(1, len(spectrum)) ** -0.5
                spectrum *= np.sqrt(shape[0] ** 2 / (2 * (spectrum**2).sum()))
                modes = (rng.standard_normal(len(spectrum)) + 1j * rng.standard_normal(len(spectrum))) / np.sqrt(2)
                beta = 1 + float(camera["row_gain"].sigma[c]) * np.fft.irfft(spectrum * modes, shape[0])
                for r, col in channel_planes(camera.cfa, channel):
                    electrons[r::2, col::2] *= np.maximum(beta[r::2, None], 0) * float(camera["gain"].value[c])
            out[f] = np.clip(np.rint(electrons + 128), 0, 65535)
        out.flush()
        partial.rename(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("build/large_stack"))
    parser.add_argument("--frames", type=int, default=8, help="frames of each of the four exposures")
    parser.add_argument("--rows", type=int, default=3840)
    parser.add_argument("--columns", type=int, default=5760)
    parser.add_argument("--simulate-only", action="store_true", help="only write the files")
    arguments = parser.parse_args()
    simulate(arguments.folder, arguments.frames, (arguments.rows, arguments.columns))
    if arguments.simulate_only:
        return
    stack = hsnoise.load(
        [str(arguments.folder / f"dark_{e}.npy") for e in range(len(EXPOSURE_S))],
        exposure_s=EXPOSURE_S,
        black_level=128,
        cfa="RGGB",
        shutter="rolling",
    )
    start = time.perf_counter()
    summary = hsnoise.summarise(stack)
    passed = time.perf_counter()
    print(f"pass over the pixels {passed - start:.1f} s, peak {peak_mib():.0f} MiB", flush=True)
    print(hsnoise.fit(summary))
    fitted, after_one = time.perf_counter(), peak_mib()
    hsnoise.fit(summary)
    again = time.perf_counter() - fitted
    pixels = sum(stack.n_frames) * stack.shape[0] * stack.shape[1]
    print(f"{pixels / 1e6:.0f} Mpixel: pass {passed - start:.1f} s ({pixels / 1e6 / (passed - start):.0f} Mpixel/s),")
    print(f"fit {fitted - passed:.1f} s with compilation, {again:.1f} s compiled;")
    print(f"peak memory {after_one:.0f} MiB, after the second fit {peak_mib():.0f} MiB")


def peak_mib() -> float:
    # Peak of the process's own memory: pages of mapped files belong to the file cache.
    for line in Path("/proc/self/status").read_text().splitlines() if Path("/proc/self/status").exists() else ():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
