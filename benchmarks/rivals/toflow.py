"""TOFlow: frames are registered by an optical flow that is trained with the network that merges them.

Xue, Chen, Wu, Wei, Freeman, "Video enhancement with task-oriented flow", IJCV 2019; flow network: Ranjan, Black,
"Optical flow estimation using a spatial pyramid network", CVPR 2017.

In: display values of 7 frames. Out: display values of the middle one. There is no noise map. Differences: the flow
network is not trained on rendered scenes first, it starts at a flow of 0 and learns from the enhancement alone.
Parameters in colour: 1 405 323, of which the flow network has 960 200 (four levels of 240 050: SPyNet's five are the
1.2 million of its paper) and the merging one 445 123; the paper gives no number.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.rivals.layers import (
    Layer,
    Noise,
    Rival,
    chain,
    displayed,
    doubled,
    halved,
    padded,
    rectified,
    scaled,
    windows,
)
from hsnoise._core.types import RandomKey

FRAMES, LEVELS = 7, 4
FLOW_MAPS = (32, 64, 32, 16)
MERGED_MAPS = 64


class TOFlow(Rival):
    """Coarse-to-fine flow from the middle frame to each other, bilinear warping, and four layers that merge."""

    before: ClassVar[int] = FRAMES // 2
    after: ClassVar[int] = FRAMES // 2
    levels: tuple[tuple[Layer, ...], ...]  # coarsest first
    merging: tuple[Layer, ...]

    def __init__(self, key: RandomKey, noise: Noise, *, width: float = 1.0):
        channels = len(noise.dark)
        first, last = jax.random.split(key)
        sizes = (2 * channels + 2, *(scaled(of, width) for of in FLOW_MAPS), 2)
        self.levels = tuple(_still(chain(k, (7,) * 5, sizes)) for k in jax.random.split(first, LEVELS))
        maps = scaled(MERGED_MAPS, width)
        self.merging = chain(last, (9, 9, 1, 1), (FRAMES * channels, maps, maps, maps, channels))

    def flow(self, middle: jax.Array, other: jax.Array) -> jax.Array:
        """Where the pixels of `middle` are in `other`, rows and columns apart; all are [batch, row, column, ...]."""
        pairs = [(middle, other)]
        for _ in range(LEVELS - 1):
            pairs.append(tuple(map(halved, pairs[-1])))
        batch, rows, columns, _ = pairs[-1][0].shape
        found = jnp.zeros((batch, rows, columns, 2), jnp.float32)
        for level, (here, there) in enumerate(reversed(pairs)):
            found = 2 * doubled(found) if level else found
            x = jnp.concatenate([here, warped(there, found), found], -1)
            *layers, last = self.levels[level]
            found = found + last(rectified(tuple(layers), x))
        return found

    def video(self, frames: jax.Array) -> jax.Array:
        rows, columns, channels = frames.shape[2:]
        found = windows(padded(displayed(frames), 2 ** (LEVELS - 1)), FRAMES)
        found = found.reshape(FRAMES, -1, *found.shape[3:])
        middle, others = found[self.before], jnp.delete(found, self.before, 0)
        others = others.reshape(-1, *others.shape[2:])
        registered = warped(others, self.flow(jnp.tile(middle, (FRAMES - 1, 1, 1, 1)), others))
        x = jnp.concatenate([middle, *registered.reshape(FRAMES - 1, *middle.shape)], -1)
        out = self.merging[-1](rectified(self.merging[:-1], x))
        return out[:, :rows, :columns].reshape(-1, *frames.shape[1:])

    def loss(self, frames: jax.Array, clean: jax.Array, done: jax.Array) -> jax.Array:
        """Mean absolute error."""
        return jnp.mean(jnp.abs(self.video(frames) - self.with_window(clean)))


def _still(layers: tuple[Layer, ...]) -> tuple[Layer, ...]:
    """Layers whose last gives zeros until it is trained."""
    last = layers[-1]
    return (*layers[:-1], eqx.tree_at(lambda layer: layer.weight, last, jnp.zeros_like(last.weight)))


def warped(frames: jax.Array, flow: jax.Array) -> jax.Array:
    """Frames [batch, row, column, channel] at the places of a flow [batch, row, column, 2], bilinear.

    flow: rows and columns from each pixel. Outside the frame its edge is repeated.
    """
    batch, rows, columns, channels = frames.shape
    grid = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), -1)[None].astype(np.float32)
    last = np.float32([rows - 1, columns - 1]).reshape(1, 1, 1, 2)
    places = jnp.clip(grid + flow, 0, last)
    low = jnp.minimum(jnp.floor(places), jnp.maximum(last - 1, 0))
    share = (places - low)[..., None]
    row, column = jnp.moveaxis(low.astype(jnp.int32), -1, 0)
    one = np.arange(batch)[:, None, None]

    def at(down: int, right: int) -> jax.Array:
        return frames[one, jnp.minimum(row + down, rows - 1), jnp.minimum(column + right, columns - 1)]

    down, right = share[..., 0, :], share[..., 1, :]
    upper = at(0, 0) * (1 - right) + at(0, 1) * right
    lower = at(1, 0) * (1 - right) + at(1, 1) * right
    return upper * (1 - down) + lower * down
