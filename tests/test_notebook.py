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
