"""The noise model, an ordered set of effects: sampling frames from it, saving and loading it."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from hsnoise._core import html as _html
from hsnoise._core.arguments import listed, whole_number
from hsnoise._core.data_frames import table_to_pandas
from hsnoise._core.forking import check_not_forked
from hsnoise._core.keys import key_of, named_key
from hsnoise._core.poisson import Regime, regime_of
from hsnoise._core.types import RandomKey, Scalar, Window, channels_of, check_shutter, is_traced, unit_in_words
from hsnoise.chain.arguments import checked_exposure, checked_light, piece_of
from hsnoise.chain.arrivals import merged
from hsnoise.chain.effect_json import arrays_of, check_all_taken, effect_from_json, effect_to_json
from hsnoise.chain.model_file import read_model, write_model
from hsnoise.chain.shared import Shared
from hsnoise.chain.signals import apply_by_effect, apply_fenced, apply_in_one, may_scale, signals
from hsnoise.effects import EFFECTS, AbstractEffect, Capture, Parameter, Stage


class NoiseModel(eqx.Module):
    """The effects of a sensor on light, in the order of their stages, then of insertion.

    A PyTree whose leaves are the physical parameters. `model["gain"].value` is the gain, `model.add(effect)`
    a larger model, `model.table` holds all numbers with their units.

    Attributes:
        effects: the effects, in the order in which they act.
        cfa: "mono" or a 2x2 Bayer string.
        shutter: "rolling" or "global".
        exposure_s: default exposure of `sample`, in seconds.
    """

    effects: tuple[AbstractEffect, ...]
    cfa: str = eqx.field(static=True)
    shutter: str = eqx.field(static=True)
    exposure_s: float = eqx.field(static=True)

    def __init__(self, effects: Iterable[AbstractEffect], *, cfa: str, shutter: str, exposure_s: float):
        """Make a model of `effects`, in any order.

        Raises:
            TypeError: if `effects` contains anything but effects.
            ValueError: for two effects of one name, a parameter that does not fit the channels of `cfa`, an
                unknown `cfa` or `shutter`, or a negative `exposure_s`.
        """
        effects = tuple(effects)
        for effect in effects:
            if not isinstance(effect, AbstractEffect):
                raise TypeError(f"effects: expected instances of AbstractEffect, got {effect!r}.")
        twice = sorted(name for name, times in Counter(effect.name for effect in effects).items() if times > 1)
        if twice:
            raise ValueError(f"effects: {', '.join(twice)} given twice; a model holds one effect per name.")
        check_shutter(shutter)
        channels = channels_of(cfa)
        ordered = sorted(effects, key=lambda effect: effect.acts_at)
        self.effects = tuple(_fit_to_channels(effect, channels) for effect in ordered)
        self.cfa = cfa
        self.shutter = shutter
        self.exposure_s = float(checked_exposure(exposure_s))

    @property
    def channels(self) -> tuple[str, ...]:
        """("mono",) or ("R", "G", "B")."""
        return channels_of(self.cfa)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects, in the order in which they act."""
        return tuple(effect.name for effect in self.effects)

    def __getitem__(self, name: str) -> AbstractEffect:
        for effect in self.effects:
            if effect.name == name:
                return effect
        raise KeyError(f"no effect {name!r} in this model, which has {', '.join(self.names) or 'none'}.")

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __iter__(self) -> Iterator[AbstractEffect]:
        return iter(self.effects)

    def add(self, effect: AbstractEffect) -> NoiseModel:
        """The model with `effect` added, or in place of the model's effect of that class.

        Raises ValueError if the model has an effect of that name but of another class.
        """
        return self._with((*(own for own in self.effects if type(own) is not type(effect)), effect))

    def remove(self, name: str) -> NoiseModel:
        """The model without the effect called `name`. Raises KeyError if it has none."""
        gone = self[name]
        return self._with(effect for effect in self.effects if effect is not gone)

    def with_value(self, name: str, field: str, value: ArrayLike) -> NoiseModel:
        """The model with another value of one parameter, such as `model.with_value("gain", "value", 2.0)`.

        Raises KeyError for an unknown effect, ValueError for an unknown parameter and for a value outside its bounds or
        that does not fit the channels, TypeError for anything but numbers.
        """
        old = self[name]
        if field not in old.specs():
            raise ValueError(f"field: expected a parameter of {name} ({', '.join(old.specs())}), got {field!r}")
        new = dataclasses.replace(old, **{field: value})
        return self._with(new if effect is old else effect for effect in self.effects)

    def _with(self, effects: Iterable[AbstractEffect]) -> NoiseModel:
        return NoiseModel(effects, cfa=self.cfa, shutter=self.shutter, exposure_s=self.exposure_s)

    def __repr__(self) -> str:
        rows = (f"  {name} = {value} {unit}".rstrip() for name, value, unit in self._shown())
        return "\n".join([self._title, *rows])

    def _repr_html_(self) -> str:
        rows = self._shown()
        table = _html.table(("parameter", "value", "unit"), rows, words=("parameter", "unit")) if rows else ""
        return _html.fragment(_html.paragraph(self._title), table)

    @property
    def _title(self) -> str:
        return f"NoiseModel of {', '.join(self.names)}; {self.cfa}, {self.shutter} shutter, {self.exposure_s:g} s"

    def _shown(self) -> list[tuple[str, str, str]]:
        """Names, values and units of parameters and settings; empty for a model without numbers."""
        rows = []
        for effect in self.effects:
            try:
                parameters, arrays = effect.parameters(self.channels), effect.summaries()
            except (TypeError, ValueError):  # no numbers: traced, batched by vmap, or shapes alone
                return []
            rows += [(p.name, f"{p.value:.6g}", unit_in_words(p.spec.unit)) for p in parameters]
            rows += [(name, f"{value:.6g}", unit_in_words(unit)) for name, value, unit in arrays]
            chosen = effect.settings().items()
            rows += [(f"{effect.name}.{field}", f"{value}", "") for field, value in chosen if value is not None]
        return rows

    def parameters(self) -> list[Parameter]:
        """All numbers of the model with name, value, unit, bounds and meaning."""
        return [parameter for effect in self.effects for parameter in effect.parameters(self.channels)]

    @property
    def table(self) -> dict[str, tuple[float, float, str]]:
        """Parameter name to (value, standard error, unit), as in the table of a fit, such as {"gain.R": (1.53, nan,
        "DN/e-"), ...}; all errors are NaN, because a model states none. One number stands for each measured array."""
        numbers = [(p.name, p.value, p.spec.unit) for p in self.parameters()]
        arrays = [one for effect in self.effects for one in effect.summaries()]
        return {name: (value, math.nan, unit) for name, value, unit in (*numbers, *arrays)}

    def to_pandas(self) -> Any:
        """`table` as a pandas DataFrame: parameter, value, standard_error, unit (needs `hsnoise[pandas]`).

        Raises ImportError without pandas.
        """
        return table_to_pandas(self)

    def save(self, path: str | os.PathLike, *, provenance: Mapping[str, Any] | None = None) -> None:
        """Write the model as human-readable JSON, all or nothing; measured arrays go to an .npz file beside it.

        Args:
            path: file to write; an existing one is replaced. Arrays of model.json are in model.npz.
            provenance: where the numbers come from (camera, data, method); anything that JSON can hold.
        """
        numbers = [getattr(effect, field) for effect in self.effects for field in effect.specs()]
        content = {
            "hsnoise_version": _version(),
            "provenance": dict(provenance or {}),
            "cfa": self.cfa,
            "shutter": self.shutter,
            "exposure_s": self.exposure_s,
            "precision": str(np.result_type(*(number.dtype for number in numbers))) if numbers else "float32",
            "effects": [effect_to_json(effect, self.channels) for effect in self.effects],
        }
        write_model(path, content, arrays_of(self.effects))

    @staticmethod
    def load(path: str | os.PathLike, effects: Iterable[type[AbstractEffect]] = ()) -> NoiseModel:
        """Read a model that `save` wrote; every number and its precision come back exactly.

        Args:
            path: the file.
            effects: classes of its effects that are not built into hsnoise.

        Raises:
            ValueError: if the file is not a noise model or holds an unknown effect, parameter or unit, or if its
                measured arrays are missing, damaged or of another model.
        """
        content, arrays = read_model(path)
        own = listed("effects", effects, "a list of classes of effects")
        classes = {cls.name: cls for cls in (*EFFECTS, *own)}
        try:
            with jax.enable_x64(content["precision"] == "float64"):
                channels = channels_of(content["cfa"])
                found = [effect_from_json(item, classes, channels, arrays) for item in content["effects"]]
                check_all_taken(found, arrays)
                return NoiseModel(found, **{field: content[field] for field in ("cfa", "shutter", "exposure_s")})
        except KeyError as error:
            raise ValueError(f"{path}: {error} is missing.") from error
        except (AttributeError, TypeError, ValueError) as error:
            raise ValueError(f"{path}: {error}") from error


def sample(
    key: RandomKey | int,
    clean: ArrayLike,
    params: NoiseModel,
    *,
    exposure_s: float | Scalar | None = None,
    sensor_key: RandomKey | int | None = None,
    window: tuple[Any, Any, int, int] | None = None,
    differentiable: bool = False,
) -> Array:
    """Draw noisy frames of a clean image: counts in DN.

    Every leading index of `clean` is a separate frame with its own row gains. Each effect draws from a key named
    after it, so adding an effect does not change the draws of the others. Works under jit and vmap.

    Args:
        key: a random key, or its seed, a whole number from 0 to 2^32 - 1: 7 means `jax.random.key(7)`.
        clean: expected photoelectrons of each pixel, e-, [..., row, column]; zeros give dark frames.
        params: the noise model.
        exposure_s: exposure in seconds; default: that of the model.
        sensor_key: key or seed of the fixed patterns; the same key is the same sensor. By default derived from `key`,
            so that each call is another sensor of the same make.
        window: (first row, first column, rows, columns) if the frames are a piece of a larger sensor, for effects
            that depend on the place (glow, taps, shading); under jit the first two may be traced. Row gains and row
            noise run over the rows of the piece.
        differentiable: return the same counts as floats, with derivatives with respect to `clean` and the parameters.
            Clipping stops gradients, rounding does not. Derivatives with respect to light and dark current need read
            noise, preceded only by effects that add electrons.

    Returns:
        Counts of the shape of `clean`: uint16 if the model's white level is at most 65535 DN, else uint32.
        Without the `adc` effect (`params.remove("adc")`), DN as floats, neither rounded nor clipped.

    Raises:
        TypeError: if `params` is not a NoiseModel, a key is neither a random key nor a whole number, or `clean` does
            not hold real numbers.
        ValueError: if `clean` has fewer than two dimensions, no pixels, odd sizes with a Bayer array, or
            negative or non-finite values; if the exposure is negative or not one number; if a seed is out of range;
            if the window does not hold the frames. (Under jit, values cannot be checked.)

    Reference: Wang et al., "Enhancing Low Light Videos by Exploring High Sensitivity Camera Noise",
    ICCV 2019.
    """
    key, light, shape, effects, capture = _prepared(key, clean, params, exposure_s, sensor_key)
    capture = dataclasses.replace(capture, differentiable=differentiable)
    if window is not None:
        first, sensor = piece_of(window, capture.shape, params.cfa)
        moved = jnp.asarray(first[0], jnp.int32), jnp.asarray(first[1], jnp.int32)
        capture = dataclasses.replace(capture, window=(0, 0, *sensor), moved=moved)
    inside_another = any(is_traced(leaf) for leaf in jax.tree.leaves((key, light, effects, capture)))
    apply = apply_fenced if inside_another and not differentiable else apply_in_one
    return apply(key, light, shape, effects, capture).reshape(np.shape(clean))


def sample_dark(
    key: RandomKey | int,
    n_frames: int,
    shape: tuple[int, int],
    params: NoiseModel,
    *,
    exposure_s: float | Scalar | None = None,
    sensor_key: RandomKey | int | None = None,
) -> Array:
    """Draw `n_frames` dark frames of `shape` (rows, columns): counts in DN, [frame, row, column]. See `sample`.

    Raises TypeError, ValueError as `sample`, and for an invalid number of frames or shape.
    """
    n_frames = whole_number("n_frames", n_frames, 1)
    if not isinstance(shape, tuple | list) or len(shape) != 2:
        raise ValueError(f"shape: expected (rows, columns), got {shape!r}")
    rows, columns = (whole_number("shape", size, 1) for size in shape)
    clean = np.broadcast_to(np.float32(0), (n_frames, rows, columns))
    return sample(key, clean, params, exposure_s=exposure_s, sensor_key=sensor_key)


def sample_by_effect(
    keys: RandomKey,
    light: np.ndarray,
    n_frames: int,
    params: NoiseModel,
    *,
    exposures_s: Sequence[float],
    sensor_key: RandomKey,
    window: Window | None = None,
    shared: Shared | None = None,
) -> Array:
    """Exposures of one sensor, each as `sample` draws it, up to rounding, but with each effect compiled separately.

    After adding an effect to a model, only that effect is compiled. What exposures have in common is drawn once.
    keys: one for each exposure; light: expected photoelectrons of all its frames [exposure, row, column]; window: as in
    FrameStack, where the frames lie on a larger sensor; shared: what draws of other models may have in common with
    these. Returns counts [exposure, frame, row, column].
    """
    check_not_forked()
    exposures = np.array([checked_exposure(exposure_s) for exposure_s in exposures_s], float)
    checked, shape = checked_light(light, params.cfa), (n_frames, *light.shape[1:])
    return apply_by_effect(keys, *_on_sensor(checked, shape, params, exposures, sensor_key, window), shared, quick=True)


def dark_signals(
    key: RandomKey, n_frames: int, shape: tuple[int, int], params: NoiseModel, *, exposure_s: float | Scalar
) -> Iterator[tuple[AbstractEffect, Array]]:
    """The signal after each effect in turn when `sample_by_effect` draws darks, [frame, row, column]."""
    clean = np.broadcast_to(np.float32(0), (n_frames, *shape))
    return signals(*_prepared(key, clean, params, exposure_s, None), quick=True)


def in_session_precision(params: NoiseModel) -> NoiseModel:
    """The model with numbers of the precision that sampling uses: a fit's are always float64."""
    dtype = jnp.result_type(float)

    def converted(leaf):
        wanted = eqx.is_inexact_array(leaf) and leaf.dtype != dtype
        return jax.lax.convert_element_type(leaf, dtype) if wanted else leaf

    return jax.tree.map(converted, params)


def _prepared(key, clean, params, exposure_s, sensor_key):
    """Checked input: key, photoelectrons [frame, row, column] or one number for all, shape, effects, capture."""
    if not isinstance(params, NoiseModel):
        raise TypeError(f"params: expected a NoiseModel (fit.params of a fit), got {type(params).__name__}.")
    check_not_forked()
    key = key_of("key", key)
    sensor_key = named_key(key, "sensor_key") if sensor_key is None else key_of("sensor_key", sensor_key)
    light = checked_light(clean, params.cfa)
    exposure = checked_exposure(params.exposure_s if exposure_s is None else exposure_s)
    *frames, rows, columns = light[0].shape
    return key, *_on_sensor(light, (math.prod(frames), rows, columns), params, exposure, sensor_key)


def _on_sensor(light, shape, params, exposure_s, sensor_key, window=None) -> tuple[Array, tuple, tuple, Capture]:
    """Light (see `checked_light`), shape, effects, capture of an exposure, or of several, with frames of `shape`."""
    dtype = jnp.result_type(float)
    clean, low, high = light
    params = in_session_precision(params)
    effects = merged(params.effects, _regime(low, high, params, exposure_s))
    capture = Capture(
        jnp.asarray(exposure_s, dtype),
        shape[1:],
        params.cfa,
        params.shutter,
        sensor_key,
        gain=next((effect.value for effect in effects if effect.name == "gain"), None),
        read_noise=params["read_noise"].sigma if "read_noise" in params else None,  # may be merged with arrivals
        window=window,
    )
    of_frames = (*np.shape(exposure_s), -1, *shape[1:])
    light = jnp.asarray(low, dtype) if low == high else jnp.asarray(clean, dtype).reshape(of_frames)
    return light, shape, effects, capture


def _regime(low: float, high: float, params: NoiseModel, exposure_s) -> Regime:
    """The known range of mean electrons if no effect has changed the light, between `low` and `high`, before."""
    rate = params["dark_current"].rate if "dark_current" in params else 0.0
    scales = ("light_scale", "dark_current_scale")
    changed = any(effect.acts_at < Stage.PHOTONS or any(may_scale(s, effect) for s in scales) for effect in params)
    if np.isnan(low) or changed or is_traced(rate) or is_traced(exposure_s):
        return "any"
    return regime_of(low + float(rate) * float(np.min(exposure_s)), high + float(rate) * float(np.max(exposure_s)))


def _fit_to_channels(effect: AbstractEffect, channels: tuple[str, ...]) -> AbstractEffect:
    """Broadcast scalars of per-channel parameters to the channels; reject any other shape but [channel]."""
    for field, spec in effect.specs().items():
        value = getattr(effect, field)
        shape = (len(channels),) if spec.per_channel else ()
        if value.shape == shape:
            continue
        if value.shape != ():
            expected = f"a scalar or one value per channel, {', '.join(channels)}" if shape else "a scalar"
            raise ValueError(f"{effect.name}.{field}: expected {expected}, got shape {value.shape}.")
        spread = jnp.broadcast_to(value, shape)
        effect = eqx.tree_at(attrgetter(field), effect, spread)
    return effect


def _version() -> str:
    try:
        return importlib.metadata.version("hsnoise")
    except importlib.metadata.PackageNotFoundError:
        return "not installed (source tree)"
