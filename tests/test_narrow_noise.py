"""Read noise below the width of a count: rounded normal noise on pixels that differ, and a real 8-bit sensor."""

from __future__ import annotations

import numpy as np
import pytest

from hsnoise.statistics.narrow_noise import narrow_read_noise


def darks(rng, sigma_dn, level_dn, spread_dn, frames=6):
    level = level_dn + spread_dn * rng.standard_normal((120, 160))
    flicker = 0.03 * rng.standard_normal((frames, 1, 1))
    return np.rint(level + flicker + sigma_dn * rng.standard_normal((frames, 120, 160))).clip(0).astype(np.uint8)


@pytest.mark.parametrize("sigma_dn", [0.12, 0.25, 0.4])
@pytest.mark.parametrize(("level_dn", "spread_dn"), [(2.88, 0.1), (10.3, 0.4), (20.0, 1.0)])
def test_noise_below_a_count_is_found_and_bounded(rng, sigma_dn, level_dn, spread_dn):
    estimate, bound = narrow_read_noise(darks(rng, sigma_dn, level_dn, spread_dn))
    assert estimate == pytest.approx(sigma_dn, rel=0.08)
    assert sigma_dn <= bound < sigma_dn + 0.2


def test_the_bound_holds_whatever_the_levels_are(rng):
    level = np.where(rng.random((120, 160)) < 0.3, 4.5, 6.1) + 0.02 * rng.standard_normal((120, 160))
    counts = np.rint(level + 0.2 * rng.standard_normal((6, 120, 160))).astype(int)
    assert 0.2 <= narrow_read_noise(counts)[1] < 0.4


def test_wide_noise_has_no_bound_of_this_kind(rng):
    assert narrow_read_noise(darks(rng, 3.0, 50.0, 1.0)) == (np.inf, np.inf)
    with pytest.raises(ValueError, match="counts: expected two frames or more"):
        narrow_read_noise(darks(rng, 0.2, 5.0, 0.1)[:1])


@pytest.mark.data
def test_the_8_bit_reference_sensor_is_below_14_electrons(shared_data):
    image = pytest.importorskip("PIL.Image")
    files = sorted((shared_data / "data/emva1288/002_CMOS_08Bit/images").glob("d_s_000_snap_*.png"))
    estimate, bound = narrow_read_noise(np.stack([np.asarray(image.open(file)) for file in files]))
    gain = 0.02063
    assert 11 < estimate / gain < 13 and estimate < bound < 14.5 * gain


def test_a_tail_that_ends_between_two_counts_is_no_matter():
    """The quantile between them was no count, none had a share, and a bare error of the optimiser came."""
    rng = np.random.default_rng(0)
    counts = np.rint(4 + 0.1 * rng.standard_normal((40, 50)) + 0.25 * rng.standard_normal((8, 40, 50)))
    counts[0].flat[:2] = 1  # two of 16000 counts: the quantile lies between them and the others
    estimate, bound = narrow_read_noise(counts)
    assert estimate == pytest.approx(0.25, abs=0.03) and bound >= estimate
