"""The noise of a camera: fit it to dark frames, sample from it. See README.md."""

from __future__ import annotations

import logging
from importlib import import_module
from typing import Any

from hsnoise._core import interrupting as _interrupting  # noqa: F401  the first is for Ctrl-C during the others
from hsnoise.chain.photometry import photoelectrons_from_illuminance
from hsnoise.criticism import compare, diagnose, improve
from hsnoise.criticism.budget import NoiseBudget, budget
from hsnoise.criticism.inspection.inspect import inspect
from hsnoise.effects import AbstractEffect, Stage, param
from hsnoise.fit import FitResult, fit
from hsnoise.frames import examples
from hsnoise.frames.io.load import load
from hsnoise.frames.stack import FrameStack
from hsnoise.likelihood.joint import log_likelihood
from hsnoise.likelihood.summary import summarise
from hsnoise.model import NoiseModel, sample, sample_dark
from hsnoise.simulation import cameras

from . import effects

__version__ = "0.1.0"

__all__ = [
    "AbstractEffect",
    "FitResult",
    "FrameStack",
    "NoiseBudget",
    "NoiseModel",
    "Stage",
    "budget",
    "cameras",
    "compare",
    "diagnose",
    "effects",
    "examples",
    "fit",
    "improve",
    "inspect",
    "load",
    "log_likelihood",
    "param",
    "photoelectrons_from_illuminance",
    "sample",
    "sample_dark",
    "summarise",
]

# What is going on goes to the loggers below "hsnoise": stages as INFO, details as DEBUG. It is silent unless asked for.
logging.getLogger("hsnoise").addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    if name == "plots":  # brings matplotlib, which is slow to import
        return import_module("hsnoise.plots")
    raise AttributeError(f"module 'hsnoise' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Public names alone, for completion."""
    return sorted([*__all__, "__version__", "plots"])
