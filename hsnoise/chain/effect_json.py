"""Effects as JSON, numbers with their units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hsnoise.effects import AbstractEffect
from hsnoise.effects._parameters import shortest


def effect_to_json(effect: AbstractEffect, channels: tuple[str, ...]) -> dict[str, Any]:
    parameters = {}
    for field, spec in effect.specs().items():
        leaf = np.asarray(getattr(effect, field))
        value = dict(zip(channels, map(shortest, leaf), strict=True)) if spec.per_channel else shortest(leaf)
        parameters[field] = {"value": value, "unit": spec.unit}
    return {"name": effect.name, "parameters": parameters, "settings": effect.settings()}


def effect_from_json(item: Mapping, classes: Mapping[str, type[AbstractEffect]], channels: tuple[str, ...]):
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
        value, unit = item["parameters"][field]["value"], item["parameters"][field]["unit"]
        if unit != spec.unit:
            raise ValueError(f"{name}.{field}: expected unit {spec.unit!r}, got {unit!r}.")
        values[field] = np.array([value[channel] for channel in channels]) if spec.per_channel else value
    return classes[name](**values, **item["settings"])
