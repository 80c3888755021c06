"""FFDNet: one frame and a map of its noise, at half the resolution.

Zhang, Zuo, Zhang, "FFDNet: toward a fast and flexible solution for CNN-based image denoising", IEEE TIP 2018.

In: display values of each frame, and the standard deviation of their noise, which varies from pixel to pixel (mean of
the squares over channels and 2 x 2 pixels: the published network has one map). Out: display values.
Parameters: 485 316 grey and 852 108 colour, here as in the released networks (0.485 and 0.852 million in the paper).
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
    halved,
    joined,
    padded,
    rectified,
    scaled,
)
from hsnoise._core.types import RandomKey
from hsnoise.stlstm import from_blocks, to_blocks


class FFDNet(Rival):
    """15 layers of 64 maps for grey frames, 12 of 96 for colour, all 3 x 3, on blocks of 2 x 2 pixels."""

    before: ClassVar[int] = 0
    after: ClassVar[int] = 0
    layers: tuple[Layer, ...]
    noise: Noise = eqx.field(static=True)

    def __init__(self, key: RandomKey, noise: Noise, *, width: float = 1.0):
        channels = len(noise.dark)
        depth, maps = (15, 64) if channels == 1 else (12, 96)
        sizes = (4 * channels + 1, *(scaled(maps, width),) * (depth - 1), 4 * channels)
        self.layers = chain(key, (3,) * depth, sizes)
        self.noise = noise

    def denoised(self, frames: jax.Array, sigma: jax.Array) -> jax.Array:
        """Display values [batch, row, column, channel]; sigma: of their noise [batch, row, column, 1]."""
        rows, columns = frames.shape[1:3]
        level = jnp.sqrt(halved(padded(sigma, 2) ** 2))
        x = rectified(self.layers[:-1], jnp.concatenate([to_blocks(padded(frames, 2), 2), level], -1))
        return from_blocks(self.layers[-1](x), 2)[:, :rows, :columns]

    def video(self, frames: jax.Array) -> jax.Array:
        shown, sigma = displayed_with_noise(frames, self.noise)
        return self.denoised(joined(shown), joined(sigma)).reshape(frames.shape)

    def loss(self, frames: jax.Array, clean: jax.Array, done: jax.Array) -> jax.Array:
        """Mean squared error."""
        return jnp.mean((self.video(frames) - clean) ** 2)
