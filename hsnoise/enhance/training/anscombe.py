"""The generalised Anscombe transform: noise of variance 1 from shot and read noise, and its unbiased inverse.

Reference: Mäkitalo and Foi, "Optimal inversion of the generalized Anscombe transformation for Poisson-Gaussian
noise", IEEE Transactions on Image Processing 22 (2013), 91-103.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hsnoise._core.types import cfa_tile
from hsnoise.likelihood.flat_likelihood import ROUNDING_VARIANCE
from hsnoise.model import NoiseModel


@dataclass(frozen=True)
class Anscombe:
    """The transform for each channel of frames [..., channel] in electrons.

    pixels: sensor pixels that a channel averages (2 greens in a Bayer cell); variance_e2: variance of the noise of one
    such pixel in the dark, e-^2. Both [channel].
    """

    pixels: np.ndarray
    variance_e2: np.ndarray

    @classmethod
    def of(cls, params: NoiseModel) -> Anscombe:
        """From a camera's gain, read noise and dark current; its other noise is not stabilised."""
        tile, channels = cfa_tile(params.cfa), len(params.channels)
        gain = np.broadcast_to(np.asarray(params["gain"].value, float), (channels,))
        read_e = np.broadcast_to(np.asarray(params["read_noise"].sigma if "read_noise" in params else 0.0), (channels,))
        dark_e = float(params["dark_current"].rate) * params.exposure_s if "dark_current" in params else 0.0
        rounding_dn2 = ROUNDING_VARIANCE if "adc" in params else 0.0
        pixels = np.bincount(tile.reshape(-1), minlength=channels)
        return cls(pixels, read_e**2 + dark_e + rounding_dn2 / gain**2)

    def forward(self, electrons: np.ndarray) -> np.ndarray:
        """Values whose noise has variance 1, from electrons, e-."""
        return 2 * np.sqrt(np.maximum(electrons * self.pixels + self._offset_e, 0))

    def inverse(self, values: np.ndarray) -> np.ndarray:
        """Electrons, e-, whose transform has these expected values.

        The closed form that approximates the exact unbiased inverse. Values below that of no light count as it.
        """
        root, d = np.sqrt(3 / 2), np.maximum(values, 2 * np.sqrt(self._offset_e))
        series = d**2 / 4 + root / (4 * d) - 11 / (8 * d**2) + 5 * root / (8 * d**3) - 1 / 8
        return np.maximum(series - self.pixels * self.variance_e2, 0) / self.pixels

    @property
    def _offset_e(self) -> np.ndarray:
        return 3 / 8 + self.pixels * self.variance_e2
