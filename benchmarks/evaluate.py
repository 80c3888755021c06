"""How good is a trained enhancer? PSNR and SSIM on held-out clips, beside what users would take without training.

    python -m benchmarks.evaluate build/train/weights.eqx --clips FOLDER

Writes a table and figures to `--out`: PSNR against illuminance and number of frames seen, frames side by side. BM3D
and BM4D take part if the extra `peers` is installed; BM4D over the frame axis stands for VBM4D, which has no package.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from skimage.metrics import structural_similarity

from benchmarks._clips import LONG, Clip, check_sizes, held_out, read_clips
from benchmarks._noisy import OPTICS, Camera, camera_of, noisy_of
from benchmarks._rivals import denoised, rivals, tuned
from benchmarks._sheet import Sheet
from benchmarks._validation import psnr_db
from benchmarks.train import pair
from hsnoise._output import write_atomically, write_figure
from hsnoise.photometry import display_from_linear, light_of_frames, linear_from_display
from hsnoise.weights import load_network

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
        """Standard deviation of the noise in linear light, from frame to frame."""
        noise = self.noisy - np.asarray(linear_from_display(self.clean))
        return float(np.sqrt(0.5 * np.mean(np.diff(noise, axis=0) ** 2)))


def scene_of(clip: Clip, camera: Camera, white_e: float, crop: int, seed: int) -> Scene:
    side = [min(crop, n) // 2 * 2 for n in clip.frames.shape[1:3]]
    row, column = ((n - s) // 2 for n, s in zip(clip.frames.shape[1:3], side, strict=True))
    light = light_of_frames(clip.frames[:, row : row + side[0], column : column + side[1]], camera.channels)
    noisy = noisy_of(jax.random.key(seed), light, camera.model, camera.model, white_e)
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


def network_of(path: Path, camera: Camera, scored: Sequence[Clip]):
    """The enhancer as a function of noisy linear light [frame, example, row, column, channel].

    Raises:
        ValueError: weights of another number of channels, or trained on clips that are to be scored.
    """
    net, about = load_network(path)
    if net.channels != camera.channels:
        raise ValueError(f"{path}: weights for {net.channels} channels, camera {camera.name} has {camera.channels}")
    seen = sorted({clip.source for clip in scored} & {name.removesuffix(LONG) for name in about.get("clips", ())})
    if seen:
        raise ValueError(f"--clips: {', '.join(seen)} would be scored, but {path} was trained on them")
    if about.get("camera") != camera.name:
        print(f"Note: {path} was trained for camera {about.get('camera')}, not {camera.name}")
    video = eqx.filter_jit(net.video)
    return lambda noisy: np.asarray(video(noisy))


def while_memory_fills(net, scene: Scene) -> list[float]:
    """PSNR of the nth frame that the network sees, dB, n from 1: of the same frames for each n, whatever they show.

    The video, or what memory holds of a long one many times over, is begun anew at each frame; scored is its second
    half.
    """
    n = min(len(scene.noisy), 2 * SHOWN_FRAMES[-1])
    most = (n + 1) // 2
    places = np.minimum(np.arange(most)[:, None] + np.arange(n), n - 1)  # [seen, begun at]
    found = np.clip(net(scene.noisy[places]), 0, 1)
    scored = range(most - 1, n)
    return [float(np.mean([psnr_db(found[seen, f - seen], scene.clean[f]) for f in scored])) for seen in range(most)]


def methods_of(net, tuning: Scene, untrained: bool) -> dict:
    """Name to function from a scene to display values."""
    found = {
        REFER: lambda scene: np.asarray(display_from_linear(scene.noisy)),
        OURS: lambda scene: net(scene.noisy[:, None])[:, 0],
    }
    for name, denoise in rivals().items() if untrained else ():
        strength, linear = tuned(denoise, tuning.noisy, tuning.clean, tuning.sigma)
        found[name] = lambda scene, f=denoise, s=strength, linear=linear: denoised(
            f, scene.noisy, scene.sigma, s, linear
        )
        print(f"{name}: best at {strength:g} times the noise, in {'linear light' if linear else 'display values'}")
    return found


def mean_of(records: Sequence[dict], what: str, **chosen) -> float:
    values = [r[what] for r in records if all(r[name] == value for name, value in chosen.items())]
    return float(np.mean(values)) if values else float("nan")


def tables(records: list[dict], unit_of_light) -> tuple[Sheet, Sheet]:
    """PSNR and SSIM of each method, all and at each illuminance; PSNR of each clip."""
    methods, levels = list(dict.fromkeys(r["method"] for r in records)), sorted({r["white_e"] for r in records})
    head = ("method", "PSNR / dB", "SSIM", *(f"PSNR at {unit_of_light(level)}" for level in levels))
    rows = [
        (
            method,
            f"{mean_of(records, 'psnr_db', method=method):.2f}",
            f"{mean_of(records, 'ssim', method=method):.3f}",
            *(f"{mean_of(records, 'psnr_db', method=method, white_e=level):.2f}" for level in levels),
        )
        for method in methods
    ]
    clips = list(dict.fromkeys(r["clip"] for r in records))
    by_clip = [(clip, *(f"{mean_of(records, 'psnr_db', method=m, clip=clip):.2f}" for m in methods)) for clip in clips]
    return Sheet("Held-out clips", head, rows), Sheet("PSNR of each clip, dB", ("clip", *methods), by_clip)


def memory_sheet(filling: dict[str, list[float]]) -> Sheet:
    """What the frames before are worth, for each clip."""
    shown = [n for n in SHOWN_FRAMES if n <= max(map(len, filling.values()))]
    rows = [(clip, *(f"{of[n - 1]:.2f}" if n <= len(of) else "" for n in shown)) for clip, of in filling.items()]
    title = "PSNR of the nth frame that the network sees, the same frames for each n, dB"
    return Sheet(title, ("clip", *(f"n = {n}" for n in shown)), rows)


def draw_curves(records: list[dict], filling: dict[str, list[float]], unit_of_light) -> Figure:
    """PSNR against illuminance (all methods) and against the number of frames that the network has seen."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    levels = sorted({r["white_e"] for r in records})
    for method in dict.fromkeys(r["method"] for r in records):
        values = [mean_of(records, "psnr_db", method=method, white_e=level) for level in levels]
        left.plot(levels, values, "o-", lw=2.5 if method == OURS else 1.2, label=method)
    left.set_xscale("log")
    left.set_xticks(levels, [unit_of_light(level) for level in levels])
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


def draw_frames(scene: Scene, found: dict[str, np.ndarray]) -> Figure:
    """The last frame of a scene by all methods."""
    panels = {**found, "clean": scene.clean}
    columns = min(4, len(panels))
    rows = -(-len(panels) // columns)
    aspect = scene.clean.shape[1] / scene.clean.shape[2]
    figure = Figure(figsize=(3.2 * columns, (3.2 * aspect + 0.35) * rows), layout="constrained")
    axes = np.ravel(figure.subplots(rows, columns))
    for axis in axes:
        axis.axis("off")
    for axis, (name, frames) in zip(axes, panels.items(), strict=False):
        axis.imshow(np.clip(frames[-1], 0, 1).squeeze(), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        value = "" if name == "clean" else f", {psnr_db(frames[-1], scene.clean[-1]):.1f} dB"
        axis.set_title(f"{name}{value}", fontsize=10, loc="left")
    return figure


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("weights", type=Path)
    add("--clips", type=Path, help="the folder that it was trained with; the clips held out then are used")
    add("--camera", default="canon_5d3", help=f"model.json of a fit, or {', '.join(OPTICS)}")
    add("--lux", type=pair)
    add("--white-e", type=pair)
    add("--crop", type=int, default=160, help="side of the middle of each frame that is scored (default 160)")
    add("--no-rivals", action="store_true", help="score the enhancer and the scaled input only")
    add("--out", type=Path, default=Path("build/evaluate"))
    options = parser.parse_args(argv)
    try:
        evaluate(options)
    except (ValueError, ImportError, OSError) as error:
        parser.exit(2, f"evaluate: {error}\n")


def evaluate(options: argparse.Namespace) -> None:
    if options.crop < LEAST_CROP:
        raise ValueError(f"--crop: expected at least {LEAST_CROP} pixels, as SSIM needs, got {options.crop}")
    options.out.mkdir(parents=True, exist_ok=True)
    camera = camera_of(options.camera, options.lux, options.white_e)
    train, kept = held_out(read_clips(options.clips))
    check_sizes([*train, *kept], LEAST_FRAMES, LEAST_CROP)
    levels = np.geomspace(*camera.white_e, LEVELS)
    net = network_of(options.weights, camera, kept)
    middle = float(levels[LEVELS // 2])
    methods = methods_of(net, scene_of(train[0], camera, middle, options.crop, 99), not options.no_rivals)
    lux = OPTICS.get(camera.name)

    def unit_of_light(white_e: float) -> str:
        return f"{white_e:.2g} e-" if lux is None else f"{white_e / float(lux.white_e(1.0)):.2g} lux"

    short = [clip for clip in kept if not clip.name.endswith(LONG)]
    tasks = [(clip, float(level)) for clip in short for level in levels]
    records = []
    for number, (clip, level) in enumerate(track(tasks, "Scoring", console=Console(stderr=True))):
        scene = scene_of(clip, camera, level, options.crop, number)
        found = {name: method(scene) for name, method in methods.items()}
        records += [row for name, frames in found.items() for row in scores(name, scene, frames)]
        if level == middle:
            write_figure(options.out / f"frames-{clip.name}.png", draw_frames(scene, found), dpi=110)
    # Without longer cuts, the clips themselves show how the memory fills.
    filling = {}
    for number, clip in enumerate([c for c in kept if c.name.endswith(LONG)] or short):
        filling[clip.name] = while_memory_fills(net, scene_of(clip, camera, middle, options.crop, 1000 + number))
    sheets = (*tables(records, unit_of_light), memory_sheet(filling))
    for sheet in (sheets[0], sheets[-1]):
        Console(width=130).print(sheet.rich())
    write_atomically(options.out / "evaluation.md", "\n".join(sheet.markdown() for sheet in sheets).encode())
    curves = draw_curves(records, filling, unit_of_light)
    write_figure(options.out / "curves.png", curves, dpi=110)
    print(f"Written to {options.out}: evaluation.md, curves.png, frames-*.png")


if __name__ == "__main__":
    main()
