"""Files of models with one field broken: a ValueError that names the file, or the clean model."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any

import numpy as np
import pytest

import hsnoise
from hsnoise import NoiseModel

VALUES: dict[str, Any] = {
    "null": None,
    "true": True,
    "text": "a",
    "no text": "",
    "number in text": "1.0",
    "-1": -1,
    "half": 0.5,
    "1e308": 1e308,
    "400 digits": 10**400,
    "NaN": float("nan"),
    "infinity": float("-inf"),
    "list": [],
    "list of itself": [[[[1.0]]]],
    "object": {},
    "nested": {"a": {"b": [{}]}},
}


@pytest.fixture(scope="module")
def model() -> NoiseModel:
    """Effects of many kinds: numbers of channels, settings, measured arrays."""
    more = [
        hsnoise.effects.TapOffsets(2.0, taps=3),
        hsnoise.effects.MeasuredMap(np.arange(24.0).reshape(4, 6)),
        hsnoise.effects.MissingCodes(2.6),
    ]
    return NoiseModel([*hsnoise.cameras.canon_5d3(), *more], cfa="RGGB", shutter="rolling", exposure_s=0.1)


def places(content: Any, at: tuple = ()) -> Iterator[tuple[tuple, Any]]:
    """Where every value lies, and the value, outermost first."""
    for key, value in content.items() if isinstance(content, dict) else enumerate(content):
        yield (*at, key), value
        if isinstance(value, dict | list) and key != "provenance":
            yield from places(value, (*at, key))


def changed(content: Any, at: tuple, change: Callable[[Any, Any], None]) -> str:
    copy = deepcopy(content)
    inside = copy
    for key in at[:-1]:
        inside = inside[key]
    change(inside, at[-1])
    return json.dumps(copy)


def dropped(inside: Any, key: Any) -> None:
    del inside[key]


def renamed(inside: Any, key: Any) -> None:
    if isinstance(inside, dict):
        inside[f"{key} "] = inside.pop(key)
    else:
        inside.append(inside[key])


def replaced(value: Any) -> Callable[[Any, Any], None]:
    return lambda inside, key: inside.__setitem__(key, value)


CHANGES = {"dropped": dropped, "renamed": renamed, **{name: replaced(value) for name, value in VALUES.items()}}


def is_another_model(at: tuple, old: Any, name: str) -> bool:
    """Whether the change makes a valid file of another model: another number, an effect less, a setting's default."""
    if name in ("-1", "half", "1e308"):
        return isinstance(old, int | float) and not isinstance(old, bool)
    if name == "dropped":
        return at[0] == "effects" and (len(at) == 2 or at[-2:-1] == ("settings",))
    return at[-1] == "settings" and name == "object" or isinstance(old, bool) and name == "true"


def twice(text: str, key: str) -> str:
    """The first field of that name given a second time."""
    return text.replace(f'"{key}": ', f'"{key}": 0, "{key}": ', 1)


def test_one_field_that_is_broken(model, tmp_path):
    path = tmp_path / "m.json"
    model.save(path, provenance={"withheld": []})
    text = path.read_text()
    content = json.loads(text)
    files = {
        f"{at} {name}": changed(content, at, change)
        for at, old in places(content)
        for name, change in CHANGES.items()
        if not is_another_model(at, old, name)
    }
    files |= {f"{key} twice": twice(text, key) for key in content}
    wrong = []
    for name, broken in files.items():
        path.write_text(broken)
        try:
            found = NoiseModel.load(path)
        except ValueError as error:
            if str(path) not in str(error):
                wrong.append(f"{name}: names no file: {error}")
        except Exception as error:
            wrong.append(f"{name}: {error!r:.200}")
        else:
            if repr(found) != repr(model):
                wrong.append(f"{name}: another model")
    assert not wrong, f"{len(wrong)} of {len(files)}:\n" + "\n".join(wrong)
