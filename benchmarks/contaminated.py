"""Captures with something in them that is no dark signal of the sensor, for tests of the fit and of the loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import jax
import numpy as np

import hsnoise
from benchmarks.pixel_simulator import Sensor, draw

GAIN, READ_E, DARK_E_PER_S, BLACK_DN, WHITE_DN = 2.0, 2.5, 20.0, 64, 4095
EXPOSURE_S = (0.05, 0.1, 0.2, 0.4)
FRAMES, SHAPE = 8, (160, 240)
SHARES = (0.001, 0.01, 0.03)
ODD = 3  # the frame of its series that is contaminated
DIFFER = Sensor(
    (GAIN,),
    READ_E,
    EXPOSURE_S,
    dark_e_per_s=DARK_E_PER_S,
    population="gamma",
    spread=0.4,
    read_noise_spread=0.3,
    hot_share=0.005,
    hot_e_per_s=200.0,
    offset_spread_dn=1.0,
    row_noise_dn=0.3,
    black_dn=BLACK_DN,
    white_dn=WHITE_DN,
    shutter="rolling",
    frames=FRAMES + 1,  # the last of each is spare
    shape=SHAPE,
)


@dataclass
class Capture:
    """Counts of each exposure [frame, row, column], changed in place; a spare frame of each; what is true and known."""

    counts: list[np.ndarray]
    spare: list[np.ndarray]
    truth: dict[str, float]
    cfa: str

    def stack(self) -> hsnoise.FrameStack:
        return hsnoise.FrameStack(self.counts, EXPOSURE_S, white_level=WHITE_DN, cfa=self.cfa, shutter="rolling")


@cache
def drawn(pixels: str, cfa: str) -> tuple[list[np.ndarray], dict[str, float]]:
    """Counts [frame, row, column] of each exposure, with a frame to spare, and the truth."""
    gains = {"gain": GAIN} if cfa == "mono" else {"gain.R": GAIN, "gain.G": 0.7 * GAIN, "gain.B": 0.8 * GAIN}
    if pixels == "differ":
        got = draw(replace(DIFFER, gain_dn_per_e=tuple(gains.values())), np.random.default_rng(25))
        read = float(np.sqrt((got["read_noise_e"] ** 2).mean()))
        return got["counts"], gains | {"read_noise.sigma": read}
    channels = len(gains)
    e = hsnoise.effects
    model = hsnoise.NoiseModel(
        [
            e.ShotNoise(),
            e.DarkCurrent(DARK_E_PER_S),
            e.ReadNoise(READ_E),
            e.RowGain(np.full(channels, 0.05), 1.0),
            e.Gain(np.array(list(gains.values()))),
            e.BlackLevel(np.full(channels, float(BLACK_DN))),
            e.ADC(WHITE_DN),
        ],
        cfa=cfa,
        shutter="rolling",
        exposure_s=EXPOSURE_S[0],
    )
    keys = jax.random.split(jax.random.key(25), len(EXPOSURE_S))
    counts = [
        np.asarray(hsnoise.sample_dark(key, FRAMES + 1, SHAPE, model, exposure_s=t))
        for key, t in zip(keys, EXPOSURE_S, strict=True)
    ]
    return counts, gains | {"read_noise.sigma": READ_E}


def capture(pixels: str, cfa: str = "mono") -> Capture:
    counts, truth = drawn(pixels, cfa)
    return Capture([c[:-1].copy() for c in counts], [c[-1].copy() for c in counts], truth, cfa)


def some_pixels(share: float, rng) -> np.ndarray:
    """A share of all pixels, at least one of 1000 [row, column]."""
    chosen = np.zeros(SHAPE, bool)
    chosen.flat[rng.choice(chosen.size, round(share * chosen.size), replace=False)] = True
    return chosen


def brighter(counts: np.ndarray, electrons) -> np.ndarray:
    return np.minimum(counts + np.rint(GAIN * electrons), WHITE_DN).astype(counts.dtype)


def stuck(level_dn: int) -> Callable:
    def contaminate(capture: Capture, share, rng) -> None:
        where = some_pixels(share, rng)
        for counts in capture.counts:
            counts[:, where] = level_dn

    return contaminate


def hot(capture: Capture, share, rng) -> None:
    where = some_pixels(share, rng)
    rate = rng.exponential(300.0, int(where.sum()))
    for counts, t in zip(capture.counts, EXPOSURE_S, strict=True):
        counts[:, where] = brighter(counts[:, where], rng.poisson(rate * t, (FRAMES, rate.size)))


def cosmic_rays(capture: Capture, share, rng) -> None:
    for counts in capture.counts:
        counts[:] = brighter(counts, (rng.random(counts.shape) < share) * rng.exponential(300.0, counts.shape))


def telegraph(capture: Capture, share, rng) -> None:
    where = some_pixels(share, rng)
    for counts in capture.counts:
        counts[:] = brighter(counts, 12.0 * where * (rng.random(counts.shape) < 0.5))


def lit_frame(capture: Capture, _, rng) -> None:
    frame = capture.counts[-1][ODD]
    frame[:] = brighter(frame, rng.poisson(40.0, SHAPE))


def frame_of_another_exposure(capture: Capture, *_) -> None:
    capture.counts[1][ODD] = capture.spare[-1]


def dead_channel(capture: Capture, *_) -> None:
    for counts in capture.counts:
        counts[:, ::2, ::2] = BLACK_DN


def dead_column(capture: Capture, *_) -> None:
    for counts in capture.counts:
        counts[:, :, 101] = 0


def dead_row(capture: Capture, *_) -> None:
    for counts in capture.counts:
        counts[:, 77] = 0


def rows_that_repeat(capture: Capture, share, _) -> None:
    for counts in capture.counts:
        counts[:, -round(share * SHAPE[0]) :] = counts[:, -round(share * SHAPE[0]) - 1, None]


def identical_frames(capture: Capture, *_) -> None:
    capture.counts[2][ODD] = capture.counts[2][1]


def masterdark(capture: Capture, *_) -> None:
    counts = capture.counts[-1]
    counts[ODD] = np.rint(np.delete(counts, ODD, axis=0).mean(0))


STUCK, FRAME = r"stuck|dead|never change|do not change|same value|constant", rf"[Ff]rames?\b.*\b{ODD}\b"


class Row(NamedTuple):
    """A contamination, how much of it, and the words by which a doubt or a refusal names it."""

    name: str
    contaminate: Callable
    share: float | None
    words: str

    def __str__(self) -> str:
        return f"{self.name}, {100 * self.share:g} %" if self.share else self.name

    def capture(self, pixels: str) -> Capture:
        """A contaminated capture of a sensor whose pixels "differ" or are "alike"."""
        contaminated = capture(pixels, "RGGB" if self.contaminate is dead_channel else "mono")
        self.contaminate(contaminated, self.share, np.random.default_rng(6))
        return contaminated


ROWS = [
    *(Row("stuck at 0", stuck(0), share, rf"{STUCK}|clip") for share in SHARES),
    *(Row("stuck at white", stuck(WHITE_DN), share, rf"{STUCK}|saturat") for share in SHARES),
    *(Row("stuck at a constant", stuck(200), share, STUCK) for share in SHARES),
    *(Row("hot pixels", hot, share, r"\bhot\b") for share in SHARES),
    *(Row("cosmic rays", cosmic_rays, share, r"cosmic|outlier") for share in SHARES),
    *(Row("telegraph pixels", telegraph, share, r"telegraph|jump between") for share in SHARES),
    Row("one lit frame", lit_frame, None, FRAME),
    Row("one frame of another exposure", frame_of_another_exposure, None, FRAME),
    Row("dead colour channel", dead_channel, None, r"[Cc]hannel R\b|\bred\b|\bR\b.*(stuck|dead|constant)"),
    Row("dead column", dead_column, None, r"[Cc]olumns?\W*101\b"),
    Row("dead row", dead_row, None, r"[Rr]ows?\W*77\b"),
    *(Row("rows that repeat", rows_that_repeat, share, r"repeat|copies|identical|padd") for share in SHARES[1:]),
    Row("two identical frames", identical_frames, None, rf"identical.*\b1\b.*\b{ODD}\b|\b1\b.*\b{ODD}\b.*identical"),
    Row("a masterdark among darks", masterdark, None, FRAME),
]
# Contaminations that are effects of the library, by which fits measure them.
MEASURED = {"cosmic rays": "cosmic_rays", "hot pixels": "hot_pixels", "telegraph pixels": "random_telegraph_noise"}
