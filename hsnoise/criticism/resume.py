"""A story of `improve` on disk, and how it goes on from there.

Fits hold the frames and their histograms. These are not written: the first fit is made again, in seconds, and what took
draws is read.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hsnoise._core.naming import named
from hsnoise._core.output import write_atomically
from hsnoise.criticism.records import Records
from hsnoise.criticism.story import Step, Story
from hsnoise.effects import EFFECTS, AbstractEffect
from hsnoise.fitting.result import FitResult, Method, Status
from hsnoise.model import NoiseModel

FORMAT, FORMAT_VERSION = "hsnoise story", 1
OF_FRAMES = ("summary", "transfer", "stack")  # of a fit, made again from the frames
OF_FIT = tuple(one.name for one in fields(FitResult) if one.name not in OF_FRAMES)
OF_STEP = tuple(one.name for one in fields(Step) if one.name != "fit")
SAME = 1e-6  # relative: numbers of one fit on two machines

Refit = Callable[[NoiseModel | None, bool], FitResult]


def write_story(path: str | os.PathLike, story: Story) -> None:
    """Write the steps of a story, all or nothing. Raises TypeError for a model with measured arrays."""
    model = story.steps[0].fit.params
    to_json = Records({}, model).to_json
    content = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "seed": story.seed,
        "cfa": model.cfa,
        "shutter": model.shutter,
        "exposure_s": model.exposure_s,
        "steps": [
            {
                "fit": {name: to_json(getattr(step.fit, name)) for name in OF_FIT},
                **{name: to_json(getattr(step, name)) for name in OF_STEP},
            }
            for step in story.steps
        ],
    }
    write_atomically(path, (json.dumps({**content, "sha256": _hash(content)}) + "\n").encode())


class Stored(NamedTuple):
    """What a file of a story holds: of each step, what is not of its fit, and what is."""

    path: Path
    steps: list[dict[str, Any]]
    fits: list[dict[str, Any]]


def read_story(path: str | os.PathLike, seed: int, own: Iterable[type[AbstractEffect]]) -> Stored:
    """The story that `write_story` wrote, before anything is fitted.

    Args:
        path: the file. seed: of its draws. own: classes of effects that are not built into hsnoise.

    Raises:
        FileNotFoundError, ValueError: if there is no such file, it is no story, or it is of another seed.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT or content["format_version"] != FORMAT_VERSION:
            raise ValueError("its format is another")
        if content.pop("sha256") != _hash(content):
            raise ValueError("it was changed")
        of = {name: content[name] for name in ("cfa", "shutter", "exposure_s")}
        records = Records({one.name: one for one in (*EFFECTS, *own)}, NoiseModel((), **of))
        steps = [{name: records.from_json(step[name]) for name in OF_STEP} for step in content["steps"]]
        fits = [{name: records.from_json(step["fit"][name]) for name in OF_FIT} for step in content["steps"]]
        if not fits:
            raise ValueError("it has no steps")
    except (AttributeError, KeyError, OverflowError, RecursionError, TypeError, ValueError) as error:
        expected = "expected a story that improve saved, as this version writes it"
        raise ValueError(f"{path}: {expected} ({error!s:.80}); begin anew without {named('resume')}") from error
    if content["seed"] != seed:
        raise ValueError(f"seed: expected {content['seed']}, with which {path} was begun, got {seed}")
    return Stored(path, steps, fits)


def steps_of(stored: Stored, refit: Refit, given: NoiseModel | None) -> list[Step]:
    """The steps of a story, with their frames.

    Args:
        stored: the story. refit: fits the same frames again, with the effects of a model, and following each pixel if
            asked for. given: the model at which the story started, None for the paper's.

    Raises:
        ValueError: if the story is of other frames, or of another model.
    """
    base = refit(given, stored.fits[0]["status"] == Status.NEARER)
    _check_same(stored.path, base, stored.fits[0]["params"])
    measured, found = set(base.added), []
    for step, of_fit in zip(stored.steps, stored.fits, strict=True):
        if step["added"] not in {None, *measured} and of_fit["method"] != Method.SYNTHETIC:
            base = refit(of_fit["params"], False)
        found.append(Step(fit=FitResult(**of_fit, **{name: getattr(base, name) for name in OF_FRAMES}), **step))
    return found


def _hash(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _check_same(path: Path, base: FitResult, stored: Any) -> None:
    """Raise ValueError unless the first fit is what it was."""
    again = base.without(base.added).params.table
    before = stored.table if isinstance(stored, NoiseModel) else {}
    if again.keys() != before.keys() or not all(np.isclose(again[name][0], before[name][0], SAME) for name in before):
        raise ValueError(
            f"{named('resume')}: the first fit comes out differently from that of {path}, which was begun with other"
            " frames, another model or another version of hsnoise; give those, or begin anew in another folder"
        )
