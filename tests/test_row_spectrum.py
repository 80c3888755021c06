"""The row gain is one law in draws and fits: nearly white rows, and a share of white noise."""

from __future__ import annotations

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise import plots
from hsnoise.effects import ADC, BlackLevel, DarkCurrent, Gain, ReadNoise, RowGain, ShotNoise
from hsnoise.likelihood.plan import plan_rules

EXPOSURE_S = (0.05, 0.2)


def camera(exponent=1.0, white_share=0.0, sigma=0.3):
    row_gain = RowGain(sigma, exponent, white_share)
    effects = [ShotNoise(), DarkCurrent(60.0), ReadNoise(3.0), row_gain, Gain(2.0), BlackLevel(64.0), ADC()]
    return hsnoise.NoiseModel(effects, cfa="mono", shutter="rolling", exposure_s=0.1)


def capture(model, seed=0, exposure_s=EXPOSURE_S, frames=8, shape=(64, 96), shutter="rolling"):
    keys = jax.random.split(jax.random.key(seed), len(exposure_s))
    counts = [
        np.asarray(hsnoise.sample_dark(key, frames, shape, model, exposure_s=t))
        for key, t in zip(keys, exposure_s, strict=True)
    ]
    black = np.asarray(model["black_level"].value, float)
    return hsnoise.FrameStack(counts, exposure_s, black_level=black, cfa=model.cfa, shutter=shutter)


def pulls(result, model):
    """(estimate - truth) / standard error of all fitted parameters."""
    truth = {name: value for name, (value, _, _) in model.table.items()}
    return {name: (result.table[name][0] - truth[name]) / result.table[name][1] for name in result.names}


def with_share(model, white_share):
    return model.with_value("row_gain", "white_share", white_share)


# Nearly white rows


@pytest.mark.slow
def test_white_rows_of_a_rolling_shutter_are_fitted_with_honest_errors():
    """A strong row gain of few rows: with a DC term in the draws alone, the gain's root mean square pull is 6."""
    model = camera(0.0, sigma=0.4)
    found = [pulls(hsnoise.fit(capture(model, s, frames=4, shape=(32, 192))), model) for s in range(6)]
    for name in ("gain", "row_gain.sigma", "row_gain.exponent"):
        assert np.sqrt(np.mean([f[name] ** 2 for f in found])) < 1.7, name  # chi-square of 6: p = 1 %


@pytest.mark.slow
@pytest.mark.parametrize("exponent", [0.0, 0.1, 0.2, 0.3])
def test_pulls_of_nearly_white_rows_are_one(exponent):
    """40 captures: the root mean square of unit normals is within 0.8 to 1.25 in 95 % of the cases."""
    canon = hsnoise.cameras.canon_5d3(black_level_dn=64).with_value("row_gain", "exponent", exponent)
    stacks = (capture(canon, seed, (0.02, 0.05, 0.1, 0.2), frames=4) for seed in range(40))
    found = [pulls(hsnoise.fit(stack), canon) for stack in stacks]
    for name in ("gain", "row_gain.sigma", "row_gain.exponent"):
        all_colours = [value for f in found for key, value in f.items() if key.startswith(name)]
        assert 0.8 < np.sqrt(np.mean(np.square(all_colours))) < 1.25, (name, exponent)


# A share of white noise


@pytest.fixture(scope="module")
def mixture():
    """A capture of a mixture, and its fit with the share free from elsewhere."""
    model = camera(1.0, 0.3)
    stack = capture(model)
    return model, stack, hsnoise.fit(stack, model=with_share(model, 0.6))


@pytest.fixture(scope="module")
def without(mixture):
    """The fit of that capture without a share."""
    return hsnoise.fit(mixture[1])


@pytest.mark.slow
def test_a_free_white_share_is_found(mixture, without):
    model, _, free = mixture
    assert free.converged and free.notes == ()
    assert max(map(abs, pulls(free, model).values())) < 3
    assert 0.01 < free.table["row_gain.white_share"][1] < 0.1
    assert free.log_likelihood > without.log_likelihood + 20
    assert 0 < float(free.params["row_gain"].white_share) == free.table["row_gain.white_share"][0] < 1
    assert "row_gain.white_share" in str(free)


@pytest.mark.slow
def test_a_share_that_is_not_asked_for_changes_nothing(mixture, without):
    model, stack, _ = mixture
    held = hsnoise.fit(stack, model=with_share(model, 0.0))
    assert held.table == without.table
    assert held.log_likelihood == without.log_likelihood
    assert held.table["row_gain.white_share"] == (0.0, 0.0, "1")


@pytest.mark.slow
def test_the_likelihood_rises_to_the_fitted_share(mixture):
    """Its gradient by the model's own leaves is 0 at the estimate, and is that of finite differences elsewhere."""
    _, _, free = mixture
    rules = plan_rules(free.params, free.summary)

    @jax.jit
    @jax.value_and_grad
    def value_and_slope(share):
        return hsnoise.log_likelihood(with_share(free.params, share), free.summary, rules=rules)

    share, error, _ = free.table["row_gain.white_share"]
    value, slope = value_and_slope(share)
    assert float(value) == pytest.approx(free.log_likelihood, abs=1e-3)
    assert abs(float(slope)) * error < 0.05
    away = share + 2 * error
    difference = (value_and_slope(away + 1e-4)[0] - value_and_slope(away - 1e-4)[0]) / 2e-4
    np.testing.assert_allclose(value_and_slope(away)[1], difference, rtol=1e-3)


@pytest.mark.slow
def test_the_fitted_spectrum_is_plotted_with_its_white_share(mixture):
    _, _, free = mixture
    ends = []
    for result in (free, replace(free, params=with_share(free.params, 0.0))):
        (line,) = [x for x in plots.row_spectrum(result).axes[0].lines if x.get_label() == "row gain alone"]
        ends.append(line.get_ydata()[-1])
    assert ends[0] > free.table["row_gain.white_share"][0] * free.table["row_gain.sigma"][0] ** 2
    assert ends[0] > ends[1]  # a power law alone falls on


@pytest.mark.parametrize(
    ("exponent", "white_share"),
    [(1.0, 0.0), pytest.param(0.0, 0.0, marks=pytest.mark.slow), pytest.param(1.0, 1.0, marks=pytest.mark.slow)],
)
def test_a_free_share_at_its_bounds_has_an_honest_error(exponent, white_share):
    """Rows without any, of an exponent of 0 too, where only the mean of a frame tells, and rows that are all white."""
    model = camera(exponent, white_share)
    result = hsnoise.fit(capture(model), model=with_share(model, 0.5))
    assert result.converged
    value, error, _ = result.table["row_gain.white_share"]
    assert 0 < value < 1
    assert 0.003 < error < 0.2
    assert abs(value - white_share) < 3 * error
    assert all(abs(pull) < 4 for pull in pulls(result, model).values())


@pytest.mark.slow
def test_a_share_of_one_is_a_global_shutter():
    model = with_share(camera(0.7), 1.0)
    stack = capture(model)
    rolling = hsnoise.fit(stack, model=model)
    fixed = hsnoise.fit(capture(model, shutter="global"))
    assert rolling.names == fixed.names
    assert "row_gain.exponent" not in rolling.names
    np.testing.assert_allclose(rolling.log_likelihood, fixed.log_likelihood, atol=0.01)
    for name in rolling.names:
        value, error, _ = fixed.table[name]
        assert abs(rolling.table[name][0] - value) < 0.05 * error
    assert rolling.table["row_gain.white_share"] == (1.0, 0.0, "1")


@pytest.mark.slow
def test_a_large_capture_finds_the_share_by_its_pilot(mixture, monkeypatch):
    from hsnoise.fitting import maximise

    model, stack, free = mixture
    monkeypatch.setattr(maximise, "MANY_ROWS", 500)  # three of the eight frames
    monkeypatch.setattr(maximise, "PILOT_ROWS", 150)  # every second row of them
    thin, thinned = maximise.every_nth_row, []
    monkeypatch.setattr(maximise, "every_nth_row", lambda summary, n: thinned.append(n) or thin(summary, n))
    result = hsnoise.fit(stack, model=with_share(model, 0.5))
    assert thinned == [2]
    for name, (value, error, _) in free.table.items():
        assert abs(result.table[name][0] - value) <= 0.2 * error, name


@pytest.mark.slow
def test_a_free_share_is_fitted_together_with_an_added_effect():
    model = camera(1.0, 0.4)
    truth = model.add(hsnoise.effects.RowNoise(2.0))
    result = hsnoise.fit(capture(truth, frames=16, shape=(128, 96)), model=truth)
    assert {"row_gain.white_share", "row_noise.sigma"} < set(result.names)
    found = pulls(result, truth)
    assert max(abs(found[name]) for name in ("gain", "row_gain.white_share", "row_noise.sigma")) < 4, found


@pytest.mark.slow
@pytest.mark.parametrize("white_share", [0.0, 1.0])
def test_the_likelihood_tells_white_rows_from_flat_ones_of_mean_one(white_share):
    """White rows move the mean of a frame: it would be called frame_offset."""
    result = hsnoise.fit(capture(camera(0.0, white_share)))
    assert result.table["row_gain.white_share"] == (white_share, 0.0, "1")
    assert ("row_gain.exponent" in result.names) == (white_share == 0)
    assert any("rows of a frame" in note or "mean of their frame" in note for note in result.notes)


@pytest.mark.slow
def test_a_share_of_none_that_is_asked_for_stays():
    model = camera(0.0, 1.0)
    result = hsnoise.fit(capture(model, frames=6), model=with_share(model, 0.0))
    assert result.table["row_gain.white_share"] == (0.0, 0.0, "1")
    assert "row_gain.exponent" in result.names


def test_the_line_fit_refuses_a_white_share(mixture):
    model, stack, _ = mixture
    with pytest.raises(ValueError, match=r"method: the line fit has no row_gain.white_share"):
        hsnoise.fit(stack, model=model, method="line")


@pytest.mark.parametrize("white_share", [-0.1, 1.1])
def test_a_share_is_a_share(white_share):
    with pytest.raises(ValueError, match=r"row_gain.white_share: expected finite values in \[0, 1\]"):
        RowGain(0.1, 1.0, white_share)


def test_a_file_older_than_the_white_share_has_none(tmp_path):
    path = tmp_path / "camera.json"
    camera(1.0, 0.25).save(path)
    assert float(hsnoise.NoiseModel.load(path)["row_gain"].white_share) == 0.25
    content = json.loads(path.read_text())
    (row_gain,) = [effect for effect in content["effects"] if effect["name"] == "row_gain"]
    del row_gain["parameters"]["white_share"]
    path.write_text(json.dumps(content))
    assert float(hsnoise.NoiseModel.load(path)["row_gain"].white_share) == 0.0
    del row_gain["parameters"]["exponent"]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"row_gain: expected parameters .* got \['sigma'\]"):
        hsnoise.NoiseModel.load(path)
