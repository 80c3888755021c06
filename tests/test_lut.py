"""Clip correction against brute force and Monte Carlo; the line fit on simulated captures."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from hsnoise.fitting.line import line_fit
from hsnoise.frames.stack import FrameStack
from hsnoise.likelihood.summary import summarise
from hsnoise.lut import clipped_moments, make_clip_tables, row_moments, unclip
from hsnoise.model import sample, sample_dark
from hsnoise.plots.clip_tables import clip_table_figure, clip_tables
from hsnoise.simulation.cameras import canon_5d3, grasshopper3

EXPOSURES_S = (0.02, 0.05, 0.1, 0.2)


def brute_force(mean_e, read_e, gain, black, white):
    """Mean above black and variance of clip(round(black + gain (P + R)), 0, white), summed over every count."""
    far = black + gain * (mean_e + 14 * np.hypot(np.sqrt(mean_e), read_e) + 12) + 20
    top = int(far if white is None else white)
    k = np.arange(int(mean_e + 12 * np.sqrt(mean_e)) + 40)
    j = np.arange(1, top + 1)
    above = stats.norm.sf((j - 0.5 - black) / gain - k[:, None], scale=read_e)
    above = stats.poisson.pmf(k, mean_e) @ above
    mean = above.sum()
    return mean - black, ((2 * j - 1) * above).sum() - mean**2


LAWS = [  # mean e-, read noise e-, gain, black level, white level
    (0.3, 3.54, 1.53, 0.0, None),
    (5.0, 3.54, 1.23, 0.0, None),
    (2.36, 2.33, 3.54, 0.0, None),
    (10.0, 0.5, 1.31, 0.3, None),  # rounding of single peaks, a black level between counts
    (25.0, 10.0, 0.1, 2.0, None),
    (4.0, 2.0, 1.5, 0.0, 12.0),
    (20.0, 6.0, 2.0, 16.0, 63.0),
    (80.0, 60.0, 1.0, 5.0, None),  # above 30 e- the sum is replaced
    (300.0, 3.0, 2.0, 64.0, 700.0),
]


@pytest.mark.parametrize(("mean_e", "read_e", "gain", "black", "white"), LAWS)
def test_moments_are_those_of_brute_force(mean_e, read_e, gain, black, white):
    mean, variance = clipped_moments(
        gain * mean_e, gain**2 * (mean_e + read_e**2), gain=gain, black_level_dn=black, white_level_dn=white
    )
    expected_mean, expected_variance = brute_force(mean_e, read_e, gain, black, white)
    assert abs(mean - expected_mean) < 3e-5 * np.sqrt(expected_variance)
    assert abs(variance / expected_variance - 1) < (1e-4 if mean_e <= 30 else 1e-3)


@pytest.mark.parametrize(("mean_e", "read_e", "gain", "black", "white"), [LAWS[0], LAWS[3], LAWS[5]])
def test_moments_are_those_of_samples(mean_e, read_e, gain, black, white):
    rng, n = np.random.default_rng(3), 2_000_000
    signal = gain * (rng.poisson(mean_e, n) + rng.normal(0, read_e, n))
    counts = np.clip(np.round(black + signal), 0, white) - black
    mean, variance = clipped_moments(
        gain * mean_e, gain**2 * (mean_e + read_e**2), gain=gain, black_level_dn=black, white_level_dn=white
    )
    centred = counts - counts.mean()
    assert abs(counts.mean() - mean) < 5 * counts.std() / np.sqrt(n)
    assert abs((centred**2).mean() - variance) < 5 * (centred**2).std() / np.sqrt(n)


def noise_grid(gain):
    """True means and variances [electrons, read noise] of the darks of a camera of the paper's kind."""
    mean_e, read_e = np.linspace(0.05, 40, 18)[:, None], np.linspace(1.5, 8, 14)[None, :]
    return gain * mean_e + 0 * read_e, gain**2 * (mean_e + read_e**2)


@pytest.mark.parametrize(
    ("black", "white"),
    [pytest.param(0.0, None, marks=pytest.mark.slow), (5.0, None), pytest.param(2.0, 120.0, marks=pytest.mark.slow)],
)
def test_unclip_inverts_the_moments(black, white):
    mean, variance = noise_grid(1.53)
    keywords = dict(gain=1.53, black_level_dn=black, white_level_dn=white)
    true = unclip(*clipped_moments(mean, variance, **keywords), **keywords)
    assert np.asarray(true.solved).all()
    np.testing.assert_allclose(true.mean_dn, mean, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(true.variance_dn2, variance, rtol=1e-7)


@pytest.fixture(scope="module")
def canon_tables():
    return make_clip_tables(1.53, nodes=40)


@pytest.mark.slow
def test_tables_return_what_was_clipped(canon_tables):
    mean, variance = noise_grid(1.53)
    true = canon_tables(*clipped_moments(mean, variance, gain=1.53))
    assert np.asarray(true.solved).all()
    assert np.abs(np.asarray(true.mean_dn) - mean).max() < 2e-3 * np.sqrt(variance.min())
    assert np.abs(np.asarray(true.variance_dn2) / variance - 1).max() < 5e-3


@pytest.mark.slow
def test_tables_at_the_white_level():
    gain, white = 2.0, 255.0
    mean = np.linspace(2, 240, 40)
    variance = gain * mean + 60.0
    tables = make_clip_tables(gain, white_level_dn=white, variance_dn2=(20.0, 1000.0), nodes=20)
    true = tables(*clipped_moments(mean, variance, gain=gain, white_level_dn=white))
    assert np.asarray(true.solved).all()
    assert np.abs((np.asarray(true.mean_dn) - mean) / np.sqrt(variance)).max() < 2e-3
    assert np.abs(np.asarray(true.variance_dn2) / variance - 1).max() < 5e-3


def test_far_above_clipping_the_tables_are_the_identity_but_for_rounding():
    tables = make_clip_tables(1.31, black_level_dn=128.0, nodes=16)
    mean, variance = noise_grid(1.31)
    true = tables(mean, variance)
    assert np.asarray(true.solved).all()
    np.testing.assert_allclose(true.mean_dn, mean, atol=1e-6)
    np.testing.assert_allclose(true.variance_dn2, variance - 1 / 12, rtol=1e-3)


@pytest.mark.slow
def test_pairs_that_no_law_has_are_masked_and_come_back_or_are_continued(canon_tables):
    # A normal around black clips to a mean of 0.683 clipped standard deviations; shot noise has variance gain * mean.
    ratio = stats.norm.pdf(0) / np.sqrt(0.5 - stats.norm.pdf(0) ** 2)
    variance = np.array([20.0, 200.0])
    for factor, expected in ((0.98, False), (1.02, True)):
        for correct in (canon_tables, lambda m, v: unclip(m, v, gain=1.53)):
            np.testing.assert_array_equal(correct(factor * ratio * np.sqrt(variance), variance).solved, expected)
            np.testing.assert_array_equal(correct(variance / 1.53 / factor, variance).solved, expected)
    outside = canon_tables(0.1, 1e6)
    assert (not outside.solved, float(outside.mean_dn), float(outside.variance_dn2)) == (True, 0.1, 1e6)
    # Whole numbers of mean 0.5 have a variance of at least 0.25.
    impossible = unclip(0.5, 0.1, gain=1.53)
    assert (not impossible.solved, float(impossible.mean_dn), float(impossible.variance_dn2)) == (True, 0.5, 0.1)


def test_correction_is_monotone(canon_tables):
    mean, variance = np.linspace(2.5, 25, 18), np.linspace(9.0, 90, 14)
    true = canon_tables(mean[:, None], 12.0 + 1.6 * mean[:, None] + variance[None, :])
    solved = np.asarray(true.solved)
    for values, axis in ((true.mean_dn, 0), (true.variance_dn2, 1)):
        steps = np.diff(np.where(solved, values, np.nan), axis=axis)
        assert (steps[np.isfinite(steps)] > 0).all()


@pytest.mark.slow
def test_gradients_are_finite_and_right(canon_tables):
    mean, variance = np.array([2.2, 3.5, 10.0, 60.0, 0.1]), np.array([9.0, 16.0, 30.0, 120.0, 1e6])

    def total(correct, m, v):
        true = correct(m, v)
        return (true.mean_dn + true.variance_dn2).sum()

    def exact(m, v):
        return unclip(m, v, gain=1.53)

    of_tables = np.array(jax.grad(lambda m, v: total(canon_tables, m, v), (0, 1))(jnp.array(mean), jnp.array(variance)))
    of_exact = np.array(jax.grad(lambda m, v: total(exact, m, v), (0, 1))(jnp.array(mean), jnp.array(variance)))
    assert np.isfinite(of_tables).all() and np.isfinite(of_exact).all()
    step = 1e-4
    for i, (dm, dv) in enumerate(((step, 0.0), (0.0, step))):
        high, low = exact(mean + dm, variance + dv), exact(mean - dm, variance - dv)
        slope = (high.mean_dn + high.variance_dn2 - low.mean_dn - low.variance_dn2) / (2 * step)
        np.testing.assert_allclose(of_exact[i, :4], slope[:4], rtol=1e-4)
        np.testing.assert_allclose(of_tables[i, :4], slope[:4], rtol=0.05, atol=0.01)


def test_row_moments_are_those_of_rows():
    # Where black is the clipping level the clipped mean is proportional to the row gain, up to rounding.
    level, _ = clipped_moments(10.0, 50.0, gain=1.5)
    over_rows, _, response = row_moments(10.0, 50.0, 0.1, gain=1.5)
    np.testing.assert_allclose([over_rows, response], [level, level], rtol=1e-3)
    # Elsewhere: a weighted mean over a fine grid of gains.
    beta = np.linspace(0.4, 1.6, 241)
    weight = stats.norm.pdf(beta, 1, 0.15)
    weight /= weight.sum()
    m, v = clipped_moments(beta * 2.0, beta**2 * 50.0, gain=beta * 1.5, black_level_dn=5.0)
    mean = weight @ np.asarray(m)
    spread = np.sqrt(weight @ (np.asarray(m) - mean) ** 2)
    expected = [mean, weight @ np.asarray(v), spread / 0.15]
    np.testing.assert_allclose(row_moments(2.0, 50.0, 0.15, gain=1.5, black_level_dn=5.0), expected, rtol=1e-3)


@pytest.mark.parametrize(
    ("name", "keywords"),
    [
        ("gain", dict(gain=0.0)),
        ("variance_dn2", dict(gain=1.0, variance_dn2=(5.0, 1.0))),
        ("white_level_dn", dict(gain=1.0, black_level_dn=9.0, white_level_dn=4.0)),
        ("nodes", dict(gain=1.0, nodes=3)),
    ],
)
def test_tables_refuse_bad_arguments(name, keywords):
    with pytest.raises(ValueError, match=f"^{name}: "):
        make_clip_tables(**keywords)


def test_figure_shows_both_tables():
    data = clip_table_figure(points=20)
    assert data.true_mean_dn.shape == data.solved.shape == (20, 20)
    np.testing.assert_array_equal(np.isfinite(data.true_variance_dn2), data.solved)
    assert 0 < data.solved.sum() < data.solved.size
    figure = clip_tables(points=20)
    assert [axes.get_xlabel() for axes in figure.axes[:2]] == ["mean of clipped counts above black / DN"] * 2


def darks(camera, seed, *, exposures_s=EXPOSURES_S, frames=4, flats_e=(), black_level=0.0, known_black=True):
    """Summary of a simulated capture of 96 x 128 pixels."""
    model, key = camera(black_level_dn=black_level), jax.random.key(seed)
    counts = [
        np.asarray(sample_dark(jax.random.fold_in(key, i), frames, (96, 128), model, exposure_s=t))
        for i, t in enumerate(exposures_s)
    ]
    for i, light in enumerate(flats_e, start=len(counts)):
        clean = np.full((frames, 96, 128), light, np.float32)
        counts.append(np.asarray(sample(jax.random.fold_in(key, i), clean, model, exposure_s=0.01)))
    stack = FrameStack(
        counts,
        exposure_s=[*exposures_s, *[0.01] * len(flats_e)],
        black_level=black_level if known_black else None,
        cfa=model.cfa,
        shutter=model.shutter,
        kind=["dark"] * len(exposures_s) + ["flat"] * len(flats_e),
    )
    return summarise(stack)


COMPARED = ("gain", "dark_current", "read_noise", "row_gain.sigma", "row_gain.exponent")


def chosen(table, *starts):
    """Numbers of a table whose names begin with these, in their order."""
    return np.array([value for start in starts for name, value in table.items() if name.startswith(start)])


def values_of(fit, *starts):
    return chosen({name: row[0] for name, row in fit.params.table.items()}, *(starts or COMPARED))


def errors_of(fit, *starts):
    return chosen(fit.standard_errors, *(starts or COMPARED))


def truth_of(model):
    return chosen({name: row[0] for name, row in model.table.items()}, *COMPARED)


@pytest.mark.parametrize(
    ("camera", "black", "captures"),
    [
        pytest.param(canon_5d3, 0.0, 5, marks=pytest.mark.slow),
        pytest.param(canon_5d3, 5.0, 3, marks=pytest.mark.slow),
        (canon_5d3, 128.0, 4),
        pytest.param(grasshopper3, 0.0, 5, marks=pytest.mark.slow),
    ],
)
def test_line_fit_recovers_the_paper(camera, black, captures):
    """Mean over captures within 5 of its standard errors; the errors the fit claims agree with the spread."""
    fits = [line_fit(darks(camera, seed, black_level=black)) for seed in range(captures)]
    values = np.stack([values_of(f) for f in fits])
    errors = np.stack([errors_of(f) for f in fits])
    truth = truth_of(camera())
    estimated = slice(None) if camera is canon_5d3 else slice(-1)  # the exponent of a global shutter is 0
    claimed = np.sqrt((errors[:, estimated] ** 2).mean(0))
    pull = (values.mean(0) - truth)[estimated] / (claimed / np.sqrt(captures))
    assert np.abs(pull).max() < 5
    # Standard errors of one capture: gain of green and blue, dark current, read noise.
    assert (claimed[1:5] / truth[1:5] < [0.05, 0.07, 0.05, 0.05]).all()
    spread = values.std(0, ddof=1)[estimated]
    assert 0.5 < np.sqrt(np.mean((claimed / spread) ** -2)) < 2
    assert all(f.notes == () for f in fits)


def test_flats_join_the_line():
    fits = [line_fit(darks(canon_5d3, seed, exposures_s=(0.05,), flats_e=(50.0, 200.0))) for seed in range(2)]
    for fit in fits:
        pull = (values_of(fit) - truth_of(canon_5d3())) / errors_of(fit)
        assert np.abs(pull[:4]).max() < 5
        assert (errors_of(fit, "gain") < 0.05 * values_of(fit, "gain")).all()


def test_black_level_is_the_intercept_where_nothing_is_clipped():
    fit = line_fit(darks(canon_5d3, 1, black_level=128.0, known_black=False))
    assert (np.abs(values_of(fit, "black_level") - 128) < 5 * errors_of(fit, "black_level")).all()
    assert (errors_of(fit, "black_level") < 0.5).all()
    clipped = line_fit(darks(canon_5d3, 1, known_black=False))
    assert any("give black_level" in note for note in clipped.notes)


@pytest.mark.parametrize("known_black", [True, False])
def test_one_exposure_does_not_determine_the_gain(known_black):
    fit = line_fit(darks(canon_5d3, 1, exposures_s=(0.05,), black_level=128.0, known_black=known_black))
    for name in ("gain", "dark_current", "read_noise"):
        assert np.isinf(errors_of(fit, name)).all()
    assert np.isfinite(values_of(fit)).all()
    assert np.isinf(errors_of(fit, "black_level")).all() != known_black
    assert "gain is not determined" in fit.notes[0]


def test_bias_frames_alone_have_no_dark_current():
    fit = line_fit(darks(canon_5d3, 1, exposures_s=(0.0,), black_level=128.0))
    assert np.isinf(errors_of(fit, "dark_current")).all() and np.isfinite(values_of(fit)).all()
    assert any("bias frames" in note for note in fit.notes)


@pytest.mark.slow
def test_single_frames_have_errors_only_from_three_exposures_on():
    assert np.isfinite(errors_of(line_fit(darks(canon_5d3, 1, frames=1)))).all()
    two = line_fit(darks(canon_5d3, 1, frames=1, exposures_s=(0.02, 0.2)))
    assert np.isinf(errors_of(two)).all()
    assert any("Standard errors" in note for note in two.notes)


def test_a_black_level_above_the_darks_is_told():
    summary = darks(canon_5d3, 1, black_level=128.0)
    wrong = eqx.tree_at(lambda s: s.black_level_dn, summary, summary.black_level_dn + 20)
    fit = line_fit(wrong)
    assert np.isfinite(values_of(fit)).all()
    assert any("below black" in note and "R at 0.02 s" in note for note in fit.notes)


def test_line_fit_needs_darks():
    summary = darks(canon_5d3, 1, exposures_s=(0.05,), flats_e=(50.0,))
    with pytest.raises(ValueError, match="needs dark frames"):
        line_fit(eqx.tree_at(lambda s: s.histograms, summary, ()))
