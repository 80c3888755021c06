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
LEAST_ROW_SIGMA = 1e-6  # the integral over the gains of rows that have none


class Physics(eqx.Module):
    """Parameters of the paper's model: gain [channel] DN/e-, dark current e-/s, read noise e-, row gain, black DN.

    outliers [exposure]: fraction of pixels that follow no such law (hot pixels, cosmic hits) and may hold any count;
    None for none. It keeps them from bending the estimates of all the others.
    black_clamp [channel]: DN that the camera subtracts for each second of exposure; None for none.
    white_share: white part of the variance of a rolling shutter's row gain; None for none.
    """

    gain: jax.Array
    dark_current: jax.Array
    read_noise: jax.Array
    row_sigma: jax.Array | None
    exponent: jax.Array
    black_level: jax.Array
    outliers: jax.Array | None = None
    black_clamp: jax.Array | None = None
    white_share: jax.Array | None = None


class Block(eqx.Module):
    """Groups of rows that share a number of nodes: counts [part, group, row, bin], beta in low..high [part, group].

    open_below: whether the nodes of a group begin where the prior ends, or at zero, before its rows' curves vanish.
    """

    counts: np.ndarray
    low: np.ndarray
    high: np.ndarray
    nodes: int = eqx.field(static=True)
    open_below: bool = eqx.field(static=True)


class RowRule(eqx.Module):
    """Rows sorted into groups of similar gain, and the quadrature that resolves them, for channels of one row_stride.

    A part is one channel in one exposure, told by `channel` and `exposure` [part]; scale [part] spaces the nodes.
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
WITH_LIKELIHOOD = ("shot_noise", "dark_current", "read_noise", "row_gain", "gain", "black_level", "adc", "black_clamp")


def physics_of(model: NoiseModel) -> Physics:
    """The base parameters of a model in float64. Raises ValueError for effects without a likelihood."""
    extra = [effect.name for effect in model.effects if effect.name not in WITH_LIKELIHOOD]
    if extra:
        raise ValueError(f"log_likelihood: effects {extra} do not state how they change the likelihood")
    n = len(model.channels)

    def f64(x):
        return jnp.asarray(x, jnp.float64)

    row_gain = model["row_gain"] if "row_gain" in model else None
    return Physics(
        gain=f64(model["gain"].value),
        dark_current=f64(model["dark_current"].rate) if "dark_current" in model else f64(0.0),
        read_noise=f64(model["read_noise"].sigma),
        row_sigma=None if row_gain is None else jnp.maximum(f64(row_gain.sigma), LEAST_ROW_SIGMA),
        exponent=f64(0.0) if row_gain is None else f64(row_gain.exponent),
        black_level=f64(model["black_level"].value) if "black_level" in model else jnp.zeros(n, jnp.float64),
        black_clamp=f64(model["black_clamp"].rate) if "black_clamp" in model else None,
        white_share=None if row_gain is None else f64(row_gain.white_share),
    )


def evaluate(physics: Physics, summary: Summary, rules: Rules) -> jax.Array:
    """Log-likelihood in float64 (enabled by the caller)."""
    total = jnp.zeros((), jnp.float64)
    if summary.histograms:
        laws = dark_laws(jax.lax.stop_gradient(physics), summary.exposure_s)
        for rule in rules:
            total += rows_log_likelihood(physics, rule, laws, summary)
    if summary.flats is not None:
        total += flat_log_likelihood(flat_law(physics, summary.flats), summary.flats)
    return total


def dark_laws(physics: Physics, exposure_s):
    """Law of the electrons of each exposure: shared by all channels, gains and black levels."""
    mean_e = physics.dark_current * jnp.asarray(exposure_s)
    return jax.vmap(poisson_normal_law, (0, None))(mean_e, physics.read_noise)


def rows_log_likelihood(physics: Physics, rule: RowRule, laws, summary: Summary) -> jax.Array:
    """Log-likelihood of the rows of a rule's channels in all exposures."""

    def part(physics, inputs):
        at, blocks, layout, scale = inputs
        if physics.row_sigma is None:
            return (blocks[0].counts[0, 0] * log_probability(physics, at, jnp.ones(1))[0]).sum()
        sigma = physics.row_sigma[at.channel]
        curves = []
        for block in blocks:
            nodes = rows.make_nodes(block.low, block.high, scale, sigma, block.nodes, block.open_below)
            table = log_probability(physics, at, nodes.beta.ravel()).reshape(*nodes.beta.shape, -1)
            curves.append((_curves(block.counts, table), nodes))
        of_rows = rows.Curves(tuple(curves), layout)
        if summary.shutter == "global":
            return rows.log_evidence_white(of_rows, sigma**2)
        spectrum = rows.row_spectrum(physics.exponent, summary.shape[0], rule.row_stride, physics.white_share)
        return rows.log_evidence_coloured(of_rows, sigma**2 * spectrum).sum()

    at = binning(summary, laws, rule.channel, rule.exposure, rule.edges_dn, rule.outlier_law)
    return _sum_with_gradient(part, physics, jax.tree.map(jnp.asarray, (at, rule.blocks, rule.layout, rule.scale)))


@jax.custom_vjp
def _curves(counts, table):
    """Log-likelihood of each row at the nodes of its group [group, row, node].

    Group by group, so that the counts as floats stay in the cache: a quarter of the time of all at once. The way back
    is in float32, which counts fit into: a sum of shares of pixels, of which the noise is far above its rounding.
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
    """What the probabilities of a part's bins stand on: channel, exposure, seconds, law of the electrons, edges."""

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


def _sum_with_gradient(function, physics: Physics, inputs):
    """Sum of function(physics, inputs[i]) over the parts i, one at a time.

    Its gradient is made together with its value, part by part, so that memory and compilation are those of one part.
    The price: only first derivatives, in reverse mode (those of coloured rows would be wrong beyond).
    """

    @jax.custom_vjp
    def total(physics, inputs):
        return jax.lax.map(lambda x: function(physics, x), inputs).sum()

    def forward(physics, inputs):
        values, gradients = jax.lax.map(lambda x: jax.value_and_grad(function)(physics, x), inputs)
        return values.sum(), jax.tree.map(lambda g: g.sum(0), gradients)

    def backward(gradient, cotangent):
        return jax.tree.map(lambda g: cotangent * g, gradient), None

    total.defvjp(forward, backward)
    return total(physics, inputs)


def log_probability(physics: Physics, at: Binning, beta):
    """log P(bin | beta) of one part: [node, bin] for beta [node]."""
    scale = physics.gain[at.channel] * jnp.maximum(beta, 1e-6)
    black = black_level_at(physics, at.exposure_s)[at.channel]
    edges_e = (at.edges_dn - black)[None, :] / scale[:, None]
    mean_e = physics.dark_current * at.exposure_s
    table = jnp.log(bin_probability(*distribution(0, edges_e, mean_e, physics.read_noise, at.law)) + FLOOR)
    if physics.outliers is None:
        return table
    share = physics.outliers[at.exposure]
    return jnp.logaddexp(table + jnp.log1p(-share), jnp.log(share * at.outlier_law + FLOOR)[None, :])


def black_level_at(physics: Physics, exposure_s):
    """Where counts without electrons lie, DN: [channel] at a scalar exposure_s, [level, channel] at [level]."""
    clamp = 0.0 * physics.gain if physics.black_clamp is None else physics.black_clamp
    if jnp.ndim(exposure_s) == 0:
        return physics.black_level - clamp * exposure_s
    return physics.black_level[None, :] - clamp[None, :] * exposure_s[:, None]


def flat_law(physics: Physics, flats: FlatMoments) -> FlatLaw:
    """What the moments of flats stand on."""
    return FlatLaw(
        gain=physics.gain,
        black_dn=black_level_at(physics, flats.exposure_s),
        dark_e=physics.dark_current * jnp.asarray(flats.exposure_s),
        read_noise_e=physics.read_noise,
        row_variance=0.0 * physics.gain if physics.row_sigma is None else physics.row_sigma**2,
    )


def flat_gain_of(physics: Physics, flats: FlatMoments) -> FlatGain:
    """Gain of the flats alone, above black and noise of the darks where they were measured, else of `physics`."""
    with jax.enable_x64(True):
        law = flat_law(jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), physics), flats)
        black_dn, variance_dn2 = (np.asarray(x) for x in without_light(law, flats))
    return flat_gain(flats, black_dn, variance_dn2, np.nan_to_num(flats.dark_error_dn2))
