"""Flats of a cool sensor that would give a wrong gain in green: nothing in its darks contradicts them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hsnoise
from hsnoise.likelihood.flat_gain import flat_gain

GAIN, BLACK_DN, NOISE_E, SHAPE = 0.8, 200.0, 3.0, (96, 128)
EXPOSURES_S, LIGHT_E = (1.0, 4.0, 16.0), (600, 1500, 3000)


def electrons(light_e, frames=4, seed=0):
    """Counts without light are those of an amplifier and a few hot pixels; light_e [pixel] for flats."""
    return np.random.default_rng(seed).poisson(np.broadcast_to(light_e, (frames, *SHAPE))).astype(float)


def read(electrons_e, seed=1):
    """Counts, and offsets of the pixels that are the same in all frames."""
    rng, offset_dn = np.random.default_rng(seed), np.random.default_rng(9).normal(0, 2, SHAPE)
    noisy = electrons_e + rng.normal(0, NOISE_E, electrons_e.shape)
    return BLACK_DN + offset_dn + GAIN * noisy


def codes(counts):
    return np.clip(np.rint(counts), 0, 65535).astype(np.uint16)


def hot_e():
    rate = np.full(SHAPE, 0.02)
    rate.flat[:: SHAPE[0] * SHAPE[1] // 30] = 60.0
    return rate


def darks(order=(0, 1, 2)):
    return [codes(read(electrons(hot_e() * EXPOSURES_S[i], 6, 20 + i), 30 + i)) for i in order]


def stack(flats, order=(0, 1, 2)):
    known = {"kind": ["dark"] * 3 + ["flat"] * len(flats), "white_level": 65535, "shutter": "global"}
    return hsnoise.FrameStack([*darks(order), *flats], [*EXPOSURES_S, *[1.0] * len(flats)], **known)


def flats(light_e=LIGHT_E, frames=4):
    return [codes(read(electrons(of, frames, 40 + i), 50 + i)) for i, of in enumerate(light_e)]


def gain_of(fit):
    return fit.table["gain"][:2]


def test_without_a_fault_there_is_no_doubt():
    """Nor of hot pixels, which had been far noisier than others of their level where they are few."""
    fit = hsnoise.fit(stack(flats()))
    assert not fit.doubts and abs(gain_of(fit)[0] - GAIN) < 4 * gain_of(fit)[1]


def test_a_hot_pixel_is_no_column_far_off(monkeypatch):
    """Although it pulls the mean of its column."""
    one_hot = np.full(SHAPE, 0.02)
    one_hot[30, 70] = 200.0
    monkeypatch.setitem(globals(), "hot_e", lambda: one_hot)
    assert not any("far off" in note for note in hsnoise.fit(stack(flats())).notes)


def test_one_level_is_doubted_where_darks_tell_no_gain():
    fit = hsnoise.fit(stack(flats(LIGHT_E[1:2])))
    assert any("nothing shows whether the response bends" in doubt for doubt in fit.doubts)


def test_copies_are_refused():
    of = flats()
    of[1][2] = of[1][0]
    with pytest.raises(ValueError, match="flats: frames 0 and 2 of the 1 s exposure are identical"):
        hsnoise.fit(stack(of))


def test_saturated_copies_are_no_error():
    full = np.full((2, *SHAPE), 65535, np.uint16)
    full[:, 0, 0] = 300
    known = {"kind": ["dark", "flat", "flat"], "shutter": "global"}
    hsnoise.fit(hsnoise.FrameStack([darks()[0], flats()[0], full], [1.0, 1.0, 2.0], **known))


def test_image_lag_in_the_flats_alone_is_told():
    of = []
    for i, light in enumerate(LIGHT_E):
        whole = electrons(light, 7, 40 + i)
        of.append(codes(read((0.9 * whole[1:] + 0.1 * whole[:-1]), 50 + i)))
    fit = hsnoise.fit(stack(of))
    assert not fit.trustworthy and any("in common with the frame before" in doubt for doubt in fit.doubts)


@pytest.mark.parametrize("order", [(0, 2, 1), (0, 1, 2)])
def test_hot_pixels_tell_swapped_exposures(order):
    fit = hsnoise.fit(stack(flats(), order))
    assert any("are the exposures swapped" in doubt for doubt in fit.doubts) is (order != (0, 1, 2))


@pytest.mark.parametrize(("step", "told"), [(0.5, True), (0.02, False)])
def test_compressed_counts_are_told(step, told):
    """Codes at equal distances of the root, as lossy raw formats have them: step, in units of the root of a count."""

    def compressed(counts):
        root = np.sqrt(np.maximum(counts, 0.0)) * 2 / step
        return codes((np.rint(root) * step / 2) ** 2)

    of = [compressed(read(electrons(light, 4, 40 + i), 50 + i)) for i, light in enumerate(LIGHT_E)]
    fit = hsnoise.fit(stack(of))
    assert any("compresses its counts" in doubt for doubt in fit.doubts) is told


def test_levels_that_agree_by_chance_have_the_error_of_chance():
    """Of EMVA 1288's line, which stands in where no curve describes the levels."""
    flats_of = hsnoise.summarise(stack(flats((600, 1200, 2000)))).flats
    signal = flats_of.mean_dn - flats_of.dark_dn
    exact = flats_of.dark_variance_dn2 + GAIN * signal * np.array([[1.0], [1.0], [1.3]])
    found = flat_gain(replace(flats_of, variance_dn2=exact, row_power_dn2=0 * exact))
    assert not found.described[0] and found.used[:, 0].tolist() == [True, True, False]
    assert found.gain[0] == pytest.approx(GAIN, rel=1e-6)
    by_chance = 1 / np.sqrt(np.sum(1 / found.level_error[:2, 0] ** 2))
    assert found.standard_error[0] == pytest.approx(by_chance, rel=0.01)
