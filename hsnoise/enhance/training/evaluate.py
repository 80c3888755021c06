"""PSNR and SSIM of a trained enhancer and its rivals on held-out clips: the command `hsnoise evaluate`."""

from __future__ import annotations

import argparse
import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from skimage.metrics import structural_similarity

from hsnoise._core.output import write_atomically, write_figure
from hsnoise._core.sheet import Sheet
from hsnoise.chain.photometry import display_from_linear, light_of_frames, linear_from_display
from hsnoise.enhance.training.clips import Clip, check_sizes, held_out, read_clips, source_of
from hsnoise.enhance.training.noisy import OPTICS, Camera, camera_of, noisy_of
from hsnoise.enhance.training.rivals import Denoiser, denoised, not_installed, rivals, tuned
from hsnoise.enhance.training.steps import digest_of
from hsnoise.enhance.training.validation import psnr_db
from hsnoise.enhance.weights import load_network
from hsnoise.stlstm import STLSTM

LEVELS = 3
LEAST_CROP, LEAST_FRAMES = 8, 3
REFER, OURS = "scaled input", "hsnoise ST-LSTM"
SHOWN_FRAMES = (1, 2, 3, 5, 8, 12, 16, 20)


@dataclass(frozen=True)
class Scene:
    """A clip in some light: display values and noisy linear light [frame, row, column, channel]."""

    clip: str
    white_e: float
    clean: np.ndarray
    noisy: np.ndarray

    @property
    def sigma(self) -> float:
        """Standard deviation of the temporal noise in linear light."""
        noise = self.noisy - np.asarray(linear_from_display(self.clean))
        return float(np.sqrt(0.5 * np.mean(np.diff(noise, axis=0) ** 2)))


def scene_of(clip: Clip, camera: Camera, white_e: float, crop: int, seed: int) -> Scene:
    side = [min(crop, n) // 2 * 2 for n in clip.frames.shape[1:3]]
    row, column = ((n - s) // 2 for n, s in zip(clip.frames.shape[1:3], side, strict=True))
    light = light_of_frames(clip.frames[:, row : row + side[0], column : column + side[1]], camera.channels)
    noisy = noisy_of(jax.random.key(seed), light, camera.model, camera.model, white_e, camera.sensor)
    return Scene(clip.name, white_e, np.asarray(display_from_linear(light)), np.asarray(noisy, np.float32))


def scores(method: str, scene: Scene, found: np.ndarray) -> list[dict]:
    """PSNR and SSIM of each frame."""
    found = np.clip(found, 0, 1)
    return [
        {
            "method": method,
            "clip": scene.clip,
            "white_e": scene.white_e,
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
    white_e = options.white_e
    if white_e is None and options.lux is None and "white_e" in about:
        white_e = tuple(about["white_e"])
    sensor = options.sensor or (tuple(about["sensor"]) if about.get("sensor") else None)
    camera = replace(camera_of(name, options.lux, white_e, options.exposure), sensor=sensor)
    if about.get("digests", {}).get("camera") != digest_of(camera.model):
        print(f"Note: {options.weights} was trained for another camera ({about.get('camera')}), not {camera.name}")
    return camera


def check_weights(path: Path, net: STLSTM, about: dict, camera: Camera, scored: Sequence[Clip]) -> None:
    """Raise ValueError for weights with a wrong number of channels, or trained on clips to be scored."""
    if net.channels != camera.channels:
        raise ValueError(f"{path}: weights for {net.channels} channels, camera {camera.name} has {camera.channels}")
    if "clips" not in about:
        print(f"Note: {path} does not say which clips it was trained on; those scored may be among them")
    names, digests = (set(map(source_of, about.get("clips", ()))), about.get("trained_on", ()))
    seen = sorted({clip.source for clip in scored if clip.source in names or digest_of(clip.frames) in digests})
    if seen:
        raise ValueError(f"--clips: {', '.join(seen)} would be scored, but {path} was trained on them")


def while_memory_fills(net, scene: Scene) -> list[float]:
    """PSNR of the nth frame that the network sees, dB, n from 1, on the same frames for each n.

    The network starts over at each frame of the video (a long one is cut far beyond the network's memory). Only the
    second half is scored.
    """
    n = min(len(scene.noisy), 2 * SHOWN_FRAMES[-1])
    most = (n + 1) // 2
    places = np.minimum(np.arange(most)[:, None] + np.arange(n), n - 1)  # [seen, begun at]
    found = np.clip(net(scene.noisy[places]), 0, 1)
    scored = range(most - 1, n)
    return [float(np.mean([psnr_db(found[seen, f - seen], scene.clean[f]) for f in scored])) for seen in range(most)]


def methods_of(net, tuning: Scene, untrained: bool) -> dict:
    """Name to function from a scene to display values."""
    found: dict[str, Callable[[Scene], np.ndarray]] = {
        REFER: lambda scene: np.asarray(display_from_linear(scene.noisy)),
        OURS: lambda scene: net(scene.noisy[:, None])[:, 0],
    }
    if untrained and not_installed():
        print(f"Note: {' and '.join(not_installed())} are left out: pip install 'hsnoise[peers]'")
    for name, denoise in rivals().items() if untrained else ():
        strength, linear = tuned(denoise, tuning.noisy, tuning.clean, tuning.sigma)
        found[name] = partial(_of_scene, denoise, strength, linear)
        print(f"{name}: best at {strength:g} times the noise in {'linear light' if linear else 'display values'}")
    return found


def _of_scene(denoise: Denoiser, strength: float, linear: bool, scene: Scene) -> np.ndarray:
    return denoised(denoise, scene.noisy, scene.sigma, strength, linear)


def mean_of(records: Sequence[dict], what: str, **chosen) -> float:
    values = [r[what] for r in records if all(r[name] == value for name, value in chosen.items())]
    return float(np.mean(values)) if values else float("nan")


def tables(records: list[dict], in_words) -> tuple[Sheet, Sheet]:
    """PSNR and SSIM of each method, overall and at each illuminance; PSNR of each clip."""
    methods, levels = list(dict.fromkeys(r["method"] for r in records)), sorted({r["white_e"] for r in records})
    head = ("method", "PSNR / dB", "SSIM", *(f"dB / SSIM at {in_words(level)}" for level in levels))
    rows = [
        (
            method,
            f"{mean_of(records, 'psnr_db', method=method):.2f}",
            f"{mean_of(records, 'ssim', method=method):.3f}",
            *(
                f"{mean_of(records, 'psnr_db', method=method, white_e=level):.2f} /"
                f" {mean_of(records, 'ssim', method=method, white_e=level):.3f}"
                for level in levels
            ),
        )
        for method in methods
    ]
    clips = list(dict.fromkeys(r["clip"] for r in records))
    by_clip = [(clip, *(f"{mean_of(records, 'psnr_db', method=m, clip=clip):.2f}" for m in methods)) for clip in clips]
    return Sheet("Held-out clips", head, rows), Sheet("PSNR of each clip, dB", ("clip", *methods), by_clip)


def as_csv(records: list[dict]) -> str:
    """All measurements, one row per frame."""
    file = io.StringIO()
    writer = csv.DictWriter(file, records[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return file.getvalue()


def memory_sheet(filling: dict[str, list[float]]) -> Sheet:
    """How much the preceding frames help, for each clip."""
    shown = [n for n in SHOWN_FRAMES if n <= max(map(len, filling.values()))]
    rows = [(clip, *(f"{of[n - 1]:.2f}" if n <= len(of) else "" for n in shown)) for clip, of in filling.items()]
    title = "PSNR of the nth frame that the network sees, the same frames for each n, dB"
    return Sheet(title, ("clip", *(f"n = {n}" for n in shown)), rows)


def draw_curves(records: list[dict], filling: dict[str, list[float]], in_words) -> Figure:
    """PSNR against illuminance (all methods), and against the number of frames that the network has seen."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    levels = sorted({r["white_e"] for r in records})
    for method, marker in zip(dict.fromkeys(r["method"] for r in records), "sovDXP", strict=False):
        values = [mean_of(records, "psnr_db", method=method, white_e=level) for level in levels]
        left.plot(levels, values, f"{marker}-", alpha=0.8, lw=2.5 if method == OURS else 1.2, label=method)
    left.set_xscale("log")
    left.set_xticks(levels, [in_words(level) for level in levels])
    left.minorticks_off()
    left.set_xlabel("light of the scene")
    left.set_ylabel("PSNR (dB)")
    left.legend(fontsize=8)
    left.set_title("Against light", loc="left")
    for clip, values in filling.items():
        right.plot(range(1, len(values) + 1), values, "o-", ms=3, label=clip)
    right.set_xlabel("frames seen, the scored one included")
    right.set_ylabel("PSNR of the same frames (dB)")
    right.legend(fontsize=8)
    right.set_title("While the memory fills", loc="left")
    return figure


def draw_frames(scene: Scene, found: dict[str, np.ndarray], light: str) -> Figure:
    """The last frame of a scene by all methods; light: the scene's light in words."""
    panels = {**found, "clean": scene.clean}
    columns = min(4, len(panels))
    rows = -(-len(panels) // columns)
    aspect = scene.clean.shape[1] / scene.clean.shape[2]
    figure = Figure(figsize=(3.2 * columns, (3.2 * aspect + 0.35) * rows + 0.35), layout="constrained")
    figure.suptitle(f"{scene.clip}, {light}, frame {len(scene.clean)}: PSNR of this frame", fontsize=11)
    axes = np.ravel(figure.subplots(rows, columns))
    for axis in axes:
        axis.axis("off")
    for axis, (name, frames) in zip(axes, panels.items(), strict=False):
        axis.imshow(np.clip(frames[-1], 0, 1).squeeze(), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        value = "" if name == "clean" else f", {psnr_db(frames[-1], scene.clean[-1]):.1f} dB"
        axis.set_title(f"{name}{value}", fontsize=10, loc="left")
    return figure


def run(options: argparse.Namespace) -> None:
    """Score, and write the results to `options.out`.

    Raises:
        ValueError: a crop too small for SSIM; weights, clips or a camera that do not match.
    """
    if options.crop < LEAST_CROP:
        raise ValueError(f"--crop: expected at least {LEAST_CROP} pixels, as SSIM needs, got {options.crop}")
    options.out.mkdir(parents=True, exist_ok=True)
    network, about = load_network(options.weights)
    camera = camera_for(about, options)
    train, kept = held_out(read_clips(options.clips))
    check_sizes([*train, *kept], LEAST_FRAMES, LEAST_CROP)
    levels = np.geomspace(*camera.white_e, LEVELS)
    check_weights(options.weights, network, about, camera, kept)
    video = eqx.filter_jit(network.video)

    def net(noisy: np.ndarray) -> np.ndarray:
        return np.asarray(video(noisy))

    middle = float(levels[LEVELS // 2])
    methods = methods_of(net, scene_of(train[0], camera, middle, options.crop, 99), not options.no_rivals)
    short = [clip for clip in kept if not clip.is_long]
    tasks = [(clip, float(level)) for clip in short for level in levels]
    records = []
    for number, (clip, level) in enumerate(track(tasks, "Scoring", console=Console(stderr=True))):
        scene = scene_of(clip, camera, level, options.crop, number)
        found = {name: method(scene) for name, method in methods.items()}
        records += [row for name, frames in found.items() for row in scores(name, scene, frames)]
        if level == middle:
            write_figure(
                options.out / f"frames-{clip.name}.png", draw_frames(scene, found, camera.in_words(level)), dpi=110
            )
    # Without longer cuts, the clips themselves show how the memory fills.
    filling = {}
    for number, clip in enumerate([clip for clip in kept if clip.is_long] or short):
        filling[clip.name] = while_memory_fills(net, scene_of(clip, camera, middle, options.crop, 1000 + number))
    sheets = (*tables(records, camera.in_words), memory_sheet(filling))
    for sheet in (sheets[0], sheets[-1]):
        Console(width=150).print(sheet.rich())
    light = f"{camera.in_words(levels[0])} to {camera.in_words(levels[-1])}"
    title = f"{options.weights}: camera {camera.name}, {light}, the middle {options.crop} pixels of each frame\n"
    text = "\n".join([title, *(sheet.markdown() for sheet in sheets)])
    write_atomically(options.out / "evaluation.md", text.encode())
    write_atomically(options.out / "frames.csv", as_csv(records).encode())
    curves = draw_curves(records, filling, camera.in_words)
    write_figure(options.out / "curves.png", curves, dpi=110)
    print(f"Written to {options.out}: evaluation.md, frames.csv, curves.png, frames-*.png")
