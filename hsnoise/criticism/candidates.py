"""What may be missing: built-in effects at amplitudes that a capture may show, their details drawn at random.

An amplitude of 1 is a modest effect; details that a user cannot know (period, corner, number of taps) vary from draw
to draw, so that an effect is recognised whatever they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from hsnoise import effects as fx
from hsnoise.effects import AbstractEffect
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import black_level_of, draw_capture, light_of
from hsnoise.statistics.structure import Places, code_step, moving_line, places

LEAST_ELECTRONS = 0.2
LEVELS_OF_A_CURVE = 3  # a straight line goes through any two
FROM_FRAME_TO_FRAME = ("image_lag", "dark_current_drift", "frame_offset", "black_shading")  # not told by one frame
SHORT_SHARE = 0.02  # of the longest exposure: a bias frame, or nearly
LINE_SEEDS = range(7000, 7006)  # of draws without lines of their own

Maker = Callable[[float, np.random.Generator], AbstractEffect]


@dataclass(frozen=True)
class Scale:
    """What amplitudes are measured by: read noise e-, longest exposure s, dark current e-/s, gain DN/e-, frames.

    has_bias: whether an exposure is short enough to tell what happens while a frame waits to be read. line: axis and
    frequency of the strongest line in the capture. places: where its patterns lie. step: distance of its codes, None if
    all occur.
    """

    read_noise: float
    longest_s: float
    rate: float
    gain: np.ndarray
    frames: int
    has_exposure: bool
    has_bias: bool
    exposures_differ: bool  # of the darks
    levels: int  # of signal: exposures of the darks, and flats
    light: float  # most photoelectrons of a flat, e-
    line: tuple[str, float]
    places: Places
    step: float | None

    @staticmethod
    def of(model: NoiseModel, part: FrameStack) -> Scale:
        darks = [i for i, kind in enumerate(part.kind) if kind == "dark"]
        exposures_s = {float(part.exposure_s[i]) for i in darks}
        longest = max(exposures_s)
        return Scale(
            read_noise=float(model["read_noise"].sigma),
            longest_s=max(longest, 1e-9),
            rate=float(model["dark_current"].rate) if "dark_current" in model else 0.0,
            gain=np.asarray(model["gain"].value, float),
            frames=max(part.n_frames[i] for i in darks),
            has_exposure=longest > 0,
            has_bias=min(exposures_s) < SHORT_SHARE * longest,
            exposures_differ=len(exposures_s) > 1,
            levels=len(exposures_s) + part.n_exposures - len(darks),
            light=max(float(light_of(model, part, i).mean()) for i in range(part.n_exposures)),
            line=moving_line(part, [draw_capture(s, model, part) for s in LINE_SEEDS], black_level_of(model)),
            places=places(part),
            step=code_step(part),
        )


def built_in(model: NoiseModel, part: FrameStack) -> dict[str, Maker]:
    """Effects that a capture can show and that the model does not have: name to maker from amplitude and generator."""
    scale = Scale.of(model, part)
    makers: Mapping[str, Maker] = {**_read_out(scale), **_pixels(scale, part.shutter), **_of_signal(scale)}
    makers |= _dark_signal(scale) if scale.has_exposure else _bias_frames(scale)
    if model.cfa == "mono" and "row_gain" in model:  # of one colour, it is the same
        makers = {n: m for n, m in makers.items() if n != "shared_row_gain"}
    if scale.frames < 2:
        makers = {n: m for n, m in makers.items() if n not in FROM_FRAME_TO_FRAME}
    return {name: maker for name, maker in makers.items() if name not in model}


def given(effect: AbstractEffect) -> Maker:
    """An effect that is ready: amplitude scales the parameters that may be 0 and have no upper bound, or may be 0."""
    may_be_zero = {name: spec for name, spec in effect.specs().items() if spec.low == 0}
    scaled = {name for name, spec in may_be_zero.items() if spec.high is None} or set(may_be_zero)

    def make(amplitude: float, rng: np.random.Generator) -> AbstractEffect:
        values = {name: np.asarray(getattr(effect, name)) for name in effect.specs()}
        for name in scaled:
            high = may_be_zero[name].high
            values[name] = np.minimum(values[name] * amplitude, np.inf if high is None else high)
        return type(effect)(**values, **effect.settings())

    return make


def _behind(rng: np.random.Generator) -> bool:
    """Whether an offset arises behind the gain."""
    return bool(rng.integers(2))


def _read_out(s: Scale) -> dict[str, Maker]:
    read = s.read_noise

    def shade(f: float, rng: np.random.Generator) -> AbstractEffect:
        axis, start, above, length = s.places.shading
        size = 0.2 * f * read * float(s.gain.mean())
        return fx.BlackShading(size, length * np.exp(rng.uniform(-0.7, 0.7)), axis, start, above)

    return {
        "row_noise": lambda f, rng: fx.RowNoise(0.25 * f * read, rng.choice([0.0, 1.0]), _behind(rng)),
        "column_noise": lambda f, rng: fx.ColumnNoise(0.25 * f * read, rng.choice([0.0, 1.0]), _behind(rng)),
        "row_fixed_pattern": lambda f, rng: fx.RowFixedPattern(0.2 * f * read, _behind(rng)),
        "column_fixed_pattern": lambda f, rng: fx.ColumnFixedPattern(0.2 * f * read, _behind(rng)),
        "frame_offset": lambda f, rng: fx.FrameOffset(0.12 * f * read, _behind(rng)),
        "periodic_banding": lambda f, rng: fx.PeriodicBanding(0.3 * f * read, s.line[1], s.line[0], _behind(rng)),
        "readout_bandwidth": lambda f, rng: fx.ReadoutBandwidth(0.03 * f),
        "readout_overshoot": lambda f, rng: fx.ReadoutOvershoot(0.03 * f),
        "odd_even_pattern": lambda f, rng: fx.OddEvenPattern(0.2 * f * read * s.places.second_chain, 0.0),
        "tap_offsets": lambda f, rng: fx.TapOffsets(0.25 * f * read, int(rng.choice([2, 4, 8])), _behind(rng)),
        "black_shading": shade,
        "missing_codes": lambda f, rng: fx.MissingCodes(s.step or 1.0 + min(f, 1.0) * rng.uniform(0.1, 1.5)),
    }


def _pixels(s: Scale, shutter: str) -> dict[str, Maker]:
    read = s.read_noise
    exponents = [0.0] if shutter == "global" else [0.0, 1.0]
    return {
        "shared_row_gain": lambda f, rng: fx.SharedRowGain(0.1 * f, rng.choice(exponents)),
        "dark_signal_nonuniformity": lambda f, rng: fx.DarkSignalNonuniformity(0.35 * f * read, _behind(rng)),
        "random_telegraph_noise": lambda f, rng: fx.RandomTelegraphNoise(
            0.02 * f, rng.uniform(2.5, 6.0) * read, rng.uniform(0.15, 0.85)
        ),
        "heavy_tailed_read_noise": lambda f, rng: fx.HeavyTailedReadNoise(2.05 + 4.0 / f),
        "read_noise_nonuniformity": lambda f, rng: fx.ReadNoiseNonuniformity(0.3 * f),
        "crosstalk": lambda f, rng: fx.Crosstalk(min(0.015 * f, 0.2)),
    }


def _hot_electrons(s: Scale, rng: np.random.Generator) -> float:
    return np.exp(rng.uniform(np.log(4), np.log(120))) * s.read_noise


def _bias_frames(s: Scale) -> dict[str, Maker]:
    """What pixels collect while frames without exposure wait to be read."""
    return {
        "hot_pixels": lambda f, rng: fx.HotPixels(min(0.003 * f, 0.2), 0.0, _hot_electrons(s, rng)),
        "cosmic_rays": lambda f, rng: fx.CosmicRays(0.0, rng.uniform(15, 80) * s.read_noise, 40.0 * f),
    }


def _dark_signal(s: Scale) -> dict[str, Maker]:
    def spot(f: float, rng: np.random.Generator) -> AbstractEffect:
        row, column = s.places.glow
        peak = 0.8 * f * max(s.read_noise, np.sqrt(s.rate * s.longest_s))
        return fx.AmplifierGlow(peak / s.longest_s, rng.uniform(0.15, 0.5), row, column, rng.choice([0.7, 1.0, 1.5]))

    def hot(f: float, rng: np.random.Generator) -> AbstractEffect:
        rate = _hot_electrons(s, rng) / s.longest_s
        at_readout = rng.choice([0.0, 0.01]) * rate * s.longest_s if s.has_bias else 0.0
        return fx.HotPixels(min(0.003 * f, 0.2), rate, at_readout)

    def cosmic(f: float, rng: np.random.Generator) -> AbstractEffect:
        at_readout = rng.choice([0.05, 0.5, 0.95])  # of the hits in the longest exposure
        hits, charge = 40.0 * f, rng.uniform(15, 80) * s.read_noise
        return fx.CosmicRays(hits * (1 - at_readout) / s.longest_s, charge, hits * at_readout)

    makers: dict[str, Maker] = {
        "amplifier_glow": spot,
        "hot_pixels": hot,
        "cosmic_rays": cosmic,
        "dark_current_drift": lambda f, rng: fx.DarkCurrentDrift(0.5 * f * s.read_noise / (s.longest_s * s.frames)),
    }
    if s.exposures_differ and s.rate * s.longest_s > LEAST_ELECTRONS:
        level = s.gain * s.rate
        grain = 0.35 * s.read_noise / (s.rate * s.longest_s)
        makers["dark_current_nonuniformity"] = lambda f, rng: fx.DarkCurrentNonuniformity(min(grain * f, 1.5))
        makers["black_clamp"] = lambda f, rng: fx.BlackClamp(level * min(0.7 * f, 1.0))
    return makers


def _of_signal(s: Scale) -> dict[str, Maker]:
    """What needs electrons, of light or of long darks."""
    electrons = max(s.rate * s.longest_s, s.light)
    if electrons <= LEAST_ELECTRONS:
        return {}
    makers: dict[str, Maker] = {"image_lag": lambda f, rng: fx.ImageLag(min(0.03 * f, 0.5))}
    if s.levels >= LEVELS_OF_A_CURVE:
        makers["nonlinearity"] = lambda f, rng: fx.Nonlinearity(0.08 * f / (electrons + 2 * s.read_noise))
    if s.light > 0:
        noise = np.sqrt(s.light + s.read_noise**2) / s.light
        makers["photo_response_nonuniformity"] = lambda f, rng: fx.PhotoResponseNonuniformity(0.3 * f * noise)
    return makers


def made(maker: Maker, amplitude: float, detail: int) -> AbstractEffect:
    """The effect at an amplitude, with details number `detail`."""
    return maker(amplitude, np.random.default_rng(detail))
