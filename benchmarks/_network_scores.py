"""Scores of `benchmarks.networks`: of each frame, and tables of them.

A record is of one frame: `clip`, `mean_e` (light of the scene, e-), `frame` (from 0), and PSNR and SSIM, as the output
is and scaled in brightness to the truth. A result of a method has its records as `frames`, and of a trained one what
`benchmarks.networks` knows of the training.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from hsnoise._core.output import write_atomically
from hsnoise._core.sheet import Sheet
from hsnoise.enhance.training.evaluate import scores
from hsnoise.enhance.training.scenes import Scene
from hsnoise.enhance.training.tables import as_csv, of_clips, standard_error

DIGITS = {"psnr_db": 2, "ssim": 3, "psnr_scaled_db": 2, "ssim_scaled": 3}
HEADS = ("PSNR / dB", "SSIM", "PSNR scaled / dB", "SSIM scaled")


def scores_of(found: np.ndarray, scaled_to_truth: np.ndarray, scene: Scene) -> list[dict[str, Any]]:
    """PSNR and SSIM of each frame of display values, as it is and scaled in brightness to the truth."""
    as_is, scaled = scores("", scene, np.clip(found, 0, 1)), scores("", scene, scaled_to_truth)
    return [
        {name: one[name] for name in ("clip", "mean_e", "frame", "psnr_db", "ssim")}
        | {"psnr_scaled_db": other["psnr_db"], "ssim_scaled": other["ssim"]}
        for one, other in zip(as_is, scaled, strict=True)
    ]


def keep(path: Path, digest: str, measure: Callable[..., dict[str, Any]], *what: Any) -> None:
    """Measure and write a file, unless it is there with this digest."""
    if not (path.exists() and json.loads(path.read_text())["digest"] == digest):
        write_atomically(path, json.dumps({"digest": digest} | measure(*what), indent=1).encode())


def picture_name(scene: Scene) -> str:
    """The file name of a frame of a scene."""
    return f"{scene.clip}-{scene.mean_e:.3g}e.png"


def write_picture(path: Path, frame: np.ndarray) -> None:
    """Write display values [row, column, channel], 0 to 1, as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(np.rint(255 * frame).astype(np.uint8).squeeze()).save(buffer, "png")
    write_atomically(path, buffer.getvalue())


def with_error(values: Sequence[float], digits: int, sign: str = "") -> str:
    """The mean of videos, and its standard error."""
    return f"{np.mean(values):{sign}.{digits}f} +- {standard_error(values):.{digits}f}"


def tables(results: dict[str, dict[str, Any]], *ours: str) -> list[Sheet]:
    """Scores of each method, and those of `ours` less each other one's; standard errors over videos."""
    means = {name: {what: of_clips(of["frames"], what) for what in DIGITS} for name, of in results.items()}

    def row(name: str, less: str | None = None) -> tuple[str, ...]:
        sign, others = ("+", means[less]) if less else ("", {})
        return tuple(
            with_error([value - others.get(what, {}).get(clip, 0.0) for clip, value in of.items()], DIGITS[what], sign)
            for what, of in means[name].items()
        )

    def about(of: dict[str, Any]) -> tuple[str, ...]:
        if "parameters" not in of:  # of a method that is not trained
            return "", "", "", ""
        return f"{of['parameters']:,}", f"{of['steps']:,}", f"{of['minutes']:.1f}", f"{of['rate']:g}"

    own = [(name, *about(of), *row(name)) for name, of in results.items()]
    others = [name for name in results if name not in ours]
    less = [(f"{one} - {name}", *row(one, name)) for one in ours if one in results for name in others]
    first = ("network", "parameters", "steps", "minutes", "rate", *HEADS)
    sheets = Sheet("Held-out clips", first, own), Sheet("Differences, paired over clips", ("networks", *HEADS), less)
    return [sheet for sheet in sheets if sheet.rows]


def csv_of(results: dict[str, dict[str, Any]]) -> str:
    """All records, one row per frame."""
    return as_csv([{"method": name} | record for name, of in results.items() for record in of["frames"]])
