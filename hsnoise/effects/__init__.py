"""Physical effects, one a file, and the one list of those built in."""

from __future__ import annotations

from hsnoise.effects._base import AbstractEffect, Capture, Parameter, ParameterSpec, Stage, param
from hsnoise.effects.adc import ADC
from hsnoise.effects.black_level import BlackLevel
from hsnoise.effects.dark_current import DarkCurrent
from hsnoise.effects.gain import Gain
from hsnoise.effects.read_noise import ReadNoise
from hsnoise.effects.row_gain import RowGain
from hsnoise.effects.shot_noise import ShotNoise

EFFECTS: tuple[type[AbstractEffect], ...] = (
    ShotNoise,
    DarkCurrent,
    ReadNoise,
    RowGain,
    Gain,
    BlackLevel,
    ADC,
)

__all__ = [
    "ADC",
    "EFFECTS",
    "AbstractEffect",
    "BlackLevel",
    "Capture",
    "DarkCurrent",
    "Gain",
    "Parameter",
    "ParameterSpec",
    "ReadNoise",
    "RowGain",
    "ShotNoise",
    "Stage",
    "param",
]
