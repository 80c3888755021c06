"""State has names: nowhere is it read back from our own sentences and names."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import hsnoise
from hsnoise.criticism.outcomes import Ended, Refused, Verdict
from hsnoise.criticism.sentences import ENDED_IN_SHORT, REFUSED
from hsnoise.fitting.result import OUTCOMES, TITLES, Method, Status

ROOT = Path(hsnoise.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
READING = {
    *("startswith", "endswith", "removeprefix", "removesuffix"),
    *("partition", "rpartition", "split", "rsplit"),
    *("match", "fullmatch", "search", "findall", "finditer"),
}
# What others wrote has to be read: modules (or folders) and what they read.
READERS = {
    "_core/parsing.py": "words of the command line",
    "cli/compiled.py": "what Linux says of the processor",
    "cli/main.py": "errors of other libraries, put on one line",
    "effects/_base.py": "docstrings, those of users' effects too",
    "enhance/training/clips.py": "names of users' files",
    "enhance/training/options.py": "words of the command line",
    "enhance/training/vgg.py": "names in files of weights",
    "enhance/video.py": "names and headers of files",
    "enhance/weights.py": "files of weights",
    "frames/io": "files, their names and headers",
    "frames/lazy.py": "names of files",
    "frames/reading.py": "names of other libraries",
    "report/_figures.py": "SVG that Matplotlib wrote",
}


def modules_of(tree: ast.Module) -> set[str]:
    """Names under which a file has modules: `np`, `jax`; a method of theirs that is called split is no string's."""
    found = {"re"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {(name.asname or name.name).split(".")[0] for name in node.names}
    return found - {"re"}


def root_of(node: ast.expr) -> str:
    """`jax` of jax.random; empty for what is no plain name with attributes."""
    while isinstance(node, ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def readings(source: str) -> list[str]:
    """Calls that take a text apart or look into it."""
    tree = ast.parse(source)
    modules = modules_of(tree) - {"re"}
    calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
    methods = [func for func in calls if isinstance(func, ast.Attribute) and func.attr in READING]
    found = [f"line {func.lineno}: {func.attr}" for func in methods if root_of(func.value) not in modules]
    imported = [node for node in ast.walk(tree) if isinstance(node, ast.Import)]
    return found + [f"line {one.lineno}: import re" for one in imported if "re" in {name.name for name in one.names}]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_is_read_back_from_a_sentence_or_a_name(path):
    inside = path.relative_to(ROOT)
    if {str(one) for one in (inside, *inside.parents)} & set(READERS):
        return
    assert not readings(path.read_text()), "give it a name or a number instead; who reads what others wrote: READERS"


@pytest.mark.parametrize("name", READERS)
def test_those_who_may_read_do(name):
    paths = [path for path in FILES if path.relative_to(ROOT).is_relative_to(name)]
    assert any(readings(path.read_text()) for path in paths), f"take {name} out of READERS"


def test_what_reads_a_text_is_found():
    assert readings("import numpy as np\nnp.split(x, 3)\njax.random.split(key)") == ["line 3: split"]
    assert readings("import re\nx.outcome.startswith('NOT')") == ["line 2: startswith", "line 1: import re"]


def test_every_outcome_has_its_words():
    assert set(OUTCOMES) == set(Status) and set(TITLES) == set(Method)
    assert set(ENDED_IN_SHORT) == set(Ended) and set(REFUSED) == set(Refused)
    assert Verdict.NAMED == "named" and f"{Verdict.NOTHING_MISSING}" == "nothing missing"
