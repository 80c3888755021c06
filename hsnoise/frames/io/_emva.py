"""Folders with EMVA1288_Data.txt, the descriptor of the EMVA 1288 standard that lists the images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from hsnoise.frames.io._files import reader_name
from hsnoise.frames.io._recording import Recording, naming

DESCRIPTOR = "EMVA1288_Data.txt"
MOST_BITS = 32
KINDS = {"b": "flat", "d": "dark"}  # bright, dark


def read(folder: Path) -> list[Recording]:
    """The images that the descriptor lists, with kind and exposure; white is the largest code of its bit depth.

    Its rows are `n bits rows columns`, then `b exposure_ns photons` or `d exposure_ns`, followed by `i image` for each.

    Raises:
        ValueError: a row of another form, or an image that cannot be read.
    """
    path = folder / DESCRIPTOR
    with naming(path):
        found = list(_images(path))
        if not found:
            raise ValueError("expected lines that begin with i, one an image, got none")
        return found


def _white_level(bits: int) -> float:
    if not 0 < bits <= MOST_BITS:
        raise ValueError(f"n: expected 1 to {MOST_BITS} bits, got {bits}")
    return 2.0**bits - 1


def _images(path: Path) -> Iterator[Recording]:
    kind, exposure_s, white_level = "", 0.0, None
    for line in path.read_text().splitlines():
        word, *values = line.split() or ["#"]
        if word in ("n", "i", *KINDS) and not values:
            raise ValueError(f"expected a value after {word!r}, got {line!r}")
        if word == "n":
            white_level = _white_level(int(values[0]))
        elif word in KINDS:
            kind, exposure_s = KINDS[word], float(values[0]) * 1e-9
        elif word == "i":
            image = path.parent / values[0].replace("\\", "/")
            reader = reader_name(image)
            if reader is None or not kind:
                raise ValueError(f"expected images of a known format below a line 'b' or 'd', got {line!r}")
            for recording in import_module(f"hsnoise.frames.io.{reader}").read(image):
                yield replace(recording, kind=kind, exposure_s=exposure_s, white_level=white_level)
        elif word != "v" and not word.startswith("#"):
            raise ValueError(f"expected lines that begin with n, b, d, i, v or #, got {line!r}")
