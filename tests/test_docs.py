"""The code in the documentation runs as it stands."""

from __future__ import annotations

import re
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
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
    said = capsys.readouterr().out
    assert "Missing: diagonal_streaks" in said and "synthetic likelihood" in said
    value, error, _ = page.again.table["diagonal_streaks.sigma"]
    assert abs(value - 1.2) < 4 * error


def test_page_on_sampling_runs_and_finds_the_numbers():
    page = {"__name__": "page"}
    exec(compile(code_of("sampling.md"), "sampling.md", "exec"), page)
    assert page["dark_current"] == pytest.approx(118, rel=0.1)
    assert page["read_noise"] == pytest.approx(2.33, rel=0.1)
    np.testing.assert_array_equal(page["counts"], hsnoise.sample(jax.random.key(0), page["clean"], page["camera"]))


def test_pytorch_takes_the_draws_without_a_copy():
    torch = pytest.importorskip("torch")
    (block,) = [
        b
        for b in re.findall(r"```python notest\n(.*?)```", (DOCS / "sampling.md").read_text(), re.DOTALL)
        if "torch" in b
    ]
    page = {"jax": jax, "jnp": jnp, "hsnoise": hsnoise, "camera": hsnoise.cameras.grasshopper3()}
    exec(compile(block, "sampling.md", "exec"), page)
    light = torch.full((2, 32, 64), 3.0)
    drawn = page["noisy"](1, light)
    assert drawn.shape == light.shape and drawn.dtype == torch.float32
    expected = hsnoise.sample(jax.random.key(1), np.full((2, 32, 64), 3.0, np.float32), page["camera"])
    np.testing.assert_array_equal(drawn.numpy(), np.asarray(expected, np.float32))
    # The same memory on both sides.
    array = jax.dlpack.from_dlpack(light)
    assert array.unsafe_buffer_pointer() == light.data_ptr()
    assert torch.from_dlpack(array).data_ptr() == array.unsafe_buffer_pointer()
    # In a training loop: the loss of a network on fresh noise falls.
    torch.manual_seed(0)
    network, losses = torch.nn.Conv2d(1, 1, 5, padding=2), []
    optimiser = torch.optim.Adam(network.parameters(), 1e-2)
    for step in range(30):
        loss = ((network(page["noisy"](step, light)[:, None])[:, 0] - light) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.2 * losses[0]


def test_page_on_the_enhancer_runs():
    page = {"__name__": "page"}
    exec(compile(code_of("enhancer.md"), "enhancer.md", "exec"), page)
    assert page["enhanced"].shape == (48, 64, 3) and np.isfinite(page["enhanced"]).all()
