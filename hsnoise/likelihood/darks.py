"""The exact likelihood of dark frames from their row histograms; that of flats is in flat_likelihood.py.

P(y | beta) is a difference of the distribution function of Poisson(lambda) + Normal(0, sigma^2) at the edges of the
count (the first and last bin take the tails); a row's curve over beta is its histogram times log P; rows.py
integrates beta out. The cost after `summarise` does not depend on the number of pixels in a row.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise.likelihood import rows
from hsnoise.likelihood.flat_gain import FlatGain, flat_gain
from hsnoise.likelihood.flat_likelihood import FlatLaw, flat_log_likelihood, without_light
from hsnoise.likelihood.flats import FlatMoments
from hsnoise.likelihood.poisson_normal import bin_probability, distribution, poisson_normal_law
from hsnoise.likelihood.summary import Summary
from hsnoise.model import NoiseModel

# Added to the probability of each bin: bounds the influence of a pixel that the model excludes (a cosmic hit), and
# the gradient far from the optimum. Changes a possible pixel's log-likelihood by less than 1e-6 relative.
FLOOR = 1e-10
LEAST_ROW_SIGMA = 1e-6  # replaces a sigma of 0 in the integral over the row gain; a fit may end at exactly 0


class Block(eqx.Module):
    """Groups of rows that share a number of nodes: counts [part, group, row, bin], beta in low..high [part, group].

    open_below: whether a group's nodes begin at the end of the prior or at zero, where its rows' curves do not vanish.
    """

    counts: np.ndarray
    low: np.ndarray
    high: np.ndarray
    nodes: int = eqx.field(static=True)
    open_below: bool = eqx.field(static=True)


class RowRule(eqx.Module):
    """Rows sorted into groups of similar gain, and the quadrature that resolves them, for channels of one row_stride.

    A part is one channel in one exposure, given by `channel` and `exposure` [part]; scale [part] spaces the nodes.
    edges_dn [part, bin - 1] and outlier_law [part, bin] are those of RowHistograms for the bins of `counts`.
    Without a row gain each part has one row, the sum of all, and there is no layout.
    """

    channel: np.ndarray
    exposure: np.ndarray
    edges_dn: np.ndarray
    outlier_law: np.ndarray
    blocks: tuple[Block, ...]
    layout: rows.Layout | None
    scale: np.ndarray
    row_stride: int = eqx.field(static=True)


Rules = tuple[RowRule, ...]


def likelihood_part(model: NoiseModel) -> NoiseModel:
    """The effects of a model that the likelihood knows, in float64 (enabled here).

    Its own exposure is set to 0: those of the summary count, and captures of different exposures share programs.
    """
    with jax.enable_x64(True):
        known = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), [e for e in model if e.in_likelihood])
        return NoiseModel(known, cfa=model.cfa, shutter=model.shutter, exposure_s=0.0)


def dark_current(model: NoiseModel):
    """Dark current of a model, e-/s; 0 if it has none."""
    return model["dark_current"].rate if "dark_current" in model else 0.0


def row_sigma(model: NoiseModel) -> jax.Array | None:
    """Standard deviation of the row gain [channel], at least LEAST_ROW_SIGMA; None for a model without."""
    return jnp.maximum(model["row_gain"].sigma, LEAST_ROW_SIGMA) if "row_gain" in model else None


def black_level(model: NoiseModel):
    """Black level of a model [channel], DN; 0 if it has none."""
    return model["black_level"].value if "black_level" in model else np.zeros(len(model.channels))


def black_level_at(model: NoiseModel, exposure_s):
    """Where counts without electrons lie, DN: [channel] at a scalar exposure_s, [level, channel] at [level]."""
    black = black_level(model)
    clamp = model["black_clamp"].rate if "black_clamp" in model else 0 * black
    if jnp.ndim(exposure_s) == 0:
        return black - clamp * exposure_s
    return black[None, :] - clamp[None, :] * exposure_s[:, None]


def evaluate(model: NoiseModel, summary: Summary, rules: Rules, outliers: jax.Array | None = None) -> jax.Array:
    """Log-likelihood in float64 (enabled by the caller) of a `likelihood_part`.

    outliers [exposure]: fraction of pixels that do not follow the model (hot pixels, cosmic hits) and may hold any
    count; None for none. It keeps them from biasing the parameters of all the others.
    """
    total = jnp.zeros((), jnp.float64)
    if summary.histograms:
        laws = dark_laws(jax.lax.stop_gradient(model), summary.exposure_s)
        for rule in rules:
            total += rows_log_likelihood(model, outliers, rule, laws, summary)
    if summary.flats is not None:
        total += flat_log_likelihood(flat_law(model, summary.flats), summary.flats)
    return total


def dark_laws(model: NoiseModel, exposure_s):
    """Distribution of the electrons of each exposure: shared by all channels, gains and black levels."""
    mean_e = dark_current(model) * jnp.asarray(exposure_s)
    return jax.vmap(poisson_normal_law, (0, None))(mean_e, model["read_noise"].sigma)


class Tables(NamedTuple):
    """What the likelihood needs for the rows of a part at given parameters.

    log_p: log P(bin | beta) [group, node, bin] of each block. prior: variance of the row gain if rows are white,
    its spectrum [row] if they are coloured, None without row gain.
    """

    log_p: tuple[jax.Array, ...]
    prior: jax.Array | None


def rows_log_likelihood(model: NoiseModel, outliers, rule: RowRule, laws, summary: Summary) -> jax.Array:
    """Log-likelihood of the rows of a rule's channels in all exposures."""

    def part(moved, inputs):
        (model, outliers), (at, blocks, layout, scale) = moved, inputs
        nodes = nodes_of(model, at.channel, blocks, scale)
        tables = tables_of(model, outliers, at, nodes, summary, rule.row_stride)
        return evidence(tables, nodes, [block.counts for block in blocks], layout)

    at = binning(summary, laws, rule.channel, rule.exposure, rule.edges_dn, rule.outlier_law)
    inputs = jax.tree.map(jnp.asarray, (at, rule.blocks, rule.layout, rule.scale))
    return _sum_with_gradient(part, (model, outliers), inputs)


def nodes_of(model: NoiseModel, channel, blocks: tuple[Block, ...], scale) -> tuple[rows.Nodes, ...]:
    """The nodes of each block of a part; a single one without row gain."""
    if "row_gain" not in model:
        return (rows.Nodes(jnp.ones((1, 1)), jnp.zeros((1, 1)), open_below=False),)
    sigma = row_sigma(model)[channel]
    return tuple(rows.make_nodes(b.low, b.high, scale, sigma, b.nodes, b.open_below) for b in blocks)


def tables_of(
    model: NoiseModel, outliers, at: Binning, nodes: tuple[rows.Nodes, ...], summary: Summary, row_stride: int
) -> Tables:
    """The tables of a part at a model and shares of outliers."""
    log_p = tuple(log_probability(model, outliers, at, of.beta.ravel()).reshape(*of.beta.shape, -1) for of in nodes)
    if "row_gain" not in model:
        return Tables(log_p, None)
    row_gain, variance = model["row_gain"], row_sigma(model)[at.channel] ** 2
    if summary.shutter == "global":
        return Tables(log_p, variance)
    spectrum = rows.row_spectrum(row_gain.exponent, summary.shape[0], row_stride, row_gain.white_share)
    return Tables(log_p, variance * spectrum)


def evidence(tables: Tables, nodes: tuple[rows.Nodes, ...], counts, layout: rows.Layout | None) -> jax.Array:
    """Log-likelihood of the rows of a part; counts [group, row, bin] of each block."""
    curves = [_curves(of_rows, log_p) for of_rows, log_p in zip(counts, tables.log_p, strict=True)]
    if tables.prior is None:
        return sum(of.sum() for of in curves)
    of_rows = rows.Curves(tuple(zip(curves, nodes, strict=True)), layout)
    if tables.prior.ndim == 0:
        return rows.log_evidence_white(of_rows, tables.prior)
    return rows.log_evidence_coloured(of_rows, tables.prior).sum()


@jax.custom_vjp
def _curves(counts, table):
    """Log-likelihood of each row at the nodes of its group [group, row, node].

    Group by group, so that the counts as floats stay in the cache: a quarter of the time of all at once. The backward
    pass is in float32, which holds counts exactly: it sums shares of pixels, whose noise is far above the rounding.
    """
    return jax.lax.map(lambda x: x[0].astype(x[1].dtype) @ x[1].T, (counts, table))


def _curves_forward(counts, table):
    return _curves(counts, table), (counts, jnp.zeros((), table.dtype))


def _curves_backward(kept, cotangent):
    counts, like = kept
    slope = jax.lax.map(lambda x: x[1].T @ x[0].astype(jnp.float32), (counts, cotangent.astype(jnp.float32)))
    return None, slope.astype(like.dtype)


_curves.defvjp(_curves_forward, _curves_backward)


class Binning(NamedTuple):
    """What determines a part's bin probabilities: channel, exposure, seconds, electron distribution, edges."""

    channel: jax.Array
    exposure: jax.Array
    exposure_s: jax.Array
    law: tuple
    edges_dn: jax.Array
    outlier_law: jax.Array


def binning(summary: Summary, laws, channel, exposure, edges_dn, outlier_law) -> Binning:
    """The Binning of parts, given by their channels, exposures and bins, with a leading axis for the parts."""
    channel, exposure, edges_dn, outlier_law = map(jnp.asarray, (channel, exposure, edges_dn, outlier_law))
    law = jax.tree.map(lambda x: x[exposure], laws)
    return Binning(channel, exposure, jnp.asarray(summary.exposure_s)[exposure], law, edges_dn, outlier_law)


def _sum_with_gradient(function, moved, inputs):
    """Sum of function(moved, inputs[i]) over the parts i, one at a time.

    The gradient is computed with the value, part by part, so that memory and compilation are those of one part.
    The price: only first derivatives in reverse mode (higher ones of coloured rows would be wrong).
    """

    @jax.custom_vjp
    def total(moved, inputs):
        return jax.lax.map(lambda x: function(moved, x), inputs).sum()

    def forward(moved, inputs):
        values, gradients = jax.lax.map(lambda x: jax.value_and_grad(function)(moved, x), inputs)
        return values.sum(), jax.tree.map(lambda g: g.sum(0), gradients)

    def backward(gradient, cotangent):
        return jax.tree.map(lambda g: cotangent * g, gradient), None

    total.defvjp(forward, backward)
    return total(moved, inputs)


def log_probability(model: NoiseModel, outliers, at: Binning, beta):
    """log P(bin | beta) of one part: [node, bin] for beta [node]; outliers as in `evaluate`."""
    scale = model["gain"].value[at.channel] * jnp.maximum(beta, 1e-6)
    black = black_level_at(model, at.exposure_s)[at.channel]
    edges_e = (at.edges_dn - black)[None, :] / scale[:, None]
    mean_e = dark_current(model) * at.exposure_s
    table = jnp.log(bin_probability(*distribution(0, edges_e, mean_e, model["read_noise"].sigma, at.law)) + FLOOR)
    if outliers is None:
        return table
    share = outliers[at.exposure]
    return jnp.logaddexp(table + jnp.log1p(-share), jnp.log(share * at.outlier_law + FLOOR)[None, :])


def flat_law(model: NoiseModel, flats: FlatMoments) -> FlatLaw:
    """What determines the moments of flats."""
    gain = model["gain"].value
    return FlatLaw(
        gain=gain,
        black_dn=black_level_at(model, flats.exposure_s),
        dark_e=dark_current(model) * jnp.asarray(flats.exposure_s),
        read_noise_e=model["read_noise"].sigma,
        row_variance=row_sigma(model) ** 2 if "row_gain" in model else 0.0 * gain,
    )


def flat_gain_of(model: NoiseModel, flats: FlatMoments) -> FlatGain:
    """Gain from the flats alone, relative to black and noise of the darks if measured, else of `model`."""
    with jax.enable_x64(True):
        black_dn, variance_dn2 = (np.asarray(x) for x in without_light(flat_law(likelihood_part(model), flats), flats))
    return flat_gain(flats, black_dn, variance_dn2, np.nan_to_num(flats.dark_error_dn2))
