"""Kinds of cameras as their users have them, by NumPy alone: python -m benchmarks.zoo

What `hsnoise.fit` makes of darks, and flats, of sensors of a kind: gain, read noise and dark current beside the truth,
in percent and in standard errors, and the light. `benchmarks.pixels` has the statistics of fewer kinds; here it is the
variety: outputs with gains of their own, noise with a heavy tail, pedestals that wander, lamps that flicker, particles
that leave tracks, registers that multiply. Pixels all differ. No code of hsnoise draws.

    python -m benchmarks.zoo --only "four outputs" sCMOS --seeds 3
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.ndimage import convolve

import hsnoise
from hsnoise._core.sheet import Sheet

Frames = np.ndarray  # [frame, row, column]


@dataclass
class Sensor:
    """A sensor of some pixels [row, column], and what it does to the electrons of a frame.

    gain, read, dark, response: DN/e-, e-, e-/s, 1, of each pixel or of all. offset_dn: static. bits: of the converter;
    shift: bits by which counts are shifted to the left. coupling: kernel by which electrons spread. each_frame: DN, of
    one frame. exposed: e- of one frame of some seconds, beyond dark current and light.
    """

    rng: np.random.Generator
    shape: tuple[int, int] = (200, 300)
    gain: Any = 1.0
    read: Any = 6.0
    dark: Any = 0.0
    response: Any = 1.0
    offset_dn: Any = 500.0
    bits: int = 16
    shift: int = 0
    coupling: Frames | None = None
    each_frame: Callable[[], Any] = lambda: 0.0
    exposed: Callable[[float], Any] = lambda seconds: 0.0
    multiplies: bool = False
    options: dict[str, Any] = field(default_factory=dict)

    def normal(self, *shape: int) -> Frames:
        return self.rng.standard_normal(shape or self.shape)

    def frames(self, count: int, seconds: float, light: float = 0.0) -> Frames:
        return np.stack([self._frame(seconds, light) for _ in range(count)])

    def _frame(self, seconds: float, light: float) -> Frames:
        mean = np.broadcast_to(self.dark * seconds + self.response * light, self.shape)
        electrons = self.rng.poisson(mean) + self.exposed(seconds)
        if self.multiplies:
            electrons = np.where(electrons > 0, self.rng.gamma(np.maximum(electrons, 1)), 0.0)
        if self.coupling is not None:
            electrons = convolve(electrons.astype(float), self.coupling)
        dn = self.gain * (electrons + self.read * self.normal()) + self.offset_dn + self.each_frame()
        counts = np.clip(np.rint(dn), 0, 2 ** (self.bits - self.shift) - 1).astype(np.uint16)
        return counts << self.shift

    def stack(self, exposures: dict[float, int], lights: dict[float, int] | None = None, flat_s: float = 1.0):
        """Darks of so many frames by exposure, and flats by light, e-."""
        darks = [self.frames(count, seconds) for seconds, count in exposures.items()]
        flats = [self.frames(count, flat_s, light) for light, count in (lights or {}).items()]
        kind = ["dark"] * len(darks) + ["flat"] * len(flats)
        return hsnoise.FrameStack([*darks, *flats], [*exposures, *[flat_s] * len(flats)], kind=kind, **self.options)

    @property
    def truth(self) -> dict[str, float]:
        """Means over pixels; of the read noise the rms. In counts as they are stored."""
        channels = {"gain": np.mean(self.gain) * 2**self.shift}
        if "cfa" in self.options:
            gain = np.broadcast_to(self.gain, self.shape)
            channels = {"gain.R": gain[0, 0], "gain.G": gain[0, 1], "gain.B": gain[1, 1]}
        read = float(np.sqrt(np.mean(np.square(self.read))))
        return {**channels, "read_noise.sigma": read, "dark_current.rate": float(np.mean(self.dark))}


def blocks(values, shape: tuple[int, int]) -> Frames:
    """Values [block row, block column] of each pixel."""
    values = np.asarray(values)
    row, column = (np.arange(n) * of // n for n, of in zip(shape, values.shape, strict=True))
    return values[row[:, None], column]


def four_outputs(rng):
    shape = (200, 320)
    sensor = Sensor(
        rng, shape, gain=blocks([[0.8, 0.92], [0.68, 0.84]], shape), dark=0.2 * rng.lognormal(0, 0.7, shape)
    )
    sensor.read, sensor.response = blocks([[6, 8], [7, 10]], shape), 1 + 0.01 * sensor.normal()
    sensor.offset_dn = blocks([[1000, 1020], [980, 1010]], shape)
    return sensor, sensor.stack({0.0: 10, 100.0: 10}, {1e3: 2, 3e3: 2, 8e3: 2, 16e3: 2})


def eight_outputs(rng):
    shape = (128, 1024)
    gain, read, offset = (
        of * (1 + by * rng.standard_normal((1, 8))) for of, by in ((0.25, 0.05), (25, 0.1), (60, 0.05))
    )
    sensor = Sensor(
        rng, shape, bits=12, gain=blocks(gain, shape), read=blocks(read, shape), offset_dn=blocks(offset, shape)
    )
    sensor.response = 1 + 0.008 * sensor.normal(1, 1024) + 0.005 * sensor.normal()
    return sensor, sensor.stack({1e-4: 16}, {500.0: 2, 1500.0: 2, 4e3: 2, 8e3: 2}, 1e-4)


def scmos(rng):
    shape = (256, 256)
    sensor = Sensor(rng, shape, gain=2.1, read=1.2 * np.exp(rng.gamma(1.0, 0.35, shape)))
    sensor.dark = 0.5 * rng.lognormal(-0.5, 1.0, shape)
    sensor.offset_dn = 100 + 2 * sensor.normal() + 1.5 * sensor.normal(1, 256)
    sensor.each_frame = lambda: 0.8 * sensor.normal(256, 1)
    return sensor, sensor.stack({0.01: 20, 1.0: 20, 5.0: 20})


def colour_camera(rng):
    """Rows share noise of one size in DN, and the dark signal is subtracted."""
    shape = (256, 384)
    sensor = Sensor(rng, shape, gain=np.tile([[5.7, 3.0], [3.0, 4.5]], (128, 192)), bits=14, offset_dn=512.0)
    sensor.dark, sensor.read = 3 * rng.lognormal(-0.3, 0.8, shape), 1.4 * np.exp(0.15 * sensor.normal())
    sensor.each_frame = lambda: 1.2 * sensor.normal(256, 1) + 0.3 * rng.standard_normal()
    sensor.options = {"cfa": "RGGB", "black_level": 512.0, "white_level": 16383.0}
    darks = []
    for seconds in (0.02, 0.1, 1.0, 5.0):
        sensor.offset_dn = 512.0 - sensor.gain * sensor.dark.mean() * seconds
        darks.append(sensor.frames(12, seconds))
    return sensor, hsnoise.FrameStack(darks, (0.02, 0.1, 1.0, 5.0), **sensor.options)


def slr(rng):
    shape = (256, 384)
    sensor = Sensor(rng, shape, gain=2.2, read=2.5 * np.exp(0.15 * rng.standard_normal(shape)), bits=14)
    sensor.dark = _warm(0.3 * rng.lognormal(0, 0.7, shape), 0.001, 20.0, rng)
    sensor.offset_dn = 2048 + np.tile(0.8 * rng.standard_normal(8), 48)
    sensor.each_frame = lambda: 0.8 * sensor.normal(256, 1) + 0.3 * sensor.normal(1, 384)
    sensor.options = {"cfa": "RGGB"}
    return sensor, sensor.stack({2.5e-4: 8, 1.0: 8, 30.0: 8})


def astronomy_cmos(rng):
    """Twelve bits in sixteen, a glow at one edge."""
    shape = (300, 400)
    down, across = np.mgrid[:300, :400]
    sensor = Sensor(rng, shape, gain=1.1, read=1.6 * np.exp(0.1 * rng.standard_normal(shape)), offset_dn=50.0, shift=4)
    glow = 0.5 * np.exp(-(((across - 400) / 70) ** 2) - ((down - 40) / 60) ** 2)
    sensor.dark = _warm(0.05 * rng.lognormal(0, 0.6, shape), 0.002, 5.0, rng) + glow
    sensor.each_frame = lambda: 0.4 * sensor.normal(300, 1)
    return sensor, sensor.stack({0.001: 12, 60.0: 12, 300.0: 12})


def long_darks(rng):
    """Five bias frames, five darks of half an hour, full of tracks."""
    shape = (256, 384)
    sensor = Sensor(rng, shape, gain=1.3, read=7.0, dark=_warm(0.01 * rng.lognormal(0, 0.6, shape), 0.003, 0.5, rng))
    sensor.exposed = lambda seconds: _tracks(rng, shape, seconds)
    return sensor, sensor.stack({0.0: 5, 1800.0: 5})


def light_leak(rng):
    """Dark signal grows towards one edge, the pedestal wanders, and the first columns are bright."""
    shape, level = (200, 300), [0.0]

    def each_frame():
        level[0] = 0.8 * level[0] + 1.5 * rng.standard_normal()
        return level[0] + 1.5 * np.exp(-np.arange(300) / 30)

    dark = (0.5 + 2 * np.linspace(0, 1, 200)[:, None] ** 2) * rng.lognormal(0, 0.3, shape)
    sensor = Sensor(rng, shape, gain=0.7, read=9.0, dark=dark, each_frame=each_frame)
    return sensor, sensor.stack({0.0: 8, 60.0: 8, 240.0: 8})


def infrared(rng):
    """Eight outputs that drift by themselves, even and odd columns apart, offsets of 160 e-."""
    shape = (256, 512)
    sensor = Sensor(rng, shape, gain=0.5, read=12 * np.exp(0.2 * rng.standard_normal(shape)))
    sensor.dark = _warm(0.05 * rng.lognormal(0, 1.0, shape), 0.01, 3.0, rng)
    sensor.offset_dn = 600 + 80 * sensor.normal() + blocks(30 * sensor.normal(1, 8), shape)
    sensor.each_frame = lambda: (
        blocks(1.5 * sensor.normal(1, 8), shape) + 1.5 * np.where(np.arange(512) % 2, 1, -1) * rng.standard_normal()
    )
    return sensor, sensor.stack({1.5: 12, 60.0: 12, 300.0: 12})


def coupled(rng):
    """Pixels that share a twentieth of their charge's signal with their neighbours."""
    kernel = np.array([[0, 0.012, 0], [0.012, 0.952, 0.012], [0, 0.012, 0]])
    sensor = Sensor(rng, (240, 320), gain=0.7, coupling=kernel, offset_dn=300.0)
    sensor.dark, sensor.response = 2 * rng.lognormal(0, 0.8, sensor.shape), 1 + 0.01 * sensor.normal()
    return sensor, sensor.stack({1.0: 8, 30.0: 8, 100.0: 8}, {1e3: 3, 4e3: 3, 12e3: 3})


def vignetting(rng):
    down, across = np.mgrid[-1:1:240j, -1:1:320j]
    sensor = Sensor(rng, (240, 320), gain=0.9, read=5.0, bits=14, offset_dn=200.0)
    sensor.response = (1 + 0.03 * sensor.normal()) * np.cos(0.8 * np.hypot(down, across)) ** 4
    return sensor, sensor.stack({0.01: 8}, {500.0: 3, 2e3: 3, 6e3: 3, 12e3: 3}, 0.01)


def flicker(rng):
    """Flats under a lamp that flickers while rows are read."""
    sensor = Sensor(rng, (240, 320), gain=0.5, read=4.0, bits=12, offset_dn=100.0)
    still = 1 + 0.01 * sensor.normal()
    flats = []
    for light in (300, 1000, 3000, 5500):
        for _ in range(2):
            wave = np.sin(2 * np.pi * (np.arange(240) / 60 + rng.random()))
            sensor.response = still * (1 + 0.1 * wave[:, None])
            flats.append(sensor.frames(1, 1e-3, light))
    groups = [sensor.frames(8, 1e-3), *(np.concatenate(flats[i : i + 2]) for i in range(0, 8, 2))]
    return sensor, hsnoise.FrameStack(groups, [1e-3] * 5, kind=["dark", *["flat"] * 4])


def few_frames(rng):
    sensor = Sensor(rng, (300, 400), gain=0.4, read=15.0, dark=0.02, offset_dn=1000.0)
    sensor.each_frame = lambda: 2 * rng.standard_normal()
    return sensor, sensor.stack({0.0: 3, 600.0: 3}, {2e4: 2}, 5.0)


def eight_bits(rng):
    sensor = Sensor(rng, (240, 320), gain=0.03, read=14.0, bits=8, dark=500 * rng.lognormal(0, 0.5, (240, 320)))
    sensor.offset_dn = 8.3 + 0.4 * sensor.normal(1, 320)
    return sensor, sensor.stack({0.001: 20, 0.5: 20, 2.0: 20}, {600.0: 4, 2e3: 4, 5e3: 4}, 0.001)


def two_banks(rng):
    """Even and odd columns by converters of their own, darks alone."""
    shape = (200, 300)
    odd = np.broadcast_to(np.arange(300) % 2, shape)
    sensor = Sensor(rng, shape, gain=np.where(odd, 1.3, 1.6), read=np.where(odd, 5.0, 6.5), offset_dn=200 + 3.0 * odd)
    sensor.dark = 2 * rng.lognormal(0, 0.5, shape)
    return sensor, sensor.stack({0.1: 16, 10.0: 16, 60.0: 16})


def emccd(rng, lights: dict[float, int] | None = None):
    """Multiplied by 300, 5 e-/DN behind the register; clocks add an electron to one pixel of a hundred."""
    shape = (200, 300)
    sensor = Sensor(rng, shape, gain=60.0, read=0.17, multiplies=True)
    sensor.dark = _warm(0.003 * rng.lognormal(-0.02, 0.2, shape), 0.003, 0.3, rng)
    sensor.offset_dn = 200 + 0.7 * sensor.normal() + sensor.normal(1, 300)
    sensor.exposed = lambda seconds: rng.poisson(0.01, shape)
    sensor.each_frame = lambda: 0.5 * rng.standard_normal()
    return sensor, sensor.stack({0.05: 20, 30.0: 12} if lights is None else {0.05: 20}, lights, 0.05)


def emccd_with_flats(rng):
    return emccd(rng, {5.0: 4, 30.0: 4, 100.0: 4})


def _warm(dark: Frames, share: float, mean: float, rng) -> Frames:
    """Dark currents, some pixels hot, e-/s."""
    return dark + (rng.random(dark.shape) < share) * rng.exponential(mean, dark.shape)


def _tracks(rng, shape: tuple[int, int], seconds: float) -> Frames:
    """Charge of particles, e-."""
    frame = np.zeros(shape)
    for _ in range(rng.poisson(8e-7 * seconds * frame.size)):
        at, turn = rng.random(2) * shape, rng.uniform(0, 2 * np.pi)
        for step in range(1 + int(rng.exponential(6))):
            row, column = (at + step * np.array([np.sin(turn), np.cos(turn)])).astype(int)
            if 0 <= row < shape[0] and 0 <= column < shape[1]:
                frame[row, column] += rng.exponential(600)
    return frame


KINDS: dict[str, Callable] = {
    "CCD, four outputs": four_outputs,
    "line of eight outputs": eight_outputs,
    "sCMOS, heavy tail of noise": scmos,
    "colour camera, subtracts dark": colour_camera,
    "SLR raw": slr,
    "astronomy CMOS, glow": astronomy_cmos,
    "CCD, half-hour darks": long_darks,
    "light leak, wandering pedestal": light_leak,
    "infrared array": infrared,
    "coupled pixels": coupled,
    "vignetting": vignetting,
    "lamp that flickers": flicker,
    "three frames": few_frames,
    "eight bits": eight_bits,
    "even and odd columns": two_banks,
    "EMCCD, darks": emccd,
    "EMCCD, bias and flats": emccd_with_flats,
}


def row_of(name: str, seed: int) -> tuple[str, ...]:
    """A row of the table: each number as percent off, and in standard errors."""
    sensor, stack = KINDS[name](np.random.default_rng([2026, seed, list(KINDS).index(name)]))
    began = time.perf_counter()
    try:
        fit = hsnoise.fit(stack)
    except (ValueError, RuntimeError) as error:
        return name, f"refused: {error}", "", "", "", ""
    seconds, table = time.perf_counter() - began, fit.table
    cells: dict[str, list[str]] = {"gain": [], "read_noise": [], "dark_current": []}
    for parameter, truth in sensor.truth.items():
        value, error = _mean_dark(fit, sensor.shape) if parameter == "dark_current.rate" else table[parameter][:2]
        off = f"{100 * (value / truth - 1):+.1f} % ({(value - truth) / error:+.1f})" if truth and error > 0 else "-"
        cells[parameter.partition(".")[0]].append("not determined" if np.isnan(value) or np.isinf(error) else off)
    return name, *("; ".join(of) for of in cells.values()), fit.conclusion.light, f"{seconds:.1f} s"


def _mean_dark(fit: hsnoise.FitResult, shape: tuple[int, int]) -> tuple[float, float]:
    """Dark current of the mean pixel, with what hot ones and a glow add, and its error."""
    table, glow = fit.table, 0.0
    if "amplifier_glow" in fit.params:
        alone = hsnoise.NoiseModel([fit.params["amplifier_glow"]], cfa="mono", shutter="global", exposure_s=1e3)
        glow = float(np.mean(hsnoise.sample_dark(0, 1, shape, alone))) / 1e3
    (rate, error, _), nothing = table["dark_current.rate"], (0.0, 0.0, "")
    (share, of_share, _), (hot, of_hot, _) = (table.get(f"hot_pixels.{name}", nothing) for name in ("fraction", "rate"))
    return rate + share * hot + glow, float(np.hypot(error, np.hypot(share * of_hot, of_share * hot)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], metavar="KIND", help="; ".join(KINDS))
    parser.add_argument("--seeds", type=int, default=1, help="sensors of each kind (default 1)")
    arguments = parser.parse_args()
    chosen = [name for name in KINDS if not arguments.only or any(w.lower() in name.lower() for w in arguments.only)]
    if not chosen:
        parser.error(f"--only: expected some of {'; '.join(KINDS)}")
    rows = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is assumed of the frames is no matter here
        for name in chosen:
            for seed in range(arguments.seeds):
                rows.append(row_of(name, seed))
                print(" | ".join(rows[-1]), flush=True)
    headings = ("kind", "gain, off by (errors)", "read noise", "dark current", "light", "time")
    print(Sheet("Kinds of cameras", headings, rows).markdown())


if __name__ == "__main__":
    main()
