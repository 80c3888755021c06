"""The simulator of hidden effects by its moments, and the tables of the grid from records made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import _grid_cells, _grid_tables, hidden_effect, simulator
from benchmarks.simulator import CANON, EXPOSURE_S, GRASSHOPPER, MODEST, MONO, ODD, PAIRS, capture

SHAPE, FRAMES = (64, 96), 4


def captured(camera, effect, amplitude=1.0, seed=7):
    rng = np.random.default_rng(seed)
    return capture(camera, effect, amplitude, rng, frames=FRAMES, shape=SHAPE).astype(float)


@pytest.mark.parametrize("effect", [None, *MODEST, *ODD, *PAIRS])
def test_every_effect_gives_counts_that_differ_from_the_clean_ones(effect):
    counts = captured(GRASSHOPPER, effect)
    assert counts.shape == (len(EXPOSURE_S), FRAMES, *SHAPE)
    assert (counts == captured(GRASSHOPPER, None)).all() == (effect is None)


def test_clamp_changes_the_mean_but_not_the_variance():
    camera = replace(GRASSHOPPER, black=400.0)
    clean, clamped = captured(camera, None), captured(camera, "black_clamp")
    green = simulator.colour_of(SHAPE) == 1
    for e, t in enumerate(EXPOSURE_S):
        fall = (clean - clamped)[e][:, green]
        np.testing.assert_allclose(fall.mean(), 0.7 * camera.gain[1] * camera.dark * t, rtol=0.02)
        np.testing.assert_allclose(clamped[e][:, green].var(), clean[e][:, green].var(), rtol=0.01)


def test_clamp_never_takes_more_than_the_dark_level():
    counts = captured(replace(MONO, black=400.0), "black_clamp", amplitude=4.0)
    np.testing.assert_allclose(counts.mean((1, 2, 3)), 400, atol=1)


def test_nonlinear_response_falls_behind_as_the_square():
    camera = replace(MONO, row_sigma=(0.0,))
    a = MODEST["nonlinearity"]
    fall = (captured(camera, None) - captured(camera, "nonlinearity")).mean((1, 2, 3)) / camera.gain[0]
    signal = camera.dark * np.array(EXPOSURE_S)
    second_moment = signal**2 + signal + camera.read**2
    np.testing.assert_allclose(fall[2:], a * second_moment[2:], rtol=0.06)


def test_a_pair_acts_both():
    counts = captured(replace(GRASSHOPPER, row_sigma=(0.0,) * 3), ("column_fixed_pattern", "frame_offset"), 3.0)
    clean = captured(replace(GRASSHOPPER, row_sigma=(0.0,) * 3), None)
    green = np.s_[0, :, 0::2, 1::2]
    for axis in ((0, 1), (1, 2)):
        assert counts[green].mean(axis).std() > 3 * clean[green].mean(axis).std()


def test_mono_camera_has_one_gain():
    counts = captured(MONO, None)
    expected = MONO.black + MONO.gain[0] * MONO.dark * np.array(EXPOSURE_S)
    np.testing.assert_allclose(counts.mean((1, 2, 3)), expected, atol=0.5)


def test_unknown_effect():
    with pytest.raises(ValueError, match="'ghosts' is not one of"):
        capture(CANON, "ghosts", 1.0, np.random.default_rng(0))


def test_cells_have_keys_of_their_own_and_seeds_outermost():
    cells = _grid_cells.grid_cells(["canon", "mono"], ["none", "row_noise"], [1.0, 0.5], range(2), 8, (32, 48))
    layouts = _grid_cells.layout_cells(range(2))
    assert len({cell.about["key"] for cell in cells + layouts}) == len(cells + layouts)
    assert [cell.about["seed"] for cell in cells] == [0] * 6 + [1] * 6  # clean captures only once a seed
    stack, truth = _grid_cells.layout_cells([0])[0].make()
    assert stack.n_exposures == 4 and truth["gain.R"] == CANON.gain[0]


def record(effect, verdict, names=(), top=(), seed=0, amplitude=1.0, **more):
    cell = _grid_cells.grid_cells(["canon"], [effect], [amplitude], [seed], 8, (32, 48))[0]
    order = [name for name, _ in top]
    ranks = {name: order.index(name) + 1 if name in order else None for name in cell.hidden}
    return {
        **cell.about,
        "refit": False,
        "seconds": {"fit": 2.0},
        "failure": None,
        "truth": {"gain.R": 1.0},
        "base_before": {"gain.R": [1.5, 0.1]},
        "error_before": 20.0,
        "verdict": verdict,
        "names": list(names),
        "ranks": ranks,
        "rank": min((r for r in ranks.values() if r), default=None),
        "top": [list(one) for one in top],
        **more,
    }


@pytest.fixture
def records():
    refit = {"refit": True, "error_after": 1.0, "base_after": {"gain.R": [1.1, 0.1]}}
    improved = {
        "added": ["row_noise"],
        "with_another_key": ["row_noise"],
        "ended": "unexplained",
        "light": "red",
        "error": 9.0,
        "base": {"gain.R": [0.9, 0.05]},
    }
    pair = {**improved, "added": ["hot_pixels", "crosstalk", "row_noise"], "error": 1.2}
    right, wrong = ("row_noise", 50.0), ("column_noise", 60.0)
    failed = _grid_cells.grid_cells(["canon"], ["crosstalk"], [1.0], [0], 8, (32, 48))[0]
    return [
        record("row_noise", "named", ["row_noise"], [right], **refit),
        record("row_noise", "named", ["column_noise"], [wrong, right], seed=1),
        record("row_noise", "ambiguous", ["row_noise", "column_noise"], [right, wrong], seed=2),
        record("none", "nothing missing", top=[right]),
        record("none", "unexplained", top=[right], seed=1),
        record("ramp_37_rows", "unexplained", top=[right], improved=improved),
        record("row_noise+hot_pixels", "named", ["hot_pixels"], [("hot_pixels", 90.0), right], improved=pair),
        {**failed.about, "refit": False, "seconds": {"simulate": 0.1, "fit": 1.0}, "failure": "ValueError: no"},
    ]


def test_tables_count_what_was_found(records):
    tables = {sheet.title: sheet.rows for sheet in _grid_tables.sheets(records)}
    assert tables["One effect hidden"] == [("canon", "1", "3", "2", "3", "1", "1", "1", "0", "0")]
    assert tables["Confusion: another effect first"] == [("row_noise", "column_noise", "named", "1", "1")]
    assert tables["False alarms on clean captures"][0][2:7] == ("2", "1", "0", "50.0%", "97.5%")
    assert tables["Two effects at once"][0][3:] == ("named 1", "1", "1", "1")
    whole = ("ramp_37_rows", "canon", "row_noise", "unexplained", "red", "20", "9", "gain.R -10.0% (-2.0)")
    assert tables["The whole loop"][0] == whole
    assert tables["What the whole loop added"] == [
        ("2 effects", "1", "1", "3% to 100%", "0", "1", "1", "0"),
        ("not in the library", "1", "0", "0% to 98%", "0", "1", "0", "1"),
    ]
    again = {row[0]: row[1:] for row in tables["Error (median) and base parameters"]}
    assert again["row_noise"] == ("3", "1", "20", "1", "0% of 1", "100% of 1")
    assert tables["Cells that raised"][0][1:] == ("fit", "ValueError: no")


def test_upper_bound_of_no_alarm_is_the_rule_of_three():
    assert _grid_tables.upper_bound(0, 100) == pytest.approx(0.03, abs=0.001)
    assert _grid_tables.upper_bound(5, 5) == 1
    assert _grid_tables.interval(0, 10)[0] == 0


def test_report_writes_markdown_and_figure(records, tmp_path, monkeypatch, capsys):
    cells = iter(records)
    monkeypatch.setattr(hidden_effect, "measure", lambda cell, refit, minutes: next(cells))
    jobs = [_grid_cells.Cell({"key": one["key"]}, None) for one in records]
    out = tmp_path / "grid.jsonl"
    out.write_text('{"key": "cut o')
    hidden_effect.run(jobs, out, refit=False, improve_minutes=None, minutes=None)
    assert len(hidden_effect.read(out)) == len(records)
    hidden_effect.run(jobs, out, refit=False, improve_minutes=None, minutes=None)  # everything is there already
    hidden_effect.report(out)
    assert "| canon | 1 | 3 |" in out.with_suffix(".md").read_text()
    assert out.with_suffix(".png").stat().st_size > 1000
    assert "8 records" in capsys.readouterr().out
