"""Which files a path names, and how they are grouped by exposure."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from hsnoise.frames.io._files import paths_of
from hsnoise.frames.io._grouping import group_by_exposure
from hsnoise.frames.io._recording import Recording
from hsnoise.frames.io.load import load
from hsnoise.frames.lazy import LazyFrames


def dark_counts(*shape):
    return np.random.default_rng(0).poisson(100, shape).astype(np.uint16)


def read_all(stack):
    return np.stack(list(stack.frames(0)))


def test_folder_glob_list_and_file(tmp_path):
    counts = dark_counts(12, 4, 6)
    for i, frame in enumerate(counts):
        np.save(tmp_path / f"dark_{i}.npy", frame)
    (tmp_path / "notes.txt").write_text("cold night")
    (tmp_path / "._dark_0.npy").write_bytes(b"left by another system")
    for path in (
        tmp_path,
        str(tmp_path),
        f"{tmp_path}/dark_*",
        [str(tmp_path / f"dark_{i}.npy") for i in range(12)],
    ):
        np.testing.assert_array_equal(read_all(load(path, exposure_s=1)), counts)
    with pytest.raises(ValueError, match="single frame"):
        load(tmp_path / "dark_3.npy", exposure_s=1)


def test_paths_that_lead_nowhere(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file or folder: .*none.dng"):
        load(tmp_path / "none.dng")
    for path in (tmp_path, f"{tmp_path}/*.dng", []):
        with pytest.raises(FileNotFoundError, match="no capture in .*known formats: .dng"):
            load(path)
    (tmp_path / "notes.txt").write_text("cold night")
    with pytest.raises(ValueError, match="notes.txt: unknown format; known are .dng"):
        load(tmp_path / "notes.txt")
    tifffile.imwrite(tmp_path / "a.tif", dark_counts(4, 4))
    np.save(tmp_path / "a.npy", dark_counts(4, 4))
    with pytest.raises(ValueError, match=r"files of several formats \(a.npy, a.tif\)"):
        load(tmp_path)


def test_square_brackets_in_a_real_name(tmp_path):
    path = tmp_path / "dark[1].npy"
    np.save(path, dark_counts(2, 4, 4))
    assert paths_of(str(path)) == ([path], [])


@given(st.lists(st.tuples(st.sampled_from(["dark", "flat"]), st.floats(0, 100), st.floats(1, 1.0004)), min_size=1))
def test_groups(items):
    counts = LazyFrames([lambda: None], (2, 2), np.uint16)
    recordings = [
        Recording(path=str(i), counts=counts, kind=kind, exposure_s=exposure * jitter)
        for i, (kind, exposure, jitter) in enumerate(items)
    ]
    groups = group_by_exposure(recordings)
    assert sorted(int(r.path) for group in groups for r in group) == list(range(len(items)))
    keys = [(group[0].kind, min(r.exposure_s for r in group)) for group in groups]
    assert keys == sorted(set(keys))
    for group, (kind, shortest) in zip(groups, keys, strict=True):
        assert all(r.kind == kind and r.exposure_s <= shortest * 1.001 for r in group)
        assert [int(r.path) for r in group] == sorted(int(r.path) for r in group)
    for (kind, one), (other, two) in zip(keys, keys[1:], strict=False):
        assert kind != other or two > one * 1.001
