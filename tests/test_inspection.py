"""`inspect` names what is odd about a capture, and says what can be had from it."""

from __future__ import annotations

import re

import numpy as np
import pytest
from astropy.io import fits

import hsnoise
from hsnoise._core.types import StatedGain
from hsnoise.cli.main import main
from hsnoise.frames.stack import FrameStack

GAIN, READ_E, BLACK_DN, SHAPE = 2.0, 3.0, 200.0, (48, 96)
RATE = np.random.default_rng(7).lognormal(np.log(20), 0.5, SHAPE)  # e-/s, pixels that differ


def darks(rng, seconds, n=8, extra_e=0.0):
    electrons = rng.poisson(RATE * seconds + extra_e, (n, *SHAPE)) + rng.normal(0, READ_E, (n, *SHAPE))
    return (BLACK_DN + GAIN * electrons).round().clip(0).astype(np.uint16)


def flats(rng, mean_e, n=4):
    electrons = rng.poisson(mean_e, (n, *SHAPE)) + rng.normal(0, READ_E, (n, *SHAPE))
    return (BLACK_DN + GAIN * electrons).round().clip(0).astype(np.uint16)


def findings(counts, exposure_s, **keywords):
    return "\n".join(hsnoise.inspect(FrameStack(counts, exposure_s, **keywords)).findings)


def test_a_good_capture(rng):
    found = hsnoise.inspect([darks(rng, 0), darks(rng, 2), darks(rng, 8)], exposure_s=[0, 2, 8])
    assert found.fit_makes_sense and found.findings == ()
    assert "Gain: yes, from the growth of the noise of darks" in found.determined[0]
    assert "dark current" in found.verdict and [group.n_frames for group in found.groups] == [8, 8, 8]
    text = str(found)
    assert "Nothing odd was found." in text and "Noise budget" in text and "Next: " in text
    assert found.groups[0].temporal_dn == pytest.approx(GAIN * READ_E, rel=0.02)


def test_the_gain_of_flats(rng):
    counts = [darks(rng, 0), *(flats(rng, mean) for mean in (300, 600, 1200, 2400))]
    found = hsnoise.inspect(FrameStack(counts, range(5), kind=["dark", *["flat"] * 4]))
    gain = float(found.determined[0].split("about ")[1].split()[0])
    assert gain == pytest.approx(GAIN, rel=0.02) and "3 levels of repeated flats" in found.determined[0]


@pytest.mark.parametrize("electrons_per_dn, word", [(0.5, "agrees"), (3.0, "wrong or nominal")])
def test_the_gain_of_a_header(rng, electrons_per_dn, word):
    stated = StatedGain(1 / electrons_per_dn, f"EGAIN {electrons_per_dn} e-/DN", certain=True)
    said = findings([darks(rng, 0), flats(rng, 900)], [0, 1], kind=["dark", "flat"], stated_gain=stated)
    assert word in said and stated.source in said


def test_single_flats_are_compared_in_pairs(rng):
    pattern = rng.normal(1, 0.01, SHAPE)
    light = [flats(rng, mean * pattern, 1) for mean in (2000, 2200, 2400)]
    stack = FrameStack([darks(rng, 0), *light], [0, 3, 3, 3], kind=["dark", "flat", "flat", "flat"])
    said = hsnoise.inspect(stack).determined[0]
    assert "compared in pairs" in said
    assert float(said.split("about ")[1].split()[0]) == pytest.approx(GAIN, rel=0.1)


def lit(counts):
    counts[3] += 100
    return "lies .* DN above the others: light got in"


def settling(counts):
    counts[0] += 4
    return "lies 4.* DN above the later ones: the black level settles"


def drifting(counts):
    counts += np.arange(8, dtype=np.uint16)[:, None, None]
    return "The level of the darks of 0 s rises from .* a drift"


def copied(counts):
    counts[5] = counts[2]
    return "are identical: drop one"


def averaged(counts):
    counts[4] = counts.mean(0).round()
    return r"has 0\.\d+ times the noise of the others: an average of frames"


@pytest.mark.parametrize("spoil", [lit, settling, drifting, copied, averaged])
def test_odd_frames_are_named(rng, spoil):
    counts = darks(rng, 0)
    expected = spoil(counts)
    found = hsnoise.inspect(FrameStack([counts, darks(rng, 4)], [0, 4]))
    assert len(found.findings) == 1, found.findings
    assert re.search(expected, found.findings[0])
    assert found.fit_makes_sense


def test_frame_at_the_level_of_another_exposure(rng):
    short, long = darks(rng, 1), darks(rng, 30)
    short[2], long[4] = long[4].copy(), short[2].copy()
    said = findings([short, long], [1, 30])
    assert "at the level of the darks of 30 s" in said and "at the level of the darks of 1 s" in said


def test_exposures_that_are_swapped(rng):
    assert "are their exposures swapped?" in findings([darks(rng, 30), darks(rng, 1)], [1, 30])


def test_flats_alone_make_no_fit_without_a_black_level(rng):
    lit = {"counts": [flats(rng, mean) for mean in (300, 600)], "exposure_s": [1, 2], "kind": "flat"}
    found = hsnoise.inspect(FrameStack(**lit))
    assert not found.fit_makes_sense and "flats alone" in found.verdict
    with pytest.raises(ValueError, match="flats alone"):
        hsnoise.fit(FrameStack(**lit))
    assert hsnoise.inspect(FrameStack(**lit, black_level=BLACK_DN)).fit_makes_sense


def test_a_group_of_averages(rng):
    mean_of_nine = darks(rng, 8, 72).reshape(9, 8, *SHAPE).mean(0).round().astype(np.uint16)
    said = findings([darks(rng, 0), darks(rng, 4), mean_of_nine], [0, 4, 8])
    assert "The darks of 8 s have" in said and "less temporal variance than shorter ones: averages?" in said


def test_darks_that_are_flats(rng):
    assert "light got in, they are flats, or all pixels have the same dark current" in findings(
        [darks(rng, 0), flats(rng, 3000, 8)], [0, 8]
    )


def test_two_kinds_of_frames_among_the_darks(rng):
    counts = np.concatenate([darks(rng, 1, 3), flats(rng, 3000, 2)])
    assert "frame 3 and 1 more of the 5 darks of 1 s lie" in findings([counts], [1.0])
    fit = hsnoise.fit(hsnoise.FrameStack([counts], [1.0]))
    assert not fit.trustworthy and "are they lit, or taken at another exposure" in str(fit)


def test_the_odd_one_of_three_frames(rng):
    counts = darks(rng, 0, 3)
    counts[0] -= 2
    found = findings([counts], [0.0])
    assert "frame 0 (darks of 0 s) lies 2.0 DN below the later ones" in found and "frame 1" not in found


def test_a_camera_that_subtracts_its_dark_current(rng):
    counts = []
    for i, seconds in enumerate((0, 4, 8)):
        one = darks(rng, seconds).astype(int)
        counts.append((one - int(one.mean()) - i + 800).clip(0).astype(np.uint16))
    assert "does the camera subtract dark current?" in findings(counts, [0, 4, 8])


@pytest.mark.parametrize("axis, lines", [(1, "Rows"), (2, "Columns")])
@pytest.mark.parametrize("sigma_e, odd", [(2.0, False), (6.0, True)])
def test_lines_that_move_together_are_no_read_noise_of_pixels(rng, axis, lines, sigma_e, odd):
    together = rng.normal(0, GAIN * sigma_e, [8, *(n if i == axis else 1 for i, n in enumerate(SHAPE, 1))])
    counts = (darks(rng, 0) + together).round().clip(0).astype(np.uint16)
    found = hsnoise.inspect(counts, exposure_s=[0])
    (read_noise,) = (said for said in found.determined if said.startswith("Read noise"))
    assert f"DN shared by {lines.lower()}" in read_noise
    pixel = float(read_noise.split(" s is ")[1].split()[0])
    assert pixel == pytest.approx(GAIN * READ_E, rel=0.03)
    assert odd == any(said.startswith(f"{lines} of the shortest darks change") for said in found.findings)


def test_clipping_and_scaled_counts(rng):
    clipped = np.maximum(darks(rng, 0).astype(int) - 196, 0).astype(np.uint16)
    assert "Counts at 0 (black is clipped)" in findings([clipped, darks(rng, 4)], [0, 4])
    assert "multiples of 16" in findings([darks(rng, 0) * 16, darks(rng, 4) * 16], [0, 4])


def test_overscan_that_falls_with_the_light(rng):
    dark, light = darks(rng, 0), flats(rng, 3000)
    light[:, :, -8:] = dark[:4, :, -8:] - 100
    stack = FrameStack([dark, light], [0, 1], kind=["dark", "flat"])
    assert "The overscan falls from 200 to 100 DN" in "\n".join(hsnoise.inspect(stack).findings)


def test_captures_that_make_no_fit(rng):
    single = hsnoise.inspect([darks(rng, t, 1) for t in (0, 1, 2)], exposure_s=[0, 1, 2])
    assert not single.fit_makes_sense and "no exposure has two frames" in single.verdict
    clipped = hsnoise.inspect(rng.poisson(0.3, (4, *SHAPE)).astype(np.uint16), exposure_s=1)
    assert not clipped.fit_makes_sense and "clipped at 0" in clipped.verdict
    copies = hsnoise.inspect(np.repeat(darks(rng, 0, 1), 4, axis=0), exposure_s=0)
    assert not copies.fit_makes_sense and "copies" in copies.verdict
    colours = darks(rng, 0)
    colours[:, ::2, ::2] *= 2
    mosaic = hsnoise.inspect(colours, exposure_s=0)
    assert not mosaic.fit_makes_sense and "mosaic" in mosaic.verdict
    assert hsnoise.inspect(colours, exposure_s=0, cfa="RGGB").fit_makes_sense


@pytest.fixture
def night(tmp_path, rng):
    """Frames of a night as files, one of them calibrated."""
    for name, counts, header in (
        ("bias", darks(rng, 0), {}),
        ("dark", darks(rng, 8, 4), {"EXPTIME": 8.0, "CCD-TEMP": -10.0}),
        ("flat", flats(rng, 2000), {"EXPTIME": 1.0}),
    ):
        (tmp_path / "night" / name).mkdir(parents=True)
        for i, frame in enumerate(counts):
            header["DATE-OBS"] = f"2026-11-01T20:00:{59 - i:02d}" if name == "bias" else f"2026-11-01T21:00:{i:02d}"
            fits.writeto(tmp_path / "night" / name / f"{i}.fits", frame, fits.Header(header))
    bad = darks(rng, 8, 1)[0].astype(np.int16) - 300
    fits.writeto(tmp_path / "night" / "dark" / "calibrated.fits", bad, fits.Header({"EXPTIME": 8.0}))
    return tmp_path / "night"


def test_files_of_a_folder(night, capsys):
    found = hsnoise.inspect(night)
    assert [(group.kind, group.n_frames) for group in found.groups] == [("dark", 8), ("dark", 4), ("flat", 4)]
    said = "\n".join(found.findings)
    assert "Not usable: " in said and "calibrated.fits: counts must be >= 0" in said
    assert "The file names of the darks of 0 s are not in the order of the times in their headers" in said
    assert found.groups[1].temperature_c == -10 and "-10.0" in str(found)
    assert main(["inspect", str(night), "--debug"]) == 0
    printed = capsys.readouterr().out
    assert found.verdict in printed and all(sentence in printed for sentence in found.stack.assumed)


def test_command_tells_a_capture_without_a_fit_by_its_status(tmp_path, rng, capsys):
    np.save(tmp_path / "darks.npy", darks(rng, 0, 1)[[0, 0, 0]])
    assert main(["inspect", str(tmp_path / "darks.npy"), "--exposure", "1"]) == 1
    assert "A fit makes no sense" in capsys.readouterr().out
    assert main(["inspect", str(tmp_path / "none")]) == 2


@pytest.mark.data
@pytest.mark.parametrize(
    "name, electrons_per_dn, words",
    [
        ("sbig_st8_cc0", 2.69, ["EGAIN 2.62 e-/DN agrees"]),
        ("ccd_kaf_mit", 2.32, ["settles", "drift", "GAIN 1.5 e-/DN, but"]),
        ("site_2k_ccd", 4.95, ["The overscan falls", "Variance over signal", "CCDGAIN 5"]),
    ],
)
def test_real_sensors(shared_data, name, electrons_per_dn, words):
    found = hsnoise.inspect(shared_data / "data" / name)
    gain = float(found.determined[0].split("about ")[1].split()[0])
    assert 1 / gain == pytest.approx(electrons_per_dn, rel=0.03) and found.fit_makes_sense
    assert all(word in "\n".join(found.findings) for word in words)
