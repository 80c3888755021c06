"""What is no error but worth telling before long work: a mosaic read as mono, exposures that files contradict."""

from __future__ import annotations

from typing import ClassVar

import jax
import numpy as np
import pytest
import tifffile

import hsnoise
from hsnoise.cli.main import main
from hsnoise.frames.arguments import check_no_copies
from hsnoise.frames.mosaics import warn_of_a_mosaic


def darks(exposure_s=0.2):
    model = hsnoise.cameras.canon_5d3()
    return np.asarray(hsnoise.sample_dark(jax.random.key(0), 2, (160, 240), model, exposure_s=exposure_s))


@pytest.mark.parametrize("exposure_s", [0.0, 0.2])
def test_a_mosaic_read_as_mono_is_told(exposure_s):
    with pytest.warns(UserWarning, match="cfa: read as mono"):
        warn_of_a_mosaic(darks(exposure_s)[0])


@pytest.mark.parametrize("seed", range(20))
def test_rows_columns_and_hot_pixels_make_no_mosaic(seed):
    """Warnings are errors in the tests."""
    rng = np.random.default_rng(seed)
    frame = rng.poisson(5, (101, 150)) + rng.normal(0, 3, (101, 1)) + rng.normal(0, 3, (1, 150))
    frame += 2.0 * (np.arange(150) % 2)  # odd-even pattern
    frame[rng.integers(0, 101, 20), rng.integers(0, 150, 20)] += 1e4
    warn_of_a_mosaic(np.rint(frame))


def test_a_fit_tells_before_the_work_and_not_of_a_colour_sensor():
    def stop():
        raise InterruptedError

    with pytest.raises(InterruptedError):
        hsnoise.fit(hsnoise.FrameStack([darks()], [0.2], cfa="RGGB"), progress=stop)
    with pytest.warns(UserWarning, match="cfa: read as mono"), pytest.raises(InterruptedError):
        hsnoise.fit(hsnoise.FrameStack([darks()], [0.2]), progress=stop)


def test_exposures_that_files_contradict_are_told(tmp_path):
    np.savez(tmp_path / "darks.npz", counts=darks()[None], exposure_s=[0.2], cfa="RGGB")
    with pytest.warns(UserWarning, match=r"exposure_s: .*darks.npz says 0.2 s; the given 3 s are used"):
        stack = hsnoise.load(tmp_path / "darks.npz", exposure_s=3)
    assert stack.exposure_s.tolist() == [3]
    assert hsnoise.load(tmp_path / "darks.npz", exposure_s=0.2).exposure_s.tolist() == [0.2]


def test_the_command_line_tells_of_its_own_options(tmp_path, capsys):
    np.savez(tmp_path / "darks.npz", counts=darks()[None], exposure_s=[0.2])
    assert main(["compare", str(tmp_path / "darks.npz"), "--model", "canon_5d3", "--exposure", "3"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "Note: --exposure: " in said
    assert "give it --cfa and --shutter)" in said


def test_copies_are_told_across_exposures_too():
    frames = darks()
    with pytest.raises(ValueError, match=r"frame 0 of the 0.1 s exposure and frame 0 of the 0.2 s exposure are ident"):
        hsnoise.fit(hsnoise.FrameStack([frames, frames], [0.1, 0.2], cfa="RGGB"))


def test_exposures_are_told_beside_their_files_in_the_order_of_decimals(tmp_path, capsys):
    for exposure_s in (0.05, 0.1, 0.4):
        tifffile.imwrite(tmp_path / f"dark_{exposure_s}s.tif", darks(exposure_s).astype(np.uint16))
    folder = str(tmp_path)
    main(["compare", folder, "--model", "canon_5d3", "--exposure", "0.05,0.1,0.4", "--out", f"{folder}/out"])
    told = [line for line in capsys.readouterr().err.splitlines() if "dark_" in line and " s: " in line]
    assert [line.split(" s: ")[0] for line in told] == ["0.05", "0.1", "0.4"]
    assert all(f"dark_{line.split(' s: ')[0]}s.tif" in line and "mean" in line for line in told)


def test_whole_electrons_of_a_users_effect_are_taken():
    class OneMore(hsnoise.AbstractEffect):
        name: ClassVar[str] = "one_more"
        stage: ClassVar[hsnoise.Stage] = hsnoise.Stage.ELECTRONS

        def sample(self, signal, capture, *, key):
            return signal.astype(int) + 100

    model = hsnoise.cameras.grasshopper3(black_level_dn=64)
    plain, more = (
        np.asarray(hsnoise.sample_dark(jax.random.key(0), 1, (32, 32), m)).astype(float)
        for m in (model, model.add(OneMore()))
    )
    assert more.mean() - plain.mean() == pytest.approx(
        100 * np.asarray(model["gain"].value)[[0, 1, 1, 2]].mean(), rel=0.05
    )


def test_copies_are_told_in_groups_of_one_exposure():
    with pytest.raises(ValueError, match=r"frames 0 and 0 of the 0.1 s exposure are identical"):
        check_no_copies([[b"one", b"two"], [b"one", b"three"]], [0.1, 0.1])
