"""What the rivals share: their interface, windows of frames, maps of the noise, and convolutions."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import RandomKey, cfa_tile
from hsnoise.chain.photometry import display_from_linear
from hsnoise.enhance.training.noisy import Camera, noisy_of
from hsnoise.stlstm import LAYOUT

DARK_SHAPE = (8, 64, 64)  # frames, rows and columns of the darks that are drawn


@dataclass(frozen=True)
class Noise:
    """A camera's noise in linear light, in the units of the networks' input; one number for each channel.

    shot: variance per unit of light; dark: variance of darks.
    """

    shot: tuple[float, ...]
    dark: tuple[float, ...]

    def sigma(self, frames: jax.Array) -> jax.Array:
        """Standard deviation [..., row, column, channel] at the light that noisy frames of this shape show."""
        shot, dark = (np.reshape(np.float32(of), (1,) * (frames.ndim - 1) + (-1,)) for of in (self.shot, self.dark))
        return jnp.sqrt(jnp.maximum(frames, 0) * shot + dark)


def noise_map_of(camera: Camera) -> Noise:
    """The noise that a camera's parameters imply.

    The variance of darks is measured on drawn ones before they are clipped, because light lifts frames off the limit.
    """
    model, channels, tile = camera.model, camera.channels, cfa_tile(camera.model.cfa)
    open_ended = model.remove("adc") if "adc" in model else model
    dark = jnp.zeros((*DARK_SHAPE, channels), jnp.float32)
    drawn = np.asarray(noisy_of(jax.random.key(0), dark, model, open_ended, 0.0, camera.unit_e), np.float64)
    variance = 0.5 * np.mean(np.diff(drawn, axis=0) ** 2, axis=(0, 1, 2))
    # A pixel of the frame is the mean of the sensor's pixels of its colour.
    shot = tuple(1 / (camera.unit_e * int(np.sum(tile == channel))) for channel in range(channels))
    return Noise(shot, tuple(map(float, variance)))


def rms(x: jax.Array) -> jax.Array:
    """Root mean square over channels, [..., 1]."""
    return jnp.sqrt(jnp.mean(x**2, -1, keepdims=True))


def displayed(light: jax.Array) -> jax.Array:
    """Display values of linear light, odd about black: along a line below it, noise of darks would exceed white."""
    return (jnp.sign(light) * display_from_linear(jnp.abs(light))).astype(jnp.float32)


def displayed_with_noise(frames: jax.Array, noise: Noise) -> tuple[jax.Array, jax.Array]:
    """Display values of noisy linear light [..., row, column, channel], and their noise [..., row, column, 1].

    The noise is half the step of the display curve from one standard deviation below to one above.
    """
    sigma = noise.sigma(frames)
    step = (displayed(frames + sigma) - displayed(frames - sigma)) / 2
    return displayed(frames), rms(step)


class Rival(eqx.Module):
    """A network that needs `before` frames before and `after` frames after each that it enhances."""

    before: eqx.AbstractClassVar[int]
    after: eqx.AbstractClassVar[int]

    @abstractmethod
    def video(self, frames: jax.Array) -> jax.Array:
        """Display values of frames [frame, example, row, column, channel] of linear light, of those with a window."""

    @abstractmethod
    def loss(self, frames: jax.Array, clean: jax.Array, done: jax.Array) -> jax.Array:
        """The published loss of noisy frames, against clean display values of the same frames.

        done: share of the training that is done, 0 to 1.
        """

    def with_window(self, clean: jax.Array) -> jax.Array:
        """Those of the frames that `video` returns."""
        return clean[self.before : len(clean) - self.after]

    def whole_video(self, frames: jax.Array) -> jax.Array:
        """Display values of all frames; the video is reflected at its ends."""
        places = np.pad(np.arange(len(frames)), (self.before, self.after), mode="reflect")
        return self.video(frames[places])


def windows(frames: jax.Array, size: int) -> jax.Array:
    """All windows of consecutive frames: [frame, ...] to [size, window, ...]."""
    return frames[np.arange(size)[:, None] + np.arange(len(frames) - size + 1)]


def joined(frames: jax.Array) -> jax.Array:
    """[frame, example, ...] to [frame and example, ...]."""
    return frames.reshape(-1, *frames.shape[2:])


def padded(x: jax.Array, multiple: int) -> jax.Array:
    """[..., row, column, channel] with its edge repeated, so that rows and columns are multiples."""
    missing = [(0, (-n) % multiple) for n in x.shape[-3:-1]]
    return jnp.pad(x, [(0, 0)] * (x.ndim - 3) + [*missing, (0, 0)], mode="edge")


def halved(x: jax.Array) -> jax.Array:
    """Means of 2 x 2 pixels of [..., row, column, channel]."""
    rows, columns, channels = x.shape[-3:]
    return x.reshape(*x.shape[:-3], rows // 2, 2, columns // 2, 2, channels).mean((-4, -2))


def doubled(x: jax.Array) -> jax.Array:
    """[batch, row, column, channel] with twice the rows and columns, bilinear."""
    batch, rows, columns, channels = x.shape
    return jax.image.resize(x, (batch, 2 * rows, 2 * columns, channels), "bilinear")


class Layer(eqx.Module):
    """A convolution of odd kernel size, zeros outside; stride 2 starts at the first pixel."""

    weight: jax.Array
    bias: jax.Array
    stride: int = eqx.field(static=True)

    def __init__(self, key: RandomKey, kernel: int, inputs: int, outputs: int, *, stride: int = 1):
        """Weights are normal with variance 2 / (kernel^2 inputs), as suits rectifiers; biases are 0."""
        shape = (kernel, kernel, inputs, outputs)
        normal = jax.random.normal(key, (math.prod(shape),), jnp.float32).reshape(shape)
        self.weight = np.float32(np.sqrt(2 / (kernel**2 * inputs))) * normal
        self.bias = jnp.zeros(outputs, jnp.float32)
        self.stride = stride

    def __call__(self, x: jax.Array) -> jax.Array:
        edge = (len(self.weight) // 2,) * 2
        steps = (self.stride,) * 2
        out = jax.lax.conv_general_dilated(x, self.weight, steps, (edge, edge), dimension_numbers=LAYOUT)
        return out + self.bias[None, None, None]


def chain(key: RandomKey, kernels: tuple[int, ...], maps: tuple[int, ...]) -> tuple[Layer, ...]:
    """Layers one after the other, from maps[0] to maps[-1]."""
    keys = jax.random.split(key, len(kernels))
    return tuple(map(Layer, keys, kernels, maps[:-1], maps[1:]))


def rectified(layers: tuple[Layer, ...], x: jax.Array) -> jax.Array:
    """All layers, each with a rectifier after it."""
    for layer in layers:
        x = jax.nn.relu(layer(x))
    return x


def scaled(maps: int, width: float) -> int:
    """This many feature maps at `width`. Raises ValueError unless width is above 0."""
    if not 0 < width < math.inf:
        raise ValueError(f"width: expected a number above 0, got {width}")
    return max(1, round(maps * width))
