"""What an effect is: physical parameters and one method that draws what happens in the sensor.

An effect of your own is a class of about 20 lines in your own file:

    class RowOffset(AbstractEffect):
        name = "row_offset"
        stage = Stage.READ
        sigma: Scalar = param("e-", low=0, amplitude=True, doc="standard deviation over rows and frames")

        def sample(self, signal, capture, *, key):
            frames, rows, _ = signal.shape
            return signal + self.sigma * jax.random.normal(key, (frames, rows, 1), signal.dtype)

    model = model.add(RowOffset(0.5))
"""
# No `from __future__ import annotations` here: Equinox must see AbstractClassVar itself, not its text.

import abc
import dataclasses
import enum
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise._core.keys import named_key
from hsnoise._core.poisson import pixel_words, poisson_of_bits
from hsnoise._core.types import (
    Counts,
    FrameRows,
    Frames,
    NotDeclared,
    PerChannel,
    PixelMap,
    RandomKey,
    Scalar,
    Window,
    cfa_tile,
    channel_index,
    channels_of,
    is_traced,
)
from hsnoise.effects._facts import CaptureFacts, Maker
from hsnoise.effects._parameters import ArraySpec, Parameter, ParameterSpec, shortest

PIXELS = "pixels"  # the random key of electrons and read noise, which share the words of a pixel


class Stage(enum.IntEnum):
    """Where in the sensor an effect acts: a model runs effects by stage, then in the order of insertion."""

    LIGHT = 0  # changes the expected photoelectrons, e-
    PHOTONS = 1  # draws the photoelectrons
    ELECTRONS = 2  # adds electrons, whole numbers
    COUPLING = 3  # mixes the electrons of neighbouring pixels or frames, e-
    MULTIPLICATION = 4  # multiplies electrons on their way to the output, before it adds read noise, e- at the input
    READ = 5  # adds to the signal while it is read, e-
    READOUT = 6  # changes the signal and its read noise in the readout chain, e-
    GAIN = 7  # multiplies; after this stage the signal is in DN
    BLACK = 8  # adds an offset, DN
    CONVERSION = 9  # shapes the steps of the converter, DN
    DIGITAL = 10  # turns DN into counts, or counts into counts


class Capture(eqx.Module):
    """How the frames were taken: what an effect can use besides the signal.

    Attributes:
        exposure_s: exposure in seconds, scalar.
        shape: rows and columns of the frames.
        cfa: "mono" or a 2x2 Bayer string.
        shutter: "rolling" or "global".
        sensor_key: random key of this sensor: its fixed patterns derive from it, the same in all captures.
        gain: system gain [channel], DN/e-; None if the model has none.
        read_noise: its sigma, rms over pixels, e-; None if the model has none.
        read_noise_scale: factor on the read noise of each pixel, [frame or 1, row, column]; None for 1. Only an effect
            that names it in `scaled_by` can use it.
        dark_current_scale: factor on the dark current of each pixel, as above.
        differentiable: whether counts are floats with a derivative, which ignores rounding.
        window: (first row, first column, rows, columns) of the sensor, if the frames are a part of it only.
        moved: rows and columns by which the frames lie below and to the right of `window`; None for 0.
    """

    exposure_s: Scalar
    shape: tuple[int, int] = eqx.field(static=True)
    cfa: str = eqx.field(static=True)
    shutter: str = eqx.field(static=True)
    sensor_key: RandomKey
    read_noise_scale: Frames | PixelMap | NotDeclared | None = None
    dark_current_scale: Frames | PixelMap | NotDeclared | None = None
    gain: PerChannel | None = None
    read_noise: Scalar | None = None
    differentiable: bool = eqx.field(static=True, default=False)
    window: Window | None = eqx.field(static=True, default=None)
    moved: tuple[jax.Array, jax.Array] | None = None

    @property
    def rows(self) -> np.ndarray | jax.Array:
        """Numbers of the frames' rows on the sensor."""
        return self._lines(0)

    @property
    def columns(self) -> np.ndarray | jax.Array:
        """Numbers of the frames' columns on the sensor."""
        return self._lines(1)

    def alternating(self, axis: int) -> np.ndarray | jax.Array:
        """-1/2 on even and 1/2 on odd rows (axis 0) or columns (1) of the sensor; in a Bayer sensor pairs of them."""
        return self._lines(axis) // (1 if self.cfa == "mono" else 2) % 2 - 0.5

    def _lines(self, axis: int) -> np.ndarray | jax.Array:
        lines = np.arange(self.shape[axis]) + (0 if self.window is None else self.window[axis])
        return lines if self.moved is None else lines + self.moved[axis]

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """Rows and columns of the sensor."""
        return self.shape if self.window is None else self.window[2:]

    def rounded(self, signal: Frames) -> Frames:
        """The nearest whole numbers, with the derivative of the signal if it is wanted."""
        whole = jnp.round(signal)
        return signal + jax.lax.stop_gradient(whole - signal) if self.differentiable else whole

    def offset(self, electrons: jax.Array, after_gain: bool) -> jax.Array:
        """An offset in the unit of the signal: e-, or after the gain DN, converted from electrons by the mean gain."""
        if not after_gain or self.gain is None:
            return electrons
        return electrons * jnp.mean(self.gain[cfa_tile(self.cfa).ravel()])

    def fixed_key(self, name: str) -> RandomKey:
        """The key from which the effect called `name` draws its fixed patterns on this sensor."""
        return named_key(self.sensor_key, name)

    def offset_variance(self, variance_e2: float, after_gain: bool = False) -> float:
        """Mean variance over all pixels, DN^2, that an offset of this variance, e-^2, adds to the counts."""
        if self.gain is None:
            return float(variance_e2)
        gain = np.asarray(self.gain, float)[cfa_tile(self.cfa)]
        return float(variance_e2 * (gain.mean() ** 2 if after_gain else (gain**2).mean()))

    def spread_of_lines(self, axis: int, power: np.ndarray | jax.Array) -> tuple[float, float]:
        """How the variance of a stationary series over rows (axis 0) or columns (1) divides between components.

        The shares of its variance in the lines and in the frame as a whole, as the three-dimensional decomposition of
        one colour estimates them: (1, 0) of white noise; the second is negative where the series has no mean.

        power: its spectrum, of mean 1, at 0 ... n - 1 cycles per frame.
        """
        lines = self.shape[axis] // len(cfa_tile(self.cfa))
        dc = float(np.mean(np.asarray(power)[::lines]))  # every line of one colour: frequencies fold
        return (lines - dc) / (lines - 1), (dc - 1) / (lines - 1)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels."""
        return channels_of(self.cfa)

    @property
    def channel_index(self) -> np.ndarray:
        """Channel of each pixel, [row, column]."""
        return channel_index(self.cfa, self.shape)

    def per_pixel(self, values: PerChannel) -> PixelMap:
        """Spread values [channel] over the pixels of their colour, [1, row, column]."""
        return self.per_row(jnp.broadcast_to(values, (1, self.shape[0], len(values))))

    def per_row(self, values: FrameRows) -> Frames:
        """Spread values [frame, row, channel] along the columns of their colour, [frame, row, column]."""
        tile, row = cfa_tile(self.cfa), np.arange(self.shape[0])
        shape = (len(values), *self.shape)
        # One number for the even and one for the odd columns of a row: loops over columns stay simple and fast.
        even, odd = (values[:, row, tile[row % len(tile), i % len(tile)], None] for i in range(2))
        return jnp.where(jax.lax.broadcasted_iota(jnp.int32, shape, 2) % 2 == 0, even, odd)


class AbstractEffect(eqx.Module):
    """One physical effect. Subclasses are final: give `name`, `stage`, parameters by `param`, and `sample`.

    Settings that are not physical parameters (a clipping level, a choice) are `eqx.field(static=True)` values that JSON
    can hold. Optionally an effect says how strong it may be (`propose`), what variance it adds (`components`), and in
    which numbers it shows (`statistics`).

    Attributes:
        name: name in tables and files, unique in a model; the effect's random key derives from it.
        stage: where in the sensor it acts.
        in_series: whether what happens in a frame depends on those before it, or on how many there were.
        adds: whether it adds electrons that do not depend on the signal.
        in_likelihood: whether the exact likelihood of row histograms knows it; else simulated statistics fit it.
        scaled_by: scales of the capture that its `sample` uses: "read_noise_scale", "dark_current_scale".
        stream: name of its random key; its own name if empty.
        least_frames: frames of one exposure that it takes to show it.
        selection_nats: penalty on its score, nats, for a detail measured on the capture and not drawn at random.
        confounded_with: the effect that looks the same in darks, so that only flats separate them; empty if none does.
        decided_by: the capture that separates them, as a sentence of advice.
        measurable: whether measured components of one sensor stand for it in a closed model: a map for the pattern that
            it draws for any sensor of the make, a distribution or hits for its noise of single pixels.
    """

    name: eqx.AbstractClassVar[str]
    stage: eqx.AbstractClassVar[Stage]
    in_series: ClassVar[bool] = False
    adds: ClassVar[bool] = False
    in_likelihood: ClassVar[bool] = False
    scaled_by: ClassVar[tuple[str, ...]] = ()
    stream: ClassVar[str] = ""
    least_frames: ClassVar[int] = 1
    selection_nats: ClassVar[float] = 0.0
    confounded_with: ClassVar[str] = ""
    decided_by: ClassVar[str] = ""
    measurable: ClassVar[bool] = False

    @property
    def acts_at(self) -> Stage:
        """Its stage, or the one after the gain if its setting `after_gain` is true."""
        return Stage.BLACK if getattr(self, "after_gain", False) else self.stage

    @abc.abstractmethod
    def sample(self, signal: Frames, capture: Capture, *, key: RandomKey) -> Frames | Counts:
        """The signal [frame, row, column] after the effect, given `signal` before it, in the unit of its stage."""

    def read_noise_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> Frames | PixelMap | None:
        """Factor on the read noise of each pixel, [frame or 1, row, column], for a signal of `shape`; None: 1.

        Its mean square must be 1, or less by what the effect's own `sample` adds, so that the sigma of the read noise
        remains its rms. The factors of all effects multiply. Thus an effect can modify the read noise without knowing
        the effect that draws it.
        """
        return None

    def dark_current_scale(
        self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey
    ) -> Frames | PixelMap | None:
        """Factor on the dark current of each pixel, like `read_noise_scale` but of mean 1: the rate stays the mean."""
        return None

    def light_scale(self, capture: Capture, shape: tuple[int, ...], *, key: RandomKey) -> Frames | PixelMap | None:
        """Factor of mean 1 on the light that falls on each pixel, for effects that act at a later stage; None: 1."""
        return None

    @classmethod
    def propose(cls, facts: CaptureFacts) -> Maker | None:
        """How strong it may be in a capture that may lack it, or None if this capture cannot show it.

        Returns:
            A function of an amplitude and a NumPy generator that makes the effect. At an amplitude of 1 it is modest:
            a few standard errors in the statistics that it moves. Unknown details (a period, a corner) are drawn from
            the generator, so that the effect is recognised for any details.

        By default None: `diagnose` tries the effect only if the user passes an instance.
        """
        return None

    def components(self, capture: Capture) -> dict[str, float]:
        """Variance that it adds to each component of the three-dimensional decomposition of dark frames, DN^2.

        Keys of `hsnoise.budget`: frame, row, column, row_x_frame, column_x_frame, pixel, temporal. Means over all
        pixels and all sensors of the make, without row gain, rounding and clipping. Empty, the default, if there is no
        simple formula: the variance then comes from draws.
        """
        return {}

    @classmethod
    def statistics(cls, frames: np.ndarray) -> dict[str, float]:
        """Extra statistics in which it shows, by name, of frames [frame, row, column] of one exposure.

        Counts are above black, DN. They are added to the statistics by which a measured capture and draws of a model
        are compared. None by default.
        """
        return {}

    def __check_init__(self):
        if not (isinstance(self.name, str) and self.name.isidentifier()):
            raise ValueError(f"name: expected that of an effect in lower case, such as row_noise, got {self.name!r}.")
        if not isinstance(self.stage, Stage):
            raise TypeError(f"{self.name}.stage: expected one of Stage, such as Stage.READ, got {self.stage!r}.")
        after_gain = getattr(self, "after_gain", False)
        if not isinstance(after_gain, bool):
            raise ValueError(f"{self.name}.after_gain: expected True or False, got {after_gain!r}.")
        for field, spec in self.specs().items():
            value = getattr(self, field)
            if is_traced(value):
                continue
            if not isinstance(value, jax.Array):
                expected = "a number or one for each channel" if spec.per_channel else "a number"
                raise TypeError(f"{self.name}.{field}: expected {expected}, got {value!r:.60}.")
            low = -np.inf if spec.low is None else spec.low
            high = np.inf if spec.high is None else spec.high
            value = np.asarray(value)
            if not np.all(np.isfinite(value) & (value >= low) & (value <= high)):
                expected = f"finite values in [{low}, {high}] {spec.unit}"
                raise ValueError(f"{self.name}.{field}: expected {expected}, got {value}.")
        arrays = self.arrays()
        if not any(is_traced(value) for value in arrays.values()):
            for field, value in arrays.items():
                self.array_specs()[field].check(f"{self.name}.{field}", value)
            self.check_arrays()

    def check_arrays(self) -> None:
        """Raise ValueError, naming the array, where measured arrays do not fit together; each has been checked."""

    @classmethod
    def specs(cls) -> dict[str, ParameterSpec]:
        """Declared parameters: field name to declaration, in order."""
        declared = {field.name: field.metadata.get("parameter") for field in dataclasses.fields(cls)}
        return {name: spec for name, spec in declared.items() if spec is not None}

    @classmethod
    def array_specs(cls) -> dict[str, ArraySpec]:
        """Declared measured arrays: field name to declaration, in order."""
        return {f.name: f.metadata["measured"] for f in dataclasses.fields(cls) if "measured" in f.metadata}

    def arrays(self) -> dict[str, jax.Array]:
        """The measured arrays that it has, by field name."""
        held = {name: getattr(self, name) for name in self.array_specs()}
        return {name: value for name, value in held.items() if value is not None}

    @classmethod
    def with_default(cls) -> set[str]:
        """Declared parameters that are optional."""
        without = dataclasses.MISSING
        return {f.name for f in dataclasses.fields(cls) if "parameter" in f.metadata and f.default is not without}

    @classmethod
    def about(cls) -> str:
        """What it is: the first line of its docstring."""
        return (cls.__doc__ or "").strip().partition("\n")[0]

    def __repr__(self) -> str:
        shown = ", ".join(f"{field.name}={_shown(getattr(self, field.name))}" for field in dataclasses.fields(self))
        return f"{type(self).__name__}({shown})"

    def settings(self) -> dict[str, Any]:
        """Static fields, which are not physical parameters: field name to value."""
        static = [field.name for field in dataclasses.fields(self) if field.metadata.get("static", False)]
        return {name: getattr(self, name) for name in static}

    def summaries(self) -> list[tuple[str, float, str]]:
        """Name in tables, number and unit that stand for each measured array."""
        specs = self.array_specs()
        return [
            (f"{self.name}.{field}", specs[field].summary(np.asarray(value, float)), specs[field].summary_unit)
            for field, value in self.arrays().items()
        ]

    def parameters(self, channels: tuple[str, ...]) -> list[Parameter]:
        """All numbers of the effect with their names in tables, one for each channel where channels differ.

        A parameter called `value` drops its name (`gain.R`); a mono sensor has no channel name (`gain`).
        """
        listed = []
        for field, spec in self.specs().items():
            name = self.name if field == "value" else f"{self.name}.{field}"
            value = np.asarray(getattr(self, field))
            if spec.per_channel and len(channels) > 1:
                values = zip(channels, np.broadcast_to(value, len(channels)), strict=True)
                listed += [Parameter(f"{name}.{channel}", shortest(v), spec) for channel, v in values]
            else:
                listed.append(Parameter(name, shortest(value.reshape(())), spec))
        return listed


def _shown(value: Any) -> str:
    """A field as Python would write it; numbers that are traced, or shapes alone, as Equinox does."""
    if not isinstance(value, jax.Array | np.ndarray) or is_traced(value):
        return eqx.tree_pformat(value)
    return np.array2string(np.asarray(value), separator=", ", precision=6)


def draw_poisson(key: RandomKey, mean: jax.Array, shape: tuple[int, ...]) -> Frames:
    """Poisson counts of `shape`, as floats, given a mean per pixel or one for all; from the first word of each pixel.

    Counts are whole numbers, so a draw has no derivative with respect to its mean.
    """
    first, _ = pixel_words(key, shape)
    return poisson_of_bits(first, jax.lax.stop_gradient(mean)).astype(mean.dtype)


def step_from_previous(signal: Frames) -> Frames:
    """Each pixel minus the one read before it in its row, of any colour; 0 for the first of a row."""
    return signal - jnp.concatenate([signal[:, :, :1], signal[:, :, :-1]], axis=2)
