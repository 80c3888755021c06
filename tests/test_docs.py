"""The code in the documentation runs as it stands."""

from __future__ import annotations

import re
import sys
import types
from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"


def test_page_on_effects_of_ones_own_runs(capsys, monkeypatch):
    code = "\n".join(re.findall(r"```python\n(.*?)```", (DOCS / "add-an-effect.md").read_text(), re.DOTALL))
    assert "class DiagonalStreaks" in code
    page = types.ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", page)
    exec(compile(code, "add-an-effect.md", "exec"), page.__dict__)
    assert "error" in capsys.readouterr().out
