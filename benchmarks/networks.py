"""The ST-LSTM against published networks, trained alike: PSNR and SSIM on held-out clips.

    python -m benchmarks.networks --clips FOLDER --minutes 10 --camera canon_5d3 --out build/networks

Every network sees the same noise and the same pieces of the same clips in the same order, for the same time of training
(without compilation; or the same number of steps, `--steps`). Its learning rate falls by a cosine from the best of
three, each tried for a sixth of that time and judged on clips that are neither trained on nor tested. Each has the loss
of its paper. Networks with a window are trained on the frames that have one, and tested on all frames of a video that
is reflected at its ends: unlike the ST-LSTM they also see later frames. Finished trainings are kept in `--out`; the
same command resumes.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import count
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from rich.console import Console
from rich.progress import track
from skimage.metrics import structural_similarity

from benchmarks.noise_ablation import standard_error
from benchmarks.rivals.fastdvdnet import FastDVDnet
from benchmarks.rivals.ffdnet import FFDNet
from benchmarks.rivals.kpn import KPN
from benchmarks.rivals.layers import Noise, Rival, noise_map_of
from benchmarks.rivals.toflow import TOFlow
from hsnoise._core.output import write_atomically
from hsnoise._core.sheet import Sheet
from hsnoise.chain.photometry import display_from_linear, light_of_frames, linear_from_display
from hsnoise.enhance.training.clips import Clip, check_sizes, crops, held_out, read_clips
from hsnoise.enhance.training.noisy import Camera, camera_of, noisy_of
from hsnoise.enhance.training.presets import Recipe
from hsnoise.enhance.training.steps import Trainer, batch_rng, digest_of
from hsnoise.enhance.training.validation import psnr_db
from hsnoise.enhance.weights import read_arrays, write_arrays
from hsnoise.stlstm import STLSTM, loss

OURS = "ST-LSTM"
RIVALS: dict[str, type[Rival]] = {"FFDNet": FFDNet, "KPN": KPN, "TOFlow": TOFlow, "FastDVDnet": FastDVDnet}
RATES = (3e-4, 1e-3, 3e-3)
TRIAL = 1 / 6  # of the budget, for each rate
BATCH, FRAMES, SIDE = 4, 8, 64
MAPS, STRIDE = 64, 4  # of the ST-LSTM
VALIDATED, LEVELS, TIMED = 3, 3, 5
SEED = 0
SCORES = ("psnr_db", "ssim", "psnr_scaled_db", "ssim_scaled")


class Ours(eqx.Module):
    """The ST-LSTM as the rivals are used."""

    net: STLSTM

    def whole_video(self, frames: jax.Array) -> jax.Array:
        return self.net.video(frames)

    def loss(self, frames: jax.Array, clean: jax.Array, done: jax.Array) -> jax.Array:
        return loss(self.net.video(frames), clean)


@dataclass(frozen=True)
class Budget:
    """What a training may use: minutes, or a number of steps."""

    minutes: float | None
    steps: int | None

    def part(self, share: float) -> Budget:
        return Budget(
            None if self.minutes is None else share * self.minutes,
            None if self.steps is None else max(1, round(share * self.steps)),
        )


@dataclass(frozen=True, eq=False)
class Setting:
    """What all trainings share. unit_e: photoelectrons that are 1 in the networks' input; digest: of it all."""

    camera: Camera
    unit_e: float
    noise: Noise
    train: Sequence[Clip]
    chosen_on: Sequence[Clip]
    width: float
    out: Path
    digest: str

    def make(self, name: str) -> Callable[[jax.Array], Any]:
        """The network of this name, from a random key."""
        if name in RIVALS:
            return partial(RIVALS[name], noise=self.noise, width=self.width)
        maps = max(1, round(MAPS * self.width))
        return lambda key: Ours(STLSTM(key, maps=maps, stride=STRIDE, channels=self.camera.channels))

    def batch(self, step: int) -> np.ndarray:
        return crops(self.train, batch_rng(SEED, step), BATCH, FRAMES, SIDE)

    def trainer(self, name: str, rate: float, steps: int) -> Trainer:
        return Trainer(
            Recipe(rate=rate),
            steps,
            self.camera,
            self.camera.model,
            make=self.make(name),
            objective=lambda net, *of: net.loss(*of),
            unit_e=self.unit_e,
        )


@dataclass(frozen=True)
class Scene:
    """A clip in some light: clean display values and noisy linear light [frame, row, column, channel]."""

    clip: Clip
    white_e: float
    clean: np.ndarray
    noisy: np.ndarray


def scene_of(setting: Setting, clip: Clip, white_e: float, crop: int, seed: int) -> Scene:
    """The middle `crop` pixels of a clip, with noise."""
    side = [min(crop, n) for n in clip.frames.shape[1:3]]
    row, column = ((n - s) // 2 for n, s in zip(clip.frames.shape[1:3], side, strict=True))
    camera = setting.camera
    light = light_of_frames(clip.frames[:, row : row + side[0], column : column + side[1]], camera.channels)
    noisy = noisy_of(jax.random.key(seed), light, camera.model, camera.model, white_e, camera.sensor)
    shown = np.asarray(display_from_linear(light), np.float32)
    return Scene(clip, white_e, shown, np.asarray(noisy, np.float32) * np.float32(white_e / setting.unit_e))


def scaled_to(found: np.ndarray, clean: np.ndarray) -> np.ndarray:
    """Display values `found` with the mean linear light of `clean`."""
    light, wanted = (np.asarray(linear_from_display(np.clip(of, 0, 1))) for of in (found, clean))
    return np.asarray(display_from_linear(light * (wanted.mean() / max(light.mean(), 1e-6))))


def scores_of(found: np.ndarray, scene: Scene) -> dict[str, float]:
    """PSNR and SSIM as it is and scaled in brightness to the truth, means over frames."""

    def measured(frames: np.ndarray) -> tuple[float, float]:
        pairs = list(zip(np.clip(frames, 0, 1), scene.clean, strict=True))
        ssim = [structural_similarity(a, b, channel_axis=-1, data_range=1.0) for a, b in pairs]
        return float(np.mean([psnr_db(a, b) for a, b in pairs])), float(np.mean(ssim))

    return dict(zip(SCORES, (*measured(found), *measured(scaled_to(found, scene.clean))), strict=True))


@eqx.filter_jit
def _enhanced(net, noisy: jax.Array) -> jax.Array:
    return net.whole_video(noisy[:, None])[:, 0]


@cache
def seconds_a_step(setting: Setting, name: str) -> float:
    """Median time of a few steps, after compilation."""
    trainer = setting.trainer(name, RATES[0], TIMED)
    state, times = trainer.start(SEED), []
    for step in range(TIMED + 1):
        begun = time.monotonic()
        state, value = trainer.step(state, setting.batch(step), SEED, step)
        value.block_until_ready()
        times.append(time.monotonic() - begun)
    return float(np.median(times[1:]))


def trained(setting: Setting, name: str, rate: float, budget: Budget) -> tuple[Any, dict]:
    """The network after training, and what is known of it: read from `--out` if a finished one is there."""
    length = f"{budget.minutes:g}min" if budget.steps is None else f"{budget.steps}"
    path = setting.out / f"{name}-{setting.width:g}-{rate:g}-{length}-{setting.digest}.eqx"
    if path.exists():
        return read_arrays(path, eqx.filter_eval_shape(setting.make(name), jax.random.key(0)))
    steps = budget.steps or max(1, int(60 * budget.minutes / seconds_a_step(setting, name)))
    trainer = setting.trainer(name, rate, steps)
    trainer.step(trainer.start(SEED), setting.batch(0), SEED, 0)  # compiles
    state, begun, text = trainer.start(SEED), time.monotonic(), f"{name}, rate {rate:g}"
    for step in track(range(steps), text, console=Console(stderr=True), transient=True):
        state, value = trainer.step(state, setting.batch(step), SEED, step)
    about = {"network": name, "rate": rate, "steps": steps, "loss": float(value)}
    about |= {"minutes": (time.monotonic() - begun) / 60, "parameters": parameters_of(state[0])}
    write_arrays(path, state[0], about)
    print(f"{text}: {steps} steps in {about['minutes']:.1f} min, loss {about['loss']:.4f}", flush=True)
    return state[0], about


def parameters_of(net: Any) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(net, eqx.is_array)))


def best_rate(setting: Setting, name: str, budget: Budget, crop: int) -> float:
    """The rate with the highest PSNR on the validation clips after a short training."""
    white_e = float(np.sqrt(np.prod(setting.camera.white_e)))
    scenes = [scene_of(setting, clip, white_e, crop, seed) for seed, clip in enumerate(setting.chosen_on)]

    def quality(rate: float) -> float:
        net, _ = trained(setting, name, rate, budget.part(TRIAL))
        return float(np.mean([psnr_db(np.asarray(_enhanced(net, scene.noisy)), scene.clean) for scene in scenes]))

    found = {rate: quality(rate) for rate in RATES}
    print(f"{name}: " + ", ".join(f"{value:.2f} dB at rate {rate:g}" for rate, value in found.items()), flush=True)
    # A diverged training has no PSNR.
    return max(RATES, key=lambda rate: found[rate] if np.isfinite(found[rate]) else -np.inf)


def tested(net: Any, scenes: Sequence[Scene]) -> dict[str, dict[str, float]]:
    """Scores of each video, means over levels of light."""
    found: dict[str, list[dict[str, float]]] = {}
    for scene in scenes:
        found.setdefault(scene.clip.name, []).append(scores_of(np.asarray(_enhanced(net, scene.noisy)), scene))
    return {
        clip: {what: float(np.mean([of[what] for of in all_of])) for what in SCORES} for clip, all_of in found.items()
    }


def with_error(values: Sequence[float], digits: int, sign: str = "") -> str:
    return f"{np.mean(values):{sign}.{digits}f} +- {standard_error(values):.{digits}f}"


def tables(results: dict[str, dict]) -> tuple[Sheet, Sheet]:
    """Scores of each network, and those of the ST-LSTM less each rival's; standard errors over videos."""
    digits = dict(zip(SCORES, (2, 3, 2, 3), strict=True))
    heads = ("PSNR / dB", "SSIM", "PSNR scaled / dB", "SSIM scaled")

    def row(name: str, less: str | None = None) -> tuple[str, ...]:
        of = results[name]["clips"]
        apart = {w: [of[c][w] - (results[less]["clips"][c][w] if less else 0.0) for c in of] for w in SCORES}
        return tuple(with_error(values, digits[what], "+" if less else "") for what, values in apart.items())

    own = [
        (name, f"{of['parameters']:,}", f"{of['steps']:,}", f"{of['minutes']:.1f}", f"{of['rate']:g}", *row(name))
        for name, of in results.items()
    ]
    less = [(f"{OURS} - {name}", *row(OURS, name)) for name in results if name != OURS and OURS in results]
    first = ("network", "parameters", "steps", "minutes", "rate", *heads)
    return Sheet("Held-out clips", first, own), Sheet("Differences, paired over clips", ("networks", *heads), less)


def setting_of(options: argparse.Namespace) -> tuple[Setting, list[Clip]]:
    """What is shared, and the clips to test on. Raises ValueError for unusable clips, camera or light."""
    camera = camera_of(options.camera, options.lux, options.white_e)
    train, kept = held_out(read_clips(options.clips))
    check_sizes([*train, *kept], FRAMES, SIDE)
    if len({clip.source for clip in train}) <= VALIDATED:
        raise ValueError(
            f"--clips: expected more than {VALIDATED} videos to train on, because {VALIDATED} choose the rate"
        )
    unit_e = camera.white_e[1]
    options.out.mkdir(parents=True, exist_ok=True)
    noise = noise_map_of(camera, unit_e)
    step = len(train) // VALIDATED
    chosen_on = train[::step][:VALIDATED]
    chosen = {clip.source for clip in chosen_on}
    rest = [clip for clip in train if clip.source not in chosen]
    digest = digest_of(camera.model, camera.white_e, unit_e, [clip.frames for clip in rest])[:8]
    setting = Setting(camera, unit_e, noise, rest, chosen_on, options.width, options.out, digest)
    return setting, [clip for clip in kept if not clip.is_long]


def run(options: argparse.Namespace) -> None:
    """Train, score and write the tables. Raises ValueError as `setting_of`."""
    setting, kept = setting_of(options)
    numbers = count(1000)
    levels = np.geomspace(*setting.camera.white_e, LEVELS)
    scenes = [scene_of(setting, clip, float(level), options.crop, next(numbers)) for clip in kept for level in levels]
    budget = Budget(None if options.steps else options.minutes, options.steps)
    results: dict[str, dict] = {}
    for name in options.networks:
        net, about = trained(setting, name, best_rate(setting, name, budget, options.crop), budget)
        results[name] = about | {"clips": tested(net, scenes)}
        sheets = tables(results)
        write_atomically(options.out / "networks.json", json.dumps(results, indent=1).encode())
        write_atomically(options.out / "networks.md", "\n".join(sheet.markdown() for sheet in sheets).encode())
    for sheet in sheets:
        Console(width=150).print(sheet.rich())


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    names = (OURS, *RIVALS)
    add("--clips", type=Path, help="folder of clean clips (default: scikit-image's pictures)")
    add("--minutes", type=float, default=10.0, help="of training, for each network (default: 10)")
    add("--steps", type=int, help="steps of training for each network, instead of minutes")
    add("--camera", default="canon_5d3", help="canon_5d3, grasshopper3 or a model.json (default: canon_5d3)")
    add("--lux", type=float, nargs=2, help="dim and bright light of the scenes (default: the paper's)")
    add("--white-e", type=float, nargs=2, help="photoelectrons of white, with a model.json instead of --lux")
    add("--width", type=float, default=0.25, help="numbers of feature maps over the published ones (default: 0.25)")
    add("--crop", type=int, default=128, help="side of the tested middle of each frame, pixels (default: 128)")
    add("--networks", nargs="+", default=names, choices=names, help="default: all")
    add("--out", type=Path, default=Path("build/networks"), help="default: build/networks")
    options = parser.parse_args(argv)
    if options.minutes <= 0 or (options.steps is not None and options.steps < 1):
        parser.error(f"--minutes, --steps: expected more than 0, got {options.minutes}, {options.steps}")
    if options.width <= 0 or options.crop < SIDE:
        parser.error(f"--width, --crop: expected above 0 and at least {SIDE}, got {options.width:g}, {options.crop}")
    try:
        run(options)
    except ValueError as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        parser.exit(130, "Interrupted; the same command resumes\n")


if __name__ == "__main__":
    main()
