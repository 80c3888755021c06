"""Networks on disk."""

from __future__ import annotations

from functools import cache

import equinox as eqx
import jax
import numpy as np
import pytest

from hsnoise.enhance.weights import FOR_OTHERS, SHIPPED, load_network, read_arrays, save_network, write_arrays
from hsnoise.stlstm import STLSTM


@cache
def small_net():
    return STLSTM(jax.random.key(0), maps=2, kernels=(3, 5), stride=2, channels=1)


def test_a_network_comes_back_exactly(tmp_path):
    path = tmp_path / "net.eqx"
    save_network(path, small_net(), {"camera": "any"})
    net, about = load_network(path)
    for one, other in zip(jax.tree.leaves(net), jax.tree.leaves(small_net()), strict=True):
        np.testing.assert_array_equal(one, other)
    assert about["camera"] == "any" and net.kernels == small_net().kernels and net.channels == 1


@pytest.mark.parametrize(
    "damage",
    [
        lambda c: c[:-7],
        lambda c: c[:30],
        lambda c: c[:-1] + b"x",
        lambda c: b"",
        lambda c: b"\x00" * 90,
        lambda c: c.replace(b'"maps": 2', b'"maps": 3'),
        lambda c: c.replace(b'"channels": 1', b'"channels": 4').replace(b'"stride": 2', b'"stride": 1'),
        lambda c: b'{"format": "hsnoise arrays 2"}\n',
        lambda c: b'{"format": "hsnoise arrays 2", "about": {}}\n',
        lambda c: b"[" * 100_000 + b"\n",
    ],
)
def test_a_damaged_file_is_told(tmp_path, damage):
    path = tmp_path / "net.eqx"
    save_network(path, small_net(), {})
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match="truncated, or changed|not a file of weights"):
        load_network(path)


@pytest.mark.slow
def test_arrays_of_another_network_are_told(tmp_path):
    path = tmp_path / "net.eqx"
    write_arrays(path, small_net(), {})
    with pytest.raises(ValueError, match="another network"):
        read_arrays(path, STLSTM(jax.random.key(0), maps=4, kernels=(3, 5), channels=1))
    with pytest.raises(ValueError, match="holds no network; give the weights.eqx"):
        load_network(path)


def test_a_failed_write_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "net.eqx"
    save_network(path, small_net(), {})
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_network(path, small_net(), {"more": 1})
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "network",
    [
        {"maps": "4"},
        {"maps": 2.5},
        {"stride": 0},
        {"foo": 1},
        {"kernels": 3},
        {"kernels": [2]},
        {"maps": 10**30},
        [],
        3,
    ],
)
def test_headers_that_describe_no_network_are_told(tmp_path, network):
    path = tmp_path / "net.eqx"
    write_arrays(path, small_net(), {"network": network})
    with pytest.raises(ValueError, match=f"{path}: its header describes no network"):
        load_network(path)


def test_weights_that_are_not_finite_are_told(tmp_path):
    path = tmp_path / "net.eqx"
    save_network(path, eqx.tree_at(lambda net: net.output.bias, small_net(), replace_fn=lambda bias: bias * np.nan), {})
    with pytest.raises(ValueError, match="expected finite weights"):
        load_network(path)


@pytest.mark.parametrize("camera", SHIPPED)
def test_the_weights_that_come_with_hsnoise_are_read(camera):
    net, about = load_network(SHIPPED[camera])
    assert net.channels == 3 and about["camera"] == camera and FOR_OTHERS in SHIPPED
