"""Clip correction: from the mean and variance of clipped, rounded counts to those before clipping.

The paper corrects its calibration by two 2-D tables made from Poisson + Gaussian samples; here they are computed.
Poisson + Gaussian has three parameters and two moments determine two, so a table holds for one gain, over which the
line fit (`fitting/line.py`) iterates. Means are relative to black.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln, ndtr
from jax.typing import ArrayLike
from jaxtyping import Array

LARGEST_SUM_E, TERMS = 30.0, 92  # sum over photoelectrons: 9 standard deviations above this mean, and some
NARROW_DN, NARROW_TERMS = 0.85, 11  # read noise below which rounding is summed count by count
LEAST_READ_VARIANCE_DN2 = 0.1  # below it, rounding of single electrons' peaks makes the map fold over
NEWTON_STEPS, NEWTON_TOLERANCE = 25, 1e-10
LEAST_VECTOR = 256  # points evaluated at once
CLEAR = 8.0  # standard deviations from the clipping level at which nothing is clipped
LEAST_RATIO = 0.15  # smallest clipped mean above the clipping level in the tables, in standard deviations


class Unclipped(NamedTuple):
    """True mean (DN above black), true variance (DN^2), and whether some distribution has these clipped moments."""

    mean_dn: Array
    variance_dn2: Array
    solved: Array


def clipped_moments(
    mean_dn: ArrayLike,
    variance_dn2: ArrayLike,
    *,
    gain: ArrayLike,
    black_level_dn: ArrayLike = 0.0,
    white_level_dn: float | None = None,
) -> tuple[Array, Array]:
    """Mean (DN above black) and variance (DN^2) of counts clip(round(black + gain * (P + R)), 0, white).

    P is Poisson, R normal, with `mean_dn` = gain E[P] and `variance_dn2` = gain^2 (E[P] + Var[R]); all arguments but
    the white level broadcast. Exact (above 30 e- to the third cumulant of P): given P, the clipped and rounded normal
    has closed moments. Where no such distribution exists, the moments are continued: a mean below black is that of a
    normal; a variance that leaves less than 0.1 DN^2 to read noise is shot noise of a lower gain.
    """
    with jax.enable_x64(True):
        return _pointwise(_moments, (mean_dn, variance_dn2, gain, black_level_dn), white_level_dn)


def unclip(
    mean_dn: ArrayLike,
    variance_dn2: ArrayLike,
    *,
    gain: ArrayLike,
    black_level_dn: ArrayLike = 0.0,
    white_level_dn: float | None = None,
) -> Unclipped:
    """Inverse of `clipped_moments`, by Newton's method; differentiable.

    `solved` is false where no Poisson + normal distribution of this gain has the pair: a mean below that of counts at
    black, or a variance below that of shot noise. Then the continuation of `clipped_moments` is inverted, or, if that
    has no solution either (no whole numbers have the pair), the pair itself is returned.

    Args:
        mean_dn: mean of the clipped counts, DN above black.
        variance_dn2: their variance, DN^2.
        gain: DN/e-.
        black_level_dn: black level, DN above the clipping level.
        white_level_dn: highest count, DN above the clipping level; None: no upper limit.
    """
    with jax.enable_x64(True):
        return Unclipped(*_pointwise(_unclip, (mean_dn, variance_dn2, gain, black_level_dn), white_level_dn)[:3])


def row_moments(
    mean_dn: ArrayLike,
    variance_dn2: ArrayLike,
    row_sigma: ArrayLike,
    *,
    gain: ArrayLike,
    black_level_dn: ArrayLike = 0.0,
    white_level_dn: float | None = None,
) -> tuple[Array, Array, Array]:
    """`clipped_moments` (same arguments) under row gains beta = max(Normal(1, row_sigma^2), 0).

    Returns the mean over rows of their means (DN above black), the mean of their variances (DN^2), and the standard
    deviation of their means divided by `row_sigma` (DN; equal to the mean far from clipping, or if black is 0).
    """
    with jax.enable_x64(True):
        mean, variance, sigma, gain, black = _broadcast(mean_dn, variance_dn2, row_sigma, gain, black_level_dn)
        nodes, weights = (a.reshape((-1,) + (1,) * mean.ndim) for a in np.polynomial.hermite_e.hermegauss(9))
        weights = weights / weights.sum()
        beta = jnp.maximum(1 + sigma[None] * nodes, 1e-3)
        level, spread = clipped_moments(
            beta * mean[None],
            beta**2 * variance[None],
            gain=beta * gain[None],
            black_level_dn=black[None],
            white_level_dn=white_level_dn,
        )
        centre = (weights * level).sum(0)
        deviation = jnp.sqrt((weights * (level - centre[None]) ** 2).sum(0))
        return centre, (weights * spread).sum(0), deviation / sigma


def _broadcast(*arrays):
    return jnp.broadcast_arrays(*(jnp.asarray(x, jnp.float64) for x in arrays))


def _pointwise(function, arguments, white):
    """Apply a function of vectors to arrays; vectors are padded to a power of two to save compilations."""
    arguments = _broadcast(*arguments)
    shape, size = arguments[0].shape, arguments[0].size
    padding = max(1 << (size - 1).bit_length(), LEAST_VECTOR) - size
    out = function(*(jnp.pad(x.ravel(), (0, padding), mode="edge") for x in arguments), white)
    return tuple(x[:size].reshape(shape) for x in out)


def _photoelectrons(mean_e):
    """Numbers of photoelectrons and their probabilities [point, term], and a normal variance to add [point].

    Up to a mean of 30 e- the exact Poisson distribution. Above, a stretched Poisson of mean 30 e- and a normal that
    together have the same mean, variance and third cumulant (kurtosis too large by less than 0.005).
    """
    few = jnp.minimum(mean_e, LARGEST_SUM_E)
    stretch = jnp.cbrt(jnp.maximum(mean_e, LARGEST_SUM_E) / LARGEST_SUM_E)
    k = jnp.arange(TERMS, dtype=mean_e.dtype)[None, :]
    p = jnp.exp(k * jnp.log(few)[:, None] - few[:, None] - gammaln(k + 1))
    electrons = mean_e[:, None] + stretch[:, None] * (k - few[:, None])
    return electrons, p, jnp.maximum(mean_e - stretch**2 * few, 0.0)


def _rectified(mu, s):
    """Mean and mean square of max(round(X), 0), X ~ Normal(mu, s^2), elementwise.

    They are sums over counts j >= 1 of P(X > j - 1/2) and of (2j - 1) P(X > j - 1/2). If s spans counts, the
    Euler-Maclaurin formula of the midpoint rule is used; otherwise the terms that are neither 0 nor 1.
    """

    def wide(mu, s):
        s = jnp.maximum(s, NARROW_DN)
        a = mu / s
        above, density = ndtr(a), jnp.exp(-0.5 * a * a) / jnp.sqrt(2 * jnp.pi) / s
        first = mu * above + s * s * density
        second = (mu * mu + s * s) * above + mu * s * s * density
        first += density * (-1 / 24 + 7 / 5760 * (a * a - 1) / s**2)
        second += above / 12 + 42 / 5760 * density * mu / s**2
        return first, second

    def all_widths(mu, s):
        base = jax.lax.stop_gradient(jnp.maximum(jnp.floor(mu + 0.5) - NARROW_TERMS // 2, 0.0))
        j = base[..., None] + jnp.arange(1, NARROW_TERMS + 1).reshape((1,) * mu.ndim + (-1,))
        above = ndtr((mu[..., None] - j + 0.5) / jnp.minimum(s, NARROW_DN)[..., None])
        narrow = base + above.sum(-1), base * base + ((2 * j - 1) * above).sum(-1)
        return tuple(jnp.where(s < NARROW_DN, n, w) for n, w in zip(narrow, wide(mu, s), strict=True))

    return jax.lax.cond((s < NARROW_DN).any(), all_widths, wide, mu, s)


@jax.jit
def _moments(mean, variance, gain, black, white):
    signal = jnp.maximum(mean, 1e-12)
    least = jnp.minimum(LEAST_READ_VARIANCE_DN2, 0.5 * variance)
    gain = jnp.minimum(gain, (variance - least) / signal)
    k, p, extra = _photoelectrons(signal / gain)
    mu = (black + jnp.minimum(mean, 0.0))[:, None] + gain[:, None] * k
    read = variance - gain * signal + gain**2 * extra
    read = jnp.broadcast_to(jnp.sqrt(read)[:, None], mu.shape)
    first, second = _rectified(mu, read)
    if white is not None:
        over, over_square = _rectified(mu - white, read)
        first, second = first - over, second - over_square - 2 * white * over
    total = (p * first).sum(1)
    return total - black, (p * (second - first**2 + (first - total[:, None]) ** 2)).sum(1)


@jax.jit
def _unclip(mean, variance, gain, black, white):
    """`unclip` of vectors [point]. Unknowns are the mean and the log variance."""

    def residual(x, y, mean, variance, gain, black):
        m, v = _moments(x, jnp.exp(y), gain, black, white)
        return (m - mean) / jnp.sqrt(variance), jnp.log(jnp.maximum(v, 1e-300) / variance)

    def newton(state):
        count, x, y, _, _ = state
        (rx, ry), tangent = jax.linearize(lambda x, y: residual(x, y, *fixed), x, y)
        (ax, ay), (bx, by) = tangent(one, 0 * one), tangent(0 * one, one)
        det = ax * by - bx * ay
        det = jnp.where(jnp.abs(det) < 1e-12, 1e-12, det)
        a, b, c, d = inverse = by / det, -bx / det, -ay / det, ax / det
        reach = 0.7 * jnp.exp(0.5 * y)
        x, y = x - jnp.clip(a * rx + b * ry, -reach, reach), y - jnp.clip(c * rx + d * ry, -0.7, 0.7)
        return count + 1, x, jnp.clip(y, -20.0, 60.0), jnp.maximum(jnp.abs(rx), jnp.abs(ry)), inverse

    def unsettled(state):
        return (state[0] < NEWTON_STEPS) & ~(state[3] < NEWTON_TOLERANCE).all()

    fixed, one = jax.lax.stop_gradient((mean, variance, gain, black)), jnp.ones_like(mean)
    start = (0, *_start(*fixed[:2], fixed[3], white), jnp.inf * one, (one, one, one, one))
    _, x, y, error, (a, b, c, d) = jax.lax.while_loop(unsettled, newton, start)
    # One more step gives the derivatives with respect to the arguments: those of the implicit function.
    rx, ry = residual(x, y, mean, variance, gain, black)
    # Where rounding folds the map, near pure shot noise of about 1 DN, the root on the reversed side is invalid.
    found = (error < 1e-6) & (a * d > b * c)
    true_mean = jnp.where(found, x - a * rx - b * ry, mean)
    true_variance = jnp.where(found, jnp.exp(y - c * rx - d * ry), variance)
    return true_mean, true_variance, found & _is_law(true_mean, true_variance, gain), found


def _start(mean, variance, black, white):
    """Starting point of Newton's method: the true mean and log variance of a clipped normal, to 20 %."""
    spread = jnp.sqrt(variance)
    ratio = (mean + black) / spread
    towards: ArrayLike = -1.0
    if white is not None:
        other = (white - black - mean) / spread
        ratio, towards = jnp.minimum(ratio, other), jnp.where(other < ratio, 1.0, -1.0)
    over = jnp.maximum(ratio, 0.3) - 0.683
    growth = jnp.log(jnp.maximum(1 - 1 / (12 * variance), 0.1)) + 1.07 * jnp.exp(-2.2 * over)
    return mean + towards * 0.683 * spread * jnp.exp(-3.3 * over), jnp.log(variance) + growth


def _is_law(mean, variance, gain):
    """Whether a mean and a variance imply a non-negative Poisson mean and read-noise variance."""
    slack = 1e-9 * jnp.sqrt(variance)
    return (mean >= -slack) & (variance - gain * mean >= -gain * slack)


class ClipTables(eqx.Module):
    """Two tables of clip correction at one gain: (clipped mean, clipped variance) -> (true mean, true variance).

    Nodes are evenly spaced in the log of the clipped variance and in nearness: the log of the distance of the clipped
    mean from the nearer clipping level over CLEAR standard deviations. It is 0 where nothing is clipped, negative near
    black, positive near white. The tables hold corrections, which vanish far from clipping (except for the 1/12 DN^2
    of rounding): (true - clipped mean) / clipped standard deviation, and log(true / clipped variance).

    Attributes:
        log_variance, nearness: nodes [variance], [nearness].
        mean_shift, log_growth: corrections [variance, nearness].
        found: whether a distribution, or the continuation of `clipped_moments`, has the node [variance, nearness].
        gain, black_level_dn, white_level_dn: DN/e-, and DN above the clipping level.
    """

    log_variance: np.ndarray
    nearness: np.ndarray
    mean_shift: np.ndarray
    log_growth: np.ndarray
    found: np.ndarray
    gain: float
    black_level_dn: float
    white_level_dn: float | None

    def __call__(self, mean_dn: ArrayLike, variance_dn2: ArrayLike) -> Unclipped:
        """True moments from clipped ones, by monotone cubic interpolation; arguments broadcast.

        Outside the tables and next to nodes not found, the pair is returned unchanged and `solved` is false. It is also
        false where the interpolated moments belong to no distribution of this gain (see `unclip`).
        """
        mean, variance = jnp.broadcast_arrays(jnp.asarray(mean_dn, float), jnp.asarray(variance_dn2, float))
        x = _position(self.log_variance, jnp.log(variance))
        y = _position(self.nearness, _nearness(mean, variance, self.black_level_dn, self.white_level_dn))
        inside = (x >= 0) & (x <= len(self.log_variance) - 1) & (y >= -1e-9) & (y <= len(self.nearness) - 1 + 1e-9)
        i = jnp.clip(jnp.floor(x), 0, len(self.log_variance) - 2).astype(int)
        j = jnp.clip(jnp.floor(y), 0, len(self.nearness) - 2).astype(int)
        found = jnp.asarray(self.found)
        inside &= found[i, j] & found[i + 1, j] & found[i, j + 1] & found[i + 1, j + 1]
        shift, growth = (
            jnp.where(inside, _interpolate(jnp.asarray(table), i, j, x - i, y - j), 0.0)
            for table in (self.mean_shift, self.log_growth)
        )
        true_mean, true_variance = mean + shift * jnp.sqrt(variance), variance * jnp.exp(growth)
        return Unclipped(true_mean, true_variance, inside & _is_law(true_mean, true_variance, self.gain))


def make_clip_tables(
    gain: float,
    *,
    black_level_dn: float = 0.0,
    white_level_dn: float | None = None,
    variance_dn2: tuple[float, float] = (1.0, 1e4),
    nodes: int = 64,
) -> ClipTables:
    """Compute the tables of one gain.

    Args:
        gain: DN/e-.
        black_level_dn: black level, DN above the clipping level.
        white_level_dn: highest count, DN above the clipping level; None: no upper limit.
        variance_dn2: range of clipped variances, DN^2.
        nodes: number of nodes along the variance, and along the nearness to each clipping level.

    Raises:
        ValueError: a gain or variances that are not positive, a white level not above black, or fewer than
            4 nodes.
    """
    low, high = variance_dn2
    if not 0 < gain < np.inf:
        raise ValueError(f"gain: expected DN/e- above 0, got {gain}")
    if not 0 < low < high < np.inf:
        raise ValueError(f"variance_dn2: expected 0 < lowest < highest, got {variance_dn2}")
    if white_level_dn is not None and not white_level_dn > black_level_dn:
        raise ValueError(f"white_level_dn: expected more than black_level_dn {black_level_dn}, got {white_level_dn}")
    if nodes < 4:
        raise ValueError(f"nodes: expected at least 4, got {nodes}")
    log_variance = np.linspace(np.log(low), np.log(high), nodes)
    side = np.linspace(0.0, np.log(CLEAR / LEAST_RATIO), nodes)
    solve = partial(_columns, np.exp(log_variance), gain, black_level_dn, white_level_dn)
    columns = solve(-side)
    if white_level_dn is None:
        nearness, columns = -side[::-1], [c[:, ::-1] for c in columns]
    else:
        nearness = np.concatenate([-side[::-1], side[1:]])
        columns = [np.hstack([c[:, ::-1], w[:, 1:]]) for c, w in zip(columns, solve(side), strict=True)]
    shift, growth, found = columns
    camera = float(gain), float(black_level_dn), white_level_dn
    return ClipTables(log_variance, nearness, shift, growth, found, *camera)


def _columns(variance, gain, black, white, nearness):
    """Corrections and whether they were found, each [variance, nearness]."""
    blocks = []
    with jax.enable_x64(True):
        # In blocks, because the iteration ends early where nothing is clipped.
        for y in np.array_split(nearness, -(-len(nearness) * len(variance) // LEAST_VECTOR)):
            mean = _mean_at(y[None, :], variance[:, None], black, white)
            m, v, _, found = _pointwise(_unclip, (mean, variance[:, None], gain, black), white)
            blocks.append(((m - mean) / np.sqrt(variance)[:, None], jnp.log(v / variance[:, None]), found))
    return [np.concatenate(b, axis=1) for b in zip(*blocks, strict=True)]


def _clearance(variance, white):
    """Distance from clipping at which nearness is 0, DN: below CLEAR deviations if counts span both ends."""
    clear = CLEAR * variance**0.5
    return clear if white is None else jnp.minimum(clear, white / 2)


def _mean_at(nearness, variance, black, white):
    distance = np.asarray(_clearance(variance, white)) * np.exp(-abs(nearness))
    return distance - black if white is None else np.where(nearness <= 0, distance - black, white - black - distance)


def _nearness(mean, variance, black, white):
    clear = _clearance(variance, white)
    above = jnp.log(jnp.clip((mean + black) / clear, 1e-9, 1.0))
    return above if white is None else above - jnp.log(jnp.clip((white - black - mean) / clear, 1e-9, 1.0))


def _position(nodes, value):
    return (value - nodes[0]) * ((len(nodes) - 1) / (nodes[-1] - nodes[0]))


def _interpolate(table, i, j, s, t):
    """Value at the fractions s, t of the cell [i, j], from the 4 x 4 nodes around it."""
    rows = [jnp.clip(i + d, 0, table.shape[0] - 1) for d in range(-1, 3)]
    columns = [jnp.clip(j + d, 0, table.shape[1] - 1) for d in range(-1, 3)]
    return _monotone_cubic([_monotone_cubic([table[r, c] for c in columns], t) for r in rows], s)


def _monotone_cubic(f, t):
    """Value between f[1] and f[2] of four even nodes, no overshoot (Steffen, Astron. Astrophys. 239, 443, 1990)."""
    before, rise, after = f[1] - f[0], f[2] - f[1], f[3] - f[2]

    def slope(a, b):
        least = jnp.minimum(jnp.minimum(jnp.abs(a), jnp.abs(b)), 0.25 * jnp.abs(a + b))
        return (jnp.sign(a) + jnp.sign(b)) * least

    left, right = slope(before, rise), slope(rise, after)
    return f[1] + t * (left + t * (3 * rise - 2 * left - right + t * (left + right - 2 * rise)))
