"""The score: gradient of the likelihood at fixed parameters, of many captures that are much alike.

It carries what the likelihood knows of the parameters, so captures are compared by it (Gallant and Tauchen, Econometric
Theory 12, 1996). At fixed parameters, tables of log P and their derivatives are the same for all captures: they are
made once, for the bins and the quadrature of one of them. Rows of another capture that lie outside of these make the
score somewhat less informative; it remains one and the same function of the counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.compiling import jit_lean
from hsnoise.likelihood.coordinates import Coordinates
from hsnoise.likelihood.darks import RowRule, Tables, binning, dark_laws, evidence, nodes_of, tables_of
from hsnoise.likelihood.gradients import likelihood_at
from hsnoise.likelihood.plan import plan_rules, with_rows_of
from hsnoise.likelihood.rows import Layout, Nodes
from hsnoise.likelihood.summary import Summary, without_counts

MARGIN = 1.35  # in beta, beyond the rows of the one capture
MOST_SLOPES = 1 << 26  # numbers of derivatives that are kept; where there are more, they are made anew each time


@dataclass(frozen=True)
class _Kept:
    """What the score of a rule's rows is made of, but for the rows. All arrays have a leading axis for the parts.

    rule: of the capture that the score was made for. slopes: derivatives of the tables, with an axis for coordinates
    before all; None where there are too many.
    """

    rule: RowRule
    nodes: tuple[Nodes, ...]
    tables: Tables
    slopes: Tables | None


@dataclass(frozen=True)
class Score:
    """Gradient of the likelihood at the vector `centre` of `coordinates`; summary: of the first capture, no counts."""

    coordinates: Coordinates
    centre: jax.Array
    summary: Summary
    kept: tuple[_Kept, ...]

    @staticmethod
    def of(coordinates: Coordinates, centre: np.ndarray, summary: Summary) -> Score:
        """For captures like the one that is summarised."""
        light = without_counts(summary)
        with jax.enable_x64(True):
            at = jnp.asarray(centre)
            rules = plan_rules(coordinates.at(at)[0], summary, MARGIN)
            return Score(coordinates, at, light, tuple(_kept(coordinates, at, light, rule) for rule in rules))

    def __call__(self, summary: Summary) -> np.ndarray:
        """Of a capture in the bins of the first [coordinate]."""
        total = np.zeros(len(self.centre))
        with jax.enable_x64(True):
            for kept in self.kept:
                rule = with_rows_of(kept.rule, summary)
                rows = [block.counts for block in rule.blocks], rule.layout
                of_tables = _of_tables(kept.nodes, kept.tables, *rows)
                total += np.asarray(self._through(kept, of_tables))
            if summary.flats is not None:
                lit = replace(summary, histograms=())
                total += np.asarray(likelihood_at(self.coordinates, self.centre, lit, ())[1])
        return total

    def _through(self, kept: _Kept, of_tables: Tables) -> jax.Array:
        """The gradient over the coordinates from that over the tables."""
        if kept.slopes is None:
            return _pulled(self.coordinates, self.centre, self.summary, kept.rule, kept.nodes, of_tables)
        return _summed(kept.slopes, of_tables)


def _kept(coordinates: Coordinates, at: jax.Array, summary: Summary, rule: RowRule) -> _Kept:
    rule = _without_rows(rule)
    nodes = _nodes(coordinates, at, rule)
    tables, along = _tables_along(coordinates, at, summary, rule, nodes, jnp.eye(len(at))[0])
    if len(at) * sum(x.size for x in jax.tree.leaves(tables)) > MOST_SLOPES:
        return _Kept(rule, nodes, tables, None)
    others = [_tables_along(coordinates, at, summary, rule, nodes, one)[1] for one in jnp.eye(len(at))[1:]]
    return _Kept(rule, nodes, tables, jax.tree.map(lambda *x: jnp.stack(x), along, *others))


def _without_rows(rule: RowRule) -> RowRule:
    return replace(rule, blocks=tuple(replace(block, counts=None) for block in rule.blocks))


@jit_lean
def _nodes(coordinates, at, rule):
    model, _ = coordinates.at(at)
    inputs = jax.tree.map(jnp.asarray, (rule.channel, rule.blocks, rule.scale))
    return jax.lax.map(lambda part: nodes_of(model, *part), inputs)


def _tables(coordinates, at, summary: Summary, rule: RowRule, nodes) -> Tables:
    """Those of all parts of a rule at a vector of coordinates."""
    model, outliers = coordinates.at(at)
    laws = dark_laws(jax.lax.stop_gradient(model), summary.exposure_s)
    parts = binning(summary, laws, rule.channel, rule.exposure, rule.edges_dn, rule.outlier_law)
    return jax.lax.map(
        lambda part: tables_of(model, outliers, part[0], part[1], summary, rule.row_stride), (parts, nodes)
    )


@jit_lean
def _tables_along(coordinates, at, summary, rule, nodes, direction):
    """Tables, and their derivative in a direction, in float32: of sums over rows whose noise is far above rounding."""
    tables, along = jax.jvp(lambda x: _tables(coordinates, x, summary, rule, nodes), (at,), (direction,))
    return tables, jax.tree.map(lambda x: x.astype(jnp.float32), along)


@jit_lean
def _pulled(coordinates, at, summary, rule, nodes, of_tables):
    _, pull = jax.vjp(lambda x: _tables(coordinates, x, summary, rule, nodes), at)
    return pull(of_tables)[0]


@jit_lean
def _summed(slopes, of_tables):
    def one(slope, of):
        return jnp.tensordot(slope, of.astype(jnp.float32), of.ndim).astype(of.dtype)

    return sum(jax.tree.leaves(jax.tree.map(one, slopes, of_tables)))


@jit_lean
def _of_tables(nodes, tables, counts: list[np.ndarray], layout: Layout | None) -> Tables:
    """Gradient of the likelihood of all parts over their tables."""

    def part(inputs):
        nodes, tables, counts, layout = inputs
        return jax.grad(evidence)(tables, nodes, counts, layout)

    return jax.lax.map(part, jax.tree.map(jnp.asarray, (nodes, tables, counts, layout)))
