"""The likelihood at a vector of coordinates: model, quadrature rules, value and gradient."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax

from hsnoise._core.compiling import jit_lean
from hsnoise.likelihood.coordinates import Coordinates
from hsnoise.likelihood.darks import Rules, evaluate
from hsnoise.likelihood.plan import plan_rules
from hsnoise.likelihood.summary import Summary


@eqx.filter_jit
def parameters_at(coordinates, vector):
    """(Model, outliers), values, their slopes over the coordinates, log prior."""
    values = coordinates.values(vector)
    return coordinates.with_values(values), values, coordinates.slope(vector), coordinates.log_prior(vector)


def rules_at(coordinates: Coordinates, vector, summary: Summary, **keywords) -> Rules:
    """`plan_rules` for what a vector stands for."""
    model, outliers = parameters_at(coordinates, vector)[0]
    return plan_rules(model, summary, outliers=outliers, **keywords)


@eqx.filter_jit
def prior_at(coordinates, vector):
    return jax.value_and_grad(coordinates.log_prior)(vector)


def gradient_at(coordinates, vector, summary, rules):
    """Log-likelihood plus prior, and its gradient.

    Each rule has a program of its own: compiling one for all takes 200 MiB more.
    """
    dark = replace(summary, flats=None)
    parts = [prior_at(coordinates, vector), *(likelihood_at(coordinates, vector, dark, (rule,)) for rule in rules)]
    if summary.flats is not None:
        parts.append(likelihood_at(coordinates, vector, replace(summary, histograms=()), ()))
    return tuple(map(sum, zip(*parts, strict=True)))


@jit_lean
def likelihood_at(coordinates, vector, summary, rules):
    """Log-likelihood and its gradient."""

    def value(at):
        model, outliers = coordinates.at(at)
        return evaluate(model, summary, rules, outliers)

    return jax.value_and_grad(value)(vector)
