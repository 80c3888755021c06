"""A simulator, in NumPy, of dark captures of sensors whose pixels differ; it shares no code with hsnoise.

`draw(sensor, rng)` gives counts and the truth of the pixels drawn. `DETERMINED` are eight kinds of sensor whose gain
follows from darks alone: at the longest exposure an ordinary pixel collects about as many electrons as the square of
its read noise. `UNDETERMINED` are five captures from which no method can determine the gain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

RGGB = np.array([[0, 1], [1, 2]])
POPULATIONS = ("lognormal", "gamma", "bimodal")
HOT_LAWS = ("exponential", "pareto")
PARETO_EXPONENT = 2.5  # of the tail of hot pixels' rates: a density that falls as rate^-3.5


@dataclass(frozen=True)
class Sensor:
    """A sensor, its readout, and the series of darks taken with it.

    One gain is a mono sensor, three are an RGGB mosaic. `dark_e_per_s` is the mean over the ordinary pixels, the read
    noise the rms over pixels. `spread` is the standard deviation of the logarithm of the dark current over pixels
    (log-normal, and within each of the two groups of "bimodal") or of the dark current over its mean (gamma);
    `second_share` of the pixels of "bimodal" have `second_ratio` times the dark current of the rest. A share
    `hot_share` of all pixels has an extra slow centre of mean rate `hot_e_per_s` and distribution `hot_law`, whose
    electrons have the Fano factor `hot_fano` (0.5 to 1, over times in which many come). Standard deviations in DN:
    `offset_spread_dn` of pixels, `column_pattern_dn` and `row_pattern_dn` fixed, `row_noise_dn` and `frame_jitter_dn`
    new in each frame, `pedestal_jump_dn` new at each exposure.
    """

    gain_dn_per_e: tuple[float, ...]
    read_noise_e: float
    exposure_s: tuple[float, ...]
    dark_e_per_s: float = 0.0
    population: str = "lognormal"
    spread: float = 0.0
    second_share: float = 0.0
    second_ratio: float = 1.0
    read_noise_spread: float = 0.0
    hot_share: float = 0.0
    hot_e_per_s: float = 0.0
    hot_law: str = "exponential"
    hot_fano: float = 1.0
    offset_spread_dn: float = 0.0
    column_pattern_dn: float = 0.0
    row_pattern_dn: float = 0.0
    row_noise_dn: float = 0.0
    frame_jitter_dn: float = 0.0
    pedestal_jump_dn: float = 0.0
    black_dn: float = 1000.0
    black_stated: bool = False
    white_dn: int = 65535
    shutter: str = "global"
    frames: int = 8
    shape: tuple[int, int] = (256, 384)

    def __post_init__(self) -> None:
        if len(self.gain_dn_per_e) not in (1, 3):
            raise ValueError(f"gain_dn_per_e: expected one gain or three, got {len(self.gain_dn_per_e)}")
        if self.population not in POPULATIONS:
            raise ValueError(f"population: expected one of {', '.join(POPULATIONS)}, got {self.population!r}")
        if self.hot_law not in HOT_LAWS:
            raise ValueError(f"hot_law: expected one of {', '.join(HOT_LAWS)}, got {self.hot_law!r}")
        if not 0.5 <= self.hot_fano <= 1:
            raise ValueError(f"hot_fano: two steps in turn give 0.5 to 1, got {self.hot_fano}")


def draw(sensor: Sensor, rng: np.random.Generator) -> dict:
    """One sensor of the kind and one series of darks.

    Returns:
        Known to the user: counts (a list of uint16 arrays [frame, row, column], one per exposure), exposure_s,
        black_level (None if not stated), white_level, cfa, shutter. True maps [row, column]: ordinary_e_per_s and
        hot_e_per_s (their sum is a pixel's dark current), read_noise_e, offset_dn (without the black level).
    """
    ordinary, hot, read, offset = (f(sensor, rng) for f in (ordinary_rates, hot_rates, read_noises, offsets))
    counts = [_exposure(sensor, t, ordinary, hot, read, offset, rng) for t in sensor.exposure_s]
    return {
        "counts": counts,
        "exposure_s": list(sensor.exposure_s),
        "black_level": sensor.black_dn if sensor.black_stated else None,
        "white_level": sensor.white_dn,
        "cfa": "mono" if len(sensor.gain_dn_per_e) == 1 else "RGGB",
        "shutter": sensor.shutter,
        "ordinary_e_per_s": ordinary,
        "hot_e_per_s": hot,
        "read_noise_e": read,
        "offset_dn": offset,
    }


def ordinary_rates(sensor: Sensor, rng) -> np.ndarray:
    """Dark current of each pixel without its hot centre, e-/s [row, column]."""
    if sensor.population == "gamma" and sensor.spread > 0:
        shape = sensor.spread**-2
        return sensor.dark_e_per_s * rng.gamma(shape, 1 / shape, sensor.shape)
    factor = np.exp(sensor.spread * rng.standard_normal(sensor.shape) - sensor.spread**2 / 2)
    if sensor.population == "bimodal":
        second = rng.random(sensor.shape) < sensor.second_share
        factor *= np.where(second, sensor.second_ratio, 1.0) / (1 + sensor.second_share * (sensor.second_ratio - 1))
    return sensor.dark_e_per_s * factor


def hot_rates(sensor: Sensor, rng) -> np.ndarray:
    """Dark current of each pixel's hot centre, e-/s [row, column]; 0 without one."""
    if sensor.hot_law == "pareto":
        size = (1 + rng.pareto(PARETO_EXPONENT, sensor.shape)) * (PARETO_EXPONENT - 1) / PARETO_EXPONENT
    else:
        size = rng.exponential(1.0, sensor.shape)
    return np.where(rng.random(sensor.shape) < sensor.hot_share, sensor.hot_e_per_s * size, 0.0)


def read_noises(sensor: Sensor, rng) -> np.ndarray:
    """Read noise of each pixel, e- [row, column]; its rms over many pixels is the sensor's."""
    z = rng.standard_normal(sensor.shape)
    return sensor.read_noise_e * np.exp(sensor.read_noise_spread * z - sensor.read_noise_spread**2)


def offsets(sensor: Sensor, rng) -> np.ndarray:
    """Fixed offset of each pixel, DN [row, column]: of pixels, columns and rows."""
    rows, columns = sensor.shape
    return (
        sensor.offset_spread_dn * rng.standard_normal((rows, columns))
        + sensor.column_pattern_dn * rng.standard_normal((1, columns))
        + sensor.row_pattern_dn * rng.standard_normal((rows, 1))
    )


def two_step_counts(mean: np.ndarray, fano: float, rng) -> np.ndarray:
    """Electrons of a centre that emits a hole and an electron in turn, in a time in which `mean` are expected.

    Both steps wait an exponential time; the mean waits are u and 1 - u of a cycle, with u^2 + (1 - u)^2 = fano. The
    electrons form an equilibrium renewal process of variance m - 2 w m + 2 w^2 (1 - exp(-m / w)), w = u (1 - u). It is
    drawn exactly: the waits of 2^k cycles are two gamma variables, and bisection finds the end of the time in them,
    where the shares of the halves are beta variables.
    """
    if fano == 1:
        return rng.poisson(mean)
    first = (1 + np.sqrt(2 * fano - 1)) / 2
    left = np.array(mean, float)
    midway = rng.random(left.shape) >= first  # the hole has been emitted before the exposure begins
    left -= np.where(midway, rng.exponential(1 - first, left.shape), 0.0)
    counts = np.where(midway & (left > 0), 1, 0)
    top = max(float(left.max(initial=0.0)), 0.0)
    size = 2 ** int(np.ceil(np.log2(top + 10 * np.sqrt(top) + 40)))  # so many cycles never fit
    waits = [first * rng.gamma(size, size=left.shape), (1 - first) * rng.gamma(size, size=left.shape)]
    while size > 1:
        size //= 2
        halves = [wait * rng.beta(size, size, left.shape) for wait in waits]
        fits = sum(halves) <= left
        left -= np.where(fits, sum(halves), 0.0)
        counts += np.where(fits, size, 0)
        waits = [np.where(fits, wait - half, half) for wait, half in zip(waits, halves, strict=True)]
    return counts + (sum(waits) <= left)


def _exposure(sensor: Sensor, exposure_s: float, ordinary, hot, read, offset, rng) -> np.ndarray:
    """Counts [frame, row, column] of one exposure."""
    whole = (sensor.frames, *sensor.shape)
    electrons = rng.poisson(ordinary * exposure_s, whole).astype(np.float32)
    where = hot > 0
    mean = np.broadcast_to(hot[where] * exposure_s, (sensor.frames, int(where.sum())))
    electrons[:, where] += two_step_counts(mean, sensor.hot_fano, rng)
    electrons += read.astype(np.float32) * rng.standard_normal(whole, np.float32)
    level = electrons * _gains(sensor) + (offset + sensor.black_dn).astype(np.float32)
    level += sensor.row_noise_dn * rng.standard_normal((*whole[:2], 1), np.float32)
    level += sensor.frame_jitter_dn * rng.standard_normal((sensor.frames, 1, 1), np.float32)
    level += np.float32(sensor.pedestal_jump_dn * rng.standard_normal())
    return np.clip(np.rint(level), 0, sensor.white_dn).astype(np.uint16)


def _gains(sensor: Sensor) -> np.ndarray:
    """Gain of each pixel, DN/e- [row, column]."""
    gain = np.array(sensor.gain_dn_per_e, np.float32)
    rows, columns = sensor.shape
    colour = np.tile(RGGB, (rows // 2, columns // 2)) if len(gain) == 3 else np.zeros(sensor.shape, int)
    return gain[colour]


DETERMINED = {
    "CCD warm": Sensor(
        (0.7,),
        read_noise_e=12.0,
        exposure_s=(60.0, 120.0, 300.0, 600.0),
        dark_e_per_s=0.3,
        spread=0.5,
        hot_share=0.02,
        hot_e_per_s=9.0,
        hot_fano=0.85,
        offset_spread_dn=3.0,
        row_noise_dn=0.3,
        frame_jitter_dn=0.3,
        frames=6,
    ),
    "CCD cool": Sensor(
        (1.4,),
        read_noise_e=7.0,
        exposure_s=(0.0, 120.0, 300.0, 600.0),
        dark_e_per_s=0.08,
        population="bimodal",
        spread=0.25,
        second_share=0.15,
        second_ratio=4.0,
        hot_share=0.005,
        hot_e_per_s=3.0,
        hot_law="pareto",
        hot_fano=0.8,
        offset_spread_dn=2.0,
        frame_jitter_dn=0.3,
    ),
    "CMOS warm": Sensor(
        (2.0,),
        read_noise_e=2.5,
        exposure_s=(0.05, 0.1, 0.2, 0.4),
        dark_e_per_s=20.0,
        population="gamma",
        spread=0.4,
        read_noise_spread=0.3,
        hot_share=0.01,
        hot_e_per_s=300.0,
        offset_spread_dn=1.0,
        row_noise_dn=0.4,
        black_dn=64.0,
        white_dn=4095,
        shutter="rolling",
    ),
    "CMOS cool": Sensor(
        (3.2,),
        read_noise_e=1.6,
        exposure_s=(10.0, 30.0, 90.0),
        dark_e_per_s=0.04,
        spread=0.6,
        read_noise_spread=0.35,
        hot_share=0.003,
        hot_e_per_s=1.0,
        offset_spread_dn=1.5,
        row_noise_dn=0.5,
        black_dn=240.0,
        white_dn=16383,
        shutter="rolling",
    ),
    "column pattern": Sensor(
        (1.2,),
        read_noise_e=3.0,
        exposure_s=(0.1, 0.4, 1.0, 2.0),
        dark_e_per_s=7.0,
        population="gamma",
        spread=0.5,
        read_noise_spread=0.2,
        hot_share=0.005,
        hot_e_per_s=60.0,
        hot_law="pareto",
        offset_spread_dn=1.0,
        column_pattern_dn=4.0,
        row_pattern_dn=1.0,
        row_noise_dn=0.3,
        black_dn=100.0,
        white_dn=4095,
        shutter="rolling",
    ),
    "frame offset": Sensor(
        (0.5,),
        read_noise_e=9.0,
        exposure_s=(30.0, 60.0, 120.0, 240.0),
        dark_e_per_s=0.4,
        spread=0.4,
        hot_share=0.01,
        hot_e_per_s=8.0,
        offset_spread_dn=2.0,
        frame_jitter_dn=1.5,
    ),
    "clipped at 0": Sensor(
        (1.5,),
        read_noise_e=3.0,
        exposure_s=(0.0, 0.5, 1.0, 2.0),
        dark_e_per_s=6.0,
        population="gamma",
        spread=0.4,
        hot_share=0.005,
        hot_e_per_s=60.0,
        offset_spread_dn=1.0,
        black_dn=10.5,
        white_dn=4095,
        shutter="rolling",
    ),
    "Bayer": Sensor(
        (1.7, 1.0, 1.35),
        read_noise_e=2.8,
        exposure_s=(0.1, 0.3, 0.6, 1.2),
        dark_e_per_s=12.0,
        population="bimodal",
        spread=0.2,
        second_share=0.2,
        second_ratio=3.0,
        hot_share=0.005,
        hot_e_per_s=150.0,
        offset_spread_dn=0.8,
        row_noise_dn=0.3,
        black_dn=512.0,
        black_stated=True,
        white_dn=16383,
        shutter="rolling",
    ),
}

UNDETERMINED = {
    "no dark signal": Sensor(
        (0.42,),
        read_noise_e=2.0,
        exposure_s=(25e-6, 250e-6, 2.5e-3, 6.4e-3),
        offset_spread_dn=0.6,
        row_noise_dn=0.1,
        black_dn=10.3,
        white_dn=4095,
    ),
    # Offsets of pixels exceed the spread of their dark signal, so neither levels nor differences between pixels show
    # how much of either is dark signal.
    "one exposure": Sensor(
        (1.0,), read_noise_e=8.0, exposure_s=(60.0,), dark_e_per_s=0.5, spread=0.1, offset_spread_dn=8.0, frames=16
    ),
    "bias only": Sensor((0.7,), read_noise_e=12.0, exposure_s=(0.0,), offset_spread_dn=3.0, frame_jitter_dn=0.3),
    "only sub-Poisson hot pixels grow": Sensor(
        (1.3,),
        read_noise_e=8.0,
        exposure_s=(0.0, 60.0, 120.0, 240.0),
        hot_share=0.01,
        hot_e_per_s=2.0,
        hot_fano=0.7,
        offset_spread_dn=2.0,
    ),
    # Dark signal too small relative to the read noise for its skewness to determine the gain.
    "pedestal jumps": Sensor(
        (1.0,),
        read_noise_e=15.0,
        exposure_s=(30.0, 60.0, 90.0, 120.0, 180.0, 240.0),
        dark_e_per_s=0.08,
        spread=0.02,
        offset_spread_dn=1.0,
        pedestal_jump_dn=40.0,
        frames=4,
    ),
}
