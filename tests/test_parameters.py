"""The mapping between the numbers of a model and the vectors that fits move."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx
from hsnoise.effects import EFFECTS
from hsnoise.likelihood.coordinates import coordinates_for
from hsnoise.likelihood.darks import likelihood_part
from hsnoise.likelihood.parameters import IN_LIKELIHOOD, OUTLIERS, numbers_of, parameters_of, within_bounds
from hsnoise.likelihood.summary import summarise

WHOLE = (
    hsnoise.cameras.canon_5d3(black_level_dn=64)
    .add(fx.BlackClamp(np.array([10.0, 20.0, 30.0])))
    .with_value("row_gain", "white_share", 0.3)
)
EXPOSURE_S = (0.02, 0.2)


@pytest.fixture(scope="module")
def coordinates():
    counts = [np.asarray(hsnoise.sample_dark(i, 2, (16, 32), WHOLE, exposure_s=t)) for i, t in enumerate(EXPOSURE_S)]
    summary = summarise(hsnoise.FrameStack(counts, EXPOSURE_S, cfa="RGGB", shutter="rolling"))
    return coordinates_for(summary, WHOLE, np.array([1e-3, 2e-3]))


def test_numbers_are_the_rows_of_the_table():
    assert {n.name: n.value_in(WHOLE) for n in numbers_of(WHOLE)} == {
        name: pytest.approx(row[0]) for name, row in WHOLE.table.items()
    }


def test_every_number_of_an_effect_with_likelihood_is_known_to_it():
    declared = {(effect.name, field) for effect in EFFECTS if effect.in_likelihood for field in effect.specs()}
    assert declared == {place for place in IN_LIKELIHOOD if place[0] != OUTLIERS}


def test_all_numbers_of_the_likelihood_move(coordinates):
    assert set(coordinates.names) == {*WHOLE.table, "outliers.0", "outliers.1"}
    assert coordinates.where("gain").sum() == 3 and coordinates.where("row_gain", "exponent").sum() == 1


def test_a_vector_stands_for_the_values_that_it_was_made_of(coordinates):
    vector = np.asarray(coordinates.start())
    model, outliers = coordinates.at(vector)
    assert jax.tree.structure(model) == jax.tree.structure(coordinates.base)
    for found, expected in zip(jax.tree.leaves(model), jax.tree.leaves(likelihood_part(WHOLE)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9)
    np.testing.assert_allclose(outliers, coordinates.outliers, rtol=1e-9)


def test_slopes_are_those_of_differences(coordinates):
    vector = np.asarray(coordinates.start()) + 0.1
    difference = (coordinates.values(vector + 1e-5) - coordinates.values(vector - 1e-5)) / 2e-5
    np.testing.assert_allclose(coordinates.slope(vector), difference, rtol=1e-6)


def test_each_coordinate_moves_its_own_number(coordinates):
    vector = np.asarray(coordinates.start())
    moved = jax.jacfwd(coordinates.values)(vector)
    np.testing.assert_array_equal(moved, np.diag(np.diagonal(moved)))


@pytest.mark.parametrize("effect", [fx.RowNoise(1.5), fx.HotPixels(0.01, 300.0), fx.Nonlinearity(1e-5)])
def test_what_is_read_from_a_model_can_be_put_back(effect):
    model = WHOLE.add(effect)
    parameters = parameters_of(model, (effect.name,))
    same = parameters.put(model, parameters.read(model))
    for name, (value, _, _) in model.table.items():
        assert same.table[name][0] == pytest.approx(value, rel=1e-6), name
    assert parameters.put(WHOLE, parameters.read(model)) is WHOLE  # which has no such effect


def test_a_search_may_leave_the_bounds_a_model_may_not(coordinates):
    beyond = np.asarray(coordinates.values(coordinates.start())).copy()
    beyond[coordinates.where("black_clamp")] = -1.0
    model, _ = coordinates.with_values(beyond)
    assert (np.asarray(model["black_clamp"].rate) == -1).all()
    assert (np.asarray(within_bounds(model)["black_clamp"].rate) == 0).all()
