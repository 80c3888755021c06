"""The integral over the row gain: white rows against quadrature by scipy, coloured ones against dense Gaussians."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from hsnoise.likelihood import rows


def nodes_over(low, high, scale, sigma, count):
    return rows.make_nodes(jnp.array([float(low)]), jnp.array([float(high)]), float(scale), sigma, count)


def one_group(curves, nodes) -> rows.Curves:
    """Rows [frame, row, node] in one group, in their own order, no place empty."""
    frames, n, count = curves.shape
    order = jnp.arange(frames * n)
    layout = rows.Layout(order, order.reshape(frames, n), jnp.ones(frames * n, bool))
    return rows.Curves(((curves.reshape(1, frames * n, count), nodes),), layout)


@pytest.mark.parametrize("sigma", [0.02, 0.1, 0.45])
@pytest.mark.parametrize("width", [0.03, 0.2, 3.0])
def test_white_rows_match_adaptive_quadrature(sigma, width):
    """Curves like those of rows: a lognormal-like peak of relative width `width`, constant below zero."""
    centre = 1.1

    def curve(beta):
        return -0.5 * (np.log(np.maximum(beta, 1e-3) / centre) / width) ** 2

    def integrand(beta):
        return np.exp(curve(beta)) * stats.norm.pdf(beta, 1, sigma)

    nodes = nodes_over(0.0, 1 + 8 * sigma, 0.05, sigma, 400)
    curves = jnp.asarray(curve(np.asarray(nodes.beta)))[:, None, :]
    ours = rows.log_evidence(curves, nodes, jnp.ones(()), jnp.float64(sigma**2))
    points = np.clip([1e-3, centre * (1 - width), centre, centre * (1 + width), 1.0], 0, 1 + 7 * sigma)
    exact, _ = integrate.quad(integrand, 0, 1 + 8 * sigma, points=sorted(points), limit=400, epsabs=0)
    exact += np.exp(curve(0.0)) * stats.norm.cdf(-1 / sigma)
    np.testing.assert_allclose(float(ours[0, 0]), np.log(exact), rtol=0, atol=1e-6)


def test_spectrum_has_unit_variance_no_dc_and_folds_like_taking_every_second_row():
    full = np.asarray(rows.row_spectrum(jnp.float64(1.0), 64, 1))
    np.testing.assert_allclose(full.mean(), 1.0)
    assert full[0] == 0
    np.testing.assert_allclose(full[1] / full[4], 4.0)
    folded = np.asarray(rows.row_spectrum(jnp.float64(1.0), 64, 2))
    covariance = np.fft.ifft(full).real
    np.testing.assert_allclose(np.fft.ifft(folded).real, covariance[::2], atol=1e-12)


def test_a_white_share_adds_to_every_frequency_and_folds_to_itself():
    full, folded = (
        np.asarray(rows.row_spectrum(jnp.float64(1.0), 64, stride, share)) for stride, share in ((1, 0.25), (2, 0.25))
    )
    coloured = np.asarray(rows.row_spectrum(jnp.float64(1.0), 64, 1))
    np.testing.assert_allclose(full, 0.75 * coloured + 0.25)
    np.testing.assert_allclose(np.fft.ifft(folded).real, np.fft.ifft(full).real[::2], atol=1e-12)
    np.testing.assert_allclose(rows.row_spectrum(jnp.float64(1.0), 64, 2, 1.0), 1.0)


def dense_log_evidence(y, variance, covariance):
    return [
        stats.multivariate_normal.logpdf(row, np.ones(len(row)), covariance + np.diag(v), allow_singular=True)
        for row, v in zip(y, variance, strict=True)
    ]


@pytest.mark.parametrize(
    ("sigma", "exponent", "noise", "mean"),
    [
        pytest.param(0.1, 1.0, 0.08, 1.0, marks=pytest.mark.slow),
        pytest.param(0.1, 0.5, 0.05, 1.0, marks=pytest.mark.slow),
        pytest.param(0.05, 1.5, 0.02, 1.0, marks=pytest.mark.slow),
        (0.05, 1.0, 0.06, 0.7),
    ],
)
def test_coloured_rows_match_the_dense_gaussian(sigma, exponent, noise, mean):
    """Gaussian curves of unequal width: the mean is exact, the determinant good to a fraction of a nat.

    Rows of another mean than 1 contradict the prior, which has no common offset: thousands of nats.
    """
    n, frames = 160, 6
    rng = np.random.default_rng(1)
    spectrum = sigma**2 * np.asarray(rows.row_spectrum(jnp.float64(exponent), n, 1))
    covariance = np.fft.ifft(np.fft.fft(np.eye(n), axis=0) * spectrum[:, None], axis=0).real
    beta = 1 + rng.multivariate_normal(np.zeros(n), covariance, frames)
    variance = (noise * beta) ** 2 * rng.uniform(0.7, 1.4, beta.shape)
    y = beta + np.sqrt(variance) * rng.standard_normal(beta.shape) + mean - 1
    nodes = nodes_over(0.05, 2.0, 0.05, 0.13, 500)
    distance = np.asarray(nodes.beta)[0] - y[..., None]
    curves = -0.5 * distance**2 / variance[..., None] - 0.5 * np.log(2 * np.pi * variance)[..., None]
    evidence = jax.jit(rows.log_evidence_coloured)  # one program, not one for each operation
    ours = evidence(one_group(jnp.asarray(curves), nodes), jnp.asarray(spectrum))
    np.testing.assert_allclose(ours, dense_log_evidence(y, variance, covariance), rtol=1e-4, atol=0.15)


def lognormal_curves(nodes, centres, width=0.1):
    """Peaks of relative width `width` at centres [...], constant below zero: [..., node]."""
    beta = np.maximum(np.asarray(nodes.beta), 1e-3)
    return jnp.asarray(-0.5 * (np.log(beta / np.maximum(centres, 0.2)[..., None]) / width) ** 2)


@pytest.mark.slow
def test_coloured_rows_with_a_white_spectrum_are_the_white_rows():
    rng = np.random.default_rng(2)
    sigma = 0.2
    nodes = nodes_over(0.0, 2.5, 0.05, sigma, 300)
    curves = lognormal_curves(nodes, 1 + sigma * rng.standard_normal((2, 40)))
    white = rows.log_evidence(curves.reshape(1, 80, -1), nodes, jnp.ones(()), jnp.float64(sigma**2))
    coloured = rows.log_evidence_coloured(one_group(curves, nodes), jnp.full(40, sigma**2))
    np.testing.assert_allclose(coloured, white.reshape(2, 40).sum(-1), atol=1e-6)
    total = rows.log_evidence_white(one_group(curves, nodes), jnp.float64(sigma**2))
    np.testing.assert_allclose(total, white.sum(), atol=1e-9)


@pytest.mark.slow
def test_gradient_of_coloured_rows_needs_no_derivative_of_the_iteration():
    rng = np.random.default_rng(3)
    nodes = nodes_over(0.0, 2.5, 0.05, 0.3, 300)
    centres = 1 + 0.3 * rng.standard_normal((2, 64, 1))
    curves = jnp.asarray(-0.5 * ((np.asarray(nodes.beta) - centres) / (0.1 * np.maximum(centres, 0.3))) ** 2)

    def value(theta):
        spectrum = theta[0] ** 2 * rows.row_spectrum(theta[1], 64, 1)
        return rows.log_evidence_coloured(one_group(theta[2] * curves, nodes), spectrum).sum()

    theta = jnp.array([0.3, 0.8, 1.0])
    gradient = jax.grad(value)(theta)
    step = 1e-4
    differences = [(value(theta.at[i].add(step)) - value(theta.at[i].add(-step))) / (2 * step) for i in range(3)]
    np.testing.assert_allclose(gradient, differences, rtol=1e-4)


def in_groups(centres, present, sigma, blocks=((1, 420), (2, 300), (1, 360))) -> rows.Curves:
    """Rows sorted into groups with rules of their own, in blocks of (groups, nodes); a fifth of the places is empty.

    Rows [frame, row] that are not `present` have a place, but no pixels.
    """
    total = centres.size
    groups = sum(g for g, _ in blocks)
    places = -(-total * 5 // 4 // groups)
    order = np.full((groups, places), total)
    for group, part in enumerate(np.array_split(np.argsort(centres, axis=None), groups)):
        order[group, places - len(part) :] = part  # empty places first, in the midst of the others
    place = np.empty(total, int)
    place[order[order < total]] = np.flatnonzero(order < total)
    known = np.append(np.where(present, centres, np.nan).ravel(), np.nan)[order]
    made, start = [], 0
    for size, count in blocks:
        inside = known[start : start + size]
        low, high = np.nanmin(inside, 1) * 0.5, np.nanmax(inside, 1) * 2.0
        nodes = rows.make_nodes(jnp.asarray(low), jnp.asarray(high), 0.05, sigma, count)
        curves = [lognormal_curves(rows.Nodes(b, b), c) for b, c in zip(nodes.beta, inside, strict=True)]
        made.append((jnp.where(np.isnan(inside)[..., None], -7.0, jnp.stack(curves)), nodes))
        start += size
    filled = jnp.asarray(~np.isnan(known.ravel()))
    layout = rows.Layout(jnp.asarray(order.ravel()), jnp.asarray(place.reshape(centres.shape)), filled)
    return rows.Curves(tuple(made), layout)


def grouped_and_not(sigma=0.2):
    """The same rows of 3 frames in several groups and, without the last frame, which has no pixels, in one."""
    centres = np.maximum(1 + sigma * np.random.default_rng(4).standard_normal((3, 40)), 0.2)
    present = np.ones(centres.shape, bool)
    present[2] = False
    nodes = nodes_over(0.0, 2.5, 0.05, sigma, 600)
    return in_groups(centres, present, sigma), one_group(lognormal_curves(nodes, centres[:2]), nodes)


@pytest.mark.slow
def test_groups_blocks_and_empty_places_change_nothing_for_white_rows():
    grouped, plain = grouped_and_not()
    assert not grouped.layout.filled.all()
    evidence = jax.jit(jax.value_and_grad(rows.log_evidence_white, argnums=1))
    value, slope = evidence(grouped, jnp.float64(0.04))
    expected, expected_slope = evidence(plain, jnp.float64(0.04))
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(slope, expected_slope, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("exponent", [0.0, 1.0])
def test_groups_blocks_and_empty_places_change_nothing_for_coloured_rows(exponent):
    grouped, plain = grouped_and_not()

    @jax.jit
    def evidence_and_slope(curves):
        def evidence(sigma):
            spectrum = sigma**2 * rows.row_spectrum(jnp.float64(exponent), 40, 1)
            return rows.log_evidence_coloured(curves, spectrum)

        return jax.jvp(evidence, (jnp.float64(0.2),), (jnp.float64(1.0),))

    ours, slope = evidence_and_slope(grouped)
    expected, expected_slope = evidence_and_slope(plain)
    assert ours.shape == (3,)
    np.testing.assert_allclose(ours[:2], expected, rtol=0, atol=1e-6)
    # The fixed point is one of float32: a thousandth of what 40 rows tell would be 0.05.
    np.testing.assert_allclose(slope[:2], expected_slope, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose([ours[2], slope[2]], 0.0, atol=1e-5)  # a frame without pixels says nothing
