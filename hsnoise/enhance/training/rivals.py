"""Methods that need no training: the scaled frame, non-local means, total variation, BM3D, BM4D.

Each gets the true noise of the frames (the standard deviation in flat areas), and the strength and the domain (linear
light or display values) that do best on a clip that is not scored.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec

import numpy as np
from skimage.restoration import denoise_nl_means, denoise_tv_chambolle

from hsnoise.chain.photometry import display_from_linear

STRENGTHS = (0.5, 1.0, 2.0, 4.0, 8.0)
WEIGHT_OF_SIGMA = 0.8  # of total variation, for a noise of 1

Denoiser = Callable[[np.ndarray, float], np.ndarray]  # frames [frame, row, column, channel], sigma


def _frame_by_frame(denoise: Denoiser, frames: np.ndarray, sigma: float) -> np.ndarray:
    return np.stack([denoise(frame, sigma) for frame in frames])


def _non_local_means(frame: np.ndarray, sigma: float) -> np.ndarray:
    sizes = {"patch_size": 5, "patch_distance": 9, "fast_mode": True}
    return denoise_nl_means(frame, h=0.8 * sigma, sigma=sigma, channel_axis=-1, **sizes)


def _total_variation(frame: np.ndarray, sigma: float) -> np.ndarray:
    return denoise_tv_chambolle(frame, weight=WEIGHT_OF_SIGMA * sigma, channel_axis=-1)


def _bm3d(frame: np.ndarray, sigma: float) -> np.ndarray:
    from bm3d import bm3d

    return bm3d(frame, sigma).reshape(frame.shape)


def _bm4d(frames: np.ndarray, sigma: float) -> np.ndarray:
    from bm4d import bm4d

    planes = [bm4d(np.moveaxis(frames[..., c], 0, -1), sigma) for c in range(frames.shape[-1])]
    return np.moveaxis(np.stack(planes, -1), 2, 0)


PEERS: dict[str, tuple[str, Denoiser]] = {
    "BM3D": ("bm3d", partial(_frame_by_frame, _bm3d)),
    "BM4D over frames": ("bm4d", _bm4d),
}


def rivals() -> dict[str, Denoiser]:
    """All methods by name; BM3D and BM4D only if their packages (extra `peers`) are installed."""
    found: dict[str, Denoiser] = {
        "non-local means": partial(_frame_by_frame, _non_local_means),
        "total variation": partial(_frame_by_frame, _total_variation),
    }
    return found | {name: denoise for name, (package, denoise) in PEERS.items() if find_spec(package)}


def not_installed() -> list[str]:
    """Names of the rivals whose packages are missing."""
    return [name for name, (package, _) in PEERS.items() if not find_spec(package)]


def denoised(denoise: Denoiser, noisy: np.ndarray, sigma: float, strength: float, linear: bool) -> np.ndarray:
    """Display values of noisy linear light, denoised as linear light or as display values."""
    if linear:
        return np.asarray(display_from_linear(denoise(noisy.astype(float), strength * sigma)))
    shown = np.clip(np.asarray(display_from_linear(noisy)), 0, 1)
    # The display curve and clipping change the noise: measure it again, as a user would.
    apart = np.diff(shown, axis=0)
    return denoise(shown.astype(float), strength * float(np.sqrt(0.5 * np.mean(apart**2))))


def tuned(denoise: Denoiser, noisy: np.ndarray, clean: np.ndarray, sigma: float) -> tuple[float, bool]:
    """The strength and the domain (linear or not) with the least squared error on this clip."""
    choices = [(strength, linear) for strength in STRENGTHS for linear in (True, False)]
    errors = [np.mean((np.clip(denoised(denoise, noisy, sigma, *choice), 0, 1) - clean) ** 2) for choice in choices]
    return choices[int(np.argmin(errors))]
