"""Rows and columns that differ in their response to light, at random or even from odd, and outputs by their gain."""

from __future__ import annotations

import numpy as np
import pytest

import hsnoise
from hsnoise import FrameStack
from hsnoise.statistics.pixels.line_response import LitPlane, line_response

BLACK_DN, WHITE_DN, SHAPE, PRNU = 100.0, 4095, (192, 256), 0.01
LIGHTS = (0.1, 0.25, 0.4, 0.55, 0.7)


def capture(
    rng,
    *,
    rows=0.0,
    columns=0.0,
    row_parity=0.0,
    column_parity=0.0,
    outputs=0.0,
    cfa="mono",
    lights=LIGHTS,
    window=None,
):
    """Darks and flats under light that falls off to the corners; `outputs`: gain of odd columns less that of even."""
    width, (h, w) = (1 if cfa == "mono" else 2), SHAPE
    odd_rows, odd_columns = ((np.arange(n) // width % 2 - 0.5) for n in SHAPE)
    response = 1 + PRNU * rng.standard_normal(SHAPE)
    response += (rows * rng.standard_normal(h) + row_parity * odd_rows)[:, None]
    response += columns * rng.standard_normal(w) + column_parity * odd_columns
    y, x = np.meshgrid(np.linspace(-1, 1, h), np.linspace(-1, 1, w), indexing="ij")
    light, gain = response * (1 - 0.2 * (x**2 + y**2)), 0.5 * (1 + outputs * odd_columns)
    offset = BLACK_DN + rng.standard_normal(SHAPE)

    def frames(light_e, n):
        electrons = rng.poisson(light_e * light, (n, *SHAPE)) + 5 * rng.standard_normal((n, *SHAPE))
        return np.clip(np.rint(offset + gain * electrons), 0, WHITE_DN).astype(np.uint16)

    options = {"shutter": "global", "white_level": WHITE_DN, "cfa": cfa, "window": window}
    darks = FrameStack([frames(0.0, 8)], [0.01], **options)
    flats = FrameStack([frames(share * 7800, 4) for share in lights], lights, kind="flat", **options)
    return FrameStack.join(darks, flats)


def responses(fit):
    return {name: fit.table[f"photo_response_nonuniformity.{name}"] for name in NAMES}


NAMES = ("sigma", "row_sigma", "column_sigma", "row_parity", "column_parity")


@pytest.mark.parametrize("cfa", ["mono", pytest.param("RGGB", marks=pytest.mark.slow)])
def test_responses_of_lines_are_measured_and_drawn(rng, cfa):
    """They were in no model: sensors with stripes in flats had even samples, and `compare` did not see it."""
    truth = {"row_sigma": 0.002, "column_sigma": 0.003, "row_parity": -0.004, "column_parity": 0.01}
    stack = capture(rng, **_as_arguments(truth), cfa=cfa)
    fit = hsnoise.fit(stack)
    for name, (value, error, _) in responses(fit).items():
        scatter = 0.1 * abs(truth.get(name, 0.0)) if name.endswith("_sigma") else 0.0  # of so few lines
        assert abs(value - truth.get(name, PRNU)) < 4 * np.hypot(error, scatter)
    assert hsnoise.compare(fit, stack, draws=20).error < 3
    even = fit.params
    for name in truth:
        even = even.with_value("photo_response_nonuniformity", name, 0.0)
    apart = hsnoise.compare(even, stack, draws=20)
    assert apart.error > 10 and max(apart.groups, key=apart.groups.get) == "flats, column responses"


def _as_arguments(truth):
    return {"rows": truth["row_sigma"], "columns": truth["column_sigma"]} | {
        name: value for name, value in truth.items() if name.endswith("parity")
    }


@pytest.mark.parametrize("lights", [LIGHTS, (0.5,)])
def test_none_where_there_is_none(rng, lights):
    """The halves of the frames share the noise of rows and columns, which would pass for their response."""
    fit = hsnoise.fit(capture(rng, lights=lights))
    value, error, _ = responses(fit)["sigma"]
    assert abs(value - PRNU) < 4 * error
    assert all(responses(fit)[name][0] == 0 for name in NAMES[1:])


def test_a_parity_counts_from_the_sensor(rng):
    """Frames that begin at an odd column of the sensor have the sign of the other columns."""
    found = [hsnoise.fit(capture(rng, column_parity=0.01, window=of)) for of in (None, (0, 1, 400, 400))]
    signs = [responses(fit)["column_parity"][0] for fit in found]
    assert abs(signs[0] - 0.01) < 0.001 and abs(signs[1] + 0.01) < 0.001


@pytest.mark.parametrize("cfa", [pytest.param("mono", marks=pytest.mark.slow), "RGGB"])
@pytest.mark.slow
def test_outputs_are_told_from_responses_by_their_noise(rng, cfa):
    """Two outputs whose gains differ make even and odd columns differ in light as two responses do."""
    stack = capture(rng, outputs=0.02, cfa=cfa)
    fit = hsnoise.fit(stack)
    value, error, _ = fit.table["odd_even_pattern.gain_mismatch"]
    assert abs(value - 0.02) < 4 * error < 0.002
    assert responses(fit)["column_parity"][0] == 0
    assert hsnoise.compare(fit, stack, draws=20).error < 3


def test_both_are_told_apart_as_far_as_noise_goes(rng):
    """All of it had been called gain, 130 of its errors off."""
    fit = hsnoise.fit(capture(rng, outputs=0.04, column_parity=0.02))
    for name, truth in (("odd_even_pattern.gain_mismatch", 0.04), ("photo_response_nonuniformity.column_parity", 0.02)):
        value, error, _ = fit.table[name]
        assert abs(value - truth) < 4 * error < truth


def test_what_noise_does_not_tell_is_said(rng):
    fit = hsnoise.fit(capture(rng, outputs=0.005))
    assert responses(fit)["column_parity"][0] > 0 and "odd_even_pattern" not in fit.params
    assert any("more frames of the flats" in note for note in fit.notes)


def test_small_frames(rng):
    """The median of two kinds of columns is one of them: 2 % between even and odd became a spread of 2 %."""
    parity = np.where(np.arange(65) % 2 == 1, 0.01, -0.01)
    signal = 1000 * (1 + parity) + rng.standard_normal((33, 65))
    plane = LitPlane(signal, 1.0, (0.0, 0.0), 1.0)
    found = line_response([plane], 0.0, axis=1, numbers=np.arange(65))
    assert abs(found.parity[0] - 0.02) < 4 * found.parity[1] < 0.002
    assert found.variance[0] < 4 * found.variance[1]
    assert np.isfinite(line_response([plane], 0.0, axis=0, numbers=np.arange(33)).variance[1])


def test_errors_of_parity(rng):
    """They were a quarter too small: neighbouring differences share a line."""
    pulls, odd = [], np.arange(256) % 2 - 0.5
    for _ in range(300):
        signal = 1000 * (1 + 0.01 * odd + 0.002 * rng.standard_normal(256)) + rng.standard_normal((64, 256))
        value, error = line_response(
            [LitPlane(signal, 1.0, (0.0, 0.0), 1.0)], 0.0, axis=1, numbers=np.arange(256)
        ).parity
        pulls.append((value - 0.01) / error)
    assert 0.85 < np.std(pulls) < 1.15


def test_dark_lines_and_defects_do_not_count(rng):
    """Overscan, dust in a part of the lines and dead pixels."""
    signal = 1000 * (1 + 0.003 * rng.standard_normal((200, 1))) + rng.standard_normal((200, 300))
    signal[:, 280:] = 0.0
    signal[:20] = 0.0
    signal[80:100, 40:90] *= 0.7
    signal[rng.integers(0, 200, 60), rng.integers(0, 280, 60)] = 0.0
    plane = LitPlane(signal, 1.0, (0.0, 0.0), 1.0)
    variance, error = line_response([plane], 0.0, axis=0, numbers=np.arange(200)).variance
    assert abs(np.sqrt(variance) - 0.003) < 4 * error / (2 * 0.003) + 0.0003
    assert line_response([plane], 0.0, axis=1, numbers=np.arange(300)).variance[0] < 1e-6


def test_few_lines_tell_nothing():
    plane = LitPlane(np.full((16, 300), 1000.0), 1.0, (0.0, 0.0), 1.0)
    assert np.isinf(line_response([plane], 0.0, axis=0, numbers=None).variance[1])
