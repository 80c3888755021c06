"""The command `hsnoise sample`: draw frames with the noise of a camera."""

from __future__ import annotations

import argparse
import os
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import track

from hsnoise._core.folders import sweep
from hsnoise._core.output import FRAME_FORMATS, frames_file, is_one_file, read_image, write_atomically
from hsnoise._core.types import cfa_tile
from hsnoise.chain.model_file import read_model
from hsnoise.chain.photometry import scale_to_photoelectrons
from hsnoise.cli.loading import model_of
from hsnoise.likelihood.parameters import numbers_of
from hsnoise.model import NoiseModel, sample

SAMPLE_SHAPE = (480, 640)
BYTES_DRAWN, BYTES_KEPT = 40, 6  # a pixel: while a frame is drawn, and of each frame until the file is written
# Metadata that formats other than .npz hold, and the defaults of `hsnoise.load` for missing ones.
HELD = {".npy": (), ".tif": ("exposure_s",), ".tiff": ("exposure_s",), ".fits": ("exposure_s", "kind", "cfa")}
BARE = {  # Python that reads the counts alone
    ".npz": "import numpy as np; counts = np.load({})['counts']",
    ".npy": "import numpy as np; counts = np.load({})",
    ".tif": "import tifffile; counts = tifffile.imread({})",
    ".tiff": "import tifffile; counts = tifffile.imread({})",
    ".fits": "from astropy.io import fits; counts = fits.getdata({})",
}
DEFAULTS = {"kind": "dark", "cfa": "mono", "shutter": "rolling"}


def run(args: argparse.Namespace) -> None:
    suffix = args.out.suffix.lower()
    if suffix not in FRAME_FORMATS:
        raise ValueError(f"--out: expected a file ending in {', '.join(FRAME_FORMATS)}, got {args.out}")
    if not args.out.parent.is_dir():
        raise ValueError(f"--out: there is no folder {args.out.parent}")
    if args.mean_e is not None and args.clean is None:
        raise ValueError("--mean-e: goes with --clean, whose image it scales")
    if args.mean_e is not None and not args.mean_e > 0:
        raise ValueError(f"--mean-e: expected photoelectrons above 0, got {args.mean_e:g}")
    if args.shape is not None and args.clean is not None:
        raise ValueError("--shape: goes with dark frames; those of --clean have the shape of the image")
    if args.out.is_dir():
        raise ValueError(f"--out: expected a file, but {args.out} is a folder")
    if args.clean is not None and is_one_file(args.out, Path(args.clean)):
        raise ValueError(f"--out: {args.out} is the image of --clean, which would be lost")
    model = model_of(args.model, "MODEL")
    exposures_s = args.exposure or [model.exposure_s]
    shape = args.shape or SAMPLE_SHAPE
    _check_memory(len(exposures_s) * args.frames, shape)
    clean = np.zeros(shape, np.float32) if args.clean is None else _clean(args.clean, args.mean_e, model)
    if args.clean is not None and _gain_is_open(Path(args.model), model):
        warnings.warn(
            "the fit of this model did not determine the gain: its electrons are DN, and light is drawn as if each"
            " electron were one DN, too bright and with the wrong shot noise. Fit flats, too",
            stacklevel=2,
        )
    counts = draw(model, exposures_s, args.frames, clean, args.seed)
    metadata = metadata_of(model, exposures_s, "flat" if args.clean else "dark")
    sweep(args.out.parent)
    write_atomically(args.out, frames_file(suffix, counts, metadata))
    print("\n".join(_told(args.out, counts, metadata)))


def _gain_is_open(path: Path, model: NoiseModel) -> bool:
    """Whether a model's file says that the fit which wrote it did not determine the gain."""
    if not path.is_file() or "gain" not in model:
        return False
    provenance = read_model(path)[0].get("provenance")
    withheld = provenance.get("withheld") if isinstance(provenance, dict) else None
    return isinstance(withheld, list) and any(number.name in withheld for number in numbers_of(model, ["gain"]))


def _check_memory(frames: int, shape: tuple[int, int]) -> None:
    """Raise ValueError if so many frames do not fit into this machine's memory."""
    needed = BYTES_DRAWN * shape[0] * shape[1] + BYTES_KEPT * frames * shape[0] * shape[1]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else np.inf
    if needed > memory:
        raise ValueError(
            f"--shape: {frames} frames of {shape[0]} x {shape[1]} pixels take {needed / 2**30:.3g} GiB, and this"
            f" machine has {memory / 2**30:.3g}; draw fewer or smaller ones, several times with other seeds"
        )


def _told(path: Path, counts: np.ndarray, metadata: dict[str, Any]) -> list[str]:
    """Description of the written file in several lines; the last is Python that reads it."""
    n, frames, rows, columns = counts.shape
    what = f"{metadata['kind']} frame{'s' if n * frames > 1 else ''}"
    exposed = " and ".join(f"{t:g} s" for t in metadata["exposure_s"])
    lines = [
        f"{path}: {n * frames} {what} of {rows} x {columns} pixels, exposed {exposed}",
        f"counts in DN, {counts.min()} to {counts.max()}, {counts.dtype}; array [exposure, frame, row, column]:"
        f" {' x '.join(map(str, counts.shape))}",
    ]
    if metadata["kind"] == "flat":
        lines.append('kind "flat": a picture of light, with dark current added; not dark frames')
    if "white_level" not in metadata and counts.max() > np.iinfo(np.uint16).max:
        lines.append(
            "The model has no white level, so counts exceed 16 bits: fit with --white-level, as the camera has"
        )
    held = HELD.get(path.suffix.lower(), tuple(metadata))
    lines.append(f"Beside the counts the file holds {', '.join(held)}" if held else "The file holds counts only")
    return [*lines, f"In Python: {_reading(path, n * frames, metadata, held)}"]


def _reading(path: Path, n_frames: int, metadata: dict[str, Any], held: tuple[str, ...]) -> str:
    """Python that reads a file: counts alone if `hsnoise.load` would need more than the file holds."""
    suffix, name = path.suffix.lower(), repr(str(path))
    if n_frames == 1 or suffix == ".npy":
        return BARE[suffix].format(name)
    given = {key: value for key, value in metadata.items() if key not in held and np.any(value != DEFAULTS.get(key))}
    return f"import hsnoise; stack = hsnoise.load({', '.join([name, *(f'{k}={_value(v)}' for k, v in given.items())])})"


def _value(value: Any) -> str:
    return repr(value.tolist() if isinstance(value, np.ndarray) else value)


def draw(model: NoiseModel, exposures_s: Any, n_frames: int, clean: np.ndarray, seed: int) -> np.ndarray:
    """Counts `[exposure, frame, row, column]`, drawn frame by frame unless frames depend on earlier ones."""
    key = jax.random.key(seed)
    at_once = n_frames if any(effect.in_series for effect in model) else 1
    tasks = [(e, f) for e in range(len(exposures_s)) for f in range(0, n_frames, at_once)]
    clean = np.broadcast_to(clean, (at_once, *clean.shape))
    console = Console(stderr=True)
    frames = []
    for e, f in track(tasks, "Drawing frames", console=console, transient=True, disable=not console.is_terminal):
        own = jax.random.fold_in(jax.random.fold_in(key, e), f)
        frames.append(np.asarray(sample(own, clean, model, exposure_s=exposures_s[e], sensor_key=key)))
    counts = np.stack(frames).reshape(len(exposures_s), n_frames, *clean.shape[1:])
    return counts.astype(np.uint16) if counts.max() <= np.iinfo(np.uint16).max else counts


def metadata_of(model: NoiseModel, exposures_s: Any, kind: str) -> dict[str, Any]:
    metadata = {"exposure_s": np.asarray(exposures_s, float), "kind": kind, "cfa": model.cfa, "shutter": model.shutter}
    black_level = np.asarray(model["black_level"].value, float) if "black_level" in model else np.zeros(1)
    metadata["black_level"] = black_level if np.ptp(black_level) > 0 else float(black_level[0])
    if "adc" in model and model["adc"].white_level_dn is not None:
        metadata["white_level"] = float(model["adc"].white_level_dn)
    return metadata


def _clean(path: str, mean_e: float | None, model: NoiseModel) -> np.ndarray:
    """Expected photoelectrons `[row, column]`; each pixel keeps only its own colour of an R, G, B image."""
    image = read_image(path).astype(np.float32)
    if image.ndim == 3:
        if model.cfa == "mono":
            raise ValueError(f"{path}: a colour image, but the sensor is mono; give an image [row, column]")
        tile = cfa_tile(model.cfa)
        row, column = np.indices(image.shape[:2])
        image = image[row, column, tile[row % 2, column % 2]]
    return image if mean_e is None else np.asarray(scale_to_photoelectrons(image, mean_e))
