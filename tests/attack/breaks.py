"""The grammar of the attack: valid captures with one thing broken, as a table of cases."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import arrays
import case
import images
import numpy as np
from captures import CLEAN
from case import Case, edited

AT_RANDOM = {
    "truncated": case.truncated,
    "flipped": case.flipped,
    "flipped early": case.flipped_early,
    "flipped often": case.flipped_often,
    "zeroed": case.zeroed,
    "shortened": case.shortened,
    "lengthened": case.lengthened,
    "exchanged": case.exchanged,
}
ENDLESS = ("zeroed", "shortened", "lengthened", "exchanged")  # libhdf5 never returns from some heaps of text broken so
# What was found with them was mended, so they come first.
FOUND = (
    "zeroed",
    "flipped",
    "truncated",
    "black_level []",
    "cfa ''",
    "cfa ['RGGB']",
    "exposure_s True",
    "exposure_s [[0.25]]",
    "iso 0.0",
    "shutter 'open'",
    "temperature_c True",
    "kind is Empty",
    "counts: NaN",
    "counts: no frame",
    "counts: one frame",
    "counts: text",
    "counts.npy given twice",
    "counts.npy with (2, 16, 24)",
    "counts.npy with (10000, 1000, 1000)",
    "(3, 16, 24) is (2, 16, 24)",
    "'<u2' is '<u1'",
    "header of 117",
    "TFIELDS = 2147483647",
    "ZNAXIS3 = 2147483647",
    "ZNAXIS1 = 7",
    "NAXIS3 = 2147483647",
    "added 'EXPTIME = 9.0'",
    "added 'YBAYROFF= 1.5'",
    "added 'YBAYROFF= T'",
    "added 'EGAIN   = 1E-320'",
    "the third page is at None",
    "page 1: value of bits is 8",
    "page 1: value of offsets is 0",
    "page 1: type of offsets is 1",
    "page 0: type of exposure is 12",
    "page 0: value of photometric is 9999",
)
CHECKED = ("npz", "png", "fits.gz")  # formats with checksums


def cases() -> list[Case]:
    """All of them: after those that found something, in an order that meets every format early."""
    tables = [_of_any_format(), arrays.npy(), arrays.npz(), arrays.hdf5(), images.fits(), images.tiff(), images.png()]
    found = [one for table in tables for one in table]
    mixed = [found[i] for i in np.random.default_rng(2).permutation(len(found))]
    return sorted(mixed, key=lambda one: not one.name.endswith(FOUND))


def _of_any_format() -> Iterator[Case]:
    for format, (_, first) in CLEAN.items():
        for name, edit in AT_RANDOM.items():
            if format == "hdf5" and name in ENDLESS:
                continue
            yield edited(format, name, edit, knowable=format in CHECKED or name == "truncated", drawn=True)
        yield edited(format, "empty", lambda *_: b"")
        yield edited(format, "first byte", lambda content, rng: case.flipped(content, rng, 0, 1))
        yield edited(format, "last byte gone", lambda content, rng: content[:-1])
        yield edited(format, "random", lambda content, rng: rng.bytes(len(content)))
        yield edited(format, "junk behind", lambda content, rng: content + rng.bytes(100))
        yield edited(format, "twice", lambda content, rng: content * 2)
        yield edited(format, "text", lambda *_: "Grüße\n".encode("utf-16") * 100)
        for other, (write, name) in CLEAN.items():
            if other.split(".")[0] != format.split(".")[0]:
                yield Case(format, f"is {other}", _renamed(write, name, first))
        yield Case(format, "folder", lambda folder, _, first=first: (folder / first).mkdir())
        yield Case(format, "dangling link", lambda folder, _, first=first: (folder / first).symlink_to("nowhere"))


def _renamed(write: Callable[[Path], Any], name: str, new: str) -> Callable[[Path, Any], None]:
    def make(folder: Path, _: Any) -> None:
        write(folder)
        content = (folder / name).read_bytes()
        for path in folder.iterdir():
            path.unlink()
        (folder / new).write_bytes(content)

    return make
