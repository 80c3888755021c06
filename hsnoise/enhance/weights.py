"""Networks and checkpoints on disk: one line of JSON that describes the arrays, then the arrays.

Files are written whole or not at all, and a hash reveals truncated or changed ones.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from hsnoise._core.output import write_atomically
from hsnoise.stlstm import STLSTM

FORMAT = "hsnoise arrays 2"
SHIPPED = {  # each described by the .txt file beside it
    camera: Path(__file__).parent / "data" / f"enhancer_{camera}.eqx" for camera in ("canon_5d3", "grasshopper3")
}
FOR_OTHERS = "canon_5d3"  # the shipped weights for cameras that are not built in


def write_arrays(path: str | os.PathLike, tree: Any, about: Mapping[str, Any]) -> None:
    """Write the arrays of a PyTree and their description `about` (anything that JSON can hold).

    Raises:
        OSError: the folder does not exist or is full; an existing file is left as it was.
    """
    buffer = io.BytesIO()
    eqx.tree_serialise_leaves(buffer, tree)
    content = buffer.getvalue()
    header = {"format": FORMAT, "sha256": _digest(_json(about) + content), "about": dict(about)}
    write_atomically(path, _json(header) + b"\n" + content)


def _json(mapping: Mapping[str, Any]) -> bytes:
    return json.dumps(dict(mapping)).encode()


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def read_arrays(path: str | os.PathLike, like: Any) -> tuple[Any, dict[str, Any]]:
    """The PyTree that `write_arrays` wrote, with the structure and shapes of `like`, and its description.

    Raises:
        ValueError: another kind of file, a truncated or changed one, or arrays of other shapes.
    """
    about, content = _read(path)
    return _restored(path, content, like), about


def _restored(path: str | os.PathLike, content: bytes, like: Any) -> Any:
    try:
        return eqx.tree_deserialise_leaves(io.BytesIO(content), like)
    except (RuntimeError, EOFError, ValueError, TypeError) as error:
        raise ValueError(f"{path}: holds arrays of another network or optimiser ({_first_line(error)})") from error


def _read(path: str | os.PathLike) -> tuple[dict[str, Any], bytes]:
    first, newline, content = Path(path).read_bytes().partition(b"\n")
    try:
        header = json.loads(first)
        known, about = header["format"] == FORMAT, header["about"]
        whole = newline == b"\n" and _digest(_json(about) + content) == header["sha256"]
    except (ValueError, KeyError, TypeError, RecursionError):
        known = whole = False
    if not known:
        raise ValueError(f"{path}: not a file of weights or a checkpoint of hsnoise")
    if not whole:
        raise ValueError(f"{path}: truncated, or changed since it was written")
    return about, content


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__


def save_network(path: str | os.PathLike, net: STLSTM, about: Mapping[str, Any]) -> None:
    """Write a network with its sizes; `about` describes its training. Raises OSError as `write_arrays`."""
    write_arrays(path, net, {**about, "network": sizes_of(net)})


def load_network(path: str | os.PathLike) -> tuple[STLSTM, dict[str, Any]]:
    """The network in a file of `save_network`, and the description of its training.

    Raises:
        ValueError: a file without a network, with one that is not finite, or a truncated or changed file.
    """
    about, content = _read(path)
    if "network" not in about:
        raise ValueError(f"{path}: holds no network; give the weights.eqx of a training run, not a checkpoint")
    try:
        like = eqx.filter_eval_shape(STLSTM, jax.random.key(0), **about["network"])
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path}: its header describes no network ({_first_line(error)})") from error
    net = _restored(path, content, like)
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(net)):
        raise ValueError(f"{path}: expected finite weights, got NaN or infinity")
    return net, about


def sizes_of(net: STLSTM) -> dict[str, Any]:
    """The arguments that build a network of these sizes."""
    return {"maps": net.maps, "kernels": list(net.kernels), "stride": net.stride, "channels": net.channels}
