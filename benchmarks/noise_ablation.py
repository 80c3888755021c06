"""Does a better noise model give a better enhancer? Tested on real dark frames.

    python -m benchmarks.noise_ablation --clips FOLDER

The same network is trained for the same steps with (a) independent Gaussian noise of the sensor's variance, (b) shot
and read noise on the sensor's line of variance against mean, (c) the paper's model as hsnoise fits it, (d) that model
after `hsnoise.improve`. Two limits: (e) light and its shot noise on the real dark frames that were fitted, which is the
most that a noise model can give, and (f) the same with their pixels shuffled, all frames alike: real distributions
without structure. The networks are tested on held-out clips whose light, with shot noise, is added to dark frames of
the sensor that no fit has seen. Real and drawn frames both have the level of their darks subtracted. Outputs are scored
as they are, and scaled in brightness to the truth. `--networks st-lstm,toflow` does it with both networks. Finished
parts are kept in `--out`; the same command resumes. The settings of the runs in docs/results.md are those of
ablation.toml.

The sensors' data are in a folder outside the project (HSNOISE_SHARED, or ../shared).
"""

from __future__ import annotations

import argparse
import json
import os
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from skimage.metrics import structural_similarity

import hsnoise
from benchmarks._ablation_networks import NETWORKS, Kind, Video
from benchmarks._ablation_sensors import Sensor, sensors
from benchmarks._ablation_tables import NOISES, REAL, SCORES, SHUFFLED, picked, table_of
from hsnoise import NoiseModel
from hsnoise._core.output import write_atomically, write_figure
from hsnoise.chain.photometry import display_from_linear, light_of_frames
from hsnoise.cli.progress import busy
from hsnoise.criticism.improve import improved
from hsnoise.enhance.mosaic import electrons_of
from hsnoise.enhance.training.clips import Batch, Clip, check_sizes, crops, held_out, read_clips
from hsnoise.enhance.training.noisy import Camera, at_exposure, matched
from hsnoise.enhance.training.protocol import PROTOCOL, middle_of, scaled_to
from hsnoise.enhance.training.scenes import Scene
from hsnoise.enhance.training.steps import batch_rng, digest_of
from hsnoise.enhance.training.tables import REFER, draw_frames
from hsnoise.enhance.training.validation import psnr_db

SETTINGS = Path(__file__).parent / "ablation.toml"
DIM, BRIGHT = 0.4, 1.6  # photoelectrons of the average, in standard deviations of a dark frame
BATCH, FRAMES, CROP = 4, 8, 128
NEAR = 3.0  # standard deviations
MATCH_SIDE = 256
ON_DARKS = "light on darks is not rounded"  # kept with the weights' names: others were trained differently
Scored = dict[str, dict[str, float]]  # {clip: {score: value}}


def models_of(sensor: Sensor, out: Path, minutes: float) -> dict[str, NoiseModel]:
    """The four noise models, saved as files; minutes: of `improve`."""
    paths = {name: out / f"{sensor.name}-{name}.json" for name in NOISES}
    if not paths["paper"].exists():
        print(f"{sensor.name}: fitting")
        fit = hsnoise.fit(sensor.fitted)
        print(fit)
        params = at_exposure(fit.params, sensor.exposure_s)
        sigma = sensor.dark_sigma_e(params)
        light_e = middle_of((DIM, BRIGHT)) * sigma
        for name in ("gaussian", "poisson-gaussian"):
            matched(params, name, light_e, sigma**2).save(paths[name])
        params.save(paths["paper"])  # written last: it shows that all three exist
    if not paths["improved"].exists():
        print(f"{sensor.name}: improving")
        with busy("Fitting the first model") as say:
            story = improved(sensor.fitted, say, max_minutes=minutes)
        write_atomically(out / f"{sensor.name}-story.txt", f"{story}\n".encode())
        at_exposure(story.fit.params, sensor.exposure_s).save(paths["improved"])
    return {name: NoiseModel.load(path) for name, path in paths.items()}


def level_of(darks: np.ndarray) -> float:
    """Mean of dark frames, DN, without outliers such as hot pixels."""
    low, middle, high = np.quantile(darks, [0.1587, 0.5, 0.8413])
    near = np.abs(darks - middle) <= NEAR * max((high - low) / 2, 1.0)
    return float(darks[near].mean())


def levelled(camera: Camera, level_dn: float) -> Camera:
    """The camera with the black level at which dark frames have the mean `level_dn`, as a user would subtract it.

    So a noise model is judged by its noise, not by its fitted level at one exposure.
    """
    model = camera.model
    dark_dn = np.asarray(model["gain"].value) * float(model["dark_current"].rate) * model.exposure_s
    return replace(camera, model=model.with_value("black_level", "value", level_dn - dark_dn))


def drawn_darks(noise: NoiseModel) -> np.ndarray:
    return np.asarray(hsnoise.sample_dark(jax.random.key(0), FRAMES, (MATCH_SIDE, MATCH_SIDE), noise), np.float64)


def trained(
    kind: Kind, camera: Camera, name: str, noise: NoiseModel | np.ndarray, clips: Sequence[Clip], seed: int, options
) -> Path:
    """Path of the weights of a network trained with the noise called `name`: a model's, or that of dark frames."""
    darks = noise if isinstance(noise, np.ndarray) else None
    model = noise if darks is None else camera.model
    if darks is None:
        camera = levelled(camera, level_of(drawn_darks(model)))
    sizes = (options.stride, options.side, options.jitter, camera.sensor, camera.mean_e, PROTOCOL)
    sizes += () if darks is None else (ON_DARKS,)
    what = digest_of(noise, camera.model, [clip.frames for clip in clips], *sizes)[:8]
    path = options.out / f"{kind.prefix}{camera.name}-{name}-{options.maps}-{options.steps}-{seed}-{what}.eqx"
    if path.exists():
        return path
    trainer = kind.trainer(camera, model, options)
    state = trainer.start(seed)
    text = f"{kind.prefix}{camera.name}, {name}, seed {seed}"
    for step in track(range(options.steps), text, console=Console(stderr=True), transient=True):
        rng = batch_rng(seed, step)
        batch = crops(clips, rng, BATCH, FRAMES, options.side)
        if darks is None:
            state, value = trainer.step(state, batch, seed, step)
        else:
            state, value = trainer.learn(state, *real_examples(batch, darks, camera, rng))
    about = {"camera": camera.name, "noise": name, "steps": options.steps, "clips": [clip.name for clip in clips]}
    kind.save(path, trainer.network(state), about)
    print(f"{text}: loss {float(value):.4f}", flush=True)
    return path


def camera_of(sensor: Sensor, paper: NoiseModel) -> Camera:
    sigma = sensor.dark_sigma_e(paper)
    camera = Camera(sensor.name, paper, (DIM * sigma, BRIGHT * sigma), sensor=sensor.fitted.shape)
    return levelled(camera, level_of(sensor.fitted_darks))


def shuffled(darks: np.ndarray) -> np.ndarray:
    """Dark frames [frame, row, column] whose pixels have changed places, in all frames alike."""
    order = np.random.default_rng(0).permutation(darks[0].size)
    return darks.reshape(len(darks), -1)[:, order].reshape(darks.shape)


def on_darks(light: np.ndarray, white_e: float, darks: np.ndarray, camera: Camera, rng: np.random.Generator):
    """Noisy light, in units of the camera [frame, row, column, 1], of light [frame, row, column, 1] (white is 1).

    With its shot noise it is added to dark frames [frame, row, column], in any order, at a random place of the sensor.
    """
    n, rows, columns = light.shape[:3]
    row, column = (rng.integers(most - size + 1) for most, size in zip(darks.shape[1:], (rows, columns), strict=True))
    order = rng.permutation(np.arange(max(n, len(darks))) % len(darks))[:n]
    dark = darks[order, row : row + rows, column : column + columns]
    gain = float(np.mean(np.asarray(camera.model["gain"].value)))
    # Darks have been rounded already. Twice, and single photoelectrons would vanish at a gain below 0.5 DN/e-.
    counts = dark + gain * rng.poisson(light[..., 0] * white_e)
    return np.asarray(electrons_of(counts, camera.model), np.float32) / camera.unit_e


def random_white_e(average: float, camera: Camera, rng: np.random.Generator) -> float:
    """Photoelectrons of white, e-, in a scene whose light has this average, and E[N_e] somewhere in the range."""
    return float(np.exp(rng.uniform(*np.log(camera.mean_e)))) / average


def real_examples(
    batch: Batch, darks: np.ndarray, camera: Camera, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Clean display values and noisy light [example, frame, row, column, 1] on darks, as `examples` makes them."""
    linear = np.asarray(light_of_frames(batch.frames, 1))
    white = [random_white_e(float(average), camera, rng) for average in batch.average]
    noisy = [on_darks(light, white_e, darks, camera, rng) for light, white_e in zip(linear, white, strict=True)]
    return np.asarray(display_from_linear(linear), np.float32), np.stack(noisy).astype(np.float32)


def real_scene(
    sensor: Sensor, clip: Clip, camera: Camera, seed: int, mean_e: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Display values and noisy light in units of the camera [frame, row, column, 1].

    Light that averages `mean_e` photoelectrons over the clip (None: somewhere in the range), and its shot noise, on
    unseen real dark frames. As many frames as there are dark frames; the seed chooses the place on the sensor.
    """
    rng = np.random.default_rng(seed)
    n = min(len(sensor.unseen), len(clip.frames))
    side = min(CROP, *sensor.unseen.shape[1:], *clip.frames.shape[1:3])
    row, column = ((size - side) // 2 for size in clip.frames.shape[1:3])
    light = np.asarray(light_of_frames(clip.frames[:n, row : row + side, column : column + side], 1))
    white_e = random_white_e(clip.average, camera, rng) if mean_e is None else mean_e / clip.average
    noisy = on_darks(light, white_e, sensor.unseen, camera, rng)
    return np.asarray(display_from_linear(light), np.float32), noisy.astype(np.float32)


def measured(sensor: Sensor, video: Video, camera: Camera, clips: Sequence[Clip], places: int) -> Scored:
    """Scores of each clip, means over several places on the sensor, which share the difficulty of a clip."""

    def scored(clip: Clip, seed: int) -> tuple[float, ...]:
        clean, noisy = real_scene(sensor, clip, camera, seed)
        found = video(jnp.asarray(noisy))
        scaled = scaled_to(found, clean)
        pairs = zip(scaled, clean, strict=True)
        ssim = [structural_similarity(one, truth, channel_axis=-1, data_range=1.0) for one, truth in pairs]
        return psnr_db(found, clean), psnr_db(scaled, clean), float(np.mean(ssim))

    means = {
        clip.name: np.mean([scored(clip, 1000 * i + place) for place in range(places)], 0)
        for i, clip in enumerate(clips)
    }
    return {clip: dict(zip(SCORES, map(float, of), strict=True)) for clip, of in means.items()}


def pictured(sensor: Sensor, camera: Camera, clip: Clip, videos: dict[str, Video]) -> Figure:
    """The last frame of a clip in the middle of the light, on real darks, by networks trained with each noise."""
    mean_e = middle_of(camera.mean_e)
    clean, noisy = real_scene(sensor, clip, camera, 0, mean_e)
    found = {name: of(jnp.asarray(noisy)) for name, of in videos.items()}
    found = {REFER: np.asarray(display_from_linear(noisy)), **found}
    scaled = {name: scaled_to(frames, clean) for name, frames in found.items()}
    return draw_frames(Scene(clip.name, camera, mean_e, mean_e / clip.average, clean, noisy), scaled)


def judged(
    kind: Kind, sensor: Sensor, folds: Sequence[tuple[list[Clip], list[Clip]]], options
) -> dict[str, list[Scored]]:
    """Scores of each clip in each fold, by the noise that networks of this kind were trained with."""
    models = models_of(sensor, options.out, options.minutes)
    camera = camera_of(sensor, models["paper"])
    noises = {**models, REAL: sensor.fitted_darks, SHUFFLED: shuffled(sensor.fitted_darks)}
    found: dict[str, list[Scored]] = {name: [] for name in noises}
    for seed, (train, kept) in enumerate(folds):
        shown = [clip for clip in kept if not clip.is_long]
        paths = {name: trained(kind, camera, name, noise, train, seed, options) for name, noise in noises.items()}
        videos = {name: kind.video(path, camera) for name, path in paths.items()}
        for name, video in videos.items():
            found[name].append(measured(sensor, video, camera, shown, options.places))
        if seed == 0:
            picture = pictured(sensor, camera, shown[0], videos)
            write_figure(options.out / f"{kind.prefix}{sensor.name}.png", picture, dpi=110)
    return found


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--clips", type=Path, help="folder of clean clips (default: scikit-image's pictures)")
    add("--sensors", help="separated by commas")
    add("--networks", help=f"of {', '.join(NETWORKS)}, separated by commas")
    add("--seeds", type=int, help="trainings with each noise; each holds out different clips")
    add("--minutes", type=float, help="of `improve`, for each sensor")
    add("--steps", type=int, help="steps of each training")
    add("--maps", type=int, help="feature maps of the network")
    add("--stride", type=int, help="side of a block of the network: 4 sees twice as far as 2")
    add("--side", type=int, help="side of the training crops, pixels")
    add(
        "--jitter",
        type=float,
        help="rms by which the logarithms of the noise's parameters vary in training (0: the fit as it is; a dark"
        " current that varies moves the black of all noises but the Gaussian, which has it in its black level)",
    )
    add("--places", type=int, help="places on the sensor for each clip")
    add("--out", type=Path, default=Path("build/ablation"), help="default: build/ablation")
    parser.set_defaults(**tomllib.loads(SETTINGS.read_text()))
    options = parser.parse_args(argv)
    folder = Path(os.environ.get("HSNOISE_SHARED", "../shared")) / "data"
    known, asked, networks = sensors(folder), options.sensors.split(","), options.networks.split(",")
    if not folder.is_dir() or set(asked) - set(known):
        parser.error(f"--sensors: expected some of {', '.join(known)}, with their data in {folder}")
    if set(networks) - set(NETWORKS):
        parser.error(f"--networks: expected some of {', '.join(NETWORKS)}, got {options.networks}")
    if options.seeds < 2:
        parser.error(f"--seeds: expected at least 2, because trainings scatter; got {options.seeds}")
    if not 0 <= options.jitter <= 1:
        parser.error(f"--jitter: expected 0 to 1, got {options.jitter:g}")
    if not options.minutes > 0:
        parser.error(f"--minutes: expected above 0, got {options.minutes:g}")
    for option in ("steps", "maps", "stride", "side", "places"):
        if getattr(options, option) < 1:
            parser.error(f"--{option}: expected at least 1, got {getattr(options, option)}")
    try:
        clips = read_clips(options.clips)
        folds = [held_out(clips, seed) for seed in range(options.seeds)]
        check_sizes(clips, FRAMES, options.side)
    except (ValueError, ImportError) as error:
        parser.error(str(error))
    if len({clip.source for _, kept in folds for clip in kept}) < 2:
        parser.error("--clips, --seeds: expected at least two held-out videos, for an error over clips")
    options.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, dict[str, dict[str, list[Scored]]]] = {network: {} for network in networks}
    for name in asked:
        sensor = known[name]()
        for network in networks:
            results[network][name] = judged(NETWORKS[network], sensor, folds, options)
        write_results(results, options.out)


def write_results(results: dict[str, dict[str, dict[str, list[Scored]]]], out: Path) -> None:
    """ablation.md and ablation.json of what is done by now; the tables are printed."""
    sheets = [table_of(picked(of, score), score, network) for network, of in results.items() for score in SCORES if of]
    for sheet in sheets:
        Console(width=180).print(sheet.rich())
    write_atomically(out / "ablation.md", "\n".join(sheet.markdown() for sheet in sheets).encode())
    write_atomically(out / "ablation.json", json.dumps(results).encode())


if __name__ == "__main__":
    main()
