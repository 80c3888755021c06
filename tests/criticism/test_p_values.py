"""p-values of `compare` are those that it prints: uniform for captures of the model itself."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.stats import kstest

import hsnoise

CAPTURES, DRAWS, EXPOSURES_S = 60, 24, (0.05, 0.2)


@pytest.mark.slow
def test_right_models_have_uniform_p_values():
    camera = hsnoise.cameras.grasshopper3(black_level_dn=64)
    found = []
    for seed in range(CAPTURES):
        keys = jax.random.split(jax.random.key(seed), len(EXPOSURES_S))
        counts = [
            np.asarray(hsnoise.sample_dark(key, 6, (48, 64), camera, exposure_s=t, sensor_key=seed))
            for key, t in zip(keys, EXPOSURES_S, strict=True)
        ]
        stack = hsnoise.FrameStack(counts, EXPOSURES_S, cfa="RGGB", shutter="global")
        one = hsnoise.compare(camera, stack, draws=DRAWS, seed=1000 + seed)
        found.append((one.p_value, one.max_z_p_value))
    ranks = np.array(found) - 0.5 / (DRAWS + 1)  # steps of 1 / (draws + 1), at their middle
    for values in ranks.T:
        assert kstest(values, "uniform").pvalue > 0.01
        assert abs(values.mean() - 0.5) < 4 / np.sqrt(12 * CAPTURES)
