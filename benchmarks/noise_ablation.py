"""Does a better noise model give a better enhancer? Tested on real dark frames.

    python -m benchmarks.noise_ablation --clips FOLDER

The same network is trained for the same steps with (a) independent Gaussian noise of the sensor's variance, (b) shot
and read noise on the sensor's line of variance against mean, (c) the paper's model as hsnoise fits it, (d) that model
after `hsnoise.improve`. The networks are tested on held-out clips whose light, with shot noise, is added to dark frames
of the sensor that no fit has seen. Real and drawn frames both have the level of their darks subtracted. Finished parts
are kept in `--out`; the same command resumes.

The sensors' data are in a folder outside the project (HSNOISE_SHARED, or ../shared).
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import track

import hsnoise
from hsnoise import NoiseModel
from hsnoise._core.output import write_atomically
from hsnoise._core.sheet import Sheet
from hsnoise.chain.photometry import display_from_linear, light_of_frames
from hsnoise.cli.progress import busy
from hsnoise.enhance.mosaic import electrons_of
from hsnoise.enhance.training.clips import Clip, check_sizes, crops, held_out, read_clips
from hsnoise.enhance.training.noisy import Camera, at_exposure, matched
from hsnoise.enhance.training.presets import Recipe
from hsnoise.enhance.training.protocol import middle_of
from hsnoise.enhance.training.steps import Trainer, batch_rng, digest_of
from hsnoise.enhance.training.validation import psnr_db
from hsnoise.enhance.weights import load_network, save_network
from hsnoise.likelihood.flat_likelihood import ROUNDING_VARIANCE

NOISES = ("gaussian", "poisson-gaussian", "paper", "improved")
DIM, BRIGHT = 0.4, 1.6  # photoelectrons of the average, in standard deviations of a dark frame
BATCH, FRAMES, CROP = 4, 8, 128
OUTSIDE, NEAR = 6.0, 3.0  # standard deviations
MATCH_SIDE = 256


@dataclass(frozen=True)
class Sensor:
    """A real sensor: the capture to fit, and dark frames [frame, row, column] of one exposure that no fit sees."""

    name: str
    fitted: hsnoise.FrameStack
    unseen: np.ndarray
    exposure_s: float

    @cached_property
    def fitted_darks(self) -> np.ndarray:
        """The fitted darks nearest in exposure, DN [frame, row, column]."""
        stack = self.fitted
        darks = [i for i, kind in enumerate(stack.kind) if kind == "dark"]
        chosen = min(darks, key=lambda i: abs(stack.exposure_s[i] - self.exposure_s))
        return np.stack([stack.frame(chosen, i) for i in range(stack.n_frames[chosen])]).astype(np.float64)

    @cached_property
    def dark_sigma_dn(self) -> float:
        """Temporal standard deviation of these darks, DN, before they were rounded to counts.

        From differences of frames.
        """
        apart = np.diff(self.fitted_darks, axis=0)
        # Cosmic rays are rare and huge: differences far outside the others are clipped to just outside.
        low, high = np.quantile(apart, [0.1587, 0.8413])
        far = OUTSIDE * (high - low) / 2
        return float(np.sqrt(np.mean(np.clip(apart, -far, far) ** 2) / 2 - ROUNDING_VARIANCE))

    def dark_sigma_e(self, params: NoiseModel) -> float:
        return self.dark_sigma_dn / float(np.mean(np.asarray(params["gain"].value)))


def sensors(folder: Path) -> dict[str, Callable[[], Sensor]]:
    def read(name: str):
        return np.load(folder / f"{name}.npz"), json.loads((folder / f"{name}.json").read_text())["arrays"]

    def stack(data, about, frames: dict[str, slice], white: float) -> hsnoise.FrameStack:
        return hsnoise.FrameStack(
            [data[name][part] for name, part in frames.items()],
            [about[name]["exposure_s"] for name in frames],
            kind=["flat" if name.startswith("flat") else "dark" for name in frames],
            white_level=white,
            cfa="mono",
            shutter="global",
        )

    def imx541() -> Sensor:
        # The rows that darks and flats share; six of the eight frames of an exposure are fitted.
        data, about = read("imx541_mono_emva")
        darks = {n: (slice(6), slice(128)) for n in ("dark_000025us", "dark_006443us")}
        flats = {n: (slice(None), slice(128)) for n in ("flat_000272us", "flat_000985us")}
        # At most 6 ms without light, and cooled: the exposures differ only in length.
        unseen = np.concatenate([data[n][6:] for n in data.files if n.startswith("dark")])
        return Sensor("imx541", stack(data, about, darks | flats, 4095), unseen, about["dark_000272us"]["exposure_s"])

    def stl1001() -> Sensor:
        data, about = read("sbig_stl1001_ccd")
        frames = {n: (slice(5), slice(128)) for n in ("bias_m05C", "dark_m05C_060s")}
        frames["flat_m05C_023s"] = (slice(None), slice(128))
        exposure_s = about["dark_m05C_060s"]["exposure_s"]
        return Sensor("stl1001", stack(data, about, frames, 65535), data["dark_m05C_060s"][5:], exposure_s)

    def tc237() -> Sensor:
        data, about = read("sbig_st7e_tc237_ccd_clipped")
        middle = slice(100, 300), slice(200, 456)
        frames = {"bias": (slice(4), *middle), "flat_006s": (slice(None), *middle)}
        return Sensor("tc237", stack(data, about, frames, 65535), data["bias"][(slice(4, None), *middle)], 0.0)

    return {"imx541": imx541, "stl1001": stl1001, "tc237": tc237}


def models_of(sensor: Sensor, out: Path) -> dict[str, NoiseModel]:
    """The four noise models, saved as files."""
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
            story = hsnoise.improve(sensor.fitted, progress=say)
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


def trained(camera: Camera, name: str, noise: NoiseModel, clips, seed: int, options) -> Path:
    """Path of the weights of a network trained with the noise called `name`."""
    camera = levelled(camera, level_of(drawn_darks(noise)))
    sizes = (options.stride, options.side, options.jitter, camera.sensor)
    what = digest_of(noise, camera.model, [clip.frames for clip in clips], *sizes)[:8]
    path = options.out / f"{camera.name}-{name}-{options.maps}-{options.steps}-{seed}-{what}.eqx"
    if path.exists():
        return path
    trainer = Trainer(
        Recipe(maps=options.maps, stride=options.stride), options.steps, camera, noise, jitter=options.jitter
    )
    state = trainer.start(seed)
    text = f"{camera.name}, {name}, seed {seed}"
    for step in track(range(options.steps), text, console=Console(stderr=True), transient=True):
        batch = crops(clips, batch_rng(seed, step), BATCH, FRAMES, options.side)
        state, value = trainer.step(state, batch, seed, step)
    about = {"camera": camera.name, "noise": name, "steps": options.steps, "clips": [clip.name for clip in clips]}
    save_network(path, trainer.network(state), about)
    print(f"{text}: loss {float(value):.4f}", flush=True)
    return path


def camera_of(sensor: Sensor, paper: NoiseModel) -> Camera:
    sigma = sensor.dark_sigma_e(paper)
    camera = Camera(sensor.name, paper, (DIM * sigma, BRIGHT * sigma), sensor=sensor.fitted.shape)
    return levelled(camera, level_of(sensor.fitted_darks))


def real_scene(sensor: Sensor, clip: Clip, camera: Camera, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Display values and noisy light in units of the camera [frame, row, column, 1]: light and its shot noise on
    unseen real dark frames.

    As many frames as there are dark frames; the seed chooses the place on the sensor.
    """
    rng = np.random.default_rng(seed)
    white_e = float(np.exp(rng.uniform(*np.log(camera.mean_e)))) / clip.average
    n = min(len(sensor.unseen), len(clip.frames))
    side = min(CROP, *sensor.unseen.shape[1:], *clip.frames.shape[1:3])
    row, column = ((size - side) // 2 for size in clip.frames.shape[1:3])
    light = np.asarray(light_of_frames(clip.frames[:n, row : row + side, column : column + side], 1))
    row, column = (rng.integers(size - side + 1) for size in sensor.unseen.shape[1:])
    dark = sensor.unseen[rng.permutation(len(sensor.unseen))[:n], row : row + side, column : column + side]
    gain = float(np.mean(np.asarray(camera.model["gain"].value)))
    counts = np.rint(dark + gain * rng.poisson(light[..., 0] * white_e))
    noisy = np.asarray(electrons_of(counts, camera.model)) / camera.unit_e
    return np.asarray(display_from_linear(light), np.float32), noisy.astype(np.float32)


def measured(sensor: Sensor, path: Path, camera: Camera, clips: Sequence[Clip], places: int) -> dict[str, float]:
    """PSNR of each clip, dB, mean over several places on the sensor, which share the difficulty of a clip."""
    net, _ = load_network(path)
    video = eqx.filter_jit(lambda noisy: net.video(noisy[:, None])[:, 0])

    def psnr(clip: Clip, seed: int) -> float:
        clean, noisy = real_scene(sensor, clip, camera, seed)
        return psnr_db(np.asarray(video(jnp.asarray(noisy))), clean)

    return {
        clip.name: float(np.mean([psnr(clip, 1000 * i + place) for place in range(places)]))
        for i, clip in enumerate(clips)
    }


def table_of(results: dict[str, dict[str, list[dict[str, float]]]]) -> Sheet:
    """Mean PSNR of each sensor and noise over seeds and clips, and the gain over (b) with its standard error."""
    head = ("sensor", *NOISES, "paper - poisson-gaussian", "improved - poisson-gaussian")
    rows = []
    for sensor, of in results.items():
        row = [sensor, *(f"{np.mean([v for clips in of[name] for v in clips.values()]):.2f}" for name in NOISES)]
        for name in ("paper", "improved"):
            pairs = zip(of[name], of["poisson-gaussian"], strict=True)
            mean, error = gain_of([{clip: one[clip] - other[clip] for clip in one} for one, other in pairs])
            row.append(f"{mean:+.2f} +- {error:.2f} dB")
        rows.append(tuple(row))
    return Sheet("PSNR on real dark frames, dB", head, rows)


def gain_of(apart: list[dict[str, float]]) -> tuple[float, float]:
    """Mean of differences {clip: dB} of several seeds, and its standard error: over clips or seeds, if larger.

    Seeds hold out different clips, so both contain the scatter between clips, and the second that between trainings.
    If more seeds repeat the clips, only the first contains the scatter between clips, and both are added.
    """
    of_clips = [[of[clip] for of in apart if clip in of] for clip in sorted({clip for of in apart for clip in of})]
    of_seeds = [list(of.values()) for of in apart]
    errors = [standard_error([float(np.mean(values)) for values in groups]) for groups in (of_clips, of_seeds)]
    repeated = any(len(values) > 1 for values in of_clips)
    return float(np.mean([value for of in of_seeds for value in of])), float(np.hypot(*errors)) if repeated else max(
        errors
    )


def standard_error(means: Sequence[float]) -> float:
    """Standard error of the mean of these means; 0 for a single one, which cannot show it."""
    return float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 1 else 0.0


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--clips", type=Path, help="folder of clean clips (default: scikit-image's pictures)")
    add("--sensors", default="imx541,stl1001,tc237", help="default: imx541,stl1001,tc237")
    add("--seeds", type=int, default=4, help="trainings with each noise; each holds out different clips (default: 4)")
    add("--steps", type=int, default=2000, help="steps of each training (default: 2000)")
    add("--maps", type=int, default=12, help="feature maps of the network (default: 12)")
    add("--stride", type=int, default=2, help="side of a block of the network: 4 sees twice as far (default: 2)")
    add("--side", type=int, default=32, help="side of the training crops, pixels (default: 32)")
    add(
        "--jitter",
        type=float,
        default=0.0,
        help="rms by which the logarithms of the noise's parameters vary in training (default: 0, the fit as it is:"
        " a dark current that varies moves the black of all noises but the Gaussian, which has it in its black level)",
    )
    add("--places", type=int, default=3, help="places on the sensor for each clip (default: 3)")
    add("--out", type=Path, default=Path("build/ablation"), help="default: build/ablation")
    options = parser.parse_args(argv)
    folder = Path(os.environ.get("HSNOISE_SHARED", "../shared")) / "data"
    known, asked = sensors(folder), options.sensors.split(",")
    if not folder.is_dir() or set(asked) - set(known):
        parser.error(f"--sensors: expected some of {', '.join(known)}, with their data in {folder}")
    if options.seeds < 2:
        parser.error(f"--seeds: expected at least 2, because trainings scatter; got {options.seeds}")
    if not 0 <= options.jitter <= 1:
        parser.error(f"--jitter: expected 0 to 1, got {options.jitter:g}")
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
    results: dict[str, dict[str, list[dict[str, float]]]] = {}
    for name in asked:
        sensor = known[name]()
        models = models_of(sensor, options.out)
        camera = camera_of(sensor, models["paper"])
        of: dict[str, list[dict[str, float]]] = {noise: [] for noise in NOISES}
        for seed, (train, kept) in enumerate(folds):
            shown = [clip for clip in kept if not clip.is_long]
            for noise in NOISES:
                path = trained(camera, noise, models[noise], train, seed, options)
                of[noise].append(measured(sensor, path, camera, shown, options.places))
        results[name] = of
        sheet = table_of(results)
        Console(width=130).print(sheet.rich())
        write_atomically(options.out / "ablation.md", sheet.markdown().encode())
        write_atomically(options.out / "ablation.json", json.dumps(results).encode())


if __name__ == "__main__":
    main()
