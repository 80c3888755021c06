"""Integrating the row gain out: white rows by quadrature, coloured rows by expectation consistency.

A row's pixels depend on its gain beta only through the curve log L(beta), given on the nodes of a `Nodes` rule.
White rows are independent: one integral each. Coloured rows share a circulant Gaussian prior: the expectation
consistent approximation (Opper and Winther, "Expectation consistent approximate inference", JMLR 2005) with one
precision for all rows of a frame. It is exact for white rows, exact in the mean for Gaussian curves, costs one FFT a
step, and is stationary at its fixed point, so that its gradient needs no derivative of the iteration.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import log_ndtr, logsumexp

ITERATIONS = 80
WHOLE_STEPS = 20  # later ones are shortened, against going round in circles
TOLERANCE = 1e-4  # the evidence is stationary at the fixed point: its error is the square of this, a row
MIXED, NEAR = 2, 1.0  # steps that the next one is mixed from, and the change below which they may be
RIDGE = 1e-6
FAILED = 0.5  # a frame that still changes by more, in deviations of a row, has no evidence: NaN
FARTHEST, FARTHEST_SIGMA = 0.1, 2.0  # that a row's gain moves in one step: so far and so many of its own deviations
PRIOR_REACH = 7.5  # standard deviations of the row gain that the nodes cover


class Nodes(eqx.Module):
    """Quadrature rules in beta = scale * sinh(u), u uniform: as fine as a row can resolve, at every gain.

    Rows are sorted into groups of similar gain, and each group has its own rule: `beta` and `log_weight` have shape
    [group, node]. A group's first node also carries all that lies below it, where the curves are constant
    (beta <= 0) or negligible.
    """

    beta: jax.Array
    log_weight: jax.Array


class Layout(eqx.Module):
    """Where the rows of an exposure's frames stand in their groups (with a leading axis for exposures in a rule).

    order [place]: index into frame * row, or frames * rows for an empty place; place [frame, row]: index into the
    places of all groups; filled [place]: a row with pixels.
    """

    order: jax.Array
    place: jax.Array
    filled: jax.Array

    def grouped(self, x):
        """[frame, row] -> [place], 1 in empty places."""
        return jnp.concatenate([x.ravel(), jnp.ones(1, x.dtype)])[self.order]

    def framed(self, x):
        """[place] -> [frame, row]."""
        return x[self.place]


def make_nodes(low, high, scale, sigma, count: int) -> Nodes:
    """`count` nodes on [low, high] [group], cut to what a prior Normal(1, sigma^2) reaches; scale is one number."""
    low = jnp.maximum(jnp.maximum(low, 1 - PRIOR_REACH * sigma), 0.0)
    high = jnp.maximum(jnp.minimum(high, 1 + PRIOR_REACH * sigma), low * (1 + 1e-9) + 1e-9)
    start, stop = jnp.arcsinh(low / scale), jnp.arcsinh(high / scale)
    step = (stop - start) / (count - 1)
    u = start[:, None] + step[:, None] * jnp.arange(count)[None, :]
    # Gregory's end correction: the integrand does not vanish at beta = 0.
    ends = jnp.array([3 / 8, 7 / 6, 23 / 24])
    weight = jnp.ones(count).at[:3].set(ends).at[-3:].set(ends[::-1])
    log_weight = jnp.log(weight)[None, :] + jnp.log(step * scale)[:, None] + jnp.log(jnp.cosh(u))
    return jax.lax.stop_gradient(Nodes(scale * jnp.sinh(u), log_weight))


def _tail(nodes: Nodes, mean, variance):
    """Log mass, mean and second moment about `mean` of Normal(mean, variance) below the first node."""
    spread = jnp.sqrt(variance)
    z = (nodes.beta[:, :1] - mean) / spread
    log_mass = log_ndtr(z)
    hazard = jnp.exp(-0.5 * z * z - log_mass) / jnp.sqrt(2 * jnp.pi)
    return log_mass, -spread * hazard, variance * (1 - z * hazard)


def _log_weights(curves, nodes: Nodes, mean, variance):
    """Log of curve x Normal(mean, variance) x weight at each node: [group, row, node]."""
    distance = nodes.beta[:, None, :] - mean[..., None]
    prior = -0.5 * distance**2 / variance[..., None] - 0.5 * jnp.log(2 * jnp.pi * variance)[..., None]
    return curves + prior + nodes.log_weight[:, None, :]


def log_evidence(curves, nodes: Nodes, mean, variance):
    """log of the integral of exp(curve) Normal(beta; mean, variance) for each row [group, row].

    curves [group, row, node]; mean and variance broadcastable to [group, row].
    """
    mean = jnp.broadcast_to(mean, curves.shape[:-1])
    variance = jnp.broadcast_to(variance, curves.shape[:-1])
    log_mass, _, _ = _tail(nodes, mean, variance)
    body = logsumexp(_log_weights(curves, nodes, mean, variance), axis=-1)
    return jnp.logaddexp(body, curves[..., 0] + log_mass)


def _posterior(curves, nodes: Nodes, mean, variance):
    """Mean and variance of beta for each row under Normal(mean, variance) x exp(curve)."""
    log_mass, tail_mean, tail_square = _tail(nodes, mean, variance)
    logs = _log_weights(curves, nodes, mean, variance)
    tail = curves[..., 0] + log_mass
    top = jnp.maximum(logs.max(-1), tail)
    w = jnp.exp(logs - top[..., None])
    w_tail = jnp.exp(tail - top)
    # Moments about the middle of the nodes, near which all rows of a group lie; one product reads the weights once.
    middle = nodes.beta.mean(-1, keepdims=True)
    offset = nodes.beta - middle
    powers = jnp.stack([jnp.ones_like(offset), offset, offset**2], axis=-1)
    sums = jnp.einsum("grn,gnk->grk", w, powers)
    shift = mean - middle
    total = sums[..., 0] + w_tail
    first = (sums[..., 1] + w_tail * (tail_mean + shift)) / total
    second = (sums[..., 2] + w_tail * (tail_square + 2 * shift * tail_mean + shift**2)) / total
    return middle + first, second - first**2


class Curves(eqx.Module):
    """The rows of one exposure and channel: curves [group, row, node] on nodes, in blocks of groups, and their layout.

    Blocks differ in their number of nodes: few rows lie far out and need many.
    """

    blocks: tuple[tuple[jax.Array, Nodes], ...]
    layout: Layout

    def each(self, function, mean, variance):
        """`function(curves, nodes, mean, variance)` of all rows, from and to [place]."""
        out, at = [], 0
        for curves, nodes in self.blocks:
            groups, places, _ = curves.shape
            part = [x[at : at + groups * places].reshape(groups, places) for x in (mean, variance)]
            out.append(jax.tree.map(jnp.ravel, function(curves, nodes, *part)))
            at += groups * places
        return jax.tree.map(lambda *parts: jnp.concatenate(parts), *out)

    def log_evidence(self, mean, variance):
        """Log evidence of each place under its own Normal(mean, variance) [place]; 0 where it is empty."""
        return jnp.where(self.layout.filled, self.each(log_evidence, mean, variance), 0.0)

    def posterior(self, mean, variance):
        """Mean and variance of beta at each place [place]; those of the prior where it is empty."""
        m, v = self.each(_posterior, mean, variance)
        return jnp.where(self.layout.filled, m, mean), jnp.where(self.layout.filled, v, variance)

    def in_float32(self) -> Curves:
        """The same up to a constant for each row, which a posterior does not depend on."""
        blocks = [(curves - curves.max(-1, keepdims=True), nodes) for curves, nodes in self.blocks]
        return Curves(jax.tree.map(lambda x: x.astype(jnp.float32), tuple(blocks)), self.layout)


def log_evidence_white(rows: Curves, variance):
    """Log evidence of independent rows, beta ~ Normal(1, variance): exact up to quadrature."""
    ones = jnp.ones(rows.layout.filled.shape, jnp.result_type(variance))
    return rows.log_evidence(ones, variance * ones).sum()


def row_spectrum(exponent, sensor_rows: int, stride: int, dtype):
    """Eigenvalues of the correlation of a coloured row gain, for a colour that uses every `stride`-th sensor row.

    Power k^-exponent at |frequency| k = 1 .. rows/2, none at k = 0, unit variance; every second row of a circulant
    process is circulant again with its spectrum folded.
    """
    k = jnp.abs(jnp.fft.fftfreq(sensor_rows, 1 / sensor_rows)).astype(dtype)
    power = jnp.where(k == 0, 0.0, jnp.exp(-exponent * jnp.log(jnp.maximum(k, 1.0))))
    power = power * (sensor_rows / power.sum())
    return power.reshape(stride, sensor_rows // stride).mean(0)


def log_evidence_coloured(rows: Curves, spectrum):
    """Expectation-consistent log evidence of all rows, beta ~ Normal(1, circulant with eigenvalues `spectrum` [row]).

    Returns [frame]; NaN where no fixed point is found, for rows that contradict the prior beyond measure.
    """
    fixed = jax.lax.stop_gradient
    layout, spectrum = rows.layout, spectrum[None, :]
    change, site, cavity = _consistent(fixed(rows), fixed(spectrum))
    (a, precision), (mean, variance) = fixed(site), fixed(cavity)
    gain = spectrum / (1 + precision[:, None] * spectrum)
    field = jnp.fft.fft(a - precision[:, None], axis=-1, norm="ortho")
    log_prior = (
        a.sum(-1)
        - 0.5 * precision * a.shape[-1]
        - 0.5 * jnp.log1p(precision[:, None] * spectrum).sum(-1)
        + 0.5 * (jnp.abs(field) ** 2 * gain).sum(-1)
    )
    wide = jnp.broadcast_to(variance[:, None], mean.shape)
    evidence = layout.framed(rows.log_evidence(layout.grouped(mean), layout.grouped(wide)))
    log_rows = evidence + 0.5 * jnp.log(2 * jnp.pi * wide) + 0.5 * mean**2 / wide
    both = 1 / (precision + 1 / variance)
    log_both = 0.5 * jnp.log(2 * jnp.pi * both)[:, None] + 0.5 * both[:, None] * (a + mean / wide) ** 2
    return jnp.where(change < FAILED, log_prior + log_rows.sum(-1) - log_both.sum(-1), jnp.nan)


def _consistent(rows: Curves, spectrum):
    """Fixed point: last change, sites (a, precision) of the rows, cavity Normal(mean, variance) that each row sees.

    a and mean are [frame, row], change, precision and variance [frame]; spectrum [1, row].
    """
    ones = jnp.ones(rows.layout.place.shape, spectrum.dtype)
    start = (ones, ones[:, 0]), (ones, jnp.broadcast_to(spectrum.mean(), ones[:, 0].shape))
    far = jnp.full_like(ones[:, 0], jnp.inf)

    def iterate(rows: Curves, spectrum, start, change):
        def step(state):
            count, change, _, _, (mean, variance), before = state
            # The longer it takes, the shorter the steps.
            found = _step(rows, spectrum, mean, variance, jnp.minimum(1.0, WHOLE_STEPS / (count + 1)))
            ahead, before = _ahead((mean, variance), found[2], found[0], change, before)
            return count + 1, *found, ahead, before

        def going(state):
            return (state[0] < ITERATIONS) & (state[1].max() > TOLERANCE)

        mean, variance = start[1]
        nothing = jnp.zeros((MIXED, len(mean), mean.shape[1] + 1), mean.dtype)
        history = nothing, nothing, jnp.full((MIXED, len(mean)), jnp.inf, mean.dtype)
        return jax.lax.while_loop(going, step, (0, change, *start, start[1], history))[1:4]

    # In float32, several times as fast; where that fails, float64 goes all of the way.
    narrow = partial(jax.tree.map, lambda x: x.astype(jnp.float32))
    near = iterate(rows.in_float32(), narrow(spectrum), narrow(start), narrow(far))
    sound = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(near)]).all()
    change, *state = jax.tree.map(lambda x, y: jnp.where(sound, x.astype(y.dtype), y), near, (far, *start))
    return iterate(rows, spectrum, tuple(state), change)


def _ahead(at, cavity, change, change_before, before):
    """Where the next step begins, and what later steps need to know of this one.

    Anderson's mixing (J. ACM 12, 1965) of the last steps: the combination of them that leaves least to go, in half as
    many steps. Frames that are far from the end, or came no nearer, just go on from their cavity.
    """
    (mean, variance), deviation = cavity, jnp.sqrt(cavity[1])[:, None]
    told = jnp.concatenate([mean, jnp.log(variance)[:, None]], axis=1)
    off_variance = jnp.log(variance / at[1])[:, None] * jnp.sqrt(mean.shape[1])
    off = jnp.concatenate([(mean - at[0]) / deviation, off_variance], axis=1)
    told_before, off_before, changes = before
    useful = (changes < NEAR) & (change < change_before)[None, :]
    d_told, d_off = (
        jnp.where(useful[..., None], now[None] - then, 0.0) for now, then in ((told, told_before), (off, off_before))
    )
    square = jnp.einsum("ifn,jfn->fij", d_off, d_off)
    ridge = RIDGE * jnp.trace(square, axis1=1, axis2=2) + jnp.finfo(mean.dtype).tiny
    along = jnp.einsum("ifn,fn->fi", d_off, off)
    share = jnp.linalg.solve(square + ridge[:, None, None] * jnp.eye(MIXED, dtype=mean.dtype)[None], along[..., None])
    ahead = told - jnp.einsum("fi,ifn->fn", share[..., 0], d_told)
    history = zip((told, off, change), before, strict=True)
    return (ahead[:, :-1], jnp.exp(ahead[:, -1])), tuple(jnp.concatenate([new[None], old[:-1]]) for new, old in history)


def _step(rows: Curves, spectrum, mean, variance, most):
    """One step towards the fixed point from a cavity, `most` of the way: (largest change [frame], site, cavity)."""
    layout = rows.layout
    wide = jnp.broadcast_to(variance[:, None], mean.shape)
    dtype = rows.blocks[0][0].dtype
    posterior = rows.posterior(layout.grouped(mean).astype(dtype), layout.grouped(wide).astype(dtype))
    m, v = (layout.framed(x).astype(mean.dtype) for x in posterior)
    spread = v.mean(-1)
    precision = jnp.maximum(1 / spread - 1 / variance, 1e-12)
    a = m / spread[:, None] - mean / wide
    gain = spectrum / (1 + precision[:, None] * spectrum)
    x = jnp.fft.ifft(gain * jnp.fft.fft(a - precision[:, None], axis=-1), axis=-1).real
    both = gain.mean(-1)
    # Cavities in natural parameters. Where rows and prior disagree, curves are not Gaussian over the whole way between:
    # no row moves further at once than a Gaussian stands for it.
    share = (1 / both - precision) - 1 / variance
    pull = ((1 + x) / both[:, None] - a) - mean / wide
    far = jnp.abs(pull - share[:, None] * m) * v / (FARTHEST + FARTHEST_SIGMA * jnp.sqrt(v))
    part = most / jnp.maximum(far.max(-1), 1.0)
    new_variance = 1 / (1 / variance + part * share)
    new_mean = new_variance[:, None] * (mean / wide + part[:, None] * pull)
    change = jnp.maximum(
        jnp.abs(jnp.log(new_variance / variance)),
        (jnp.abs(new_mean - mean) / jnp.sqrt(new_variance)[:, None]).max(-1),
    )
    return change, (a, precision), (new_mean, new_variance)
