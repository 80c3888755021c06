"""Video in and out."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from PIL import Image

from hsnoise.video import frame_rate_of, frames_of, is_clip, write_video

FRAMES = np.stack([np.full((32, 48, 3), 40 * i, np.uint8) for i in range(5)])


def test_a_video_comes_back(tmp_path):
    pytest.importorskip("av")
    path = tmp_path / "clip.mp4"
    assert write_video(path, FRAMES, Fraction(30)) == 5
    found = np.stack(list(frames_of(path)))
    assert found.shape == FRAMES.shape and frame_rate_of(path) == 30
    assert np.abs(found.astype(int) - FRAMES).max() < 6
    assert list(tmp_path.iterdir()) == [path]


def test_odd_sizes_lose_a_row(tmp_path):
    pytest.importorskip("av")
    write_video(tmp_path / "odd.mp4", FRAMES[:, :31, :47], Fraction(25))
    assert next(frames_of(tmp_path / "odd.mp4")).shape == (30, 46, 3)


def test_folders_and_arrays(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for i, frame in enumerate(FRAMES):
        Image.fromarray(frame).save(folder / f"{i:03d}.png")
    np.savez(tmp_path / "clip.npz", frames=FRAMES)
    np.save(tmp_path / "clip.npy", FRAMES)
    for path in (folder, tmp_path / "clip.npz", tmp_path / "clip.npy"):
        assert is_clip(path)
        np.testing.assert_array_equal(np.stack(list(frames_of(path))), FRAMES)


def test_numbers_in_names_count(tmp_path):
    for i in (1, 2, 10):
        Image.fromarray(np.full((8, 8, 3), i, np.uint8)).save(tmp_path / f"frame{i}.png")
    Image.fromarray(FRAMES[0]).save(tmp_path / "._frame1.png", format="PNG")
    assert [int(frame[0, 0, 0]) for frame in frames_of(tmp_path)] == [1, 2, 10]


@pytest.mark.parametrize(("mode", "words"), [("I;16", "8 bits"), ("F", "8 bits"), ("RGBA", "alpha"), ("LA", "alpha")])
def test_images_that_are_no_display_values(tmp_path, mode, words):
    Image.new(mode, (8, 8)).save(tmp_path / "0.tif")
    with pytest.raises(ValueError, match=words):
        list(frames_of(tmp_path))


def test_bad_clips_are_told(tmp_path):
    (tmp_path / "empty").mkdir()
    np.savez(tmp_path / "grey.npz", frames=FRAMES[..., 0])
    np.savez(tmp_path / "other.npz", video=FRAMES)
    (tmp_path / "cut.npz").write_bytes((tmp_path / "other.npz").read_bytes()[:50])
    (tmp_path / "text.txt").write_text("no")
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    Image.fromarray(FRAMES[0]).save(mixed / "0.png")
    Image.fromarray(FRAMES[0, :16]).save(mixed / "1.png")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "0.png").write_bytes(b"\x89PNG no")
    for name, words in {
        "missing.mp4": "no such file",
        "empty": "no frames",
        "grey.npz": "expected frames",
        "other.npz": "array `frames`",
        "cut.npz": "array `frames`",
        "text.txt": "unknown format",
        "mixed": "frame 1 has shape",
        "broken": "cannot be read as an image",
    }.items():
        with pytest.raises(ValueError, match=words):
            list(frames_of(tmp_path / name))


def test_a_broken_video_is_told_and_none_is_left_half_written(tmp_path):
    pytest.importorskip("av")
    (tmp_path / "broken.mp4").write_bytes(b"no video at all")
    with pytest.raises(ValueError, match="cannot be read as video"):
        list(frames_of(tmp_path / "broken.mp4"))
    with pytest.raises(ValueError, match="frames: expected at least one"):
        write_video(tmp_path / "none.mp4", [], Fraction(25))
    with pytest.raises(ValueError, match="expected a video file"):
        write_video(tmp_path / "none.gif", FRAMES, Fraction(25))
    assert [path.name for path in tmp_path.iterdir()] == ["broken.mp4"]
