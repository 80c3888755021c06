"""The grammar of the attack: valid captures with one thing broken, as a table of cases.

A case that no reader can notice, such as another pixel where a format has no checksum, is not `knowable`: its numbers
may differ, but it must neither crash nor hang, nor end in an error of another kind.
"""

from __future__ import annotations

import gzip
import io
import itertools
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import captures
import h5py
import numpy as np
from captures import CLEAN, FIELDS, FILLERS, SHAPE, frames

Bytes = Callable[[bytes, np.random.Generator], bytes]


@dataclass(frozen=True)
class Case:
    """One thing that is broken: `make` writes the capture to a folder."""

    format: str
    name: str
    make: Callable[[Path, np.random.Generator], Any]
    knowable: bool = True


def cases() -> list[Case]:
    """All of them, in an order that meets every format early."""
    tables = [_of_any_format(), _npy(), _npz(), _hdf5(), _fits(), _tiff(), _png()]
    found = [case for table in tables for case in table]
    return [found[i] for i in np.random.default_rng(2).permutation(len(found))]


# Files as bytes


def _edited(format: str, name: str, edit: Bytes, knowable: bool = True) -> Case:
    """The clean capture, of whose first file the bytes are edited."""
    write, first = CLEAN[format]

    def make(folder: Path, rng: np.random.Generator) -> None:
        write(folder)
        (folder / first).write_bytes(edit((folder / first).read_bytes(), rng))

    return Case(format, name, make, knowable)


def _truncated(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: rng.integers(len(content))]


def _flipped(content: bytes, rng: np.random.Generator, first: int = 0, end: int | None = None) -> bytes:
    out = bytearray(content)
    out[rng.integers(first, len(out) if end is None else end)] ^= 1 << int(rng.integers(8))
    return bytes(out)


def _zeroed(content: bytes, rng: np.random.Generator) -> bytes:
    first = int(rng.integers(len(content)))
    return content[:first] + bytes(min(64, len(content) - first)) + content[first + 64 :]


def _of_any_format() -> Iterator[Case]:
    checked = ("npz", "png", "fits.gz")  # formats with checksums
    for format, (_, first) in CLEAN.items():
        for i in range(4):
            yield _edited(format, f"truncated {i}", _truncated)
        for i in range(8 if format in checked else 3):
            yield _edited(format, f"flipped {i}", _flipped, knowable=format in checked)
        yield _edited(format, "zeroed", _zeroed, knowable=format in checked)
        yield _edited(format, "empty", lambda *_: b"")
        yield _edited(format, "first byte", lambda content, rng: _flipped(content, rng, 0, 1))
        yield _edited(format, "last byte gone", lambda content, rng: content[:-1])
        yield _edited(format, "random", lambda content, rng: rng.bytes(len(content)))
        yield _edited(format, "junk behind", lambda content, rng: content + rng.bytes(100))
        yield _edited(format, "twice", lambda content, rng: content * 2)
        yield _edited(format, "text", lambda *_: "Grüße\n".encode("utf-16") * 100)
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


# Arrays


def _wrong_counts() -> dict[str, Any]:
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


def _npy() -> Iterator[Case]:
    for name, counts in _wrong_counts().items():
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
        yield _edited("npy", f"{old} is {new:.30}", lambda content, _, edit=edit: edit(content))
    for version in (0, 2, 3, 9):
        yield _edited("npy", f"version {version}", lambda c, _, v=version: c[:6] + bytes([v]) + c[7:])
    for length in (0, 10, 117, 65535):
        yield _edited("npy", f"header of {length}", lambda c, _, n=length: c[:8] + struct.pack("<H", n) + c[10:])


def _npy_header(old: str, new: str) -> Callable[[bytes], bytes]:
    def edit(content: bytes) -> bytes:
        header = content[10:128].rstrip().replace(old.encode(), new.encode())
        length = -(-(len(header) + 11) // 64) * 64 - 10
        return content[:8] + struct.pack("<H", length) + header.ljust(length - 1) + b"\n" + content[128:]

    return edit


def _npz() -> Iterator[Case]:
    for field, value, name in _wrong_fields():
        yield Case("npz", name, lambda folder, _, f=field, v=value: captures.npz(folder / "a.npz", **{f: v}))
    for name, counts in _wrong_counts().items():
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


def _hdf5() -> Iterator[Case]:
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
    for name, counts in _wrong_counts().items():
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
        yield Case("hdf5", f"flipped below a checksum {i}", _flipped_chunk)
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
    path.write_bytes(_flipped(path.read_bytes(), rng, chunk.byte_offset, chunk.byte_offset + chunk.size))


# FITS


CARDS: dict[str, tuple[str, ...]] = {
    "SIMPLE": ("F", "3", "'T'"),
    "BITPIX": ("12", "-1", "0", "'16'", "32", "999999999999", "T"),
    "NAXIS": ("0", "1", "2", "4", "-3", "999", "T", "'3'"),
    "NAXIS1": ("0", "-24", "48", "2147483647", "99999999999999999999", "24.5", "T", "'a'"),
    "NAXIS2": ("0", "-16", "32", "2147483647", "1E3", "''"),
    "NAXIS3": ("0", "-3", "4", "2147483647", "1E400"),
    "BZERO": ("NaN", "'a'", "T", "-32768", "1E400", "0", "32768.5"),
    "BSCALE": ("0", "NaN", "'a'", "T", "1E400", "0.5"),
    "EXPTIME": ("T", "'abc'", "NaN", "-1.0", "1E400", "''", "(1.0, 2.0)", "0.2.5", "'0.25'"),
    "IMAGETYP": ("'dork'", "3", "T", "''", "'Master Dark'", "'dark' 'flat'", "dark"),
    "BAYERPAT": ("'XYZW'", "3", "T", "'RG'", "RGGB", "'rggb'"),
    "CCD-TEMP": ("NaN", "'cold'", "-1E9", "T", "1E400"),
}
ADDED = (
    "XBAYROFF= 'a'",
    "XBAYROFF= 1E9",
    "XBAYROFF= NaN",
    "YBAYROFF= 1.5",
    "YBAYROFF= T",
    "ROWORDER= 'BOTTOM-UP'",
    "XBINNING= 0",
    "XBINNING= NaN",
    "XBINNING= 1E300",
    "XBINNING= 'two'",
    "CCDSUM  = '0 0'",
    "CCDSUM  = '99999999999999999999999 1'",
    "GAIN    = NaN",
    "EGAIN   = 0",
    "EGAIN   = -1",
    "EGAIN   = 1E-320",
    "EGAIN   = 'e-'",
    "NCOMBINE= 7",
    "NCOMBINE= NaN",
    "BIASSEC = '[1:2]'",
    "BIASSEC = '[-5:0,9:9]'",
    "BIASSEC = '[99999999999999999999999999:1,1:1]'",
    "DATE-OBS= 3",
    "DATE-OBS= 'yesterday'",
    "SHUTTER = 'open'",
    "BLANK   = 1000",
    "BLANK   = 'a'",
    "GCOUNT  = 2",
    "PCOUNT  = -5",
    "PCOUNT  = 99999999999",
    "GROUPS  = T",
    "NAXIS4  = 5",
    "EXPTIME = 9.0",
    "EXTEND  = 3",
    "END",
    "CONTINUE  'and more'",
    "HIERARCH",
    "=",
    "\xff\xfe\x80",
    "exptime = 9.0",
    "OBJECT  = 'light'",
)


def _card(keyword: str, value: str) -> Bytes:
    def edit(content: bytes, _: Any) -> bytes:
        at = content.index(keyword.ljust(8).encode() + b"=")
        return content[:at] + f"{keyword:8}= {value:>20}".ljust(80).encode() + content[at + 80 :]

    return edit


def _added(text: str) -> Bytes:
    def edit(content: bytes, rng: np.random.Generator) -> bytes:
        at = content.index(f"COMMENT filler {rng.integers(FILLERS)}".encode())
        return content[:at] + text.encode("latin-1").ljust(80) + content[at + 80 :]

    return edit


def _without(keyword: str) -> Bytes:
    return lambda content, _: content.replace(keyword.ljust(8).encode(), b"COMMENT ", 1)


def _fits() -> Iterator[Case]:
    edits = {f"{name} = {value}": _card(name, value) for name, values in CARDS.items() for value in values}
    edits |= {f"added {text!r}": _added(text) for text in ADDED}
    edits |= {f"without {name}": _without(name) for name in (*CARDS, "END") if name != "BAYERPAT"}  # it may lack
    edits["lower case"] = lambda content, _: content[:2880].lower() + content[2880:]
    edits["no blanks"] = lambda content, _: content[:2880].replace(b" ", b"\0") + content[2880:]
    for name, edit in edits.items():
        yield _edited("fits", name, edit)
        if name[:5] in ("NAXIS", "BITPI", "added"):
            yield _edited("fits.gz", name, _unpacked(edit))
    for name in ("ZNAXIS1", "ZNAXIS3", "ZTILE1", "ZBITPIX", "NAXIS2", "PCOUNT", "TFIELDS", "ZVAL1", "THEAP"):
        for value in ("0", "-3", "7", "2147483647", "'a'"):
            yield _edited("fits.fz", f"{name} = {value}", _card_or_added(name, value))
    for name in ("'RICE_9'", "'GZIP_1'", "'HCOMPRESS_1'", "3"):
        yield _edited("fits.fz", f"ZCMPTYPE = {name}", _card_or_added("ZCMPTYPE", name))
    for name, counts in _wrong_counts().items():
        if np.asarray(counts).dtype.kind in "uif" and np.asarray(counts).dtype.itemsize > 1 and name != "half":
            yield Case("fits", f"counts: {name}", lambda folder, _, c=counts: _write_fits(folder, c))


def _write_fits(folder: Path, counts: Any) -> None:
    (folder / "a.fits").write_bytes(captures.fits_bytes(np.atleast_1d(counts)))


def _unpacked(edit: Bytes) -> Bytes:
    return lambda content, rng: gzip.compress(edit(gzip.decompress(content), rng), mtime=0)


def _card_or_added(keyword: str, value: str) -> Bytes:
    def edit(content: bytes, rng: np.random.Generator) -> bytes:
        if keyword.ljust(8).encode() + b"=" in content:
            at = content.rindex(keyword.ljust(8).encode() + b"=")
            return content[:at] + f"{keyword:8}= {value:>20}".ljust(80).encode() + content[at + 80 :]
        return _added(f"{keyword:8}= {value:>20}")(content, rng)

    return edit


# TIFF and DNG


TAGS = {  # with values that are none
    "width": (256, (0, 12, 48, 2**31)),
    "height": (257, (0, 8, 32, 2**31)),
    "bits": (258, (0, 7, 8, 12, 32, 64, 999)),
    "compression": (259, (0, 5, 7, 8, 9999)),
    "photometric": (262, (2, 9999)),
    "offsets": (273, (0, 2**32 - 1)),
    "samples": (277, (0, 3, 65535)),
    "rows a strip": (278, (0,)),
    "strip bytes": (279, (0, 100, 2**32 - 1)),
    "exposure": (captures.EXPOSURE, (0, 2**32 - 1)),
    "CFA": (captures.BAYER, (0, 2**32 - 1, 0x03030303)),
}


def _directory(content: bytes, page: int) -> tuple[int, list[int]]:
    """Where the entries of a page begin, and their tags."""
    (at,) = struct.unpack_from("<I", content, 4)
    for _ in range(page):
        (n,) = struct.unpack_from("<H", content, at)
        (at,) = struct.unpack_from("<I", content, at + 2 + 12 * n)
    (n,) = struct.unpack_from("<H", content, at)
    return at + 2, [struct.unpack_from("<H", content, at + 2 + 12 * i)[0] for i in range(n)]


def _entry(content: bytes, page: int, code: int) -> int:
    """Where the entry of a tag of a page begins."""
    at, codes = _directory(content, page)
    return at + 12 * codes.index(code)


def _sample_format(value: int, page: int) -> Bytes:
    """In place of the unit of resolution, which says nothing here."""

    def edit(content: bytes, _: Any) -> bytes:
        at = _entry(content, page, 296)
        return content[:at] + struct.pack("<HHII", 339, 3, 1, value) + content[at + 12 :]

    return edit


def _tag(code: int, part: str, value: int, page: int = 0) -> Bytes:
    offset, kind = {"code": (0, "<H"), "type": (2, "<H"), "count": (4, "<I"), "value": (8, "<I")}[part]

    def edit(content: bytes, _: Any) -> bytes:
        out = bytearray(content)
        struct.pack_into(kind, out, _entry(content, page, code) + offset, value)
        return bytes(out)

    return edit


def _rational(numerator: int, denominator: int) -> Bytes:
    def edit(content: bytes, _: Any) -> bytes:
        (at,) = struct.unpack_from("<I", content, _entry(content, 0, captures.EXPOSURE) + 8)
        return content[:at] + struct.pack("<II", numerator, denominator) + content[at + 8 :]

    return edit


def _next_page(value: int | None) -> Bytes:
    """The second page leads to `value`; None: back to the first."""

    def edit(content: bytes, _: Any) -> bytes:
        (first,) = struct.unpack_from("<I", content, 4)
        at, codes = _directory(content, 1)
        place = at + 12 * len(codes)
        return content[:place] + struct.pack("<I", first if value is None else value) + content[place + 4 :]

    return edit


def _tiff() -> Iterator[Case]:
    for format, page in itertools.product(("tiff", "raw"), (0, 1)):
        if format == "raw" and page:
            continue
        for name, (code, values) in TAGS.items():
            edits = {("value", value): value for value in values}
            edits |= {("type", value): value for value in (0, 1, 2, 5, 12, 99)}
            edits |= {("count", value): value for value in (0, 2, 2**31)}
            edits[("code", 65000)] = 65000
            for (part, _), value in edits.items():
                yield _edited(
                    format, f"page {page}: {part} of {name} is {value}", _tag(code, part, value, page), format == "tiff"
                )
        for value in (0, 3, 4, 5, 6, 99):
            edit = _sample_format(value, page)
            yield _edited(format, f"page {page}: sample format is {value}", edit, format == "tiff")
    for pair in ((1, 0), (0, 0), (2**32 - 1, 0)):
        yield _edited("tiff", f"exposure {pair}", _rational(*pair))
        yield _edited("raw", f"exposure {pair}", _rational(*pair))
    for value in (None, 1, 7, 2**32 - 1):
        yield _edited("tiff", f"the third page is at {value}", _next_page(value))
    yield _edited("tiff", "no directory", lambda content, _: content[:4] + bytes(4) + content[8:])
    yield _edited("tiff", "other byte order", lambda content, _: b"MM" + content[2:])
    yield _edited("tiff", "version 43", lambda content, _: content[:2] + b"\x2b\0" + content[4:])
    for name, counts in _wrong_counts().items():
        if np.asarray(counts).dtype.kind in "uif" and np.ndim(counts) == 3 and np.size(counts):
            yield Case("tiff", f"counts: {name}", lambda folder, _, c=counts: _write_tiff(folder, c))
    yield Case("tiff", "packed", lambda folder, _: _write_tiff(folder, None, compression="zlib"))
    yield Case("tiff", "packed and cut", _cut_tiff)


def _write_tiff(folder: Path, counts: Any, **options: Any) -> None:
    (folder / "a.tif").write_bytes(captures.tiff_bytes(counts, **options))


def _cut_tiff(folder: Path, rng: np.random.Generator) -> None:
    content = captures.tiff_bytes(compression="zlib")
    edit = _tag(279, "value", int(rng.integers(1, 200)), int(rng.integers(3)))
    (folder / "a.tif").write_bytes(edit(content, rng))


# PNG


def _png() -> Iterator[Case]:
    fields = {
        "width": (16, 4, (0, 12, 48, 2**31, 2**31 - 1)),
        "height": (20, 4, (0, 8, 32, 2**31 - 1, 2**32 - 1)),
        "depth": (24, 1, (0, 1, 2, 3, 4, 8, 32)),
        "colours": (25, 1, (1, 2, 3, 4, 6, 9)),
        "packing": (26, 1, (1, 255)),
        "filter": (27, 1, (1, 255)),
        "interlacing": (28, 1, (1, 2)),
    }
    for name, (at, size, values) in fields.items():
        for value in values:
            yield _edited("png", f"{name} is {value}", _png_header(at, size, value))
    for kind in (b"IHDR", b"IDAT", b"IEND"):
        yield _edited("png", f"without {kind.decode()}", _png_chunk(kind, lambda _: None))
        yield _edited("png", f"{kind.decode()} is empty", _png_chunk(kind, lambda _: b""))
    yield _edited("png", "pixels cut", _png_chunk(b"IDAT", lambda data: zlib.compress(zlib.decompress(data)[:300])))
    yield _edited("png", "stream cut", _png_chunk(b"IDAT", lambda data: data[: len(data) // 2]))
    yield _edited("png", "more pixels", _png_chunk(b"IDAT", lambda data: zlib.compress(zlib.decompress(data) * 2)))
    unknown = _png_chunk(b"IDAT", lambda data: zlib.compress(b"\x09" + zlib.decompress(data)[1:]))
    yield _edited("png", "unknown filter", unknown)


def _png_header(at: int, size: int, value: int) -> Bytes:
    return lambda content, _: _with_crc(content[:at] + value.to_bytes(size, "big") + content[at + size :])


def _with_crc(content: bytes) -> bytes:
    return content[:29] + struct.pack(">I", zlib.crc32(content[12:29])) + content[33:]


def _png_chunk(kind: bytes, change: Callable[[bytes], bytes | None]) -> Bytes:
    def edit(content: bytes, _: Any) -> bytes:
        out, at = content[:8], 8
        while at < len(content):
            (length,) = struct.unpack_from(">I", content, at)
            name, data = content[at + 4 : at + 8], content[at + 8 : at + 8 + length]
            new = change(data) if name == kind else data
            if new is not None:
                out += struct.pack(">I", len(new)) + name + new + struct.pack(">I", zlib.crc32(name + new))
            at += 12 + length
        return out

    return edit
