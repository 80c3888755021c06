"""Noisy frames of clean ones: light of a scene, what the camera makes of it, and simpler noise of the same strength."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import hsnoise
from hsnoise import NoiseModel, photoelectrons_from_illuminance
from hsnoise._keys import named_key
from hsnoise._types import cfa_tile
from hsnoise.draws import black_level_of
from hsnoise.effects import BlackLevel, DarkCurrent, ReadNoise, ShotNoise
from hsnoise.mosaic import electrons_of, mosaic
from hsnoise.photometry import GREY

JITTER = 0.1  # rms, of the logarithm of each parameter that cannot be negative
MATCH_SHAPE, MATCH_FRAMES = (256, 256), 8
NOISES = ("hsnoise", "gaussian", "poisson-gaussian")


@dataclass(frozen=True)
class Optics:
    """A camera's exposure and what turns the light of a scene into electrons, and its range in the paper (lux)."""

    exposure_s: float
    f_number: float
    pixel_pitch_m: float
    quantum_efficiency: float
    lux: tuple[float, float]

    def white_e(self, lux) -> jax.Array:
        """Photoelectrons of a pixel that sees a white surface in `lux`: the lens passes 1 / (4 N^2) of them."""
        return photoelectrons_from_illuminance(
            lux / (4 * self.f_number**2),
            exposure_s=self.exposure_s,
            quantum_efficiency=self.quantum_efficiency,
            pixel_pitch_m=self.pixel_pitch_m,
        )


# Exposure, f-number and illuminance: Wang et al., ICCV 2019. Pitch and quantum efficiency: data sheets.
OPTICS = {
    "canon_5d3": Optics(0.05, 5.6, 6.25e-6, 0.49, (0.05, 0.2)),
    "grasshopper3": Optics(0.03, 1.8, 3.45e-6, 0.60, (0.01, 0.03)),
}


@dataclass(frozen=True)
class Camera:
    """A camera to train for: its noise, and the photoelectrons of white in dim and in bright scenes."""

    name: str
    model: NoiseModel
    white_e: tuple[float, float]

    @property
    def channels(self) -> int:
        return len(self.model.channels)


def camera_of(name: str, lux: tuple[float, float] | None, white_e: tuple[float, float] | None) -> Camera:
    """A built-in camera, or that of a model.json.

    Raises:
        ValueError: an unknown camera or file; light that is missing, given twice or not above 0.
    """
    if name in OPTICS:
        model, optics = getattr(hsnoise.cameras, name)(), OPTICS[name]
        if white_e is None:
            low, high = lux or optics.lux
            white_e = float(optics.white_e(low)), float(optics.white_e(high))
    elif Path(name).is_file():
        if lux is not None or white_e is None:
            raise ValueError("--white-e: needed with a model.json, which does not tell the optics that --lux needs")
        model = NoiseModel.load(name)
    else:
        raise ValueError(f"--camera: expected a model.json or one of {', '.join(OPTICS)}, got {name}")
    if not 0 < white_e[0] <= white_e[1]:
        raise ValueError(f"--lux, --white-e: expected low, high above 0, got {white_e[0]:g}, {white_e[1]:g}")
    return Camera(Path(name).stem, model, white_e)


def noise_of(kind: str, camera: Camera) -> NoiseModel:
    """The noise to train on: the camera's own, a simpler one of the same strength, or that of a model.json.

    Raises:
        ValueError: an unknown noise, or a model of other channels than the camera's.
    """
    if kind == "hsnoise":
        return camera.model
    if kind in NOISES:
        return matched(camera.model, kind, GREY * float(np.sqrt(np.prod(camera.white_e))))
    if not Path(kind).is_file():
        raise ValueError(f"--noise: expected a model.json or one of {', '.join(NOISES)}, got {kind}")
    model = NoiseModel.load(kind)
    if model.cfa != camera.model.cfa:
        raise ValueError(f"--noise: {kind} is a model of cfa {model.cfa}, the camera's is {camera.model.cfa}")
    return model


def matched(model: NoiseModel, kind: str, light_e: float, dark_variance_e2: float | None = None) -> NoiseModel:
    """Independent noise of the same variance in each pixel: that of the model's frames, or of `dark_variance_e2`.

    "poisson-gaussian": shot noise, and read noise that makes up the variance of darks (so that variance against mean
    is the same line). "gaussian": one variance for all, that at `light_e` photoelectrons.
    """
    light_e = light_e if kind == "gaussian" else 0.0
    variance_e2 = _variance_e2(model, light_e) if dark_variance_e2 is None else dark_variance_e2 + light_e
    rate = model["dark_current"].rate if "dark_current" in model else jnp.zeros(())
    dark_e = float(rate) * model.exposure_s
    if kind == "poisson-gaussian":
        effects = [ShotNoise(), DarkCurrent(rate), ReadNoise(float(np.sqrt(max(variance_e2 - dark_e, 1e-6))))]
        black_level = black_level_of(model)
    else:
        effects = [ReadNoise(float(np.sqrt(variance_e2)))]
        clamp = np.asarray(model["black_clamp"].rate) * model.exposure_s if "black_clamp" in model else 0.0
        black_level = black_level_of(model) + np.asarray(model["gain"].value) * dark_e - clamp
    effects += [model["gain"], BlackLevel(jnp.asarray(black_level)), *([model["adc"]] if "adc" in model else [])]
    return NoiseModel(effects, cfa=model.cfa, shutter=model.shutter, exposure_s=model.exposure_s)


def _variance_e2(model: NoiseModel, light_e: float) -> float:
    """Temporal variance of sensor pixels in even light, mean over them, e-^2, from differences of frames."""
    light = np.full((MATCH_FRAMES, *MATCH_SHAPE), light_e, np.float32)
    # Before clipping: the simpler noise is clipped, too.
    open_ended = model.remove("adc") if "adc" in model else model
    counts = np.asarray(hsnoise.sample(jax.random.key(0), light, open_ended), np.float64)
    tile = cfa_tile(model.cfa)
    gain = np.tile(np.asarray(model["gain"].value)[tile], [n // len(tile) for n in MATCH_SHAPE])
    return float(0.5 * np.mean((np.diff(counts, axis=0) / gain) ** 2))


def jittered(key: jax.Array, model: NoiseModel, rms: float = JITTER) -> NoiseModel:
    """`model` with other numbers, about 10 % off: cameras of one make differ, and so do fits."""
    for effect in model.effects:
        for field, spec in effect.specs().items():
            if spec.low != 0:
                continue
            value = getattr(effect, field)
            own = named_key(key, f"{effect.name}.{field}")
            value = value * jnp.exp(rms * jax.random.normal(own, jnp.shape(value), jnp.float32))
            model = model.with_value(effect.name, field, value if spec.high is None else jnp.minimum(value, spec.high))
    return model


def noisy_of(key: jax.Array, light: jax.Array, camera: NoiseModel, noise: NoiseModel, white_e) -> jax.Array:
    """What comes out of frames of light [frame, row, column, channel] (white is 1), in the same units.

    noise makes the counts; black level, gain and dark current of `camera` turn them back to light.
    """
    counts = hsnoise.sample(key, mosaic(light * white_e, noise.cfa), noise)
    return electrons_of(counts, camera) / white_e
