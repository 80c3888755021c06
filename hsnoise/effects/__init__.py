"""Physical effects, one per file, and the list of the built-in ones.

May import only `_core`; effects never import each other.
"""

from __future__ import annotations

from hsnoise.effects._base import AbstractEffect, Capture, Stage
from hsnoise.effects._facts import CaptureFacts, Maker, Places, either_side
from hsnoise.effects._parameters import Parameter, ParameterSpec, param
from hsnoise.effects.adc import ADC
from hsnoise.effects.adc_nonuniformity import AdcNonuniformity
from hsnoise.effects.amplifier_glow import AmplifierGlow
from hsnoise.effects.black_clamp import BlackClamp
from hsnoise.effects.black_level import BlackLevel
from hsnoise.effects.black_shading import BlackShading
from hsnoise.effects.brighter_fatter import BrighterFatter
from hsnoise.effects.column_fixed_pattern import ColumnFixedPattern
from hsnoise.effects.column_noise import ColumnNoise
from hsnoise.effects.correlated_read_noise import CorrelatedReadNoise
from hsnoise.effects.cosmic_rays import CosmicRays
from hsnoise.effects.crosstalk import Crosstalk
from hsnoise.effects.dark_current import DarkCurrent
from hsnoise.effects.dark_current_drift import DarkCurrentDrift
from hsnoise.effects.dark_current_instability import DarkCurrentInstability
from hsnoise.effects.dark_current_nonuniformity import DarkCurrentNonuniformity
from hsnoise.effects.dark_signal_nonuniformity import DarkSignalNonuniformity
from hsnoise.effects.electron_multiplication import ElectronMultiplication
from hsnoise.effects.frame_offset import FrameOffset
from hsnoise.effects.frame_settling import FrameSettling
from hsnoise.effects.frame_tilt import FrameTilt
from hsnoise.effects.gain import Gain
from hsnoise.effects.heavy_tailed_read_noise import HeavyTailedReadNoise
from hsnoise.effects.hot_pixels import HotPixels
from hsnoise.effects.image_lag import ImageLag
from hsnoise.effects.interference import Interference
from hsnoise.effects.measured_distribution import MeasuredDistribution
from hsnoise.effects.measured_hits import MeasuredHits
from hsnoise.effects.measured_map import MeasuredMap
from hsnoise.effects.measured_response import MeasuredResponse
from hsnoise.effects.measured_spectrum import MeasuredSpectrum
from hsnoise.effects.missing_codes import MissingCodes
from hsnoise.effects.nonlinearity import Nonlinearity
from hsnoise.effects.odd_even_pattern import OddEvenPattern
from hsnoise.effects.periodic_banding import PeriodicBanding
from hsnoise.effects.photo_response_nonuniformity import PhotoResponseNonuniformity
from hsnoise.effects.random_telegraph_noise import RandomTelegraphNoise
from hsnoise.effects.read_noise import ReadNoise
from hsnoise.effects.read_noise_nonuniformity import ReadNoiseNonuniformity
from hsnoise.effects.readout_bandwidth import ReadoutBandwidth
from hsnoise.effects.readout_overshoot import ReadoutOvershoot
from hsnoise.effects.row_bank_noise import RowBankNoise
from hsnoise.effects.row_fixed_pattern import RowFixedPattern
from hsnoise.effects.row_gain import RowGain
from hsnoise.effects.row_group_noise import RowGroupNoise
from hsnoise.effects.row_noise import RowNoise
from hsnoise.effects.shared_row_gain import SharedRowGain
from hsnoise.effects.shot_noise import ShotNoise
from hsnoise.effects.tap_gains import TapGains
from hsnoise.effects.tap_offsets import TapOffsets

EFFECTS: tuple[type[AbstractEffect], ...] = (
    ShotNoise,
    DarkCurrent,
    ReadNoise,
    RowGain,
    Gain,
    BlackLevel,
    ADC,
    SharedRowGain,
    RowNoise,
    RowBankNoise,
    RowGroupNoise,
    ColumnNoise,
    RowFixedPattern,
    ColumnFixedPattern,
    FrameOffset,
    FrameTilt,
    FrameSettling,
    DarkSignalNonuniformity,
    PhotoResponseNonuniformity,
    HotPixels,
    AmplifierGlow,
    DarkCurrentDrift,
    DarkCurrentInstability,
    DarkCurrentNonuniformity,
    RandomTelegraphNoise,
    HeavyTailedReadNoise,
    ReadNoiseNonuniformity,
    CorrelatedReadNoise,
    PeriodicBanding,
    Interference,
    Crosstalk,
    BrighterFatter,
    ReadoutBandwidth,
    ReadoutOvershoot,
    ImageLag,
    OddEvenPattern,
    TapOffsets,
    TapGains,
    BlackShading,
    AdcNonuniformity,
    MissingCodes,
    CosmicRays,
    ElectronMultiplication,
    BlackClamp,
    Nonlinearity,
    MeasuredMap,
    MeasuredSpectrum,
    MeasuredDistribution,
    MeasuredHits,
    MeasuredResponse,
)

__all__ = [
    "ADC",
    "AbstractEffect",
    "AdcNonuniformity",
    "AmplifierGlow",
    "BlackClamp",
    "BlackLevel",
    "BlackShading",
    "BrighterFatter",
    "Capture",
    "CaptureFacts",
    "ColumnFixedPattern",
    "ColumnNoise",
    "CorrelatedReadNoise",
    "CosmicRays",
    "Crosstalk",
    "DarkCurrent",
    "DarkCurrentDrift",
    "DarkCurrentInstability",
    "DarkCurrentNonuniformity",
    "DarkSignalNonuniformity",
    "EFFECTS",
    "ElectronMultiplication",
    "FrameOffset",
    "FrameSettling",
    "FrameTilt",
    "Gain",
    "HeavyTailedReadNoise",
    "HotPixels",
    "ImageLag",
    "Maker",
    "MeasuredDistribution",
    "MeasuredHits",
    "MeasuredMap",
    "MeasuredResponse",
    "MeasuredSpectrum",
    "MissingCodes",
    "Nonlinearity",
    "OddEvenPattern",
    "Parameter",
    "ParameterSpec",
    "PeriodicBanding",
    "Interference",
    "PhotoResponseNonuniformity",
    "Places",
    "RandomTelegraphNoise",
    "ReadNoise",
    "ReadNoiseNonuniformity",
    "ReadoutBandwidth",
    "ReadoutOvershoot",
    "RowBankNoise",
    "RowFixedPattern",
    "RowGain",
    "RowGroupNoise",
    "RowNoise",
    "SharedRowGain",
    "ShotNoise",
    "Stage",
    "TapGains",
    "TapOffsets",
    "either_side",
    "param",
]
