"""How accurate are the fits? RMSE over the Cramer-Rao bound, coverage and bias, for both cameras of the paper.

    python -m benchmarks.calibration --seeds 200

Simulates captures (4 exposures x 8 frames x 160 x 240, Bayer), fits each by maximum likelihood and by the paper's
line, and compares with the truth. Finished seeds are kept in `--out`, so an interrupted run resumes.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from rich.table import Table

import hsnoise
from hsnoise.fit import fit

EXPOSURE_S = (0.02, 0.05, 0.1, 0.2)
FRAMES, SHAPE = 8, (160, 240)
CONFIGURATIONS = {
    "Canon, 1/f rows": lambda: hsnoise.cameras.canon_5d3(),
    "Canon, white rows": lambda: hsnoise.cameras.canon_5d3(shutter="global"),
    "Grasshopper, white rows": lambda: hsnoise.cameras.grasshopper3(black_level_dn=64),
    "Grasshopper, 1/f rows": lambda: hsnoise.cameras.grasshopper3(black_level_dn=64, shutter="rolling"),
}


def capture(model: hsnoise.NoiseModel, seed: int) -> hsnoise.FrameStack:
    keys = jax.random.split(jax.random.key(seed), len(EXPOSURE_S))
    counts = [
        np.asarray(hsnoise.sample_dark(key, FRAMES, SHAPE, model, exposure_s=t))
        for key, t in zip(keys, EXPOSURE_S, strict=True)
    ]
    black = np.asarray(model["black_level"].value)
    return hsnoise.FrameStack(np.stack(counts), EXPOSURE_S, black_level=black, cfa=model.cfa, shutter=model.shutter)


def one_seed(model: hsnoise.NoiseModel, seed: int) -> dict:
    """Errors (estimate minus truth) and standard errors of both methods, and the observed information."""
    summary = hsnoise.summarise(capture(model, seed))
    truth = {name: value for name, (value, _, _) in model.table.items()}
    record = {}
    for method in ("ml", "line"):
        result = fit(summary, method=method)
        errors = [result.table[name][0] - truth[name] for name in result.names]
        record[method] = {
            "names": list(result.names),
            "error": errors,
            "standard_error": [result.table[name][1] for name in result.names],
            "covariance": result.covariance.tolist() if method == "ml" else None,
        }
    return record


def run(seeds: int, out: Path) -> dict[str, list[dict]]:
    """Records of all configurations and seeds; those already in `out` are not recomputed."""
    out.parent.mkdir(parents=True, exist_ok=True)
    done = {}
    if out.exists():
        for line in out.read_text().splitlines():
            try:
                record = json.loads(line)
            except ValueError:  # a row that an interruption truncated
                continue
            done[record["configuration"], record["seed"]] = record
    with out.open("a") as file:
        for name, make in CONFIGURATIONS.items():
            model = make()
            for seed in track(range(seeds), description=name, console=Console(stderr=True)):
                if (name, seed) in done:
                    continue
                record = {"configuration": name, "seed": seed, **one_seed(model, seed)}
                file.write(json.dumps(record) + "\n")
                file.flush()
                done[name, seed] = record
    return {name: [done[name, seed] for seed in range(seeds)] for name in CONFIGURATIONS}


def accuracy(records: list[dict]) -> dict[str, dict[str, float]]:
    """For each parameter: bound, RMSE over bound, coverage of 95 % intervals and bias of both methods."""
    names = records[0]["ml"]["names"]
    # The Cramer-Rao bound from the mean observed information.
    information = np.mean([np.linalg.inv(r["ml"]["covariance"]) for r in records], axis=0)
    bound = np.sqrt(np.diagonal(np.linalg.inv(information)))
    rows = {name: {"bound": float(b)} for name, b in zip(names, bound, strict=True)}
    for method in ("ml", "line"):
        error = np.array([r[method]["error"] for r in records])
        standard_error = np.array([r[method]["standard_error"] for r in records])
        ratio = np.sqrt((error**2).mean(0)) / bound
        cover = (np.abs(error) < 1.96 * standard_error).mean(0)
        for i, name in enumerate(names):
            rows[name][f"{method}_ratio"] = float(ratio[i])
            rows[name][f"{method}_cover"] = float(cover[i])
            rows[name][f"{method}_bias"] = float(error[:, i].mean() / bound[i])
    return rows


def print_tables(results: dict[str, dict], seeds: int) -> None:
    console = Console(width=110)
    for name, rows in results.items():
        table = Table(title=f"{name}, {seeds} seeds (in units of the Cramer-Rao bound)", title_justify="left")
        for heading in ("parameter", "bound", "ML RMSE", "ML cover", "ML bias", "line RMSE", "line cover", "line bias"):
            table.add_column(heading, justify="left" if heading == "parameter" else "right")
        for parameter, row in rows.items():
            cells = [f"{row['bound']:.4g}"]
            for method in ("ml", "line"):
                cells += [
                    f"{row[f'{method}_ratio']:.2f}",
                    f"{row[f'{method}_cover']:.1%}",
                    f"{row[f'{method}_bias']:+.2f}",
                ]
            table.add_row(parameter, *cells)
        console.print(table)


def figure(results: dict[str, dict], seeds: int) -> Figure:
    fig = Figure(figsize=(11, 7), layout="constrained")
    axes = fig.subplots(2, 2, sharex=True)
    for axis, (name, rows) in zip(axes.flat, results.items(), strict=True):
        y = np.arange(len(rows))[::-1]
        spread = 1.96 / np.sqrt(2 * seeds)
        axis.axvspan(1 - spread, 1 + spread, color="0.9", label="95 % of unbiased efficient estimators")
        for method, marker, colour, label in (
            ("ml", "o", "#0072b2", "maximum likelihood"),
            ("line", "s", "#d55e00", "line fit"),
        ):
            axis.plot([r[f"{method}_ratio"] for r in rows.values()], y, marker, color=colour, label=label)
        axis.set_yticks(y, list(rows))
        axis.set_xscale("log")
        axis.set_title(name, loc="left")
        axis.grid(axis="x", alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel("RMSE / Cramér–Rao bound")
    axes[0, 0].legend(loc="lower right", fontsize=8)
    ticks = [1, 2, 3, 5, 10]
    axes[0, 0].set_xticks(ticks, [str(t) for t in ticks], minor=False)
    axes[0, 0].minorticks_off()
    return fig


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=32, help="captures for each configuration (default 32)")
    parser.add_argument(
        "--out", type=Path, default=Path("build/calibration.jsonl"), help="where finished seeds are kept"
    )
    parser.add_argument("--figure", type=Path, default=Path("docs/figures/calibration.png"))
    arguments = parser.parse_args()
    if arguments.seeds < 2:
        parser.error("--seeds: expected at least 2")
    records = run(arguments.seeds, arguments.out)
    results = {name: accuracy(r) for name, r in records.items()}
    print_tables(results, arguments.seeds)
    arguments.figure.parent.mkdir(parents=True, exist_ok=True)
    figure(results, arguments.seeds).savefig(arguments.figure, dpi=110)
    print(f"figure: {arguments.figure}")


if __name__ == "__main__":
    main()
