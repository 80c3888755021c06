"""Sorting frames into darks and flats: by header, then by the names of file and folder."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hsnoise._core.naming import named, setting
from hsnoise.frames.arguments import KINDS
from hsnoise.frames.io._recording import Recording

# The order matters: a "dark flat" is a dark.
CALIBRATION = {"dark": ("dark",), "bias": ("bias", "zero", "offset"), "flat": ("flat",)}
LIT = ("linearity", "sensitivity", "ptc", "twilight")  # series of lit frames that measure a sensor
LIGHTS = ("light", "lights", "science", "sci", "object", "objects")
SECONDS = {"s": 1.0, "sec": 1.0, "secs": 1.0, "ms": 1e-3, "us": 1e-6}
EXPOSURE = re.compile(r"(?<![\d.])(\d+(?:\.\d+)?)[ _-]?(secs?|s|ms|us)(?![a-z])", re.IGNORECASE)


def kind_of(text: str | None, calibration_only: bool = False) -> str | None:
    """dark, bias, flat or light, by a word in `text`; None: no such word."""
    words = re.findall("[a-z]+", (text or "").lower())
    for kind, signs in CALIBRATION.items():
        if any(sign in word for word in words for sign in signs):
            return kind
    if any(word in LIT for word in words):
        return "flat"
    return None if calibration_only or not any(word in LIGHTS for word in words) else "light"


def names_of(path: Path, root: Path) -> list[str]:
    """Names that may reveal a file's kind: its own first, then its folders' up to `root`.

    The name of `root` counts only if it begins with a word for a kind, because users name it after anything.
    """
    folders = list(path.parent.relative_to(root).parts[::-1]) if path.is_relative_to(root) else []
    first_word = re.match("[a-z]*", root.name.lower())
    is_told = first_word is not None and kind_of(first_word[0], calibration_only=True) is not None
    return [path.stem, *folders, *([root.name] if is_told else [])]


def with_kinds(read: Sequence[Recording], given: Any, root: Path) -> tuple[list[Recording], list[str]]:
    """Recordings with kind "dark", "flat" or "light", and sentences on what was assumed.

    A bias frame is a dark, of 0 s if the file states no exposure.

    Raises:
        ValueError: `given` is neither None, one kind, nor one for each.
    """
    kinds = [given] * len(read) if given is None or isinstance(given, str) else list(given)
    if len(kinds) != len(read):
        raise ValueError(f"{named('kind')}: expected one, or {len(read)} (one a file or exposure), got {given}")
    out, reasons = [], []
    for recording, kind in zip(read, kinds, strict=True):
        if kind is not None and kind not in KINDS:
            raise ValueError(f"{recording.path}: expected kind 'dark' or 'flat', got {kind!r}; give {setting('kind')}")
        found, reason = (kind, None) if kind is not None else _told(recording, root)
        exposure_s = 0.0 if found == "bias" and recording.exposure_s is None else recording.exposure_s
        out.append(replace(recording, kind="dark" if found == "bias" else found, exposure_s=exposure_s))
        reasons.append(reason)
    return out, _sentences(read, reasons, root)


def _told(recording: Recording, root: Path) -> tuple[str, str | None]:
    """Kind of a file, and the reason in words if its header does not state it."""
    if recording.kind in CALIBRATION:
        return recording.kind, None
    if recording.kind not in (None, "light"):
        raise ValueError(
            f"{recording.path}: expected kind 'dark' or 'flat', got {recording.kind!r}; give {setting('kind')}"
        )
    names = names_of(recording.path, root)
    is_light = any(kind_of(name) == "light" for name in names)
    if is_light and recording.kind == "light":
        return "light", None
    for name in names:
        kind = kind_of(name, calibration_only=True)
        if kind is not None:
            despite = ", though the header says light" if recording.kind == "light" else ""
            what = "a bias, that is a dark of 0 s," if kind == "bias" and not recording.exposure_s else f"a {kind}"
            whose = "its" if name == recording.path.stem else "its folder's"
            return kind, f"{what} by {whose} name{despite}"
    if is_light or recording.kind == "light":
        return "light", None
    if recording.is_open:
        return "flat", "a flat, because its header says that the shutter was open"
    return "dark", "a dark, because nothing says what it is"


def _sentences(read: Sequence[Recording], reasons: Sequence[str | None], root: Path) -> list[str]:
    groups: dict[tuple[str, str], int] = {}
    for recording, reason in zip(read, reasons, strict=True):
        if reason is not None:
            key = reason, folder_of(recording.path, root)
            groups[key] = groups.get(key, 0) + recording.n_frames
    return [f"{frames(n)}{place}: {'each ' if n > 1 else ''}taken as {reason}" for (reason, place), n in groups.items()]


def frames(n: int) -> str:
    return f"{n} frame{'s' if n > 1 else ''}"


def folder_of(path: Path, root: Path) -> str:
    """ " in bias/", or empty for files in `root` itself."""
    inside = path.is_relative_to(root) and path.parent != root
    return f" in {path.parent.relative_to(root)}/" if inside else ""


def exposure_of_names(path: Path, root: Path) -> float | None:
    """Seconds in the name of a file or of its folders ("dark_0.05s", "30 s"); None if there are none."""
    for name in names_of(path, root):
        found = EXPOSURE.search(name)
        if found is not None:
            return float(found[1]) * SECONDS[found[2].lower()]
    return None
