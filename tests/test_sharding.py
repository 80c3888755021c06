"""The same draws whatever the batch; the same draws and the same likelihood on one device and on eight."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from hsnoise.effects import ColumnNoise, RowNoise, SharedRowGain
from hsnoise.model import sample
from hsnoise.simulation.cameras import canon_5d3

PROGRAM = """
import hashlib, json, sys
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P
import hsnoise

devices = jax.devices()
assert len(devices) == int(sys.argv[1]), devices
mesh = Mesh(np.array(devices), ("frames",))
model = hsnoise.cameras.canon_5d3(black_level_dn=32).add(hsnoise.effects.HotPixels(0.01, 300.0))
model = model.add(hsnoise.effects.RowNoise(1.0, 1.0))
clean = np.linspace(0, 40, 16 * 128 * 64, dtype=np.float32).reshape(16, 128, 64)
spread = jax.device_put(clean, NamedSharding(mesh, P("frames")))
whole = jax.device_put(clean, NamedSharding(mesh, P(None, "frames")))
draw = jax.jit(lambda key, clean: hsnoise.sample(key, clean, model.remove("adc")))  # no rounding hides a difference
drawn = [draw(jax.random.key(3), light) for light in (spread, whole)]
assert np.array_equal(*drawn)
darks = np.asarray(hsnoise.sample_dark(jax.random.key(4), 8, (24, 40), model.remove("hot_pixels").remove("row_noise")))
base = hsnoise.cameras.canon_5d3(black_level_dn=32)
value = hsnoise.log_likelihood(base, darks, exposure_s=0.05, black_level=32, cfa="RGGB")
print(json.dumps({
    "devices": len(drawn[0].sharding.device_set), "likelihood": float(value),
    "drawn": hashlib.sha256(np.asarray(drawn[0]).tobytes()).hexdigest(),
}))
"""


def on(devices: int) -> dict:
    flags = f"--xla_force_host_platform_device_count={devices}"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(devices)], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize(
    "effects",
    [
        (),
        pytest.param((SharedRowGain(0.1),), marks=pytest.mark.slow),
        pytest.param((RowNoise(1.0, 1.0), ColumnNoise(1.0, 1.0, after_gain=True)), marks=pytest.mark.slow),
    ],
    ids=len,
)
def test_draws_do_not_depend_on_the_batch(effects):
    model = canon_5d3().remove("adc")  # no rounding hides a difference in the last bit
    for effect in effects:
        model = model.add(effect)
    light = np.random.default_rng(0).uniform(0.5, 50, (16, 64, 64)).astype(np.float32)
    with jax.enable_x64(False):  # as users draw; JAX 0.12 computes single frames of float64 differently in the last bit
        whole = sample(jax.random.key(3), light, model)
        for frames in (1, 2, 5):
            np.testing.assert_array_equal(sample(jax.random.key(3), light[:frames], model), whole[:frames])
        square = sample(jax.random.key(3), light.reshape(4, 4, 64, 64), model)
    np.testing.assert_array_equal(square.reshape(whole.shape), whole)


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_devices():
    one, eight = on(1), on(8)
    assert (one["devices"], eight["devices"]) == (1, 8)
    assert one["drawn"] == eight["drawn"]
    assert eight["likelihood"] == pytest.approx(one["likelihood"], rel=1e-10)
