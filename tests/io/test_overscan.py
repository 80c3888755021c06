"""Overscan is found in flats or named by headers, and taken off when asked for; its means are kept."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits

from hsnoise.frames.io.load import load

BLACK_DN, WIDTH = 500, 12


@pytest.fixture
def sensor(tmp_path):
    """Darks and flats of 40 x 100 pixels whose last 12 columns see no light; their level falls with the light."""

    def write(kind, seconds, signal_dn, fall_dn):
        rng = np.random.default_rng([int(seconds * 10), signal_dn])
        level = np.full((40, 100), BLACK_DN + signal_dn, float)
        level[:, -WIDTH:] = BLACK_DN - fall_dn
        for i in range(3):
            header = fits.Header({"IMAGETYP": kind, "EXPTIME": seconds, "FILTER": "V"})
            frame = rng.normal(level, np.sqrt(level)).round().astype(np.uint16)
            fits.writeto(tmp_path / f"{kind}_{seconds}_{i}.fits", frame, header)

    write("bias", 0.0, 0, 0)
    write("flat", 1.0, 2000, 40)
    write("flat", 2.0, 4000, 80)
    return tmp_path


def test_overscan_is_named_by_default(sensor):
    stack = load(sensor)
    assert stack.shape == (40, 100) and stack.overscan_dn is None
    assert stack.assumed == ("The last 12 columns look like overscan: overscan='auto' removes them",)


@pytest.mark.parametrize("overscan", ["auto", (None, (88, 100)), ((0, 40), (88, 100))])
def test_overscan_taken_off(sensor, overscan):
    stack = load(sensor, overscan=overscan)
    assert stack.shape == (40, 88) and stack.assumed == ("The last 12 columns were removed as overscan",)
    error_dn = np.sqrt(BLACK_DN / (40 * WIDTH / 2 * 3))
    np.testing.assert_allclose(stack.overscan_dn, [500, 460, 420], rtol=0, atol=4 * error_dn)
    np.testing.assert_array_equal(stack.frame(2, 0), load(sensor).frame(2, 0)[:, :88])


def test_overscan_of_portrait_frames_is_rows(sensor):
    stack = load(sensor, overscan="auto", row_axis=1)
    assert stack.shape == (88, 40) and "last 12 rows" in stack.assumed[0]


@pytest.mark.parametrize(
    "overscan, message",
    [
        ("left", "overscan: expected 'auto', None or spans"),
        ((None, (40, 60)), "columns at an edge"),
        (((0, 5), (0, 5)), "columns at an edge"),
        ((None, (90, 101)), "0 <= start < stop <= 100"),
        (3, "overscan: expected"),
    ],
)
def test_wrong_overscan(sensor, overscan, message):
    with pytest.raises(ValueError, match=message):
        load(sensor, overscan=overscan)


def test_vignetting_is_no_overscan(tmp_path):
    rng = np.random.default_rng(0)
    light = 4000 * np.clip(np.arange(100) / 20, 0, 1)  # falls to nothing over 20 columns
    for i in range(2):
        for kind, level in (("bias", np.full(100, BLACK_DN)), ("flat", BLACK_DN + light)):
            frame = rng.poisson(np.broadcast_to(level, (40, 100))).astype(np.uint16)
            fits.writeto(tmp_path / f"{kind}{i}.fits", frame, fits.Header({"IMAGETYP": kind, "EXPTIME": 1.0}))
    assert load(tmp_path).assumed == ()


def test_overscan_beside_light_that_falls_toward_it(tmp_path):
    """Columns without light at both edges, the light beside the right ones half of that in the middle."""
    light = 8000 * np.linspace(1, 0.35, 200)
    light[:10] = light[-10:] = 0
    for i in range(2):
        rng = np.random.default_rng(i)
        for kind, level in (("bias", np.full(200, BLACK_DN)), ("flat", BLACK_DN + light)):
            frame = rng.poisson(np.broadcast_to(level, (40, 200))).astype(np.uint16)
            fits.writeto(tmp_path / f"{kind}{i}.fits", frame, fits.Header({"IMAGETYP": kind, "EXPTIME": 1.0}))
    stack = load(tmp_path, overscan="auto")
    assert stack.shape == (40, 180)
    assert stack.assumed[:2] == (
        "The first 10 columns were removed as overscan",
        "The last 10 columns were removed as overscan",
    )


@pytest.mark.parametrize("section, told", [("[1:8,1:40]", True), ("[1:8,1:400]", False), ("none", False)])
def test_overscan_of_headers(tmp_path, section, told):
    for i in range(2):
        frame = np.random.default_rng(i).poisson(BLACK_DN, (40, 100)).astype(np.uint16)
        fits.writeto(
            tmp_path / f"{i}.fits", frame, fits.Header({"EXPTIME": 1.0, "IMAGETYP": "dark", "BIASSEC": section})
        )
    assert ("The first 8 columns look like overscan" in repr(load(tmp_path))) == told


@pytest.mark.data
def test_overscan_that_falls_with_the_light(shared_data):
    stack = load(shared_data / "data" / "site_2k_ccd", overscan="auto")
    assert stack.shape == (200, 269) and stack.overscan_dn[0] > 4800 and min(stack.overscan_dn) < 400
