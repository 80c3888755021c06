"""The notebook of the first hour."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow  # tests/test_docs.py runs its cells on smaller frames
def test_the_notebook_runs_from_top_to_bottom(tmp_path):
    """In a process of its own, as a user's; it writes its frames into the fresh folder."""
    notebook = ROOT / "docs" / "first-hour.ipynb"
    code = f"""
import nbformat, nbclient
notebook = nbformat.read({str(notebook)!r}, as_version=4)
nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
nbformat.write(notebook, "run.ipynb")
"""
    kernel = {
        "JUPYTER_PLATFORM_DIRS": "1",
        "PYTHONPATH": str(ROOT),
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache"),
    }
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, **kernel}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    cells = [cell for cell in nbformat.read(tmp_path / "run.ipynb", as_version=4).cells if cell.cell_type == "code"]
    shown = {kind for cell in cells for one in cell.outputs for kind in one.get("data", {})}
    assert {"text/html", "image/png"} <= shown
    printed = "".join(one.text for cell in cells for one in cell.outputs if one.output_type == "stream")
    before, after = map(float, re.search(r"error (\S+) before, (\S+) after", printed).groups())
    assert after < before / 10


INTERRUPTED = '''
import random, sys, time
from jupyter_client.manager import start_new_kernel

CAPTURE = """
import numpy as np, hsnoise
rng = np.random.default_rng(0)
rate, offset, counts = 300 * rng.lognormal(0, 0.6, (48, 64)), rng.normal(0, 6, (48, 64)), []
for exposure_s in (0.02, 0.1, 0.4):
    electrons = rng.poisson(rate * exposure_s, (6, 48, 64)) + rng.normal(0, 4, (6, 48, 64))
    counts.append(np.clip(np.rint(100 + offset + 1.5 * electrons), 0, 4095).astype(np.uint16))
stack = hsnoise.FrameStack(counts, (0.02, 0.1, 0.4), black_level=100, white_level=4095, shutter="global")
"""
FIT = "print(sorted((name, repr(row[0])) for name, row in hsnoise.fit(stack).table.items()))"
JOBS = ("hsnoise.fit(stack)", "hsnoise.improve(stack)", "hsnoise.diagnose(hsnoise.fit(stack), stack)")
manager, client = start_new_kernel(kernel_name="python3")


def ran(code, *interrupted_after_s):
    client.execute(code)
    for seconds in interrupted_after_s:
        time.sleep(seconds)
        manager.interrupt_kernel()
    printed, failed = "", None
    while True:
        message = client.get_iopub_msg(timeout=120)
        kind, content = message["header"]["msg_type"], message["content"]
        printed += content["text"] if kind == "stream" else ""
        failed = content["ename"] if kind == "error" else failed
        of = message["parent_header"].get("msg_type")
        if kind == "status" and content["execution_state"] == "idle" and of == "execute_request":
            return printed, failed


try:
    assert ran(CAPTURE) == ("", None)
    rng, stopped = random.Random(1), 0
    for job in JOBS * 3:
        _, failed = ran(job, rng.uniform(0.02, 2.0), rng.uniform(0.0, 0.3))
        assert failed in (None, "KeyboardInterrupt"), (job, failed)
        stopped += failed is not None
    assert stopped
    after = ran(FIT)
    manager.restart_kernel()
    client.wait_for_ready(timeout=60)
    assert ran(CAPTURE) == ("", None)
    assert after == ran(FIT) and after[1] is None and "gain" in after[0]
finally:
    manager.shutdown_kernel(now=True)
'''


@pytest.mark.slow
def test_a_kernel_that_is_interrupted_twice_goes_on_and_fits_the_same(tmp_path):
    kernel = {"JUPYTER_PLATFORM_DIRS": "1", "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", INTERRUPTED]
    done = subprocess.run(words, cwd=tmp_path, env={**os.environ, **kernel}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
