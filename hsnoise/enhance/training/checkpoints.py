"""Checkpoints of a training run: the last two are kept, and a truncated one is replaced by the one before."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hsnoise.enhance.weights import read_arrays, write_arrays

KEPT = 2


def path_of(folder: Path, step: int) -> Path:
    return folder / f"checkpoint-{step:08d}.eqx"


def checkpoints(folder: Path) -> list[Path]:
    """The checkpoints in a folder, newest first."""
    return sorted(folder.glob("checkpoint-*.eqx"), reverse=True)


def write(folder: Path, step: int, tree: Any, about: dict[str, Any]) -> Path:
    """Write a checkpoint, then remove all but the last two.

    Raises:
        OSError: the disk is full; earlier checkpoints are left as they were.
    """
    path = path_of(folder, step)
    try:
        write_arrays(path, tree, {**about, "step": step})
    except OSError as error:
        raise OSError(
            error.errno, f"checkpoint not written ({error.strerror}); the last one is intact", str(path)
        ) from error
    for old in checkpoints(folder)[KEPT:]:
        old.unlink()
    return path


def read_newest(folder: Path, like: Any, say=print) -> tuple[Any, dict[str, Any]] | None:
    """Tree and description of the newest intact checkpoint; None if there is none.

    If the only checkpoint is truncated, the run starts over, with a message.

    Raises:
        ValueError: there are several checkpoints, and none can be read.
    """
    found, damaged = checkpoints(folder), []
    for path in found:
        try:
            result = read_arrays(path, like)
        except ValueError as error:
            instead = "using the one before" if path != found[-1] else "there is none before it"
            say(f"{error}; {instead}")
            damaged.append(path)
            continue
        set_aside(damaged)
        return result
    if len(found) == 1:
        set_aside(damaged)
    elif found:
        raise ValueError(f"{folder}: none of its {len(found)} checkpoints can be read; remove them to start over")
    return None


def set_aside(damaged: list[Path]) -> None:
    """Rename them; otherwise they would count as the last two."""
    for path in damaged:
        path.rename(path.with_suffix(".damaged"))
