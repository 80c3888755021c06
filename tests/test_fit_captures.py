"""Fits of captures that were not made by the model: other simulators, what is no dark capture, starts that are off."""

from __future__ import annotations

import json

import numpy as np
import pytest

import hsnoise
from benchmarks import simulator
from hsnoise.likelihood.moments import _of_one_rate

EXPOSURE_S = (0.02, 0.05, 0.1, 0.2)


def test_flats_of_several_lights_in_one_group_are_refused(rng):
    flats = np.concatenate([np.rint(0.5 * rng.poisson(x, (2, 16, 16)) + 50) for x in (100, 500)]).astype(np.uint16)
    with pytest.raises(ValueError, match="same light"):
        hsnoise.fit(flats, exposure_s=0.1, kind="flat", black_level=50, shutter="global")


@pytest.mark.slow
def test_directions_known_a_thousand_times_better_than_others_leave_errors_honest(rng):
    """Read noise far above shot noise: the product of gain and dark current is known well, each alone hardly."""
    frames = [
        np.rint(1.5 * (rng.poisson(50 * t, (4, 64, 96)) + 40 * rng.standard_normal((4, 64, 96))) + 400)
        for t in (0.1, 0.4, 3.2)
    ]
    result = hsnoise.fit(
        [f.astype(np.uint16) for f in frames], exposure_s=[0.1, 0.4, 3.2], black_level=400, shutter="global"
    )
    value, error, _ = result.table["gain"]
    assert abs(value - 1.5) < 4.5 * error
    assert 0.05 < error < 1.0


def test_flats_alone_need_a_black_level(rng):
    flats = [np.rint(0.5 * rng.poisson(x, (3, 16, 16)) + 50).astype(np.uint16) for x in (100, 500)]
    with pytest.raises(ValueError, match="black_level"):
        hsnoise.fit(flats, exposure_s=[0.1, 0.5], kind="flat", shutter="global")


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("case", ["a", "b"])
def test_cases_of_another_simulator_are_recovered(shared_data, case):
    answers = json.loads((shared_data / "cases" / "answers.json").read_text())[f"case_{case}"]["base"]
    with np.load(shared_data / "cases" / f"case_{case}.npz") as stored:
        result = hsnoise.fit(
            stored["counts"],
            exposure_s=stored["exposure_s"],
            black_level=float(stored["black_level"]),
            white_level=float(stored["white_level"]),
            cfa=str(stored["cfa"]),
            shutter=str(stored["shutter"]),
        )
    truth = {f"gain.{c}": answers["gain_dn_per_e"][c] for c in "RGB"}
    truth |= {f"row_gain.sigma.{c}": answers["row_gain_sigma"][c] for c in "RGB"}
    truth |= {"dark_current.rate": answers["dark_current_e_per_s"], "read_noise.sigma": answers["read_noise_e"]}
    truth |= {"row_gain.exponent": answers["row_spectrum_exponent"]}
    for name in result.names:
        value, error, _ = result.table[name]
        assert abs(value - truth[name]) < 3 * error, name


def test_copies_of_a_frame_are_refused():
    frame = np.random.default_rng(0).poisson(20, (1, 32, 48)).astype(np.uint16)
    other = np.random.default_rng(1).poisson(20, (1, 32, 48)).astype(np.uint16)
    with pytest.raises(ValueError, match="frames 0 and 2 of the 0.1 s exposure are identical"):
        hsnoise.fit(np.concatenate([frame, other, frame]), exposure_s=0.1, cfa="mono", shutter="global")


def test_a_few_pixels_are_refused():
    frames = np.random.default_rng(0).poisson(20, (4, 2, 2)).astype(np.uint16)
    with pytest.raises(ValueError, match="at least 8 x 8 pixels"):
        hsnoise.fit(frames, exposure_s=0.1, cfa="mono", shutter="global")


@pytest.mark.parametrize(
    ("means", "exposure_s", "words"),
    [((400, 400), (0.1, 0.4), "pass kind='flat'"), ((10, 30), (0.1, 0.1), "All exposures are given as 0.1 s")],
)
def test_what_cannot_be_darks_is_told(means, exposure_s, words):
    rng = np.random.default_rng(0)
    counts = [64 + rng.poisson(mean, (4, 32, 48)).astype(np.uint16) for mean in means]
    stack = hsnoise.FrameStack(counts, exposure_s, black_level=64, cfa="mono", shutter="global")
    result = hsnoise.fit(stack, method="line")
    assert any(words in note for note in result.notes)


def test_a_start_gives_all_channels_the_same_dark_electrons():
    """Where means and variances nearly agree the means decide; where they do not, something else moves the means."""
    dark_e, gain = np.array([1.0, 5.0, 10.0]), np.array([1.5, 0.9, 1.2])
    told = _of_one_rate(gain, dark_e, [1.3 * dark_e, 1.2 * dark_e, 9.0 * dark_e])
    np.testing.assert_allclose(told, [1.3, 1.2, 1.2])


@pytest.mark.slow
def test_rows_that_conflict_with_the_start_do_not_end_a_fit():
    """Hot pixels and row noise once gave a start at which the likelihood of coloured rows was no number."""
    hidden = ("row_noise", "hot_pixels")
    counts = simulator.capture(simulator.CAMERAS["canon"], hidden, 1.0, np.random.default_rng(4))
    result = hsnoise.fit(counts, exposure_s=EXPOSURE_S, black_level=0, white_level=65535, cfa="RGGB", shutter="rolling")
    assert result.method == "ml" and result.outcome.startswith("converged")


@pytest.mark.data
@pytest.mark.slow
def test_a_black_level_at_a_step_of_the_likelihood_is_known_to_half_a_count_only(shared_data):
    """Row noise taken for row gain: the model clips the gain of rows at 0, which lie on one count then."""
    with np.load(shared_data / "cases" / "case_c.npz") as data:
        known = {name: str(data[name]) for name in ("cfa", "shutter")}
        result = hsnoise.fit(data["counts"], exposure_s=data["exposure_s"], **known)
    value, error, _ = result.table["black_level.R"]
    assert abs(value - 63.5) < 0.01 and error == pytest.approx(0.5)
    assert any("black_level.R lies at a step of the likelihood" in note for note in result.notes)
    assert 1e-3 < result.table["black_level.G"][1] < 0.1
