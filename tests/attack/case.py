"""What a case of the attack is, and bytes that are broken at random."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from captures import CLEAN

Bytes = Callable[[bytes, np.random.Generator], bytes]


@dataclass(frozen=True)
class Case:
    """One thing that is broken: `make` writes the capture to a folder.

    A case that no reader can notice, such as another pixel where a format has no checksum, is not `knowable`: its
    numbers may differ, but it must neither crash nor hang, nor end in an error of another kind. A case that is `drawn`
    is another one for each seed.
    """

    format: str
    name: str
    make: Callable[[Path, np.random.Generator], Any]
    knowable: bool = True
    drawn: bool = False


def edited(format: str, name: str, edit: Bytes, **more: bool) -> Case:
    """The clean capture, of whose first file the bytes are edited."""
    write, first = CLEAN[format]

    def make(folder: Path, rng: np.random.Generator) -> None:
        write(folder)
        (folder / first).write_bytes(edit((folder / first).read_bytes(), rng))

    return Case(format, name, make, **more)


def truncated(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: rng.integers(len(content))]


def flipped(content: bytes, rng: np.random.Generator, first: int = 0, end: int | None = None) -> bytes:
    out = bytearray(content)
    out[rng.integers(first, len(out) if end is None else end)] ^= 1 << int(rng.integers(8))
    return bytes(out)


def flipped_often(content: bytes, rng: np.random.Generator) -> bytes:
    for _ in range(rng.integers(2, 20)):
        content = flipped(content, rng)
    return content


def flipped_early(content: bytes, rng: np.random.Generator) -> bytes:
    """Where most formats have their headers."""
    return flipped(content, rng, 0, min(512, len(content)))


def zeroed(content: bytes, rng: np.random.Generator) -> bytes:
    first = int(rng.integers(len(content)))
    return content[:first] + bytes(min(64, len(content) - first)) + content[first + 64 :]


def shortened(content: bytes, rng: np.random.Generator) -> bytes:
    first = int(rng.integers(len(content)))
    return content[:first] + content[first + int(rng.integers(1, 9)) :]


def lengthened(content: bytes, rng: np.random.Generator) -> bytes:
    first = int(rng.integers(len(content)))
    return content[:first] + rng.bytes(int(rng.integers(1, 9))) + content[first:]


def exchanged(content: bytes, rng: np.random.Generator) -> bytes:
    """Two blocks of the file, one for the other."""
    block = len(content) // 8
    one, other = sorted(rng.choice(8, 2, replace=False) * block)
    blocks = [content[:one], content[one : one + block], content[one + block : other], content[other : other + block]]
    return b"".join(blocks[i] for i in (0, 3, 2, 1)) + content[other + block :]
