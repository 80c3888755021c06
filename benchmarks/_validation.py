"""How good an enhancer is while it is trained: PSNR on held-out clips, and a picture of them."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
from PIL import Image

from benchmarks._clips import Clip
from benchmarks._noisy import Camera, noisy_of
from hsnoise._output import write_atomically
from hsnoise.photometry import display_from_linear, frames_of_display, light_of_frames
from hsnoise.stlstm import STLSTM

CROP = 96
MOST_CLIPS = 4


def psnr_db(found: np.ndarray, clean: np.ndarray) -> float:
    """Peak signal to noise of display values, clipped to 0 to 1, over all that is given."""
    return float(-10 * np.log10(max(np.mean((np.clip(found, 0, 1) - clean) ** 2), 1e-12)))


class Validation:
    """Crops from the middle of held-out clips in the middle of the light range, always with the same noise."""

    def __init__(self, clips: Sequence[Clip], camera: Camera, frames: int, out: Path):
        self.out, self.last = out, float("nan")
        white_e = float(np.sqrt(np.prod(camera.white_e)))
        clean, noisy = [], []
        side = min(CROP, *(n // 2 * 2 for clip in clips for n in clip.frames.shape[1:3]))
        frames = min(frames, *(len(clip.frames) for clip in clips))
        for i, clip in enumerate(clips[:MOST_CLIPS]):
            row, column = ((n - side) // 2 for n in clip.frames.shape[1:3])
            light = light_of_frames(clip.frames[:frames, row : row + side, column : column + side], camera.channels)
            clean.append(np.asarray(display_from_linear(light)))
            noisy.append(np.asarray(noisy_of(jax.random.key(i), light, camera.model, camera.model, white_e)))
        self.clean, self.noisy = np.stack(clean, 1), np.stack(noisy, 1).astype(np.float32)
        self.refer = psnr_db(np.asarray(display_from_linear(self.noisy)), self.clean)
        self._video = eqx.filter_jit(lambda net, noisy: net.video(noisy))

    def measure(self, net: STLSTM, step: int) -> float:
        """Mean PSNR over clips, dB; writes a picture of the last frames: noisy, enhanced, clean."""
        enhanced = np.asarray(self._video(net, self.noisy))
        values = [psnr_db(enhanced[:, i], self.clean[:, i]) for i in range(enhanced.shape[1])]
        self.last = float(np.mean(values))
        rows = [np.asarray(display_from_linear(self.noisy[-1])), enhanced[-1], self.clean[-1]]
        picture = np.concatenate([np.concatenate(list(row), 1) for row in rows], 0)
        pixels = frames_of_display(picture)
        buffer = io.BytesIO()
        Image.fromarray(pixels.squeeze()).save(buffer, "PNG")
        write_atomically(self.out / f"validation-{step:08d}.png", buffer.getvalue())
        return self.last
