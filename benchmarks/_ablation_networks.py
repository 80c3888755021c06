"""The two networks of `benchmarks.noise_ablation`: how each is trained, kept and used."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.rivals.layers import noise_map_of
from benchmarks.rivals.toflow import TOFlow
from hsnoise.enhance.training.noisy import Camera
from hsnoise.enhance.training.presets import Recipe
from hsnoise.enhance.training.steps import Trainer
from hsnoise.enhance.weights import load_network, read_arrays, save_network, write_arrays
from hsnoise.model import NoiseModel

WIDTH, RATE = 0.25, 1e-3  # of TOFlow's feature maps; its rate of learning
Video = Callable[[jax.Array], np.ndarray]  # display values of noisy light [frame, row, column, 1]


class Kind(Protocol):
    """A kind of network; `prefix` begins the names of its files."""

    prefix: str

    def trainer(self, camera: Camera, noise: NoiseModel, options: argparse.Namespace) -> Any: ...

    def save(self, path: Path, net: Any, about: dict[str, Any]) -> None: ...

    def video(self, path: Path, camera: Camera) -> Video: ...


class Recurrent:
    """The ST-LSTM."""

    prefix = ""

    def trainer(self, camera: Camera, noise: NoiseModel, options: argparse.Namespace) -> Trainer:
        recipe = Recipe(maps=options.maps, stride=options.stride)
        return Trainer(recipe, options.steps, camera, noise, jitter=options.jitter)

    def save(self, path: Path, net: Any, about: dict[str, Any]) -> None:
        save_network(path, net, about)

    def video(self, path: Path, camera: Camera) -> Video:
        net, _ = load_network(path)
        return _video_of(net.video)


class Flow:
    """TOFlow, narrower than published."""

    prefix = "toflow-"

    def trainer(self, camera: Camera, noise: NoiseModel, options: argparse.Namespace) -> FlowTrainer:
        return FlowTrainer(Recipe(rate=RATE), options.steps, camera, noise, jitter=options.jitter)

    def save(self, path: Path, net: Any, about: dict[str, Any]) -> None:
        write_arrays(path, net, about)

    def video(self, path: Path, camera: Camera) -> Video:
        net, _ = read_arrays(path, eqx.filter_eval_shape(_flow_of(camera), jax.random.key(0)))
        return _video_of(net.whole_video)


def _flow_of(camera: Camera) -> Callable[[jax.Array], TOFlow]:
    return partial(TOFlow, noise=noise_map_of(camera), width=WIDTH)


def _video_of(enhance: Callable[[jax.Array], jax.Array]) -> Video:
    of_video = eqx.filter_jit(lambda noisy: enhance(noisy[:, None])[:, 0])
    return lambda noisy: np.asarray(of_video(noisy))


class FlowTrainer(Trainer):
    """TOFlow trained as the ST-LSTM is, with a loss of its own."""

    def make(self, key: jax.Array) -> TOFlow:
        return _flow_of(self.camera)(key)

    def learner(self) -> Callable:
        return partial(_learn, self.optimiser)


def _learn(optimiser, state, clean, noisy):
    net, memory = state
    clean, noisy = clean.swapaxes(0, 1), noisy.swapaxes(0, 1)
    # TOFlow's loss does not depend on how much of the training is done.
    value, slope = eqx.filter_value_and_grad(lambda net: net.loss(noisy, clean, jnp.zeros((), jnp.float32)))(net)
    change, memory = optimiser.update(slope, memory)
    return (eqx.apply_updates(net, change), memory), value


NETWORKS: dict[str, Kind] = {"st-lstm": Recurrent(), "toflow": Flow()}
