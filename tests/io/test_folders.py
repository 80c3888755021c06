"""Folders as users keep them: what belongs together is one capture, what does not is set aside and named."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile
from astropy.io import fits

from hsnoise.frames.io._kinds import exposure_of_names, kind_of
from hsnoise.frames.io.load import load

DARK_DN, FLAT_DN = 500, 4000


def write(path, level=DARK_DN, shape=(16, 20), seed=0, comments=None, **header):
    """A FITS file of one Poisson frame; header keywords with _ for -."""
    path.parent.mkdir(parents=True, exist_ok=True)
    frame = np.random.default_rng([seed, *path.name.encode()]).poisson(level, shape).astype(np.uint16)
    cards = fits.Header({name.replace("_", "-"): value for name, value in header.items()})
    for name, text in (comments or {}).items():
        cards.comments[name] = text
    fits.writeto(path, frame, cards)


def write_some(folder, n=3, level=DARK_DN, **header):
    for i in range(n):
        write(folder / f"{i}.fits", level, seed=i, **header)


@pytest.fixture
def night(tmp_path):
    """bias/, darks/60s/ and flats/ in one folder, kinds by names alone."""
    write_some(tmp_path / "night" / "bias")
    write_some(tmp_path / "night" / "darks" / "60s", EXPTIME=60.0)
    write_some(tmp_path / "night" / "flats", 2, FLAT_DN, EXPTIME=2.0)
    return tmp_path / "night"


def groups(stack):
    return list(zip(stack.kind, stack.exposure_s.tolist(), stack.n_frames, strict=True))


def test_one_folder_is_one_capture(night):
    stack = load(night)
    assert groups(stack) == [("dark", 0, 3), ("dark", 60, 3), ("flat", 2, 2)]
    assert stack.assumed == (
        "3 frames in bias/: each taken as a bias, that is a dark of 0 s, by its folder's name",
        "3 frames in darks/60s/: each taken as a dark by its folder's name",
        "2 frames in flats/: each taken as a flat by its folder's name",
    )
    assert all(sentence in repr(stack) for sentence in stack.assumed)


def test_headers_come_before_names(tmp_path):
    write_some(tmp_path / "flats", IMAGETYP="Flat Dark", EXPTIME=2.0)
    write_some(tmp_path / "b", FRAME="Flat", EXP_TIME="2.5", level=FLAT_DN)
    write_some(tmp_path / "c", OBSTYPE="zero")
    stack = load(tmp_path)
    assert groups(stack) == [("dark", 0, 3), ("dark", 2, 3), ("flat", 2.5, 3)] and stack.assumed == ()


@pytest.mark.parametrize(
    "text, kind",
    [
        ("Dark Flat", "dark"),
        ("darkflat3s", "dark"),
        ("master_dark", "dark"),
        ("Bias Frame", "bias"),
        ("ZERO", "bias"),
        ("offsets", "bias"),
        ("SkyFlat", "flat"),
        ("linearity_V0.5", "flat"),
        ("Light Frame", "light"),
        ("M31", None),
        ("highlights", None),
        (None, None),
    ],
)
def test_words(text, kind):
    assert kind_of(text) == kind


@pytest.mark.parametrize(
    "name, seconds",
    [
        ("dark_0.05s_1.png", 0.05),
        ("dark30s2.png", 30),
        ("d 20 ms.png", 0.02),
        ("dark7.png", None),
        ("2stars.png", None),
    ],
)
def test_exposures_of_names(tmp_path, name, seconds):
    assert exposure_of_names(tmp_path / name, tmp_path) == seconds


def test_exposure_by_the_folder(tmp_path):
    for seconds in (1, 30):
        (tmp_path / f"darks_{seconds}s").mkdir()
        for i in range(2):
            frame = np.random.default_rng(i).poisson(100, (8, 8)).astype(np.uint16)
            tifffile.imwrite(tmp_path / f"darks_{seconds}s" / f"{i}.tif", frame, photometric="minisblack")
    stack = load(tmp_path)
    assert groups(stack) == [("dark", 1, 2), ("dark", 30, 2)]
    assert "4 frames: exposure taken from the names of files and folders (1, 30 s)" in stack.assumed


def test_what_does_not_belong_is_set_aside_and_named(night):
    write_some(night / "bias_2x2", shape=(8, 10), XBINNING=2, YBINNING=2)
    write_some(night / "lights", level=900, EXPTIME=60.0)
    write_some(night / "warm", IMAGETYP="dark", EXPTIME=60.0, CCD_TEMP=20.0)
    write_some(night / "cold", 4, IMAGETYP="dark", EXPTIME=60.0, CCD_TEMP=-10.0)
    write_some(night / "high", IMAGETYP="dark", EXPTIME=60.0, GAIN=200)
    write_some(night / "low", 4, IMAGETYP="dark", EXPTIME=60.0, GAIN=100)
    write(night / "masterdark.fits", EXPTIME=60.0)
    write(night / "darks" / "sum.fits", EXPTIME=60.0, NCOMBINE=9)
    write_some(night / "calibrated", EXPTIME=60.0)
    (night / "notes.txt").write_text("cold night")
    np.save(night / "result.npy", np.ones((4, 4)))
    stack = load(night)
    assert groups(stack) == [("dark", 0, 3), ("dark", 60, 11), ("flat", 2, 2)]
    expected = {
        "3 frames of 8 x 10 pixels in bias_2x2/ were set aside: the others have 16 x 20",
        "3 frames in lights/ were set aside: light frames are neither darks nor flats",
        "3 frames at 20 degrees Celsius in warm/ were set aside: other darks are at -10",
        "3 frames of gain 200 in high/ were set aside: the others have gain 100",
        "1 frame was set aside: averages of several frames (masters) have less noise than frames",
        "1 frame in darks/ was set aside: averages of several frames (masters) have less noise than frames",
        "calibrated/ was passed over because of its name",
        "1 .npy file set aside: the others are .fits",
    }
    assert expected <= set(stack.assumed), expected - set(stack.assumed)


def test_averages_that_only_their_fractions_tell(tmp_path):
    write_some(tmp_path, EXPTIME=1.0)
    mean = np.random.default_rng(0).normal(500, 3, (16, 20)).astype(np.float32)
    fits.writeto(tmp_path / "x.fits", mean, fits.Header({"EXPTIME": 1.0}))
    stack = load(tmp_path)
    assert stack.n_frames == (3,) and any("averages" in sentence for sentence in stack.assumed)


def test_light_frames_in_a_folder_of_darks_are_darks(tmp_path):
    write_some(tmp_path / "darks", IMAGETYP="Light Frame", EXPTIME=1.0)
    stack = load(tmp_path)
    assert stack.kind == ("dark",)
    told = "3 frames in darks/: each taken as a dark by its folder's name, though the header says light"
    assert stack.assumed == (told,)


def test_an_open_shutter_makes_a_flat(tmp_path):
    write_some(tmp_path / "a", EXPTIME=0.0, SHUTTER=False)
    write_some(tmp_path / "b", EXPTIME=1.0, SHUTTER=True, level=FLAT_DN)
    assert groups(load(tmp_path)) == [("dark", 0, 3), ("flat", 1, 3)]


def test_sizes_of_which_neither_is_the_most(tmp_path):
    write_some(tmp_path / "a", EXPTIME=1.0)
    write_some(tmp_path / "b", EXPTIME=2.0, shape=(12, 20))
    with pytest.raises(ValueError, match="there are equally many of both; all frames must have one size"):
        load(tmp_path)
    write_some(tmp_path / "flats", level=FLAT_DN, EXPTIME=1.0)
    stack = load(tmp_path)  # darks of the size of the flats
    assert stack.shape == (16, 20) and stack.kind == ("dark", "flat")


def test_flats_of_another_crop(tmp_path):
    write_some(tmp_path / "dark", EXPTIME=1.0, EGAIN=0.8)
    write_some(tmp_path / "flat", 4, FLAT_DN, EXPTIME=1.0, EGAIN=0.8, shape=(8, 20))
    stack = load(tmp_path)
    assert stack.kind == ("dark",) and stack.elsewhere.shape == (8, 20) and stack.elsewhere.n_frames == (4,)
    assert stack.stated_gain.value_dn_per_e == pytest.approx(1.25) and stack.elsewhere.stated_gain is not None


def test_flats_that_are_binned_are_set_aside(tmp_path):
    write_some(tmp_path / "dark", EXPTIME=1.0)
    write_some(tmp_path / "flat", 4, FLAT_DN, EXPTIME=1.0, shape=(8, 10))
    stack = load(tmp_path)
    assert stack.elsewhere is None
    assert "4 frames of 8 x 10 pixels in flat/ were set aside: the others have 16 x 20" in stack.assumed


def test_twilight_flats_are_levels_of_their_own(tmp_path):
    write_some(tmp_path / "bias", shape=(64, 64))
    for i, level in enumerate((4000, 6000, 4040, 8000, 6050)):  # in order of time
        write(tmp_path / "flat" / f"{i}.fits", level, EXPTIME=3.0, shape=(64, 64))
    stack = load(tmp_path)
    assert groups(stack) == [("dark", 0, 3), ("flat", 3, 2), ("flat", 3, 2), ("flat", 3, 1)]
    for number, file in ((0, 0), (1, 2)):
        np.testing.assert_array_equal(stack.frame(1, number), fits.getdata(tmp_path / "flat" / f"{file}.fits"))
    assert any("5 flats of 3 s were taken as 3 levels of light" in sentence for sentence in stack.assumed)


def test_filters_separate_flats(tmp_path):
    for i, name in enumerate("VRVR"):
        write(tmp_path / "flat" / f"{i}.fits", FLAT_DN, IMAGETYP="flat", EXPTIME=3.0, FILTER=name)
    stack = load(tmp_path)
    assert groups(stack) == [("flat", 3, 2), ("flat", 3, 2)]
    np.testing.assert_array_equal(stack.frame(0, 1), fits.getdata(tmp_path / "flat" / "3.fits"))


@pytest.mark.parametrize(
    "header, comment, source, value, certain",
    [
        ({"EGAIN": 2.62, "GAIN": 100}, {}, "EGAIN 2.62 e-/DN", 1 / 2.62, True),
        ({"EGAIN": 1.0}, {}, "EGAIN 1 e-/DN", 1.0, False),
        ({"GAIN": 1.5}, {"GAIN": "e-/ADU"}, "GAIN 1.5 e-/DN", 1 / 1.5, False),
        ({"GAIN": 1.5}, {}, "GAIN 1.5 (e-/DN?)", 1 / 1.5, False),
    ],
)
def test_stated_gain(tmp_path, header, comment, source, value, certain):
    write_some(tmp_path, EXPTIME=1.0, comments=comment, **header)
    gain = load(tmp_path).stated_gain
    assert gain.source == source and gain.value_dn_per_e == pytest.approx(value) and gain.certain == certain


@pytest.mark.parametrize("header", [{}, {"GAIN": 120}, {"GAIN": 1}, {"EGAIN": 0.0}, {"GAIN": "high"}])
def test_headers_that_state_no_gain(tmp_path, header):
    write_some(tmp_path, EXPTIME=1.0, **header)
    assert load(tmp_path).stated_gain is None


@pytest.mark.data
def test_folders_of_real_sensors(shared_data):
    stack = load(shared_data / "data" / "sbig_st8_cc0")
    assert groups(stack) == [("dark", 3, 6), ("dark", 25, 7), ("flat", 3, 5)]
    assert stack.assumed == ("3 frames of 160 x 240 pixels in bias_2x2/ were set aside: the others have 320 x 480",)
    twilight = load(shared_data / "data" / "ccd_kaf_mit")
    assert twilight.n_frames == (20, *[1] * 17)
    assert load(shared_data / "data" / "emva1288" / "001_CCD_12Bit").white_level == 4095


def test_masters_alone_are_refused_if_their_headers_say_so(tmp_path):
    write_some(tmp_path / "darks", EXPTIME=1.0, NCOMBINE=7)
    with pytest.raises(ValueError, match="no dark and no flat frames: 3 frames .* averages of several frames"):
        load(tmp_path / "darks")


def test_masters_alone_by_their_names_are_told(tmp_path):
    for i in range(2):
        write(tmp_path / f"masterdark{i}.fits", seed=i, EXPTIME=1.0)
    assert "2 frames called master: are they averages? These have less noise than frames" in load(tmp_path).assumed


@pytest.mark.parametrize("shape", [(16, 20), (16, 12)])
def test_flats_that_hold_one_count_show_the_white_level(night, shape):
    """No header states it, and samples went on above it without a word."""
    for i in range(2):
        path = night / "flats" / f"bright{i}.fits"
        fits.writeto(path, np.full(shape, 16383, np.uint16), fits.Header({"EXPTIME": 9.0}))
        write(night / "flats" / f"lit{i}.fits", FLAT_DN, shape, EXPTIME=2.0)
        (night / "flats" / f"{i}.fits").unlink()
    stack = load(night)
    assert stack.white_level == 16383
    assert any("the white level is taken as 16383 DN" in sentence for sentence in stack.assumed)


def test_dark_frames_among_flats_are_no_white_level(night):
    fits.writeto(night / "flats" / "off.fits", np.zeros((16, 20), np.uint16), fits.Header({"EXPTIME": 9.0}))
    assert load(night).white_level is None
