"""Is the hidden effect found? Fit, compare, diagnose and refit on a grid of simulated dark captures.

    python -m benchmarks.hidden_effect --amplitudes 1,0.5 --seeds 5 --refit
    python -m benchmarks.hidden_effect --effects odd --pairs --triples --improve 5
    python -m benchmarks.hidden_effect --layouts --seeds 10
    python -m benchmarks.hidden_effect --cases FOLDER --refit
    python -m benchmarks.hidden_effect --report-only

Finished cells are rows of `--out` and are not run again, so an interrupted run resumes, and runs with other options add
to one report: tables on the terminal and, beside `--out`, as .md, with a figure as .png.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

import jax
from rich.console import Console
from rich.progress import track

from benchmarks._grid_cells import CLEAN, Cell, case_cells, grid_cells, layout_cells, measure
from benchmarks._grid_tables import draw_detection, sheets
from benchmarks.simulator import CAMERAS, MODEST, ODD, PAIRS, TRIPLES

MOST_MAPS = 50_000  # a Linux process may have 65530 memory maps, and compiled programs use them up


def read(out: Path) -> dict[str, dict]:
    """Records in the file by key; the last of each key counts."""
    records = {}
    for line in out.read_text().splitlines() if out.exists() else ():
        try:
            record = json.loads(line)
        except ValueError:  # a row that an interruption truncated
            continue
        records[record["key"]] = record
    return records


def run(cells: list[Cell], out: Path, refit: bool, improve_minutes: float | None, minutes: float | None) -> None:
    """Measure the cells that `out` lacks; cells without a refit, or a run of `improve`, if that is wanted now."""
    records = read(out)

    def lacks(cell: Cell) -> bool:
        record = records.get(cell.about["key"])
        unimproved = improve_minutes is not None and record is not None and "improved" not in record
        return record is None or (refit and not record["refit"]) or unimproved

    left = [cell for cell in cells if lacks(cell)]
    out.parent.mkdir(parents=True, exist_ok=True)
    end = None if minutes is None else time.monotonic() + 60 * minutes
    with out.open("a") as file:
        if out.stat().st_size and not out.read_bytes().endswith(b"\n"):
            file.write("\n")
        description = f"{len(left)} of {len(cells)} cells"
        for cell in track(left, description=description, console=Console(stderr=True)):
            if end is not None and time.monotonic() > end:
                break
            file.write(json.dumps(measure(cell, refit, improve_minutes), allow_nan=False) + "\n")
            file.flush()
            os.fsync(file.fileno())
            forget_compiled_programs()


def forget_compiled_programs() -> None:
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_text().count("\n") > MOST_MAPS:
        jax.clear_caches()


def report(out: Path) -> None:
    """Write tables of all records in the file, on the terminal and as Markdown, and the figure."""
    records = list(read(out).values())
    if not records:
        raise SystemExit(f"no records in {out}")
    tables = sheets(records)
    console = Console(width=130)
    for sheet in tables:
        console.print(sheet.rich())
    out.with_suffix(".md").write_text("\n".join(sheet.markdown() for sheet in tables))
    written = [out.with_suffix(".md")]
    figure = draw_detection(records)
    if figure is not None:
        figure.savefig(out.with_suffix(".png"), dpi=110)
        written.append(out.with_suffix(".png"))
    print(f"{len(records)} records of {out}; written: {', '.join(map(str, written))}")


def cells_of(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> list[Cell]:
    """The cells that the options select."""
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    if arguments.cases is not None:
        if not (arguments.cases / "answers.json").is_file():
            parser.error(f"--cases: expected a folder with answers.json, got {arguments.cases}")
        return case_cells(arguments.cases)
    if arguments.layouts:
        return layout_cells(seeds)
    groups = {"all": list(MODEST), "none": [CLEAN], "odd": list(ODD)}
    several = arguments.pairs or arguments.triples
    asked = arguments.effects if arguments.effects is not None else [] if several else ["all", "none"]
    effects = [name for word in asked for name in groups.get(word, [word])]
    for option, names, known in (
        ("--effects", effects, [*MODEST, *ODD, CLEAN]),
        ("--cameras", arguments.cameras, CAMERAS),
    ):
        unknown = [name for name in names if name not in known]
        if unknown:
            parser.error(f"{option}: {', '.join(unknown)} not known; expected {', '.join(known)}")
    effects += ["+".join(some) for some in (PAIRS if arguments.pairs else ()) + (TRIPLES if arguments.triples else ())]
    return grid_cells(arguments.cameras, effects, arguments.amplitudes, seeds, arguments.frames, arguments.shape)


def words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def amplitudes(text: str) -> list[float]:
    values = [float(word) for word in words(text)]
    if not values or min(values) <= 0:
        raise argparse.ArgumentTypeError(f"expected positive numbers such as 1,0.5, got {text!r}")
    return values


def shape(text: str) -> tuple[int, int]:
    try:
        rows, columns = (int(word) for word in text.split("x"))
    except ValueError:
        rows = columns = 0
    if min(rows, columns) <= 0 or rows % 2 or columns % 2:
        raise argparse.ArgumentTypeError(f"expected two even numbers such as 160x240, got {text!r}")
    return rows, columns


def folder_of_cases() -> Path:
    """The default folder of `--cases`."""
    return Path(os.environ.get("HSNOISE_SHARED", "shared")) / "cases"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--cameras", type=words, default=["canon", "grasshopper"], help=f"of {', '.join(CAMERAS)}")
    add("--effects", type=words, help="names, all (in the library), odd (not in it), none (clean); default all,none")
    add("--pairs", action="store_true", help="two effects at once, beside those of --effects (default then: none)")
    add("--triples", action="store_true", help="three effects at once, likewise")
    add("--amplitudes", type=amplitudes, default=[1.0], help="1 is a modest real sensor (default 1)")
    add("--seeds", type=int, default=1, help="captures of each kind (default 1)")
    add("--first-seed", type=int, default=0)
    add("--frames", type=int, default=8, help="frames of each of the four exposures (default 8)")
    add("--shape", type=shape, default=(160, 240), help="rows x columns (default 160x240)")
    add("--layouts", action="store_true", help="clean captures of other layouts instead of the grid")
    add("--cases", type=Path, nargs="?", const=folder_of_cases(), help="captures of a folder instead of the grid")
    add("--refit", action="store_true", help="fit again with the effect found, and compare again")
    add("--improve", type=float, metavar="MINUTES", help="run the whole loop, too, with two keys, each for so long")
    add("--minutes", type=float, help="start no new cell after this time")
    add("--out", type=Path, default=Path("build/hidden_effect.jsonl"), help="where finished cells are kept")
    add("--report-only", action="store_true", help="only tables of the records in --out, nothing is run")
    arguments = parser.parse_args()
    if arguments.seeds < 1 or arguments.frames < 1:
        parser.error("--seeds, --frames: expected at least 1")
    if not arguments.report_only:
        run(cells_of(parser, arguments), arguments.out, arguments.refit, arguments.improve, arguments.minutes)
    report(arguments.out)


if __name__ == "__main__":
    main()
