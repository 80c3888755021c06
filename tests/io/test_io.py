from __future__ import annotations

import gzip
import tracemalloc

import h5py
import imageio.v3 as imageio
import numpy as np
import pytest
import tifffile
from astropy.io import fits

from hsnoise.frames.io.load import load


def dark_counts(*shape, mean=100, seed=0):
    return np.random.default_rng(seed).poisson(mean, shape).astype(np.uint16)


def read_all(stack, exposure=0):
    return np.stack(list(stack.frames(exposure)))


def write_dng(path, frame, *, cfa=(0, 1, 1, 2), exposure=(1, 50), iso=800, black=(64, 65, 65, 67)):
    """The least DNG that LibRaw opens: a TIFF with colour filter, levels and a colour matrix."""
    identity = [x for value in np.eye(3, dtype=int).ravel() for x in (int(value), 1)]
    tags = [
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, cfa, True),  # CFAPattern
        (50706, "B", 4, (1, 4, 0, 0), True),  # DNGVersion
        (50708, "s", 0, "hsnoise test camera", True),  # UniqueCameraModel
        (50713, "H", 2, (2, 2), True),  # BlackLevelRepeatDim
        (50714, "H", 4, black, True),  # BlackLevel
        (50717, "H", 1, 4095, True),  # WhiteLevel
        (50721, "2i", 9, identity, True),  # ColorMatrix1
        (271, "s", 0, "hsnoise", True),  # Make
        (272, "s", 0, "test", True),  # Model
        (34855, "H", 1, iso, True),  # ISOSpeedRatings
    ]
    if exposure is not None:
        tags.append((33434, "2I", 1, exposure, True))
    tifffile.imwrite(path, frame, photometric=32803, extratags=tags, metadata=None, software=False, subfiletype=0)


def write_fits(path, frame, **header):
    fits.writeto(path, frame, fits.Header({name.replace("_", "-"): value for name, value in header.items()}))


def write_tiff(path, frames, exposure=(1, 20)):
    tags = [] if exposure is None else [(33434, "2I", 1, exposure, True)]
    tifffile.imwrite(path, frames, photometric="minisblack", extratags=tags, metadata=None)


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])


def write_hdf5(path, counts, **attributes):
    with h5py.File(path, "w") as file:
        file.create_dataset("counts", data=counts).attrs.update(attributes)


def test_dng(tmp_path):
    counts = dark_counts(3, 64, 96)
    for i, frame in enumerate(counts):
        write_dng(tmp_path / f"dark{i}.dng", frame)
    stack = load(tmp_path)
    assert stack.cfa == "RGGB" and stack.white_level == 4095 and stack.iso == 800
    assert stack.exposure_s.tolist() == [0.02] and stack.shape == (64, 96) and stack.kind == ("dark",)
    np.testing.assert_array_equal(stack.black_level, [64, 65, 67])
    assert stack.is_lazy(0)
    np.testing.assert_array_equal(read_all(stack), counts)


@pytest.mark.parametrize("codes, cfa", [((2, 1, 1, 0), "BGGR"), ((1, 0, 2, 1), "GRBG"), ((1, 2, 0, 1), "GBRG")])
def test_dng_bayer_order_and_black_level_of_each_channel(tmp_path, codes, cfa):
    black = [{0: 10, 1: 20, 2: 30}[code] for code in codes]
    for i in range(2):
        write_dng(tmp_path / f"{i}.dng", dark_counts(32, 48, seed=i), cfa=codes, black=black)
    stack = load(tmp_path)
    assert stack.cfa == cfa
    np.testing.assert_array_equal(stack.black_level, [10, 20, 30])


def test_dng_of_other_exposures_and_isos(tmp_path):
    for i, denominator in enumerate((10, 100, 10, 100)):
        write_dng(tmp_path / f"{i}.dng", dark_counts(32, 48, seed=i), exposure=(1, denominator))
    stack = load(tmp_path)
    assert stack.exposure_s.tolist() == [0.01, 0.1] and stack.n_frames == (2, 2)
    np.testing.assert_array_equal(read_all(stack, 0)[1], dark_counts(32, 48, seed=3))
    write_dng(tmp_path / "4.dng", dark_counts(32, 48), iso=1600)
    stack = load(tmp_path)
    assert stack.n_frames == (2, 2) and stack.iso == 800
    assert "1 frame of ISO 1600 was set aside: the others have ISO 800" in stack.assumed
    with pytest.raises(ValueError, match="0.dng and .*4.dng differ in iso: 800.0 and 1600.0"):
        load([tmp_path / "0.dng", tmp_path / "4.dng"])


def test_dng_without_exposure_names_the_file_and_the_keyword(tmp_path):
    for i in range(2):
        write_dng(tmp_path / f"{i}.dng", dark_counts(32, 48, seed=i), exposure=None)
    with pytest.raises(ValueError, match=r"0.dng: no exposure time \(looked for EXIF ExposureTime\); give exposure_s="):
        load(tmp_path)
    assert load(tmp_path, exposure_s=0.5).exposure_s.tolist() == [0.5]


def test_black_levels_of_files_may_differ_by_rounding_only(tmp_path):
    for i, black in enumerate((64, 65)):
        write_dng(tmp_path / f"{i}.dng", dark_counts(32, 48, seed=i), black=(black,) * 4)
    np.testing.assert_array_equal(load(tmp_path).black_level, [64.5, 64.5, 64.5])
    write_dng(tmp_path / "2.dng", dark_counts(32, 48), black=(80,) * 4)
    with pytest.raises(ValueError, match=r"differ in black_level by more than 1 DN \(64 to 80\)"):
        load(tmp_path)
    assert load(tmp_path, black_level=64).black_level == 64


def test_fits_kinds_and_metadata(tmp_path):
    bias, dark, flat = dark_counts(2, 8, 10), dark_counts(2, 8, 10, seed=1), dark_counts(2, 8, 10, mean=900)
    for i in range(2):
        write_fits(tmp_path / f"c{i}.fits", bias[i], IMAGETYP="Bias Frame")
        write_fits(tmp_path / f"b{i}.fits", dark[i], IMAGETYP="Dark Frame", EXPTIME=30 + i * 0.01, CCD_TEMP=-10.0 - i)
        write_fits(tmp_path / f"a{i}.fits", flat[i], IMAGETYP="FLAT", EXPOSURE=1.5)
    stack = load(tmp_path)
    assert stack.kind == ("dark", "dark", "flat") and stack.exposure_s == pytest.approx([0, 30.005, 1.5])
    np.testing.assert_array_equal(stack.temperature_c, [np.nan, -10.5, np.nan])
    for i, counts in enumerate((bias, dark, flat)):
        np.testing.assert_array_equal(read_all(stack, i), counts)


@pytest.mark.parametrize("dtype", ["u1", "i2", "u2", "i4", "u4", "f4"])
@pytest.mark.parametrize("suffix", ["fits", "fits.gz"])
def test_fits_cube_of_any_type(tmp_path, dtype, suffix):
    counts = dark_counts(3, 8, 10).astype(dtype)
    write_fits(tmp_path / f"cube.{suffix}", counts, EXPTIME=2)
    stack = load(tmp_path)
    assert stack.n_frames == (3,) and stack.counts[0].dtype == np.dtype(dtype)
    np.testing.assert_array_equal(read_all(stack), counts)


def test_a_packed_fits_file_is_unpacked_once(tmp_path, monkeypatch):
    """For each frame anew, a cube of 800 small frames took 20 s."""
    frames, opened = dark_counts(5, 8, 10), []
    write_fits(tmp_path / "a.fits.gz", frames, EXPTIME=1)
    unpack = gzip.open
    monkeypatch.setattr(gzip, "open", lambda *words: opened.append(words) or unpack(*words))
    np.testing.assert_array_equal(read_all(load(tmp_path / "a.fits.gz")), frames)
    assert len(opened) == 1


def test_fits_compressed_extension_with_exposure_in_the_primary_header(tmp_path):
    counts = dark_counts(2, 16, 20)
    primary = fits.PrimaryHDU(header=fits.Header({"EXPTIME": 4.0}))
    fits.HDUList([primary, fits.CompImageHDU(counts)]).writeto(tmp_path / "a.fits.fz")
    stack = load(tmp_path / "a.fits.fz")
    assert stack.exposure_s.tolist() == [4]
    np.testing.assert_array_equal(read_all(stack), counts)


def test_fits_bayer_order(tmp_path):
    path = tmp_path / "a.fits"
    write_fits(path, dark_counts(2, 8, 10), EXPTIME=2, BAYERPAT="RGGB", XBAYROFF=1, ROWORDER="TOP-DOWN")
    assert load(path).cfa == "GRBG"
    path.unlink()
    write_fits(path, dark_counts(2, 8, 10), EXPTIME=2, BAYERPAT="RGGB", ROWORDER="BOTTOM-UP")
    with pytest.raises(ValueError, match="a.fits: a colour mosaic of unknown Bayer order; give cfa="):
        load(path)
    assert load(path, cfa="GBRG").cfa == "GBRG"


def test_fits_light_frames_need_a_kind(tmp_path):
    write_fits(tmp_path / "a.fits", dark_counts(2, 8, 10), EXPTIME=2, IMAGETYP="Light Frame")
    with pytest.raises(ValueError, match="no dark and no flat frames: 2 frames were set aside: light .*give kind="):
        load(tmp_path)
    assert load(tmp_path, kind="flat").kind == ("flat",)


def test_fits_of_several_images(tmp_path):
    images = [fits.PrimaryHDU(dark_counts(4, 4)), fits.ImageHDU(dark_counts(4, 4))]
    fits.HDUList(images).writeto(tmp_path / "a.fits")
    with pytest.raises(ValueError, match=r"a.fits: expected one image .* got 0 PRIMARY \(4, 4\), 1 \(4, 4\); hdu="):
        load(tmp_path)


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_tiff_pages_and_files(tmp_path, compression):
    counts = dark_counts(5, 8, 10)
    tags = [(33434, "2I", 1, (1, 20), True)]
    for name, frames in (("a1.tif", counts[:2]), ("a2.tiff", counts[2]), ("a10.tif", counts[3:])):
        tifffile.imwrite(
            tmp_path / name,
            frames,
            photometric="minisblack",
            extratags=tags,
            metadata=None,
            compression=compression,
        )
    stack = load(tmp_path)
    assert stack.exposure_s.tolist() == [0.05] and stack.cfa == "mono"
    np.testing.assert_array_equal(read_all(stack), counts)


@pytest.mark.parametrize("codes, given, cfa", [((1, 0, 2, 1), None, "GRBG"), ((0, 1, 2, 1), "BGGR", "BGGR")])
def test_tiff_of_a_colour_mosaic(tmp_path, codes, given, cfa):
    tags = [(33421, "H", 2, (2, 2), True), (33422, "B", 4, codes, True)]
    for i, frame in enumerate(dark_counts(2, 8, 10)):
        tifffile.imwrite(tmp_path / f"{i}.tif", frame, photometric=32803, extratags=tags, metadata=None)
    assert load(tmp_path, exposure_s=1, cfa=given).cfa == cfa
    if given is not None:
        with pytest.raises(ValueError, match="0.tif: a colour mosaic of unknown Bayer order"):
            load(tmp_path, exposure_s=1)


def test_png(tmp_path):
    counts = dark_counts(3, 8, 10, mean=40000)
    for i, frame in enumerate(counts):
        imageio.imwrite(tmp_path / f"frame{i + 9}.png", frame)
    stack = load(tmp_path, exposure_s=[1, 2, 1])
    assert stack.exposure_s.tolist() == [1, 2] and stack.n_frames == (2, 1)
    np.testing.assert_array_equal(read_all(stack), counts[::2])
    with pytest.raises(ValueError, match=r"frame9.png: no exposure time .*give exposure_s="):
        load(tmp_path)
    with pytest.raises(ValueError, match="exposure_s: expected 3 .one for each file or exposure."):
        load(tmp_path, exposure_s=[1, 2])


@pytest.mark.parametrize("suffix, match", [("png", "mode 'RGB'"), ("tif", "expected pages")])
def test_colour_images_are_not_raw(tmp_path, suffix, match):
    imageio.imwrite(tmp_path / f"a.{suffix}", dark_counts(8, 10, 3).astype(np.uint8))
    with pytest.raises(ValueError, match=rf"a.{suffix}: .*{match}"):
        load(tmp_path, exposure_s=1)


@pytest.mark.parametrize("suffix", ["npz", "h5"])
def test_named_arrays(tmp_path, suffix):
    counts = np.stack([dark_counts(3, 8, 10, mean=300), dark_counts(3, 8, 10)])
    known = {
        "exposure_s": [0.2, 0.1],
        "black_level": 64.0,
        "white_level": 4095,
        "cfa": "GBRG",
        "shutter": "global",
        "iso": 400,
    }
    if suffix == "npz":
        np.savez(tmp_path / "a.npz", counts=counts, **known)
    else:
        write_hdf5(tmp_path / "a.h5", counts, **known)
    stack = load(tmp_path)
    assert stack.exposure_s.tolist() == [0.1, 0.2] and stack.shutter == "global" and stack.cfa == "GBRG"
    assert stack.black_level == 64 and stack.white_level == 4095 and stack.iso == 400
    assert stack.is_lazy(0) == (suffix == "h5")
    for i in range(2):
        np.testing.assert_array_equal(read_all(stack, i), counts[1 - i])
    with pytest.warns(UserWarning, match="exposure_s: "), pytest.warns(UserWarning, match="cfa: "):  # told, and taken
        given = load(tmp_path, exposure_s=[1, 1.0005], shutter="rolling", cfa="mono", black_level=7, white_level=999)
    assert given.n_frames == (6,) and given.shutter == "rolling" and given.cfa == "mono"
    assert given.black_level == 7 and given.white_level == 999


def test_hdf5_data_sets_beside_the_counts(tmp_path):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["counts"], file["exposure_s"] = dark_counts(2, 3, 8, 10), [1.0, 2.0]
        file["kind"] = ["dark", "flat"]
        file.attrs["temperature_c"] = -5.0
    stack = load(tmp_path / "a.hdf5")
    assert stack.kind == ("dark", "flat") and stack.temperature_c.tolist() == [-5, -5]
    assert stack.n_frames == (3, 3) and stack.exposure_s.tolist() == [1, 2]


def test_npy_files_are_mapped(tmp_path):
    counts = dark_counts(2, 3, 8, 10)
    for i in range(2):
        np.save(tmp_path / f"{i}.npy", counts[i])
    one = load(tmp_path / "0.npy", exposure_s=1)
    assert isinstance(one.counts[0], np.memmap)
    both = load([tmp_path / "1.npy", tmp_path / "0.npy"], exposure_s=1)
    np.testing.assert_array_equal(read_all(both), np.concatenate(counts[::-1]))
    np.save(tmp_path / "all.npy", counts)
    np.testing.assert_array_equal(read_all(load(tmp_path / "all.npy", exposure_s=[2, 1]), 0), counts[1])


@pytest.mark.parametrize(
    "name, content, match",
    [
        ("a.npz", {"frames": dark_counts(2, 4, 4)}, r"a.npz: expected an array 'counts', got \['frames'\]"),
        ("a.npz", {"counts": dark_counts(4)}, "a.npz: expected counts"),
        (
            "a.npz",
            {"counts": dark_counts(2, 2, 4, 4), "exposure_s": 1},
            r"a.npz: exposure_s: expected 2 values",
        ),
        ("a.npz", {"counts": dark_counts(2, 4, 4)}, r"a.npz: no exposure time \(looked for 'exposure_s'"),
        (
            "a.npz",
            {"counts": dark_counts(2, 4, 4), "exposure_s": 1, "kind": "dork"},
            "a.npz: expected kind 'dark' or 'flat', got 'dork'; give kind=",
        ),
        (
            "a.npz",
            {"counts": dark_counts(2, 4, 4), "exposure_s": -1},
            "a.npz: expected an exposure_s >= 0, got -1",
        ),
    ],
)
def test_wrong_content(tmp_path, name, content, match):
    np.savez(tmp_path / name, **content)
    with pytest.raises(ValueError, match=match):
        load(tmp_path / name)


def test_hdf5_without_counts(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"] = dark_counts(2, 4, 4)
    with pytest.raises(ValueError, match=r"a.h5: expected a data set 'counts', got \['frames'\]"):
        load(tmp_path)


WRITERS = {
    "a.dng": lambda path, frames: write_dng(path, frames[0]),
    "a.fits": lambda path, frames: write_fits(path, frames, EXPTIME=1),
    "a.fits.gz": lambda path, frames: write_fits(path, frames, EXPTIME=1),
    "a.tif": write_tiff,
    "a.png": lambda path, frames: imageio.imwrite(path, frames[0]),
    "a.npy": np.save,
    "a.npz": lambda path, frames: np.savez(path, counts=frames, exposure_s=1),
    "a.h5": lambda path, frames: write_hdf5(path, frames, exposure_s=1),
}


@pytest.mark.parametrize("name, write", WRITERS.items(), ids=WRITERS)
@pytest.mark.parametrize("damage", ["truncated", "other bytes", "empty"])
# A warning comes before the error: Astropy and exifread say in their own words what is wrong.
@pytest.mark.filterwarnings("ignore::astropy.utils.exceptions.AstropyUserWarning")
def test_damaged_files_are_named(tmp_path, name, write, damage):
    path, twin = tmp_path / name, tmp_path / f"b{name[1:]}"
    write(path, dark_counts(2, 64, 96))
    write(twin, dark_counts(2, 64, 96, seed=1))
    if damage == "truncated":
        truncate(path)
    else:
        path.write_bytes(b"" if damage == "empty" else b"not an image" * 400)
    with pytest.raises(ValueError, match=rf"cannot read .*{name}: ."):
        list(load([twin, path], exposure_s=1).frames(0))


def test_sizes_that_differ_name_both_files(tmp_path):
    np.save(tmp_path / "a.npy", dark_counts(2, 4, 6))
    np.save(tmp_path / "b.npy", dark_counts(2, 4, 8))
    with pytest.raises(ValueError, match=r"b.npy: frames of \(4, 8\) pixels, those of .*a.npy have \(4, 6\)"):
        load(tmp_path, exposure_s=1)


def test_a_bad_frame_names_its_file(tmp_path):
    for i, frame in enumerate((dark_counts(4, 6), np.zeros((4, 6), np.uint16))):
        write_tiff(tmp_path / f"{i}.tif", frame)
    stack = load(tmp_path)
    with pytest.raises(ValueError, match="1.tif: counts are all zero"):
        list(stack.frames(0))


@pytest.mark.parametrize("row_axis, shape", [(0, (10, 14)), (1, (14, 10))])
def test_region_of_interest_is_that_of_the_stack(tmp_path, row_axis, shape):
    write_tiff(tmp_path / "a.tif", dark_counts(2, 10, 14))
    whole = load(tmp_path, row_axis=row_axis, cfa="GRBG")
    part = load(tmp_path, row_axis=row_axis, cfa="GRBG", roi=((1, 7), (2, 8)))
    assert whole.shape == shape and part.shape == (6, 6)
    assert part.cfa == whole.select(rows=(1, 7), columns=(2, 8)).cfa == {0: "BGGR", 1: "RGGB"}[row_axis]
    np.testing.assert_array_equal(read_all(part), read_all(whole)[:, 1:7, 2:8])


def test_region_makes_odd_sides_even(tmp_path):
    write_tiff(tmp_path / "a.tif", dark_counts(2, 9, 14))
    with pytest.raises(ValueError, match="even numbers of rows and columns, got 9 x 14; crop the frames"):
        load(tmp_path, cfa="RGGB")
    assert load(tmp_path, cfa="RGGB", roi=((0, 8), None)).shape == (8, 14)
    with pytest.raises(ValueError, match="roi: expected .* <= 9, got"):
        load(tmp_path, roi=((0, 10), None))
    with pytest.raises(ValueError, match="roi: expected"):
        load(tmp_path, roi=(0, 8, 0, 8))


def test_memory_stays_at_one_frame(tmp_path):
    frame = dark_counts(512, 1024)
    for i in range(12):
        write_tiff(tmp_path / f"{i}.tif", np.roll(frame, i))
    tracemalloc.start()
    stack = load(tmp_path)
    after_load = tracemalloc.get_traced_memory()[1]
    for _ in stack.frames(0):
        pass
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert after_load < frame.nbytes and peak < 4 * frame.nbytes


def test_progress_bar_only_on_long_reads(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes it for a terminal
    for i in range(16):
        np.save(tmp_path / f"{i}.npy", dark_counts(4, 4, seed=i))
    load(f"{tmp_path}/1*.npy", exposure_s=1)
    load(tmp_path, exposure_s=1, progress=False)
    assert capsys.readouterr() == ("", "")
    load(tmp_path, exposure_s=1)
    out, error = capsys.readouterr()
    assert out == "" and "Reading headers" in error
    monkeypatch.delenv("FORCE_COLOR")
    load(tmp_path, exposure_s=1)
    assert capsys.readouterr() == ("", "")
