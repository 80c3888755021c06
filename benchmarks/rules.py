"""The thresholds of `hsnoise.criticism.rules` that can be derived, derived again from clean captures.

    python -m benchmarks.rules
    python -m benchmarks.rules --camera canon --captures 200

Captures in which nothing is missing are drawn from a camera of the paper, and judged as `compare` and `diagnose` judge:
their errors, the normal score of their worst group of statistics, and the best score of any candidate. The table shows
what stands in rules.py beside what these captures give.
"""

from __future__ import annotations

import argparse

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.stats import norm

import hsnoise
from hsnoise._core.keys import named_key
from hsnoise.criticism import rules
from hsnoise.criticism.candidates import built_in, facts_of
from hsnoise.criticism.fingerprint import Bench
from hsnoise.criticism.ranking import GRID
from hsnoise.criticism.search import GLANCE, GLANCE_DETAILS
from hsnoise.simulation.draws import draw_capture
from hsnoise.simulation.gaussian import shrunk
from hsnoise.simulation.portion import Portion
from hsnoise.simulation.reference import misfits
from hsnoise.simulation.simulator import Purpose, Simulator, key_for

CAMERAS = {"canon": hsnoise.cameras.canon_5d3, "grasshopper": hsnoise.cameras.grasshopper3}
EXPOSURE_S, FRAMES, SHAPE = (0.02, 0.05, 0.1, 0.2), 8, (96, 128)
DRAWS = 64  # of the model, as `diagnose` takes


def clean_portion(model: hsnoise.NoiseModel, seed: int) -> Portion:
    """A capture of the model, in which nothing is missing."""
    empty = np.zeros((len(EXPOSURE_S), FRAMES, *SHAPE), np.uint16) + np.arange(SHAPE[1], dtype=np.uint16)
    like = hsnoise.FrameStack(empty, EXPOSURE_S, cfa=model.cfa, shutter=model.shutter)
    return Portion.of(draw_capture(named_key(key_for(seed, Purpose.CHANCE), "clean"), model, like))


def measured(model: hsnoise.NoiseModel, captures: int, seed: int) -> dict[str, np.ndarray]:
    """Of clean captures [capture]: error, largest |z|, normal score of the worst group, best score in nats."""
    portion = clean_portion(model, seed)
    bench = Bench.of(Simulator(model, portion, key_for(seed, Purpose.DIAGNOSE)), DRAWS)
    null = shrunk(bench.base.own_z(), bench.slopes())
    makers = built_in(facts_of(model, portion, seed))
    prints = bench.fingerprints({name: (maker, GLANCE) for name, maker in makers.items()}, GLANCE_DETAILS)
    fresh = Simulator(model, portion, key_for(seed, Purpose.CHANCE)).draws(model, captures)
    z, groups = bench.base.z(fresh), bench.base.groups
    typical = np.median([max(misfits(one, groups).values()) for one in bench.base.own_z()])
    nothing = null.log_density(z)
    scores = [of.distribution(float(a), null).log_density(z) - nothing for of in prints for a in GRID[::2]]
    return {
        "candidates": np.array(len(makers)),
        "groups": np.array(len(set(groups))),
        "error": np.array([max(misfits(one, groups).values()) for one in z]) / typical,
        "max_z": np.abs(z).max(1),
        "misfit": np.array([max(null.normal_scores(one, groups).values()) for one in z]),
        "score": np.max(scores, 0),
    }


def derived(found: dict[str, np.ndarray]) -> list[tuple[str, float, str]]:
    """Name of a rule, what stands there, and what the captures give, in words."""
    groups, candidates = int(found["groups"]), int(found["candidates"])
    limit = rules.evidence(candidates)
    return [
        ("FITS", rules.FITS, f"99 % of right models are below {np.quantile(found['error'], 0.99):.2f}"),
        (
            "MAX_Z",
            rules.MAX_Z,
            f"99 % of right models are below {np.quantile(found['max_z'], 0.99):.2f}; the largest is"
            f" {found['max_z'].max():.2f}",
        ),
        (
            "MISFIT_LEFT",
            rules.MISFIT_LEFT,
            f"99.5 % below {np.quantile(found['misfit'], 0.995):.2f}; of {groups} independent normal groups"
            f" {norm.isf(0.005 / groups):.2f}",
        ),
        (
            "MISFIT",
            rules.MISFIT,
            f"largest {found['misfit'].max():.2f}; of {groups} independent normal groups, one in ten thousand"
            f" {norm.isf(1e-4 / groups):.2f}",
        ),
        (
            f"evidence({candidates})",
            limit,
            f"exceeded by {100 * np.mean(found['score'] > limit):.1f} % (Markov's inequality: at most"
            f" {100 * rules.FALSE_ALARM_RATE:.0f} %); 99 % below {np.quantile(found['score'], 0.99):.2f} nats",
        ),
        ("AMBIGUOUS", rules.AMBIGUOUS, "log 20: odds of 20 to 1"),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--camera", choices=CAMERAS, action="append", help="default: both")
    parser.add_argument("--captures", type=int, default=200, help="clean captures of each camera (default 200)")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    table = Table("camera", "rule", "stands", "clean captures give")
    for name in arguments.camera or CAMERAS:
        for rule, value, words in derived(measured(CAMERAS[name](), arguments.captures, arguments.seed)):
            table.add_row(name, rule, f"{value:.2f}", words)
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
