"""The enhancer in PyTorch, with our weights, to compare the time of a training step."""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np
import torch
from torch.nn import functional

from hsnoise.stlstm import FORGET_BIAS, L1, L2, STLSTM, TOTAL_VARIATION, Convolution

Weights = dict[str, torch.Tensor]


def weights_of(net: STLSTM) -> Weights:
    """Parameters by name, kernels as [out, in, row, column]."""
    named: dict[str, Convolution] = {"features": net.features, "output": net.output}
    for i, cell in enumerate(net.cells):
        parts = ("of_input", "of_hidden", "of_memory", "of_both", "merge")
        named |= {f"{i}.{part}": getattr(cell, part) for part in parts}
    weights = {}
    for name, convolution in named.items():
        kernel = torch.tensor(np.asarray(convolution.weight).transpose(3, 2, 0, 1))
        weights[f"{name}.weight"] = kernel.contiguous(memory_format=torch.channels_last).requires_grad_()
        weights[f"{name}.bias"] = torch.tensor(np.asarray(convolution.bias)).requires_grad_()
    return weights


def device() -> torch.device:
    """Where JAX computes, too."""
    return torch.device("cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu")


def training_step(net: STLSTM, noisy: np.ndarray, clean: np.ndarray, rate: float) -> Callable[[], float]:
    """A function that takes one step of Adam on frames [time, batch, row, column, channel] and returns the loss."""
    with device():
        weights = weights_of(net)
        given, wanted = (_channels_first(x) for x in (noisy, clean))
    optimiser = torch.optim.Adam(weights.values(), lr=rate)

    def step() -> float:
        optimiser.zero_grad()
        with device():
            value = _loss(_video(weights, given, net.maps, len(net.cells), net.stride), wanted)
        value.backward()
        torch.nn.utils.clip_grad_norm_(weights.values(), 1.0)
        optimiser.step()
        return float(value.detach())

    return step


def _channels_first(frames: np.ndarray) -> list[torch.Tensor]:
    turned = torch.tensor(np.asarray(frames, np.float32).transpose(0, 1, 4, 2, 3))
    return [frame.contiguous(memory_format=torch.channels_last) for frame in turned]


def _convolved(weights: Weights, name: str, x: torch.Tensor) -> torch.Tensor:
    return functional.conv2d(x, weights[f"{name}.weight"], weights[f"{name}.bias"], padding="same")


def _to_blocks(x: torch.Tensor, stride: int) -> torch.Tensor:
    batch, channels, rows, columns = x.shape
    x = x.reshape(batch, channels, rows // stride, stride, columns // stride, stride).permute(0, 3, 5, 1, 2, 4)
    x = x.reshape(batch, -1, rows // stride, columns // stride)
    return x.contiguous(memory_format=torch.channels_last)


def _from_blocks(x: torch.Tensor, stride: int) -> torch.Tensor:
    batch, _, rows, columns = x.shape
    x = x.reshape(batch, stride, stride, -1, rows, columns).permute(0, 3, 4, 1, 5, 2)
    return x.reshape(batch, -1, rows * stride, columns * stride)


def _cell(weights: Weights, layer: int, x, hidden, cell, memory):
    x_g, x_i, x_f, x_gm, x_im, x_fm, x_o = _convolved(weights, f"{layer}.of_input", x).chunk(7, 1)
    h_g, h_i, h_f, h_o = _convolved(weights, f"{layer}.of_hidden", hidden).chunk(4, 1)
    m_g, m_i, m_f = _convolved(weights, f"{layer}.of_memory", memory).chunk(3, 1)
    cell = torch.sigmoid(x_f + h_f + FORGET_BIAS) * cell + torch.sigmoid(x_i + h_i) * torch.tanh(x_g + h_g)
    memory = torch.sigmoid(x_fm + m_f + FORGET_BIAS) * memory + torch.sigmoid(x_im + m_i) * torch.tanh(x_gm + m_g)
    both = torch.cat([cell, memory], 1)
    open_to = torch.sigmoid(x_o + h_o + _convolved(weights, f"{layer}.of_both", both))
    return open_to * torch.tanh(_convolved(weights, f"{layer}.merge", both)), cell, memory


def _video(weights: Weights, frames: list[torch.Tensor], maps: int, layers: int, stride: int) -> list[torch.Tensor]:
    batch, _, rows, columns = frames[0].shape
    memory = torch.zeros(batch, maps, rows // stride, columns // stride).to(memory_format=torch.channels_last)
    hidden, cells, out = [memory] * layers, [memory] * layers, []
    for frame in frames:
        features = _convolved(weights, "features", _to_blocks(torch.arcsinh(frame), stride))
        x = features
        for i in range(layers):
            x, cells[i], memory = _cell(weights, i, x, hidden[i], cells[i], memory)
            hidden[i] = x
        out.append(_from_blocks(_convolved(weights, "output", x + features), stride))
    return out


def _loss(enhanced: list[torch.Tensor], clean: list[torch.Tensor]) -> torch.Tensor:
    got, wanted = torch.stack(enhanced), torch.stack(clean)
    difference = got - wanted
    variation = sum(got.diff(dim=axis).abs().sum((2, 3, 4)) for axis in (3, 4))
    return L2 * difference.square().mean() + L1 * difference.abs().mean() + TOTAL_VARIATION * variation.mean()
