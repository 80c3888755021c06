"""The video enhancer: a recurrent network of spatio-temporal LSTM layers, trained on noise that hsnoise draws.

Frames go in one by one and come out enhanced; a state of constant size carries the memory of earlier frames. Arrays are
[batch, row, column, map]; a frame may lack the batch axis.

Reference: Wang et al., "Enhancing Low Light Videos by Exploring High Sensitivity Camera Noise", ICCV 2019 (network and
loss); Wang, Long, Wang, Gao, Yu, "PredRNN: recurrent neural networks for predictive learning using spatiotemporal
LSTMs", NeurIPS 2017 (cell).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.arguments import listed, whole_number
from hsnoise._core.keys import key_of
from hsnoise._core.types import RandomKey

LAYOUT = ("NHWC", "HWIO", "NHWC")
FORGET_BIAS = 1.0
MOST_LAYERS = 64  # the paper has 4; a file that declares thousands would keep a reader busy for hours
REACH = 16  # blocks beyond a tile that the network sees
FILLED = 6  # frames after which its memory of a video hardly grows
L2, L1, PERCEPTUAL, TOTAL_VARIATION = 5.0, 1.0, 0.06, 2e-6  # weights of equation 10


@jax.custom_vjp
def convolve(x: jax.Array, weight: jax.Array) -> jax.Array:
    """Convolution of x [batch, row, column, in] with weight [row, column, in, out], same size, zeros outside.

    Its derivative with respect to the weight is a sum of matrix products, one per kernel element. XLA's own, a
    convolution with a kernel as large as the image, is ten times slower inside loops on a CPU.
    """
    return jax.lax.conv_general_dilated(x, weight, (1, 1), "SAME", dimension_numbers=LAYOUT)


def _forward(x, weight):
    return convolve(x, weight), (x, weight)


def _backward(residuals, slope):
    x, weight = residuals
    turned = jnp.flip(weight, (0, 1)).swapaxes(2, 3)
    by_x = jax.lax.conv_general_dilated(slope, turned, (1, 1), "SAME", dimension_numbers=LAYOUT)
    height, width = weight.shape[:2]
    rows, columns = x.shape[1:3]
    above, left = (height - 1) // 2, (width - 1) // 2
    padded = jnp.pad(x, ((0, 0), (above, height - 1 - above), (left, width - 1 - left), (0, 0)))
    by_weight = [
        [jnp.einsum("bhwi,bhwo->io", padded[:, r : r + rows, c : c + columns], slope) for c in range(width)]
        for r in range(height)
    ]
    return by_x, jnp.stack([jnp.stack(row) for row in by_weight])


convolve.defvjp(_forward, _backward)


class Convolution(eqx.Module):
    """A convolution of odd kernel size that keeps the size of the image."""

    weight: jax.Array
    bias: jax.Array

    def __init__(self, key: RandomKey, kernel: int, inputs: int, outputs: int):
        """Weights are normal with variance 1 / (kernel^2 inputs); biases are 0. Raises ValueError for even kernels."""
        if kernel % 2 == 0:
            raise ValueError(f"kernel: expected an odd size, got {kernel}")
        scale = 1 / np.sqrt(kernel**2 * inputs)
        shape = (kernel, kernel, inputs, outputs)
        # The same numbers as drawn in this shape, which XLA compiles in four times as long.
        normal = jax.random.normal(key, (math.prod(shape),), jnp.float32).reshape(shape)
        self.weight = jnp.float32(scale) * normal
        self.bias = jnp.zeros(outputs, jnp.float32)

    def __call__(self, x: jax.Array) -> jax.Array:
        return convolve(x, self.weight) + self.bias[None, None, None]


class Cell(eqx.Module):
    """One ST-LSTM layer: cell C stays in the layer between frames, memory M comes from the layer below."""

    of_input: Convolution
    of_hidden: Convolution
    of_memory: Convolution
    of_both: Convolution
    merge: Convolution
    maps: int = eqx.field(static=True)

    def __init__(self, key: RandomKey, kernel: int, maps: int):
        keys = jax.random.split(key, 5)
        self.of_input = Convolution(keys[0], kernel, maps, 7 * maps)
        self.of_hidden = Convolution(keys[1], kernel, maps, 4 * maps)
        self.of_memory = Convolution(keys[2], kernel, maps, 3 * maps)
        self.of_both = Convolution(keys[3], kernel, 2 * maps, maps)
        self.merge = Convolution(keys[4], 1, 2 * maps, maps)
        self.maps = maps

    def __call__(self, x: jax.Array, hidden: jax.Array, cell: jax.Array, memory: jax.Array):
        """(hidden, cell, memory) after a frame whose features are x."""
        x_g, x_i, x_f, x_gm, x_im, x_fm, x_o = jnp.split(self.of_input(x), 7, -1)
        h_g, h_i, h_f, h_o = jnp.split(self.of_hidden(hidden), 4, -1)
        m_g, m_i, m_f = jnp.split(self.of_memory(memory), 3, -1)
        forget = jax.nn.sigmoid(x_f + h_f + FORGET_BIAS)
        cell = forget * cell + jax.nn.sigmoid(x_i + h_i) * jnp.tanh(x_g + h_g)
        forget = jax.nn.sigmoid(x_fm + m_f + FORGET_BIAS)
        memory = forget * memory + jax.nn.sigmoid(x_im + m_i) * jnp.tanh(x_gm + m_g)
        both = jnp.concatenate([cell, memory], -1)
        hidden = jax.nn.sigmoid(x_o + h_o + self.of_both(both)) * jnp.tanh(self.merge(both))
        return hidden, cell, memory


class State(eqx.Module):
    """The network's memory: hidden and cell of each layer, and the memory that the top layer passes on.

    All are [batch, row, column, map], with the rows and columns of the features.
    """

    hidden: tuple[jax.Array, ...]
    cell: tuple[jax.Array, ...]
    memory: jax.Array


class STLSTM(eqx.Module):
    """The enhancer: features of blocks of stride x stride pixels, ST-LSTM layers, and a convolution back to pixels.

    A skip connection adds the features to the last layer. Frames come in as linear light, in which noise averages out,
    and leave as display values, in which errors look as large as they are.

    Attributes:
        stride: side of the blocks; kernels: kernel size of each layer; maps: feature maps; channels: of a frame.
    """

    features: Convolution
    cells: tuple[Cell, ...]
    output: Convolution
    maps: int = eqx.field(static=True)
    kernels: tuple[int, ...] = eqx.field(static=True)
    stride: int = eqx.field(static=True)
    channels: int = eqx.field(static=True)

    def __init__(
        self,
        key: RandomKey | int,
        *,
        maps: int = 64,
        kernels: Sequence[int] = (3, 5, 5, 3),
        stride: int = 2,
        channels: int = 3,
    ):
        """Make an untrained network, its weights drawn from `key`: a random key, or a whole number as its seed.

        Raises:
            ValueError: sizes below 1, even kernels or a seed out of range.
            TypeError: sizes that are not whole numbers, or a key that is neither a random key nor a whole number.
        """
        key = key_of("key", key)
        for name, value in {"maps": maps, "stride": stride, "channels": channels}.items():
            whole_number(name, value, 1)
        kernels = listed("kernels", kernels, "odd sizes, one per layer")
        if not 0 < len(kernels) <= MOST_LAYERS:
            raise ValueError(f"kernels: expected 1 to {MOST_LAYERS} sizes, one per layer, got {len(kernels)}")
        if any(whole_number("kernels", kernel, 1) % 2 == 0 for kernel in kernels):
            raise ValueError(f"kernels: expected odd sizes, one per layer, got {kernels}")
        first, last, *rest = jax.random.split(key, 2 + len(kernels))
        self.features = Convolution(first, 3, channels * stride**2, maps)
        self.cells = tuple(Cell(key, kernel, maps) for key, kernel in zip(rest, kernels, strict=True))
        self.output = Convolution(last, 3, maps, channels * stride**2)
        self.maps, self.kernels, self.stride, self.channels = maps, kernels, stride, channels

    def init_state(self, shape: tuple[int, int], batch: int = 1) -> State:
        """The state before the first frame of `shape` (rows, columns)."""
        rows, columns = (-(-n // self.stride) for n in shape)
        zero = jnp.zeros((batch, rows, columns, self.maps), jnp.float32)
        return State((zero,) * len(self.cells), (zero,) * len(self.cells), zero)

    def __call__(self, frame: jax.Array, state: State) -> tuple[jax.Array, State]:
        """One frame, enhanced, and the state after it.

        Args:
            frame: linear light, white is 1, [row, column, channel] or [batch, row, column, channel], of any size.
            state: from `init_state` for this size, or from the previous frame.

        Raises:
            ValueError: a frame with other channels, or of another size or batch than the state.
        """
        frame = jnp.asarray(frame, self.features.weight.dtype)
        single = frame.ndim == 3
        frames = frame[None] if single else frame
        self._check(frames, state)
        rows, columns = frames.shape[1:3]
        missing = [(-n) % self.stride for n in (rows, columns)]
        padded = jnp.pad(frames, ((0, 0), (0, missing[0]), (0, missing[1]), (0, 0)), mode="edge")
        features = self.features(to_blocks(jnp.arcsinh(padded), self.stride))  # noise may be several times white
        x, memory, hidden, cell = features, state.memory, [], []
        for layer, h, c in zip(self.cells, state.hidden, state.cell, strict=True):
            x, c, memory = layer(x, h, c, memory)
            hidden.append(x)
            cell.append(c)
        out = from_blocks(self.output(x + features), self.stride)[:, :rows, :columns]
        return (out[0] if single else out), State(tuple(hidden), tuple(cell), memory)

    def _check(self, frames: jax.Array, state: State) -> None:
        if frames.ndim != 4 or frames.shape[-1] != self.channels or not frames.size:
            raise ValueError(f"frame: expected [row, column, {self.channels}] or a batch of it, got {frames.shape}")
        expected = (len(frames), *(-(-n // self.stride) for n in frames.shape[1:3]))
        if state.memory.shape[:3] != expected:
            raise ValueError(
                f"state: made for features of batch, rows and columns {state.memory.shape[:3]}, the frame needs"
                f" {expected}; make one with init_state"
            )

    def video(
        self, frames: jax.Array, *, state: State | None = None, checkpoint: bool = False, unroll: int = 1
    ) -> jax.Array:
        """All frames [time, batch, row, column, channel], enhanced one after the other.

        state: from which they go on, such as that of `after`; None: an empty one; checkpoint: recompute the inside of
        each frame for the gradient, which takes a third of the memory; unroll: frames compiled into one piece, which a
        GPU runs faster and takes longer to compile.
        """
        step = jax.checkpoint(_step) if checkpoint else _step
        state = self.init_state(frames.shape[2:4], frames.shape[1]) if state is None else state
        _, out = jax.lax.scan(lambda state, frame: step(self, frame, state), state, frames, unroll=unroll)
        return out

    def after(self, frames: jax.Array) -> State:
        """The state after frames [time, batch, row, column, channel] that begin with an empty one."""
        start = self.init_state(frames.shape[2:4], frames.shape[1])
        return jax.lax.scan(lambda state, frame: (self(frame, state)[1], None), start, frames)[0]


def _step(net: STLSTM, frame: jax.Array, state: State) -> tuple[State, jax.Array]:
    out, state = net(frame, state)
    return state, out


def to_blocks(x: jax.Array, stride: int) -> jax.Array:
    """[batch, row, column, channel] to [batch, block row, block column, pixel of the block and channel]."""
    batch, rows, columns, channels = x.shape
    x = x.reshape(batch, rows // stride, stride, columns // stride, stride, channels)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(batch, rows // stride, columns // stride, -1)


def from_blocks(x: jax.Array, stride: int) -> jax.Array:
    """The inverse of `to_blocks`."""
    batch, rows, columns, _ = x.shape
    x = x.reshape(batch, rows, columns, stride, stride, -1).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(batch, rows * stride, columns * stride, -1)


def enhance(
    net: STLSTM,
    frames: Iterable[np.ndarray],
    *,
    tile: int | None = None,
    margin: int | None = None,
    look_ahead: int = 0,
    mirrored: bool = False,
) -> Iterator[np.ndarray]:
    """Enhance a video of any length in constant memory.

    Args:
        net: the network; frames: [row, column, channel], linear light, one after the other.
        tile: side of the tiles into which large frames are cut, pixels; None: whole frames. The result equals that of
            whole frames where the network sees no further than `margin` pixels beyond a tile.
        margin: overlap of tiles in pixels, a multiple of the stride; default: 16 strides, more than the reach of a
            frame and the few before it.
        look_ahead: so many frames that follow help each frame, too: the network also goes through them backward, and
            the two results are averaged. This takes three times as long. 0: each frame leaves before the next comes in.
        mirrored: average with the result of the mirrored frames, mirrored back (Lim, Son, Kim, Nah, Lee, "Enhanced deep
            residual networks for single image super-resolution", CVPR workshops 2017). This takes twice as long.

    Raises:
        ValueError: a tile or margin that is not a multiple of the stride; frames that change size; a negative
            look_ahead.
    """
    margin = REACH * net.stride if margin is None else margin
    if tile is not None and (tile <= 0 or tile % net.stride or margin < 0 or margin % net.stride):
        raise ValueError(f"tile, margin: expected multiples of the stride {net.stride}, got {tile}, {margin}")
    whole_number("look_ahead", look_ahead, 0)

    @eqx.filter_jit
    def step(net, frame, state):
        return net(frame, state)

    begin = partial(_Pass, net, step, tile, margin, mirrored)
    frames = _of_one_size(frames)
    if not look_ahead:
        yield from map(begin(), frames)
        return
    forward, seen, held = begin(), 0, []
    for frame in frames:
        held.append((frame, forward(frame)))
        if len(held) == 2 * look_ahead:
            yield from _merged(held, begin(), seen)[:look_ahead]
            seen, held = seen + look_ahead, held[look_ahead:]
    yield from _merged(held, begin(), seen)


def _of_one_size(frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    shape = None
    for number, frame in enumerate(map(np.asarray, frames)):
        if shape is not None and frame.shape != shape:
            raise ValueError(f"frames: frame {number} has shape {frame.shape}, those before {shape}")
        shape = frame.shape
        yield frame


class _Pass:
    """The network on its way through frames of one size, tile by tile."""

    def __init__(self, net: STLSTM, step: Callable, tile: int | None, margin: int, mirrored: bool):
        self.net, self.step, self.tile, self.margin = net, step, tile, margin
        self.views = (1, -1) if mirrored else (1,)  # directions of columns
        self.states: dict[tuple[int, ...], State] = {}

    def __call__(self, frame: np.ndarray) -> np.ndarray:
        """The next frame [row, column, channel], enhanced."""
        return np.mean([self._of_view(frame[:, ::view], view)[:, ::view] for view in self.views], axis=0)

    def _of_view(self, frame: np.ndarray, view: int) -> np.ndarray:
        out = np.empty(frame.shape, np.float32)
        for whole, inner, target in _tiles(frame.shape[:2], self.tile, self.margin):
            part = jnp.asarray(frame[whole], jnp.float32)
            place = view, *(of.start for of in target)
            state = self.states.get(place) or self.net.init_state(part.shape[:2])
            enhanced, self.states[place] = self.step(self.net, part, state)
            out[target] = np.asarray(enhanced)[inner]
        return out


def _merged(held: list[tuple[np.ndarray, np.ndarray]], backward: _Pass, seen: int) -> list[np.ndarray]:
    """Results of held frames: what they became forward, after `seen` others, averaged with a pass backward."""
    after = [backward(frame) for frame, _ in reversed(held)][::-1]
    shares = [np.float32(share_of_past(seen + i + 1, len(held) - i)) for i in range(len(held))]
    return [a * one + (1 - a) * other for a, (_, one), other in zip(shares, held, after, strict=True)]


def share_of_past(seen, ahead):
    """Weight of a frame's result forward, after `seen` frames, beside that backward, after `ahead`, both with it."""
    past = np.minimum(seen, FILLED)
    return past / (past + np.minimum(ahead, FILLED))


def both_ways(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Results [time, ...] forward and backward, both in the order of time, averaged as `enhance` does."""
    seen = np.arange(1, len(before) + 1)
    share = share_of_past(seen, seen[::-1]).astype(before.dtype).reshape(-1, *[1] * (before.ndim - 1))
    return share * before + (1 - share) * after


def _tiles(shape: tuple[int, int], tile: int | None, margin: int) -> Iterator[tuple[tuple[slice, ...], ...]]:
    """For each tile: the part of the frame to read, the part of that to keep, and where it goes."""
    if tile is None:
        everything = (slice(0, shape[0]), slice(0, shape[1]))
        yield everything, everything, everything
        return
    for top in range(0, shape[0], tile):
        for left in range(0, shape[1], tile):
            target, whole, inner = [], [], []
            for start, size in ((top, shape[0]), (left, shape[1])):
                first, last = max(start - margin, 0), min(start + tile + margin, size)
                stop = min(start + tile, size)
                target.append(slice(start, stop))
                whole.append(slice(first, last))
                inner.append(slice(start - first, stop - first))
            yield tuple(whole), tuple(inner), tuple(target)


def total_variation(frames: jax.Array) -> jax.Array:
    """Sum of absolute differences of neighbouring pixels [..., row, column, channel], mean over frames."""
    down = jnp.abs(jnp.diff(frames, axis=-3)).sum((-3, -2, -1))
    across = jnp.abs(jnp.diff(frames, axis=-2)).sum((-3, -2, -1))
    return jnp.mean(down + across)


def loss(enhanced: jax.Array, clean: jax.Array, perceptual=None) -> jax.Array:
    """Equation 10 of the paper: 5 L2 + L1 + 0.06 perceptual + 2e-6 total variation, mean over frames.

    Args:
        enhanced, clean: [..., row, column, channel].
        perceptual: features of frames, such as those of VGG-16; None leaves that term out.
    """
    difference = enhanced - clean
    value = L2 * jnp.mean(difference**2) + L1 * jnp.mean(jnp.abs(difference))
    value = value + TOTAL_VARIATION * total_variation(enhanced)
    if perceptual is not None:
        value = value + PERCEPTUAL * jnp.mean((perceptual(enhanced) - perceptual(clean)) ** 2)
    return value
