"""Public functions take a path, a list of paths, a stack or arrays for a capture, each with keywords of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import hsnoise
from hsnoise.effects import ADC, BlackLevel, DarkCurrent, Gain, ReadNoise, ShotNoise
from hsnoise.frames.source import as_stack
from hsnoise.frames.stack import FrameStack

MODEL = hsnoise.NoiseModel(
    [ShotNoise(), DarkCurrent(400.0), ReadNoise(3.0), Gain(2.0), BlackLevel(100.0), ADC()],
    cfa="mono",
    shutter="rolling",
    exposure_s=0.1,
)
EXPOSURE_S = 0.1
NAMES = [f"dark_{i}.npy" for i in range(4)]

CALLS = {
    "inspect": hsnoise.inspect,
    "budget": hsnoise.budget,
    "summarise": hsnoise.summarise,
    "fit": hsnoise.fit,
    "log_likelihood": lambda stack, **keywords: hsnoise.log_likelihood(MODEL, stack, **keywords),
    "compare": lambda stack, **keywords: hsnoise.compare(MODEL, stack, **keywords),
    "diagnose": lambda stack, **keywords: hsnoise.diagnose(MODEL, stack, **keywords),
    "improve": lambda stack, **keywords: hsnoise.improve(stack, **keywords),
}


@pytest.fixture(scope="module")
def counts():
    return np.asarray(hsnoise.sample_dark(5, len(NAMES), (34, 40), MODEL, exposure_s=EXPOSURE_S))


@pytest.fixture(scope="module")
def folder(counts, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("darks")
    for name, frame in zip(NAMES, counts, strict=True):
        np.save(folder / name, frame)
    return folder


def sources(folder: Path):
    return {
        "folder": str(folder),
        "path": folder,
        "pattern": f"{folder}/dark_*.npy",
        "list of names": [f"{folder}/{name}" for name in NAMES],
        "tuple of paths": tuple(folder / name for name in NAMES),
    }


@pytest.mark.parametrize("kind", sources(Path()))
def test_paths_are_loaded(folder, counts, kind):
    stack = as_stack(sources(folder)[kind], exposure_s=EXPOSURE_S, black_level=3, roi=((2, 20), None))
    assert (stack.shape, stack.black_level, stack.n_frames) == ((18, 40), 3.0, (4,))
    np.testing.assert_array_equal(list(stack.frames(0)), counts[:, 2:20])


def test_stacks_and_arrays_stay_what_they_were(counts):
    stack = FrameStack(counts, EXPOSURE_S)
    assert as_stack(stack) is stack
    assert as_stack(counts, exposure_s=1.0, cfa="GBRG").cfa == "GBRG"
    several = as_stack([counts, counts[:2]], exposure_s=[0.1, 0.2])
    assert several.n_frames == (4, 2)
    assert as_stack([counts.tolist()], exposure_s=1.0).shape == stack.shape  # numbers in lists


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_every_function_loads_a_path_and_says_what_load_says(call, folder):
    for nowhere in ("no such folder", Path("no such folder"), [folder / NAMES[0], "no such folder"]):
        with pytest.raises(FileNotFoundError, match="^path: no such file or folder: no such folder$"):
            call(nowhere)
    with pytest.raises(
        ValueError, match=r"dark_0\.npy: no exposure time .*; give exposure_s=, in seconds, one for all .*_01\.tif\)$"
    ):
        call(folder)
    with pytest.raises(ValueError, match="^shutter: expected one of 'rolling', 'global', got 'leaf'$"):
        call([folder / name for name in NAMES], exposure_s=EXPOSURE_S, shutter="leaf")


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_what_is_no_capture_is_named(call, folder, counts):
    with pytest.raises(TypeError, match="^stack: expected a path, a FrameStack or an array of counts, got int$"):
        call(5)
    with pytest.raises(TypeError, match="^stack: expected a list of paths or a list of arrays, got both in one list$"):
        call([folder / NAMES[0], counts], exposure_s=EXPOSURE_S)
    with pytest.raises(TypeError, match="^photons_e: expected keywords among exposure_s, kind, .*hdu$"):
        call(folder, photons_e=3.0)
    with pytest.raises(TypeError, match="^roi: expected keywords among exposure_s, .*assumed$"):
        call(counts, exposure_s=EXPOSURE_S, roi=None)
    stack = FrameStack(counts, EXPOSURE_S)
    with pytest.raises(TypeError, match="^cfa: only go with a path or an array; a FrameStack holds them already$"):
        call(stack, cfa="RGGB")
    with pytest.raises(TypeError, match="^metod: expected keywords among "):
        call(stack, metod="ml")


@pytest.mark.slow
def test_results_of_a_path_are_those_of_its_frames(folder, counts):
    keywords = {"exposure_s": EXPOSURE_S, "black_level": 100.0}
    of_path, of_frames = (hsnoise.budget(source, **keywords) for source in (folder, counts))
    assert str(of_path) == str(of_frames) and of_path.table == of_frames.table
    assert str(hsnoise.inspect(folder, **keywords).budget) == str(hsnoise.inspect(counts, **keywords).budget)
    one, other = (float(hsnoise.log_likelihood(MODEL, source, **keywords)) for source in (folder, counts))
    assert one == other
    fits = [hsnoise.fit(source, model=MODEL, pixels="alike", **keywords) for source in (str(folder), counts)]
    assert fits[0].table == fits[1].table and fits[0].stack.shape == (34, 40)
    compared = [hsnoise.compare(MODEL, source, draws=8, **keywords) for source in (folder, counts)]
    assert compared[0].table == compared[1].table


@pytest.mark.parametrize("name", ["compare", "diagnose"])
def test_keywords_of_load_reach_the_capture(name, folder):
    with pytest.raises(ValueError, match="expected frames of at least 32 x 32 pixels, got 30 x 40"):
        CALLS[name](folder, exposure_s=EXPOSURE_S, roi=((2, 32), None))
    with pytest.raises(ValueError, match="counts: a fit needs frames of at least 8 x 8 pixels, got 6 x 40"):
        hsnoise.fit(folder, exposure_s=EXPOSURE_S, roi=((2, 8), None))
