"""PSNR and SSIM of a trained enhancer and its rivals on held-out clips: the command `hsnoise evaluate`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import equinox as eqx
import numpy as np
from rich.console import Console
from rich.progress import track
from skimage.metrics import structural_similarity

from hsnoise._core.folders import made
from hsnoise._core.output import write_atomically, write_figure
from hsnoise.chain.photometry import display_from_linear
from hsnoise.enhance.training.clips import Clip, check_sizes, read_clips, source_of
from hsnoise.enhance.training.noisy import Camera, camera_of
from hsnoise.enhance.training.protocol import OPTICS, PROTOCOL, scaled_to
from hsnoise.enhance.training.rivals import Denoiser, denoised, not_installed, rivals, tuned
from hsnoise.enhance.training.scenes import Scene, scene_of
from hsnoise.enhance.training.split import Split, split_of
from hsnoise.enhance.training.steps import digest_of
from hsnoise.enhance.training.tables import (
    AT_BEST,
    OURS,
    REFER,
    SCALED,
    SHOWN_FRAMES,
    as_csv,
    draw_curves,
    draw_frames,
    memory_sheet,
    tables,
)
from hsnoise.enhance.training.validation import psnr_db
from hsnoise.enhance.weights import load_network
from hsnoise.stlstm import STLSTM, both_ways

LEVELS = 3
LEAST_CROP, LEAST_FRAMES = 8, 3
Method = Callable[[Scene], np.ndarray]  # from a scene to display values


def scores(method: str, scene: Scene, found: np.ndarray) -> list[dict]:
    """PSNR and SSIM of each frame of display values, 0 to 1."""
    return [
        {
            "method": method,
            "clip": scene.clip,
            "mean_e": scene.mean_e,
            "frame": i,
            "psnr_db": psnr_db(one, clean),
            "ssim": float(structural_similarity(one, clean, channel_axis=-1, data_range=1.0)),
        }
        for i, (one, clean) in enumerate(zip(found, scene.clean, strict=True))
    ]


def camera_for(about: dict, options: argparse.Namespace) -> Camera:
    """The camera and light to score with: as the options say, or else those that the weights were trained for.

    Raises:
        ValueError: weights for a camera that is not built in, without its file; others as in `camera_of`.
    """
    name = options.camera or about.get("camera")
    if options.camera is None and name not in OPTICS:
        raise ValueError(f"--camera: the weights were trained for {name}, which is not built in; give its model.json")
    mean_e = options.mean_e
    if mean_e is None and options.lux is None and "mean_e" in about:
        mean_e = tuple(about["mean_e"])
    sensor = options.sensor or (tuple(about["sensor"]) if about.get("sensor") else None)
    camera = replace(camera_of(name, options.lux, mean_e, options.exposure), sensor=sensor)
    if about.get("digests", {}).get("camera") != digest_of(camera.model):
        _note(f"{options.weights} was trained for other noise than that of {camera.name}, on which it is scored")
    return camera


def check_weights(path: Path, net: STLSTM, about: dict, camera: Camera, scored: Sequence[Clip]) -> None:
    """Raise ValueError for weights with a wrong number of channels, or trained on clips to be scored."""
    if net.channels != camera.channels:
        raise ValueError(f"{path}: weights for {net.channels} channels, camera {camera.name} has {camera.channels}")
    if "clips" not in about:
        _note(f"{path} does not say which clips it was trained on; those scored may be among them")
    names, digests = (set(map(source_of, about.get("clips", ()))), about.get("trained_on", ()))
    seen = sorted({clip.source for clip in scored if clip.source in names or digest_of(clip.frames) in digests})
    if seen:
        raise ValueError(f"--clips: expected clips that {path} was not trained on, got {', '.join(seen)}")


def note_protocol(path: Path, about: dict) -> None:
    """Say under which protocol weights were trained, if it is not that of the scores."""
    if about.get("protocol") != PROTOCOL:
        _note(f"{path} was trained by {about.get('protocol', 'an unknown protocol')}, and is scored by {PROTOCOL!r}")


def while_memory_fills(net, scene: Scene) -> dict[str, list[float]]:
    """PSNR of the nth frame that the network sees, dB, n from 1, on the same frames for each n; as it is, and scaled.

    The network starts over at each frame of the video (a long one is cut far beyond the network's memory). Only the
    second half is scored.
    """
    n = min(len(scene.noisy), 2 * SHOWN_FRAMES[-1])
    most = (n + 1) // 2
    places = np.minimum(np.arange(most)[:, None] + np.arange(n), n - 1)  # [seen, begun at]
    found = net(scene.noisy[places])
    scaled = np.stack([scaled_to(found[:, begun], scene.clean[places[:, begun]]) for begun in range(n)], 1)
    scored = range(most - 1, n)
    return {
        name: [float(np.mean([psnr_db(of[seen, f - seen], scene.clean[f]) for f in scored])) for seen in range(most)]
        for name, of in ((scene.clip, found), (f"{scene.clip}, scaled", scaled))
    }


def methods_of(net, tuning: Scene, untrained: bool) -> dict[str, Method]:
    """The input, the network and its rivals, by name."""
    found: dict[str, Method] = {
        REFER: lambda scene: np.asarray(display_from_linear(scene.noisy)),
        OURS: lambda scene: net(scene.noisy[:, None])[:, 0],
        AT_BEST: partial(at_its_best, net),
    }
    if untrained and not_installed():
        _note(f"{' and '.join(not_installed())} are left out: pip install 'hsnoise[peers]'")
    for name, denoise in rivals().items() if untrained else ():
        found[name] = prepared(name, denoise, tuning)
    return found


def at_its_best(net, scene: Scene) -> np.ndarray:
    """Display values of a scene by a network [time, batch, ...] that sees the frames that follow and mirrored ones."""
    noisy, seen = scene.noisy[:, None], []
    for view in (1, -1):
        frames = noisy[:, :, :, ::view]
        seen.append(both_ways(net(frames), net(frames[::-1])[::-1])[:, 0, :, ::view])
    return (seen[0] + seen[1]) / 2


def prepared(name: str, denoise: Denoiser, tuning: Scene) -> Method:
    """A rival that is not trained, with the strength and domain that do best on a scene that is not scored."""
    strength, domain = tuned(denoise, tuning)
    print(f"{name}: best at {strength:g} times the noise in {domain}", file=sys.stderr, flush=True)
    return partial(denoised, denoise, strength=strength, domain=domain)


def outputs(methods: dict[str, Method], scene: Scene) -> dict[str, np.ndarray]:
    """Display values of each method, 0 to 1, scaled to the brightness of the truth; the network's as they are, too."""
    found = {}
    for name, method in methods.items():
        frames = method(scene)
        if name == OURS:
            found[OURS], name = np.clip(frames, 0, 1), SCALED
        found[name] = scaled_to(frames, scene.clean)
    return found


def run(options: argparse.Namespace) -> None:
    """Score, and write the results to `options.out`.

    Raises:
        ValueError: a crop too small for SSIM; weights, clips or a camera that do not match.
    """
    if options.crop < LEAST_CROP:
        raise ValueError(f"--crop: expected at least {LEAST_CROP} pixels, as SSIM needs, got {options.crop}")
    network, about = load_network(options.weights)
    made(options.out)
    camera = camera_for(about, options)
    split = split_of(read_clips(options.clips), options.split)
    check_sizes(sum(split, []), LEAST_FRAMES, LEAST_CROP)
    check_weights(options.weights, network, about, camera, split.test)
    note_protocol(options.weights, about)
    video = eqx.filter_jit(network.video)
    records, filling = scored(lambda noisy: np.asarray(video(noisy)), split, camera, options)
    write_results(records, filling, camera, options)


def scored(net, split: Split, camera: Camera, options: argparse.Namespace) -> tuple[list[dict], dict]:
    """Records of all frames, and PSNR while the memory fills; writes pictures in the middle of the light."""
    lights = [float(light) for light in np.geomspace(*camera.mean_e, LEVELS)]
    middle = lights[LEVELS // 2]
    # Not a clip that is scored: without a split in a file, those that validate are.
    tuning = (split.training if options.split is None else split.validation)[0]
    methods = methods_of(net, scene_of(tuning, camera, middle, options.crop, 99), not options.no_rivals)
    short = [clip for clip in split.test if not clip.is_long]
    tasks = [(clip, light) for clip in short for light in lights]
    records = []
    for number, (clip, light) in enumerate(track(tasks, "Scoring", console=Console(stderr=True))):
        scene = scene_of(clip, camera, light, options.crop, number)
        found = outputs(methods, scene)
        records += [row for name, frames in found.items() for row in scores(name, scene, frames)]
        if light == middle:
            write_figure(options.out / f"frames-{clip.name}.png", draw_frames(scene, found), dpi=110)
    filling: dict[str, list[float]] = {}
    # Without longer cuts, the clips themselves show how the memory fills.
    for number, clip in enumerate([clip for clip in split.test if clip.is_long] or short):
        filling |= while_memory_fills(net, scene_of(clip, camera, middle, options.crop, 1000 + number))
    return records, filling


def write_results(records: list[dict], filling: dict, camera: Camera, options: argparse.Namespace) -> None:
    """evaluation.md, frames.csv and curves.png; then the tables are printed."""
    sheets = [*tables(records, camera.in_words), memory_sheet(filling)]
    light = f"{camera.in_words(camera.mean_e[0])} to {camera.in_words(camera.mean_e[1])}"
    title = f"{options.weights}: camera {camera.name}, {light}, the middle {options.crop} pixels of each frame\n"
    text = "\n".join([title, *(sheet.markdown() for sheet in sheets)])
    write_atomically(options.out / "evaluation.md", text.encode())
    write_atomically(options.out / "frames.csv", as_csv(records).encode())
    write_figure(options.out / "curves.png", draw_curves(records, filling, camera.in_words), dpi=110)
    console = Console(width=150)
    with console.capture() as printed:
        for sheet in (*sheets[:2], sheets[-1]):
            console.print(sheet.rich())
    print(printed.get() + f"Written to {options.out}: evaluation.md, frames.csv, curves.png, frames-*.png")


def _note(sentence: str) -> None:
    print(f"Note: {sentence}", file=sys.stderr)
