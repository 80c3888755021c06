"""The benchmark of sensors whose pixels differ: figures from records whose answer is known, folders as written."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

import hsnoise
from benchmarks import pixels
from benchmarks._pixel_tables import determined, figures, undetermined, withheld
from benchmarks._real_folders import COVERED, REAL, Known, judged, unpacked
from benchmarks.pixel_simulator import draw


def record(gain, error, *, truth=2.0, trustworthy=True, refused=None, broke=None):
    table = {} if refused or broke else {"gain": [gain, error], "read_noise.sigma": [3.0, 0.0]}
    about = {"refused": refused, "broke": broke, "trustworthy": trustworthy, "seconds": 1.0, "truth": {"gain": truth}}
    return about | {"table": table, "doubts": []}


def test_figures_of_gains_are_relative_and_their_coverage_counted():
    f = figures([record(2.02, 0.02), record(1.98, 0.02), record(2.2, 0.05, trustworthy=False), record(np.nan, np.inf)])
    np.testing.assert_allclose([f["bias"], f["rms"], f["worst"]], [0.1 / 3, np.sqrt(0.0102 / 3), 0.1])
    np.testing.assert_allclose([f["cover gain"], f["withheld"], f["trustworthy"]], [2 / 3, 0.25, 0.75])
    assert np.isnan(f["cover mean dark current"])


def test_refused_and_nan_are_both_withheld_and_a_fit_that_broke_is_not():
    records = [
        record(np.nan, np.nan),
        record(0, 0, refused="one exposure"),
        record(1.2, 0.3),
        record(0, 0, broke="SVD"),
    ]
    assert [withheld(r) for r in records] == [True, True, False, False]
    row = undetermined({"bias only": records}).rows[0]
    assert row[1:5] == ("2 of 4", "1", "1", "1.2 ± 0.3")
    assert determined({"CCD warm": records}).rows[0][0] == "CCD warm (4)"


@pytest.mark.parametrize(
    ("error", "kept_as"), [(ValueError("one"), "refused"), (np.linalg.LinAlgError("one"), "broke")]
)
def test_refusals_are_told_from_failures(monkeypatch, error, kept_as):
    def fit(*_, **__):
        raise error

    monkeypatch.setattr(hsnoise, "fit", fit)
    of_one = pixels.one_fit("bias only", 0, "auto")
    assert of_one[kept_as] == "one" and not of_one["trustworthy"] and not of_one["table"]


def fitted(hot: bool):
    """A fit with a gain of 0.7, a dark current of 0.3 and, with `hot`, 2 % hot pixels of 9 e-/s."""
    values = {"gain": (0.7, 0.01), "dark_current.rate": (0.3, 0.003)}
    if hot:
        values |= {"hot_pixels.fraction": (0.02, 0.001), "hot_pixels.rate": (9.0, 0.2)}
    return SimpleNamespace(
        trustworthy=True,
        doubts=(),
        names=tuple(values),
        covariance=np.diag([error**2 for _, error in values.values()]),
        table={name: (*pair, "") for name, pair in values.items()},
        params=SimpleNamespace(names=("dark_current", "hot_pixels") if hot else ("dark_current",)),
    )


def test_the_mean_dark_current_has_the_hot_pixels_in_it(rng):
    assert pixels.mean_dark_current(fitted(False)) == (0.3, 0.003)
    value, error = pixels.mean_dark_current(fitted(True))
    assert value == pytest.approx(0.3 + 0.02 * 9)
    assert error == pytest.approx(np.sqrt(0.003**2 + (9 * 0.001) ** 2 + (0.02 * 0.2) ** 2))
    truth = pixels.truth_of("CCD warm", draw(pixels.KINDS["CCD warm"], rng))
    assert truth["mean dark current"] == pytest.approx(0.3 + 0.02 * 9, rel=0.1)


def test_an_interrupted_run_goes_on(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(hsnoise, "fit", lambda *_, **keywords: calls.append(keywords) or fitted(True))
    out = tmp_path / "pixels.jsonl"
    pixels.run(["CCD warm"], 1, 1, "auto", out)
    with out.open("a") as file:
        file.write('\n{"kind": "CCD w')
    again = pixels.run(["CCD warm"], 2, 1, "auto", out)
    assert len(calls) == 2 and len(again["CCD warm"]) == 2
    assert pixels.run(["CCD warm"], 2, 1, "auto", out) == again and len(calls) == 2
    assert set(calls[0]) == {"method", "exposure_s", "black_level", "white_level", "cfa", "shutter"}
    assert json.loads(out.read_text().splitlines()[1])["truth"]["gain"] == 0.7


@pytest.mark.parametrize(
    ("known", "value", "error", "reached"),
    [
        (Known("gain", 0.5, 0.52, 0.02), 0.53, 0.001, "yes"),
        (Known("gain", 0.5, 0.52, 0.02), 0.535, 0.1, "no"),
        (Known("gain", 0.5, 0.52, COVERED), 0.6, 0.05, "yes"),
        (Known("gain", 0.5, 0.52, COVERED), 0.6, 0.03, "no"),
        (Known("gain", 0.5, 0.52, COVERED), 0.6, 10.0, "no"),
        (Known("gain", 0.5, 0.52, 0.02), 0.51, 10.0, "no"),
        (Known("share", 0.5, 0.52, 0.02), 0.51, np.nan, "yes"),
        (Known("gain", 0.5, 0.52, 0.02), np.nan, np.inf, "no"),
        (Known("gain", np.nan, np.nan), np.nan, np.inf, "yes"),
        (Known("gain", np.nan, np.nan), 0.5, 0.01, "no"),
    ],
)
def test_a_fit_is_judged_by_what_is_known(known, value, error, reached):
    assert judged(known, value, error)[-1] == reached


@pytest.mark.data
def test_sets_are_written_as_their_owners_keep_them(shared_data, tmp_path):
    unpacked("sbig_stl1001_ccd", "bias_m05C|flat")(shared_data / "data", tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bias", "flat"]
    stack = hsnoise.load(tmp_path / "bias")
    assert stack.n_frames == (10,) and stack.exposure_s.tolist() == [0.0]
    assert len({real.name for real in REAL}) == len(REAL)
