"""Video in and out."""

from __future__ import annotations

import struct
import zlib
from fractions import Fraction

import numpy as np
import pytest
import tifffile
from PIL import Image

from hsnoise.enhance.video import frame_rate_of, frames_of, is_clip, write_video

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
    with pytest.warns(UserWarning, match="30 x 46 of 31 x 47 pixels"):
        write_video(tmp_path / "odd.mp4", FRAMES[:, :31, :47], Fraction(25))
    assert next(frames_of(tmp_path / "odd.mp4")).shape == (30, 46, 3)


def test_the_same_frames_make_the_same_file(tmp_path):
    pytest.importorskip("av")
    rng = np.random.default_rng(0)
    scene = rng.integers(0, 256, (160, 160, 3))
    noisy = [np.clip(np.roll(scene, i, 1) // 2 + rng.normal(60, 10, scene.shape), 0, 255) for i in range(30)]
    path = tmp_path / "clip.mp4"
    files = set()
    for _ in range(4):
        write_video(path, [frame.astype(np.uint8) for frame in noisy], Fraction(25))
        files.add(path.read_bytes())
    assert len(files) == 1


def test_two_runs_to_one_file_do_not_meet(tmp_path):
    pytest.importorskip("av")
    path = tmp_path / "clip.mp4"

    def frames():
        yield FRAMES[0]
        write_video(path, FRAMES[:2], Fraction(25))
        yield FRAMES[1]

    assert write_video(path, frames(), Fraction(25)) == 2
    assert len(list(frames_of(path))) == 2 and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_colours_are_those_of_hd_video_and_say_so(tmp_path, suffix):
    av = pytest.importorskip("av")
    colours = np.uint8([[255, 0, 0], [0, 255, 0], [0, 0, 255], [200, 100, 50], [255, 255, 255], [0, 0, 0]])
    frame = np.repeat(np.repeat(colours[None], 32, 0), 16, 1)
    path = tmp_path / f"clip{suffix}"
    write_video(path, [frame], Fraction(25))
    with av.open(str(path)) as container:
        frame_read, tags = next(container.decode(video=0)), container.streams.video[0].codec_context
        assert (tags.colorspace, tags.color_primaries, tags.color_trc, tags.color_range) == (1, 1, 1, 1)
    luma = frame_read.to_ndarray()[16, 8:96:16]
    np.testing.assert_allclose(luma, 16 + 219 / 255 * colours @ [0.2126, 0.7152, 0.0722], atol=2)  # BT.709
    assert np.abs(next(frames_of(path)).astype(int) - frame).max() < 6


def test_phone_video_is_turned_upright(tmp_path):
    pytest.importorskip("av")
    path = tmp_path / "phone.mp4"
    top = np.zeros((32, 64, 3), np.uint8)
    top[:, :16] = 255  # left edge of the sensor: at the top once the phone is upright
    write_video(path, [top], Fraction(25))
    straight = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    clockwise = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30)
    head, _, tail = path.read_bytes().rpartition(straight)  # the last is that of the track
    path.write_bytes(head + clockwise + tail)
    upright = next(frames_of(path))
    assert upright.shape == (64, 32, 3) and upright[:12].min() > 240 and upright[20:].max() < 16


def test_images_are_turned_upright(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6  # the camera was held in portrait
    frame = np.zeros((32, 64, 3), np.uint8)
    frame[:, :16] = 255
    Image.fromarray(frame).save(tmp_path / "0.jpg", exif=exif)
    upright = next(frames_of(tmp_path))
    assert upright.shape == (64, 32, 3) and upright[:12].min() > 240 and upright[20:].max() < 16


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 3], lambda b: b[: len(b) // 2] + bytes(2000)])
def test_a_video_that_ends_early_is_told(tmp_path, damage):
    pytest.importorskip("av")
    path = tmp_path / "clip.mkv"
    frames = np.random.default_rng(0).integers(0, 256, (50, 32, 48, 3), dtype=np.uint8)
    write_video(path, frames, Fraction(25))
    assert len(list(frames_of(path))) == 50
    path.write_bytes(damage(path.read_bytes()))
    with pytest.warns(UserWarning, match=r"truncated or damaged; \d+ frames could be read, up to .* of a video of 2 s"):
        assert len(list(frames_of(path))) < 40


def test_a_longer_sound_track_is_no_loss(tmp_path):
    av = pytest.importorskip("av")
    path = tmp_path / "clip.mkv"
    with av.open(str(path), "w") as container:
        video, sound = container.add_stream("libx264", rate=25), container.add_stream("pcm_s16le", rate=8000)
        video.height, video.width, video.pix_fmt, sound.layout = 32, 48, "yuv420p", "mono"
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 32000), np.int16), format="s16", layout="mono")
        silence.rate = 8000
        for packets in [video.encode(av.VideoFrame.from_ndarray(frame)) for frame in FRAMES]:
            container.mux(packets)
        container.mux([*video.encode(), *sound.encode(silence), *sound.encode()])
    assert len(list(frames_of(path))) == 5


def test_pages_of_an_image_are_frames(tmp_path):
    pages = [Image.fromarray(frame) for frame in FRAMES]
    pages[0].save(tmp_path / "0.tif", save_all=True, append_images=pages[1:])
    np.testing.assert_array_equal(list(frames_of(tmp_path)), FRAMES)


def test_second_pictures_of_phones_are_no_frames(tmp_path):
    depth = Image.fromarray(FRAMES[0, :16])
    Image.fromarray(FRAMES[1]).save(tmp_path / "0.jpg", format="MPO", save_all=True, append_images=[depth])
    assert len(list(frames_of(tmp_path))) == 1


@pytest.mark.parametrize("name", ["0.png", "0.tif", "planes.tif"])
def test_colour_images_of_16_bits_are_refused(tmp_path, name):
    """Pillow reads them, as 8 bits."""
    image = np.full((8, 8, 3), 300, np.uint16)
    if name.endswith(".png"):
        header, rows = (
            struct.pack(">2I5B", 8, 8, 16, 2, 0, 0, 0),
            b"".join(b"\0" + row.astype(">u2").tobytes() for row in image),
        )
        parts = [(b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
        chunks = [struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in parts]
        (tmp_path / name).write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    else:
        layout = "separate" if name.startswith("planes") else "contig"
        stored = np.moveaxis(image, -1, 0) if layout == "separate" else image
        tifffile.imwrite(tmp_path / name, stored, photometric="rgb", planarconfig=layout)
    with pytest.raises(ValueError, match="8 bits"):
        list(frames_of(tmp_path))


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
    hidden = tmp_path / "._frame1.png"
    Image.fromarray(FRAMES[0]).save(hidden, format="PNG")
    assert not is_clip(hidden.rename(tmp_path / "._clip.npz")) and is_clip(tmp_path)
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
    whole = (tmp_path / "other.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[:50])
    np.savez_compressed(tmp_path / "corrupt.npz", frames=FRAMES)
    packed = bytearray((tmp_path / "corrupt.npz").read_bytes())
    packed[len(packed) // 2 : len(packed) // 2 + 40] = bytes(40)
    (tmp_path / "corrupt.npz").write_bytes(packed)
    (tmp_path / "archive.npy").write_bytes(whole)
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
        "corrupt.npz": "array `frames`",
        "archive.npy": "array `frames`",
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
    with pytest.raises(ValueError, match="at least 2 x 2 pixels"):
        write_video(tmp_path / "none.mp4", FRAMES[:, :1], Fraction(25))
    with pytest.raises(ValueError, match="frames: expected at least one"):
        write_video(tmp_path / "none.mp4", [], Fraction(25))
    with pytest.raises(ValueError, match="expected a video file"):
        write_video(tmp_path / "none.gif", FRAMES, Fraction(25))
    assert [path.name for path in tmp_path.iterdir()] == ["broken.mp4"]
