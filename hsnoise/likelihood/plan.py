"""Quadrature rules that resolve every row: where the rows of a capture lie in beta, and how sharply."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.types import is_traced
from hsnoise.likelihood import rows
from hsnoise.likelihood.darks import (
    Block,
    RowRule,
    Rules,
    binning,
    dark_current,
    dark_laws,
    likelihood_part,
    log_probability,
    row_sigma,
)
from hsnoise.likelihood.moments import binned_moments, start_model
from hsnoise.likelihood.summary import RowHistograms, Summary, round_up, without_counts
from hsnoise.model import NoiseModel

SCAN_NODES = 256
KEEP_NATS = 25.0  # a node where every row of a group is this far below its best is left out
# Factors in beta on either side: so that parameters can move during a fit, and where they are almost known.
MARGIN, CLOSE_MARGIN = 1.35, 1.05
EXTREME_ROWS = 6
NODES_PER_SIGMA = 0.75  # of the sharpest row; the trapezoid's error is exp(-2 (0.75 pi)^2) (Poisson summation)
MOST_NODES = 1024
# Extra nodes: if the integrand ends at a gain of zero, or rows are few; and if there are enough to average out errors.
SPARE, SPARE_OF_MANY = 16, 4
GROUP_ROWS, MOST_GROUPS, SPLIT_FROM = 192, 24, 8

_At = tuple[NoiseModel, jax.Array | None]  # a model and its shares of outliers


def plan_rules(
    model: NoiseModel, summary: Summary, margin: float = MARGIN, channel: int | None = None, outliers=None
) -> Rules:
    """Quadrature rules for the rows at `model` (at the moment estimates while `model` is traced).

    margin: in beta, on either side of where the rows are now (at least MARGIN while `model` is traced). channel: plan
        this channel only. outliers: as in `evaluate`.
    """
    if not summary.histograms:
        return ()
    if any(map(is_traced, jax.tree.leaves(model))):
        model, margin = start_model(summary, with_row_gain="row_gain" in model), max(margin, MARGIN)
    channels = range(len(summary.histograms)) if channel is None else [channel]
    alike = [
        [c for c in channels if summary.histograms[c].row_stride == stride]
        for stride in sorted({summary.histograms[c].row_stride for c in channels})
    ]
    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        at = jax.tree.map(np.asarray, (likelihood_part(model), outliers))
        return tuple(_rule(at, chosen, summary, margin) for chosen in alike)


def _rule(at: _At, chosen: list[int], summary: Summary, margin: float) -> RowRule:
    """The rule of the channels `chosen`, which use the same share of the sensor rows."""
    stride = summary.histograms[chosen[0]].row_stride
    exposures = len(summary.exposure_s)
    channel, exposure = np.repeat(chosen, exposures), np.tile(np.arange(exposures), len(chosen))
    histograms = _used_bins([summary.histograms[c] for c in chosen])
    edges, outliers = (np.concatenate([getattr(h, name) for h in histograms]) for name in ("edges_dn", "outlier_law"))
    if "row_gain" not in at[0]:
        pooled = [h.counts.sum((1, 2), dtype=np.float64) for h in histograms]
        ones = np.ones((len(channel), 1))
        block = Block(np.concatenate(pooled)[:, None, None, :], ones, ones, nodes=1, open_below=False)
        return RowRule(channel, exposure, edges, outliers, (block,), None, ones[:, 0], stride)
    channels = [_channel_blocks(at, c, h, summary, margin) for c, h in zip(chosen, histograms, strict=True)]
    layouts, scales, blocks = zip(*channels, strict=True)
    join = partial(jax.tree.map, lambda *x: np.concatenate(x))
    joined = [join(*(like(b, same) for b in same)) for same in zip(*blocks, strict=True)]
    return RowRule(channel, exposure, edges, outliers, tuple(joined), join(*layouts), np.concatenate(scales), stride)


def like(block: Block, others: Sequence[Block]) -> Block:
    """A block with at least as many nodes as the `others`, so that they share a program."""
    blocks = block, *others
    return replace(block, nodes=max(b.nodes for b in blocks), open_below=any(b.open_below for b in blocks))


def replan(old: Rules, new: Rules) -> Rules:
    """New rules with the old numbers of nodes and bins if these suffice, which saves a compilation."""

    def enough(old, new):
        new = _with_bins(new, old.outlier_law.shape[-1])
        pairs = zip(old.blocks, new.blocks, strict=True)
        return replace(new, blocks=tuple(like(n, [o]) for o, n in pairs))

    return tuple(enough(o, n) for o, n in zip(old, new, strict=True))


def with_rows_of(rule: RowRule, summary: Summary) -> RowRule:
    """The same bins and nodes with the rows of another capture, which is summarised in the same bins."""
    channels, exposures = list(dict.fromkeys(rule.channel)), len(summary.exposure_s)
    edges = rule.edges_dn.reshape(len(channels), exposures, -1)
    histograms = [_in_bins(summary.histograms[c], e) for c, e in zip(channels, edges, strict=True)]
    if rule.layout is None:
        pooled = np.concatenate([h.counts.sum((1, 2), dtype=np.float64) for h in histograms])
        return replace(rule, blocks=(replace(rule.blocks[0], counts=pooled[:, None, None, :]),))
    layouts, counts = zip(*map(_sort_rows, histograms), strict=True)
    ends = np.cumsum([block.low.shape[1] for block in rule.blocks])
    parts = np.split(np.concatenate(counts), ends[:-1], axis=1)  # a block's groups follow those of the previous one
    blocks = tuple(replace(block, counts=of_block) for block, of_block in zip(rule.blocks, parts, strict=True))
    return replace(rule, blocks=blocks, layout=jax.tree.map(lambda *x: np.concatenate(x), *layouts))


def _in_bins(h: RowHistograms, edges: np.ndarray) -> RowHistograms:
    """Histograms with these edges [exposure, bin - 1], a subset of their own; repeated edges leave bins empty."""
    counts = np.zeros((*h.counts.shape[:-1], edges.shape[-1] + 1), h.counts.dtype)
    for e, (own, wanted) in enumerate(zip(h.edges_dn, edges, strict=True)):
        starts = np.r_[0, np.searchsorted(own, np.unique(wanted)) + 1]
        merged = np.add.reduceat(h.counts[e], starts, axis=-1, dtype=h.counts.dtype)
        counts[e, ..., : len(starts) - 1], counts[e, ..., -1] = merged[..., :-1], merged[..., -1]
    return replace(h, counts=counts, edges_dn=edges)


def _with_bins(rule: RowRule, bins: int) -> RowRule:
    """The rule with at least this many bins: new ones are empty, have no width, and come before the last."""
    further = bins - rule.outlier_law.shape[-1]
    if further <= 0:
        return rule

    def padded(x):
        return np.insert(x, [x.shape[-1] - 1] * further, 0, axis=-1)

    edges = np.pad(rule.edges_dn, [(0, 0), (0, further)], mode="edge")
    blocks = tuple(replace(b, counts=padded(b.counts)) for b in rule.blocks)
    return replace(rule, edges_dn=edges, outlier_law=padded(rule.outlier_law), blocks=blocks)


def _used_bins(histograms: list[RowHistograms]) -> list[RowHistograms]:
    """The same without bins that no row uses, about half of them: each run of unused bins becomes one."""
    used = [h.counts.any((1, 2)) for h in histograms]
    kept = [u[:, :-1] | u[:, 1:] for u in used]  # edges beside a bin that is used
    for k in kept:
        k[:, 0] |= ~k.any(1)  # an exposure with fewer frames than others has none left
    size = round_up(max(int(k.sum(1).max()) for k in kept) + 1, steps=2 if _has_many_rows(histograms[0]) else 1)
    if size >= used[0].shape[1]:
        return histograms
    return [_merged(h, u, k, size) for h, u, k in zip(histograms, used, kept, strict=True)]


def _has_many_rows(h: RowHistograms) -> bool:
    """Whether evaluating costs more than compiling. If not, sizes are coarse, so that captures share programs."""
    return h.counts[0, ..., 0].size >= GROUP_ROWS * SPLIT_FROM


def _merged(h: RowHistograms, used: np.ndarray, kept: np.ndarray, size: int) -> RowHistograms:
    """Histograms with only the edges `kept` [exposure, bin - 1], and empty bins of no width before the last."""
    counts = np.zeros((*h.counts.shape[:-1], size), h.counts.dtype)
    edges, outliers = np.empty((len(used), size - 1)), np.zeros((len(used), size))
    for e, keep in enumerate(kept):
        place = np.concatenate([[0], np.cumsum(keep)])
        place[place == place[-1]] = size - 1
        counts[e][..., place[used[e]]] = h.counts[e][..., used[e]]
        edges[e] = np.pad(h.edges_dn[e, keep], (0, size - 1 - keep.sum()), mode="edge")
        np.add.at(outliers[e], place, h.outlier_law[e])
    return replace(h, counts=counts, edges_dn=edges, outlier_law=outliers)


def _channel_blocks(at: _At, c: int, histograms: RowHistograms, summary: Summary, margin: float):
    """Layout, scale and blocks of one channel in all exposures."""
    model, _ = at
    sigma = float(row_sigma(model)[c])
    electrons = dark_current(model) * summary.exposure_s + model["read_noise"].sigma ** 2
    # Rounding to whole counts hides gains below this one: the rows' resolution stops being proportional to beta.
    scale = np.clip(1 / (float(model["gain"].value[c]) * np.sqrt(12 * electrons)), 1e-3, 1.0)
    bins = histograms.edges_dn, histograms.outlier_law
    beta, table, information = (np.asarray(x) for x in _scan(at, c, without_counts(summary), *bins, scale))
    layout, counts = _sort_rows(histograms)
    low, high, peak = _reach(table, beta, counts)
    # Rows that hold almost a single count are skewed, not narrow: they do not set the resolution.
    seen = (beta[:, 1:] >= np.maximum(low[:, :1], 3 * scale[:, None])) & (beta[:, 1:] <= high[:, -1:])
    best = np.where(seen, information, 0).max(1) * histograms.row_pixels.max((1, 2))
    # The nodes must resolve the prior as well: its width in u where the rows are densest.
    width = np.minimum(1 / np.sqrt(best + 1e-12), sigma / np.sqrt(scale**2 + 1))[:, None]
    top, bottom = 1 + rows.PRIOR_REACH * sigma, max(1 - rows.PRIOR_REACH * sigma, 0.0)
    low, high = low / margin, high * margin
    if summary.shutter == "rolling":
        # The gains of coloured rows have a mean of 1: if that of the rows' best gains is not 1, all are shifted.
        pull = 1 - peak.mean(1, keepdims=True)
        low, high = low + np.minimum(pull, 0), high + np.maximum(pull, 0)
    low, high = np.clip(low, bottom, top), np.clip(high, bottom, top)
    span = np.arcsinh(high / scale[:, None]) - np.arcsinh(low / scale[:, None])
    many = _has_many_rows(histograms)
    open_below = (low <= bottom).any(0) | (not many)
    wanted = (NODES_PER_SIGMA * span / width).max(0) + np.where(open_below, SPARE, SPARE_OF_MANY)
    nodes = [min(round_up(int(n), steps=8 if many else 1), MOST_NODES) for n in wanted]
    # The darkest rows reach far and need many nodes, the brightest and those next to the darkest some, the others few.
    cuts = [slice(0, 1), slice(1, 3), slice(3, None)] if many else [slice(None)]
    blocks = [Block(counts[:, c], low[:, c], high[:, c], max(nodes[c]), bool(open_below[c].any())) for c in cuts]
    return layout, scale, tuple(blocks)


def _sort_rows(histograms: RowHistograms) -> tuple[rows.Layout, np.ndarray]:
    """Rows of each exposure in groups of similar mean, and their histograms in that order."""
    exposures, frames, n, bins = histograms.counts.shape
    total = frames * n
    groups = int(np.clip(total // GROUP_ROWS, 1, MOST_GROUPS))
    places = -(-total // groups)
    pixels, mean, _ = binned_moments(histograms)
    rank = np.where(pixels > 0, mean, np.inf).reshape(exposures, total)  # missing rows come last
    order = np.full((exposures, groups * places), total)
    order[:, :total] = np.argsort(rank, axis=1, kind="stable")
    # The darkest, the brightest, then all between: those at the ends need their own rules.
    ends_first = np.r_[0, groups - 1, 1 : groups - 1][:groups]
    order = order.reshape(exposures, groups, places)[:, ends_first].reshape(exposures, -1)
    place = np.argsort(order, axis=1, kind="stable")[:, :total].reshape(exposures, frames, n)
    counts = np.zeros((exposures, groups * places, bins), histograms.counts.dtype)
    for e in range(exposures):
        filled = order[e] < total
        counts[e, filled] = histograms.counts[e].reshape(total, bins)[order[e, filled]]
    counts = counts.reshape(exposures, groups, places, bins)
    return rows.Layout(order, place, counts.any(-1).reshape(exposures, -1)), counts


@jax.jit
def _scan(sensor: _At, c: int, summary: Summary, edges_dn, outlier_law, scale):
    """On a wide grid of beta [exposure, node]: log P [exposure, node, bin], information of a pixel on asinh(beta)."""
    model, outliers = sensor
    sigma = row_sigma(model)[c]
    top = (1 + rows.PRIOR_REACH * sigma)[None]

    def exposure(inputs):
        at, scale = inputs
        beta = rows.make_nodes(0 * top, top, scale, sigma, SCAN_NODES).beta[0]
        table = log_probability(model, outliers, at, beta)
        slope = jnp.diff(table, axis=0) / jnp.diff(jnp.arcsinh(beta / scale))[:, None]
        return beta, table, (jnp.exp(table[1:]) * slope**2).sum(-1)

    index = jnp.arange(len(scale))
    laws = dark_laws(model, summary.exposure_s)
    at = binning(summary, laws, jnp.full(len(scale), c), index, edges_dn, outlier_law)
    return jax.lax.map(exposure, (at, jnp.asarray(scale)))


def _reach(table: np.ndarray, beta: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range of beta where the most extreme rows of a group have any likelihood, and its best beta [exposure, group]."""
    ends = np.zeros((*counts.shape[:2], 4 * EXTREME_ROWS, counts.shape[-1]), counts.dtype)
    for at in np.ndindex(counts.shape[:2]):
        extreme = _extreme_rows(counts[at])
        ends[at][: len(extreme)] = extreme
    # In JAX, because NumPy's threads compete if captures are planned in parallel.
    curves = np.asarray(jnp.einsum("egrb,enb->egrn", ends.astype(np.float64), table))
    whole = np.asarray(jnp.einsum("egb,enb->egn", counts.sum(2, dtype=np.float64), table))
    alive = (curves >= curves.max(-1, keepdims=True) - KEEP_NATS) & ends.any(-1)[..., None]
    alive = alive.any(2)
    alive |= ~alive.any(-1, keepdims=True)  # parameters so far out that no likelihood is finite
    first, last = alive.argmax(-1), alive.shape[-1] - 1 - alive[..., ::-1].argmax(-1)
    places = np.maximum(first - 1, 0), np.minimum(last + 1, alive.shape[-1] - 1), whole.argmax(-1)
    empty = ~counts.any((2, 3))
    low, high, peak = (np.where(empty, 1.0, np.take_along_axis(beta, place, 1)) for place in places)
    return low, high, peak


def _extreme_rows(group: np.ndarray) -> np.ndarray:
    """Histograms [row, bin] of the rows of a group whose counts are lowest, highest, narrowest and widest."""
    group = group[group.any(-1)]
    index = np.arange(group.shape[-1])
    n = group.sum(1, dtype=np.int64)
    mean = group @ index / n
    spread = group @ index**2 / n - mean**2
    most = min(EXTREME_ROWS, len(group))
    orders = [np.argsort(key) for key in (mean, spread)]
    return group[np.unique(np.concatenate([part for order in orders for part in (order[:most], order[-most:])]))]
