"""What files say of exposure, ISO and bits in ways that are easily misread: right, or refused by name."""

from __future__ import annotations

import json
import struct
import zlib

import numpy as np
import pytest
import tifffile
from astropy.io import fits

import hsnoise
from hsnoise._core.output import frames_file

EXPOSURE, ISO, RATIONAL, SHORT = 33434, 34855, 5, 3


def frames(n: int = 2, most: int = 4000) -> np.ndarray:
    return np.random.default_rng(0).integers(0, most, (n, 32, 48)).astype(np.uint16)


def write_tiff(path, pages, tags_of) -> None:
    with tifffile.TiffWriter(path) as file:
        for i, page in enumerate(pages):
            file.write(page, photometric="minisblack", metadata=None, extratags=tags_of(i))


def exposure_tag(numerator: int, denominator: int):
    return (EXPOSURE, RATIONAL, 1, (numerator, denominator), True)


@pytest.mark.parametrize("pair", [(1, 0), (0, 0)])
def test_a_rational_without_a_value_is_refused(tmp_path, pair):
    write_tiff(tmp_path / "a.tif", frames(), lambda _: [exposure_tag(*pair)])
    with pytest.raises(ValueError, match=r"a\.tif: ExposureTime: expected one rational number of seconds, got"):
        hsnoise.load(tmp_path / "a.tif")


def test_several_rationals_are_refused(tmp_path):
    tag = (EXPOSURE, RATIONAL, 3, (1, 10, 2, 10, 3, 10), True)
    write_tiff(tmp_path / "a.tif", frames(), lambda _: [tag])
    with pytest.raises(ValueError, match="ExposureTime: expected one rational number"):
        hsnoise.load(tmp_path / "a.tif")


def test_each_page_has_its_own_exposure(tmp_path):
    pages = frames(4)
    write_tiff(tmp_path / "a.tif", pages, lambda i: [exposure_tag(1, 10 if i % 2 else 100)])
    stack = hsnoise.load(tmp_path / "a.tif")
    assert list(stack.exposure_s) == [0.01, 0.1] and stack.n_frames == (2, 2)
    np.testing.assert_array_equal(np.stack(list(stack.frames(0))), pages[::2])
    np.testing.assert_array_equal(np.stack(list(stack.frames(1))), pages[1::2])


def test_pages_that_say_nothing_are_as_the_first(tmp_path):
    write_tiff(tmp_path / "a.tif", frames(3), lambda i: [exposure_tag(1, 4)] if i == 0 else [])
    stack = hsnoise.load(tmp_path / "a.tif")
    assert list(stack.exposure_s) == [0.25] and stack.n_frames == (3,)


@pytest.mark.parametrize(("value", "iso"), [((800, 800), 800), ((0,), None), ((1600,), 1600)])
def test_iso_is_one_number_and_0_is_none(tmp_path, value, iso):
    tag = (ISO, SHORT, len(value), value if len(value) > 1 else value[0], True)
    write_tiff(tmp_path / "a.tif", frames(), lambda _: [exposure_tag(1, 4), tag])
    assert hsnoise.load(tmp_path / "a.tif").iso == iso


def test_a_pair_of_isos_is_refused(tmp_path):
    write_tiff(tmp_path / "a.tif", frames(), lambda _: [exposure_tag(1, 4), (ISO, SHORT, 2, (100, 800), True)])
    with pytest.raises(ValueError, match=r"ISOSpeedRatings: expected one number, got \(100, 800\)"):
        hsnoise.load(tmp_path / "a.tif")


@pytest.mark.parametrize("exposure_s", [1e-7, 2.5e-5, 1 / 30, 0.1, 600.0])
def test_short_exposures_survive_a_tiff(tmp_path, exposure_s):
    about = {"exposure_s": np.array([exposure_s]), "kind": "dark", "cfa": "mono"}
    (tmp_path / "a.tif").write_bytes(frames_file(".tif", frames()[None], about))
    read = hsnoise.load(tmp_path / "a.tif").exposure_s[0]
    assert abs(read / exposure_s - 1) < 1e-6


def png_of(counts: np.ndarray, depth: int) -> bytes:
    """A greyscale PNG of `depth` bits a sample, by hand: Pillow writes 8."""
    rows, columns = counts.shape
    bits = np.unpackbits(counts[..., None], axis=2)[..., 8 - depth :].reshape(rows, -1)
    lines = b"".join(b"\0" + np.packbits(line).tobytes() for line in bits)
    head = struct.pack(">IIBBBBB", columns, rows, depth, 0, 0, 0, 0)
    chunks = [(b"IHDR", head), (b"IDAT", zlib.compress(lines)), (b"IEND", b"")]
    packed = [struct.pack(">I", len(d)) + kind + d + struct.pack(">I", zlib.crc32(kind + d)) for kind, d in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


@pytest.mark.parametrize("depth", [2, 4, 8])
def test_png_of_few_bits_holds_what_was_stored(tmp_path, depth):
    counts = frames(2, 2**depth).astype(np.uint8)
    for name, one in zip("ab", counts, strict=True):
        (tmp_path / f"{name}.png").write_bytes(png_of(one, depth))
    stack = hsnoise.load(tmp_path, exposure_s=1.0)
    for i, one in enumerate(counts):
        np.testing.assert_array_equal(stack.frame(0, i), one)


@pytest.mark.parametrize(
    ("comment", "factor"),
    [("exposure time [ms]", 1e-3), ("in microseconds", 1e-6), ("us", 1e-6), ("minutes", 60), ("seconds, min 1", 1)],
)
def test_a_fits_exposure_is_in_the_unit_of_its_comment(tmp_path, comment, factor):
    header = fits.Header()
    header["EXPTIME"] = (250.0, comment)
    fits.PrimaryHDU(frames(), header).writeto(tmp_path / "a.fits")
    assert hsnoise.load(tmp_path / "a.fits").exposure_s[0] == pytest.approx(250 * factor)


def test_a_truth_value_is_no_exposure(tmp_path):
    header = fits.Header()
    header["EXPTIME"] = True
    fits.PrimaryHDU(frames(), header).writeto(tmp_path / "a.fits")
    with pytest.raises(ValueError, match="no exposure time"):
        hsnoise.load(tmp_path / "a.fits")


def test_time_spans_are_read_in_their_unit(tmp_path):
    np.savez(tmp_path / "a.npz", counts=frames(), exposure_s=np.timedelta64(250, "ms"))
    assert hsnoise.load(tmp_path / "a.npz").exposure_s[0] == 0.25


def test_a_bayer_order_that_contradicts_the_file_is_told(tmp_path):
    np.savez(tmp_path / "a.npz", counts=frames(), exposure_s=1.0, cfa="RGGB")
    with pytest.warns(UserWarning, match=r"cfa: .*a\.npz says RGGB; the given BGGR is used instead"):
        assert hsnoise.load(tmp_path / "a.npz", cfa="BGGR").cfa == "BGGR"


@pytest.mark.parametrize(
    ("about", "expected"),
    [
        ({"name": "no frames"}, "a.npz: expected an array 'counts', or 'arrays' in a.json with kind and exposure"),
        ([], "a.npz: expected an array 'counts', or 'arrays' in a.json"),
        ({"arrays": {"bias": {"kind": "bias"}}}, "a.npz: a.json describes 'bias': expected .* kind and exposure_s"),
        ({"arrays": {"dark": {"kind": "dark", "exposure_s": 1}}}, "a.npz: a.json describes 'dark': expected an array"),
        ({"arrays": {"bias": 3}}, "a.npz: a.json describes 'bias': expected"),
    ],
)
def test_json_beside_an_npz_file_that_does_not_describe_it(tmp_path, about, expected):
    np.savez(tmp_path / "a.npz", bias=frames())
    (tmp_path / "a.json").write_text(json.dumps(about))
    with pytest.raises(ValueError, match=expected):
        hsnoise.load(tmp_path / "a.npz")


def test_json_beside_an_npz_file_gives_kind_and_exposure(tmp_path):
    np.savez(tmp_path / "a.npz", bias=frames(), dark=frames())
    arrays = {"bias": {"kind": "bias", "exposure_s": 0.0}, "dark": {"kind": "dark", "exposure_s": 2.5}}
    (tmp_path / "a.json").write_text(json.dumps({"arrays": arrays, "cfa": "RGGB"}))
    stack = hsnoise.load(tmp_path / "a.npz")
    assert list(stack.exposure_s) == [0.0, 2.5] and stack.cfa == "RGGB"


def write_fits(path, **fields):
    header = fits.Header()
    for name, value in {"IMAGETYP": "dark", "EXPTIME": 1.0, **fields}.items():
        header[name] = value
    fits.writeto(path, frames(1)[0], header)


@pytest.mark.parametrize(
    ("stated", "celsius"),
    [((-20.0, "sensor"), -20.0), (("129.995", "detector mount temp"), -143.155), ((98.0, "[K] detector"), -175.15)],
)
def test_cold_sensors_have_kelvins(tmp_path, stated, celsius):
    for i in range(2):
        write_fits(tmp_path / f"{i}.fits", CCDTEMP=stated)
    assert hsnoise.load(tmp_path).temperature_c[0] == pytest.approx(celsius)


def test_milliseconds_of_another_keyword(tmp_path):
    for i in range(2):
        header = fits.Header()
        header["IMG_EXP"] = 1999, "Exposure (ms)"
        fits.writeto(tmp_path / f"dark{i}.fits", frames(1)[0], header)
    assert hsnoise.load(tmp_path).exposure_s[0] == pytest.approx(1.999)


def test_a_spectrum_of_a_lamp_is_no_dark(tmp_path):
    for i in range(3):
        write_fits(tmp_path / f"{i}.fits", IMAGETYP="cal", OBJECT="arcs" if i == 2 else "bias")
    stack = hsnoise.load(tmp_path)
    assert stack.n_frames == (2,) and "1 frame was set aside: light frames" in " ".join(stack.assumed)


@pytest.fixture
def amplifiers(tmp_path):
    """Two darks with two images each, of other levels."""
    for i in range(2):
        images = [fits.ImageHDU(frames(1, 4000)[0] + level, name=name) for level, name in ((0, "AMP1"), (9000, "AMP2"))]
        primary = fits.PrimaryHDU(header=fits.Header({"IMAGETYP": "dark", "EXPTIME": 2.0}))
        fits.HDUList([primary, *images]).writeto(tmp_path / f"{i}.fits")
    return tmp_path


def test_one_of_several_images_is_chosen(amplifiers):
    with pytest.raises(ValueError, match=r"got 1 AMP1 \(32, 48\), 2 AMP2 \(32, 48\); hdu= takes one of several"):
        hsnoise.load(amplifiers)
    for hdu, least in ((1, 0), ("AMP1", 0), (2, 9000), ("amp2", 9000)):
        stack = hsnoise.load(amplifiers, hdu=hdu)
        assert stack.exposure_s[0] == 2.0 and least <= stack.frame(0, 1).min() < least + 1000
    for wrong in (3, 0, "AMP3"):
        with pytest.raises(ValueError, match=r"hdu=.*: expected one of the images \(number, name, shape\): 1 AMP1"):
            hsnoise.load(amplifiers, hdu=wrong)
    with pytest.raises(TypeError, match="hdu: expected the number or the name of an HDU, got True"):
        hsnoise.load(amplifiers, hdu=True)


def test_only_fits_files_have_several_images(tmp_path):
    np.save(tmp_path / "a.npy", frames())
    with pytest.raises(ValueError, match=r"hdu=1: expected with FITS files alone, got a\.npy"):
        hsnoise.load(tmp_path / "a.npy", hdu=1, exposure_s=1.0)
