"""The command `hsnoise enhance`: a noisy video in, an enhanced one out."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from rich.console import Console
from rich.progress import track

from hsnoise.io import load
from hsnoise.model import NoiseModel
from hsnoise.mosaic import electrons_of
from hsnoise.photometry import GREY, frames_of_display, light_of_frames
from hsnoise.stlstm import STLSTM, enhance
from hsnoise.video import VIDEO, frame_rate_of, frames_of, write_video
from hsnoise.weights import load_network


def run(args: argparse.Namespace, camera: NoiseModel | None) -> None:
    """camera: of raw frames; None for a video of display values."""
    if args.out.suffix.lower() not in VIDEO:
        raise ValueError(f"OUT: expected a video file, ending in {', '.join(VIDEO)}, got {args.out}")
    if not args.out.parent.is_dir():
        raise ValueError(f"OUT: there is no folder {args.out.parent}")
    if not args.brighten > 0:
        raise ValueError(f"--brighten: expected a factor above 0, got {args.brighten:g}")
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
    stack = load(args.video, cfa=camera.cfa, kind="flat", exposure_s=camera.exposure_s)
    white_e = None
    for group, count in enumerate(stack.n_frames):
        for number in range(count):
            electrons = np.asarray(electrons_of(stack.frame(group, number), camera))
            if white_e is None:
                white_e = max(float(electrons.mean()), 1e-3) / (GREY * args.brighten)
            yield electrons / white_e


def _pixels(frame: np.ndarray) -> np.ndarray:
    values = frames_of_display(frame)
    return np.broadcast_to(values, (*values.shape[:2], 3))
