"""What `improve` has found, as JSON and back: dataclasses of a fixed list, effects, models, arrays; no pickles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from typing import Any

import jax
import numpy as np

from hsnoise.chain.effect_json import effect_from_json, effect_to_json
from hsnoise.criticism.compare import Comparison
from hsnoise.criticism.finding import Diagnosis, Unexplained
from hsnoise.criticism.outcomes import Verdict
from hsnoise.criticism.ranking import Candidate
from hsnoise.criticism.shares import Share
from hsnoise.effects import AbstractEffect
from hsnoise.fitting.result import Method, Status
from hsnoise.model import NoiseModel

RECORDS = {one.__name__: one for one in (Candidate, Comparison, Diagnosis, Share, Unexplained)}
NAMES = {one.__name__: one for one in (Method, Status, Verdict)}


@dataclass(frozen=True)
class Records:
    """Values of one camera as JSON and back, each with its kind; numbers come back to the last bit.

    classes: of effects, by name; model: whose Bayer pattern, shutter and exposure all models have.
    """

    classes: Mapping[str, type[AbstractEffect]]
    model: NoiseModel

    @property
    def _camera(self) -> dict[str, Any]:
        return {name: getattr(self.model, name) for name in ("cfa", "shutter", "exposure_s")}

    def to_json(self, value: Any) -> Any:
        """Raises TypeError for what has no place in a record, such as measured arrays of the size of a sensor."""
        match value:
            case StrEnum():
                return {"name": [type(value).__name__, str(value)]}
            case None | bool() | int() | float() | str():
                return value
            case np.generic():
                return self.to_json(value.item())
            case np.ndarray():
                return {"array": value.tolist(), "dtype": str(value.dtype)}
            case NoiseModel():
                return {"model": [self.to_json(effect) for effect in value]}
            case AbstractEffect() if not value.arrays():
                (value,) = NoiseModel([value], **self._camera)  # one number for each channel
                precision = np.result_type(*(getattr(value, name).dtype for name in value.specs()), np.float32)
                return {"effect": effect_to_json(value, self.model.channels), "precision": str(precision)}
            case Mapping():
                return {"mapping": [[self.to_json(key), self.to_json(one)] for key, one in value.items()]}
        if type(value).__name__ in RECORDS:
            names = [one.name for one in fields(value)] if is_dataclass(value) else value._fields
            return {"record": type(value).__name__, "of": [self.to_json(getattr(value, name)) for name in names]}
        if isinstance(value, tuple | list):
            return [self.to_json(one) for one in value]
        raise TypeError(f"expected values of a story, got {type(value).__name__}")

    def from_json(self, value: Any) -> Any:
        """What `to_json` made JSON of; lists come back as tuples. Raises KeyError, TypeError, ValueError otherwise."""
        match value:
            case list():
                return tuple(map(self.from_json, value))
            case {"name": [kind, name]}:
                return NAMES[kind](name)
            case {"array": numbers, "dtype": dtype}:
                return np.array(numbers, dtype)
            case {"effect": item, "precision": precision}:
                with jax.enable_x64(precision == "float64"):
                    return effect_from_json(item, self.classes, self.model.channels)
            case {"model": effects}:
                with jax.enable_x64(True):  # each effect keeps its own precision
                    return NoiseModel(map(self.from_json, effects), **self._camera)
            case {"mapping": pairs}:
                return {self.from_json(key): self.from_json(one) for key, one in pairs}
            case {"record": kind, "of": of}:
                return RECORDS[kind](*map(self.from_json, of))
            case dict():
                raise ValueError(f"unknown kind of value: {', '.join(map(str, value))[:60]}")
        return value
