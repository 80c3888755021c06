"""The enhancer: its convolution, streaming, sizes, tiles and loss."""

from __future__ import annotations

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hsnoise.stlstm import (
    LAYOUT,
    STLSTM,
    Convolution,
    both_ways,
    convolve,
    enhance,
    from_blocks,
    loss,
    to_blocks,
    total_variation,
)

KEY = jax.random.key(2)


@cache
def small_net():
    return STLSTM(KEY, maps=4, kernels=(3, 5), stride=2)


def video(frames, shape, batch=1, seed=0):
    return np.random.default_rng(seed).uniform(0, 1, (frames, batch, *shape, 3)).astype(np.float32)


@pytest.mark.parametrize("kernel", [1, 3, 5])
def test_convolution_has_the_derivatives_of_xlas(kernel):
    x = jax.random.normal(KEY, (2, 7, 9, 3), jnp.float32)
    weight = jax.random.normal(KEY, (kernel, kernel, 3, 4), jnp.float32)

    def plain(x, weight):
        return jax.lax.conv_general_dilated(x, weight, (1, 1), "SAME", dimension_numbers=LAYOUT)

    np.testing.assert_allclose(convolve(x, weight), plain(x, weight), rtol=1e-5, atol=1e-5)
    found, expected = (jax.grad(lambda *a, f=f: jnp.sum(f(*a) ** 2), (0, 1))(x, weight) for f in (convolve, plain))
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3)


def test_blocks_are_undone():
    x = jax.random.normal(KEY, (2, 6, 9, 3), jnp.float32)
    np.testing.assert_array_equal(from_blocks(to_blocks(x, 3), 3), x)


def test_frame_by_frame_is_the_whole_video():
    frames = video(4, (10, 12))
    whole = small_net().video(jnp.asarray(frames))
    later = small_net().video(jnp.asarray(frames[2:]), state=small_net().after(jnp.asarray(frames[:2])))
    np.testing.assert_allclose(later, whole[2:], atol=1e-6)
    state = small_net().init_state((10, 12))
    for frame, expected in zip(frames, whole, strict=True):
        out, state = small_net()(jnp.asarray(frame), state)
        np.testing.assert_allclose(out, expected, rtol=1e-4, atol=1e-5)


def test_a_frame_depends_on_those_before_not_after():
    frames = video(3, (8, 8))
    changed = frames.copy()
    changed[1] += 0.5
    one, other = (np.asarray(small_net().video(jnp.asarray(f))) for f in (frames, changed))
    np.testing.assert_array_equal(one[0], other[0])
    assert np.abs(one[2] - other[2]).max() > 1e-5


@pytest.mark.slow
def test_checkpoint_changes_no_gradient():
    frames = jnp.asarray(video(3, (8, 8), batch=2))

    def slope(checkpoint):
        return eqx.filter_grad(lambda net: jnp.sum(net.video(frames, checkpoint=checkpoint) ** 2))(small_net())

    for one, other in zip(jax.tree.leaves(slope(True)), jax.tree.leaves(slope(False)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(rows=st.integers(1, 13), columns=st.integers(1, 13), stride=st.sampled_from([1, 2, 3]))
def test_any_size(rows, columns, stride):
    net = STLSTM(KEY, maps=2, kernels=(3,), stride=stride)
    frame = jnp.ones((rows, columns, 3))
    out, state = net(frame, net.init_state((rows, columns)))
    assert out.shape == frame.shape and np.isfinite(out).all()
    assert net(out, state)[0].shape == frame.shape


@pytest.mark.slow
def test_tiles_are_the_whole_frame_where_nothing_beyond_their_margin_is_seen():
    frames = video(2, (48, 60), seed=3)[:, 0]
    whole, tiled = (list(enhance(small_net(), frames, tile=tile, margin=24)) for tile in (None, 16))
    # In two frames the network sees 2 x (3 x 3 and its output) blocks of two pixels: less than 24 pixels.
    for one, other in zip(whole, tiled, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("tile", [None, 8])
def test_frames_that_follow_help_as_those_before(tile):
    frames = video(7, (8, 10), seed=4)[:, 0]
    net = small_net()

    def forward(some):
        return list(enhance(net, some, tile=tile))

    before, after = forward(frames), forward(frames[::-1])[::-1]
    whole = list(enhance(net, frames, tile=tile, look_ahead=7))
    np.testing.assert_allclose(whole, both_ways(np.array(before), np.array(after)), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(whole[0], (before[0] + 6 * after[0]) / 7, rtol=1e-5, atol=1e-6)  # seen: 1; at most 6
    pieces = list(enhance(net, iter(frames), tile=tile, look_ahead=2))
    assert len(pieces) == 7
    # The first two are seen with those up to the fourth.
    third = forward(frames[3::-1])[::-1][1]
    np.testing.assert_allclose(pieces[1], (2 * before[1] + 3 * third) / 5, rtol=1e-5, atol=1e-6)
    # After six frames the memory counts as full: the last of the middle has seen 4, and 4 from the end.
    sixth = forward(frames[:1:-1])[::-1][2]
    np.testing.assert_allclose(pieces[4], (5 * before[4] + 3 * sixth) / 8, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("tile", [None, 8])
def test_mirrored_frames_are_averaged_with(tile):
    frames, net = video(3, (8, 12), seed=5)[:, 0], small_net()

    def through(some, **how):
        return np.array(list(enhance(net, some, tile=tile, **how)))

    for look_ahead in (0, 3):
        plain, turned = (through(some, look_ahead=look_ahead) for some in (frames, frames[:, :, ::-1]))
        found = through(frames, look_ahead=look_ahead, mirrored=True)
        np.testing.assert_allclose(found, (plain + turned[:, :, ::-1]) / 2, rtol=1e-5, atol=1e-6)
        assert np.abs(found - plain).max() > 1e-4


def test_a_frame_leaves_as_soon_as_those_it_looks_ahead_to_are_there():
    taken = []

    def frames():
        for frame in video(9, (8, 8))[:, 0]:
            taken.append(frame)
            yield frame

    for look_ahead, most in ((0, 1), (2, 4)):
        taken.clear()
        next(enhance(small_net(), frames(), look_ahead=look_ahead))
        assert len(taken) == most
    with pytest.raises(ValueError, match="look_ahead"):
        next(enhance(small_net(), frames(), look_ahead=-1))


def test_tiles_that_the_stride_does_not_divide_are_refused():
    with pytest.raises(ValueError, match="tile, margin: expected multiples of the stride 2, got 7"):
        next(enhance(small_net(), [np.zeros((8, 8, 3))], tile=7))


@pytest.mark.slow
def test_a_few_steps_learn():
    clean = jnp.full((4, 2, 16, 16, 3), 0.5)
    noisy = clean + 0.2 * jax.random.normal(KEY, clean.shape)

    optimiser = optax.adam(1e-2)
    net, memory, values = small_net(), optimiser.init(eqx.filter(small_net(), eqx.is_array)), []

    @eqx.filter_jit
    def step(net, memory):
        value, slope = eqx.filter_value_and_grad(lambda net: loss(net.video(noisy), clean))(net)
        update, memory = optimiser.update(slope, memory)
        return value, eqx.apply_updates(net, update), memory

    for _ in range(40):
        value, net, memory = step(net, memory)
        values.append(float(value))
    assert values[-1] < 0.7 * values[0]


def test_loss_is_that_of_equation_10():
    clean, enhanced = jnp.zeros((2, 4, 5, 3)), jnp.ones((2, 4, 5, 3)).at[:, 2:].set(3.0)
    variation = 2 * 5 * 3  # one step of 2 in each of 5 columns and 3 channels
    assert float(total_variation(enhanced)) == pytest.approx(variation)
    expected = 5 * 5.0 + 2.0 + 2e-6 * variation
    assert float(loss(enhanced, clean)) == pytest.approx(expected)
    doubled = loss(enhanced, clean, perceptual=lambda frames: 2 * frames)
    assert float(doubled) == pytest.approx(expected + 0.06 * 4 * 5.0)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [({"maps": 0}, "maps"), ({"stride": 0}, "stride"), ({"kernels": (3, 4)}, "kernels"), ({"kernels": ()}, "kernels")],
)
def test_bad_sizes_are_named(arguments, name):
    with pytest.raises(ValueError, match=name):
        STLSTM(KEY, **arguments)


def test_odd_sizes_keep_their_shape():
    frame = jnp.ones((7, 9, 3))
    out, state = small_net()(frame, small_net().init_state((7, 9)))
    assert out.shape == frame.shape and np.isfinite(out).all()
    assert small_net()(out, state)[0].shape == frame.shape


@pytest.mark.parametrize("arguments", [{"maps": 2.5}, {"stride": "2"}, {"kernels": 3}, {"kernels": (3.0,)}])
def test_sizes_that_are_no_whole_numbers_are_named(arguments):
    with pytest.raises(TypeError, match=f"{next(iter(arguments))}: expected"):
        STLSTM(KEY, **arguments)


def test_even_kernels_are_refused():
    with pytest.raises(ValueError, match="kernel: expected an odd size, got 4"):
        Convolution(KEY, 4, 3, 3)


def test_frames_may_be_lists():
    frame = np.ones((8, 8, 3), np.float32)
    state = small_net().init_state((8, 8))
    np.testing.assert_array_equal(small_net()(frame.tolist(), state)[0], small_net()(frame, state)[0])
    np.testing.assert_array_equal(next(enhance(small_net(), [frame.tolist()])), next(enhance(small_net(), [frame])))


@pytest.mark.parametrize("shape", [(8, 8, 4), (8, 8), (1, 8, 8, 1), (0, 8, 3), (0, 8, 8, 3)])
def test_bad_frames_are_named(shape):
    with pytest.raises(ValueError, match="frame: expected"):
        small_net()(jnp.zeros(shape), small_net().init_state((8, 8)))


def test_state_of_another_size_is_named():
    with pytest.raises(ValueError, match="state: made for"):
        small_net()(jnp.zeros((8, 8, 3)), small_net().init_state((8, 10)))
    with pytest.raises(ValueError, match="frame 1 has shape"):
        list(enhance(small_net(), [np.zeros((8, 8, 3)), np.zeros((8, 9, 3))]))


def test_training_is_that_of_the_same_network_in_pytorch():
    """The peer of benchmarks.speed does the same work: losses of three steps of Adam agree."""
    pytest.importorskip("torch")
    from benchmarks._torch_stlstm import training_step

    rng = np.random.default_rng(0)
    noisy, clean = rng.uniform(0, 2, (2, 3, 2, 16, 32, 3)).astype(np.float32)
    net, optimiser = STLSTM(jax.random.key(0), maps=4), optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1e-2))
    step, memory = training_step(net, noisy, clean, 1e-2), optimiser.init(eqx.filter(net, eqx.is_array))
    for _ in range(3):
        value, slope = eqx.filter_value_and_grad(lambda net: loss(net.video(noisy), clean))(net)
        assert step() == pytest.approx(float(value), rel=1e-4)
        change, memory = optimiser.update(slope, memory)
        net = eqx.apply_updates(net, change)
