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


def record(gain, error, *, truth=2.0, trustworthy=True, refused=None):
    table = {} if refused else {"gain": [gain, error], "read_noise.sigma": [3.0, 0.0]}
    about = {"refused": refused, "trustworthy": trustworthy, "seconds": 1.0, "truth": {"gain": truth}}
    return about | {"table": table, "doubts": []}


def test_figures_of_gains_are_relative_and_their_coverage_counted():
    f = figures([record(2.02, 0.02), record(1.98, 0.02), record(2.2, 0.05, trustworthy=False), record(np.nan, np.inf)])
    np.testing.assert_allclose([f["bias"], f["rms"], f["worst"]], [0.1 / 3, np.sqrt(0.0102 / 3), 0.1])
    np.testing.assert_allclose([f["cover gain"], f["withheld"], f["trustworthy"]], [2 / 3, 0.25, 0.75])
    assert np.isnan(f["cover dark_current.rate"])


def test_refused_and_nan_are_both_withheld():
    records = [record(np.nan, np.nan), record(0, 0, refused="one exposure"), record(1.2, 0.3)]
    assert [withheld(r) for r in records] == [True, True, False]
    row = undetermined({"bias only": records}).rows[0]
    assert row[1:4] == ("2 of 3", "1", "1.2 ± 0.3")
    assert determined({"CCD warm": records}).rows[0][0] == "CCD warm (3)"


def test_the_truth_of_the_dark_current_depends_on_whether_hot_pixels_are_apart(rng):
    drawn = draw(pixels.KINDS["CCD warm"], rng)
    apart, together = (pixels.truth_of("CCD warm", drawn, hot_apart=x)["dark_current.rate"] for x in (True, False))
    assert apart == pytest.approx(0.3, rel=0.01)
    assert together == pytest.approx(0.3 + 0.02 * 9, rel=0.1)


def test_an_interrupted_run_goes_on(tmp_path, monkeypatch):
    fitted = SimpleNamespace(trustworthy=True, doubts=(), table={"gain": (0.7, 0.01, "DN/e-")}, params=None)
    fitted.params = SimpleNamespace(names=("hot_pixels",))
    calls = []
    monkeypatch.setattr(hsnoise, "fit", lambda *_, **keywords: calls.append(keywords) or fitted)
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
