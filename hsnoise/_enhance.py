"""The command `hsnoise enhance`: a noisy video in, an enhanced one out."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from rich.console import Console
from rich.progress import track

from hsnoise._types import channels_of
from hsnoise.io import load
from hsnoise.model import NoiseModel
from hsnoise.mosaic import electrons_of
from hsnoise.photometry import GREY, frames_of_display, light_of_frames
from hsnoise.stlstm import STLSTM, enhance
from hsnoise.video import WRITTEN, frame_rate_of, frames_of, write_video
from hsnoise.weights import load_network


def run(args: argparse.Namespace, camera: NoiseModel | None) -> None:
    """camera: of raw frames; None for a video of display values."""
    if args.out.suffix.lower() not in WRITTEN or args.out.is_dir():
        raise ValueError(f"OUT: expected a video file, ending in {', '.join(WRITTEN)}, got {args.out}")
    if not args.out.parent.is_dir():
        raise ValueError(f"OUT: there is no folder {args.out.parent}")
    if not args.brighten > 0:
        raise ValueError(f"--brighten: expected a factor above 0, got {args.brighten:g}")
    if not 0 < args.rate < np.inf:
        raise ValueError(f"--rate: expected frames a second above 0, got {args.rate:g}")
    net, about = load_network(args.weights)
    if camera is not None and len(camera.channels) != net.channels:
        raise ValueError(
            f"--weights: trained for {net.channels} channels (camera {about.get('camera')}), the camera of"
            f" {args.camera} has {len(camera.channels)}"
        )
    light = _of_display(args, net) if camera is None else _of_counts(args, camera)
    console = Console(stderr=True)
    frames = enhance(net, light, tile=args.tile)
    shown = track(frames, "Enhancing", total=None, console=console, transient=True, disable=not console.is_terminal)
    rate = frame_rate_of(args.video, args.rate)
    count = write_video(args.out, (_pixels(frame) for frame in shown), rate)
    print(f"{args.out}: {count} frames at {float(rate):g} a second")


def _of_display(args: argparse.Namespace, net: STLSTM) -> Iterator[np.ndarray]:
    for frame in frames_of(args.video):
        yield np.asarray(light_of_frames(frame, net.channels)) * args.brighten


def _of_counts(args: argparse.Namespace, camera: NoiseModel) -> Iterator[np.ndarray]:
    """Light of raw frames, of a white that makes the first frame of ordinary brightness."""
    stack = load(args.video, cfa=args.cfa, kind="flat", exposure_s=args.exposure)
    if stack.n_exposures > 1:  # they are in the order of their exposures, not of time
        raise ValueError(f"IN: expected frames of one exposure, got {', '.join(f'{t:g}' for t in stack.exposure_s)} s")
    # Gains belong to colours; the order of these in the array is that of the frames.
    cfa, exposure_s = camera.cfa if stack.cfa == "mono" else stack.cfa, float(stack.exposure_s[0])
    if channels_of(cfa) != camera.channels:
        raise ValueError(f"--camera: a model of {camera.cfa}, but the frames of {args.video} are {stack.cfa}")
    camera = NoiseModel(camera.effects, cfa=cfa, shutter=camera.shutter, exposure_s=exposure_s)
    white_e = None
    for frame in stack.frames(0):
        electrons = np.asarray(electrons_of(frame, camera))
        if white_e is None:
            if not electrons.mean() > 0:
                raise ValueError(
                    f"IN: the first frame lies {electrons.mean():.3g} e- from black, expected light; is --camera a"
                    f" model of this camera, and is its exposure {exposure_s:g} s?"
                )
            white_e = float(electrons.mean()) / (GREY * args.brighten)
        yield electrons / white_e


def _pixels(frame: np.ndarray) -> np.ndarray:
    values = frames_of_display(frame)
    return np.broadcast_to(values, (*values.shape[:2], 3))
