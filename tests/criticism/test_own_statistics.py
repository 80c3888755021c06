"""A user's effect may bring a statistic of its own."""

from __future__ import annotations

import importlib
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hsnoise

CAMERA = hsnoise.cameras.grasshopper3(black_level_dn=64)
EXPOSURE_S = (0.02, 0.2)


class ThirdRows(hsnoise.AbstractEffect):
    """An offset of every third row, new in each frame."""

    name: ClassVar[str] = "third_rows"
    stage: ClassVar[hsnoise.Stage] = hsnoise.Stage.READ
    worth: ClassVar[float] = 1.0
    sigma: jax.Array = hsnoise.param("e-", low=0, amplitude=True, doc="standard deviation over rows")

    def sample(self, signal, capture, *, key):
        offset = self.sigma * jax.random.normal(key, (*signal.shape[:2], 1))
        return signal + offset * (jnp.arange(signal.shape[1]) % 3 == 0)[None, :, None]

    @classmethod
    def propose(cls, facts):
        return lambda size, rng: cls(0.5 * size * facts.read_noise_e)

    @classmethod
    def statistics(cls, frames):
        means = frames.mean(2)
        return {"third rows": cls.worth * np.log(means[:, ::3].var() / means[:, 1::3].var())}


@pytest.fixture
def stack(monkeypatch):
    """Frames with the effect, and no built-in candidates."""
    monkeypatch.setattr(importlib.import_module("hsnoise.criticism.diagnose"), "built_in", lambda facts: {})
    truth = CAMERA.add(ThirdRows(1.2))
    counts = [
        np.asarray(hsnoise.sample_dark(3 + i, 6, (48, 64), truth, exposure_s=t)) for i, t in enumerate(EXPOSURE_S)
    ]
    return hsnoise.FrameStack(counts, EXPOSURE_S, black_level=64, cfa="RGGB", shutter="global")


def test_a_statistic_of_its_own_takes_part(stack, monkeypatch):
    """It is off without the effect, and with it there is more evidence than by the common statistics alone."""
    with_it = hsnoise.diagnose(CAMERA, stack, candidates=[ThirdRows], draws=24)
    monkeypatch.setattr(ThirdRows, "statistics", hsnoise.AbstractEffect.__dict__["statistics"])
    without = hsnoise.diagnose(CAMERA, stack, candidates=[ThirdRows], draws=24)
    assert with_it.names == ("third_rows",)
    assert with_it.best.score > without.ranking[0].score + 5


def test_a_statistic_that_is_not_finite_is_named(stack, monkeypatch):
    monkeypatch.setattr(ThirdRows, "worth", np.nan)
    with pytest.raises(ValueError, match="third_rows: expected finite statistics, third rows is nan"):
        hsnoise.diagnose(CAMERA, stack, candidates=[ThirdRows], draws=24)
