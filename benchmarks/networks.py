"""The ST-LSTM against published networks, trained alike: PSNR and SSIM on held-out clips.

    python -m benchmarks.networks --clips FOLDER --minutes 10 --camera canon_5d3 --out build/networks
    python -m benchmarks.networks --clips FOLDER --untrained

Every network sees the same noise and the same pieces of the same clips in the same order, for the same time of training
(without compilation; or the same number of steps, `--steps`). Its learning rate falls by a cosine from the best of
three, each tried for a sixth of that time and judged on the split's validation clips, which are neither trained on nor
tested. Each has the loss of its paper (the ST-LSTM's without the perceptual term). Networks with a window are trained
on those of the 8 frames of a piece that have one (FFDNet 8, FastDVDnet 4, TOFlow 2, KPN 1), and tested on all frames of
a video that is reflected at its ends: unlike the ST-LSTM they also see later frames. `--untrained` adds methods that
need no training, tuned on the first validation clip, and the input itself; `--weights` a network of `hsnoise train`,
such as those that come with hsnoise. Outputs are scored as they are, and scaled
in brightness to the truth. Finished trainings and scores are kept in `--out`; the same command resumes. `--noise
gaussian` trains with simpler noise of the same strength; tests have the camera's. Tables, scores of each frame
(networks.csv), their curves (networks.png) and the last frame of each clip (CLIP.png) show all methods that `--out` has
for the same training, light and clips, those of earlier commands, too.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from rich.console import Console

from benchmarks._network_figures import draw_scene, draw_scores
from benchmarks._network_scores import csv_of, keep, picture_name, scores_of, tables, write_picture
from benchmarks.rivals.fastdvdnet import FastDVDnet
from benchmarks.rivals.ffdnet import FFDNet
from benchmarks.rivals.kpn import KPN
from benchmarks.rivals.layers import Noise, Rival, noise_map_of
from benchmarks.rivals.toflow import TOFlow
from hsnoise._core.keys import named_key
from hsnoise._core.output import write_atomically, write_figure
from hsnoise._core.sheet import Sheet
from hsnoise.chain.photometry import display_from_linear
from hsnoise.enhance.training.clips import Batch, Clip, check_sizes, crops, read_clips
from hsnoise.enhance.training.evaluate import Method, at_its_best, check_weights, prepared
from hsnoise.enhance.training.noisy import JITTER, Camera, Shape, camera_of, noise_of
from hsnoise.enhance.training.protocol import middle_of, scaled_to
from hsnoise.enhance.training.rivals import Denoiser, rivals
from hsnoise.enhance.training.scenes import Scene, scene_of
from hsnoise.enhance.training.split import split_of
from hsnoise.enhance.training.steps import batch_rng, digest_of, examples
from hsnoise.enhance.training.tables import REFER
from hsnoise.enhance.training.validation import psnr_db
from hsnoise.enhance.weights import load_network, read_arrays, write_arrays
from hsnoise.model import NoiseModel
from hsnoise.stlstm import STLSTM, loss

OURS, WEIGHTS, AT_BEST = "ST-LSTM", "weights", "weights both ways, mirrored"
RIVALS: dict[str, type[Rival]] = {"FFDNet": FFDNet, "KPN": KPN, "TOFlow": TOFlow, "FastDVDnet": FastDVDnet}
MINUTES = 10.0  # of a training
RATES = (3e-4, 1e-3, 3e-3)
TRIAL = 1 / 6  # of the budget, for each rate
FRAMES, SIDE = 8, 64
MAPS, STRIDE = 64, 4  # of the ST-LSTM
UNROLLED = 4  # of its frames, on a GPU
LEVELS, TESTED_FRAMES = 5, 10  # 10: all clips have as many, so that networks are compiled once
SEED = 0
SPLIT = Path(__file__).parent / "split.toml"
OPTIMISER = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1.0))  # as `hsnoise train`; rates are arguments


class Ours(eqx.Module):
    """The ST-LSTM as the rivals are used. unroll: frames that are compiled into one piece."""

    net: STLSTM
    unroll: int = eqx.field(static=True, default=1)

    def whole_video(self, frames: jax.Array) -> jax.Array:
        return self.net.video(frames)

    def loss(self, frames: jax.Array, clean: jax.Array, done: jax.Array) -> jax.Array:
        return loss(self.net.video(frames, unroll=self.unroll), clean)


@dataclass(frozen=True)
class Budget:
    """What a training may use: minutes, a number of steps, or whichever ends first."""

    minutes: float | None
    steps: int | None

    def part(self, share: float) -> Budget:
        return Budget(
            None if self.minutes is None else share * self.minutes,
            None if self.steps is None else max(1, round(share * self.steps)),
        )

    def used(self, steps: int, minutes: float) -> float:
        """The share that is used up after so many steps and minutes."""
        return max(0.0 if most is None else of / most for of, most in ((steps, self.steps), (minutes, self.minutes)))

    def __str__(self) -> str:
        parts = "" if self.steps is None else f"{self.steps}", "" if self.minutes is None else f"{self.minutes:g}min"
        return "-".join(filter(None, parts))


@dataclass(frozen=True, eq=False)
class Setting:
    """What all trainings share.

    model: the camera's, trained_on: that of the noise in training, both in single precision; noise: for noise maps;
    pieces: of clips in a step; digest: of the camera, its light and all clips; noise_digest: of the noise, too.
    """

    camera: Camera
    model: NoiseModel
    trained_on: NoiseModel
    noise: Noise
    train: Sequence[Clip]
    validation: Sequence[Clip]
    width: float
    pieces: int
    out: Path
    digest: str
    noise_digest: str

    def make(self, name: str) -> Callable[[jax.Array], Any]:
        """The network of this name, from a random key."""
        if name in RIVALS:
            return partial(RIVALS[name], noise=self.noise, width=self.width)
        maps = max(1, round(MAPS * self.width))
        unroll = 1 if jax.default_backend() == "cpu" else UNROLLED
        return lambda key: Ours(STLSTM(key, maps=maps, stride=STRIDE, channels=self.camera.channels), unroll)

    def batch(self, step: int) -> Batch:
        return crops(self.train, batch_rng(SEED, step), self.pieces, FRAMES, SIDE)

    def start(self, name: str) -> tuple[Any, Any]:
        """The untrained network and its optimiser's state."""
        net = self.make(name)(named_key(jax.random.key(SEED), "network"))
        return net, OPTIMISER.init(eqx.filter(net, eqx.is_array))

    def step(self, state: tuple[Any, Any], number: int, done: float, rate: float) -> tuple[tuple[Any, Any], jax.Array]:
        """State after step `number`, when this share of the training is done, and the loss."""
        key = jax.random.fold_in(named_key(jax.random.key(SEED), "noise"), number)
        light = jnp.asarray(self.camera.mean_e, jnp.float32)
        rates = jnp.asarray([rate * (1 + math.cos(math.pi * done)) / 2, done], jnp.float32)
        models = self.model, self.trained_on
        return _step(state, self.batch(number), key, *models, light, self.camera.sensor, *rates)


@eqx.filter_jit
def _step(state, batch: Batch, key, camera: NoiseModel, noise: NoiseModel, light, sensor: Shape | None, rate, done):
    net, memory = state
    pair = examples(batch, key, camera, noise, light, JITTER, sensor)
    clean, noisy = (frames.swapaxes(0, 1) for frames in pair)
    value, slope = eqx.filter_value_and_grad(lambda net: net.loss(noisy, clean, done))(net)
    change, memory = OPTIMISER.update(slope, memory)
    return (eqx.apply_updates(net, jax.tree.map(lambda of: rate * of, change)), memory), value


@eqx.filter_jit
def _enhanced(net, noisy: jax.Array) -> jax.Array:
    return net.whole_video(noisy[:, None])[:, 0]


def named(setting: Setting, name: str, budget: Budget) -> str:
    return f"{name}-{setting.width:g}-{setting.pieces}-{budget}-{setting.noise_digest}"


def trained(setting: Setting, name: str, rate: float, budget: Budget) -> tuple[Any, dict]:
    """The network after training, and what is known of it: read from `--out` if a finished one is there."""
    path = setting.out / f"{named(setting, name, budget)}-{rate:g}.eqx"
    if path.exists():
        return read_arrays(path, eqx.filter_eval_shape(setting.make(name), jax.random.key(0)))
    setting.step(setting.start(name), 0, 0.0, rate)[1].block_until_ready()  # compiles
    state, begun, number, done = setting.start(name), time.monotonic(), 0, 0.0
    while done < 1:
        state, value = setting.step(state, number, done, rate)
        value.block_until_ready()
        number += 1
        done = budget.used(number, (time.monotonic() - begun) / 60)
    about = {"network": name, "rate": rate, "steps": number, "loss": float(value)}
    about |= {"minutes": (time.monotonic() - begun) / 60, "parameters": parameters_of(state[0])}
    write_arrays(path, state[0], about)
    print(f"{name}, rate {rate:g}: {number} steps in {about['minutes']:.1f} min, loss {about['loss']:.4f}", flush=True)
    return state[0], about


def parameters_of(net: Any) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(net, eqx.is_array)))


def best_rate(setting: Setting, name: str, budget: Budget, rates: Sequence[float], crop: int) -> float:
    """The rate with the highest PSNR on the validation clips after a short training; a single one is not tried."""
    if len(rates) == 1:
        return rates[0]
    mean_e = middle_of(setting.camera.mean_e)
    clips = enumerate(setting.validation)
    scenes = [scene_of(clip, setting.camera, mean_e, crop, seed, TESTED_FRAMES) for seed, clip in clips]

    def quality(rate: float) -> float:
        net, _ = trained(setting, name, rate, budget.part(TRIAL))
        return float(np.mean([psnr_db(np.asarray(_enhanced(net, scene.noisy)), scene.clean) for scene in scenes]))

    found = {rate: quality(rate) for rate in rates}
    print(f"{name}: " + ", ".join(f"{value:.2f} dB at rate {rate:g}" for rate, value in found.items()), flush=True)
    # A diverged training has no PSNR.
    return max(rates, key=lambda rate: found[rate] if np.isfinite(found[rate]) else -np.inf)


def _of_scene(net: Any, scene: Scene) -> np.ndarray:
    return np.asarray(_enhanced(net, scene.noisy))


def _at_its_best(net: Any, scene: Scene) -> np.ndarray:
    return at_its_best(lambda noisy: np.asarray(_enhanced(net, noisy[:, 0]))[:, None], scene)


def tested(method: Method, scenes: Sequence[Scene], shown: Path) -> list[dict[str, Any]]:
    """Scores of each frame of all scenes. method: display values of a scene; shown: folder for their last frames."""
    shown.mkdir(parents=True, exist_ok=True)
    records = []
    for scene in scenes:
        found = method(scene)
        scaled = scaled_to(found, scene.clean)
        records += scores_of(found, scaled, scene)
        write_picture(shown / picture_name(scene), scaled[-1])
    return records


def setting_of(options: argparse.Namespace) -> tuple[Setting, list[Clip]]:
    """What is shared, and the clips to test on. Raises ValueError for unusable clips, split, camera or light."""
    light = (None if of is None else tuple(of) for of in (options.lux, options.mean_e))
    camera = camera_of(options.camera, *light)
    training, *others = split_of(read_clips(options.clips), options.split)
    validation, test = ([clip for clip in clips if not clip.is_long] for clips in others)
    check_sizes([*training, *validation, *test], FRAMES, SIDE)
    options.out.mkdir(parents=True, exist_ok=True)
    models = camera.model, noise_of(options.noise, camera)
    seen = camera.mean_e, [clip.frames for clip in (*training, *validation, *test)]
    digests = digest_of(camera.model, *seen)[:8], digest_of(models, *seen)[:8]
    models = (jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), model) for model in models)
    sizes = options.width, options.batch, options.out
    return Setting(camera, *models, noise_map_of(camera), training, validation, *sizes, *digests), test


def suffix_of(noise: str) -> str:
    """What the name of a network that was trained with this noise ends with."""
    return "" if noise == "hsnoise" else f", {Path(noise).stem} noise"


def folders_of(setting: Setting, budget: Budget, options: argparse.Namespace) -> tuple[Path, Path]:
    """Where scores are that may be compared: of networks that were trained alike, and of what needs no training."""
    rates = "-".join(f"{rate:g}" for rate in options.rates)
    tests = f"{options.crop}-{setting.digest}"
    alike = f"{setting.width:g}-{setting.pieces}-{budget}-{rates}-{tests}"
    return setting.out / f"trained-{alike}", setting.out / f"untrained-{tests}"


def measures(
    setting: Setting, scenes: Sequence[Scene], options: argparse.Namespace
) -> tuple[tuple[Path, Path], list[Callable[[], None]]]:
    """Folders of scores, and what trains or tunes each method if need be and writes its scores there."""
    budget = Budget(options.minutes if options.minutes or options.steps else MINUTES, options.steps)
    noise, folders = suffix_of(options.noise), folders_of(setting, budget, options)

    def of_network(name: str) -> dict[str, Any]:
        rate = best_rate(setting, name, budget, options.rates, options.crop)
        net, about = trained(setting, name, rate, budget)
        return about | {"frames": tested(partial(_of_scene, net), scenes, folders[0] / f"{name}{noise}")}

    def of_untrained(name: str, denoise: Denoiser) -> dict[str, Any]:
        mean_e = middle_of(setting.camera.mean_e)
        tuning = scene_of(setting.validation[0], setting.camera, mean_e, options.crop, 99, TESTED_FRAMES)
        return {"frames": tested(prepared(name, denoise, tuning), scenes, folders[1] / name)}

    def of_input() -> dict[str, Any]:
        return {
            "frames": tested(lambda scene: np.asarray(display_from_linear(scene.noisy)), scenes, folders[1] / REFER)
        }

    def of_weights(name: str) -> dict[str, Any]:
        net = Ours(load_network(options.weights)[0])
        method = _of_scene if name == WEIGHTS else _at_its_best
        return {"frames": tested(partial(method, net), scenes, folders[1] / name)}

    digests = setting.noise_digest, setting.digest
    found = [
        partial(keep, folders[0] / f"{name}{noise}.json", digests[0], of_network, name) for name in options.networks
    ]
    if options.weights is not None:
        of_file = f"{digests[1]}-{hashlib.sha256(options.weights.read_bytes()).hexdigest()[:8]}"
        names = WEIGHTS, AT_BEST
        found += [partial(keep, folders[1] / f"{name}.json", of_file, of_weights, name) for name in names]
    if options.untrained:
        found.append(partial(keep, folders[1] / f"{REFER}.json", digests[1], of_input))
        for name, denoise in rivals().items():
            found.append(partial(keep, folders[1] / f"{name}.json", digests[1], of_untrained, name, denoise))
    return folders, found


def write_tables(folders: tuple[Path, Path], ours: str, out: Path) -> tuple[dict[str, Path], list[Sheet]]:
    """Files of all scores in these folders by method, and tables of them; tables and scores are written to `out`."""
    of_methods = {path.stem: path for folder in folders for path in sorted(folder.glob("*.json"))}
    of_methods = {name: of_methods[name] for name in sorted(of_methods, key=lambda name: name != ours)}
    results = {name: json.loads(path.read_text()) for name, path in of_methods.items()}
    sheets = tables(results, ours, AT_BEST)
    write_atomically(out / "networks.md", "\n".join(sheet.markdown() for sheet in sheets).encode())
    write_atomically(out / "networks.csv", csv_of(results).encode())
    return of_methods, sheets


def write_figures(of_methods: dict[str, Path], scenes: Sequence[Scene], ours: str, out: Path) -> None:
    """Curves of all scores, and the last frame of each clip in the middle of the light by all methods."""
    results = {name: json.loads(path.read_text()) for name, path in of_methods.items()}
    write_figure(out / "networks.png", draw_scores(results, ours, scenes[0].camera.in_words), dpi=110)
    middle = sorted({scene.mean_e for scene in scenes})[LEVELS // 2]
    pictures = {name: path.with_suffix("") for name, path in of_methods.items()}
    for scene in scenes:
        if scene.mean_e == middle:
            write_figure(out / f"{scene.clip}.png", draw_scene(scene, pictures), dpi=110)


def run(options: argparse.Namespace) -> None:
    """Train, score and write the tables. Raises ValueError as `setting_of`."""
    setting, test = setting_of(options)
    if options.weights is not None:
        check_weights(options.weights, *load_network(options.weights), setting.camera, test)
    tasks = [(clip, float(level)) for clip in test for level in np.geomspace(*setting.camera.mean_e, LEVELS)]
    scenes = [
        scene_of(clip, setting.camera, level, options.crop, 1000 + number, TESTED_FRAMES)
        for number, (clip, level) in enumerate(tasks)
    ]
    folders, found = measures(setting, scenes, options)
    ours = OURS + suffix_of(options.noise) if options.weights is None else WEIGHTS
    for measure in found:
        measure()
        of_methods, sheets = write_tables(folders, ours, options.out)
    write_figures(of_methods, scenes, ours, options.out)
    for sheet in sheets:
        Console(width=150).print(sheet.rich())


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    names = (OURS, *RIVALS)
    add("--clips", type=Path, required=True, help="folder of clean clips")
    add(
        "--split",
        type=Path,
        default=SPLIT,
        help="which clips train, validate and test (default: benchmarks/split.toml)",
    )
    add("--minutes", type=float, help=f"of training, for each network (default: {MINUTES:g}, without --steps)")
    add("--steps", type=int, help="of training, for each network; with --minutes whichever ends first")
    add("--noise", default="hsnoise", help="in training: hsnoise, gaussian, poisson-gaussian or a model.json")
    add("--rates", type=float, nargs="+", default=RATES, help="learning rates that are tried (default: 3e-4 1e-3 3e-3)")
    add("--camera", default="canon_5d3", help="canon_5d3, grasshopper3 or a model.json (default: canon_5d3)")
    add("--lux", type=float, nargs=2, help="dim and bright light of the scenes (default: the paper's)")
    add("--mean-e", type=float, nargs=2, help="photoelectrons that scenes average, with a model.json instead of --lux")
    add("--width", type=float, default=0.25, help="numbers of feature maps over the published ones (default: 0.25)")
    add("--batch", type=int, default=4, help="pieces of clips in a step of training (default: 4)")
    add("--crop", type=int, default=128, help="side of the tested middle of each frame, pixels (default: 128)")
    add("--networks", nargs="*", default=names, choices=names, help="default: all")
    add("--untrained", action="store_true", help="non-local means, total variation, and BM3D, BM4D if installed, too")
    add("--weights", type=Path, help="weights.eqx of `hsnoise train`, scored beside the others")
    add("--out", type=Path, default=Path("build/networks"), help="default: build/networks")
    options = parser.parse_args(argv)
    for option in ("minutes", "steps"):
        if (value := getattr(options, option)) is not None and not 0 < value < math.inf:
            parser.error(f"--{option}: expected more than 0, got {value:g}")
    if not (options.networks or options.untrained or options.weights):
        parser.error("--networks: expected a network at least, --weights or --untrained")
    if min(options.rates) <= 0:
        parser.error(f"--rates: expected above 0, got {options.rates}")
    if options.width <= 0 or options.crop < SIDE or options.batch < 1:
        parser.error(
            f"--width, --batch, --crop: expected above 0, at least 1 and at least {SIDE},"
            f" got {options.width:g}, {options.batch}, {options.crop}"
        )
    try:
        run(options)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        parser.exit(130, "Interrupted; the same command resumes\n")


if __name__ == "__main__":
    main()
