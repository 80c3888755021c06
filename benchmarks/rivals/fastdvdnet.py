"""FastDVDnet: two stages of the same small U-Net over 5 frames, without explicit motion compensation.

Tassano, Delon, Veit, "FastDVDnet: towards real-time deep video denoising without flow estimation", CVPR 2020.

In: display values of 5 frames and maps of their noise. Out: display values of the middle one. Differences: each frame
has a noise map of its own, because its shot noise does; the published network repeats one map.
Parameters in colour: 2 477 642, the paper's 2.48 million.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from benchmarks.rivals.layers import (
    Layer,
    Noise,
    Rival,
    chain,
    displayed_with_noise,
    joined,
    padded,
    rectified,
    scaled,
)
from hsnoise._core.types import RandomKey
from hsnoise.stlstm import from_blocks

MAPS, OF_FRAME = (32, 64, 128), 30
STRIDE = 4  # rows and columns of the coarsest level


class Block(eqx.Module):
    """The U-Net: three frames and their noise to the middle frame less its noise."""

    of_frame: tuple[Layer, ...]  # one for each frame, together the paper's grouped convolution
    inward: tuple[Layer, ...]
    down: tuple[tuple[Layer, ...], ...]
    up: tuple[tuple[Layer, ...], ...]
    outward: tuple[Layer, ...]

    def __init__(self, key: RandomKey, channels: int, width: float):
        keys = jax.random.split(key, 9)
        of_frame, (a, b, c) = scaled(OF_FRAME, width), (scaled(maps, width) for maps in MAPS)
        self.of_frame = tuple(Layer(k, 3, channels + 1, of_frame) for k in keys[:3])
        self.inward = (Layer(keys[3], 3, 3 * of_frame, a),)
        self.down = (_down(keys[4], a, b), _down(keys[5], b, c))
        self.up = (chain(keys[6], (3, 3, 3), (c, c, c, 4 * b)), chain(keys[7], (3, 3, 3), (b, b, b, 4 * a)))
        self.outward = chain(keys[8], (3, 3), (a, a, channels))

    def __call__(self, frames: list[jax.Array], sigmas: list[jax.Array]) -> jax.Array:
        """[batch, row, column, channel] of three frames [the same] and their noise [batch, row, column, 1]."""
        inputs = [jnp.concatenate(pair, -1) for pair in zip(frames, sigmas, strict=True)]
        single = [jax.nn.relu(layer(x)) for layer, x in zip(self.of_frame, inputs, strict=True)]
        fine = rectified(self.inward, jnp.concatenate(single, -1))
        middle = rectified(self.down[0], fine)
        x = middle + _up(self.up[0], rectified(self.down[1], middle))
        x = fine + _up(self.up[1], x)
        return frames[1] - self.outward[1](rectified(self.outward[:1], x))


def _down(key: RandomKey, inputs: int, outputs: int) -> tuple[Layer, ...]:
    first, rest = jax.random.split(key)
    return (Layer(first, 3, inputs, outputs, stride=2), *chain(rest, (3, 3), (outputs,) * 3))


def _up(layers: tuple[Layer, ...], x: jax.Array) -> jax.Array:
    return from_blocks(layers[-1](rectified(layers[:-1], x)), 2)


class FastDVDnet(Rival):
    """A stage over the three triples of 5 frames, a second over its results."""

    before: ClassVar[int] = 2
    after: ClassVar[int] = 2
    stages: tuple[Block, Block]
    noise: Noise = eqx.field(static=True)

    def __init__(self, key: RandomKey, noise: Noise, *, width: float = 1.0):
        first, second = (Block(k, len(noise.dark), width) for k in jax.random.split(key))
        self.stages = (first, second)
        self.noise = noise

    def video(self, frames: jax.Array) -> jax.Array:
        rows, columns = frames.shape[2:4]
        x, sigma = (padded(part, STRIDE) for part in displayed_with_noise(frames, self.noise))
        for block in self.stages:  # each triple once, though it belongs to several windows
            n = len(x) - 2
            out = block(*([joined(part[i : i + n]) for i in range(3)] for part in (x, sigma)))
            x, sigma = out.reshape(n, *x.shape[1:]), sigma[1:-1]
        return x[:, :, :rows, :columns]

    def loss(self, frames: jax.Array, clean: jax.Array, done: jax.Array) -> jax.Array:
        """Mean squared error."""
        return jnp.mean((self.video(frames) - self.with_window(clean)) ** 2)
