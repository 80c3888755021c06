"""The public log-likelihood of a model, on a stack or its summary."""

from __future__ import annotations

import equinox as eqx
import jax

from hsnoise.likelihood.darks import Rules, evaluate, likelihood_part
from hsnoise.likelihood.plan import CLOSE_MARGIN, plan_rules
from hsnoise.likelihood.summary import Summary, summarise, without_counts
from hsnoise.model import NoiseModel

_evaluate = eqx.filter_jit(evaluate)


def log_likelihood(params: NoiseModel, stack, *, rules: Rules | None = None, **keywords) -> jax.Array:
    """Log-likelihood (nats) of dark frames, and of flats if there are any, under `params`.

    params: a NoiseModel; `jax.jit`, `jax.grad` and `jax.vmap` work over its leaves.
    stack: what `summarise` takes, with its keywords, or the `Summary` that it made: make that once for many calls.
    Computed in float64 whatever JAX's global setting. Rows with a coloured gain (shutter "rolling") are integrated by
    the expectation-consistent approximation (rows.py), white rows exactly, all within 7.5 deviations of the row gain
    and, while the model is traced, near the estimates from moments: a model that is thousands of nats from the capture
    is judged too low. NaN where coloured rows contradict a model so far that their gains have no common fixed point
    (a dark current of a tenth or four times the capture's, say). Raises ValueError if the model's
    channels or shutter are not the stack's, or if it holds effects without a likelihood.
    """
    summary = stack if isinstance(stack, Summary) else summarise(stack, **keywords)
    if params.channels != summary.channels:
        raise ValueError(f"params: channels {params.channels}, but the stack has {summary.channels}")
    if params.shutter != summary.shutter:
        raise ValueError(f"params: shutter {params.shutter!r}, but the stack's is {summary.shutter!r}")
    extra = [effect.name for effect in params if not effect.in_likelihood]
    if extra:
        raise ValueError(f"params: effects {extra} do not state how they change the likelihood")
    with jax.enable_x64(True):
        model = likelihood_part(params)
        rules = plan_rules(model, summary, CLOSE_MARGIN) if rules is None else rules
        return _evaluate(model, without_counts(summary), rules)  # the rules hold the counts
