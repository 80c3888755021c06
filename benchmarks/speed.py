"""Speed of sampling and its gradient, histograms, likelihood, fits, diagnosis and training, compared with what users
would use instead.

    python -m benchmarks.speed
    python -m benchmarks.speed --only sampling,passes --rounds 3

Contestants take turns, so that a busy machine slows them equally; the table gives medians. PyTorch is included if
installed. Growth is the slope of log time against log size.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import isqrt
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import hsnoise
from hsnoise.chain.photometry import GREY
from hsnoise.effects import ADC
from hsnoise.enhance.training.clips import Batch
from hsnoise.enhance.training.noisy import camera_of
from hsnoise.enhance.training.presets import Recipe
from hsnoise.enhance.training.steps import Trainer, examples
from hsnoise.likelihood.darks import evaluate, likelihood_part
from hsnoise.likelihood.plan import CLOSE_MARGIN, plan_rules
from hsnoise.likelihood.summary import summarise, without_counts

TURN_S = 0.5
FRAMES, ROWS, COLUMNS = 8, 1024, 1024
READ_E, GAIN, ROW_SIGMA, DARK_E, WHITE = 3.5, 1.3, 0.2, 2.6, 16383


@dataclass(frozen=True)
class Line:
    """A row of the report: what was measured, of which contestant, and its median rate or time."""

    part: str
    what: str
    who: str
    value: float
    unit: str


def model() -> hsnoise.NoiseModel:
    """The paper's complete model, 14 bits."""
    return hsnoise.cameras.canon_5d3().remove("adc").add(ADC(WHITE))


def medians(contestants: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median seconds per call of each contestant, in turns, after one call that may compile.

    A turn lasts at least TURN_S: after seconds of a slow contestant, the next one's first call finds cold memory (up to
    twice the time on machines that reclaim idle pages), which would not happen in a user's loop.
    """
    for run in contestants.values():
        jax.block_until_ready(run())
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    for _ in range(rounds):
        for name, run in contestants.items():
            start, calls = time.perf_counter(), 0
            while (passed := time.perf_counter() - start) < TURN_S:
                jax.block_until_ready(run())
                calls += 1
            seconds[name].append(passed / calls)
    return {name: float(np.median(values)) for name, values in seconds.items()}


def threaded_numpy(mean_e, threads: int) -> Callable[[], np.ndarray]:
    """The same model with NumPy's fastest generator, a share of the frames in each thread."""
    out = np.empty((FRAMES, ROWS, COLUMNS), np.uint16)

    def share(i: int) -> None:
        generator = np.random.Generator(np.random.SFC64(i))
        part = slice(i * FRAMES // threads, (i + 1) * FRAMES // threads)
        shape = out[part].shape
        electrons = generator.poisson(mean_e if np.isscalar(mean_e) else mean_e[part], shape).astype(np.float32)
        electrons += np.float32(READ_E) * generator.standard_normal(shape, np.float32)
        beta = np.maximum(1 + np.float32(ROW_SIGMA) * generator.standard_normal((*shape[:2], 1), np.float32), 0)
        out[part] = np.clip(np.rint(np.float32(GAIN) * beta * electrons), 0, WHITE)

    def run() -> np.ndarray:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(share, range(threads)))
        return out

    return run


def by_jax_random(mean_e) -> Callable[[], jax.Array]:
    @jax.jit
    def run(key, mean):
        shot, read, row = jax.random.split(key, 3)
        shape = (FRAMES, ROWS, COLUMNS)
        electrons = jax.random.poisson(shot, mean, shape) + READ_E * jax.random.normal(read, shape)
        beta = jnp.maximum(1 + ROW_SIGMA * jax.random.normal(row, (FRAMES, ROWS, 1)), 0)
        return jnp.clip(jnp.round(GAIN * beta * electrons), 0, WHITE).astype(jnp.uint16)

    mean = jnp.asarray(mean_e, jnp.float32)
    return lambda: run(jax.random.key(0), mean)


def by_torch(mean_e) -> Callable[[], object] | None:
    try:
        import torch

        from benchmarks._torch_stlstm import device
    except ImportError:
        return None
    shape, where = (FRAMES, ROWS, COLUMNS), device()
    mean = (torch.full(shape, mean_e) if np.isscalar(mean_e) else torch.from_numpy(mean_e)).to(where)

    def run():
        beta = torch.clamp(1 + ROW_SIGMA * torch.randn(FRAMES, ROWS, 1, device=where), min=0)
        y = GAIN * beta * (torch.poisson(mean) + READ_E * torch.randn(shape, device=where))
        drawn = torch.clamp(torch.round(y), 0, WHITE).to(torch.int32)
        if where.type == "cuda":
            torch.cuda.synchronize()
        return drawn

    return run


def sampling(rounds: int) -> list[Line]:
    clean = np.random.default_rng(0).uniform(0.5, 50, (FRAMES, ROWS, COLUMNS)).astype(np.float32)
    on_device, camera, key, threads = jnp.asarray(clean), model(), jax.random.key(0), os.cpu_count() or 1
    lines = []
    for what, mean_e, own in (
        ("mean of 0.5 to 50 e- by pixel", clean, lambda: hsnoise.sample(key, on_device, camera)),
        ("one mean, 2.6 e-", DARK_E, lambda: hsnoise.sample_dark(key, FRAMES, (ROWS, COLUMNS), camera)),
    ):
        contestants = {
            "hsnoise.sample": own,
            f"NumPy, {threads} threads": threaded_numpy(mean_e, threads),
            "jax.random": by_jax_random(mean_e),
        }
        torch = by_torch(mean_e)
        if torch is not None:
            contestants["PyTorch"] = torch
        lines += [Line("sampling", what, who, rate(t), "Mpixel/s") for who, t in medians(contestants, rounds).items()]
    bits = jax.jit(lambda key: jax.random.bits(key, (FRAMES, ROWS, COLUMNS), jnp.uint32))
    copy = jax.jit(lambda x: x + 1)
    floors = {"jax.random.bits, 32 a pixel": lambda: bits(key), "copy of float32": lambda: copy(on_device)}
    return lines + [Line("sampling", "floor", who, rate(t), "Mpixel/s") for who, t in medians(floors, rounds).items()]


def gradient(rounds: int) -> list[Line]:
    """Gradient of the mean square of 1 Mpixel of samples with respect to all parameters."""
    camera, key = model(), jax.random.key(0)
    light = jnp.full((1, ROWS, COLUMNS), 10.0)

    @jax.jit
    def slope(camera, light):
        return jax.grad(lambda c: jnp.mean(hsnoise.sample(key, light, c, differentiable=True) ** 2))(camera)

    times = medians({"hsnoise.sample": lambda: jax.tree.leaves(slope(camera, light))}, rounds)
    return [Line("gradient", "by all parameters", w, rate(t, 1), "Mpixel/s") for w, t in times.items()]


def dark_stack(frames: int, shape: tuple[int, int], exposures: int = 4, cfa: str = "RGGB") -> hsnoise.FrameStack:
    camera, exposure_s = model(), np.geomspace(0.02, 0.2, exposures)
    counts = [
        np.asarray(hsnoise.sample_dark(jax.random.key(i), frames, shape, camera, exposure_s=float(t)))
        for i, t in enumerate(exposure_s)
    ]
    return hsnoise.FrameStack(counts, exposure_s, black_level=0, white_level=WHITE, cfa=cfa, shutter="rolling")


def passes(rounds: int) -> list[Line]:
    stack = dark_stack(2, (ROWS, COLUMNS))
    pixels = 8 * ROWS * COLUMNS / 1e6
    times = medians({"hsnoise.summarise": lambda: summarise(stack).histograms[0].counts}, rounds)
    return [Line("passes", "row histograms from memory", w, pixels / t, "Mpixel/s") for w, t in times.items()]


def likelihood(rounds: int) -> list[Line]:
    """Likelihood of 32 dark frames of 12 Mpixel as in a fit, and of narrow rows, which hold less information each."""
    return [likelihood_of(shape, rounds) for shape in ((3000, 256), (3000, 4000))]


def likelihood_of(shape: tuple[int, int], rounds: int) -> Line:
    summary = summarise(dark_stack(32, shape, exposures=1))
    with jax.enable_x64(True):
        known = likelihood_part(model())
        rules = jax.tree.map(jnp.asarray, plan_rules(known, summary, CLOSE_MARGIN))
        slope = eqx.filter_jit(jax.value_and_grad(evaluate))
        light = without_counts(summary)
        times = medians({"hsnoise": lambda: slope(known, light, rules)}, rounds)
    what = f"32 frames of {shape[0]} x {shape[1]}, value and gradient"
    return Line("likelihood", what, "hsnoise", 1e3 * times["hsnoise"], "ms")


def fit(rounds: int) -> list[Line]:
    summary = summarise(dark_stack(8, (160, 240)))
    start = time.perf_counter()
    hsnoise.fit(summary)
    first = time.perf_counter() - start
    again = medians({"hsnoise.fit": lambda: hsnoise.fit(summary).covariance}, rounds)["hsnoise.fit"]
    what = "4 x 8 x 160 x 240, after the histograms"
    return [
        Line("fit", f"{what}, first", "hsnoise.fit", first, "s"),
        Line("fit", f"{what}, compiled", "hsnoise.fit", again, "s"),
    ]


def growth(rounds: int) -> list[Line]:
    """Slopes of log time against log size."""
    camera, key = model(), jax.random.key(0)

    def slope(what: str, who: str, sizes, prepare: Callable, run: Callable) -> Line:
        seconds = []
        for size in sizes:
            ready = prepare(size)
            seconds.append(medians({who: lambda ready=ready: run(ready)}, rounds)[who])
        return Line("growth", what, who, slope_of(sizes, seconds), "slope")

    def draw(side: int):
        return hsnoise.sample_dark(key, 4, (side, side), camera)

    def square(pixels: int) -> hsnoise.FrameStack:
        return dark_stack(2, (isqrt(pixels), isqrt(pixels)))

    def read(stack: hsnoise.FrameStack):
        return summarise(stack).exposure_s

    def fitted(summary):
        return hsnoise.fit(summary).covariance

    pixels = tuple(side**2 for side in (256, 512, 1024, 2048))
    lines = [slope("sampling against pixels", "hsnoise.sample", pixels, isqrt, draw)]
    captures = {
        "pixels": (pixels[:3], square),
        "frames": ((2, 4, 8), lambda n: dark_stack(n, (512, 512))),
        "exposures": ((2, 4, 8), lambda n: dark_stack(2, (512, 512), n)),
    }
    for what, (sizes, make) in captures.items():
        lines.append(slope(f"row histograms against {what}", "hsnoise.summarise", sizes, make, read))
    summaries = {
        "columns": ((120, 240, 480), lambda n: summarise(dark_stack(8, (160, n)))),
        "frames": ((4, 8, 16), lambda n: summarise(dark_stack(n, (160, 240)))),
        "exposures": ((2, 4, 8), lambda n: summarise(dark_stack(8, (160, 240), n))),
    }
    for what, (sizes, make) in summaries.items():
        lines.append(slope(f"fit after the histograms against {what}", "hsnoise.fit", sizes, make, fitted))
    return lines


def diagnose(rounds: int) -> list[Line]:
    stack = dark_stack(8, (160, 240))
    fitted = hsnoise.fit(stack)
    lines = []
    for what, run in (
        ("diagnose", lambda: hsnoise.diagnose(fitted, stack)),
        ("compare", lambda: hsnoise.compare(fitted.params, stack)),
    ):
        for when in ("first", "compiled"):
            start = time.perf_counter()
            run()
            lines.append(
                Line("diagnose", f"4 x 8 x 160 x 240, {when}", f"hsnoise.{what}", time.perf_counter() - start, "s")
            )
    return lines


def training(rounds: int) -> list[Line]:
    """A training step of the enhancer, 16 maps, 4 x 8 frames of 32 pixels: whole, its noise alone, and in PyTorch."""
    camera = camera_of("canon_5d3", None, None)
    trainer = Trainer(Recipe(maps=16, decay=False), 1, camera, camera.model)
    state = trainer.start(0)
    frames = np.random.default_rng(0).integers(0, 256, (4, 8, 32, 32, 3), np.uint8)
    batch = Batch(frames, np.full(4, GREY, np.float32))
    light, draw = jnp.asarray(camera.mean_e, jnp.float32), eqx.filter_jit(examples)

    def drawn() -> tuple[jax.Array, jax.Array]:
        return draw(batch, jax.random.key(0), trainer.camera.model, trainer.noise, light)

    contestants: dict[str, Callable[[], object]] = {
        "whole step": lambda: trainer.step(state, batch, 0, 0)[1],
        "light, noise and colours alone": drawn,
    }
    try:
        from benchmarks import _torch_stlstm
    except ImportError:
        pass
    else:
        clean, noisy = (np.asarray(x).swapaxes(0, 1) for x in drawn())
        contestants["PyTorch, noise given"] = _torch_stlstm.training_step(state[0], noisy, clean, 1e-3)
    what = "ST-LSTM, 16 maps, 4 x 8 frames of 32 pixels"
    return [Line("training", what, who, 1e3 * t, "ms") for who, t in medians(contestants, rounds).items()]


PARTS = {
    "sampling": sampling,
    "gradient": gradient,
    "passes": passes,
    "likelihood": likelihood,
    "fit": fit,
    "growth": growth,
    "diagnose": diagnose,
    "training": training,
}


def rate(seconds: float, frames: int = FRAMES) -> float:
    return frames * ROWS * COLUMNS / 1e6 / seconds


def slope_of(sizes, seconds) -> float:
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def machine() -> str:
    device = jax.devices()[0]
    return f"{platform.machine()}, {os.cpu_count()} cores, {device.device_kind}, jax {jax.__version__}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help=f"some of {', '.join(PARTS)}, separated by commas")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each contestant")
    parser.add_argument("--out", type=Path, default=Path("build/speed.md"), help="the table as Markdown")
    arguments = parser.parse_args()
    chosen = arguments.only.split(",") if arguments.only else list(PARTS)
    unknown = sorted(set(chosen) - set(PARTS))
    if unknown or arguments.rounds < 1:
        parser.error(f"--only: expected some of {', '.join(PARTS)}; --rounds: expected at least 1")
    console = Console(width=120)
    lines = []
    for part in chosen:
        with console.status(part):
            lines += PARTS[part](arguments.rounds)
    table = Table("", "what", "who", "median", "unit", title=f"Speed ({machine()})")
    for line in lines:
        table.add_row(line.part, line.what, line.who, f"{line.value:.3g}", line.unit)
    console.print(table)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    rows = [f"| {line.what} | {line.who} | {line.value:.3g} {line.unit} |" for line in lines]
    arguments.out.write_text("\n".join([f"{machine()}\n", "| what | who | median |", "|---|---|---|", *rows, ""]))
    print(f"Written to {arguments.out}")


if __name__ == "__main__":
    main()
