"""Noisy frames from clean ones: the light of a scene, the camera's noise, and simpler noise of the same strength."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from hsnoise._core.keys import named_key
from hsnoise._core.types import cfa_tile
from hsnoise.effects import BlackLevel, DarkCurrent, ReadNoise, ShotNoise
from hsnoise.enhance.mosaic import electrons_of, mosaic
from hsnoise.enhance.training.protocol import OPTICS, Optics, middle_of, unit_of
from hsnoise.model import NoiseModel, sample
from hsnoise.simulation import cameras
from hsnoise.simulation.draws import black_level_of

JITTER = 0.1  # rms, of the logarithm of each non-negative parameter
MATCH_SHAPE, MATCH_FRAMES = (256, 256), 8
LEAST_LIGHT, MOST_LIGHT = 1e-4, 1e6  # photoelectrons, or lux
NOISES = ("hsnoise", "gaussian", "poisson-gaussian")
Shape = tuple[int, int]


@dataclass(frozen=True)
class Camera:
    """A camera to train for: its noise, photoelectrons that dim and bright scenes average, and its optics if known.

    sensor: rows and columns of its frames, from which pieces are drawn; None: each piece is a whole frame.
    """

    name: str
    model: NoiseModel
    mean_e: tuple[float, float]
    optics: Optics | None = None
    sensor: Shape | None = None

    @property
    def channels(self) -> int:
        return len(self.model.channels)

    @property
    def unit_e(self) -> float:
        """Electrons, e-, that are 1 in the network's input."""
        return unit_of(self.mean_e)

    def in_words(self, mean_e: float) -> str:
        """The light of a scene that averages `mean_e` photoelectrons."""
        return f"{mean_e:.2g} e-" if self.optics is None else f"{mean_e / float(self.optics.mean_e(1.0)):.2g} lux"


def camera_of(
    name: str,
    lux: tuple[float, float] | None,
    mean_e: tuple[float, float] | None,
    exposure_s: float | None = None,
) -> Camera:
    """A built-in camera, or the one in a model.json at this exposure of a video frame (default: the model's own).

    Raises:
        ValueError: an unknown camera or file; light that is missing, given twice or out of range; an exposure that is
            not above 0, or given with a built-in camera, which has its own.
    """
    if lux is not None and mean_e is not None:
        raise ValueError(f"--lux, --mean-e: both say how much light there is; expected one, got {lux} and {mean_e}")
    if name in OPTICS:
        if exposure_s is not None:
            raise ValueError(f"--exposure: goes with a model.json; {name} has {OPTICS[name].exposure_s:g} s")
        return _built_in(name, lux, mean_e)
    if not Path(name).is_file():
        raise ValueError(f"--camera: expected a model.json or one of {', '.join(OPTICS)}, got {name}")
    model = NoiseModel.load(name)
    if lux is not None or mean_e is None:
        raise ValueError("--mean-e: needed with a model.json, which lacks the optics that --lux needs")
    if exposure_s is not None:
        if not 0 < exposure_s < np.inf:
            raise ValueError(f"--exposure: expected seconds above 0, got {exposure_s:g}")
        model = at_exposure(model, exposure_s)
    return Camera(Path(name).stem, model, checked_light("--mean-e", mean_e))


def _built_in(name: str, lux: tuple[float, float] | None, mean_e: tuple[float, float] | None) -> Camera:
    model, optics = getattr(cameras, name)(), OPTICS[name]
    if mean_e is None:
        low, high = checked_light("--lux", lux or optics.lux)
        mean_e = float(optics.mean_e(low)), float(optics.mean_e(high))
    return Camera(name, model, checked_light("--mean-e", mean_e), optics)


def checked_light(option: str, light: tuple[float, float]) -> tuple[float, float]:
    """`light`; raises ValueError unless it is a plausible range."""
    low, high = light
    if not LEAST_LIGHT <= low <= high <= MOST_LIGHT:
        allowed = f"low,high, the low one first, from {LEAST_LIGHT:g} to {MOST_LIGHT:g}"
        raise ValueError(f"{option}: expected {allowed}, got {low:g},{high:g}")
    return light


def at_exposure(model: NoiseModel, exposure_s: float) -> NoiseModel:
    """`model` with this default exposure, s."""
    return NoiseModel(model.effects, cfa=model.cfa, shutter=model.shutter, exposure_s=exposure_s)


def noise_of(kind: str, camera: Camera) -> NoiseModel:
    """The noise to train on: the camera's own, simpler noise of the same strength, or that of a model.json.

    All at the camera's exposure.

    Raises:
        ValueError: an unknown noise, or a model whose channels differ from the camera's.
    """
    if kind == "hsnoise":
        return camera.model
    if kind in NOISES:
        return matched(camera.model, kind, middle_of(camera.mean_e))
    if not Path(kind).is_file():
        raise ValueError(f"--noise: expected a model.json or one of {', '.join(NOISES)}, got {kind}")
    model = NoiseModel.load(kind)
    if model.cfa != camera.model.cfa:
        raise ValueError(f"--noise: {kind} is a model of cfa {model.cfa}, the camera's is {camera.model.cfa}")
    return at_exposure(model, camera.model.exposure_s)


def matched(model: NoiseModel, kind: str, light_e: float, dark_variance_e2: float | None = None) -> NoiseModel:
    """Independent noise with each pixel's variance in the model's frames, or in darks of `dark_variance_e2`.

    "poisson-gaussian": shot noise plus read noise that makes up the variance of darks, so that variance against mean is
    the same straight line except for the row gain's quadratic term. "gaussian": the variance at `light_e`
    photoelectrons for all pixels.
    """
    light_e = light_e if kind == "gaussian" else 0.0
    variance_e2 = _variance_e2(model, light_e) if dark_variance_e2 is None else dark_variance_e2 + light_e
    rate = model["dark_current"].rate if "dark_current" in model else jnp.zeros(())
    dark_e = float(rate) * model.exposure_s
    clamp = np.asarray(model["black_clamp"].rate) * model.exposure_s if "black_clamp" in model else 0.0
    black_level = black_level_of(model) - clamp
    if kind == "poisson-gaussian":
        effects = [ShotNoise(), DarkCurrent(rate), ReadNoise(float(np.sqrt(max(variance_e2 - dark_e, 1e-6))))]
    else:
        effects = [ReadNoise(float(np.sqrt(variance_e2)))]
        black_level = black_level + np.asarray(model["gain"].value) * dark_e
    effects += [model["gain"], BlackLevel(jnp.asarray(black_level)), *([model["adc"]] if "adc" in model else [])]
    return NoiseModel(effects, cfa=model.cfa, shutter=model.shutter, exposure_s=model.exposure_s)


def _variance_e2(model: NoiseModel, light_e: float) -> float:
    """Mean temporal variance of sensor pixels in uniform light, e-^2, from differences of frames."""
    light = np.full((MATCH_FRAMES, *MATCH_SHAPE), light_e, np.float32)
    # Before clipping, because the simpler noise is clipped as well.
    open_ended = model.remove("adc") if "adc" in model else model
    counts = np.asarray(sample(jax.random.key(0), light, open_ended), np.float64)
    tile = cfa_tile(model.cfa)
    gain = np.tile(np.asarray(model["gain"].value)[tile], [n // len(tile) for n in MATCH_SHAPE])
    return float(0.5 * np.mean((np.diff(counts, axis=0) / gain) ** 2))


def jittered(key: jax.Array, model: NoiseModel, rms: float = JITTER) -> NoiseModel:
    """`model` with parameters changed by about 10 %: cameras of one make differ, and so do fits."""
    for effect in model.effects:
        for field, spec in effect.specs().items():
            if spec.low != 0:
                continue
            value = getattr(effect, field)
            own = named_key(key, f"{effect.name}.{field}")
            value = value * jnp.exp(rms * jax.random.normal(own, jnp.shape(value), jnp.float32))
            model = model.with_value(effect.name, field, value if spec.high is None else jnp.minimum(value, spec.high))
    return model


def noisy_of(
    key: jax.Array,
    light: jax.Array,
    camera: NoiseModel,
    noise: NoiseModel,
    white_e: ArrayLike,
    unit_e: ArrayLike,
    sensor: Shape | None = None,
) -> jax.Array:
    """Noisy frames, in units of `unit_e` electrons, from frames of light [frame, row, column, channel] (white is 1).

    `noise` makes the counts; black level, gain and dark current of `camera` turn them back to electrons.

    white_e: photoelectrons of white in this scene, e-: those of its average, E[N_e], over the average of its light;
    sensor: as in Camera; the frames lie at a random place on it. Raises ValueError if they are larger.
    """
    photons = mosaic(light * white_e, noise.cfa)
    window = None if sensor is None else _somewhere(named_key(key, "place"), photons.shape, sensor, noise.cfa)
    return electrons_of(sample(key, photons, noise, window=window), camera) / unit_e


def _somewhere(key: jax.Array, shape: tuple[int, ...], sensor: Shape, cfa: str) -> tuple:
    """A window for frames of `shape` at a random place on the sensor that starts on a whole Bayer cell."""
    free = [most - size for most, size in zip(sensor, shape[-2:], strict=True)]
    if min(free) < 0:
        asked, came = (f"{rows} x {columns}" for rows, columns in (shape[-2:], sensor))
        raise ValueError(f"--sensor: expected at least the {asked} pixels of a piece of a frame, got {came}")
    period, keys = len(cfa_tile(cfa)), jax.random.split(key)
    first = (period * jax.random.randint(k, (), 0, n // period + 1) for k, n in zip(keys, free, strict=True))
    return (*first, *sensor)
