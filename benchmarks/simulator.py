"""A simulator, in NumPy, of dark captures with a hidden effect; it shares no code with hsnoise.

`capture(camera, effect, amplitude, rng)` gives counts [exposure, frame, row, column]; `effect` may be a pair.
Amplitude 1 is typical of a modest real sensor; details (period, corner, taps) are drawn from `rng`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

EXPOSURE_S = (0.02, 0.05, 0.1, 0.2)


@dataclass(frozen=True)
class Camera:
    """Gain [channel] DN/e-, dark current e-/s, read noise e-, row gain sigma [channel], 1/f rows or white, black DN.

    Three channels are an RGGB sensor, one is a mono sensor.
    """

    gain: tuple[float, ...]
    dark: float
    read: float
    row_sigma: tuple[float, ...]
    rolling: bool
    black: float


CANON = Camera((1.53, 1.23, 1.31), 51.7, 12.5**0.5, (0.197**0.5, 0.039**0.5, 0.013**0.5), True, 0.0)
GRASSHOPPER = Camera((3.54, 3.11, 3.95), 118.0, 5.43**0.5, (0.09, 0.0069**0.5, 0.026**0.5), False, 64.0)
MONO = Camera((2.1,), 80.0, 3.0, (0.12,), True, 64.0)
CAMERAS = {"canon": CANON, "grasshopper": GRASSHOPPER, "mono": MONO}

# Amplitude 1 in each effect's own unit.
MODEST = {
    "row_noise": 1.0,  # e-
    "column_noise": 0.8,
    "row_fixed_pattern": 0.6,
    "column_fixed_pattern": 0.6,
    "frame_offset": 0.4,
    "dark_signal_nonuniformity": 1.5,
    "hot_pixels": 0.004,  # of the pixels
    "amplifier_glow": 60.0,  # e-/s in the corner
    "dark_current_nonuniformity": 0.15,  # relative, rms over pixels
    "dark_current_instability": 0.1,  # relative, rms over frames
    "dark_current_drift": 0.25,  # relative, from the first frame of an exposure to the last
    "random_telegraph_noise": 0.03,  # of the pixels, 12 e-
    "heavy_tailed_read_noise": 5.0,  # degrees of freedom
    "read_noise_nonuniformity": 0.35,
    "correlated_read_noise": 0.2,  # of the variance
    "periodic_banding": 0.8,  # e-
    "interference": 0.4,  # e-
    "row_bank_noise": 1.0,  # e-, rms of a bank's rows
    "row_group_noise": 0.8,  # e-
    "frame_tilt": 1.5,  # e-, from the first row to the last, rms over frames
    "frame_settling": 1.5,  # e-, in the first frame
    "crosstalk": 0.02,
    "readout_bandwidth": 0.05,
    "readout_overshoot": 0.04,
    "image_lag": 0.04,
    "odd_even_pattern": 0.8,  # e-
    "tap_offsets": 0.8,  # e-
    "tap_gains": 0.06,  # relative
    "black_shading": 1.5,  # DN, rms
    "missing_codes": 0.6,  # digital gain minus 1
    "adc_nonuniformity": 0.06,  # DN, rms error of the width of a code
    "cosmic_rays": 60.0,  # hits per Mpixel and frame
    "shared_row_gain": 0.12,
    "black_clamp": 0.7,  # of the dark level
    "nonlinearity": 0.003,  # curvature, 1/e-
}
# Effects that the library does not have.
ODD = (
    "ramp_37_rows",
    "block_offsets",
    "read_noise_along_row",
    "gain_vignette",
    "gain_slope",
    "dark_vignette",
    "checkerboard",
    "noise_over_frames",
    "noisy_odd_columns",
    "coupled_columns",
    "rows_swapped",
    "row_memory",
)
PAIRS = (
    ("row_noise", "hot_pixels"),
    ("column_fixed_pattern", "amplifier_glow"),
    ("frame_offset", "dark_signal_nonuniformity"),
    ("crosstalk", "random_telegraph_noise"),
    ("periodic_banding", "tap_offsets"),
)
TRIPLES = (
    ("row_noise", "hot_pixels", "column_fixed_pattern"),
    ("frame_offset", "dark_signal_nonuniformity", "crosstalk"),
    ("periodic_banding", "tap_offsets", "random_telegraph_noise"),
    ("odd_even_pattern", "cosmic_rays", "black_shading"),
    ("column_noise", "amplifier_glow", "row_fixed_pattern"),
)


def colour_of(shape: tuple[int, int], channels: int = 3) -> np.ndarray:
    """Channel of each pixel [row, column] of an RGGB sensor, or of a mono sensor with one channel."""
    if channels == 1:
        return np.zeros(shape, int)
    tile = np.array([[0, 1], [1, 2]])
    return np.tile(tile, (shape[0] // 2, shape[1] // 2))


def series(rng, frames: int, n: int, exponent: float) -> np.ndarray:
    """Normal series [frame, n] of unit variance, white or of power 1/f^exponent without DC."""
    if exponent == 0:
        return rng.standard_normal((frames, n))
    f = np.fft.rfftfreq(n, 1 / n)
    amplitude = np.zeros(len(f))
    amplitude[1:] = f[1:] ** (-exponent / 2)
    modes = rng.standard_normal((frames, len(f))) + 1j * rng.standard_normal((frames, len(f)))
    modes[:, -1] = modes[:, -1].real * np.sqrt(2)
    power = (amplitude[1:-1] ** 2).sum() * 2 + amplitude[-1] ** 2
    return np.fft.irfft(modes * amplitude, n, axis=1) * n / np.sqrt(2 * power)


def capture(
    camera: Camera,
    effect: str | tuple[str, ...] | None,
    amplitude: float,
    rng,
    *,
    frames=8,
    shape=(160, 240),
    exposure_s=EXPOSURE_S,
) -> np.ndarray:
    """Counts [exposure, frame, row, column] with `effect` hidden in them (None: nothing; several: all at once)."""
    effects = (effect,) if isinstance(effect, str) else effect or ()
    sizes = {name: _size(name, amplitude) for name in effects}
    hidden = _static(sizes, camera, rng, shape)
    return np.stack([_exposure(camera, sizes, hidden, t, rng, frames, shape) for t in exposure_s])


def _size(effect: str, amplitude: float) -> float:
    """An amplitude in the effect's own unit."""
    if effect not in MODEST and effect not in ODD:
        raise ValueError(f"effect: {effect!r} is not one of {', '.join((*MODEST, *ODD))}")
    if effect == "heavy_tailed_read_noise":
        return max(MODEST[effect] / amplitude, 2.1)  # the variance of Student's t is finite above 2
    size = MODEST.get(effect, 1.0) * amplitude
    return min(size, 1.0) if effect == "black_clamp" else size  # no camera subtracts more than the dark level


def _static(sizes: dict[str, float], camera: Camera, rng, shape) -> dict[str, np.ndarray | float]:
    """The fixed patterns of the sensor from all effects."""
    out: dict[str, np.ndarray | float] = {}
    for effect, size in sizes.items():
        for name, value in _static_of(effect, size, camera, rng, shape).items():
            if name in ("offset", "rate"):
                value = out.get(name, 0.0) + value
            elif name in ("read", "gain"):
                value = out.get(name, 1.0) * value
            out[name] = value
    return out


def _static_of(effect: str, size: float, camera: Camera, rng, shape) -> dict[str, np.ndarray | float]:
    """The fixed patterns of the sensor from one effect."""
    rows, columns = shape
    r, c = np.mgrid[0:rows, 0:columns]
    out: dict[str, np.ndarray | float] = {}
    if effect == "row_fixed_pattern":
        out["offset"] = size * rng.standard_normal((rows, 1))
    elif effect == "column_fixed_pattern":
        out["offset"] = size * rng.standard_normal((1, columns))
    elif effect == "dark_signal_nonuniformity":
        out["offset"] = size * rng.standard_normal(shape)
    elif effect == "odd_even_pattern":
        out["offset"] = size * (_parity(camera, shape) - 0.5)
    elif effect in ("tap_offsets", "tap_gains"):
        taps = int(rng.choice([2, 4, 8]))
        levels = rng.standard_normal(taps)
        levels = size * ((levels - levels.mean()) / max(levels.std(), 0.3))[c * taps // columns]
        out.update({"offset": levels} if effect == "tap_offsets" else {"gain": 1 + levels})
    elif effect == "black_shading":
        along = rng.choice([0, 1])
        line = np.exp(-np.arange(shape[along]) / (rng.uniform(0.05, 1.0) * shape[along]))[:: rng.choice([-1, 1])]
        line = rng.choice([-1, 1]) * (line - line.mean()) / line.std()
        out["black"] = size * (line[:, None] if along == 0 else line[None])
    elif effect == "hot_pixels":
        hot = rng.random(shape) < size
        out["rate"] = hot * rng.exponential(rng.uniform(200, 800), shape)
    elif effect == "dark_current_nonuniformity":
        out["rate"] = camera.dark * (rng.gamma(1 / size**2, size**2, shape) - 1)
    elif effect == "amplifier_glow":
        far = np.hypot((r - rng.choice([0, rows - 1])) / rows, (c - rng.choice([0, columns - 1])) / columns)
        out["rate"] = size * np.exp(-far / rng.uniform(0.2, 0.5))
    elif effect == "random_telegraph_noise":
        out["jumping"] = rng.random(shape) < size
        out["duty"] = float(rng.uniform(0.25, 0.75))
    elif effect == "read_noise_nonuniformity":
        spread = np.exp(size * rng.standard_normal(shape))
        out["read"] = spread / np.sqrt((spread**2).mean())
    elif effect == "correlated_read_noise":
        out["memory"], out["alternates"] = float(rng.uniform(0.3, 0.8)), bool(rng.integers(2))
    elif effect == "periodic_banding":
        out["frequency"] = float(rng.uniform(0.03, 0.45))
    elif effect == "interference":
        out["down"], out["across"] = rng.uniform(0.03, 0.45), rng.uniform(-0.45, 0.45)
    elif effect == "row_group_noise":
        together = int(rng.choice([4, 8, 16]))
        out["group"] = (np.arange(rows) + rng.integers(together)) // together
    elif effect == "frame_settling":
        out["frames"] = float(rng.uniform(0.7, 3.0))
    elif effect == "adc_nonuniformity":
        widths = 1 + size * rng.standard_normal(int(rng.choice([4, 8, 16])))
        out["widths"] = widths / widths.mean()
    elif effect == "block_offsets":
        out["offset"] = 0.8 * size * rng.standard_normal((rows // 64 + 1, columns // 64 + 1))[r // 64, c // 64]
    elif effect == "read_noise_along_row":
        spread = 1 + 0.6 * size * (c / columns - 0.5)
        out["read"] = spread / np.sqrt((spread**2).mean())
    elif effect in ("gain_vignette", "dark_vignette"):
        far = ((r - rows / 2) / rows) ** 2 + ((c - columns / 2) / columns) ** 2
        less = size * (far - far.mean())
        out.update({"gain": 1 - 0.5 * less} if effect == "gain_vignette" else {"rate": -camera.dark * less})
    elif effect == "checkerboard":
        out["offset"] = 1.5 * size * ((r // 2 + c // 2) % 2 - 0.5)
    elif effect == "gain_slope":
        out["gain"] = 1 + 0.3 * size * (c / columns - 0.5)
    elif effect == "noisy_odd_columns":
        out["noisy"] = _parity(camera, shape)
    elif effect == "coupled_columns":
        out["column"] = int(rng.integers(4, columns - 4))
    elif effect == "rows_swapped":
        out["row"] = 2 * int(rng.integers(0, rows // 4))
    return out


def _parity(camera: Camera, shape) -> np.ndarray:
    """0 in even columns of each colour, 1 in odd ones."""
    period = 1 if len(camera.gain) == 1 else 2
    return np.broadcast_to(np.arange(shape[1]) // period % 2, shape)


def _exposure(camera: Camera, sizes, hidden, t: float, rng, frames: int, shape) -> np.ndarray:
    whole = (frames, *shape)
    rate = camera.dark + hidden.get("rate", 0.0)
    if drift := sizes.get("dark_current_drift"):
        rate = rate * (1 + drift * np.arange(frames)[:, None, None] / max(frames - 1, 1))
    if swing := sizes.get("dark_current_instability"):
        phase = 1.7 * np.arange(frames) + rng.uniform(0, 2 * np.pi)
        rate = rate * (1 + swing * np.sqrt(2) * np.sin(phase))[:, None, None]
    x = rng.poisson(np.broadcast_to(rate * t, whole)).astype(float)
    if excess := sizes.get("noisy_odd_columns"):
        x += np.sqrt(0.3 * excess * x * hidden["noisy"]) * rng.standard_normal(whole)
    if hits := sizes.get("cosmic_rays"):
        x += (rng.random(whole) < hits * 1e-6) * rng.exponential(120.0, whole)
    if leak := sizes.get("crosstalk"):
        padded = np.pad(x, ((0, 0), (1, 1), (1, 1)), mode="edge")
        around = padded[:, :-2, 1:-1] + padded[:, 2:, 1:-1] + padded[:, 1:-1, :-2] + padded[:, 1:-1, 2:]
        x = (1 - 4 * leak) * x + leak * around
    if lag := sizes.get("image_lag"):
        x[1:] = (1 - lag) * x[1:] + lag * x[:-1]
    noise = rng.standard_normal(whole)
    if freedom := sizes.get("heavy_tailed_read_noise"):
        noise = rng.standard_t(freedom, whole) * np.sqrt((freedom - 2) / freedom)
    if share := sizes.get("correlated_read_noise"):
        noise = np.sqrt(1 - share) * noise + np.sqrt(share) * _along_rows(hidden, rng, whole)
    if growth := sizes.get("noise_over_frames"):
        noise *= np.linspace(1 - 0.3 * growth, 1 + 0.3 * growth, frames)[:, None, None]
    x += camera.read * noise * hidden.get("read", 1.0) + hidden.get("offset", 0.0)
    if coupling := sizes.get("coupled_columns"):
        x[:, :, hidden["column"]] += coupling * x[:, :, hidden["column"] - 2]
    for effect, size in sizes.items():
        x += _moving(effect, size, hidden, rng, frames, shape)
    if smear := sizes.get("readout_bandwidth"):
        x[:, :, 1:] = (1 - smear) * x[:, :, 1:] + smear * x[:, :, :-1]
    if ahead := sizes.get("readout_overshoot"):
        x[:, :, 1:] = (1 + ahead) * x[:, :, 1:] - ahead * x[:, :, :-1]
    if curvature := sizes.get("nonlinearity"):
        x = np.minimum(x, 0.5 / curvature)  # constant beyond the maximum
        x = x - curvature * np.maximum(x, 0) ** 2
    return _digital(camera, sizes, x * hidden.get("gain", 1.0), hidden, t, rng)


def _along_rows(hidden, rng, shape: tuple[int, ...]) -> np.ndarray:
    """Noise of unit variance that goes on from pixel to pixel of a row, as it is or with alternating sign."""
    memory = hidden["memory"]
    kicks = rng.standard_normal(shape) * np.sqrt(1 - memory**2)
    kicks[..., 0] /= np.sqrt(1 - memory**2)
    noise = lfilter([1.0], [1.0, -memory], kicks, axis=-1)
    return noise * (-1.0) ** np.arange(shape[-1]) if hidden["alternates"] else noise


def _moving(effect, size, hidden, rng, frames: int, shape) -> np.ndarray | float:
    """Offsets that are new in each frame, e-."""
    rows, columns = shape
    if effect == "row_noise":
        return size * rng.standard_normal((frames, rows, 1))
    if effect == "column_noise":
        return size * rng.standard_normal((frames, 1, columns))
    if effect == "frame_offset":
        return size * rng.standard_normal((frames, 1, 1))
    if effect == "periodic_banding":
        phase = rng.uniform(0, 2 * np.pi, (frames, 1, 1))
        return size * np.sin(2 * np.pi * hidden["frequency"] * np.arange(rows)[None, :, None] + phase)
    if effect == "interference":
        turns = hidden["down"] * np.arange(rows)[:, None] + hidden["across"] * np.arange(columns)
        return size * np.sin(2 * np.pi * (turns + rng.random((frames, 1, 1))))
    if effect == "row_bank_noise":
        kicks = rng.standard_normal((2, frames, rows // 2)) * np.sqrt(1 - 0.9**2)
        kicks[..., 0] /= np.sqrt(1 - 0.9**2)
        banks = lfilter([1.0], [1.0, -0.9], kicks, axis=-1)
        return size * banks.transpose(1, 2, 0).reshape(frames, rows, 1)
    if effect == "row_group_noise":
        return size * rng.standard_normal((frames, rows))[:, hidden["group"], None]
    if effect == "frame_tilt":
        return size * rng.standard_normal((frames, 1, 1)) * np.linspace(-0.5, 0.5, rows)[:, None]
    if effect == "frame_settling":
        return size * np.exp(-np.arange(frames) / hidden["frames"])[:, None, None]
    if effect == "random_telegraph_noise":
        return 12.0 * hidden["jumping"] * (rng.random((frames, *shape)) < hidden["duty"])
    if effect == "row_memory":
        kicks = rng.standard_normal((frames, rows, 1))
        kicks[1:] *= 0.6
        return size * lfilter([1.0], [1.0, -0.8], kicks, axis=0)
    if effect == "ramp_37_rows":
        return (1.5 * size * ((np.arange(rows) % 37) / 37 - 0.5))[None, :, None]
    return 0.0


def _digital(camera: Camera, sizes, x: np.ndarray, hidden, t: float, rng) -> np.ndarray:
    """Gain, row gain, black level and its shading, codes."""
    frames, rows, columns = x.shape
    channels = len(camera.gain)
    colour = colour_of(x.shape[1:], channels)
    shared = np.zeros((frames, rows))
    if sigma := sizes.get("shared_row_gain"):
        shared = sigma * series(rng, frames, rows, float(camera.rolling))
    y = np.empty_like(x)
    for c in range(channels):
        beta = 1 + camera.row_sigma[c] * series(rng, frames, rows, float(camera.rolling))
        beta = np.maximum(beta, 0) * np.maximum(1 + shared, 0)
        clamped = sizes.get("black_clamp", 0.0) * camera.gain[c] * camera.dark * t
        y = np.where(colour == c, camera.gain[c] * beta[:, :, None] * x - clamped, y)
    y += camera.black + hidden.get("black", 0.0)
    counts = np.clip(np.rint(y), 0, 65535)
    if "widths" in hidden:
        ends = np.cumsum(np.resize(hidden["widths"], int(counts.max()) + 2)) - 0.5
        counts = np.searchsorted(ends, y, side="right").astype(float)
    if "row" in hidden:  # the readout has lost step for a fifth of the rows
        swapped = slice(hidden["row"], hidden["row"] + 2 * (rows // 10))
        pairs = counts[:, swapped].reshape(frames, -1, 2, columns)
        counts[:, swapped] = pairs[:, :, ::-1].reshape(frames, -1, columns)
    if more := sizes.get("missing_codes"):
        counts = np.clip(np.rint(np.rint(counts / (1 + more)) * (1 + more)), 0, 65535)
    return counts.astype(np.uint16)
