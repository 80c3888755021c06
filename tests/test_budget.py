"""The noise budget recovers the components of simulated frames, with errors that cover."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise.criticism.budget import NoiseBudget
from hsnoise.criticism.budget_table import concise
from hsnoise.statistics.decomposition import COMPONENTS
from hsnoise.statistics.pixels import sample

SIGMA = {
    "frame": 3.0,
    "row": 2.5,
    "column": 2.0,
    "row_x_frame": 3.0,
    "column_x_frame": 1.5,
    "pixel": 5.0,
    "temporal": 6.0,
}
ROUNDING = 1 / 12
SHAPES = {  # axes [frame, row, column] along which a component varies
    "frame": (1, 0, 0),
    "row": (0, 1, 0),
    "column": (0, 0, 1),
    "row_x_frame": (1, 1, 0),
    "column_x_frame": (1, 0, 1),
    "pixel": (0, 1, 1),
    "temporal": (1, 1, 1),
}


def frames(rng, n=24, rows=32, columns=48, sigma=SIGMA, mean=500.0):
    """Counts [frame, row, column] of normal components."""
    total = np.full((n, rows, columns), mean)
    for name, there in SHAPES.items():
        size = [length if used else 1 for length, used in zip((n, rows, columns), there, strict=True)]
        total += sigma[name] * rng.standard_normal(size)
    return np.rint(total).astype(np.uint16)


def mosaic(rng, n, sigma=SIGMA, mean=500.0):
    """Bayer counts, each of the four planes by itself."""
    counts = np.empty((n, 64, 96), np.uint16)
    for r, c in np.ndindex(2, 2):
        counts[:, r::2, c::2] = frames(rng, n, sigma=sigma, mean=mean)
    return counts


def pulls(found, channel="mono"):
    """Deviations of ln variance from the truth over standard errors [row of the budget, component].

    Variances of few frames or lines are chi-squared: in their logarithm errors are about symmetric.
    """
    truth = {name: s**2 + (ROUNDING if name == "temporal" else 0) for name, s in SIGMA.items()}
    return np.array(
        [
            [
                np.log(c.variance_dn2 / truth[n]) * c.variance_dn2 / c.standard_error_dn2
                for n, c in row.components.items()
            ]
            for row in found.rows
            if row.channel == channel
        ]
    )


def test_components_are_recovered_with_errors_that_cover():
    rng = np.random.default_rng(1)
    # Two exposures of unequal frame numbers a capture.
    z = np.concatenate(
        [pulls(hsnoise.budget([frames(rng, 24), frames(rng, 40)], exposure_s=[0, 1])) for _ in range(60)]
    )
    rms = np.sqrt((z**2).mean(0))
    assert np.all((rms > 0.8) & (rms < 1.25)), dict(zip(COMPONENTS, rms.round(2), strict=True))
    assert np.all(np.abs(z.mean(0)) < 4 / np.sqrt(len(z)) + 0.2)


def test_estimates_are_unbiased_without_static_pixels():
    rng = np.random.default_rng(2)
    plain = SIGMA | dict.fromkeys(("pixel", "row", "column", "frame"), 0.0)
    found = [hsnoise.budget(frames(rng, 6, 16, 24, plain), exposure_s=[1.0]).rows[0].components for _ in range(200)]
    for name in COMPONENTS:
        values = np.array([one[name].variance_dn2 for one in found])
        truth = plain[name] ** 2 + (ROUNDING if name == "temporal" else 0)
        assert abs(values.mean() - truth) < 4 * values.std() / np.sqrt(len(values)), name


def test_colours_of_a_bayer_sensor_are_told_apart():
    rng = np.random.default_rng(3)
    z = {channel: [] for channel in "RGB"}
    for _ in range(25):
        found = hsnoise.budget(mosaic(rng, 24), exposure_s=[1.0], cfa="GRBG")
        for channel in z:
            z[channel].append(pulls(found, channel))
    for channel, of in z.items():
        rms = np.sqrt((np.concatenate(of) ** 2).mean(0))
        assert np.all((rms > 0.6) & (rms < 1.45)), (channel, rms.round(2))
    loud = mosaic(rng, 8)
    loud[:, ::2, ::2] = frames(rng, 8, sigma=SIGMA | {"temporal": 30.0})  # the red plane
    found = hsnoise.budget(loud, exposure_s=[1.0], cfa="RGGB")
    temporal = {row.channel: row.components["temporal"].variance_dn2 for row in found.rows}
    np.testing.assert_allclose([temporal[c] for c in "RGB"], [900, 36, 36], rtol=0.1)


def test_one_frame_tells_no_component():
    rng = np.random.default_rng(4)
    found = hsnoise.budget([frames(rng, 1), frames(rng, 8)], exposure_s=[0, 1])
    alone, several = found.rows
    assert all(np.isnan(one.variance_dn2) for one in alone.components.values())
    assert all(np.isfinite(one.variance_dn2) for one in several.components.values())
    assert alone.mean_dn == pytest.approx(500, abs=10)
    assert " - " in str(found) and "nan" not in str(found)


def test_shares_of_clipped_and_saturated_counts():
    rng = np.random.default_rng(5)
    counts = frames(rng, 8)
    counts.ravel()[::100] = 0
    counts.ravel()[1::50] = 4095
    row = hsnoise.budget(counts, exposure_s=[1.0], white_level=4095).rows[0]
    np.testing.assert_allclose([row.clipped_share, row.saturated_share], [0.01, 0.02], rtol=1e-2)
    printed = str(hsnoise.budget(counts, exposure_s=[1.0], white_level=4095))
    assert "at 0" in printed and "white" in printed


def test_shares_add_up_to_one():
    found = hsnoise.budget([frames(np.random.default_rng(6)) for _ in range(2)], exposure_s=[0, 1])
    for row in found.rows:
        assert sum(one.share for one in row.components.values()) == pytest.approx(1, abs=1e-12)
        assert row.total_dn2 == pytest.approx(sum(max(one.variance_dn2, 0) for one in row.components.values()))


def test_growth_is_that_of_the_components():
    rng = np.random.default_rng(7)
    times = (0.0, 1.0, 2.0, 3.0)
    counts = [frames(rng, 12, sigma=SIGMA | {"temporal": np.sqrt(36 + 20 * t)}) for t in times]
    found = hsnoise.budget(counts, exposure_s=times)
    slope, error = found.growth["mono", "temporal"]
    assert abs(slope - 20) < 4 * error < 8
    slope, error = found.growth["mono", "column_x_frame"]
    assert abs(slope) < 4 * error


def sensor(spread=0.5, offset=4.0):
    e = hsnoise.effects
    effects = [
        e.ShotNoise(),
        e.DarkCurrent(40.0),
        e.DarkCurrentNonuniformity(spread),
        e.DarkSignalNonuniformity(offset),
        e.ReadNoise(3.0),
        e.Gain(2.0),
        e.BlackLevel(300.0),
        e.ADC(),
    ]
    return hsnoise.NoiseModel(effects, cfa="mono", shutter="global", exposure_s=1.0)


def drawn(model, times=(0.0, 2.0), n=8, shape=(96, 128), seed=3):
    key, sensor_key = jax.random.split(jax.random.key(seed))
    counts = [
        np.asarray(
            hsnoise.sample_dark(jax.random.fold_in(key, i), n, shape, model, exposure_s=t, sensor_key=sensor_key)
        )
        for i, t in enumerate(times)
    ]
    return hsnoise.FrameStack(counts, times, shutter="global")


@pytest.mark.slow
def test_pixels_differ_by_what_they_were_drawn_with():
    found = hsnoise.budget(drawn(sensor()))
    n = 96 * 128
    offset, dark = found.pixels["mono", "offset"], found.pixels["mono", "dark signal"]
    # Spread of a normal distribution from n pixels, and of the core of a log-normal one.
    assert offset.spread == pytest.approx(2 * 4.0, rel=5 / np.sqrt(2 * n) + 0.01)
    assert dark.median == pytest.approx(2 * 40 * np.exp(-0.125), rel=0.02)
    assert dark.spread == pytest.approx(2 * 40 * np.sqrt(np.expm1(0.25)), rel=0.06)


@pytest.mark.slow
def test_the_tail_over_pixels_is_no_noise_of_estimation():
    alike = hsnoise.budget(drawn(sensor(0.0, 0.0)))
    for what in ("offset", "temporal noise"):
        assert alike.pixels["mono", what].tail < 0.2 * 2 * 3.0, what  # of the read noise, DN
    model = sensor().add(hsnoise.effects.HotPixels(0.01, 2000.0, 0.0))
    tail = hsnoise.budget(drawn(model)).pixels["mono", "dark signal"].tail
    # Of an exponential distribution: 0.05 % of all pixels are above this.
    assert tail == pytest.approx(2 * 2000 * np.log(0.01 / 0.0005), rel=0.2)


def test_the_budget_of_the_true_model_agrees():
    model = sensor()
    found = hsnoise.budget(drawn(model))
    under = found.under(model)
    assert isinstance(under, NoiseBudget)
    for measured, expected in zip(found.rows, under.rows, strict=True):
        assert measured.mean_dn == pytest.approx(expected.mean_dn, rel=0.01)
        for name in ("pixel", "temporal"):
            a, b = measured.components[name], expected.components[name]
            error = np.hypot(a.standard_error_dn2, b.standard_error_dn2)
            assert abs(a.variance_dn2 - b.variance_dn2) < 4 * error, name


@pytest.mark.slow
def test_of_large_frames_the_middle_is_drawn_of_the_model():
    model = sensor()
    wide = hsnoise.budget(drawn(model, n=2, shape=(32, 1200)))
    assert wide.under(model).survey.shape == (32, 512)


def test_a_model_of_another_sensor_is_refused():
    found = hsnoise.budget(frames(np.random.default_rng(8), 4), exposure_s=[1.0])
    with pytest.raises(ValueError, match="model: made for RGGB"):
        found.under(hsnoise.cameras.canon_5d3())
    with pytest.raises(TypeError, match="model: expected a NoiseModel"):
        found.under("canon")


@pytest.mark.parametrize("cfa", ["mono", "RGGB"])
def test_print_fits_into_a_terminal(cfa):
    rng = np.random.default_rng(9)
    counts = [mosaic(rng, 3, mean=30000.0) for _ in range(8)]
    text = str(hsnoise.budget(counts, exposure_s=np.geomspace(25.2e-6, 300, 8), cfa=cfa, white_level=30010))
    assert max(len(line) for line in text.splitlines()) <= 100
    assert "…" not in text and "nan" not in text.lower()
    assert sum(line.lstrip().startswith("25.2 µs") for line in text.splitlines()) == 2 * (1 if cfa == "mono" else 3)


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (45.512, 0.31, "45.5(3)"),
        (0.1412, 0.071, "0.14(7)"),
        (272.0, 51.0, "270(50)"),
        (41700.0, 19600.0, "4(2)e4"),
        (2.37e-4, 2.1e-5, "2.4(2)e-4"),
        (0.996, 0.096, "1.0(1)"),
        (-0.02, 5.0, "0(5)"),
        (9.96, 0.98, "10(1)"),
        (np.nan, np.nan, "-"),
        (3.0, 0.0, "3"),
    ],
)
def test_standard_errors_in_brackets(value, error, text):
    assert concise(value, error) == text


def test_table_goes_to_pandas_or_says_what_is_missing(no_pandas):
    found = hsnoise.budget(frames(np.random.default_rng(10), 4), exposure_s=[1.0])
    assert len(found.table) == 7
    assert found.table[0]._fields == (
        "exposure_s", "kind", "channel", "component", "variance_dn2", "standard_error_dn2", "share"
    )  # fmt: skip
    with pytest.raises(ImportError, match=r"pip install 'hsnoise\[pandas\]'"):
        found.to_pandas()


def test_pandas_has_the_table():
    pandas = pytest.importorskip("pandas")
    found = hsnoise.budget(frames(np.random.default_rng(10), 4), exposure_s=[1.0])
    data = found.to_pandas()
    assert isinstance(data, pandas.DataFrame)
    assert list(data.component) == list(COMPONENTS)


def test_memory_does_not_grow_with_frames(tmp_path, monkeypatch):
    """Sums are kept, and the counts of sampled rows, as many rows as MOST_COUNTS allows."""
    monkeypatch.setattr(sample, "MOST_COUNTS", 1 << 21)
    peaks = []
    for n in (4, 12):
        path = tmp_path / f"{n}.npy"
        stored = np.lib.format.open_memmap(path, "w+", np.uint16, (n, 1024, 2048))
        rng = np.random.default_rng(0)
        for frame in stored:
            frame[:] = rng.integers(90, 110, frame.shape, np.uint16)
        del stored
        lazy = hsnoise.FrameStack([np.load(path, mmap_mode="r")], [1.0])
        tracemalloc.start()
        hsnoise.budget(lazy)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0], peaks


def test_the_function_is_public_beside_its_module():
    code = """
import hsnoise
assert callable(hsnoise.budget) and hsnoise.NoiseBudget
from hsnoise.criticism.budget import NoiseBudget, budget
assert hsnoise.budget is budget and hsnoise.NoiseBudget is NoiseBudget
import hsnoise.criticism.budget
assert callable(hsnoise.budget)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="exposure_s"):
        hsnoise.budget(np.zeros((2, 8, 8), np.uint16))
    with pytest.raises(TypeError, match="progress"):
        hsnoise.budget(np.zeros((2, 8, 8), np.uint16), exposure_s=[1.0], progress=3)


def test_progress_is_called_after_each_frame():
    seen = []
    hsnoise.budget(frames(np.random.default_rng(11), 5), exposure_s=[1.0], progress=lambda: seen.append(1))
    assert len(seen) == 5
