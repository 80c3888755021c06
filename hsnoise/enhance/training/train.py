"""A training run of the video enhancer that can be interrupted: the command `hsnoise train`.

All output goes to `--out`: checkpoints, validation pictures, log.csv, and weights.eqx at the end. The same command
resumes an interrupted run and ends with the same weights.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import time
from dataclasses import asdict, replace
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from hsnoise._core.folders import alone_in, made
from hsnoise._core.output import write_atomically
from hsnoise.enhance.training import checkpoints, vgg
from hsnoise.enhance.training.clips import check_sizes, crops, read_clips
from hsnoise.enhance.training.noisy import camera_of, noise_of
from hsnoise.enhance.training.presets import PRESETS, Preset
from hsnoise.enhance.training.protocol import PROTOCOL
from hsnoise.enhance.training.split import split_of
from hsnoise.enhance.training.steps import Trainer, batch_rng, digest_of
from hsnoise.enhance.training.validation import Validation
from hsnoise.enhance.weights import load_network, save_network

CHECKPOINT_S = 60.0
SHOWN_EVERY = 10
ENDED, DESCRIBED = "weights.eqx", "run.json"
LOGGED = ["step", "loss", "psnr_db", "input_psnr_db"]
MOST_SEED = 2**32 - 1


def run(options: argparse.Namespace, console: Console) -> Path:
    """Train, or resume training, and tell progress on the console; returns the weights file.

    Raises:
        ValueError: an option out of range, another run in the same folder or at work in it, a loss that is not finite.
    """
    if not 0 <= options.seed <= MOST_SEED:
        raise ValueError(f"--seed: expected 0 to {MOST_SEED}, got {options.seed}")
    preset = chosen_preset(options)
    perceptual, vgg_digest = perceptual_of(options.vgg, console)
    camera = replace(camera_of(options.camera, options.lux, options.mean_e, options.exposure), sensor=options.sensor)
    noise = noise_of(options.noise, camera)
    train, kept, test = split_of(read_clips(options.clips), options.split)
    check_sizes([*train, *kept], preset.frames, preset.side)
    about = description(preset, camera, noise, train, kept, test, options) | {"vgg": vgg_digest}
    check_same_run(options.out, about)
    with alone_in(options.out):
        return trained(preset, camera, noise, perceptual, train, kept, about, options, console)


def trained(preset: Preset, camera, noise, perceptual, train, kept, about: dict, options, console) -> Path:
    """The run in its folder, from where an earlier one got to."""
    path = options.out / ENDED
    if has_ended(path, about):
        print(f"Already finished: weights in {path}")
        return path
    console.print(f"{len(train)} clips to train on, held out: {', '.join(clip.name for clip in kept)}")
    console.print(
        f"Camera {camera.name} at {camera.model.exposure_s:g} s, noise {options.noise},"
        f" scenes that average {camera.mean_e[0]:.3g} to {camera.mean_e[1]:.3g} e-"
    )
    trainer = Trainer(preset.recipe, preset.steps, camera, noise, perceptual)
    validation = Validation(kept, camera, preset.frames, options.out)
    state = trainer.start(options.seed)
    found = checkpoints.read_newest(options.out, state, lambda text: console.print(text, markup=False))
    first = 0
    if found is not None:
        check_same(options.out, found[1], about)
        state, first = found[0], found[1]["step"]
        console.print(f"Resuming from step {first}")
    write_atomically(options.out / DESCRIBED, (json.dumps(about, indent=2) + "\n").encode())
    state = loop(trainer, state, first, preset, train, validation, about, options, console)
    if math.isnan(validation.last):  # nothing was left to train
        validation.measure(trainer.network(state), preset.steps)
    save_network(path, trainer.network(state), {**about, "psnr_db": validation.last})
    print(f"Weights in {path}, log in {options.out / 'log.csv'}")
    return path


def description(preset: Preset, camera, noise, train, kept, test, options: argparse.Namespace) -> dict:
    """Everything that defines a run, in types that JSON can hold."""
    return {
        "preset": json.loads(json.dumps(asdict(preset))),
        "camera": camera.name,
        "noise": options.noise,
        "protocol": PROTOCOL,
        "mean_e": list(camera.mean_e),
        "unit_e": camera.unit_e,
        "sensor": None if camera.sensor is None else list(camera.sensor),
        "seed": options.seed,
        "clips": [clip.name for clip in train],
        "held_out": [clip.name for clip in kept],
        "test": [clip.name for clip in test],
        "trained_on": [digest_of(clip.frames) for clip in train],
        "digests": {
            "camera": digest_of(camera.model),
            "noise": digest_of(noise),
            "clips": digest_of([clip.frames for clip in (*train, *kept)]),
        },
    }


def loop(trainer, state, first, preset, clips, validation, about, options, console):
    """All steps from `first` on, with checkpoints and validation; an interrupt saves a checkpoint."""
    saved, saved_at = time.monotonic(), first
    at = (first, state, 0.0)  # one tuple: an interrupt must not separate a state from its number
    try:
        with ProgressOfTraining(console, preset.steps, first) as progress:
            for step in range(first, preset.steps):
                batch = crops(clips, batch_rng(options.seed, step), preset.batch, preset.seen, preset.side)
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
                    checkpoints.write(options.out, done, state, about)
                    saved, saved_at = time.monotonic(), done
    except KeyboardInterrupt:
        if at[0] > saved_at and math.isfinite(at[2]):
            checkpoints.write(options.out, at[0], at[1], about)
        console.print("Interrupted; the same command resumes here")
        raise
    return at[1]


def checked_loss(value, step: int) -> float:
    """The loss as a number. Raises ValueError unless it is finite, because training cannot recover from that."""
    if not math.isfinite(value):
        raise ValueError(
            f"step {step}: the loss is {float(value)}; is the light, or a number of the camera, out of range?"
        )
    return float(value)


class ProgressOfTraining:
    """A bar in a terminal, lines of text elsewhere."""

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
        """Show the number of steps done, and the loss of the last."""
        now, (then, before) = time.monotonic(), self._mark
        speed = (done - before) / max(now - then, 1e-9)
        self._mark = (now, done)
        self._bar.update(self._task, completed=done, loss=f"{loss:.4f}", speed=f"{speed:.1f}")

    def tell(self, done: int, loss: float, psnr: float, refer: float) -> None:
        """Print the result of the validation, dB."""
        self._bar.update(self._task, psnr=f"{psnr:.2f}")
        if not self._console.is_terminal:
            self._console.print(f"step {done}: loss {loss:.4f}, PSNR {psnr:.2f} dB (input {refer:.2f})")


def append_log(path: Path, step: int, value: float, psnr: float, refer: float) -> None:
    """Add a row to the log; drop damaged rows, and rows of steps that a resumed run repeats."""
    rows = list(csv.reader(path.read_text(errors="replace").splitlines()))[1:] if path.exists() else []
    rows = [row for row in rows if len(row) == len(LOGGED) and row[0].isdecimal() and int(row[0]) < step]
    rows.append([str(step), f"{value:.6f}", f"{psnr:.4f}", f"{refer:.4f}"])
    text = "\n".join(",".join(row) for row in [LOGGED, *rows])
    write_atomically(path, f"{text}\n".encode())


def chosen_preset(options: argparse.Namespace) -> Preset:
    preset = PRESETS[options.preset]
    steps = preset.steps if options.steps is None else options.steps
    if steps < 1:
        raise ValueError(f"--steps: expected at least 1, got {steps}")
    return replace(preset, steps=steps, validate_every=min(preset.validate_every, steps))


def perceptual_of(path: Path | None, console: Console):
    """Features for the perceptual term, and the hash of their weights; prints which are used."""
    if path is None:
        console.print("Perceptual term of the loss: off, no VGG-16 weights given (--vgg)")
        return None, None
    state, digest = vgg.read_weights(path)
    console.print(f"Perceptual term of the loss: {vgg.name_of(digest)}, relu2_2")
    return vgg.features_of(state), digest


def check_same_run(out: Path, about: dict) -> None:
    """Raise ValueError if the folder `out`, which is created if missing, holds another run."""
    path = out / DESCRIBED
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out: expected a folder, but {out} is a file")
    made(out)
    if path.exists():
        try:
            before = dict(json.loads(path.read_text()))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: damaged ({error}); remove it, the checkpoints describe the run, too") from error
        check_same(out, before, about)


def check_same(out: Path, before: dict, about: dict) -> None:
    """Raise ValueError unless the run in `out`, described by `before`, is the one that `about` describes."""
    changed = [name for name in about if about[name] != before.get(name)]
    if changed:
        raise ValueError(
            f"--out: {out} holds another run ({', '.join(changed)} differ); give another folder or remove it"
        )


def has_ended(path: Path, about: dict) -> bool:
    """Whether `path` holds the final weights of this run."""
    try:
        found = load_network(path)[1]
    except (OSError, ValueError):
        return False
    return all(found.get(name) == value for name, value in about.items())
