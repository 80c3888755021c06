"""Figures of `benchmarks.networks`: scores against light and number of the frame, and one frame by all methods."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from benchmarks._network_scores import picture_name
from hsnoise.enhance.training.scenes import Scene
from hsnoise.enhance.training.tables import InWords, draw_frames, lights_in, of_clips, standard_error

PANELS = {"psnr_scaled_db": "PSNR scaled in brightness (dB)", "ssim_scaled": "SSIM scaled in brightness"}
MARKERS = "os^vDXP*<>hp"


def draw_scores(results: dict[str, dict[str, Any]], ours: str, in_words: InWords) -> Figure:
    """PSNR and SSIM of all methods, means over clips: above against light, below against the number of the frame.

    The bars of `ours` are standard errors over clips, which all methods share for the most part.
    """
    figure = Figure(figsize=(13, 9.5), layout="constrained")
    axes = figure.subplots(2, 2, sharey="col")
    for column, (what, label) in enumerate(PANELS.items()):
        for row, (by, name) in enumerate({"mean_e": "light of the scene", "frame": "number of the frame"}.items()):
            axis = axes[row, column]
            for (method, of), marker in zip(results.items(), MARKERS, strict=False):
                _draw_line(axis, method, of["frames"], what, by, marker, method == ours)
            axis.set_xlabel(name)
            axis.set_ylabel(label)
            axis.grid(alpha=0.3)
        lights = lights_in(next(iter(results.values()))["frames"])
        axes[0, column].set_xscale("log")
        axes[0, column].set_xticks(lights, [in_words(light) for light in lights])
        axes[0, column].minorticks_off()
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=10)
    return figure


def _draw_line(axis, method: str, records: Sequence[dict], what: str, by: str, marker: str, bold: bool) -> None:
    places = sorted({record[by] for record in records})
    of = [list(of_clips(records, what, **{by: place}).values()) for place in places]
    errors = [standard_error(values) for values in of] if bold else None
    x = [place + 1 for place in places] if by == "frame" else places
    style = {"label": method, "lw": 2.5 if bold else 1.2, "zorder": 3 if bold else 2, "alpha": 0.85}
    style |= {"ls": "--"} if "," in method else {}  # trained on other noise
    axis.errorbar(x, [np.mean(values) for values in of], errors, marker=marker, ms=5, capsize=3, **style)


def draw_scene(scene: Scene, pictures: dict[str, Path]) -> Figure:
    """The last frame of a scene by all methods, from folders of pictures that were kept, scaled in brightness."""

    def read(folder: Path) -> np.ndarray:
        frame = np.asarray(Image.open(folder / picture_name(scene)), np.float32) / 255
        return frame.reshape(1, *scene.clean.shape[1:])

    return draw_frames(scene, {name: read(folder) for name, folder in pictures.items()})
