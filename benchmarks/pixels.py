"""Is the gain right where pixels differ? Simulated sensors, and real ones.

    python -m benchmarks.pixels --seeds 20
    python -m benchmarks.pixels --kinds "CCD warm" Bayer "bias only" --seeds 4
    python -m benchmarks.pixels --real

Sensors of `benchmarks.pixel_simulator` (256 x 384 pixels, no code of hsnoise): eight kinds whose gain follows from the
darks, five from which none does. Finished fits are kept in `--out`, so an interrupted run resumes. With
--real: captures of real sensors, as folders of files, from ../shared/data (or $HSNOISE_SHARED/data).

Like is compared with like. The truth is that of the drawn pixels, not of their distribution. The read noise is the rms
over pixels, like `read_noise.sigma`. Each fit decides where hot pixels begin, and whether a second group of pixels is
hot; the mean dark current over all pixels does not depend on that. So the dark current here is this mean:
`dark_current.rate`, plus `hot_pixels.fraction` times `hot_pixels.rate` if the fitted model has them.
"""

from __future__ import annotations

import argparse
import json
import time
import zlib
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

import hsnoise
from benchmarks._pixel_tables import MEAN_DARK, determined, undetermined
from benchmarks._real_folders import data_folder, real_sensors
from benchmarks.pixel_simulator import DETERMINED, UNDETERMINED, draw

KINDS = DETERMINED | UNDETERMINED
KNOWN = ("exposure_s", "black_level", "white_level", "cfa", "shutter")


def one_fit(kind: str, seed: int, method: str) -> dict:
    """A record of one simulated capture: fit and truth."""
    drawn = draw(KINDS[kind], np.random.default_rng([zlib.crc32(kind.encode()), seed]))
    record = {"kind": kind, "seed": seed, "method": method, "refused": None, "broke": None, "trustworthy": False}
    record |= {"table": {}, "truth": {}, "doubts": []}
    began = time.perf_counter()
    try:
        fit = hsnoise.fit(drawn["counts"], method=method, **{name: drawn[name] for name in KNOWN})
    except np.linalg.LinAlgError as failure:  # a ValueError, but not an intended refusal
        return record | {"broke": str(failure), "seconds": time.perf_counter() - began}
    except ValueError as refusal:
        return record | {"refused": str(refusal), "seconds": time.perf_counter() - began}
    return record | {
        "seconds": time.perf_counter() - began,
        "trustworthy": bool(fit.trustworthy),
        "doubts": list(fit.doubts),
        "table": {name: [float(value), float(error)] for name, (value, error, _) in fit.table.items()}
        | {MEAN_DARK: list(mean_dark_current(fit))},
        "truth": truth_of(kind, drawn),
    }


def mean_dark_current(fit) -> tuple[float, float]:
    """Mean over all pixels and its standard error, e-/s; includes hot pixels if the model has them separately."""
    slopes = {"dark_current.rate": 1.0}
    value = fit.table["dark_current.rate"][0]
    if "hot_pixels" in fit.params.names:
        fraction, rate = (fit.table[f"hot_pixels.{name}"][0] for name in ("fraction", "rate"))
        value += fraction * rate
        slopes |= {"hot_pixels.fraction": rate, "hot_pixels.rate": fraction}
    if np.isnan(value) or "dark_current.rate" not in fit.names:
        return float(value), fit.table["dark_current.rate"][1]
    slope = np.array([slopes.get(name, 0.0) for name in fit.names])
    return float(value), float(np.sqrt(slope @ fit.covariance @ slope))


def truth_of(kind: str, drawn: dict) -> dict[str, float]:
    """Parameter name to the truth of the drawn pixels, without zeros."""
    gains = KINDS[kind].gain_dn_per_e
    names = ["gain"] if len(gains) == 1 else ["gain.R", "gain.G", "gain.B"]
    truth = dict(zip(names, gains, strict=True))
    truth["read_noise.sigma"] = float(np.sqrt((drawn["read_noise_e"] ** 2).mean()))
    truth[MEAN_DARK] = float((drawn["ordinary_e_per_s"] + drawn["hot_e_per_s"]).mean())
    return {name: value for name, value in truth.items() if value > 0}


def kept(out: Path, method: str) -> dict[tuple[str, int], dict]:
    """Records of an earlier run with this method."""
    done = {}
    for line in out.read_text().splitlines() if out.exists() else ():
        try:
            record = json.loads(line)
        except ValueError:  # empty, or truncated by an interruption
            continue
        if record["method"] == method:
            done[record["kind"], record["seed"]] = record
    return done


def fitted(tasks: list[tuple[str, int, str]], workers: int) -> Iterator[dict]:
    """Records of all tasks, in the order in which they finish."""
    if workers == 1:
        yield from (one_fit(*task) for task in tasks)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for future in as_completed([pool.submit(one_fit, *task) for task in tasks]):
            yield future.result()


def run(kinds: list[str], seeds: int, workers: int, method: str, out: Path) -> dict[str, list[dict]]:
    """Records of each kind; those already in `out` are not recomputed."""
    out.parent.mkdir(parents=True, exist_ok=True)
    done = kept(out, method)
    tasks = [(kind, seed, method) for kind in kinds for seed in range(seeds) if (kind, seed) not in done]
    with out.open("a") as file:
        records = fitted(tasks, workers)
        for record in track(records, "Fitting", total=len(tasks), console=Console(stderr=True)):
            file.write("\n" + json.dumps(record))  # ends a row that an interruption truncated
            file.flush()
            done[record["kind"], record["seed"]] = record
    return {kind: [done[kind, seed] for seed in range(seeds)] for kind in kinds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="captures of each kind (default 20)")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS), metavar="KIND")
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--method", choices=("auto", "ml", "line", "transfer"), default="auto")
    parser.add_argument("--out", type=Path, default=Path("build/pixels.jsonl"), help="where finished fits are kept")
    parser.add_argument("--real", action="store_true", help="real sensors instead")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD", help="with --real: only captures whose name contains WORD"
    )
    arguments = parser.parse_args()
    for name in ("seeds", "workers"):
        if getattr(arguments, name) < 1:
            parser.error(f"--{name}: expected at least 1, got {getattr(arguments, name)}")
    console = Console(width=160)
    if arguments.real:
        console.print(real_sensors(data_folder(), arguments.only).rich())
        return
    records = run(arguments.kinds, arguments.seeds, arguments.workers, arguments.method, arguments.out)
    for sheet, kinds in ((determined, DETERMINED), (undetermined, UNDETERMINED)):
        if chosen := {kind: of for kind, of in records.items() if kind in kinds}:
            console.print(sheet(chosen).rich())


if __name__ == "__main__":
    main()
