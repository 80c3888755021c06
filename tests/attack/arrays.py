"""Broken .npy, .npz and HDF5 files."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import captures
import h5py
import numpy as np
from captures import FIELDS, SHAPE, frames
from case import Case, edited, flipped


def wrong_counts() -> dict[str, Any]:
    """Counts that are none, and some that only are stored otherwise."""
    nan, negative, zeros = frames(float), frames(np.int32), frames()
    nan[2, 5, 7], negative[1, 3, 3], zeros[2] = np.nan, -1, 0
    return {
        "NaN": nan,
        "infinity": np.where(np.isnan(nan), np.inf, nan),
        "fractions": frames(float) + 0.5,
        "a single fraction": frames(float) + 0.5 * (np.indices(SHAPE).sum(0) == 40),
        "negative": negative,
        "too large": frames(np.float64) * 1e9,
        "zeros last": zeros,
        "complex": frames(complex),
        "text": frames().astype("S5"),
        "unicode": frames().astype("U5"),
        "truth": frames() > 1000,
        "times": frames().astype("timedelta64[ms]"),
        "structured": frames().view([("low", "u1"), ("high", "u1")]),
        "one line": frames().ravel(),
        "five axes": frames()[None, None],
        "no frame": frames()[:0],
        "no rows": frames()[:, :0],
        "one frame": frames()[:1],
        "a number": np.uint16(3),
        "colours": np.stack([frames()] * 3, -1),
        "other byte order": frames().astype(">u2"),
        "in columns": np.asfortranarray(frames()),
        "64 bits": frames(np.int64),
        "doubles": frames(float),
        "half": frames(np.float16),
    }


WRONG: dict[str, tuple[Any, ...]] = {
    "exposure_s": (
        np.nan,
        np.inf,
        -1.0,
        "long",
        "0.25",
        "",
        b"\xff",
        True,
        [],
        [0.25, 1.0],
        [[0.25]],
        0.25j,
        np.timedelta64(250, "ms"),
        np.timedelta64("NaT"),
        np.datetime64("2020-01-01"),
        np.float16(0.25),
        np.zeros(1, [("a", "f8")])[0],
    ),
    "kind": ("dork", "", 3, np.nan, ["dark", "flat"], [], [["dark"]], b"\xff\xfe", True, "DARK", "dark " * 1000),
    "cfa": ("XYZW", "", "rggb", 3, np.nan, ["RGGB"], ["RGGB", "BGGR"], b"RG", [0, 1, 1, 2], True, [], "R" * 10_000),
    "black_level": (np.nan, np.inf, -1.0, 1e9, "abc", [1.0, 2.0], [1.0] * 4, [], 900j, True, 4095.0, [[900.0]], 1e308),
    "white_level": (np.nan, -np.inf, -1.0, 0.0, 10.0, 900.0, "x", [1.0, 2.0], [], 4095j, True, [[4095.0]]),
    "shutter": ("global ", "", "open", 3, np.nan, ["rolling"], [], b"\xff", True),
    "iso": (np.nan, -1.0, np.inf, 0.0, "x", [1.0, 2.0], [], 1j, True, 1e308),
    "temperature_c": (np.nan, np.inf, -1e9, "cold", [1.0, 2.0], [], 1j, True),
}


def _wrong_fields() -> Iterator[tuple[str, Any, str]]:
    for field, values in WRONG.items():
        for value in values:
            yield field, value, f"{field} {value!r:.40}"


def npy() -> Iterator[Case]:
    for name, counts in wrong_counts().items():
        yield Case("npy", f"counts: {name}", lambda folder, _, c=counts: captures.npy(folder / "a.npy", c))
    yield Case("npy", "objects", lambda folder, _: captures.npy(folder / "a.npy", np.array([{}, 1], object)))
    for old, new in (
        ("(3, 16, 24)", "(2, 16, 24)"),
        ("(3, 16, 24)", "(4, 16, 24)"),
        ("(3, 16, 24)", "(3, 16, -4)"),
        ("(3, 16, 24)", "(3, 1.5,24)"),
        ("(3, 16, 24)", "'3, 16, 24'"),
        ("(3, 16, 24)", "(3, 9**9*9)"),
        ("(3, 16, 24)", "(9999999999999999, 16, 24)"),
        ("(3, 16, 24)", "(10000, 1000, 1000)"),
        ("(3, 16, 24)", "(1, 3, 16, 24)"),
        ("(3, 16, 24)", "(0, 16, 24)"),
        ("'<u2'", "'<u8'"),
        ("'<u2'", "'<u1'"),
        ("'<u2'", "'|O2'"),
        ("'<u2'", "'<U0'"),
        ("'<u2'", "3"),
        ("False", "'no'"),
        ("'shape'", "'shade'"),
        ("{", "{" * 50),
        ("{", "["),
    ):
        edit = _npy_header(old, new)
        yield edited("npy", f"{old} is {new:.30}", lambda content, _, edit=edit: edit(content))
    for version in (0, 2, 3, 9):
        yield edited("npy", f"version {version}", lambda c, _, v=version: c[:6] + bytes([v]) + c[7:])
    for length in (0, 10, 117, 65535):
        yield edited("npy", f"header of {length}", lambda c, _, n=length: c[:8] + struct.pack("<H", n) + c[10:])


def _npy_header(old: str, new: str) -> Callable[[bytes], bytes]:
    def edit(content: bytes) -> bytes:
        header = content[10:128].rstrip().replace(old.encode(), new.encode())
        length = -(-(len(header) + 11) // 64) * 64 - 10
        return content[:8] + struct.pack("<H", length) + header.ljust(length - 1) + b"\n" + content[128:]

    return edit


def npz() -> Iterator[Case]:
    for field, value, name in _wrong_fields():
        yield Case("npz", name, lambda folder, _, f=field, v=value: captures.npz(folder / "a.npz", **{f: v}))
    for name, counts in wrong_counts().items():
        yield Case("npz", f"counts: {name}", lambda folder, _, c=counts: captures.npz(folder / "a.npz", counts=c))
    for old, new in (
        ("(3, 16, 24)", "(2, 16, 24)"),
        ("(3, 16, 24)", "(4, 16, 24)"),
        ("(3, 16, 24)", "(10000, 1000, 1000)"),
        ("'<u2'", "'<u1'"),
    ):
        yield Case("npz", f"counts.npy with {new}", _zipped(_npy_header(old, new)))
    yield Case("npz", "counts.npy given twice", _zipped(lambda content: content, times=2))
    yield Case("npz", "counts.npy is empty", _zipped(lambda _: b""))
    yield Case("npz", "counts.npy is text", _zipped(lambda _: b"no array"))
    yield Case("npz", "counts.npy packs zeros", _zipped(_npy_of_zeros))


def _npy_of_zeros(content: bytes) -> bytes:
    return _npy_header("(3, 16, 24)", "(400, 500, 500)")(content)[:128] + bytes(200_000_000)


def _zipped(edit: Callable[[bytes], bytes], times: int = 1) -> Callable[[Path, Any], None]:
    """An .npz file with another member of counts."""

    def make(folder: Path, _: Any) -> None:
        buffer = io.BytesIO()
        np.save(buffer, frames())
        with zipfile.ZipFile(folder / "a.npz", "w", zipfile.ZIP_DEFLATED) as file:
            for i in range(times):
                file.writestr(zipfile.ZipInfo("counts.npy"), edit(buffer.getvalue())[: -2 * i or None])
            for name, value in FIELDS.items():
                with file.open(f"{name}.npy", "w") as member:
                    np.save(member, value)

    return make


# HDF5


def hdf5() -> Iterator[Case]:
    def changed(change: Callable[[h5py.File], Any]) -> Callable[[Path, Any], None]:
        def make(folder: Path, _: Any) -> None:
            captures.hdf5(folder / "a.h5")
            with h5py.File(folder / "a.h5", "r+") as file:
                change(file)

        return make

    def attribute(field: str, value: Any) -> Callable[[h5py.File], None]:
        return lambda file: file.attrs.__setitem__(field, value)

    def data_set(field: str, **options: Any) -> Callable[[h5py.File], None]:
        def change(file: h5py.File) -> None:
            del file.attrs[field]
            file.create_dataset(field, **options)

        return change

    for field, value, name in _wrong_fields():
        if not isinstance(value, np.datetime64 | np.timedelta64):  # HDF5 has no times
            yield Case("hdf5", f"attribute {name}", changed(attribute(field, value)))
    for name, counts in wrong_counts().items():
        if np.asarray(counts).dtype.kind not in "Um":
            yield Case("hdf5", f"counts: {name}", lambda folder, _, c=counts: captures.hdf5(folder / "a.h5", c))
    for field in FIELDS:
        yield Case("hdf5", f"{field} is Empty", changed(attribute(field, h5py.Empty("f8"))))
        yield Case("hdf5", f"{field} is a null data set", changed(data_set(field, data=h5py.Empty("f8"))))
        never = data_set(field, shape=(10**10,), dtype="f8", chunks=True)
        yield Case("hdf5", f"{field} is never written", changed(never))
        yield Case("hdf5", f"{field} is a group", changed(lambda file, f=field: file.create_group(f)))
        yield Case("hdf5", f"{field} leads outside", changed(_linked(field, h5py.ExternalLink("b.h5", "/a"))))
        yield Case("hdf5", f"{field} leads nowhere", changed(_linked(field, h5py.SoftLink("/nowhere"))))
        yield Case("hdf5", f"{field} leads to itself", changed(_linked(field, h5py.SoftLink(f"/{field}"))))
        yield Case("hdf5", f"{field} is a reference", changed(lambda file, f=field: _refer(file, f)))
    enumeration = h5py.enum_dtype({"DARK": 0, "FLAT": 1}, basetype="i4")
    yield Case("hdf5", "kind is an enumeration", changed(lambda f: f.attrs.create("kind", 0, dtype=enumeration)))
    yield Case("hdf5", "packed", lambda folder, _: captures.hdf5(folder / "a.h5", compression="gzip", chunks=SHAPE))
    for i in range(4):
        yield Case("hdf5", f"flipped below a checksum {i}", _flipped_chunk, drawn=True)
    yield Case("hdf5", "declares 20 GB", changed(_large))


def _large(file: h5py.File) -> None:
    del file["counts"]
    file.create_dataset("counts", shape=(10_000, 1000, 1000), dtype="u2", chunks=(1, 1000, 1000))


def _linked(field: str, link: Any) -> Callable[[h5py.File], None]:
    return lambda file: file.__setitem__(field, link)


def _refer(file: h5py.File, field: str) -> None:
    file.attrs.create(field, file["counts"].ref, dtype=h5py.ref_dtype)


def _flipped_chunk(folder: Path, rng: np.random.Generator) -> None:
    path = folder / "a.h5"
    captures.hdf5(path, fletcher32=True, chunks=SHAPE)
    with h5py.File(path) as file:
        chunk = file["counts"].id.get_chunk_info(0)
    path.write_bytes(flipped(path.read_bytes(), rng, chunk.byte_offset, chunk.byte_offset + chunk.size))
