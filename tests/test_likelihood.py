"""The likelihood against brute force: every pixel by itself, laws from scipy, the row gain integrated by scipy."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import hsnoise
from hsnoise._core.compiling import jit_lean, lean_options
from hsnoise.likelihood import plan
from hsnoise.likelihood.darks import evaluate, likelihood_part
from hsnoise.likelihood.moments import start_model
from hsnoise.likelihood.plan import plan_rules
from hsnoise.likelihood.summary import some_frames, summarise
from hsnoise.model import sample_dark

EXPOSURE_S = (0.02, 0.1)


def camera(cfa="RGGB", shutter="global", **keywords):
    model = hsnoise.cameras.canon_5d3(cfa="RGGB" if cfa == "mono" else cfa, shutter=shutter, **keywords)
    if cfa != "mono":
        return model
    from hsnoise.effects import ADC, BlackLevel, DarkCurrent, Gain, ReadNoise, RowGain, ShotNoise

    exponent = 1.0 if shutter == "rolling" else 0.0
    black, white = keywords.get("black_level_dn", 0.0), keywords.get("white_level_dn")
    effects = [
        ShotNoise(),
        DarkCurrent(51.7),
        ReadNoise(3.5),
        RowGain(0.3, exponent),
        Gain(1.4),
        BlackLevel(black),
        ADC(white),
    ]
    return hsnoise.NoiseModel(effects, cfa="mono", shutter=shutter, exposure_s=0.05)


def capture(model, shape=(8, 12), frames=2, seed=5):
    keys = jax.random.split(jax.random.key(seed), len(EXPOSURE_S))
    counts = [
        np.asarray(sample_dark(k, frames, shape, model, exposure_s=t)) for k, t in zip(keys, EXPOSURE_S, strict=True)
    ]
    return hsnoise.FrameStack(
        counts,
        EXPOSURE_S,
        black_level=np.asarray(model["black_level"].value, float),
        white_level=model["adc"].white_level_dn,
        cfa=model.cfa,
        shutter=model.shutter,
    )


def pixel_law(y, mean_e, sigma_e, scale, black, white):
    """P(count y) for scale = gain x beta > 0, with the tails in the counts 0 and white."""
    k = np.arange(120)
    pmf = stats.poisson.pmf(k, mean_e)

    def cdf(edge):
        return (pmf * stats.norm.cdf(((edge - black) / scale - k) / sigma_e)).sum()

    high = 1.0 if white is not None and y >= white else cdf(y + 0.5)
    return high - (0.0 if y == 0 else cdf(y - 0.5))


def brute_force(model, stack):
    """Sum over exposures, frames, rows and colours of log integral of the pixels' product over the row gain."""
    tile = np.array([["mono"]]) if stack.cfa == "mono" else np.array(list(stack.cfa)).reshape(2, 2)
    rate, sigma_e = float(model["dark_current"].rate), float(model["read_noise"].sigma)
    total = 0.0
    for e, exposure in enumerate(stack.exposure_s):
        for frame in stack.frames(e):
            for r, row in enumerate(frame):
                for channel in dict.fromkeys(tile[r % len(tile)]):
                    c = stack.channels.index(channel)
                    pixels = row[[i for i in range(len(row)) if tile[r % len(tile), i % tile.shape[1]] == channel]]
                    total += np.log(row_integral(model, c, pixels, rate * exposure, sigma_e))
    return total


def row_integral(model, c, pixels, mean_e, sigma_e):
    gain, black = (float(np.ravel(model[name].value)[c]) for name in ("gain", "black_level"))
    spread = float(np.ravel(model["row_gain"].sigma)[c])
    white = model["adc"].white_level_dn
    codes, repeats = np.unique(pixels, return_counts=True)

    def likelihood(beta):
        scale = gain * max(beta, 1e-6)
        return np.prod(
            [pixel_law(y, mean_e, sigma_e, scale, black, white) ** n for y, n in zip(codes, repeats, strict=True)]
        )

    # Composite Gauss-Legendre: 60 panels of 12 points.
    x, w = np.polynomial.legendre.leggauss(12)
    edges = np.linspace(0, 1 + 7.5 * spread, 61)
    half = np.diff(edges)[:, None] / 2
    beta, weight = (edges[:-1, None] + half * (x + 1)).ravel(), (half * w).ravel()
    body = sum(wi * likelihood(b) * stats.norm.pdf(b, 1, spread) for b, wi in zip(beta, weight, strict=True))
    return body + likelihood(0.0) * stats.norm.cdf(-1 / spread)


@pytest.mark.parametrize(
    ("cfa", "keywords"),
    [
        pytest.param("mono", {}, marks=pytest.mark.slow),
        ("mono", {"black_level_dn": 20.3, "white_level_dn": 40}),
        pytest.param("GBRG", {"black_level_dn": 4.0}, marks=pytest.mark.slow),
        pytest.param("GBRG", {"black_level_dn": 4.3, "white_level_dn": 16}, marks=pytest.mark.slow),
    ],
)
def test_white_rows_match_brute_force(cfa, keywords):
    model = camera(cfa, **keywords)
    stack = capture(model, shape=(2, 10), frames=1)
    ours = float(hsnoise.log_likelihood(model, stack))
    np.testing.assert_allclose(ours, brute_force(model, stack), rtol=1e-6)


def moved(model, factor):
    return eqx.tree_at(lambda m: (m["gain"].value, m["read_noise"].sigma), model, replace_fn=lambda x: x * factor)


@pytest.mark.slow
@pytest.mark.parametrize("shutter", ["global", "rolling"])
def test_gradient_matches_differences(shutter):
    model = camera(shutter=shutter, black_level_dn=10.0)
    summary = hsnoise.summarise(capture(model, shape=(32, 64)))
    known = likelihood_part(model)
    rules = plan_rules(known, summary)
    value = jax.jit(lambda m: evaluate(m, summary, rules))
    leaves, structure = jax.tree.flatten(jax.grad(value)(known))
    points = jax.tree.leaves(known)
    for i, (point, slope) in enumerate(zip(points, leaves, strict=True)):
        step = 1e-4 * np.maximum(np.abs(point), 0.1)
        ends = [structure.unflatten([*points[:i], point + s * step, *points[i + 1 :]]) for s in (1, -1)]
        difference = (value(ends[0]) - value(ends[1])) / 2
        np.testing.assert_allclose((slope * step).sum(), difference, rtol=1e-3, atol=1e-7)


@pytest.mark.slow
def test_jit_vmap_and_a_float32_session_give_the_same():
    model = camera(shutter="rolling", black_level_dn=10.0)
    summary = hsnoise.summarise(capture(model, shape=(16, 32)))
    factors = jnp.array([0.97, 1.0, 1.03])
    models = [moved(model, f) for f in factors]
    rules = plan_rules(model, summary)
    one_by_one = [float(hsnoise.log_likelihood(m, summary, rules=rules)) for m in models]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *models)
    batched = jax.jit(jax.vmap(lambda m: hsnoise.log_likelihood(m, summary, rules=rules)))(batch)
    np.testing.assert_allclose(batched, one_by_one, rtol=1e-10)
    with jax.enable_x64(False):
        single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), models[0])
        value, gradient = jax.value_and_grad(lambda m: hsnoise.log_likelihood(m, summary, rules=rules))(single)
    np.testing.assert_allclose(float(value), one_by_one[0], rtol=1e-6)
    assert all(np.isfinite(np.asarray(g)).all() for g in jax.tree.leaves(gradient))


@pytest.mark.slow
@pytest.mark.parametrize("row_gain", [True, False])
def test_bins_that_no_row_uses_make_no_difference(row_gain, monkeypatch):
    """Left out by `plan_rules`, or put in again by `replan`; hot pixels are far out, in the last, open bin, too."""
    model = camera(shutter="global", black_level_dn=40.0)
    stack = capture(model, shape=(32, 64))
    frames = [np.stack(list(stack.frames(e))) for e in range(len(stack.exposure_s))]
    frames[1][0, 3, ::16] = [90, 300, 5000, 16000]
    model = model if row_gain else model.remove("row_gain")
    summary = hsnoise.summarise(hsnoise.FrameStack(frames, EXPOSURE_S, black_level=40, cfa="RGGB", shutter="global"))
    known = likelihood_part(model)
    value = jax.jit(lambda rules, outliers: evaluate(known, summary, rules, outliers))
    fewer = plan_rules(known, summary)
    monkeypatch.setattr(plan, "_used_bins", lambda histograms: histograms)
    all_bins = plan_rules(known, summary)
    assert fewer[0].outlier_law.shape[-1] < all_bins[0].outlier_law.shape[-1]
    padded = plan.replan(all_bins, fewer)
    assert padded[0].outlier_law.shape == all_bins[0].outlier_law.shape
    for outliers in (None, jnp.full(2, 1e-3)):
        expected = float(value(all_bins, outliers))
        for rules in (fewer, padded):
            np.testing.assert_allclose(float(value(rules, outliers)), expected, rtol=1e-9)


@pytest.mark.slow
def test_rules_hold_away_from_where_they_were_made():
    """A rule made at the truth is still exact where a fit may wander; finer rules change nothing."""
    model = camera(shutter="rolling", black_level_dn=10.0)
    summary = hsnoise.summarise(capture(model, shape=(64, 96), frames=4))
    rules = plan_rules(model, summary)
    for factor in (0.9, 1.0, 1.1):
        there = likelihood_part(moved(model, factor))
        ours, own = evaluate(there, summary, rules), evaluate(there, summary, plan_rules(there, summary))
        np.testing.assert_allclose(float(ours), float(own), rtol=0, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "gain"),
    [(1.7, 1.0), (0.5, 1.0), (1.0, 0.65), (1.3, 1.3)],
)
def test_likelihood_is_a_number_where_rows_of_a_model_have_another_mean(rate, gain):
    """Coloured rows have no common offset that could take up a wrong mean."""
    model = camera(shutter="rolling", black_level_dn=10.0)
    summary = hsnoise.summarise(capture(model, shape=(64, 96), frames=4))
    wrong = model.with_value("dark_current", "rate", rate * model["dark_current"].rate)
    wrong = wrong.with_value("gain", "value", gain * model["gain"].value)
    assert float(hsnoise.log_likelihood(wrong, summary)) < float(hsnoise.log_likelihood(model, summary)) - 100


# At exactly 0, coloured rows are integrated over a gain of 1e-6 in the precision of their fixed point.
@pytest.mark.parametrize(
    ("sigma", "shutter", "rtol"),
    [
        pytest.param(1e-5, "global", 1e-7, marks=pytest.mark.slow),
        pytest.param(1e-5, "rolling", 1e-7, marks=pytest.mark.slow),
        (0.0, "global", 1e-7),
        pytest.param(0.0, "rolling", 1e-6, marks=pytest.mark.slow),
    ],
)
def test_rows_of_a_model_without_row_gain_need_no_integral(sigma, shutter, rtol):
    model = camera(shutter=shutter, black_level_dn=20.0).remove("row_gain")
    stack = capture(model, shape=(16, 32))
    still = camera(shutter=shutter, black_level_dn=20.0)
    tiny = eqx.tree_at(lambda m: m["row_gain"].sigma, still, jnp.full(3, sigma))
    np.testing.assert_allclose(
        float(hsnoise.log_likelihood(model, stack)), float(hsnoise.log_likelihood(tiny, stack)), rtol=rtol
    )


def test_known_photons_of_flats_tell_the_gain():
    rng = np.random.default_rng(0)
    light = np.array([100.0, 400.0, 1600.0])
    flats = [np.rint(0.5 * rng.poisson(x, (4, 64, 64)) + 50).astype(np.uint16) for x in light]
    known = hsnoise.FrameStack(flats, light / 1000, kind="flat", photons_e=light, black_level=50, shutter="global")
    unknown = hsnoise.FrameStack(flats, light / 1000, kind="flat", black_level=50, shutter="global")
    errors = [hsnoise.fit(s).table["gain"] for s in (known, unknown)]
    for value, error, _ in errors:
        assert abs(value - 0.5) < 4 * error
    assert errors[0][1] < 0.1 * errors[1][1]


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (camera(shutter="rolling"), "shutter"),
        (camera("mono"), "channels"),
    ],
)
def test_a_model_of_another_sensor_is_refused(model, message):
    with pytest.raises(ValueError, match=message):
        hsnoise.log_likelihood(model, capture(camera(black_level_dn=10.0)))


def test_programs_of_fits_are_compiled_lean():
    assert lean_options() or jax.__version_info__ >= (0, 12), (
        "this version of XLA does not know the option: fits compile twice as long"
    )
    square = jit_lean(lambda x, power: x**power)
    assert square(3.0, 2) == 9.0 and square(jnp.arange(3.0), 2)[2] == 4.0


def test_frames_that_only_some_exposures_have_make_a_piece(rng):
    counts = [np.rint(100 + 5 * rng.standard_normal((n, 16, 16))).astype(np.uint16) for n in (8, 2)]
    summary = summarise(hsnoise.FrameStack(counts, EXPOSURE_S, shutter="global", black_level=90))
    (rule,) = plan_rules(start_model(summary), some_frames(summary, 4, 8))
    assert np.isfinite(rule.edges_dn).all()
