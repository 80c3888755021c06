"""The command `hsnoise enhance`: enhance a noisy video."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from hsnoise._core.folders import sweep
from hsnoise._core.output import is_one_file
from hsnoise._core.types import channels_of
from hsnoise.chain.photometry import GREY, frames_of_display, light_of_frames
from hsnoise.effects import BlackLevel
from hsnoise.enhance.mosaic import electrons_of
from hsnoise.enhance.video import VIDEO, WRITTEN, frame_rate_of, frames_of, write_video
from hsnoise.enhance.weights import FOR_OTHERS, SHIPPED, load_network
from hsnoise.frames.io.load import load
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.stlstm import STLSTM, enhance

RANGES = {"brighten": (1e-3, 1e3), "rate": (0.01, 1000.0)}
CLEAN = 1 / 16  # of the smallest variance in training: with less, the video is of another kind
BLOCK = 8  # pixels; most of a picture is uniform within a block


def run(args: argparse.Namespace, camera: NoiseModel | None) -> None:
    """camera: of raw frames; None for a video of display values."""
    _check(args)
    net, about = load_network(args.weights or SHIPPED.get(args.camera, SHIPPED[FOR_OTHERS]))
    if args.weights is None:
        print(
            f"Using the weights that come with hsnoise, trained for {about['camera']}, {_light_in_words(about)};"
            " choose others by --weights",
            file=sys.stderr,
        )
    _check_network(args, net, about, camera)
    light = _of_display(args, net) if camera is None else _of_counts(args, camera, about.get("unit_e"))
    console = Console(stderr=True)
    frames = enhance(net, _noted(light, about), tile=args.tile, look_ahead=args.look_ahead, mirrored=args.mirrored)
    shown = track(frames, "Enhancing", total=None, console=console, transient=True, disable=not console.is_terminal)
    rate = frame_rate_of(args.video, args.rate)
    sweep(args.out.parent)
    with _terminable():
        count = write_video(args.out, (_pixels(frame) for frame in shown), rate)
    print(f"{args.out}: {count} frames at {float(rate):g} a second")


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM raises an exception inside this context; otherwise a half-written file would remain."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread receives signals
        yield
        return
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _check(args: argparse.Namespace) -> None:
    """Checks that need no files to be read."""
    if args.out.suffix.lower() not in WRITTEN or args.out.is_dir():
        raise ValueError(f"OUT: expected a video file, ending in {', '.join(WRITTEN)}, got {args.out}")
    if not args.out.parent.is_dir():
        raise ValueError(f"OUT: there is no folder {args.out.parent}")
    if is_one_file(args.out, Path(args.video)):
        raise ValueError(f"OUT: expected another file than IN, got {args.out}, which would be lost")
    for option, (low, high) in RANGES.items():
        value = getattr(args, option)
        if not low <= value <= high:
            raise ValueError(f"--{option}: expected {low:g} to {high:g}, got {value:g}")
    for option in ("exposure", "cfa"):
        if args.camera is None and getattr(args, option) is not None:
            raise ValueError(f"--{option}: goes with --camera, the camera of raw frames")


def _check_network(args: argparse.Namespace, net: STLSTM, about: dict[str, Any], camera: NoiseModel | None) -> None:
    expected = (1, 3) if camera is None else (len(camera.channels),)
    if net.channels not in expected:
        of = "a video has 1 or 3" if camera is None else f"the camera of {args.camera} has {expected[0]}"
        raise ValueError(f"--weights: trained for {net.channels} channels (camera {about.get('camera')}), {of}")
    if args.tile is not None and args.tile % net.stride:
        raise ValueError(f"--tile: expected a multiple of {net.stride}, the stride of the network, got {args.tile}")


def _noted(frames: Iterable[np.ndarray], about: dict[str, Any]) -> Iterator[np.ndarray]:
    """The frames of light, with a warning if the first is far cleaner than the network's training frames.

    Training frames have at least the shot noise of the brightest scene everywhere. Differences of neighbours contain
    noise and picture, so they are never less than the noise.
    """
    for number, frame in enumerate(frames):
        if number == 0 and "unit_e" in about and _is_clean(frame, about["unit_e"]):
            warnings.warn(
                f"IN: has far less noise than the weights were trained for, {_light_in_words(about)}; the result may be"
                " worse than the input",
                stacklevel=2,
            )
        yield frame


def _light_in_words(about: dict[str, Any]) -> str:
    low, high = about["mean_e"]
    return f"scenes that average {low:.2g} to {high:.2g} photoelectrons"


def _is_clean(frame: np.ndarray, unit_e: float) -> bool:
    """Whether most blocks of light [row, column, channel] lack the shot noise of a 1 of `unit_e` electrons."""
    rows, columns = (n - n % BLOCK for n in frame.shape[:2])
    blocks = frame[:rows, :columns].reshape(rows // BLOCK, BLOCK, columns // BLOCK, BLOCK, -1)
    variance = np.mean(np.diff(blocks, axis=3) ** 2, (1, 3, 4)) / 2
    clean = variance < CLEAN * blocks.mean((1, 3, 4)) / unit_e
    return 2 * np.count_nonzero(clean) > clean.size


def _of_display(args: argparse.Namespace, net: STLSTM) -> Iterator[np.ndarray]:
    try:
        for frame in frames_of(args.video):
            yield np.asarray(light_of_frames(frame, net.channels)) * args.brighten
    except ValueError as error:
        if Path(args.video).suffix.lower() in VIDEO or not Path(args.video).exists():
            raise
        raise ValueError(f"{error}; if these are raw frames, give --camera") from error


def _of_counts(args: argparse.Namespace, camera: NoiseModel, unit_e: float | None) -> Iterator[np.ndarray]:
    """Light of raw frames in the network's unit; None, of weights that state none: the first is ordinarily bright."""
    stack = load(args.video, cfa=args.cfa, kind="flat", exposure_s=args.exposure)
    if stack.n_exposures > 1:  # they are sorted by exposure, not by time
        raise ValueError(f"IN: expected frames of one exposure, got {', '.join(f'{t:g}' for t in stack.exposure_s)} s")
    camera = _as_taken(args, camera, stack)
    white_e = None
    for frame in stack.frames(0):
        electrons = np.asarray(electrons_of(frame, camera))
        if white_e is None:
            if not electrons.mean() > 0:
                raise ValueError(
                    f"IN: the first frame lies {electrons.mean():.3g} e- from black, expected light; is --camera a"
                    f" model of this camera, and is its exposure {camera.exposure_s:g} s?"
                )
            white_e = (float(electrons.mean()) / GREY if unit_e is None else unit_e) / args.brighten
        yield electrons / white_e


def _as_taken(args: argparse.Namespace, camera: NoiseModel, stack: FrameStack) -> NoiseModel:
    """The camera with the frames' exposure, and their Bayer order and black level where known."""
    # Gains belong to colours; the frames determine the order of the colours.
    cfa = args.cfa or (camera.cfa if stack.cfa == "mono" else stack.cfa)
    if channels_of(cfa) != camera.channels:
        raise ValueError(f"--camera: a model of {camera.cfa}, but the frames of {args.video} are {cfa}")
    effects = list(camera)
    if stack.black_level is not None:
        effects = [effect for effect in effects if effect.name != BlackLevel.name] + [BlackLevel(stack.black_level)]
    return NoiseModel(effects, cfa=cfa, shutter=camera.shutter, exposure_s=float(stack.exposure_s[0]))


def _pixels(frame: np.ndarray) -> np.ndarray:
    values = frames_of_display(frame)
    return np.broadcast_to(values, (*values.shape[:2], 3))
