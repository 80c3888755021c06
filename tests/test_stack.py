from __future__ import annotations

import copy
import dataclasses

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hsnoise.frames.lazy import LazyFrames
from hsnoise.frames.reading import check_frame
from hsnoise.frames.source import as_stack
from hsnoise.frames.stack import FrameStack

BAYER = ("RGGB", "BGGR", "GRBG", "GBRG")


def dark_counts(*shape, mean=100, dtype=np.uint16, seed=0):
    return np.random.default_rng(seed).poisson(mean, shape).astype(dtype)


def lazy(counts):
    return LazyFrames([lambda i=i: counts[i] for i in range(len(counts))], counts.shape[1:], counts.dtype)


def read_all(stack, exposure=0):
    return np.stack(list(stack.frames(exposure)))


class Elements:
    """Array of four axes that is neither NumPy nor JAX, as Dask and HDF5 are; counts what is read."""

    def __init__(self, counts):
        self._counts, self.shape, self.dtype, self.reads = counts, counts.shape, counts.dtype, []

    def __getitem__(self, index):
        self.reads.append(index)
        return self._counts[index]


def test_one_exposure():
    counts = dark_counts(4, 6, 10)
    stack = FrameStack(counts, 0.02)
    assert stack.n_exposures == 1 and stack.n_frames == (4,) and stack.shape == (6, 10)
    assert stack.channels == ("mono",) and stack.kind == ("dark",) and stack.exposure_s.tolist() == [0.02]
    assert stack.black_level is None and stack.white_level is None and stack.photons_e is None
    np.testing.assert_array_equal(read_all(stack), counts)


def test_exposures_of_one_array_and_of_a_list_agree():
    counts = dark_counts(2, 3, 6, 10)
    one, many = FrameStack(counts, [0.1, 0.2]), FrameStack(list(counts), [0.1, 0.2])
    for i in range(2):
        np.testing.assert_array_equal(read_all(one, i), counts[i])
        np.testing.assert_array_equal(read_all(many, i), counts[i])


def test_frame_numbers_may_differ():
    stack = FrameStack([dark_counts(3, 4, 4), dark_counts(1, 4, 4)], [0.1, 0.2])
    assert stack.n_frames == (3, 1)


def test_ladder_of_single_darks():
    stack = FrameStack(dark_counts(5, 1, 4, 4), [0, 1, 2, 3, 4])
    assert stack.n_frames == (1,) * 5


@pytest.mark.parametrize(
    "stored, expected",
    [
        ("u1", "u2"),
        ("u2", "u2"),
        (">u2", "u2"),
        ("u4", "i4"),
        ("i2", "i4"),
        (">i2", "i4"),
        ("i8", "i4"),
        ("f4", "i4"),
        ("f8", "i4"),
    ],
)
def test_frames_are_plain_contiguous_integers(stored, expected):
    counts = dark_counts(2, 4, 6).astype(stored)
    for source in (counts, lazy(counts)):
        for i, frame in enumerate(FrameStack(source, 1.0).frames(0)):
            assert type(frame) is np.ndarray and frame.dtype == np.dtype(expected) and frame.dtype.isnative
            assert frame.flags.c_contiguous
            np.testing.assert_array_equal(frame, counts[i])


def test_portrait_frames_are_turned_to_sensor_orientation():
    counts = dark_counts(3, 6, 10)
    stack = FrameStack(counts, 1.0, cfa="GRBG", row_axis=1)
    assert stack.shape == (10, 6) and stack.cfa == "GBRG" and stack.channels == ("R", "G", "B")
    np.testing.assert_array_equal(read_all(stack), counts.transpose(0, 2, 1))
    assert all(frame.flags.c_contiguous for frame in stack.frames(0))


@pytest.mark.parametrize("dimensions", [3, 4])
@pytest.mark.parametrize("kind", ["jax", "memmap", "hdf5", "duck"])
def test_any_array_gives_the_same_frames(kind, dimensions, tmp_path):
    counts = dark_counts(*(2, 3, 4, 6)[4 - dimensions :])
    exposure_s = [0.1, 0.2] if dimensions == 4 else 0.1
    if kind == "hdf5":
        with h5py.File(tmp_path / "a.h5", "w") as file:
            stack = as_stack(file.create_dataset("counts", data=counts), exposure_s=exposure_s)
            result = [read_all(stack, i) for i in range(stack.n_exposures)]
    else:
        np.save(tmp_path / "a.npy", counts)
        source = {
            "jax": lambda: jnp.asarray(counts),
            "memmap": lambda: np.load(tmp_path / "a.npy", mmap_mode="r"),
            "duck": lambda: Elements(counts),
        }[kind]()
        stack = as_stack(source, exposure_s=exposure_s)
        assert stack.is_lazy(0) == (kind != "jax")
        result = [read_all(stack, i) for i in range(stack.n_exposures)]
    np.testing.assert_array_equal(result, counts.reshape(-1, *counts.shape[-3:]))


def test_lazy_pixels_are_read_only_when_iterated_and_one_frame_at_a_time():
    source = Elements(dark_counts(2, 3, 4, 6))
    stack = FrameStack(source, [0.1, 0.2], black_level=10)
    part = stack.select(rows=(1, 3), frames=slice(0, 2))
    assert source.reads == []
    frames = part.frames(1)
    assert source.reads == []
    next(frames)
    assert source.reads == [(1, 0)]
    stack.check()
    assert source.reads == [(1, 0), (0, 0), (1, 0)]


def test_lazy_frames():
    counts = dark_counts(5, 4, 6)
    frames = lazy(counts)
    assert frames.shape == (5, 4, 6) and frames.dtype == np.uint16 and len(frames) == 5
    np.testing.assert_array_equal(frames[-1], counts[-1])
    part = frames[1:5:2]
    assert isinstance(part, LazyFrames) and part.shape == (2, 4, 6)
    np.testing.assert_array_equal(np.stack(list(part)), counts[1:5:2])
    with pytest.raises(IndexError):
        frames[5]
    with pytest.raises(ValueError, match=r"frame 0: read \(4, 6\) pixels, expected \(4, 8\)"):
        LazyFrames([lambda: counts[0]], (4, 8), np.uint16)[0]


SHAPES = {
    "one frame": (dark_counts(4, 4), r"got ndarray with shape \(4, 4\)"),
    "list of frames": (list(dark_counts(3, 4, 4)), r"got list with shape \(4, 4\)"),
    "five axes": (dark_counts(1, 1, 2, 4, 4), r"got ndarray with shape \(1, 1, 2, 4, 4\)"),
    "number": (7, r"got int with shape \(\)"),
    "nothing": ([], "at least one exposure"),
    "single frame": (dark_counts(1, 4, 4), "single frame"),
    "no frames": (dark_counts(0, 4, 4), "none may be empty"),
    "no columns": (dark_counts(2, 4, 0), "none may be empty"),
    "sizes differ": ([dark_counts(2, 4, 4), dark_counts(2, 4, 6)], r"one size, got \[\(4, 4\), \(4, 6\)\]"),
}


@pytest.mark.parametrize("counts, message", SHAPES.values(), ids=SHAPES)
def test_wrong_shapes(counts, message):
    n = len(counts) if isinstance(counts, list) else 1
    with pytest.raises(ValueError, match=message):
        FrameStack(counts, np.ones(n))


@pytest.mark.parametrize("dtype", [bool, complex, object, "U4"])
def test_wrong_dtypes(dtype):
    with pytest.raises(TypeError, match="counts: expected integers"):
        FrameStack(dark_counts(2, 4, 4).astype(dtype), 1.0)


def with_pixel(value, dtype=np.float64):
    counts = dark_counts(2, 4, 6).astype(dtype)
    counts[1, 2, 3] = value
    return counts


VALUES = {
    "NaN": (with_pixel(np.nan), "NaN"),
    "infinity": (with_pixel(np.inf), "infinity"),
    "fraction": (with_pixel(0.5), "do not normalise"),
    "negative": (with_pixel(-1, np.int32), "subtracting a dark makes counts negative; give the raw frames"),
    "negative float": (with_pixel(-1), "subtracting a dark makes counts negative"),
    "too large": (with_pixel(2**31, np.int64), "31 bits"),
    "zero": (np.stack([dark_counts(4, 6), np.zeros((4, 6), np.uint16)]), "all zero"),
    "constant": (np.stack([dark_counts(4, 6), np.full((4, 6), 7, np.uint16)]), "all 7"),
    "saturated": (
        np.stack([dark_counts(4, 6), 1000 + dark_counts(4, 6)]),
        "100% of the pixels reach white_level 1000",
    ),
}


@pytest.mark.parametrize("counts, message", VALUES.values(), ids=VALUES)
def test_wrong_values_name_the_frame(counts, message):
    with pytest.raises(ValueError, match=message) as error:
        FrameStack(counts, 1.0, white_level=1000)
    assert "frame 1 of dark exposure 0 (1 s)" in str(error.value)


@pytest.mark.parametrize("counts, message", VALUES.values(), ids=VALUES)
def test_wrong_lazy_values_show_when_the_frame_is_read(counts, message):
    frames = FrameStack(lazy(counts), 1.0, white_level=1000).frames(0)
    next(frames)
    with pytest.raises(ValueError, match=message) as error:
        next(frames)
    assert "frame 1" in str(error.value)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("level", [0.0, 4.0])
def test_counts_that_wrapped_below_zero_are_refused(kind, level, rng):
    """A bias subtracted in unsigned integers: the fit had ended in "SVD did not converge"."""
    counts = np.round(level + 3 * rng.standard_normal((4, 64, 96))).astype(np.int32).astype(kind)
    with pytest.raises(
        ValueError, match=r"frame 0 of dark exposure 0 .* of the counts lie just below .* wrapped around"
    ):
        FrameStack(counts, 1.0)


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_counts_that_wrapped_in_fewer_bits_are_refused(bits, rng):
    counts = np.round(3 * rng.standard_normal((4, 64, 96))).astype(np.int32) % 2**bits
    with pytest.raises(ValueError, match=f"of the counts lie just below {2**bits} and the others near 0"):
        FrameStack(counts.astype(np.uint16), 1.0)


def test_bright_flats_with_dark_columns_have_not_wrapped(rng):
    counts = np.round(3900 + 30 * rng.standard_normal((4, 64, 96))).astype(np.uint16)
    counts[:, :, :2] = rng.integers(0, 3, (4, 64, 2))
    FrameStack(counts, 1.0, kind="flat")


def test_dark_frames_of_a_clamped_black_with_columns_that_saturate_have_not_wrapped(rng):
    counts = np.maximum(np.round(3 * rng.standard_normal((4, 64, 96))), 0).astype(np.uint16)
    counts[:, :, :2] = 4000
    FrameStack(counts, 1.0)


@pytest.mark.parametrize("hot", [65535, 64000])
def test_hot_pixels_that_saturate_have_not_wrapped(hot, rng):
    counts = np.round(100 + 3 * rng.standard_normal((4, 64, 96))).astype(np.uint16)
    counts[:, :2] = hot
    FrameStack(counts, 1.0)


def test_half_saturated_is_allowed_and_more_is_not():
    counts = dark_counts(2, 4, 4)
    counts[:, :2] = 1000
    assert FrameStack(counts, 1.0, white_level=1000).white_level == 1000
    counts[:, 2, 0] = 1001
    with pytest.raises(ValueError, match="56% of the pixels"):
        FrameStack(counts, 1.0, white_level=1000)


def test_check_frame_of_a_later_pass():
    stack = FrameStack(lazy(dark_counts(2, 4, 4)), 1.0)
    with pytest.raises(ValueError, match="frame 1: counts are all zero"):
        check_frame(np.zeros((4, 4), np.uint16), stack, exposure=0, frame_number=1)


ARGUMENTS = {
    "no exposure": ({"exposure_s": None}, "exposure_s is missing"),
    "few exposures": ({"exposure_s": [1.0]}, "exposure_s: expected 2"),
    "scalar exposure": ({"exposure_s": 1.0}, "exposure_s: expected 2"),
    "negative exposure": ({"exposure_s": [1.0, -1.0]}, "exposure_s: expected finite"),
    "NaN exposure": ({"exposure_s": [1.0, np.nan]}, "exposure_s: expected finite"),
    "infinite exposure": ({"exposure_s": [1.0, np.inf]}, "exposure_s: expected finite"),
    "cfa": ({"cfa": "RGBG"}, "cfa: expected one of 'mono', 'RGGB'"),
    "cfa not text": ({"cfa": 3}, "cfa: expected one of"),
    "shutter": ({"shutter": "leaf"}, "shutter: expected one of 'rolling', 'global', got 'leaf'"),
    "kind": ({"kind": "light"}, "kind: expected one of 'dark', 'flat', got 'light'"),
    "kinds": ({"kind": ["dark"]}, r"kind: expected one, or 2"),
    "bias": ({"kind": "bias"}, "a bias frame is a dark of 0 s"),
    "row_axis": ({"row_axis": 2}, "row_axis: expected one of 0, 1"),
    "negative black": ({"black_level": -1}, "black_level: expected finite"),
    "NaN black": ({"black_level": np.nan}, "black_level: expected finite"),
    "blacks": ({"black_level": [1, 2]}, r"black_level: expected 1 \(one for each channel\)"),
    "black over white": ({"black_level": 300, "white_level": 200}, "black_level must lie below white_level"),
    "black at white": ({"black_level": 200, "white_level": 200}, "black_level must lie below white_level"),
    "white": ({"white_level": 0}, "white_level: expected a number > 0"),
    "black over data": ({"black_level": 150}, "black_level 150 DN lies above the data"),
    "photons without flats": ({"photons_e": [1.0, 2.0]}, "photons_e: belongs to flat exposures only"),
    "photons": ({"photons_e": [1.0, 2.0, 3.0], "kind": "flat"}, "photons_e: expected 2"),
    "negative photons": ({"photons_e": [1.0, -2.0], "kind": "flat"}, "photons_e: expected finite"),
    "iso": ({"iso": -100}, "iso: expected finite"),
    "temperatures": ({"temperature_c": [1.0, 2.0, 3.0]}, "temperature_c: expected 2"),
}


@pytest.mark.parametrize("changes, message", ARGUMENTS.values(), ids=ARGUMENTS)
def test_wrong_arguments(changes, message):
    arguments = {"exposure_s": [0.1, 0.2], **changes}
    with pytest.raises(ValueError, match=message):
        FrameStack(dark_counts(2, 2, 6, 6), **arguments)


def test_text_for_a_number():
    with pytest.raises(TypeError, match="exposure_s: expected numbers, got 'long'"):
        FrameStack(dark_counts(2, 4, 4), "long")


@pytest.mark.parametrize("shape", [(5, 4), (4, 5)])
def test_bayer_frames_have_even_sides(shape):
    with pytest.raises(ValueError, match="even numbers of rows and columns"):
        FrameStack(dark_counts(2, *shape), 1.0, cfa="RGGB")
    assert FrameStack(dark_counts(2, *shape), 1.0, cfa=None).cfa == "mono"


def test_black_level_may_lie_below_noise_but_not_above():
    counts = [dark_counts(2, 50, 50, mean=400), dark_counts(2, 50, 50, mean=900)]
    for level in (0, 400, 415, 900):  # 900: some exposure reaches it; 20 DN is the noise at 400
        assert FrameStack(counts, [1, 2], black_level=level).black_level == level
    with pytest.raises(ValueError, match="at most 90[0-9] DN|at most 89[0-9] DN"):
        FrameStack(counts, [1, 2], black_level=1000)


def test_black_level_of_each_channel_meets_its_own_pixels():
    counts = dark_counts(2, 20, 20)
    counts[:, ::2, ::2] += 500  # the red pixels
    np.testing.assert_array_equal(
        FrameStack(counts, 1.0, cfa="RGGB", black_level=[550, 50, 60]).black_level, [550, 50, 60]
    )
    with pytest.raises(ValueError, match="black_level 550 DN lies above the data: the median of channel B"):
        FrameStack(counts, 1.0, cfa="RGGB", black_level=[550, 50, 550])


def test_check_finds_a_black_level_above_lazy_data():
    stack = FrameStack(lazy(dark_counts(2, 10, 10)), 1.0, black_level=200)
    with pytest.raises(ValueError, match="black_level 200 DN lies above the data"):
        stack.check()


def test_photons_of_flats():
    counts = dark_counts(3, 2, 4, 4)
    kind = ["dark", "flat", "flat"]
    for photons_e in ([50.0, 60.0], [np.nan, 50.0, 60.0]):
        stack = FrameStack(counts, [1, 1, 2], kind=kind, photons_e=photons_e)
        np.testing.assert_array_equal(stack.photons_e, [np.nan, 50.0, 60.0])


def test_stack_is_frozen():
    stack = FrameStack(dark_counts(2, 4, 4), 1.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        stack.cfa = "RGGB"
    with pytest.raises(ValueError):
        stack.exposure_s[0] = 2
    np.testing.assert_array_equal(read_all(copy.deepcopy(stack)), read_all(stack))


def test_repr():
    stack = FrameStack(
        [dark_counts(2, 4, 6), dark_counts(1, 4, 6)],
        [0.02, 5],
        cfa="RGGB",
        black_level=64,
        white_level=4095,
        kind=["dark", "flat"],
        temperature_c=[20, np.nan],
        photons_e=30,
        iso=800,
    )
    assert repr(stack) == (
        "FrameStack: 3 frames of 4 rows x 6 columns, RGGB, rolling shutter, ISO 800\n"
        "  black level 64.0 DN, white level 4095 DN\n"
        "  dark      0.02 s  2 frames, 20.0 degrees Celsius\n"
        "  flat         5 s  1 frame, 30 photoelectrons per pixel"
    )


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(1, 3), st.integers(1, 3)), max_size=3), st.data())
def test_any_list_of_integer_arrays_gives_a_stack_or_a_clear_error(shapes, data):
    values = st.integers(-2, 70000)
    counts = [
        np.array(data.draw(st.lists(values, min_size=a * b * c, max_size=a * b * c)), int).reshape(a, b, c)
        for a, b, c in shapes
    ]
    try:
        stack = FrameStack(counts, np.arange(len(counts)))
    except ValueError as error:
        assert str(error).startswith("counts")
    else:
        assert len({shape[1:] for shape in shapes}) == 1 and sum(stack.n_frames) >= 2
        assert all((read_all(stack, i) == counts[i]).all() and counts[i].min() >= 0 for i in range(len(counts)))
