"""KPN: the mean of a burst of 8 frames, each filtered by its own 5 x 5 kernel at each pixel.

Mildenhall et al., "Burst denoising with kernel prediction networks", CVPR 2018.

In: linear light of 8 frames, and the standard deviation of the noise of the reference. Out: display values of the
reference. Differences: the reference is the fifth frame, not the first, so that none is more than four frames away;
frames in colour share the kernels of a pixel; the kernels start near the mean of 5 x 5 pixels; the single frames' part
of the loss falls in proportion to the length of the training.
Parameters: the paper gives no number. A grey burst needs 28 703 064 with the layers of the authors' code (3 of 64, 128,
256, 512 and 512 maps on the way down, 3 of 512, 256 and 200 on the way up), one in colour 9216 more in its first layer.
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
    displayed,
    doubled,
    halved,
    joined,
    padded,
    rectified,
    rms,
    scaled,
    windows,
)
from hsnoise._core.types import RandomKey

BURST, KERNEL = 8, 5
DOWN = (64, 128, 256, 512, 512)
BETA = 100.0
SINGLE = 0.25  # of the training, after which single frames weigh as much as their mean


class KPN(Rival):
    """A U-Net down to a sixteenth; kernels are predicted at half the resolution and interpolated."""

    before: ClassVar[int] = BURST // 2
    after: ClassVar[int] = BURST - BURST // 2 - 1
    down: tuple[tuple[Layer, ...], ...]
    up: tuple[tuple[Layer, ...], ...]
    kernels: tuple[Layer, ...]
    noise: Noise = eqx.field(static=True)

    def __init__(self, key: RandomKey, noise: Noise, *, width: float = 1.0):
        first, second, last = jax.random.split(key, 3)
        maps = [scaled(of, width) for of in DOWN]
        inputs = [BURST * len(noise.dark) + 1, *maps[:-1]]
        keys = jax.random.split(first, len(maps))
        self.down = tuple(chain(k, (3, 3, 3), (n, m, m, m)) for k, n, m in zip(keys, inputs, maps, strict=True))
        # From below come as many maps as the level below has, from beside as many as this one has.
        keys = jax.random.split(second, 2)
        sizes = ((maps[4] + maps[3], maps[3]), (maps[3] + maps[2], maps[2]))
        self.up = tuple(chain(k, (3, 3, 3), (n, m, m, m)) for k, (n, m) in zip(keys, sizes, strict=True))
        out = BURST * KERNEL**2
        *others, predicted = chain(last, (3, 3, 3), (maps[2] + maps[1], out, out, out))
        mean = jnp.full(out, 1 / KERNEL**2, jnp.float32)
        self.kernels = (*others, eqx.tree_at(lambda layer: layer.bias, predicted, mean))
        self.noise = noise

    def predicted(self, bursts: jax.Array) -> jax.Array:
        """Kernels [batch, row, column, frame of the burst, 25] of bursts [frame, batch, row, column, channel]."""
        rows, columns = bursts.shape[2:4]
        x = padded(jnp.concatenate([*bursts, rms(self.noise.sigma(bursts[self.before]))], -1), 16)
        beside = []
        for level, layers in enumerate(self.down):
            x = rectified(layers, halved(x) if level else x)
            beside.append(x)
        for layers, skipped in zip((*self.up, self.kernels[:-1]), beside[-2:0:-1], strict=True):
            x = rectified(layers, jnp.concatenate([doubled(x), skipped], -1))
        x = doubled(self.kernels[-1](x))[:, :rows, :columns]
        return x.reshape(*x.shape[:-1], BURST, KERNEL**2)

    def video(self, frames: jax.Array) -> jax.Array:
        out = displayed(self._single(frames).mean(0))
        return out.reshape(-1, *frames.shape[1:])

    def _single(self, frames: jax.Array) -> jax.Array:
        """Linear light of the filtered frames of all bursts, [frame of the burst, batch, row, column, channel]."""
        found = windows(frames, BURST)
        bursts = found.reshape(BURST, -1, *found.shape[3:])
        return filtered(bursts, self.predicted(bursts))

    def loss(self, frames: jax.Array, clean: jax.Array, done: jax.Array) -> jax.Array:
        """Squared error and L1 error of gradients; at first mostly of single frames (equations 6 and 7).

        These weigh beta alpha^t in the paper. Here alpha^t is beta^(-4 done), which is 1 / beta after a quarter of the
        training; in the paper it is after 23 000 steps.
        """
        single, wanted = self._single(frames), joined(self.with_window(clean))
        weight = BETA ** (1 - done / SINGLE)
        each = _basic(displayed(single), wanted[None])
        return _basic(displayed(single.mean(0)), wanted) + weight * BURST * each


def filtered(bursts: jax.Array, kernels: jax.Array) -> jax.Array:
    """Frames [frame, batch, row, column, channel], each pixel by its kernel [batch, row, column, frame, 25]."""
    rows, columns = bursts.shape[2:4]
    edge = (KERNEL // 2,) * 2
    x = jnp.pad(bursts, ((0, 0), (0, 0), edge, edge, (0, 0)))
    weights = jnp.moveaxis(kernels, (-2, -1), (0, 1))[..., None]  # [frame, element, batch, row, column, 1]
    places = [(row, column) for row in range(KERNEL) for column in range(KERNEL)]
    return sum(weights[:, i] * x[:, :, r : r + rows, c : c + columns] for i, (r, c) in enumerate(places))


def _basic(found: jax.Array, clean: jax.Array) -> jax.Array:
    apart = found - clean
    slopes = sum(jnp.mean(jnp.abs(jnp.diff(apart, axis=axis))) for axis in (-3, -2))
    return jnp.mean(apart**2) + slopes
