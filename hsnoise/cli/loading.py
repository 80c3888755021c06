"""Loading captures and models from command-line arguments."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np

from hsnoise._core.naming import as_options, named
from hsnoise._core.parsing import or_near
from hsnoise.cli.options import CAMERAS
from hsnoise.frames.io.load import load
from hsnoise.frames.lazy import LazyFrames
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel


def load_capture(paths: list[str], args: argparse.Namespace) -> FrameStack:
    """Darks, and flats if any, as one stack."""
    options = {
        "cfa": args.cfa,
        "black_level": _one_or_list(args.black_level),
        "white_level": args.white_level,
        "shutter": args.shutter,
        "row_axis": args.row_axis,
        "roi": args.roi,
        "overscan": args.overscan,
        "hdu": args.hdu,
    }
    groups = _captures(paths, exposure_s=_one_or_list(args.exposure), kind=args.kind, **options)
    if args.exposure is not None and len(args.exposure) > 1:
        for group in groups:
            _tell_exposures(group)
    if args.flats:
        with as_options({"path": "--flats", "exposure_s": "--flats-exposure"}):
            groups += _captures(args.flats, exposure_s=_one_or_list(args.flats_exposure), kind="flat", **options)
    return groups[0] if len(groups) == 1 else FrameStack.join(*groups)


def same_capture(args: argparse.Namespace) -> str:
    """Command-line words that load the capture of `args` again."""
    words = [*args.paths]
    for name in (
        "exposure",
        "kind",
        "cfa",
        "black_level",
        "white_level",
        "shutter",
        "row_axis",
        "roi",
        "overscan",
        "hdu",
    ):
        value = getattr(args, name)
        if value is not None and not (name == "row_axis" and value == 0):
            words += [f"--{name.replace('_', '-')}", _in_words(value)]
    words += ["--flats", *args.flats] if args.flats else []
    words += ["--flats-exposure", _in_words(args.flats_exposure)] if args.flats_exposure else []
    return shlex.join(words)


def _in_words(value: Any) -> str:
    """An option's value as a user types it: numbers and spans with commas."""
    if isinstance(value, tuple | list):
        spans = all(isinstance(one, tuple) for one in value)
        ends = [":".join("" if end is None else str(end) for end in one) for one in value] if spans else value
        return ",".join(one if isinstance(one, str) else f"{one:.10g}" for one in ends)
    return value if isinstance(value, str) else f"{value:.10g}"


def _tell_exposures(stack: FrameStack) -> None:
    """Print the files to which the command line's exposures were assigned, with the mean of each first frame."""
    for i, (counts, exposure_s) in enumerate(zip(stack.counts, stack.exposure_s, strict=True)):
        if isinstance(counts, LazyFrames):
            more = f" and {len(counts.names) - 1} more" if len(counts.names) > 1 else ""
            mean_dn = stack.frame(i, 0).mean()
            print(f"{exposure_s:g} s: {counts.names[0]}{more}, mean {mean_dn:.1f} DN", file=sys.stderr)


def _captures(paths: list[str], **options: Any) -> list[FrameStack]:
    """One capture from several files or folders; one each from patterns, or from folders with their own exposures."""
    is_one = all(Path(path).exists() for path in paths) and np.ndim(options["exposure_s"]) == 0
    if len(paths) > 1 and (is_one or all(Path(path).is_file() for path in paths)):
        return [load(paths, **options)]
    return [load(path, **options) for path in paths]


def model_of(name: str, argument: str = "model") -> NoiseModel:
    """A model.json or a built-in camera. Raises ValueError, naming the argument, if it is neither."""
    if name in CAMERAS:
        return CAMERAS[name]()
    if not Path(name).is_file():
        expected = f"expected a model.json or one of {', '.join(CAMERAS)}"
        raise ValueError(f"{named(argument)}: {expected}, and there is no {name}{or_near(name, CAMERAS)}")
    return NoiseModel.load(name)


def _one_or_list(numbers: list[float] | None) -> Any:
    return numbers[0] if numbers is not None and len(numbers) == 1 else numbers
