"""The quality of an enhancer during training: PSNR on held-out clips, and a picture of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import numpy as np
from matplotlib.figure import Figure

from hsnoise._core.output import write_figure
from hsnoise.chain.photometry import display_from_linear
from hsnoise.enhance.training.clips import Clip
from hsnoise.enhance.training.noisy import Camera
from hsnoise.enhance.training.protocol import middle_of
from hsnoise.enhance.training.scenes import scene_of
from hsnoise.stlstm import STLSTM

CROP = 96
MOST_CLIPS = 4


def psnr_db(found: np.ndarray, clean: np.ndarray) -> float:
    """Peak signal-to-noise ratio of display values, clipped to 0 to 1, over whole arrays."""
    return float(-10 * np.log10(max(np.mean((np.clip(found, 0, 1) - clean) ** 2), 1e-12)))


class Validation:
    """Central crops of held-out clips in the middle of the light range, always with the same noise."""

    def __init__(self, clips: Sequence[Clip], camera: Camera, frames: int, out: Path):
        self.out, self.last = out, float("nan")
        mean_e = middle_of(camera.mean_e)
        self.names = [clip.name for clip in clips[:MOST_CLIPS]]
        clean, noisy = [], []
        side = min(CROP, *(n // 2 * 2 for clip in clips for n in clip.frames.shape[1:3]))
        frames = min(frames, *(len(clip.frames) for clip in clips))
        for i, clip in enumerate(clips[:MOST_CLIPS]):
            scene = scene_of(clip, camera, mean_e, side, i, frames)
            clean.append(scene.clean)
            noisy.append(scene.noisy)
        self.clean, self.noisy = np.stack(clean, 1), np.stack(noisy, 1)
        self.refer = psnr_db(np.asarray(display_from_linear(self.noisy)), self.clean)
        self._video = eqx.filter_jit(lambda net, noisy: net.video(noisy))

    def measure(self, net: STLSTM, step: int) -> float:
        """Mean PSNR over clips, dB; writes a picture of the last frames: noisy, enhanced, clean."""
        enhanced = np.asarray(self._video(net, self.noisy))
        values = [psnr_db(enhanced[:, i], self.clean[:, i]) for i in range(enhanced.shape[1])]
        self.last = float(np.mean(values))
        write_figure(self.out / f"validation-{step:08d}.png", self._picture(enhanced[-1], step), dpi=100)
        return self.last

    def _picture(self, enhanced: np.ndarray, step: int) -> Figure:
        """The last frame of each clip: noisy, enhanced, clean."""
        columns = {"noisy": np.asarray(display_from_linear(self.noisy[-1])), "enhanced": enhanced}
        columns["clean"] = self.clean[-1]
        figure = Figure(figsize=(8.4, 2.9 * len(enhanced) + 0.3), layout="constrained")
        figure.suptitle(f"Step {step}: last frame of held-out clips", x=0.01, ha="left", fontsize=11)
        axes = figure.subplots(len(enhanced), 3, squeeze=False)
        for j, (name, frames) in enumerate(columns.items()):
            for i, (axis, frame) in enumerate(zip(axes[:, j], frames, strict=True)):
                value = self.names[i] if name == "clean" else f"{psnr_db(frame, self.clean[-1, i]):.1f} dB"
                axis.set_title(f"{name}, {value}", fontsize=10, loc="left")
                axis.imshow(np.clip(frame, 0, 1).squeeze(), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
                axis.axis("off")
        return figure
