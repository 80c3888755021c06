"""Options of the command line."""

from __future__ import annotations

import argparse
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hsnoise._core.output import FRAME_FORMATS
from hsnoise._core.parsing import Parser, cfa, count, hdu, list_of_seconds, minutes, numbers, overscan, positive, roi
from hsnoise._core.types import BAYER_CFAS, SHUTTERS
from hsnoise.enhance.training.options import shape_of, training_arguments
from hsnoise.simulation.cameras import canon_5d3, grasshopper3

CAMERAS = {"canon_5d3": canon_5d3, "grasshopper3": grasshopper3}


def parser() -> Parser:
    """The parser of all commands; its result's `command` names one, or is None."""
    top = Parser(
        prog="hsnoise",
        description="Measure the noise of a camera from dark frames (taken with the lens cap on), and draw frames with "
        "the same noise. New here? Run: hsnoise demo",
    )
    top.add_argument("--version", action="version", version=_versions())
    commands = top.add_subparsers(dest="command", metavar="COMMAND")
    _demo_arguments(commands)
    _inspect_arguments(commands)
    _fit_arguments(commands)
    _loop_arguments(commands)
    _sample_arguments(commands)
    _enhance_arguments(commands)
    training_arguments(commands)
    for name in ("demo", "inspect", "fit", "compare", "diagnose", "improve"):
        commands.choices[name].add_argument("--verbose", action="store_true", help="print all results")
    for name in ("inspect", "fit", "compare", "diagnose", "improve"):
        text = "print the result as one line of JSON, and what is for reading to standard error"
        commands.choices[name].add_argument("--json", action="store_true", help=text)
    for command in commands.choices.values():
        command.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return top


def _versions() -> str:
    """The versions that an error report should name."""
    libraries = {"jax": "JAX", "numpy": "NumPy", "equinox": "Equinox", "optimistix": "Optimistix"}
    found = [f"Python {platform.python_version()}", *(f"{name} {version(key)}" for key, name in libraries.items())]
    return f"hsnoise {version('hsnoise')} ({', '.join(found)})"


def _demo_arguments(commands: Any) -> None:
    text = (
        "Simulate a small dark capture of a Canon 5D Mark III at ISO 25600 with an effect hidden in it, fit it, find "
        "what is missing, add it, and show the fit beside the truth. Takes a few minutes."
    )
    demo = commands.add_parser("demo", help="see what hsnoise does, on simulated frames or your own", description=text)
    demo.add_argument(
        "--data", nargs="+", metavar="PATH", help="use these dark frames instead: a folder, files or a pattern"
    )
    demo.add_argument("--real", action="store_true", help="use the frames of a real CCD camera that come with hsnoise")
    demo.add_argument("--out", type=Path, default=Path("hsnoise-demo"), metavar="FOLDER", help="default: hsnoise-demo")
    _limit_arguments(demo)
    _capture_arguments(demo)


def _inspect_arguments(commands: Any) -> None:
    text = (
        "Check a capture before any fit, in seconds: what its frames are, which are odd, their noise budget, what "
        "can and cannot be determined from them, and the next capture worth taking. Exits with 1 if a fit makes no "
        "sense."
    )
    inspect = commands.add_parser("inspect", help="see what frames are and what they can show", description=text)
    inspect.add_argument("paths", nargs="+", metavar="PATH", help="a folder with bias, darks, flats; files; a pattern")
    _capture_arguments(inspect)


def _fit_arguments(commands: Any) -> None:
    text = (
        "Fit the noise model to dark frames. Reads raw, DNG, FITS, TIFF, PNG, NumPy and HDF5 files, all at one ISO, "
        "best at several exposures. Writes model.json, table.csv and figures to a folder. Exits with 1 if the numbers "
        "should not be used."
    )
    fit = commands.add_parser("fit", help="measure the noise of a camera from dark frames", description=text)
    fit.add_argument("paths", nargs="+", metavar="PATH", help="dark frames: a folder, files or a pattern in quotes")
    fit.add_argument("--out", type=Path, default=Path("hsnoise-fit"), metavar="FOLDER", help="default: hsnoise-fit")
    fit.add_argument(
        "--model",
        help="model.json whose effects are fitted, such as that of `improve` (default: the paper's, and what is found)",
    )
    _method_argument(fit)
    fit.add_argument(
        "--pixels",
        choices=("auto", "alike", "differ"),
        default="auto",
        help="whether to pool pixels as if alike, or to fit each by itself (default: a test on the frames decides)",
    )
    fit.add_argument(
        "--maps",
        type=Path,
        metavar="FILE",
        help="write offset, dark current, noise and flags of each pixel to a .fits or .npz file",
    )
    _capture_arguments(fit)


def _loop_arguments(commands: Any) -> None:
    compare = commands.add_parser(
        "compare",
        help="see where a model fails to describe dark frames",
        description="Compare a model with dark frames: statistics of the frames with those of the model's own samples. "
        "An error of 1 means that the frames are as close as those samples.",
    )
    diagnose = commands.add_parser(
        "diagnose",
        help="learn which physical effect a model lacks",
        description="Name the effect that a fitted model lacks, in one to five minutes. Without --model the frames are "
        "fitted first.",
    )
    improve = commands.add_parser(
        "improve",
        help="fit, find what is missing, add it, until nothing is left",
        description="The whole loop: fit the frames, find the effect that the model lacks, add it and fit again, until "
        "nothing significant is left: 2 to 15 minutes. Writes model.json, table.csv, story.txt, story.json (for "
        "--resume) and a figure. Exits with 1 if the model should not be used.",
    )
    for parser, name in ((compare, "compare"), (diagnose, "diagnose"), (improve, "improve")):
        if name == "diagnose":
            _method_argument(parser)
        start = "where to start (default: the paper's model): " if name == "improve" else ""
        parser.add_argument(
            "--model",
            required=name == "compare",
            help=f"{start}model.json of a fit, or a built-in camera: {', '.join(CAMERAS)}",
        )
        parser.add_argument(
            "paths", nargs="+", metavar="PATH", help="dark frames: a folder, files or a pattern in quotes"
        )
        folder = f"hsnoise-{name}"
        parser.add_argument("--out", type=Path, default=Path(folder), metavar="FOLDER", help=f"default: {folder}")
        parser.add_argument(
            "--report", type=Path, metavar="FILE", help="write one page of HTML, figures included: report.html"
        )
        parser.add_argument("--seed", type=count, default=0, help="seed of the model's samples (default 0)")
        if name == "improve":
            _limit_arguments(parser)
        _capture_arguments(parser)


def _limit_arguments(parser: argparse.ArgumentParser) -> None:
    """Limits of the loop."""
    text = "stop after this time and keep the result so far; the first fit and what it measures are always finished"
    parser.add_argument("--max-minutes", type=minutes, metavar="M", help=text)
    text = "add at most N effects, besides those that the first fit measures"
    parser.add_argument("--max-steps", type=count, metavar="N", help=text)
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on where an earlier run with this --out ended or was stopped, with the same frames, model and seed; "
        "start from the beginning if there is none",
    )
    parser.add_argument(
        "--close",
        action="store_true",
        help="end by measuring maps, spectra and distributions of this sensor; a minute or two more",
    )


def _method_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--method",
        choices=("auto", "ml", "line", "transfer"),
        default="auto",
        help="ml: maximum likelihood; line: the paper's line fit; transfer: each pixel over time; auto (default): ml, "
        "or transfer where pixels differ",
    )


def _capture_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("what the files do not state", "each option overrides the files")
    group.add_argument(
        "--exposure",
        type=list_of_seconds,
        metavar="S[,S...]",
        help="exposure in seconds, one or one per file: 0.5, 1/30, 20ms",
    )
    group.add_argument("--kind", choices=("dark", "flat"), help="what the frames are (default: dark)")
    group.add_argument("--cfa", type=cfa, metavar="CFA", help=f"mono or the Bayer order: {', '.join(BAYER_CFAS)}")
    group.add_argument("--black-level", type=numbers, metavar="DN[,DN,DN]", help="one, or one for each of R, G, B")
    group.add_argument("--white-level", type=float, metavar="DN", help="count at which the sensor saturates")
    group.add_argument(
        "--shutter",
        choices=SHUTTERS,
        help="how the sensor is read (default: rolling); row gains fluctuate as 1/f if rolling, else as white noise",
    )
    group.add_argument(
        "--row-axis",
        type=int,
        choices=(0, 1),
        default=0,
        help="axis of a stored frame that counts sensor rows; 1 if frames are stored in portrait (default: 0)",
    )
    group.add_argument("--roi", type=roi, metavar="R0:R1,C0:C1", help="use only these rows and columns")
    group.add_argument(
        "--overscan",
        type=overscan,
        metavar="auto|R0:R1,C0:C1",
        help="remove rows or columns that see no light: auto, or rows,columns with : for all (:,1024:1050)",
    )
    group.add_argument("--hdu", type=hdu, metavar="N|NAME", help="which image of FITS files that hold several")
    group.add_argument("--flats", nargs="+", metavar="PATH", help="evenly lit frames, several of each brightness")
    group.add_argument("--flats-exposure", type=list_of_seconds, metavar="S[,S...]", help="their exposure in seconds")


def _sample_arguments(commands: Any) -> None:
    text = "Draw raw frames from a noise model: dark frames, or noisy frames of a clean image."
    sample = commands.add_parser("sample", help="draw frames with the noise of a camera", description=text)
    sample.add_argument(
        "model", metavar="MODEL", help=f"model.json of a fit, or a built-in camera: {', '.join(CAMERAS)}"
    )
    sample.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help=f"file to write: {' '.join(FRAME_FORMATS)}"
    )
    sample.add_argument("--frames", type=positive, default=8, metavar="N", help="frames of each exposure (default 8)")
    sample.add_argument(
        "--exposure", type=list_of_seconds, metavar="S[,S...]", help="exposures in seconds (default: the model's)"
    )
    sample.add_argument("--shape", type=shape_of, metavar="ROWSxCOLUMNS", help="size of dark frames (default 480x640)")
    sample.add_argument(
        "--clean",
        metavar="IMAGE",
        help="clean image (.npy, .tif, .png) of expected photoelectrons per pixel; R, G, B or a mosaic",
    )
    sample.add_argument(
        "--mean-e", type=float, metavar="E", help="scale the clean image to this mean, in photoelectrons"
    )
    sample.add_argument("--seed", type=count, default=0, help="same seed, same frames (default 0)")


def _enhance_arguments(commands: Any) -> None:
    text = (
        "Enhance a noisy video with the network that comes with hsnoise, or with one from `hsnoise train`. The video "
        "holds display values (a video file or a folder of images) or, with --camera, raw frames. Its noise should be "
        "as strong as in training: an ordinary video has far less, and comes out worse. The first eight frames or so "
        "come out poorer than later ones."
    )
    enhance = commands.add_parser("enhance", help="remove the noise from a video", description=text)
    enhance.add_argument("video", metavar="IN", help="a video file, a folder of images, or raw frames with --camera")
    enhance.add_argument("out", type=Path, metavar="OUT", help="video file to write: .mp4, .mkv, ...")
    enhance.add_argument(
        "--weights",
        type=Path,
        metavar="FILE",
        help="weights.eqx of a training (default: shipped ones, of grasshopper3 for that --camera, else canon_5d3)",
    )
    enhance.add_argument("--camera", help=f"model.json of the camera of raw frames, or {', '.join(CAMERAS)}")
    enhance.add_argument(
        "--exposure",
        type=list_of_seconds,
        metavar="S",
        help="exposure of raw frames in seconds (default: as their files state)",
    )
    enhance.add_argument(
        "--cfa",
        type=cfa,
        metavar="CFA",
        help="Bayer order of raw frames (default: as their files state, or else the model's)",
    )
    enhance.add_argument(
        "--brighten",
        type=float,
        default=1.0,
        metavar="X",
        help="multiply the light before the network sees it (default 1); with --camera the mean of the first "
        "frame becomes X times 0.2 of white",
    )
    enhance.add_argument(
        "--tile",
        type=positive,
        metavar="PIXELS",
        help="work in tiles of this size (a multiple of the network's stride) to save memory: 256, say",
    )
    enhance.add_argument(
        "--look-ahead",
        type=count,
        default=0,
        metavar="N",
        help="see N following frames of each, too: less noise, in three times the time (default 0; 8 helps a lot)",
    )
    enhance.add_argument(
        "--mirrored", action="store_true", help="average with mirrored frames: a little better, in twice the time"
    )
    enhance.add_argument("--rate", type=float, default=25, help="frames per second if IN states none (default 25)")
