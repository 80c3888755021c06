"""Effects as JSON, numbers with their units."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hsnoise.effects import AbstractEffect
from hsnoise.effects._parameters import shortest


def effect_to_json(effect: AbstractEffect, channels: tuple[str, ...]) -> dict[str, Any]:
    parameters = {}
    for field, spec in effect.specs().items():
        leaf = np.asarray(getattr(effect, field))
        value = dict(zip(channels, map(shortest, leaf), strict=True)) if spec.per_channel else shortest(leaf)
        parameters[field] = {"value": value, "unit": spec.unit}
    item = {"name": effect.name, "parameters": parameters, "settings": effect.settings()}
    specs = effect.array_specs()
    arrays = {
        field: {"unit": specs[field].unit, "shape": list(value.shape), "dtype": str(value.dtype)}
        for field, value in effect.arrays().items()
    }
    return {**item, "arrays": arrays} if arrays else item


def arrays_of(effects: Iterable[AbstractEffect]) -> dict[str, np.ndarray]:
    """The measured arrays of effects, by the names that they have in files."""
    return {
        f"{effect.name}.{field}": np.asarray(value) for effect in effects for field, value in effect.arrays().items()
    }


def check_all_taken(effects: Iterable[AbstractEffect], arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError if a file holds measured arrays that no effect takes."""
    left = sorted(set(arrays) - set(arrays_of(effects)))
    if left:
        raise ValueError(f"arrays: no effect takes {', '.join(left)}.")


def effect_from_json(
    item: Mapping,
    classes: Mapping[str, type[AbstractEffect]],
    channels: tuple[str, ...],
    arrays: Mapping[str, np.ndarray] | None = None,
):
    """The effect of `item`; `arrays` are the measured ones of the whole model, by name."""
    name = item["name"]
    if name not in classes:
        raise ValueError(
            f"effect {name!r} is not built into hsnoise; pass its class: NoiseModel.load(path, effects=[MyEffect])."
        )
    specs = classes[name].specs()
    given, needed = set(item["parameters"]), set(specs) - classes[name].with_default()
    if not needed <= given <= set(specs):  # a file may be older than a parameter that has a default
        raise ValueError(f"{name}: expected parameters {sorted(specs)}, got {sorted(item['parameters'])}.")
    values = {}
    for field, spec in ((field, spec) for field, spec in specs.items() if field in given):
        one = item["parameters"][field]
        if not isinstance(one, Mapping) or not {"value", "unit"} <= set(one):
            raise ValueError(f"{name}.{field}: expected an object with value and unit, got {one!r:.60}.")
        value, unit = one["value"], one["unit"]
        if unit != spec.unit:
            raise ValueError(f"{name}.{field}: expected unit {spec.unit!r}, got {unit!r}.")
        values[field] = _of_channels(value, channels, f"{name}.{field}") if spec.per_channel else value
    _check_settings(item["settings"], classes[name])
    return classes[name](**values, **_measured(item, classes[name], arrays or {}), **item["settings"])


def _of_channels(value: Any, channels: tuple[str, ...], name: str) -> list[Any]:
    if not isinstance(value, Mapping) or set(value) != set(channels):
        got = ", ".join(map(str, value)) if isinstance(value, Mapping) else repr(value)
        raise ValueError(f"{name}: expected a value for each of {', '.join(channels)} (cfa), got {got:.60}.")
    return [value[channel] for channel in channels]


def _check_settings(given: Mapping[str, Any], cls: type[AbstractEffect]) -> None:
    known = {f.name for f in dataclasses.fields(cls)} - set(cls.specs()) - set(cls.array_specs())
    if not set(given) <= known:
        raise ValueError(f"{cls.name}: expected settings among {sorted(known)}, got {sorted(given)}.")


def _measured(item: Mapping, cls: type[AbstractEffect], arrays: Mapping[str, np.ndarray]) -> dict[str, jax.Array]:
    found = {}
    for field, stated in item.get("arrays", {}).items():
        name = f"{cls.name}.{field}"
        if field not in cls.array_specs():
            raise ValueError(f"{cls.name}: expected arrays among {sorted(cls.array_specs())}, got {field}.")
        unit = cls.array_specs()[field].unit
        if stated["unit"] != unit:
            raise ValueError(f"{name}: expected unit {unit!r}, got {stated['unit']!r}.")
        if name not in arrays:
            raise ValueError(f"{name}: expected in the file of arrays, which has {sorted(arrays) or 'none'}.")
        with jax.enable_x64(True):  # the array keeps its own precision
            found[field] = jnp.asarray(arrays[name])
    return found
