"""Every threshold of the loop has its reason, and there are few of them."""

from __future__ import annotations

import ast
import io
import math
import tokenize
from pathlib import Path

import numpy as np
import pytest

from hsnoise.criticism import rules
from hsnoise.criticism.compare import Comparison

MOST_NUMBERS = 40
SOURCE = Path(rules.__file__).read_text()
TREE = ast.parse(SOURCE)
ASSIGNED = [node for node in TREE.body if isinstance(node, ast.Assign | ast.AnnAssign)]
COMMENTS = {
    token.start[0]: token.string.lstrip("# ")
    for token in tokenize.generate_tokens(io.StringIO(SOURCE).readline)
    if token.type == tokenize.COMMENT
}


def names_of(node: ast.stmt) -> list[str]:
    """The names that an assignment binds."""
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    return [one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]


def numbers_in(node: ast.AST) -> list[float]:
    """The numbers that are written in it."""
    constants = [one.value for one in ast.walk(node) if isinstance(one, ast.Constant)]
    return [value for value in constants if isinstance(value, int | float) and not isinstance(value, bool)]


def test_there_are_few_numbers():
    numbers = [number for node in ASSIGNED for number in numbers_in(node.value)]
    assert 10 < len(numbers) <= MOST_NUMBERS


@pytest.mark.parametrize("node", ASSIGNED, ids=lambda node: ", ".join(names_of(node)))
def test_every_rule_has_a_reason(node):
    """In a comment beside it, or in the lines above."""
    reason = COMMENTS.get(node.end_lineno) or COMMENTS.get(node.lineno - 1, "")
    assert len(reason.split()) >= 4, f"say why: {', '.join(names_of(node))}"


def test_every_function_of_rules_says_why():
    functions = [node for node in TREE.body if isinstance(node, ast.FunctionDef)]
    assert functions and all(ast.get_docstring(node) for node in functions)


@pytest.mark.parametrize("name", [name for node in ASSIGNED for name in names_of(node)])
def test_every_rule_is_followed(name):
    """By the loop, or by another rule."""
    package = Path(rules.__file__).parents[1]
    used = any(f"rules.{name}" in path.read_text() for path in package.rglob("*.py"))
    loads = [one for one in ast.walk(TREE) if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Load)]
    assert used or name in {one.id for one in loads}


@pytest.mark.parametrize(("error", "fits"), [(1.0, True), (1.99, True), (rules.FITS, False), (30.0, False)])
def test_there_is_one_definition_of_a_model_that_fits(error, fits):
    found = Comparison(error, {"tails": error}, (), (), 0.5, math.nan, ())
    assert found.fits is fits and (found.conclusion.light == "green") is fits


@pytest.mark.parametrize("candidates", [1, 5, 24])
def test_one_of_so_many_candidates_seldom_has_the_evidence_by_chance(candidates):
    rng = np.random.default_rng(candidates)
    z, sizes = rng.standard_normal((100_000, candidates)), rng.uniform(0.5, 5.0, candidates)
    ratios = (sizes * z - sizes**2 / 2).max(1)  # of Normal(size, 1) against Normal(0, 1)
    assert np.mean(ratios > rules.evidence(candidates, 0.05)) < 0.05
    assert rules.evidence(candidates) == pytest.approx(math.log(candidates / rules.FALSE_ALARM_RATE))
    assert rules.evidence(candidates, rules.LATER_RATE) > rules.evidence(candidates)
