"""Setting aside frames that do not belong with the others, and naming them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hsnoise._core.naming import setting
from hsnoise.frames.io._kinds import folder_of, frames, names_of
from hsnoise.frames.io._recording import Recording

SAME_TEMPERATURE_K = 4.0  # frames closer than this are assumed to share offset and dark current
BINNED = (2, 3, 4)  # frames whose sides differ by one of these factors are binned
THIN = 16  # one in so many rows and columns shows whether counts are integers

Reasons = dict[int, tuple[str, str]]  # by index: how a recording differs ("of ISO 100"), and from what


@dataclass(frozen=True)
class Sorted:
    """Recordings of one region of the sensor, flats of another crop, and sentences about what was set aside."""

    main: list[Recording]
    elsewhere: list[Recording]
    told: list[str]


def sort_out(read: Sequence[Recording], root: Path) -> Sorted:
    """Set aside lights, masters, and frames of another size, binning, gain, ISO, CFA or temperature.

    Raises:
        ValueError: nothing is left, or two sizes, gains or ISOs have equally many frames.
    """
    kept, told = list(read), []
    rules: list[Callable[[list[Recording]], Reasons]] = [
        _lights,
        lambda read: _masters(read, root),
        _of_other_size,
        lambda read: _of_other("iso", "ISO {:g}", read),
        lambda read: _of_other("gain_setting", "gain {:g}", read),
        lambda read: _of_other("cfa", "CFA {}", read),
        _of_other_temperature,
    ]
    for rule in rules:
        reasons = rule(kept)
        told += _sentences(kept, reasons, root)
        kept = [recording for i, recording in enumerate(kept) if i not in reasons]
        if not kept:
            raise ValueError(
                f"{root}: no dark and no flat frames: {'; '.join(told)}; give {setting('kind')} if they are"
            )
    n = sum(r.n_frames for r in kept if _is_called_master(r, root))
    told += [f"{frames(n)} called master: are they averages? These have less noise than frames"] if n else []
    size = _main_size(kept)
    return Sorted([r for r in kept if r.size == size], [r for r in kept if r.size != size], told)


def _sentences(read: Sequence[Recording], reasons: Reasons, root: Path) -> list[str]:
    """One sentence for all frames of a folder that were set aside for the same reason."""
    groups: Counter[tuple[str, str, str]] = Counter()
    for i, (what, why) in reasons.items():
        groups[what, folder_of(read[i].path, root), why] += read[i].n_frames
    return [
        f"{frames(n)}{what}{place} {'were' if n > 1 else 'was'} set aside: {why}"
        for (what, place, why), n in groups.items()
    ]


def _lights(read: list[Recording]) -> Reasons:
    return {i: ("", "light frames are neither darks nor flats") for i, r in enumerate(read) if r.kind == "light"}


def _masters(read: list[Recording], root: Path) -> Reasons:
    why = "", "averages of several frames (masters) have less noise than frames"
    masters = [i for i, r in enumerate(read) if _is_master(r, root)]
    # Names alone do not condemn a whole capture: its folder may be called anything.
    return dict.fromkeys(masters, why) if len(masters) < len(read) or all(r.is_master for r in read) else {}


def _is_called_master(recording: Recording, root: Path) -> bool:
    return any("master" in name.lower() for name in names_of(recording.path, root))


def _is_master(recording: Recording, root: Path) -> bool:
    if recording.is_master or _is_called_master(recording, root):
        return True
    if np.dtype(recording.counts.dtype).kind != "f":
        return False
    some = np.asarray(recording.counts[0])[::THIN, ::THIN]
    some = some[np.isfinite(some)]  # NaN is no average, and is refused with the whole
    return bool((some != np.rint(some)).any())


def _of_other_size(read: list[Recording]) -> Reasons:
    """Frames of another size than most darks (or flats, if no darks), except flats of another crop."""
    size = _main_size(read)
    binning = _most_common([r for r in read if r.size == size], lambda r: r.binning)
    crops = [r for r in read if r.size != size and r.kind == "flat" and not _is_binned(r, size, binning)]
    if any(r.kind == "flat" and r.size == size for r in read):
        crops = []
    crop = _most_common(crops, lambda r: r.size)
    reasons = {}
    for i, r in enumerate(read):
        if r.size not in (size, crop) or (r.size == crop and r not in crops):
            reasons[i] = " of {} x {} pixels".format(*r.size), "the others have {} x {}".format(*size)
        elif r.binning is not None and binning is not None and r.binning != binning:
            reasons[i] = " binned {} x {}".format(*r.binning), "the others are binned {} x {}".format(*binning)
    return reasons


def _main_size(read: Sequence[Recording]) -> tuple[int, int]:
    """Size of most darks; on a tie, the size of most frames. Raises ValueError if that is a tie, too."""
    darks = [r for r in read if r.kind == "dark"] or read
    tied = _tied(darks, lambda r: r.size)
    if len(tied) > 1:
        tied = _tied([r for r in read if r.size in tied], lambda r: r.size)
    if len(tied) > 1:
        one, two = (next(r for r in read if r.size == size) for size in tied[:2])
        raise ValueError(
            f"{two.path}: frames of {two.size} pixels, those of {one.path} have {one.size}, and there are equally many"
            " of both; all frames must have one size: name the files, or the folder, of one of them"
        )
    return tied[0]


def _is_binned(recording: Recording, size: tuple[int, int], binning: tuple[int, int] | None) -> bool:
    if None not in (recording.binning, binning):
        return recording.binning != binning
    pairs = list(zip(recording.size, size, strict=True))
    return any(all(a * n == b for a, b in pairs) or all(a == b * n for a, b in pairs) for n in BINNED)


def _of_other(name: str, words: str, read: list[Recording]) -> Reasons:
    """Frames whose `name` is known and differs from the majority's. Raises ValueError without a majority."""
    known = [r for r in read if getattr(r, name) is not None]
    tied = _tied(known, lambda r: getattr(r, name))
    if len(tied) > 1:
        one, two = (next(r for r in known if getattr(r, name) == value) for value in tied[:2])
        hint = "load them separately" if name != "cfa" else f"give {setting('cfa')} or load them separately"
        raise ValueError(f"{one.path} and {two.path} differ in {name}: {tied[0]} and {tied[1]}; {hint}")
    return {
        i: (f" of {words.format(getattr(r, name))}", f"the others have {words.format(tied[0])}")
        for i, r in enumerate(read)
        if getattr(r, name) not in (None, *tied)
    }


def _of_other_temperature(read: list[Recording]) -> Reasons:
    """Frames more than SAME_TEMPERATURE_K from the temperature of most frames of their kind."""
    reasons = {}
    for kind in ("dark", "flat"):
        known = [(i, r) for i, r in enumerate(read) if r.kind == kind and r.temperature_c is not None]
        if not known:
            continue
        celsius = np.repeat([r.temperature_c for _, r in known], [r.n_frames for _, r in known])
        near = np.abs(celsius[:, None] - celsius[None]) <= SAME_TEMPERATURE_K
        usual = float(np.median(celsius[near[np.argmax(near.sum(1))]]))
        for i, r in known:
            if abs(r.temperature_c - usual) > SAME_TEMPERATURE_K:
                reasons[i] = f" at {r.temperature_c:.0f} degrees Celsius", f"other {kind}s are at {usual:.0f}"
    return reasons


def _tied(read: Sequence[Recording], key: Callable[[Recording], Hashable]) -> list:
    """The value that most frames have; on a tie, all such values."""
    n: Counter[Hashable] = Counter()
    for recording in read:
        n[key(recording)] += recording.n_frames
    return [value for value, number in n.items() if number == max(n.values())]


def _most_common(read: Sequence[Recording], key: Callable[[Recording], Hashable]):
    return next(iter(_tied(read, key)), None)
