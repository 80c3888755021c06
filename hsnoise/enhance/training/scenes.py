"""A clip in some light, as a camera sees it: what networks and rivals are scored on."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

from hsnoise.chain.photometry import GREY, display_from_linear, light_of_frames, linear_from_display
from hsnoise.enhance.training.clips import Clip
from hsnoise.enhance.training.noisy import Camera, noisy_of


@dataclass(frozen=True)
class Scene:
    """A clip in light that averages `mean_e` photoelectrons, [frame, row, column, channel].

    clean: display values; noisy: light in units of the camera; white_e: photoelectrons of white, e-.
    """

    clip: str
    camera: Camera
    mean_e: float
    white_e: float
    clean: np.ndarray
    noisy: np.ndarray

    @property
    def noisy_e(self) -> np.ndarray:
        """The noisy frames in photoelectrons, e-."""
        return self.noisy.astype(float) * self.camera.unit_e

    @property
    def sigma_e(self) -> float:
        """Standard deviation of the temporal noise, e-."""
        noise = self.noisy_e - self.white_e * np.asarray(linear_from_display(self.clean))
        return float(np.sqrt(0.5 * np.mean(np.diff(noise, axis=0) ** 2)))

    @property
    def exposed_e(self) -> float:
        """Photoelectrons, e-, that an automatic exposure makes white: the mean becomes an ordinary grey.

        Raises:
            ValueError: the frames are no brighter than black.
        """
        mean_e = float(self.noisy_e.mean())
        if not mean_e > 0:
            raise ValueError(f"clip {self.clip}: averages {mean_e:.3g} e- above black, expected light")
        return mean_e / GREY


def scene_of(clip: Clip, camera: Camera, mean_e: float, crop: int, seed: int, frames: int | None = None) -> Scene:
    """The central square of `crop` pixels of the first `frames` frames (None: of all), with noise of this seed.

    mean_e: photoelectrons that the whole clip averages, e-.
    """
    side = [min(crop, n) // 2 * 2 for n in clip.frames.shape[1:3]]
    row, column = ((n - s) // 2 for n, s in zip(clip.frames.shape[1:3], side, strict=True))
    light = light_of_frames(clip.frames[:frames, row : row + side[0], column : column + side[1]], camera.channels)
    white_e, model = mean_e / clip.average, camera.model
    noisy = noisy_of(jax.random.key(seed), light, model, model, white_e, camera.unit_e, camera.sensor)
    return Scene(
        clip.name, camera, mean_e, white_e, np.asarray(display_from_linear(light)), np.asarray(noisy, np.float32)
    )
