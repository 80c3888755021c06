"""The code in the documentation runs as it stands."""

from __future__ import annotations

import re
import sys
import types
from pathlib import Path

import jax
import numpy as np
import pytest

import hsnoise

DOCS = Path(__file__).parent.parent / "docs"


def code_of(page: str) -> str:
    return "\n".join(re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), re.DOTALL))


def test_page_on_effects_of_ones_own_runs(capsys, monkeypatch):
    code = code_of("add-an-effect.md")
    assert "class DiagonalStreaks" in code
    page = types.ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", page)
    exec(compile(code, "add-an-effect.md", "exec"), page.__dict__)
    assert "error" in capsys.readouterr().out


def test_page_on_sampling_runs_and_finds_the_numbers():
    page = {"__name__": "page"}
    exec(compile(code_of("sampling.md"), "sampling.md", "exec"), page)
    assert page["dark_current"] == pytest.approx(118, rel=0.1)
    assert page["read_noise"] == pytest.approx(2.33, rel=0.1)
    np.testing.assert_array_equal(page["counts"], hsnoise.sample(jax.random.key(0), page["clean"], page["camera"]))
