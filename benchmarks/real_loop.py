"""What `improve` makes of real sensors in a few minutes each: python -m benchmarks.real_loop

Their dark frames alone, as `benchmarks.closed` takes them: what was added and the error after each addition, the
largest part of the whole variance and of a component's own that is left, and the change of the likelihood of held-out
frames. Finished sensors are lines of `--out`, and are not run again. Needs the captures of shared/.

    python -m benchmarks.real_loop --minutes 5 --only STL IMX
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console

import hsnoise
from benchmarks._real_folders import data_folder
from benchmarks.closed import SENSORS
from hsnoise._core.sheet import Sheet
from hsnoise.fitting.result import number

HEADINGS = (
    "capture",
    "error after each addition",
    "left of the whole",
    "left of a component",
    "held out, nats",
    "time",
)


def improved(name: str, place: Callable[[Path, Path], None], minutes: float) -> tuple[str, ...]:
    """A row of the table."""
    began = time.perf_counter()
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what loading assumes is no matter here
        place(data_folder(), Path(folder))
        try:
            story = hsnoise.improve(hsnoise.load(folder, progress=False), max_minutes=minutes)
        except (ValueError, RuntimeError) as error:
            return name, f"refused: {error}", "", "", "", _minutes(began)
    steps = [f"{step.added or ''} {number(step.comparison.error)}".strip() for step in story.steps]
    last = story.steps[-1].comparison
    worst, by_itself = last.largest_unexplained, max(last.shares, key=lambda one: one.unexplained, default=None)
    left = "none" if worst is None else f"{worst.component}, {100 * worst.unexplained_of_total:.2g} %"
    alone = (
        "none" if worst is None or by_itself is None else f"{by_itself.component}, {100 * by_itself.unexplained:.2g} %"
    )
    held_out = f"{story.steps[0].held_out:.0f} to {story.steps[-1].held_out:.0f}"
    return name, "; ".join(steps), left, alone, held_out, _minutes(began)


def _minutes(began: float) -> str:
    return f"{(time.perf_counter() - began) / 60:.1f} min"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], metavar="SENSOR", help=", ".join(SENSORS))
    parser.add_argument("--minutes", type=float, default=5.0, help="of improve, for each sensor (default 5)")
    parser.add_argument("--out", type=Path, default=Path("build/real_loop.jsonl"))
    arguments = parser.parse_args()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    lines = map(json.loads, arguments.out.read_text().splitlines()) if arguments.out.exists() else ()
    rows = {row[0]: tuple(row) for row in lines}
    for name, place in SENSORS.items():
        if name in rows or arguments.only and not any(word.lower() in name.lower() for word in arguments.only):
            continue
        Console(stderr=True).print(name)
        rows[name] = improved(name, place, arguments.minutes)
        with arguments.out.open("a") as file:
            file.write(json.dumps(rows[name]) + "\n")
    print(Sheet("improve on dark frames of real sensors", HEADINGS, list(rows.values())).markdown())


if __name__ == "__main__":
    main()
