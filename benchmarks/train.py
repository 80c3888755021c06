"""Train the video enhancer on clean clips and the noise of a camera.

    python -m benchmarks.train                                        (2 minutes, on scikit-image's pictures)
    python -m benchmarks.train --preset cpu --clips FOLDER            (half an hour on 2 cores)
    python -m benchmarks.train --preset paper --clips FOLDER          (a GPU)
    python -m benchmarks.train --camera hsnoise-fit/model.json --white-e 2,10

Everything goes into `--out`: checkpoints, validation pictures, log.csv, and weights.eqx at the end. The same command
goes on where an interrupted run stopped, and ends with the same weights.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from benchmarks import _checkpoints, _vgg
from benchmarks._clips import check_sizes, crops, held_out, read_clips
from benchmarks._noisy import NOISES, OPTICS, camera_of, noise_of
from benchmarks._training import Recipe, Trainer, batch_rng, digest_of
from benchmarks._validation import Validation
from hsnoise._output import write_atomically
from hsnoise.weights import save_network

CHECKPOINT_S = 60.0
SHOWN_EVERY = 10
ENDED = "weights.eqx"


@dataclass(frozen=True)
class Preset:
    """Sizes of a run; recipe: network and optimiser."""

    steps: int
    batch: int
    frames: int
    side: int
    validate_every: int
    recipe: Recipe


PRESETS = {
    "smoke": Preset(120, 2, 4, 32, 60, Recipe(maps=8)),
    # In this little light details of less than 4 pixels are lost: coarse blocks see four times the scene in the time.
    "cpu": Preset(4_400, 4, 12, 64, 500, Recipe(maps=16, stride=4, rate=2e-3)),
    "paper": Preset(100_000, 8, 8, 64, 1000, Recipe(maps=64, decay=False)),
}


def run(options: argparse.Namespace, console: Console) -> Path:
    """Train, or go on training; returns the weights file."""
    preset = chosen_preset(options)
    perceptual, vgg = perceptual_of(options.vgg, console)
    camera = camera_of(options.camera, options.lux, options.white_e)
    noise = noise_of(options.noise, camera)
    train, kept = held_out(read_clips(options.clips))
    check_sizes([*train, *kept], preset.frames, preset.side)
    about = {
        "preset": json.loads(json.dumps(asdict(preset))),
        "camera": camera.name,
        "noise": options.noise,
        "white_e": list(camera.white_e),
        "seed": options.seed,
        "clips": [clip.name for clip in train],
        "held_out": [clip.name for clip in kept],
        "vgg": vgg,
        "digests": {
            "camera": digest_of(camera.model),
            "noise": digest_of(noise),
            "clips": digest_of([clip.frames for clip in (*train, *kept)]),
        },
    }
    check_same_run(options.out, about)
    console.print(f"{len(train)} clips to train on, held out: {', '.join(clip.name for clip in kept)}")
    console.print(
        f"Camera {camera.name}, noise {options.noise}, white of {camera.white_e[0]:.3g} to {camera.white_e[1]:.3g} e-"
    )
    trainer = Trainer(preset.recipe, preset.steps, camera, noise, perceptual)
    validation = Validation(kept, camera, preset.frames, options.out)
    state = trainer.start(options.seed)
    found = _checkpoints.read_newest(options.out, state, lambda text: console.print(text, markup=False))
    first = 0
    if found is not None:
        state, first = found[0], found[1]["step"]
        console.print(f"Going on from step {first}")
    state = loop(trainer, state, first, preset, train, validation, about, options, console)
    path = options.out / ENDED
    if math.isnan(validation.last):  # nothing was left to train
        validation.measure(trainer.network(state), preset.steps)
    save_network(path, trainer.network(state), {**about, "psnr_db": validation.last})
    console.print(f"Weights in {path}, log in {options.out / 'log.csv'}")
    return path


def loop(trainer, state, first, preset, clips, validation, about, options, console):
    """All steps from `first` on, with checkpoints and validation."""
    text = "{task.description}  loss {task.fields[loss]}  PSNR {task.fields[psnr]} dB  {task.fields[speed]} steps/s"
    columns = (TextColumn(text), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    saved = time.monotonic()
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("Training", total=preset.steps, completed=first, loss="-", psnr="-", speed="-")
        mark, marked = time.monotonic(), first
        for step in range(first, preset.steps):
            batch = crops(clips, batch_rng(options.seed, step), preset.batch, preset.frames, preset.side)
            state, value = trainer.step(state, batch, options.seed, step)
            done = step + 1
            if done % SHOWN_EVERY == 0 or done == preset.steps:
                speed = (done - marked) / max(time.monotonic() - mark, 1e-9)
                mark, marked = time.monotonic(), done
                progress.update(task, completed=done, loss=f"{float(value):.4f}", speed=f"{speed:.1f}")
            if done % preset.validate_every == 0 or done == preset.steps:
                psnr = validation.measure(trainer.network(state), done)
                progress.update(task, psnr=f"{psnr:.2f}")
                append_log(options.out / "log.csv", done, float(value), psnr, validation.refer)
                if not console.is_terminal:
                    console.print(
                        f"step {done}: loss {float(value):.4f}, PSNR {psnr:.2f} dB (input {validation.refer:.2f})"
                    )
            if time.monotonic() - saved > CHECKPOINT_S or done == preset.steps:
                _checkpoints.write(options.out, done, state, about)
                saved = time.monotonic()
    return state


def append_log(path: Path, step: int, value: float, psnr: float, refer: float) -> None:
    """One more row of the log; rows of steps that a resumed run repeats are replaced."""
    rows = list(csv.reader(path.read_text().splitlines()))[1:] if path.exists() else []
    rows = [row for row in rows if int(row[0]) < step]
    rows.append([step, f"{value:.6f}", f"{psnr:.4f}", f"{refer:.4f}"])
    text = "\n".join(",".join(map(str, row)) for row in [["step", "loss", "psnr_db", "input_psnr_db"], *rows])
    write_atomically(path, f"{text}\n".encode())


def chosen_preset(options: argparse.Namespace) -> Preset:
    preset = PRESETS[options.preset]
    steps = options.steps or preset.steps
    return replace(preset, steps=steps, validate_every=min(preset.validate_every, steps))


def perceptual_of(vgg: Path | None, console: Console):
    """Features for the perceptual term and the hash of their weights; the first line of the log says which."""
    if vgg is None:
        console.print("Perceptual term of the loss: off, no VGG-16 weights given (--vgg)")
        return None, None
    state, digest = _vgg.read_weights(vgg)
    console.print(f"Perceptual term of the loss: {_vgg.name_of(digest)}, relu2_2")
    return _vgg.features_of(state), digest


def check_same_run(out: Path, about: dict) -> None:
    """Keep what the run is in run.json. Raises ValueError if the folder holds another run."""
    path = out / "run.json"
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out: expected a folder, but {out} is a file")
    if path.exists():
        before = json.loads(path.read_text())
        changed = [name for name in about if about[name] != before.get(name)]
        if changed:
            raise ValueError(
                f"--out: {out} holds another run ({', '.join(changed)} differ); give another folder or remove it"
            )
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(path, (json.dumps(about, indent=2) + "\n").encode())


def pair(text: str) -> tuple[float, float]:
    try:
        low, _, high = text.partition(",")
        return float(low), float(high or low)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a number or low,high, got {text!r}") from None


def parser() -> argparse.ArgumentParser:
    top = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = top.add_argument
    add("--preset", choices=PRESETS, default="smoke")
    add("--camera", default="canon_5d3", help=f"model.json of a fit, or {', '.join(OPTICS)}")
    add("--noise", default="hsnoise", help=f"{', '.join(NOISES)} of the same strength, or a model.json")
    add(
        "--clips",
        type=Path,
        help="folder of videos, folders of images or .npz files (default: scikit-image's pictures)",
    )
    add("--lux", type=pair, help="illuminance of the scene: low,high (default: the paper's for the camera)")
    add("--white-e", type=pair, help="or photoelectrons of white: low,high")
    add("--vgg", type=Path, help="torchvision's VGG-16 weights (.safetensors or .pth) for the perceptual term")
    add("--steps", type=int, help="instead of the preset's")
    add("--seed", type=int, default=0)
    add("--out", type=Path, default=Path("build/train"), help="default: build/train")
    return top


def main(argv: list[str] | None = None) -> None:
    top = parser()
    options = top.parse_args(argv)
    if options.steps is not None and options.steps < 1:
        top.error("--steps: expected at least 1")
    console = Console(highlight=False, soft_wrap=True)
    try:
        run(options, console)
    except (ValueError, ImportError, OSError) as error:
        top.exit(2, f"train: {error}\n")
    except KeyboardInterrupt:
        top.exit(130, "train: interrupted; the same command goes on from the last checkpoint\n")


if __name__ == "__main__":
    main()
