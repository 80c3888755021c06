"""Threads and processes: the same numbers as one fit after the other, or a refusal, but never a wait without end."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import pytest

import hsnoise

ROOT = Path(__file__).parents[1]
WAIT_S = 60.0
SCRIPT = """
import sys, multiprocessing
import jax, numpy as np, hsnoise

def capture(seed):
    rng = np.random.default_rng(seed)
    electrons = [rng.poisson(80 * t, (4, 32, 48)) + rng.normal(0, 3, (4, 32, 48)) for t in (0.1, 0.4)]
    counts = np.rint(100 + 1.5 * np.array(electrons)).astype(np.uint16)
    return hsnoise.FrameStack(counts, (0.1, 0.4), black_level=100, white_level=4095, cfa="mono", shutter="global")

def table(seed):
    return {name: (float(value), float(error)) for name, (value, error, _) in hsnoise.fit(capture(seed)).table.items()}

if __name__ == "__main__":
    here = [table(seed) for seed in (0, 1)]
    with multiprocessing.get_context(sys.argv[1]).Pool(1) as pool:
        assert pool.map(table, (0, 1)) == here
    print("the same")
"""


def capture(seed: int) -> hsnoise.FrameStack:
    """Darks whose pixels differ."""
    rng = np.random.default_rng(seed)
    rate, offset, counts = 300 * rng.lognormal(0, 0.6, (48, 64)), rng.normal(0, 6, (48, 64)), []
    for exposure_s in (0.02, 0.1, 0.4):
        electrons = rng.poisson(rate * exposure_s, (6, 48, 64)) + rng.normal(0, 4, (6, 48, 64))
        counts.append(np.clip(np.rint(100 + offset + 1.5 * electrons), 0, 4095).astype(np.uint16))
    known = {"black_level": 100, "white_level": 4095, "cfa": "mono", "shutter": "global"}
    return hsnoise.FrameStack(counts, (0.02, 0.1, 0.4), **known)


def fitted(stack: hsnoise.FrameStack, method: str) -> dict:
    """Value and error of each parameter; texts, as NaN equals nothing."""
    return {
        name: (repr(value), repr(error)) for name, (value, error, _) in hsnoise.fit(stack, method=method).table.items()
    }


@pytest.mark.parametrize("method", [*(pytest.param(one, marks=pytest.mark.slow) for one in ("ml", "line")), "transfer"])
def test_fits_in_threads_are_those_of_one_after_the_other(method):
    stacks = [capture(seed) for seed in (0, 1)]
    with ThreadPoolExecutor(2) as pool:  # first, so that all compile at once
        at_once = list(pool.map(lambda stack: fitted(stack, method), stacks))
    assert at_once == [fitted(stack, method) for stack in stacks]
    assert at_once[0] != at_once[1]


@pytest.mark.parametrize("method", ["spawn", "forkserver"])
@pytest.mark.slow
def test_fits_in_processes_are_those_of_this_one(method, tmp_path):
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {method} here")
    (tmp_path / "script.py").write_text(SCRIPT)
    run = subprocess.run(
        [sys.executable, str(tmp_path / "script.py"), method],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert (run.returncode, run.stdout) == (0, "the same\n"), run.stderr


def in_a_fork(work) -> str:
    """What work says in a process that is forked from this one, in which JAX has started."""
    jax.block_until_ready(jax.numpy.zeros(1))
    receiver, sender = multiprocessing.Pipe(duplex=False)

    def run() -> None:
        try:
            sender.send(str(work()))
        except RuntimeError as error:
            sender.send(f"RuntimeError: {error}")

    process = multiprocessing.get_context("fork").Process(target=run, daemon=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # JAX and Python warn of forks
        process.start()
    try:
        assert receiver.poll(WAIT_S), "it waits for ever"
        return receiver.recv()
    finally:
        process.kill()
        process.join()


CAMERA = hsnoise.cameras.grasshopper3()
FORKED = {
    "fit": lambda: hsnoise.fit(capture(0)),
    "compare": lambda: hsnoise.compare(CAMERA, capture(0)),
    "diagnose": lambda: hsnoise.diagnose(CAMERA, capture(0)),
    "improve": lambda: hsnoise.improve(capture(0)),
    "sample": lambda: hsnoise.sample_dark(0, 1, (8, 8), CAMERA),
}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.parametrize("name", FORKED)
def test_a_fork_of_a_process_in_which_jax_runs_is_refused(name):
    said = in_a_fork(FORKED[name])
    assert said.startswith("RuntimeError: this process was forked after JAX had started") and '"spawn"' in said


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_what_needs_no_jax_works_in_a_fork():
    assert "A fit makes sense" in in_a_fork(lambda: hsnoise.inspect(capture(0)).conclusion)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.slow
def test_a_fork_before_jax_starts_works():
    code = (
        SCRIPT.split("if __name__")[0]
        + "with multiprocessing.get_context('fork').Pool(1) as p: print(p.map(table, [0]))"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert run.returncode == 0 and "read_noise.sigma" in run.stdout, run.stderr
