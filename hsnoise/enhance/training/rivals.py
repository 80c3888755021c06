"""Methods that need no training: non-local means, total variation, BM3D, BM4D.

Each gets frames at the brightness of an automatic exposure, the true noise of the frames, and the strength and the
domain (linear light, display values, or the camera's variance stabilised) that do best on a clip that is not scored.

BM4D over the frames of each colour stands in for VBM4D, which the paper compares with and which has no package: it
groups cubes of pixels, where VBM4D follows motion first.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec

import numpy as np
from skimage.restoration import denoise_nl_means, denoise_tv_chambolle

from hsnoise.chain.photometry import display_from_linear
from hsnoise.enhance.training.anscombe import Anscombe
from hsnoise.enhance.training.protocol import scaled_to
from hsnoise.enhance.training.scenes import Scene

STRENGTHS = (0.5, 1.0, 1.5, 2.0, 4.0, 8.0, 16.0, 32.0)
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


def _of_light(denoise: Denoiser, scene: Scene, strength: float) -> np.ndarray:
    light = scene.noisy_e / scene.exposed_e
    return np.asarray(display_from_linear(denoise(light, strength * scene.sigma_e / scene.exposed_e)))


def _of_display(denoise: Denoiser, scene: Scene, strength: float) -> np.ndarray:
    shown = np.clip(np.asarray(display_from_linear(scene.noisy_e / scene.exposed_e), float), 0, 1)
    # The display curve and clipping change the noise: measure it again, as a user would.
    apart = np.diff(shown, axis=0)
    return denoise(shown, strength * float(np.sqrt(0.5 * np.mean(apart**2))))


def _of_stabilised(denoise: Denoiser, scene: Scene, strength: float) -> np.ndarray:
    transform = Anscombe.of(scene.camera.model)
    values = transform.forward(scene.noisy_e)
    top = values.max()  # BM3D and BM4D expect values up to about 1
    found_e = transform.inverse(top * denoise(values / top, strength / top))
    return np.asarray(display_from_linear(found_e / scene.exposed_e))


DOMAINS = {"linear light": _of_light, "display values": _of_display, "stabilised variance": _of_stabilised}


def denoised(denoise: Denoiser, scene: Scene, strength: float, domain: str) -> np.ndarray:
    """Display values of a scene, denoised in one of DOMAINS at `strength` times its noise."""
    return DOMAINS[domain](denoise, scene, strength)


def tuned(denoise: Denoiser, scene: Scene) -> tuple[float, str]:
    """The strength and the domain with the least squared error on this scene, each at its best brightness."""
    choices = [(strength, domain) for strength in STRENGTHS for domain in DOMAINS]
    outputs = (denoised(denoise, scene, *choice) for choice in choices)
    errors = [float(np.mean((scaled_to(found, scene.clean) - scene.clean) ** 2)) for found in outputs]
    return choices[int(np.argmin(errors))]
