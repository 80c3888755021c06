"""The published networks: their sizes, a property of each, and that training lowers their loss."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import hsnoise
from benchmarks._network_scores import tables
from benchmarks.networks import OURS, RIVALS, Budget, main
from benchmarks.rivals.fastdvdnet import STRIDE
from benchmarks.rivals.kpn import BURST, KERNEL, filtered
from benchmarks.rivals.layers import Noise, displayed_with_noise, noise_map_of
from benchmarks.rivals.toflow import warped
from hsnoise.chain.photometry import display_from_linear, linear_from_display
from hsnoise.enhance.training.noisy import camera_of, noisy_of

KEY = jax.random.key(3)
GREY, COLOUR = Noise((0.05,), (0.01,)), Noise((0.05, 0.03, 0.05), (0.01, 0.01, 0.02))
# In the papers or their released code, see each module.
PARAMETERS = {
    ("FFDNet", 1): 485_316,
    ("FFDNet", 3): 852_108,
    ("KPN", 1): 28_703_064,
    ("TOFlow", 3): 960_200 + 445_123,
    ("FastDVDnet", 3): 2_477_642,
}


@cache
def small(name, noise=COLOUR):
    return RIVALS[name](KEY, noise, width=1 / 8)


def descended(net, optimiser, error, keys):
    """The network after a step down the error(net, key) for each of the keys."""

    @eqx.filter_jit
    def step(net, memory, key):
        change, memory = optimiser.update(eqx.filter_grad(error)(net, key), memory)
        return eqx.apply_updates(net, change), memory

    memory = optimiser.init(eqx.filter(net, eqx.is_array))
    for key in keys:
        net, memory = step(net, memory, key)
    return net


def scene(frames=8, side=32, channels=3, seed=0):
    """A picture of blocks that moves by a pixel each frame: clean display values and noisy linear light."""
    rng = np.random.default_rng(seed)
    blocks = np.kron(rng.uniform(0.1, 0.9, (16, 16, channels)), np.ones((4, 4, 1)))
    clean = np.stack([blocks[i : i + side, :side] for i in range(frames)])[:, None].astype(np.float32)
    light = np.asarray(linear_from_display(clean))
    noisy = light + rng.normal(0, 0.1, light.shape)
    return jnp.asarray(noisy, jnp.float32), jnp.asarray(clean)


@pytest.mark.parametrize(("name", "channels"), PARAMETERS)
def test_published_sizes(name, channels):
    noise = GREY if channels == 1 else COLOUR
    net = eqx.filter_eval_shape(RIVALS[name], KEY, noise)
    leaves = jax.tree.leaves(eqx.filter(net, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct)))
    assert sum(math.prod(leaf.shape) for leaf in leaves) == PARAMETERS[name, channels]


@pytest.mark.slow
@pytest.mark.parametrize("name", RIVALS)
def test_steps_down_a_finite_slope_lower_the_loss(name):
    net, (noisy, clean) = small(name), scene(side=16)
    of_loss = eqx.filter_jit(eqx.filter_value_and_grad(lambda net: net.loss(noisy, clean, jnp.float32(0.5))))
    values = []
    for _ in range(6):
        value, slope = of_loss(net)
        values.append(float(value))
        slopes = [np.asarray(leaf) for leaf in jax.tree.leaves(slope)]
        assert all(np.isfinite(of).all() for of in slopes) and any(of.any() for of in slopes)
        length = 0.05 / np.sqrt(sum(np.sum(of**2) for of in slopes))
        net = jax.tree.map(lambda leaf, of, length=length: leaf - np.float32(length) * np.asarray(of), net, slope)
    assert values[-1] < 0.95 * values[0]


@pytest.mark.parametrize("name", RIVALS)
def test_odd_frames_keep_their_size(name):
    shape = (3, 2, 9, 11, 3)
    assert jax.eval_shape(small(name).whole_video, jax.ShapeDtypeStruct(shape, jnp.float32)).shape == shape


@pytest.mark.parametrize(
    "name", ["FastDVDnet", *(pytest.param(n, marks=pytest.mark.slow) for n in ("FFDNet", "KPN", "TOFlow"))]
)
def test_frames_beyond_the_window_do_not_matter_and_those_within_do(name):
    net, noisy = small(name), scene(frames=12)[0][:, :, :16, :16]
    video = eqx.filter_jit(net.whole_video)
    at = 5
    one = np.asarray(video(noisy))[at]
    for place, matters in ((at - net.before - 1, False), (at - net.before, True), (at + net.after + 1, False)):
        other = np.asarray(video(noisy.at[place].add(0.3)))[at]
        assert (np.abs(other - one).max() > 1e-6) == matters


def test_noise_map_is_the_noise_of_drawn_frames():
    camera = camera_of("grasshopper3", None, (20.0, 20.0))
    camera = replace(camera, model=camera.model.remove("row_gain"))  # the map leaves it out
    light = jnp.full((8, 64, 64, 3), 0.5, jnp.float32)
    noisy = noisy_of(KEY, light, camera.model, camera.model, 20.0, camera.unit_e)
    expected = np.sqrt(0.5 * np.mean(np.diff(np.asarray(noisy, float), axis=0) ** 2, (0, 1, 2)))
    found = noise_map_of(camera).sigma(jnp.full((1, 1, 3), 10.0 / camera.unit_e, jnp.float32))[0, 0]
    np.testing.assert_allclose(found, expected, rtol=0.03)


def test_noise_of_display_values_follows_the_curve():
    noise = Noise((0.0,), (1e-6,))
    light = jnp.asarray([-0.01, 0.002, 0.1, 0.5], jnp.float32).reshape(1, 4, 1)
    slope = jax.vmap(jax.grad(lambda x: display_from_linear(x)))(jnp.abs(light).reshape(-1))  # odd about black
    np.testing.assert_allclose(displayed_with_noise(light, noise)[1].reshape(-1), 1e-3 * slope, rtol=0.01)


@pytest.mark.slow
def test_ffdnet_trusts_a_frame_less_where_the_map_says_more_noise():
    """Flat frames, each with an error of its own: the best output is nearer to the mean of all, the larger the noise.

    Only the map tells how large it is.
    """
    net, optimiser = small("FFDNet", GREY), optax.adam(3e-3)

    def drawn(key):
        keys = jax.random.split(key, 3)
        sigma = jax.random.uniform(keys[0], (64, 1, 1, 1), jnp.float32, 0, 0.5)
        clean, error = (jax.random.normal(key, sigma.shape, jnp.float32) for key in keys[1:])
        clean = 0.5 + 0.2 * clean
        return (jnp.broadcast_to(of, (64, 4, 4, 1)) for of in (clean, clean + sigma * error, sigma))

    def error(net, key):
        clean, noisy, sigma = drawn(key)
        return jnp.mean((net.denoised(noisy, sigma) - clean) ** 2)

    net = descended(net, optimiser, error, jax.random.split(KEY, 250))
    _, noisy, sigma = drawn(jax.random.key(9))
    denoised = eqx.filter_jit(net.denoised)
    spread = [float(jnp.std(denoised(noisy, 0 * sigma + level))) for level in (0.02, 0.2, 0.5)]
    assert spread[0] > spread[1] > 1.3 * spread[2]


def test_kernels_that_are_one_pixel_give_that_pixel_of_that_frame():
    bursts = scene(BURST, 12)[0]
    kernels = np.zeros((1, 12, 12, BURST, KERNEL**2), np.float32)
    middle = KERNEL**2 // 2
    kernels[..., 2, middle] = 1
    kernels[..., 5, middle + 1] = 1
    out = np.asarray(filtered(bursts, jnp.asarray(kernels)))
    np.testing.assert_array_equal(out[2], bursts[2])
    np.testing.assert_array_equal(out[5, :, :, :-1], bursts[5, :, :, 1:])
    assert not out[[0, 1, 3, 4, 6, 7]].any()


def test_kernels_start_near_the_mean_of_their_pixels():
    bias = small("KPN").kernels[-1].bias
    np.testing.assert_allclose(bias.reshape(BURST, -1).sum(-1), 1, rtol=1e-6)


def test_warping_by_the_true_flow_registers_a_shifted_picture():
    picture = jnp.asarray(np.random.default_rng(0).uniform(0, 1, (1, 20, 24, 2)), jnp.float32)
    shifted = jnp.roll(picture, (2, -3), (1, 2))
    flow = jnp.broadcast_to(jnp.asarray([2.0, -3.0], jnp.float32).reshape(1, 1, 1, 2), (1, 20, 24, 2))
    inside = (slice(None), slice(0, 18), slice(3, 24))
    np.testing.assert_array_equal(warped(shifted, flow)[inside], picture[inside])
    half = warped(picture, flow * 0 + 0.5)[:, :-1, :-1]
    mean = sum(picture[:, r : r + 19, c : c + 23] for r in (0, 1) for c in (0, 1)) / 4
    np.testing.assert_allclose(half, mean, atol=1e-6)
    one_row = warped(picture[:, :1], flow[:, :1])
    np.testing.assert_array_equal(one_row[:, :, 3:], picture[:, :1, :-3])


@pytest.mark.slow
def test_flow_is_learned_from_a_shift_through_the_warping():
    """The flow network, trained by the warped picture alone, finds the motion: task-oriented flow."""
    ramp = jnp.arange(16, dtype=jnp.float32)[None, :, None, None] / 16
    middle = jnp.broadcast_to(ramp, (1, 16, 16, 3))
    other = middle + 2 / 16  # the same ramp, two rows further
    net = small("TOFlow")
    inside = (slice(None), slice(3, 12))
    np.testing.assert_array_equal(net.flow(middle, other), 0)

    def error(net, _):
        return jnp.mean((warped(other, net.flow(middle, other)) - middle)[inside] ** 2)

    net = descended(net, optax.adam(2e-3), error, [None] * 60)
    assert abs(float(jnp.median(net.flow(middle, other)[inside][..., 0])) + 2) < 0.5


def test_fastdvdnet_moves_with_its_input_by_whole_strides():
    block = small("FastDVDnet").stages[0]
    frames = list(jax.random.uniform(KEY, (3, 1, 96, 96, 3), jnp.float32))
    sigmas = [0.1 + 0 * frame[..., :1] for frame in frames]
    run = eqx.filter_jit(block)
    inside = slice(40, 56)  # beyond the reach of the zeros outside
    still = np.asarray(run(frames, sigmas))[:, inside, inside]
    for shift, same in ((STRIDE, True), (STRIDE // 2, False)):
        moved = np.asarray(run([jnp.roll(frame, shift, 1) for frame in frames], sigmas))
        assert np.allclose(moved[:, 40 + shift : 56 + shift, inside], still, atol=1e-4) == same


@pytest.mark.slow
def test_fastdvdnet_shares_triples_as_separate_windows_would():
    net, (noisy, _) = small("FastDVDnet"), scene(frames=7, side=16)
    whole = np.asarray(eqx.filter_jit(net.video)(noisy))
    window = eqx.filter_jit(net.video)
    assert len(whole) == 3
    for i in range(3):
        np.testing.assert_allclose(window(noisy[i : i + 5])[0], whole[i], atol=1e-4)


def test_differences_are_paired_over_clips():
    def result(values):
        scores = ("psnr_db", "ssim", "psnr_scaled_db", "ssim_scaled")
        # Two frames of each clip, whose mean counts.
        frames = [{"clip": name} | dict.fromkeys(scores, v + by) for name, v in values for by in (-1.0, 1.0)]
        return {"parameters": 1, "steps": 2, "minutes": 1.0, "rate": 0.1, "frames": frames}

    of = {OURS: result([("a", 20.0), ("b", 30.0)]), "KPN": result([("a", 18.0), ("b", 28.0)])}
    own, apart = tables(of, OURS)
    assert own.rows[0][5] == "25.00 +- 5.00"
    assert apart.rows == [("ST-LSTM - KPN", "+2.00 +- 0.00", "+2.000 +- 0.000", "+2.00 +- 0.00", "+2.000 +- 0.000")]
    of["again"] = result([("a", 21.0), ("b", 31.0)])
    assert [row[:2] for row in tables(of, OURS, "again")[1].rows] == [
        ("ST-LSTM - KPN", "+2.00 +- 0.00"),
        ("again - KPN", "+3.00 +- 0.00"),
    ]


def test_a_training_ends_with_its_steps_or_its_minutes():
    assert Budget(None, 4).used(2, 100.0) == 0.5
    assert Budget(10.0, None).used(2, 5.0) == 0.5
    assert Budget(10.0, 4).used(1, 5.0) == 0.5 and Budget(10.0, 4).used(3, 5.0) == 0.75
    assert Budget(6.0, 4).part(0.5) == Budget(3.0, 2)


def test_width_must_be_positive():
    with pytest.raises(ValueError, match="width: expected a number above 0, got 0"):
        RIVALS["KPN"](KEY, GREY, width=0)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--steps", "0"], "--steps: expected more than 0, got 0"),
        (["--minutes", "nan"], "--minutes: expected more than 0, got nan"),
        (["--networks"], "--networks: expected a network at least, --weights or --untrained"),
        (["--crop", "32"], "at least 64, got 0.25, 4, 32"),
        (["--rates", "-1"], "--rates: expected above 0, got [-1.0]"),
        ([], "--clips: expected a folder"),
    ],
)
def test_bad_options_are_named(tmp_path, capsys, more, words):
    with pytest.raises(SystemExit):
        main(["--clips", str(tmp_path / "none"), *more])
    assert words in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_trains_scores_and_keeps_what_is_finished(tmp_path, capsys):
    rng, clips = np.random.default_rng(0), tmp_path / "clips"
    clips.mkdir()
    for name in "abc":
        frames = np.kron(rng.integers(40, 200, (8, 16, 16, 3)), np.ones((1, 4, 4, 1))).astype(np.uint8)
        np.savez(clips / f"{name}.npz", frames=frames)
    (tmp_path / "split.toml").write_text('training = ["a"]\nvalidation = ["b"]\ntest = ["c"]\n')
    out = tmp_path / "out"
    given = ["--clips", clips, "--split", tmp_path / "split.toml", "--out", out, "--networks", "FFDNet"]
    command = [*map(str, given), "--steps", "6", "--width", "0.125", "--crop", "64", "--rates", "1e-3", "3e-3"]
    main(command)
    first = capsys.readouterr().out
    assert "FFDNet: " in first and "6 steps" in first and "| FFDNet |" in (out / "networks.md").read_text()
    scores = next(out.glob("trained-*/FFDNet.json"))
    found = json.loads(scores.read_text())
    assert {record["clip"] for record in found["frames"]} == {"c"} and found["steps"] == 6 and found["parameters"] > 0
    assert (out / "networks.csv").read_text().count("FFDNet,c,") == len(found["frames"]) == 5 * 8
    assert len(list(scores.with_suffix("").glob("c-*e.png"))) == 5
    assert (out / "networks.png").stat().st_size > 10_000 and (out / "c.png").stat().st_size > 10_000
    scores.unlink()  # as if interrupted before them
    main(command)
    again = capsys.readouterr().out
    assert "steps" not in again.split("Held-out")[0]
    assert json.loads(scores.read_text())["frames"] == found["frames"]
    main([*command, "--noise", "gaussian"])
    table = (out / "networks.md").read_text()
    assert "| FFDNet, gaussian noise |" in table and "| FFDNet |" in table  # those of earlier commands, too
    assert len((out / "networks.csv").read_text().splitlines()) == 1 + 2 * 5 * 8
    shipped = Path(hsnoise.__file__).parent / "enhance" / "data" / "enhancer_canon_5d3.eqx"
    main([*command, "--weights", str(shipped)])
    table = (out / "networks.md").read_text()
    assert "| weights |" in table and "| weights - FFDNet |" in table
