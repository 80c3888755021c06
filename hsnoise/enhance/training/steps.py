"""Training steps: noise drawn on the fly, gradient, Adam. A step depends only on the seed and its number."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from hsnoise._core.keys import named_key
from hsnoise.chain.photometry import display_from_linear, light_of_frames
from hsnoise.enhance.training.clips import Batch
from hsnoise.enhance.training.noisy import JITTER, Camera, Shape, jittered, noisy_of
from hsnoise.enhance.training.presets import Recipe
from hsnoise.enhance.training.protocol import unit_of
from hsnoise.model import NoiseModel
from hsnoise.stlstm import STLSTM, State, loss


def batch_rng(seed: int, step: int) -> np.random.Generator:
    """Generator for the crops of one step: a resumed run takes the same crops as an uninterrupted one."""
    return np.random.default_rng([seed, step])


def digest_of(*trees: Any) -> str:
    """A hash of everything in them: structure and numbers."""
    found = hashlib.sha256(str(jax.tree.structure(trees)).encode())
    for leaf in jax.tree.leaves(trees):
        found.update(np.asarray(leaf).tobytes())
    return found.hexdigest()


class Trainer:
    """A network, its optimiser and the jitted step; the state is (network arrays, optimiser state).

    learn: one step on given examples, clean and noisy, as `examples` makes them; returns what `step` does.
    """

    def __init__(
        self,
        recipe: Recipe,
        steps: int,
        camera: Camera,
        noise: NoiseModel,
        perceptual: Callable | None = None,
        jitter: float = JITTER,
    ):
        # Fits use double precision, training does not.
        single = partial(jax.tree.map, lambda leaf: np.asarray(leaf, np.float32))
        self.recipe, self.camera, self.noise = recipe, replace(camera, model=single(camera.model)), single(noise)
        self.perceptual = perceptual
        schedule = optax.cosine_decay_schedule(recipe.rate, steps) if recipe.decay else recipe.rate
        self.optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
        self.sharding = sharding_of_batches()
        learn = self.learner()
        self._step = eqx.filter_jit(partial(_step, learn, jitter, camera.sensor), donate="none")
        self.learn = eqx.filter_jit(learn, donate="none")

    def make(self, key: jax.Array) -> Any:
        """The untrained network."""
        recipe = self.recipe
        return STLSTM(
            key, maps=recipe.maps, kernels=recipe.kernels, stride=recipe.stride, channels=self.camera.channels
        )

    def learner(self) -> Callable:
        """What takes a state, clean and noisy frames to the next state and the loss."""
        return partial(_learn, self.optimiser, self.perceptual, self.recipe)

    def start(self, seed: int) -> tuple[STLSTM, Any]:
        """The untrained network and its optimiser's state."""
        net = self.make(named_key(jax.random.key(seed), "network"))
        return net, self.optimiser.init(eqx.filter(net, eqx.is_array))

    def network(self, state: tuple[STLSTM, Any]) -> STLSTM:
        return state[0]

    def step(self, state: tuple[STLSTM, Any], batch: Batch, seed: int, number: int):
        """State after one more step, and the loss."""
        key = jax.random.fold_in(named_key(jax.random.key(seed), "noise"), number)
        if self.sharding is not None and len(batch.frames) % self.sharding.mesh.size == 0:
            batch = jax.device_put(batch, self.sharding)
        light = jnp.asarray(self.camera.mean_e, jnp.float32)
        return self._step(state, batch, key, self.camera.model, self.noise, light)


def sharding_of_batches() -> jax.sharding.NamedSharding | None:
    """Examples spread over all devices; None if there is only one."""
    devices = np.array(jax.devices())
    if len(devices) == 1:
        return None
    return jax.sharding.NamedSharding(jax.sharding.Mesh(devices, "example"), jax.sharding.PartitionSpec("example"))


def _step(learn, jitter, sensor, state, batch, key, camera, noise, light):
    return learn(state, *examples(batch, key, camera, noise, light, jitter, sensor))


def _learn(optimiser, perceptual, recipe, state, clean, noisy):
    net, memory = state
    before, frames = jnp.split(noisy.swapaxes(0, 1), [recipe.warm_up])
    start = _half_warm(net, before) if recipe.warm_up else None

    def value_of(net: STLSTM) -> jax.Array:
        enhanced = net.video(frames, state=start, checkpoint=recipe.checkpoint).swapaxes(0, 1)
        return loss(enhanced, clean[:, recipe.warm_up :], perceptual)

    value, slope = eqx.filter_value_and_grad(value_of)(net)
    change, memory = optimiser.update(slope, memory)
    return (eqx.apply_updates(net, change), memory), value


def _half_warm(net: STLSTM, before: jax.Array) -> State:
    """States of a batch whose later half has seen these frames [time, batch, ...]; those of the others are empty."""
    cold = before.shape[1] // 2
    empty = net.init_state(before.shape[2:4], cold)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), empty, net.after(before[:, cold:]))


def examples(
    batch: Batch,
    key,
    camera: NoiseModel,
    noise: NoiseModel,
    light,
    jitter: float = JITTER,
    sensor: Shape | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Clean display values, and noisy light in units of the camera, [example, frame, row, column, channel].

    Each example has its own camera, changed by `jitter`, its own E[N_e] within `light`, and its own place on the
    sensor, as in Camera.
    """
    linear = light_of_frames(batch.frames, len(camera.channels))

    def one(key, linear, average):
        of_light, of_camera, of_noise = (named_key(key, name) for name in ("light", "camera", "noise"))
        mean_e = light[0] * (light[1] / light[0]) ** jax.random.uniform(of_light, (), jnp.float32)
        drawn = jittered(of_camera, noise, jitter)
        return noisy_of(of_noise, linear, camera, drawn, mean_e / average, unit_of(light), sensor)

    noisy = jax.vmap(one)(jax.random.split(key, len(linear)), linear, batch.average)
    return display_from_linear(linear).astype(jnp.float32), noisy.astype(jnp.float32)
