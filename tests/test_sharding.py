"""The same counts and the same likelihood on one device and on eight."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

PROGRAM = """
import json, sys
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P
import hsnoise

devices = jax.devices()
assert len(devices) == int(sys.argv[1]), devices
mesh = Mesh(np.array(devices), ("frames",))
model = hsnoise.cameras.canon_5d3(black_level_dn=32).add(hsnoise.effects.HotPixels(0.01, 300.0))
model = model.add(hsnoise.effects.RowNoise(1.0, 1.0))
clean = np.linspace(0, 40, 16 * 24 * 40, dtype=np.float32).reshape(16, 24, 40)
spread = jax.device_put(clean, NamedSharding(mesh, P("frames")))
counts = jax.jit(lambda key, clean: hsnoise.sample(key, clean, model))(jax.random.key(3), spread)
darks = np.asarray(hsnoise.sample_dark(jax.random.key(4), 8, (24, 40), model.remove("hot_pixels").remove("row_noise")))
base = hsnoise.cameras.canon_5d3(black_level_dn=32)
value = hsnoise.log_likelihood(base, darks, exposure_s=0.05, black_level=32, cfa="RGGB")
print(json.dumps({
    "devices": len(counts.sharding.device_set), "counts": np.asarray(counts).tolist(), "likelihood": float(value)
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


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_devices():
    one, eight = on(1), on(8)
    assert (one["devices"], eight["devices"]) == (1, 8)
    assert one["counts"] == eight["counts"]
    assert eight["likelihood"] == pytest.approx(one["likelihood"], rel=1e-10)
