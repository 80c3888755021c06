"""Integrating the row gain out: white rows by quadrature, coloured rows by expectation consistency.

A row's pixels depend on its gain beta only through the curve log L(beta), given on the nodes of a `Nodes` rule.
White rows are independent: one integral each. Coloured rows share a circulant Gaussian prior: they use the expectation
consistent approximation (Opper and Winther, "Expectation consistent approximate inference", JMLR 2005) with one
precision for all rows of a frame. It is exact for white rows, exact in the mean for Gaussian curves, costs one FFT a
step, and is stationary at its fixed point, so that its gradient needs no derivative of the iteration.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import log_ndtr, logsumexp

from hsnoise._core.coloured import row_gain_power

ITERATIONS = 80
WHOLE_STEPS = 20  # later ones are shortened, to prevent cycles
# Steps converge quadratically: after one of this length, in deviations of a row, a hundredth of it remains. The
# evidence is stationary at the fixed point, so its error per row is the square of the remainder.
TOLERANCE = 2e-3
GAUSSIAN_STEPS, GAUSSIAN_TOLERANCE = 12, 2e-4  # with Gaussians for the rows' curves, between two evaluations
FAILED = 0.5  # a frame that still changes by more, in deviations of a row, has no evidence: NaN
LEAST_SHARE, LEAST_PRECISION = 1e-9, 0.2  # of a cavity's variance, and of a row's precision, in steps of Gaussians
FARTHEST, FARTHEST_SIGMA = 0.1, 2.0  # limits of a row's move in one step: in gain, and in its own deviations
PRIOR_REACH = 7.5  # standard deviations of the row gain that the nodes cover


class Nodes(eqx.Module):
    """Quadrature rules in beta = scale * sinh(u), u uniform: as fine as a row can resolve, at every gain.

    Rows are sorted into groups of similar gain, and each group has its own rule: `beta` and `log_weight` have shape
    [group, node]. If `open_below`, a group's first node also carries all mass below it, where its curves are taken
    as constant (they are for beta <= 0); otherwise they have vanished there.
    """

    beta: jax.Array
    log_weight: jax.Array
    open_below: bool = eqx.field(static=True, default=True)

    def in_units(self, unit) -> Nodes:
        """The same in (beta - 1) / unit."""
        return Nodes((self.beta - 1) / unit, self.log_weight - jnp.log(unit), self.open_below)


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


def make_nodes(low, high, scale, sigma, count: int, open_below: bool = True) -> Nodes:
    """`count` nodes on [low, high] [group], cut to the reach of a prior Normal(1, sigma^2); scale is a scalar."""
    low = jnp.maximum(jnp.maximum(low, 1 - PRIOR_REACH * sigma), 0.0)
    high = jnp.maximum(jnp.minimum(high, 1 + PRIOR_REACH * sigma), low * (1 + 1e-9) + 1e-9)
    start, stop = jnp.arcsinh(low / scale), jnp.arcsinh(high / scale)
    step = (stop - start) / (count - 1)
    u = start[:, None] + step[:, None] * jnp.arange(count)[None, :]
    # Gregory's end correction: the integrand does not vanish at beta = 0.
    ends = jnp.array([3 / 8, 7 / 6, 23 / 24])
    weight = jnp.ones(count).at[:3].set(ends).at[-3:].set(ends[::-1])
    log_weight = jnp.log(weight)[None, :] + jnp.log(step * scale)[:, None] + jnp.log(jnp.cosh(u))
    return jax.lax.stop_gradient(Nodes(scale * jnp.sinh(u), log_weight, open_below))


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


@jax.custom_jvp
def _log_sum_exp(logs):
    """Over the nodes. The weights of its derivative are in float32: each is a share of one of many rows."""
    return logsumexp(logs, axis=-1)


@_log_sum_exp.defjvp
def _log_sum_exp_jvp(primals, tangents):
    (logs,), (change,) = primals, tangents
    total = _log_sum_exp(logs)
    share = jnp.exp((logs - total[..., None]).astype(jnp.float32))
    return total, (share.astype(logs.dtype) * change).sum(-1)


def log_evidence(curves, nodes: Nodes, mean, variance):
    """log of the integral of exp(curve) Normal(beta; mean, variance) for each row [group, row].

    curves [group, row, node]; mean and variance broadcastable to [group, row].
    """
    mean = jnp.broadcast_to(mean, curves.shape[:-1])
    variance = jnp.broadcast_to(variance, curves.shape[:-1])
    body = _log_sum_exp(_log_weights(curves, nodes, mean, variance))
    return jnp.logaddexp(body, curves[..., 0] + _tail(nodes, mean, variance)[0]) if nodes.open_below else body


def _posterior(curves, nodes: Nodes, mean, variance):
    """Mean and variance of beta for each row under Normal(mean, variance) x exp(curve)."""
    logs = _log_weights(curves, nodes, mean, variance)
    top = logs.max(-1)
    if nodes.open_below:
        log_mass, tail_mean, tail_square = _tail(nodes, mean, variance)
        tail = curves[..., 0] + log_mass
        top = jnp.maximum(top, tail)
    w = jnp.exp(logs - top[..., None])
    # Moments about the middle of the nodes, near which all rows of a group lie; one product reads the weights once.
    middle = nodes.beta.mean(-1, keepdims=True)
    offset = nodes.beta - middle
    powers = jnp.stack([jnp.ones_like(offset), offset, offset**2], axis=-1)
    total, first, second = jnp.moveaxis(jnp.einsum("grn,gnk->grk", w, powers), -1, 0)
    if nodes.open_below:
        w_tail, shift = jnp.exp(tail - top), mean - middle
        total += w_tail
        first += w_tail * (tail_mean + shift)
        second += w_tail * (tail_square + 2 * shift * tail_mean + shift**2)
    first = first / total
    return middle + first, second / total - first**2


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

    def in_float32(self, unit) -> Curves:
        """Rows in (beta - 1) / unit, up to a constant for each row, which cancels in its posterior."""
        blocks = [(curves - curves.max(-1, keepdims=True), nodes.in_units(unit)) for curves, nodes in self.blocks]
        return Curves(jax.tree.map(lambda x: x.astype(jnp.float32), tuple(blocks)), self.layout)


def log_evidence_white(rows: Curves, variance):
    """Log evidence of independent rows, beta ~ Normal(1, variance): exact up to quadrature."""
    ones = jnp.ones(rows.layout.filled.shape, jnp.result_type(variance))
    return rows.log_evidence(ones, variance * ones).sum()


def row_spectrum(exponent, sensor_rows: int, stride: int, white_share=None):
    """Eigenvalues of the correlation of a row gain, for a colour that uses every `stride`-th sensor row.

    They are the spectrum that `row_gain` is drawn with, of unit variance; every second row of a circulant process is
    circulant again with its spectrum folded.
    """
    power = row_gain_power(sensor_rows, exponent, white_share)
    return power.reshape(stride, sensor_rows // stride).mean(0)


def log_evidence_coloured(rows: Curves, spectrum):
    """Expectation-consistent log evidence of all rows, beta ~ Normal(1, circulant with eigenvalues `spectrum` [row]).

    Returns [frame]; NaN where no fixed point is found, because rows contradict the prior too strongly.
    """
    fixed = jax.lax.stop_gradient
    unit = fixed(jnp.sqrt(spectrum.mean()))  # from here on, beta - 1 is in deviations of the prior
    layout, spectrum = rows.layout, spectrum / unit**2
    found = _consistent(fixed(rows).in_float32(unit), fixed(spectrum).astype(jnp.float32), FARTHEST / unit)
    change, (a, precision), (mean, variance) = jax.tree.map(lambda x: x.astype(spectrum.dtype), found)
    wide = jnp.broadcast_to(variance[:, None], mean.shape)
    gain = spectrum[None, :] / (1 + precision[:, None] * spectrum[None, :])
    field = jnp.fft.fft(a, axis=-1, norm="ortho")
    log_prior = 0.5 * (jnp.abs(field) ** 2 * gain - jnp.log1p(precision[:, None] * spectrum[None, :])).sum(-1)
    evidence = layout.framed(rows.log_evidence(layout.grouped(1 + unit * mean), layout.grouped(unit**2 * wide)))
    log_rows = evidence + 0.5 * jnp.log(2 * jnp.pi * wide) + 0.5 * mean**2 / wide
    both = 1 / (precision + 1 / variance)
    log_both = 0.5 * jnp.log(2 * jnp.pi * both)[:, None] + 0.5 * both[:, None] * (a + mean / wide) ** 2
    return jnp.where(change < FAILED, log_prior + log_rows.sum(-1) - log_both.sum(-1), jnp.nan)


def _consistent(rows: Curves, spectrum, farthest):
    """Fixed point: last change, sites (a, precision) of the rows, cavity Normal(mean, variance) that each row sees.

    a and mean are [frame, row], change, precision and variance [frame]; spectrum [row]. In float32, as `rows` are.
    """
    farthest = farthest.astype(spectrum.dtype)
    zeros = jnp.zeros(rows.layout.place.shape, spectrum.dtype)
    ones = jnp.ones_like(zeros[:, 0])

    def step(state):
        count, _, _, cavity = state
        # The longer it takes, the shorter the steps.
        return count + 1, *_step(rows, spectrum, cavity, jnp.minimum(1.0, WHOLE_STEPS / (count + 1)), farthest)

    def going(state):
        return (state[0] < ITERATIONS) & (state[1].max() > TOLERANCE)

    start = 0, jnp.inf * ones, (zeros, ones), (zeros, spectrum.mean() * ones)
    return jax.lax.while_loop(going, step, start)[1:]


def _step(rows: Curves, spectrum, cavity, most, farthest):
    """One step towards the fixed point from a cavity, `most` of the way: (largest change [frame], site, cavity).

    Near the cavity a row's curve acts like the Gaussian that gives the same posterior. The step leads to the fixed
    point of these Gaussians, which is found without evaluating the curves.
    """
    layout, (mean, variance) = rows.layout, cavity
    wide = jnp.broadcast_to(variance[:, None], mean.shape)
    m, v = (layout.framed(x) for x in rows.posterior(layout.grouped(mean), layout.grouped(wide)))
    v = jnp.maximum(v, LEAST_SHARE * wide)
    precision, pull = 1 / v - 1 / wide, m / v - mean / wide

    def of_gaussians(cavity):
        mean, variance = cavity
        both = jnp.maximum(precision + 1 / variance[:, None], LEAST_PRECISION / v)
        return (pull + mean / variance[:, None]) / both, 1 / both

    def gaussian_step(state):
        count, _, cavity, posterior = state
        ahead = _cavity(_site(posterior, cavity), spectrum)
        return count + 1, _change(cavity, ahead, v).max(), ahead, of_gaussians(ahead)

    def going(state):
        return (state[0] < GAUSSIAN_STEPS) & (state[1] > GAUSSIAN_TOLERANCE)

    ahead = jax.lax.while_loop(going, gaussian_step, (0, jnp.inf * v[0, 0], cavity, (m, v)))[2]
    # If rows and prior disagree, curves are not Gaussian all the way between them: no row moves farther at once than
    # its Gaussian is valid. Steps are in the natural parameters of the cavities.
    share = 1 / ahead[1] - 1 / variance
    to_go = ahead[0] / ahead[1][:, None] - mean / wide
    far = jnp.abs(to_go - share[:, None] * m) * v / (farthest + FARTHEST_SIGMA * jnp.sqrt(v))
    part = most / jnp.maximum(far.max(-1), 1.0)
    new_variance = 1 / (1 / variance + part * share)
    new = new_variance[:, None] * (mean / wide + part[:, None] * to_go), new_variance
    return _change(cavity, new, v), _site(of_gaussians(new), new), new


def _change(cavity, ahead, v):
    """The largest change of a row [frame], in deviations of its posterior, which moves by its cavity's share in it."""
    (mean, variance), (new_mean, new_variance) = cavity, ahead
    moved = (jnp.abs(new_mean - mean) / jnp.sqrt(new_variance)[:, None]).max(-1)
    share = jnp.sqrt(jnp.minimum(v.mean(-1) / new_variance, 1.0))
    return share * jnp.maximum(jnp.abs(jnp.log(new_variance / variance)), moved)


def _site(posterior, cavity):
    """What the rows add to their cavities: (a, precision) of exp(a x - precision x^2 / 2), one precision per frame."""
    (m, v), (mean, variance) = posterior, cavity
    spread = v.mean(-1)
    precision = jnp.maximum(1 / spread - 1 / variance, 1e-12)
    return m / spread[:, None] - mean / variance[:, None], precision


def _cavity(site, spectrum):
    """What a row's neighbours and the prior say about it, Normal(mean, variance), given the sites of all rows."""
    a, precision = site
    gain = spectrum[None, :] / (1 + precision[:, None] * spectrum[None, :])
    half = gain[:, : gain.shape[1] // 2 + 1]
    x = jnp.fft.irfft(half * jnp.fft.rfft(a, axis=-1), n=a.shape[1], axis=-1)
    both = gain.mean(-1)
    variance = 1 / (1 / both - precision)
    return variance[:, None] * (x / both[:, None] - a), variance
