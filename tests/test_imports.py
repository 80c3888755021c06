"""The import order of the architecture: see docs/architecture.md."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import hsnoise

ROOT = Path(hsnoise.__file__).parent
# A module may import those before it, and its own package.
ORDER = """_core frames effects chain model statistics likelihood lut simulation fitting fit
    stlstm enhance plots criticism report cli __main__""".split()
FILES = [path for path in sorted(ROOT.rglob("*.py")) if path != ROOT / "__init__.py"]


def top(module: str) -> str:
    """hsnoise.frames.io._fits to frames."""
    return module.split(".")[1] if "." in module else module


def imports(path: Path) -> set[str]:
    """Dotted names of the hsnoise modules that a file imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = f"{node.module}"
            found |= {f"hsnoise.{name.name}" for name in node.names} if module == "hsnoise" else {module}
    return {name for name in found if name.split(".")[0] == "hsnoise"}


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).with_suffix("").parts[0]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_only_go_down(path):
    name = name_of(path)
    assert name in ORDER, f"{name}: add it to ORDER where it belongs"
    if name == "cli":  # it sees all public names
        return
    seen = {top(module) for module in imports(path)} - {name}
    above = seen - set(ORDER[: ORDER.index(name)])
    assert not above, f"{path.name} imports {above}"


@pytest.mark.parametrize("path", [p for p in FILES if p.parent.name == "effects" and p.name != "__init__.py"])
def test_effects_never_see_each_other(path):
    within = {module for module in imports(path) if top(module) == "effects"}
    assert within <= {f"hsnoise.effects.{name}" for name in ("_base", "_facts", "_parameters", "_taps")}


def test_model_knows_no_single_effect():
    within = {module for module in imports(ROOT / "model.py") if top(module) == "effects"}
    assert within <= {"hsnoise.effects"}


def test_import_is_light_and_leaves_jax_alone():
    code = """
import sys, jax
before = dict(jax.config.values)
import hsnoise
assert dict(jax.config.values) == before, "import hsnoise changed jax.config"
heavy = {"matplotlib", "rawpy", "astropy", "tifffile", "h5py", "exifread", "PIL", "jinja2", "pandas"} & set(sys.modules)
assert not heavy, heavy
assert set(hsnoise.__all__) <= set(dir(hsnoise))
import hsnoise.cli.main
heavy = {"matplotlib", "optax", "skimage", "av"} & set(sys.modules)
assert not heavy, heavy
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_completion_shows_public_names_only():
    names = dir(hsnoise)
    assert set(names) == {*hsnoise.__all__, "__version__", "plots"} and len(names) == len(set(names))
    assert all(getattr(hsnoise, name) is not None for name in names)
    assert {"fit", "load", "sample", "improve", "cameras", "effects"} <= set(names)
    assert not {"np", "jax", "Any", "annotations", "import_module", "logging", "io", "model"} & set(names)


def test_the_top_floor_is_small():
    entries = {path.name for path in ROOT.iterdir() if path.name != "__pycache__"}
    assert len(entries) <= 20, sorted(entries)


PACKAGES = [path for path in sorted(ROOT.rglob("__init__.py")) if path.parent != ROOT]


@pytest.mark.parametrize("path", PACKAGES, ids=lambda path: str(path.parent.relative_to(ROOT)))
def test_each_package_says_what_it_may_import(path):
    about = ast.get_docstring(ast.parse(path.read_text())) or ""
    assert "import" in about.lower() and len(about.split()) < 80
