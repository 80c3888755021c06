"""A black level that settles over a run: its course is measured, and told from offsets that are new in each frame."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise.criticism.closing import closed
from hsnoise.criticism.held_out import split_frames
from hsnoise.simulation.portion import Portion
from hsnoise.statistics.pixels.settling import settling_of

SHAPE = (64, 96)


def drawn(offsets_dn, exposures_s=(0.0, 0.0), frames=14, gain=1.5, seed=0):
    """Darks whose pixels differ, and flats; offsets_dn(f): of each frame [frame], DN."""
    rng = np.random.default_rng(seed)
    offset, rate = rng.normal(0, 3, SHAPE), rng.gamma(4, 2, SHAPE)
    counts, kinds, seconds = [], [], []
    for exposure_s in dict.fromkeys(exposures_s):
        electrons = rng.poisson(rate * exposure_s, (frames, *SHAPE)) + rng.normal(0, 6, (frames, *SHAPE))
        of_frames = offsets_dn(np.arange(frames), rng)[:, None, None]
        counts.append(np.rint(500 + offset + of_frames + gain * electrons))
        kinds.append("dark")
        seconds.append(exposure_s)
    for light in (500, 2000, 5000):
        electrons = rng.poisson(light, (2, *SHAPE)) + rng.normal(0, 6, (2, *SHAPE))
        counts.append(np.rint(500 + offset + gain * electrons))
        kinds.append("flat")
        seconds.append(light / 1000)
    known = {"kind": kinds, "white_level": 65535, "shutter": "global"}
    return hsnoise.FrameStack([of.astype(np.uint16) for of in counts], seconds, **known)


def settling(f, rng):
    return 6 * np.exp(-f / 0.8) - 4 * np.exp(-f / 12) + rng.normal(0, 0.2, len(f))


def test_the_course_of_bias_frames_is_measured():
    fit = hsnoise.fit(drawn(settling, frames=24))
    assert "frame_settling" in fit.added
    for name, truth in (("amplitude", 6 / 1.5), ("slow", -4 / 1.5)):
        value, error, _ = fit.table[f"frame_settling.{name}"]
        assert error < 0.25 * abs(truth) and abs(value - truth) < 4 * error, (name, value, error)
    assert fit.table["black_level"][0] == pytest.approx(500, abs=4 * fit.table["black_level"][1])
    sigma, error, _ = fit.table["frame_offset.sigma"]
    assert abs(sigma - 0.2 / 1.5) < 4 * error


@pytest.mark.slow
def test_a_model_with_the_course_is_like_the_frames():
    stack = drawn(settling, frames=24)
    fit = hsnoise.fit(stack)
    assert hsnoise.compare(fit, stack).fits
    assert hsnoise.compare(fit.params.remove("frame_settling"), stack).error > 5
    assert closed(fit, stack).comparison.groups["level"] < 5  # the course is in no map


@pytest.mark.slow
def test_frames_held_out_are_later_ones_of_the_course():
    stack = drawn(settling, frames=24)
    first, last = split_frames(Portion.of(stack), stack)
    fit = hsnoise.fit(first)
    found = closed(fit, first, held_out=last, before=(18,))
    assert found.comparison.groups["level"] < 5 and found.before.groups["level"] < 5
    of_frames = [share for share in found.shares if share.component == "frame"]
    assert of_frames and all(share.unexplained == 0 for share in of_frames)
    with pytest.raises(ValueError, match="before: expected a number for each of 1 exposures held out"):
        closed(fit, first, held_out=last, before=(18, 18))


def test_exposures_of_one_course_tell_it():
    fit = hsnoise.fit(drawn(lambda f, _: 8 * np.exp(-f / 1.5), exposures_s=(0.1, 0.5), frames=8))
    value, error, _ = fit.table["frame_settling.amplitude"]
    assert abs(value - 8 / 1.5) < 4 * error and "frame_offset" not in fit.added


@pytest.mark.parametrize("kind", ["new in each frame", "one lit frame", "none"])
def test_other_offsets_are_no_course(kind):
    offsets = {
        "new in each frame": lambda f, rng: rng.normal(0, 2, len(f)),
        "one lit frame": lambda f, _: 5.0 * (f == 7),
        "none": lambda f, _: 0.0 * f,
    }
    assert "frame_settling" not in hsnoise.fit(drawn(offsets[kind])).added


def test_what_grows_with_exposure_is_none_of_the_black_level():
    rng, f = np.random.default_rng(1), np.arange(10)
    runs = [rng.normal(0, 0.1, 10) + size * np.exp(-f / 3) for size in (1.0, 2.0, 4.0)]
    assert settling_of(runs, is_bias=False) is None
    assert settling_of([rng.normal(0, 0.1, 10) + np.exp(-f / 3)] * 3, is_bias=False) is not None


def test_one_run_of_lit_or_long_frames_tells_no_black_level():
    run = 5 * np.exp(-np.arange(20) / 2) + np.random.default_rng(2).normal(0, 0.1, 20)
    assert settling_of([run], is_bias=False) is None
    assert settling_of([run], is_bias=True) is not None


@pytest.mark.parametrize(("frames", "exposures"), [(8, 4), (20, 1), pytest.param(48, 2, marks=pytest.mark.slow)])
def test_white_offsets_are_hardly_ever_taken_for_a_course(frames, exposures):
    rng = np.random.default_rng(3)
    runs = [[rng.normal(0, 1, frames) for _ in range(exposures)] for _ in range(300)]
    assert not any(settling_of(of, is_bias=True) for of in runs)


@pytest.mark.data
def test_the_bias_frames_of_a_ccd_settle(shared_data):
    fit = hsnoise.fit(shared_data / "data" / "ccd_kaf_mit")
    amplitude, error, _ = fit.table["frame_settling.amplitude"]
    assert amplitude > 10 * error and fit.table["frame_offset.sigma"][0] < 1.0  # 3.3 e- with the course in it
