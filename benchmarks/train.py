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
from hsnoise.weights import load_network, save_network

CHECKPOINT_S = 60.0
SHOWN_EVERY = 10
ENDED, DESCRIBED = "weights.eqx", "run.json"
LOGGED = ["step", "loss", "psnr_db", "input_psnr_db"]
MOST_SEED = 2**32 - 1
SENSOR_HELP = (
    "ROWSxCOLUMNS of the camera's frames, for noise that depends on the place (glow, taps, shading): pieces lie"
    " anywhere in them (default: each piece is a whole frame)"
)


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
    # In this little light details of less than 4 pixels are lost: coarse blocks see four times the scene in the time.
    "smoke": Preset(200, 4, 4, 64, 100, Recipe(maps=8, stride=4, rate=5e-3)),
    "cpu": Preset(4_400, 4, 12, 64, 500, Recipe(maps=16, stride=4, rate=2e-3)),
    "paper": Preset(100_000, 8, 8, 64, 1000, Recipe(maps=64, decay=False)),
}


def run(options: argparse.Namespace, console: Console) -> Path:
    """Train, or go on training; returns the weights file."""
    preset = chosen_preset(options)
    perceptual, vgg = perceptual_of(options.vgg, console)
    camera = replace(camera_of(options.camera, options.lux, options.white_e, options.exposure), sensor=options.sensor)
    noise = noise_of(options.noise, camera)
    train, kept = held_out(read_clips(options.clips))
    check_sizes([*train, *kept], preset.frames, preset.side)
    about = description(preset, camera, noise, train, kept, options) | {"vgg": vgg}
    check_same_run(options.out, about)
    path = options.out / ENDED
    if has_ended(path, about):
        console.print(f"Already finished: weights in {path}")
        return path
    console.print(f"{len(train)} clips to train on, held out: {', '.join(clip.name for clip in kept)}")
    console.print(
        f"Camera {camera.name} at {camera.model.exposure_s:g} s, noise {options.noise},"
        f" white of {camera.white_e[0]:.3g} to {camera.white_e[1]:.3g} e-"
    )
    trainer = Trainer(preset.recipe, preset.steps, camera, noise, perceptual)
    validation = Validation(kept, camera, preset.frames, options.out)
    state = trainer.start(options.seed)
    found = _checkpoints.read_newest(options.out, state, lambda text: console.print(text, markup=False))
    first = 0
    if found is not None:
        check_same(options.out, found[1], about)
        state, first = found[0], found[1]["step"]
        console.print(f"Going on from step {first}")
    write_atomically(options.out / DESCRIBED, (json.dumps(about, indent=2) + "\n").encode())
    state = loop(trainer, state, first, preset, train, validation, about, options, console)
    if math.isnan(validation.last):  # nothing was left to train
        validation.measure(trainer.network(state), preset.steps)
    save_network(path, trainer.network(state), {**about, "psnr_db": validation.last})
    console.print(f"Weights in {path}, log in {options.out / 'log.csv'}")
    return path


def description(preset: Preset, camera, noise, train, kept, options: argparse.Namespace) -> dict:
    """What makes a run the one that it is, in words that JSON can hold."""
    return {
        "preset": json.loads(json.dumps(asdict(preset))),
        "camera": camera.name,
        "noise": options.noise,
        "white_e": list(camera.white_e),
        "sensor": None if camera.sensor is None else list(camera.sensor),
        "seed": options.seed,
        "clips": [clip.name for clip in train],
        "held_out": [clip.name for clip in kept],
        "trained_on": [digest_of(clip.frames) for clip in train],
        "digests": {
            "camera": digest_of(camera.model),
            "noise": digest_of(noise),
            "clips": digest_of([clip.frames for clip in (*train, *kept)]),
        },
    }


def loop(trainer, state, first, preset, clips, validation, about, options, console):
    """All steps from `first` on, with checkpoints and validation; an interrupted one is kept where it stopped."""
    saved, saved_at = time.monotonic(), first
    at = (first, state, 0.0)  # in one piece: an interrupt must not come between a step and its number
    try:
        with ProgressOfTraining(console, preset.steps, first) as progress:
            for step in range(first, preset.steps):
                batch = crops(clips, batch_rng(options.seed, step), preset.batch, preset.frames, preset.side)
                at = (step + 1, *trainer.step(at[1], batch, options.seed, step))
                done, state, value = at
                last = done == preset.steps
                if done % SHOWN_EVERY == 0 or last:
                    progress.show(done, checked_loss(value, done))
                if done % preset.validate_every == 0 or last:
                    psnr = validation.measure(trainer.network(state), done)
                    append_log(options.out / "log.csv", done, float(value), psnr, validation.refer)
                    progress.tell(done, float(value), psnr, validation.refer)
                if time.monotonic() - saved > CHECKPOINT_S or last:
                    checked_loss(value, done)
                    _checkpoints.write(options.out, done, state, about)
                    saved, saved_at = time.monotonic(), done
    except KeyboardInterrupt:
        if at[0] > saved_at and math.isfinite(at[2]):
            _checkpoints.write(options.out, at[0], at[1], about)
        raise
    return at[1]


def checked_loss(value, step: int) -> float:
    """The loss as a number. Raises ValueError if it is none, from which no step leads back."""
    if not math.isfinite(value):
        raise ValueError(
            f"step {step}: the loss is {float(value)}; is the light, or a number of the camera, out of range?"
        )
    return float(value)


class ProgressOfTraining:
    """A bar in a terminal; lines of text where there is none."""

    def __init__(self, console: Console, steps: int, first: int):
        text = "{task.description}  loss {task.fields[loss]}  PSNR {task.fields[psnr]} dB  {task.fields[speed]} steps/s"
        columns = (TextColumn(text), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        self._console, self._bar = console, Progress(*columns, console=console, disable=not console.is_terminal)
        self._task = self._bar.add_task("Training", total=steps, completed=first, loss="-", psnr="-", speed="-")
        self._mark = (time.monotonic(), first)

    def __enter__(self):
        self._bar.start()
        return self

    def __exit__(self, *_):
        self._bar.stop()

    def show(self, done: int, loss: float) -> None:
        """A few steps more, and the loss of the last."""
        now, (then, before) = time.monotonic(), self._mark
        speed = (done - before) / max(now - then, 1e-9)
        self._mark = (now, done)
        self._bar.update(self._task, completed=done, loss=f"{loss:.4f}", speed=f"{speed:.1f}")

    def tell(self, done: int, loss: float, psnr: float, refer: float) -> None:
        """What the validation found, dB."""
        self._bar.update(self._task, psnr=f"{psnr:.2f}")
        if not self._console.is_terminal:
            self._console.print(f"step {done}: loss {loss:.4f}, PSNR {psnr:.2f} dB (input {refer:.2f})")


def append_log(path: Path, step: int, value: float, psnr: float, refer: float) -> None:
    """One more row of the log; rows of steps that a resumed run repeats, and damaged ones, are left out."""
    rows = list(csv.reader(path.read_text(errors="replace").splitlines()))[1:] if path.exists() else []
    rows = [row for row in rows if len(row) == len(LOGGED) and row[0].isdecimal() and int(row[0]) < step]
    rows.append([str(step), f"{value:.6f}", f"{psnr:.4f}", f"{refer:.4f}"])
    text = "\n".join(",".join(row) for row in [LOGGED, *rows])
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
    """Raise ValueError if the folder `out`, which is made, holds another run."""
    path = out / DESCRIBED
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out: expected a folder, but {out} is a file")
    out.mkdir(parents=True, exist_ok=True)
    if path.exists():
        try:
            before = dict(json.loads(path.read_text()))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: damaged ({error}); remove it, the checkpoints tell what the run is") from error
        check_same(out, before, about)


def check_same(out: Path, before: dict, about: dict) -> None:
    """Raise ValueError if what a run in `out` says of itself is not `about`."""
    changed = [name for name in about if about[name] != before.get(name)]
    if changed:
        raise ValueError(
            f"--out: {out} holds another run ({', '.join(changed)} differ); give another folder or remove it"
        )


def has_ended(path: Path, about: dict) -> bool:
    """Whether `path` holds the weights at the end of this run."""
    try:
        found = load_network(path)[1]
    except (OSError, ValueError):
        return False
    return all(found.get(name) == value for name, value in about.items())


def pair(text: str) -> tuple[float, float]:
    try:
        low, _, high = text.partition(",")
        return float(low), float(high or low)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a number or low,high, got {text!r}") from None


def shape_of(text: str) -> tuple[int, int]:
    """Rows and columns of 3000x4000."""
    rows, _, columns = text.partition("x")
    if not (rows.isdecimal() and columns.isdecimal() and int(rows) and int(columns)):
        raise argparse.ArgumentTypeError(f"expected ROWSxCOLUMNS, such as 3000x4000, got {text!r}")
    return int(rows), int(columns)


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
    add("--exposure", type=float, help="of a video frame, s, with a model.json (default: the model's own)")
    add("--sensor", type=shape_of, help=SENSOR_HELP)
    add("--vgg", type=Path, help="torchvision's VGG-16 weights (.safetensors or .pth) for the perceptual term")
    add("--steps", type=int, help="instead of the preset's")
    add("--seed", type=int, default=0, help="default: 0")
    add("--out", type=Path, default=Path("build/train"), help="default: build/train")
    return top


def main(argv: list[str] | None = None) -> None:
    top = parser()
    options = top.parse_args(argv)
    if options.steps is not None and options.steps < 1:
        top.error(f"--steps: expected at least 1, got {options.steps}")
    if not 0 <= options.seed <= MOST_SEED:
        top.error(f"--seed: expected 0 to {MOST_SEED}, got {options.seed}")
    console = Console(highlight=False, soft_wrap=True)
    try:
        run(options, console)
    except (ValueError, ImportError, OSError) as error:
        top.exit(2, f"train: {error}\n")
    except KeyboardInterrupt:
        top.exit(130, "train: interrupted; the same command goes on where it stopped\n")


if __name__ == "__main__":
    main()
