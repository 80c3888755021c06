"""On an accelerator: the draws, derivatives, fits and training steps of the processor (`pytest -m gpu`)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hsnoise
from hsnoise.enhance.training.clips import Batch
from hsnoise.enhance.training.noisy import camera_of
from hsnoise.enhance.training.presets import Recipe
from hsnoise.enhance.training.steps import Trainer

pytestmark = pytest.mark.gpu

KEY = jax.random.key(3)
EXPOSURE_S = (0.02, 0.1)


@pytest.fixture(autouse=True, scope="module")
def accelerator():
    if jax.default_backend() == "cpu":
        pytest.skip("no accelerator")


def on_both(run):
    """What `run` gives on the accelerator and on the processor."""
    here = jax.tree.map(np.asarray, run())
    with jax.default_device(jax.devices("cpu")[0]):
        return here, jax.tree.map(np.asarray, run())


@pytest.mark.parametrize("name", ["canon_5d3", "grasshopper3"])
def test_draws_are_those_of_the_processor(name):
    """But for rounding: a quantile next to a step of a Poisson number falls on its other side."""
    camera = getattr(hsnoise.cameras, name)()
    light = np.random.default_rng(0).uniform(0.5, 50, (4, 256, 256)).astype(np.float32)
    here, there = on_both(lambda: hsnoise.sample(KEY, light, camera))
    differ = here != there
    assert differ.mean() < 2e-3
    assert abs(here.astype(float).mean() - there.astype(float).mean()) < 1e-3 * there.mean()


def test_derivatives_are_those_of_the_processor():
    camera = hsnoise.cameras.canon_5d3()
    light = jnp.full((2, 64, 64), 10.0, jnp.float32)

    def slope():
        loss = lambda c: jnp.mean(hsnoise.sample(KEY, light, c, differentiable=True) ** 2)  # noqa: E731
        return jax.tree.leaves(jax.grad(loss)(camera))

    for here, there in zip(*on_both(slope), strict=True):
        np.testing.assert_allclose(here, there, rtol=2e-2, atol=1e-3 * np.abs(there).max())


def test_fits_are_those_of_the_processor():
    camera = hsnoise.cameras.canon_5d3()
    counts = [np.asarray(hsnoise.sample_dark(i, 4, (96, 128), camera, exposure_s=t)) for i, t in enumerate(EXPOSURE_S)]
    stack = hsnoise.FrameStack(counts, EXPOSURE_S, black_level=0, white_level=16383, cfa="RGGB", shutter="rolling")
    here, there = on_both(lambda: {name: row[:2] for name, row in hsnoise.fit(stack).table.items()})
    assert here.keys() == there.keys()
    for name, (value, error) in here.items():
        other = there[name][0]
        assert abs(value - other) <= 1e-2 * error + 1e-9 * abs(other), name


def test_steps_of_training_are_those_of_the_processor():
    camera = camera_of("canon_5d3", None, None)
    rng = np.random.default_rng(0)
    batch = Batch(rng.integers(0, 256, (2, 4, 32, 32, 3), np.uint8), np.full(2, 0.2, np.float32))

    def losses():
        trainer = Trainer(Recipe(maps=8, stride=4), 5, camera, camera.model)
        state, found = trainer.start(0), []
        for number in range(5):
            state, value = trainer.step(state, batch, 0, number)
            found.append(value)
        return jnp.stack(found)

    np.testing.assert_allclose(*on_both(losses), rtol=2e-3)
