"""Features of VGG-16 for the perceptual term of the loss, from the user's weights file.

Reference: Simonyan and Zisserman, "Very deep convolutional networks for large-scale image recognition", ICLR 2015;
Johnson, Alahi, Fei-Fei, "Perceptual losses for real-time style transfer and super-resolution", ECCV 2016 (relu2_2).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

# Convolutions up to relu2_2: position in torchvision's `features`, inputs, outputs; a pool follows the second.
LAYERS = ((0, 3, 64), (2, 64, 64), (5, 64, 128), (7, 128, 128))
POOL_AFTER = 2
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # torchvision's normalisation
KNOWN = {"397923af": "VGG16_Weights.IMAGENET1K_V1"}  # torchvision's file names hold the start of the hash


def read_weights(path: Path) -> tuple[dict[str, np.ndarray], str]:
    """State dict of torchvision's VGG-16 (.safetensors, or .pth, which needs torch), and SHA-256 of the file.

    Raises:
        ValueError: an unknown format, a file that cannot be read, or arrays that are missing, of wrong shape or not
            finite.
        ImportError: the library that reads the format is not installed.
    """
    if not path.is_file():
        raise ValueError(f"--vgg: there is no file {path}")
    if path.suffix not in (".safetensors", ".pth", ".pt"):
        raise ValueError(f"--vgg: expected a .safetensors or .pth file, got {path}")
    shapes = {}
    for place, inputs, outputs in LAYERS:
        shapes |= {f"features.{place}.weight": (outputs, inputs, 3, 3), f"features.{place}.bias": (outputs,)}
    try:
        state = _read_safetensors(path) if path.suffix == ".safetensors" else _read_pickle(path)
        state = {name: np.asarray(state[name], np.float32) for name in shapes if name in state}
    except ImportError:
        raise
    except Exception as error:  # pickles and archives can fail in countless ways
        raise ValueError(f"--vgg: {path} cannot be read ({type(error).__name__}: {error})") from error
    for name, shape in shapes.items():
        found = state[name].shape if name in state else "nothing"
        if found != shape:
            raise ValueError(f"--vgg: {path}: expected {name} of shape {shape}, got {found}")
        if not np.isfinite(state[name]).all():
            raise ValueError(f"--vgg: {path}: expected finite numbers in {name}, got NaN or infinite ones")
    return state, hashlib.sha256(path.read_bytes()).hexdigest()


def _read_safetensors(path: Path) -> dict[str, np.ndarray]:
    try:
        from safetensors.numpy import load_file
    except ImportError as error:
        raise ImportError(f"--vgg: {path} needs safetensors: pip install 'hsnoise[vgg]'") from error
    return load_file(path)


def _read_pickle(path: Path) -> dict[str, np.ndarray]:
    try:
        import torch
    except ImportError as error:
        raise ImportError(f"--vgg: {path} needs PyTorch: pip install torch; a .safetensors file does not") from error
    state = torch.load(path, map_location="cpu", weights_only=True)
    return {name: value.detach().float().numpy() for name, value in state.items() if str(name).startswith("features.")}


def features_of(state: dict[str, np.ndarray]) -> Callable[[jax.Array], jax.Array]:
    """The function from display values [..., row, column, 3 or 1] to features relu2_2."""
    layers = [
        (
            jnp.asarray(state[f"features.{place}.weight"].transpose(2, 3, 1, 0)),
            jnp.asarray(state[f"features.{place}.bias"]),
        )
        for place, _, _ in LAYERS
    ]

    def features(frames: jax.Array) -> jax.Array:
        x = jnp.broadcast_to(jnp.asarray(frames, jnp.float32), (*frames.shape[:-1], 3)).reshape(
            -1, *frames.shape[-3:-1], 3
        )
        x = (x - np.float32(MEAN)[None, None, None]) / np.float32(DEVIATION)[None, None, None]
        for i, (weight, bias) in enumerate(layers):
            if i == POOL_AFTER:
                x = jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 2, 2, 1), (1, 2, 2, 1), "VALID")
            x = jax.lax.conv_general_dilated(x, weight, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))
            x = jax.nn.relu(x + bias[None, None, None])
        return x

    return features


def name_of(digest: str) -> str:
    """The name of known weights by their hash."""
    return KNOWN.get(digest[:8], f"weights of unknown origin, SHA-256 {digest[:8]}")
