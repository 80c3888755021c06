"""Quadrature rules that resolve every row: where the rows of a capture lie in beta, and how sharply."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise import rows
from hsnoise._types import is_traced
from hsnoise.moments import binned_moments, start_physics
from hsnoise.physics import Block, Physics, RowRule, Rules, binning, dark_laws, log_probability
from hsnoise.statistics import RowHistograms, Summary, round_up, without_counts

SCAN_NODES = 256
KEEP_NATS = 25.0  # a node where every row of a group is this far below its best is left out
MARGIN = 1.35  # in beta on either side, so that the parameters may move during a fit
EXTREME_ROWS = 6
NODES_PER_SIGMA = 0.75  # of the sharpest row; the trapezoid's error is exp(-2 (0.75 pi)^2) (Poisson summation)
MOST_NODES = 1024
GROUP_ROWS, MOST_GROUPS, SPLIT_FROM = 192, 24, 8


def plan_rules(physics: Physics, summary: Summary, margin: float = MARGIN, channel: int | None = None) -> Rules:
    """Quadrature rules for the rows at `physics` (at the moment estimates while `physics` is traced).

    margin: in beta, on either side of where the rows are now. channel: of that channel only.
    """
    if not summary.histograms:
        return ()
    if any(map(is_traced, jax.tree.leaves(physics))):
        physics = start_physics(summary, with_row_gain=physics.row_sigma is not None)
    channels = range(len(summary.histograms)) if channel is None else [channel]
    alike = [
        [c for c in channels if summary.histograms[c].row_stride == stride]
        for stride in sorted({summary.histograms[c].row_stride for c in channels})
    ]
    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        physics = jax.tree.map(lambda x: np.asarray(x, np.float64), physics)
        return tuple(_rule(physics, chosen, summary, margin) for chosen in alike)


def _rule(physics: Physics, chosen: list[int], summary: Summary, margin: float) -> RowRule:
    """The rule of the channels `chosen`, which use the same share of the sensor rows."""
    stride = summary.histograms[chosen[0]].row_stride
    exposures = len(summary.exposure_s)
    channel, exposure = np.repeat(chosen, exposures), np.tile(np.arange(exposures), len(chosen))
    if physics.row_sigma is None:
        pooled = [summary.histograms[c].counts.sum((1, 2), dtype=np.float64) for c in chosen]
        ones = np.ones((len(channel), 1))
        block = Block(np.concatenate(pooled)[:, None, None, :], ones, ones, 1)
        return RowRule(channel, exposure, (block,), None, ones[:, 0], stride)
    channels = [_channel_blocks(physics, c, summary, margin) for c in chosen]
    layouts, scales, blocks = zip(*channels, strict=True)
    join = partial(jax.tree.map, lambda *x: np.concatenate(x))
    nodes = [max(b.nodes for b in same) for same in zip(*blocks, strict=True)]
    joined = [
        join(*(replace(b, nodes=n) for b in same)) for same, n in zip(zip(*blocks, strict=True), nodes, strict=True)
    ]
    return RowRule(channel, exposure, tuple(joined), join(*layouts), np.concatenate(scales), stride)


def _channel_blocks(physics: Physics, c: int, summary: Summary, margin: float):
    """Layout, scale and blocks of one channel in all exposures."""
    histograms, sigma = summary.histograms[c], float(physics.row_sigma[c])
    electrons = physics.dark_current * summary.exposure_s + physics.read_noise**2
    # Rounding to whole counts hides gains below this one: the rows' resolution stops being proportional to beta.
    scale = np.clip(1 / (float(physics.gain[c]) * np.sqrt(12 * electrons)), 1e-3, 1.0)
    beta, table, information = (np.asarray(x) for x in _scan(physics, c, without_counts(summary), scale))
    layout, counts = _sort_rows(histograms)
    low, high, peak = _reach(table, beta, counts)
    # Rows of almost only one count are skewed, not narrow: they do not set the resolution.
    seen = (beta[:, 1:] >= np.maximum(low[:, :1], 3 * scale[:, None])) & (beta[:, 1:] <= high[:, -1:])
    best = np.where(seen, information, 0).max(1) * histograms.row_pixels.max((1, 2))
    # The prior is part of what the nodes must resolve: its width in u where the rows are densest.
    width = np.minimum(1 / np.sqrt(best + 1e-12), sigma / np.sqrt(scale**2 + 1))[:, None]
    top, bottom = 1 + rows.PRIOR_REACH * sigma, max(1 - rows.PRIOR_REACH * sigma, 0.0)
    low, high = low / margin, high * margin
    if summary.shutter == "rolling":
        # The gains of coloured rows have a mean of 1: where that of the rows' best is another, all are pulled there.
        pull = 1 - peak.mean(1, keepdims=True)
        low, high = low + np.minimum(pull, 0), high + np.maximum(pull, 0)
    low, high = np.clip(low, bottom, top), np.clip(high, bottom, top)
    span = np.arcsinh(high / scale[:, None]) - np.arcsinh(low / scale[:, None])
    wanted = (NODES_PER_SIGMA * span / width).max(0) + 16
    # The group of the darkest rows reaches far down and needs many nodes, the others few.
    cuts = [slice(0, 1), slice(1, None)] if len(wanted) > SPLIT_FROM else [slice(None)]
    blocks = [
        Block(counts[:, cut], low[:, cut], high[:, cut], min(round_up(int(wanted[cut].max())), MOST_NODES))
        for cut in cuts
    ]
    return layout, scale, tuple(blocks)


def _sort_rows(histograms: RowHistograms) -> tuple[rows.Layout, np.ndarray]:
    """Rows of each exposure in groups of similar mean, and their histograms in that order."""
    exposures, frames, n, bins = histograms.counts.shape
    total = frames * n
    groups = int(np.clip(total // GROUP_ROWS, 1, MOST_GROUPS))
    places = -(-total // groups)
    pixels, mean, _ = binned_moments(histograms)
    rank = np.where(pixels > 0, mean, np.inf).reshape(exposures, total)  # rows that are not there come last
    order = np.full((exposures, groups * places), total)
    order[:, :total] = np.argsort(rank, axis=1, kind="stable")
    place = np.argsort(order[:, :total], axis=1).reshape(exposures, frames, n)
    counts = np.zeros((exposures, groups * places, bins), histograms.counts.dtype)
    for e in range(exposures):
        counts[e, :total] = histograms.counts[e].reshape(total, bins)[order[e, :total]]
    counts = counts.reshape(exposures, groups, places, bins)
    return rows.Layout(order, place, counts.any(-1).reshape(exposures, -1)), counts


@jax.jit
def _scan(physics: Physics, c: int, summary: Summary, scale):
    """On a wide grid of beta [exposure, node]: log P [exposure, node, bin], information of a pixel on asinh(beta)."""
    sigma = physics.row_sigma[c]
    top = (1 + rows.PRIOR_REACH * sigma)[None]

    def exposure(inputs):
        at, scale = inputs
        beta = rows.make_nodes(0 * top, top, scale, sigma, SCAN_NODES).beta[0]
        table = log_probability(physics, at, beta)
        slope = jnp.diff(table, axis=0) / jnp.diff(jnp.arcsinh(beta / scale))[:, None]
        return beta, table, (jnp.exp(table[1:]) * slope**2).sum(-1)

    index = jnp.arange(len(scale))
    at = binning(summary, dark_laws(physics, summary.exposure_s), jnp.full(len(scale), c), index)
    return jax.lax.map(exposure, (at, jnp.asarray(scale)))


def _reach(table: np.ndarray, beta: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range of beta where the most extreme rows of a group keep any likelihood, and its best: [exposure, group]."""
    ends = np.zeros((*counts.shape[:2], 4 * EXTREME_ROWS, counts.shape[-1]), counts.dtype)
    for at in np.ndindex(counts.shape[:2]):
        extreme = _extreme_rows(counts[at])
        ends[at][: len(extreme)] = extreme
    # In JAX: NumPy's threads get into each other's way where captures are planned side by side.
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
