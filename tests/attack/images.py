"""Broken FITS, TIFF, DNG and PNG files."""

from __future__ import annotations

import gzip
import itertools
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import captures
import numpy as np
from arrays import wrong_counts
from captures import FILLERS
from case import Bytes, Case, edited

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


def fits() -> Iterator[Case]:
    edits = {f"{name} = {value}": _card(name, value) for name, values in CARDS.items() for value in values}
    edits |= {f"added {text!r}": _added(text) for text in ADDED}
    edits |= {f"without {name}": _without(name) for name in (*CARDS, "END") if name != "BAYERPAT"}  # it may lack
    edits["lower case"] = lambda content, _: content[:2880].lower() + content[2880:]
    edits["no blanks"] = lambda content, _: content[:2880].replace(b" ", b"\0") + content[2880:]
    for name, edit in edits.items():
        yield edited("fits", name, edit)
        if name[:5] in ("NAXIS", "BITPI", "added"):
            yield edited("fits.gz", name, _unpacked(edit))
    for name in ("ZNAXIS1", "ZNAXIS3", "ZTILE1", "ZBITPIX", "NAXIS2", "PCOUNT", "TFIELDS", "ZVAL1", "THEAP"):
        for value in ("0", "-3", "7", "2147483647", "'a'"):
            yield edited("fits.fz", f"{name} = {value}", _card_or_added(name, value))
    for name in ("'RICE_9'", "'GZIP_1'", "'HCOMPRESS_1'", "3"):
        yield edited("fits.fz", f"ZCMPTYPE = {name}", _card_or_added("ZCMPTYPE", name))
    for name, counts in wrong_counts().items():
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


def tiff() -> Iterator[Case]:
    for format, page in itertools.product(("tiff", "raw"), (0, 1)):
        if format == "raw" and page:
            continue
        for name, (code, values) in TAGS.items():
            edits = {("value", value): value for value in values}
            edits |= {("type", value): value for value in (0, 1, 2, 5, 12, 99)}
            edits |= {("count", value): value for value in (0, 2, 2**31)}
            edits[("code", 65000)] = 65000
            for (part, _), value in edits.items():
                yield edited(
                    format,
                    f"page {page}: {part} of {name} is {value}",
                    _tag(code, part, value, page),
                    knowable=format == "tiff",
                )
        for value in (0, 3, 4, 5, 6, 99):
            edit = _sample_format(value, page)
            yield edited(format, f"page {page}: sample format is {value}", edit, knowable=format == "tiff")
    for pair in ((1, 0), (0, 0), (2**32 - 1, 0)):
        yield edited("tiff", f"exposure {pair}", _rational(*pair))
        yield edited("raw", f"exposure {pair}", _rational(*pair))
    for value in (None, 1, 7, 2**32 - 1):
        yield edited("tiff", f"the third page is at {value}", _next_page(value))
    yield edited("tiff", "no directory", lambda content, _: content[:4] + bytes(4) + content[8:])
    yield edited("tiff", "other byte order", lambda content, _: b"MM" + content[2:])
    yield edited("tiff", "version 43", lambda content, _: content[:2] + b"\x2b\0" + content[4:])
    for name, counts in wrong_counts().items():
        if np.asarray(counts).dtype.kind in "uif" and np.ndim(counts) == 3 and np.size(counts):
            yield Case("tiff", f"counts: {name}", lambda folder, _, c=counts: _write_tiff(folder, c))
    yield Case("tiff", "packed", lambda folder, _: _write_tiff(folder, None, compression="zlib"))
    yield Case("tiff", "packed and cut", _cut_tiff, drawn=True)


def _write_tiff(folder: Path, counts: Any, **options: Any) -> None:
    (folder / "a.tif").write_bytes(captures.tiff_bytes(counts, **options))


def _cut_tiff(folder: Path, rng: np.random.Generator) -> None:
    content = captures.tiff_bytes(compression="zlib")
    edit = _tag(279, "value", int(rng.integers(1, 200)), int(rng.integers(3)))
    (folder / "a.tif").write_bytes(edit(content, rng))


# PNG


def png() -> Iterator[Case]:
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
            yield edited("png", f"{name} is {value}", _png_header(at, size, value))
    for kind in (b"IHDR", b"IDAT", b"IEND"):
        yield edited("png", f"without {kind.decode()}", _png_chunk(kind, lambda _: None))
        yield edited("png", f"{kind.decode()} is empty", _png_chunk(kind, lambda _: b""))
    yield edited("png", "pixels cut", _png_chunk(b"IDAT", lambda data: zlib.compress(zlib.decompress(data)[:300])))
    yield edited("png", "stream cut", _png_chunk(b"IDAT", lambda data: data[: len(data) // 2]))
    yield edited("png", "more pixels", _png_chunk(b"IDAT", lambda data: zlib.compress(zlib.decompress(data) * 2)))
    unknown = _png_chunk(b"IDAT", lambda data: zlib.compress(b"\x09" + zlib.decompress(data)[1:]))
    yield edited("png", "unknown filter", unknown)


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
