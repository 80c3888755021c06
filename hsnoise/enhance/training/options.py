"""Options of `hsnoise train` and `hsnoise evaluate`; imports nothing slow."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from hsnoise._core.parsing import seconds
from hsnoise.enhance.training.noisy import NOISES
from hsnoise.enhance.training.presets import PRESETS
from hsnoise.enhance.training.protocol import OPTICS

TRAIN = """Train the video enhancer on clean clips and the noise of a camera.

    hsnoise train                                        (2 minutes, on scikit-image's pictures)
    hsnoise train --preset cpu --clips FOLDER            (half an hour on 2 cores)
    hsnoise train --preset gpu --clips FOLDER            (the same network, for longer, on a GPU)
    hsnoise train --preset paper --clips FOLDER          (a GPU)
    hsnoise train --camera hsnoise-fit/model.json --mean-e 2,10

All output goes to --out: checkpoints, validation pictures, log.csv, and weights.eqx at the end. The same command
resumes an interrupted run and ends with the same weights.
"""
EVALUATE = """Score a trained enhancer: PSNR and SSIM on held-out clips, compared with methods that need no training.

    hsnoise evaluate hsnoise-train/weights.eqx --clips FOLDER

Writes a table and figures to --out: PSNR against illuminance and number of frames seen, frames side by side. BM3D
and BM4D are included if the extra `peers` is installed; BM4D over frames stands in for VBM4D, which has no package.
"""
SENSOR = (
    "size of the camera's frames, for noise that depends on the place (glow, taps, shading): pieces"
    " lie anywhere in them (default: each piece is a whole frame)"
)


def training_arguments(commands: Any) -> None:
    """Add both commands to a parser's subparsers."""
    raw = argparse.RawDescriptionHelpFormatter
    train = commands.add_parser("train", help="train the video enhancer", description=TRAIN, formatter_class=raw)
    _train_arguments(train)
    text = "score a trained enhancer on held-out clips"
    _evaluate_arguments(commands.add_parser("evaluate", help=text, description=EVALUATE, formatter_class=raw))


def _train_arguments(train: argparse.ArgumentParser) -> None:
    add = train.add_argument
    add("--preset", choices=PRESETS, default="smoke", help="sizes of the run (default: smoke, a mere trial)")
    add("--camera", default="canon_5d3", help=f"model.json of a fit, or {', '.join(OPTICS)}")
    add("--noise", default="hsnoise", help=f"{', '.join(NOISES)} of the same strength, or a model.json")
    clips = "folder of videos, folders of images or .npz files (default: scikit-image's pictures)"
    add("--clips", type=Path, metavar="FOLDER", help=clips)
    _split_argument(train, "trained on, and which validate")
    _light_arguments(train, "the paper's for the camera")
    add("--sensor", type=shape_of, metavar="ROWSxCOLUMNS", help=SENSOR)
    vgg = "torchvision's VGG-16 weights (.safetensors or .pth) for the perceptual term"
    add("--vgg", type=Path, metavar="FILE", help=vgg)
    add("--steps", type=int, metavar="N", help="number of steps instead of the preset's")
    add("--seed", type=int, default=0, help="default: 0")
    add("--out", type=Path, default=Path("hsnoise-train"), metavar="FOLDER", help="default: hsnoise-train")


def _evaluate_arguments(evaluate: argparse.ArgumentParser) -> None:
    add = evaluate.add_argument
    add("weights", type=Path, metavar="WEIGHTS", help="weights.eqx of a training")
    clips = "the folder that it was trained with; the clips that were held out are scored"
    add("--clips", type=Path, metavar="FOLDER", help=clips)
    _split_argument(evaluate, "scored, and on which rivals are tuned")
    add(
        "--camera",
        help=f"model.json of a fit, or {', '.join(OPTICS)} (default: the built-in one that it was trained for)",
    )
    _light_arguments(evaluate, "that of the training")
    sensor = "size of the camera's frames (default: that of the training)"
    add("--sensor", type=shape_of, metavar="ROWSxCOLUMNS", help=sensor)
    crop = "side of the central square of each frame that is scored (default 160)"
    add("--crop", type=int, default=160, metavar="PIXELS", help=crop)
    add("--no-rivals", action="store_true", help="score the enhancer and the scaled input only")
    add("--out", type=Path, default=Path("hsnoise-evaluate"), metavar="FOLDER", help="default: hsnoise-evaluate")


def _split_argument(parser: argparse.ArgumentParser, use: str) -> None:
    text = f"TOML file that says which clips are {use} (default: every fourth video is held out)"
    parser.add_argument("--split", type=Path, metavar="FILE", help=text)


def _light_arguments(parser: argparse.ArgumentParser, default: str) -> None:
    add = parser.add_argument
    add("--lux", type=pair, metavar="LOW,HIGH", help=f"illuminance of the scene (default: {default})")
    add("--mean-e", type=pair, metavar="LOW,HIGH", help="instead of --lux: photoelectrons of the average pixel")
    exposure = "exposure of a video frame, s, with a model.json (default: the model's own)"
    add("--exposure", type=seconds, metavar="S", help=exposure)


def pair(text: str) -> tuple[float, float]:
    """Low and high from 2,10; a single number is both."""
    try:
        low, _, high = text.partition(",")
        return float(low), float(high or low)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a number or low,high, got {text!r}") from None


def shape_of(text: str) -> tuple[int, int]:
    """Rows and columns from 3000x4000."""
    rows, _, columns = text.lower().partition("x")
    if not (rows.isdecimal() and columns.isdecimal() and int(rows) and int(columns)):
        raise argparse.ArgumentTypeError(f"expected ROWSxCOLUMNS such as 480x640, got {text!r}")
    return int(rows), int(columns)
