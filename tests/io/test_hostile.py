"""Files that are broken on purpose: one sentence that names the file and what is wrong, and nothing outside is read."""

from __future__ import annotations

import json
import time

import h5py
import jax
import numpy as np
import pytest
from astropy.io import fits

import hsnoise
from hsnoise._core.output import read_image, write_atomically
from hsnoise.cli.main import main
from hsnoise.stlstm import STLSTM


def counts(n: int = 3) -> np.ndarray:
    return np.random.default_rng(1).integers(90, 110, (n, 16, 24)).astype(np.uint16)


def group(file):
    file.create_group("counts")


def empty(file):
    file.create_dataset("counts", data=h5py.Empty("u2"))


def external(file):
    with h5py.File(f"{file.filename}.secret", "w") as other:
        other["counts"] = counts()
    file["counts"] = h5py.ExternalLink(f"{file.filename}.secret", "/counts")


def virtual(file):
    with h5py.File(f"{file.filename}.secret", "w") as other:
        other["counts"] = counts()
    layout = h5py.VirtualLayout((3, 16, 24), "u2")
    layout[:] = h5py.VirtualSource(f"{file.filename}.secret", "counts", (3, 16, 24))
    file.create_virtual_dataset("counts", layout)


def broken_link(file):
    file["counts"] = h5py.SoftLink("/nowhere")


def never_written(file):
    file.create_dataset("counts", shape=(100, 100_000, 100_000), dtype="u2", chunks=(1, 1000, 1000))


def not_utf8(file):
    file["counts"] = counts()
    file.attrs.create("kind", b"\xff\xfe", dtype=h5py.string_dtype("utf-8", 2))


def words(file):
    file["counts"] = counts()
    file.attrs["exposure_s"] = "long"


def no_black(file):
    file["counts"] = counts()
    file.attrs["black_level"] = "abc"


def no_white(file):
    file["counts"] = counts()
    file.attrs["white_level"] = np.nan


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (group, "expected a data set 'counts', got a group"),
        (empty, "the data set 'counts' is empty"),
        (external, "'counts' is a link to another file, which is not followed"),
        (virtual, "the values of 'counts' are in another file, which is not followed"),
        (broken_link, "expected a data set 'counts', got a broken link"),
        (never_written, "'counts' declares 2e\\+12 bytes and holds 0: was the file written to its end"),
        (not_utf8, "kind: expected text in UTF-8, got"),
        (words, "exposure_s: expected numbers, got 'long'"),
        (no_black, "black_level: expected numbers, got 'abc'"),
        (no_white, "white_level: expected finite numbers, got nan"),
    ],
)
def test_hdf5(tmp_path, make, expected):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        if make is not words:
            file.attrs["exposure_s"] = 1.0
        make(file)
    with pytest.raises(ValueError, match=f"cannot read .*a.h5: {expected}"):
        hsnoise.load(tmp_path / "a.h5")


def test_frames_of_zeros_that_pack_well_are_no_unwritten_file(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("counts", data=np.repeat(counts(1), 400, 0), compression="gzip", chunks=(400, 16, 24))
        file.attrs["exposure_s"] = 1.0
    assert hsnoise.load(tmp_path / "a.h5").n_frames == (400,)


def test_a_truncated_npy_is_told_with_its_sizes(tmp_path):
    np.save(tmp_path / "a.npy", counts())
    data = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(data[:-1])
    declared = counts().nbytes
    with pytest.raises(ValueError, match=f"a.npy: its header declares {declared} bytes, and it holds {declared - 1}"):
        hsnoise.load(tmp_path / "a.npy", exposure_s=1)


def test_archives_and_objects_that_are_called_npy(tmp_path):
    np.savez(tmp_path / "a.npz", counts=counts())
    archive, objects = tmp_path / "a.npy", tmp_path / "b.npy"
    (tmp_path / "a.npz").rename(archive)
    np.save(objects, np.array([{}, 1], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match=r"a.npy: it is an archive of several arrays; give it the suffix .npz"):
        hsnoise.load(archive, exposure_s=1)
    with pytest.raises(ValueError, match=r"a.npy: expected one array, got an archive"):
        read_image(archive)
    with pytest.raises(ValueError, match=r"b.npy: cannot be read as an image"):
        read_image(objects)


def edited(text: str, **fields) -> str:
    return json.dumps(json.loads(text) | fields)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda text: "[" * 10_000 + "]" * 10_000, "it is nested too deeply"),
        (lambda text: text.replace("51.7", "9" * 400), "dark_current.rate: expected a number, got 9{50,70}\\.?$"),
        (lambda text: text.replace("51.7", "9" * 5000), "not a JSON file"),
        (lambda text: text.replace('"cfa"', '"cfa": "mono", "cfa"', 1), "'cfa' is given twice"),
        (lambda text: text.replace('"format_version": 1', '"format_version": 2'), "this version reads format 1"),
        (lambda text: edited(text, precision=[1]), r"precision: expected float32 or float64, got \[1\]"),
        (lambda text: edited(text, effects={}), "effects: expected a list of effects, got {}"),
        (lambda text: edited(text, effects=[]), r"effects: expected a list of effects, got \[\]"),
        (lambda text: edited(text, effects=[{"name": 3}]), "effect 0: expected a name, parameters and settings, got"),
        (lambda text: edited(text, exposure_s=10**400), "exposure_s: expected finite seconds >= 0, got 10{50,60}"),
        (lambda text: text.replace("51.7", "NaN"), "dark_current.rate: expected finite values"),
        (lambda text: text.replace("51.7", "1e999"), "dark_current.rate: expected finite values"),
    ],
)
def test_models(tmp_path, change, expected):
    hsnoise.cameras.canon_5d3().save(tmp_path / "m.json")
    text = (tmp_path / "m.json").read_text()
    (tmp_path / "m.json").write_text(change(text))
    with pytest.raises((ValueError, TypeError), match=expected):
        hsnoise.NoiseModel.load(tmp_path / "m.json")


def test_a_model_with_many_effects_is_refused_at_once(tmp_path):
    hsnoise.cameras.canon_5d3().save(tmp_path / "m.json")
    content = json.loads((tmp_path / "m.json").read_text())
    content["effects"] = content["effects"][2:3] * 20_000
    (tmp_path / "m.json").write_text(json.dumps(content))
    began = time.process_time()
    with pytest.raises(ValueError, match="read_noise given twice"):
        hsnoise.NoiseModel.load(tmp_path / "m.json")
    assert time.process_time() - began < 2


@pytest.mark.parametrize(
    ("card", "value", "expected"),
    [
        ("NAXIS1", -24, "NAXIS1: expected a size of 0 or more, got -24"),
        ("NAXIS", 9, "a header lacks .*NAXIS4"),
        ("BITPIX", 17, "BITPIX: expected one of 8, 16, .*, got 17"),
        ("BZERO", "'abc'", "BZERO: expected a number, got 'abc'"),
    ],
)
def test_fits(tmp_path, card, value, expected):
    fits.writeto(tmp_path / "a.fits", counts(4), fits.Header({"EXPTIME": 1.0}))
    content = (tmp_path / "a.fits").read_bytes()
    at = content.index(f"{card:8s}=".encode())
    (tmp_path / "a.fits").write_bytes(content[:at] + f"{card:8s}= {value:>20}".encode() + content[at + 30 :])
    with pytest.raises(ValueError, match=f"cannot read .*a.fits: {expected}"):
        hsnoise.load(tmp_path / "a.fits")


def test_one_nan_is_no_average(tmp_path):
    values = np.stack([counts(4), counts(4)]).astype(np.float64)
    values[0, 0, 0, 0] = np.nan
    np.savez(tmp_path / "a.npz", counts=values, exposure_s=[1.0, 4.0])
    with pytest.raises(ValueError, match="counts must be finite, got NaN"):
        hsnoise.fit(tmp_path / "a.npz", black_level=0, white_level=4095)


def test_names_of_which_one_is_the_other_with_a_number(tmp_path):
    for place in ("dark.fits", "dark1.fits", "darks/dark.fits", "darks2/dark.fits"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        fits.writeto(tmp_path / place, counts(1)[0], fits.Header({"EXPTIME": 1.0}))
    assert hsnoise.load(tmp_path, progress=False).n_frames == (4,)


def test_a_link_to_nothing_is_set_aside(tmp_path, capsys):
    for name in "ac":
        fits.writeto(tmp_path / f"{name}.fits", counts(1)[0], fits.Header({"EXPTIME": 1.0}))
    (tmp_path / "b.fits").symlink_to(tmp_path / "gone.fits")
    assert main(["inspect", str(tmp_path), "--verbose"]) in (0, 1)
    assert "b.fits was set aside: a link to nothing, or no file" in "".join(capsys.readouterr())


def test_an_image_is_not_overwritten_by_what_is_drawn_from_it(tmp_path, capsys):
    np.save(tmp_path / "scene.npy", np.full((8, 8), 5.0, np.float32))
    before, scene = (tmp_path / "scene.npy").read_bytes(), str(tmp_path / "scene.npy")
    assert main(["sample", "canon_5d3", "--clean", scene, "--out", scene]) == 2
    assert "is the image of --clean, which would be lost" in capsys.readouterr().err
    assert (tmp_path / "scene.npy").read_bytes() == before


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--seed", "9" * 30], "--seed: expected at most 2147483648, got 9"),
        (["--shape", "100000000x100000000"], "--shape: 8 frames of 100000000 x 100000000 pixels take"),
        (["--shape", "0x4"], "--shape: expected ROWSxCOLUMNS"),
        (["--frames", "0"], "--frames: expected a whole number above 0, got '0'"),
        (["--clean", "."], "unknown image format"),
    ],
)
def test_options_of_sample(tmp_path, options, expected, capsys):
    arguments = ["sample", "canon_5d3", "--out", str(tmp_path / "a.npz"), *options]
    try:
        assert main(arguments) == 2
    except SystemExit as ended:  # argparse
        assert ended.code == 2
    assert expected in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_folder_in_place_of_a_file(tmp_path, capsys):
    (tmp_path / "a.npz").mkdir()
    assert main(["sample", "canon_5d3", "--out", str(tmp_path / "a.npz")]) == 2
    assert "a.npz is a folder" in capsys.readouterr().err
    with pytest.raises(IsADirectoryError, match="expected a file, but it is a folder: .*a.npz'"):
        write_atomically(tmp_path / "a.npz", b"")
    with pytest.raises(FileNotFoundError, match=r"nowhere.b.npz'$"):
        write_atomically(tmp_path / "nowhere" / "b.npz", b"")


@pytest.mark.parametrize("white", [-1, 0, float("nan"), float("inf"), 2.5, "a", {}, True, 10**12])
@pytest.mark.parametrize("effect", [hsnoise.effects.ADC, lambda white: hsnoise.effects.MissingCodes(2.0, white)])
def test_white_levels_that_are_none(effect, white):
    with pytest.raises(ValueError, match="white_level_dn: expected a positive whole number or None, got"):
        effect(white)


@pytest.mark.parametrize("first", [3, "ab", (1,), (-1, 0), (0.5, 0), None])
def test_maps_that_begin_nowhere(first):
    with pytest.raises(ValueError, match="measured_map.first: expected a row and a column of the sensor, got"):
        hsnoise.effects.MeasuredMap(np.zeros((4, 6)), first=first)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("n 999999999999 16 24\nd 5\ni a.npy", "n: expected 1 to 32 bits, got 999999999999"),
        ("n -5", "n: expected 1 to 32 bits, got -5"),
        ("d", "expected a value after 'd', got 'd'"),
        ("d 5\ni", "expected a value after 'i', got 'i'"),
        ("", "expected lines that begin with i, one an image, got none"),
        ("d 5\ni ../secret", "expected images of a known format"),
    ],
)
def test_descriptors_of_emva(tmp_path, text, expected):
    np.save(tmp_path / "a.npy", counts())
    (tmp_path / "EMVA1288_Data.txt").write_text(text)
    with pytest.raises(ValueError, match=f"cannot read .*EMVA1288_Data.txt: {expected}"):
        hsnoise.load(tmp_path)


def test_networks_of_thousands_of_layers():
    with pytest.raises(ValueError, match="kernels: expected 1 to 64 sizes, one per layer, got 20000"):
        STLSTM(jax.random.key(0), kernels=[3] * 20_000)


@pytest.mark.parametrize("value", [True, "1.0", [True]])
def test_truth_values_and_text_are_no_numbers(value):
    with pytest.raises(TypeError, match="read_noise.sigma: expected a number, got"):
        hsnoise.effects.ReadNoise(value)


@pytest.mark.parametrize("packed", [False, True])
def test_fits_files_that_are_cut_short(tmp_path, packed):
    hdu = fits.CompImageHDU if packed else fits.ImageHDU
    path = tmp_path / ("a.fits.fz" if packed else "a.fits")
    header = fits.Header({"EXPTIME": 1.0})
    frames = np.random.default_rng(0).integers(0, 4000, (3, 96, 128)).astype(np.uint16)
    fits.HDUList([fits.PrimaryHDU(), hdu(frames, header)]).writeto(path)
    assert hsnoise.load(path).n_frames == (3,)
    path.write_bytes(path.read_bytes()[:9000])
    with pytest.raises(ValueError, match=r"cannot read .*a\.fits.*truncated"):
        hsnoise.load(path)
