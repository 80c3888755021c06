"""The noise model: an ordered set of effects; sampling frames from it; its file."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from functools import partial, reduce
from operator import attrgetter
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from hsnoise._keys import named_key
from hsnoise._output import write_atomically
from hsnoise._types import RandomKey, Scalar, cfa_tile, channels_of, check_shutter, is_traced
from hsnoise.effects import EFFECTS, AbstractEffect, Capture, Parameter
from hsnoise.effects._base import shortest

FORMAT, FORMAT_VERSION = "hsnoise noise model", 1


class NoiseModel(eqx.Module):
    """What a sensor does to light: effects in the order of their stages, then of insertion.

    A PyTree whose leaves are the physical parameters. `model["gain"].value` is the gain, `model.add(effect)`
    a larger model, `model.table()` all numbers with their units.

    Attributes:
        effects: the effects, in the order in which they act.
        cfa: "mono" or a 2x2 Bayer string.
        shutter: "rolling" or "global".
        exposure_s: exposure in seconds that `sample` takes unless told otherwise.
    """

    effects: tuple[AbstractEffect, ...]
    cfa: str = eqx.field(static=True)
    shutter: str = eqx.field(static=True)
    exposure_s: float = eqx.field(static=True)

    def __init__(self, effects: Iterable[AbstractEffect], *, cfa: str, shutter: str, exposure_s: float):
        """Make a model of `effects`, in any order.

        Raises:
            TypeError: if something among `effects` is no effect.
            ValueError: on two effects of one name, a parameter that does not fit the channels of `cfa`, an
                unknown `cfa` or `shutter`, a negative `exposure_s`.
        """
        effects = tuple(effects)
        for effect in effects:
            if not isinstance(effect, AbstractEffect):
                raise TypeError(f"effects: expected instances of AbstractEffect, got {effect!r}.")
        names = [effect.name for effect in effects]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"effects: {', '.join(twice)} given twice; a model holds one effect of a name.")
        check_shutter(shutter)
        channels = channels_of(cfa)
        ordered = sorted(effects, key=lambda effect: effect.stage)
        self.effects = tuple(_fit_to_channels(effect, channels) for effect in ordered)
        self.cfa = cfa
        self.shutter = shutter
        self.exposure_s = float(_check_exposure(exposure_s))

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
        """The model with one effect more. Raises ValueError if it has one of that name."""
        return self._with((*self.effects, effect))

    def remove(self, name: str) -> NoiseModel:
        """The model without the effect called `name`. Raises KeyError if it has none."""
        gone = self[name]
        return self._with(effect for effect in self.effects if effect is not gone)

    def with_value(self, name: str, field: str, value: ArrayLike) -> NoiseModel:
        """The model with another value of one parameter, such as `model.with_value("gain", "value", 2.0)`.

        Raises KeyError for an effect that it has not, ValueError for a value that does not fit the channels.
        """
        old = self[name]
        new = eqx.tree_at(attrgetter(field), old, jnp.asarray(value, float))
        return self._with(new if effect is old else effect for effect in self.effects)

    def _with(self, effects: Iterable[AbstractEffect]) -> NoiseModel:
        return NoiseModel(effects, cfa=self.cfa, shutter=self.shutter, exposure_s=self.exposure_s)

    def parameters(self) -> list[Parameter]:
        """All numbers of the model with name, value, unit, bounds and meaning."""
        return [parameter for effect in self.effects for parameter in effect.parameters(self.channels)]

    def table(self) -> dict[str, tuple[float, str]]:
        """Parameter name to (value, unit), such as {"gain.R": (1.53, "DN/e-"), ...}."""
        return {p.name: (p.value, p.spec.unit) for p in self.parameters()}

    def save(self, path: str | os.PathLike, *, provenance: Mapping[str, Any] | None = None) -> None:
        """Write the model as human-readable JSON, all or nothing.

        Args:
            path: file to write; an existing one is replaced.
            provenance: where the numbers come from (camera, data, method); anything that JSON can hold.
        """
        leaves = jax.tree.leaves(self.effects)
        content = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "hsnoise_version": _version(),
            "provenance": dict(provenance or {}),
            "cfa": self.cfa,
            "shutter": self.shutter,
            "exposure_s": self.exposure_s,
            "precision": str(jnp.result_type(*leaves)) if leaves else "float32",
            "effects": [_effect_to_json(effect, self.channels) for effect in self.effects],
        }
        write_atomically(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())

    @staticmethod
    def load(path: str | os.PathLike, effects: Iterable[type[AbstractEffect]] = ()) -> NoiseModel:
        """Read a model that `save` wrote; every number and its precision come back exactly.

        Args:
            path: the file.
            effects: classes of the effects in it that are not built into hsnoise.

        Raises:
            ValueError: if the file is no noise model or holds an effect, parameter or unit that is not known.
        """
        try:
            content = json.loads(Path(path).read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{path}: not a JSON file ({error}).") from error
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError(f"{path}: not a noise model saved by hsnoise.")
        if content.get("format_version") != FORMAT_VERSION:
            raise ValueError(
                f"{path}: file format {content.get('format_version')}, written by hsnoise "
                f"{content.get('hsnoise_version')}; this version reads format {FORMAT_VERSION}."
            )
        classes = {cls.name: cls for cls in (*EFFECTS, *effects)}
        try:
            with jax.enable_x64(content["precision"] == "float64"):
                channels = channels_of(content["cfa"])
                return NoiseModel(
                    [_effect_from_json(item, classes, channels) for item in content["effects"]],
                    **{field: content[field] for field in ("cfa", "shutter", "exposure_s")},
                )
        except KeyError as error:
            raise ValueError(f"{path}: {error} is missing.") from error
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: {error}") from error


def sample(
    key: RandomKey,
    clean: ArrayLike,
    params: NoiseModel,
    *,
    exposure_s: float | Scalar | None = None,
    sensor_key: RandomKey | None = None,
) -> Array:
    """Draw what the sensor makes of a clean image: counts in DN.

    Every leading index of `clean` is a frame of its own, with its own row gains. Each effect draws from a key
    that is named after it, so adding an effect leaves the draws of the others as they were. Works under jit
    and vmap.

    Args:
        key: random key.
        clean: expected photoelectrons of each pixel, e-, [..., row, column]; zeros give dark frames.
        params: the noise model.
        exposure_s: exposure in seconds; that of the model by default.
        sensor_key: key from which fixed patterns are drawn; the same key is the same sensor. By default derived
            from `key`, so that each call is another sensor of the same make.

    Returns:
        Counts, the shape of `clean`: uint16 if the model's white level is at most 65535 DN, else uint32.
        Without the `adc` effect (`params.remove("adc")`): DN as floats, neither rounded nor clipped, which
        has gradients by the parameters of Gaussian and multiplicative effects.

    Raises:
        TypeError: if `params` is no NoiseModel or `clean` does not hold real numbers.
        ValueError: if `clean` has fewer than two dimensions, no pixels, odd sizes with a Bayer array, or
            negative or non-finite values; if the exposure is negative or not one number. (Under jit, values
            cannot be checked.)

    Reference: Wang et al., "Enhancing Low Light Videos by Exploring High Sensitivity Camera Noise",
    ICCV 2019.
    """
    signal, effects, capture = _prepared(key, clean, params, exposure_s, sensor_key)
    return _apply_in_one(key, signal, effects, capture).reshape(np.shape(clean))


def sample_dark(
    key: RandomKey,
    n_frames: int,
    shape: tuple[int, int],
    params: NoiseModel,
    *,
    exposure_s: float | Scalar | None = None,
    sensor_key: RandomKey | None = None,
) -> Array:
    """Draw dark frames of `shape` (rows, columns): counts in DN, [frame, row, column]. See `sample`."""
    clean = np.zeros((n_frames, *shape), np.float32)
    return sample(key, clean, params, exposure_s=exposure_s, sensor_key=sensor_key)


def sample_dark_by_effect(
    key: RandomKey,
    n_frames: int,
    shape: tuple[int, int],
    params: NoiseModel,
    *,
    exposure_s: float | Scalar,
    sensor_key: RandomKey,
) -> Array:
    """As `sample_dark`, the same counts up to rounding, but each effect is compiled by itself.

    Somewhat slower to run; but of a model with one effect more, only that effect is compiled.
    """
    clean = np.zeros((n_frames, *shape), np.float32)
    return _apply(key, *_prepared(key, clean, params, exposure_s, sensor_key))


def dark_signals(
    key: RandomKey, n_frames: int, shape: tuple[int, int], params: NoiseModel, *, exposure_s: float | Scalar
) -> Iterator[tuple[AbstractEffect, Array]]:
    """What leaves each effect in turn when `sample_dark_by_effect` draws, [frame, row, column]."""
    clean = np.zeros((n_frames, *shape), np.float32)
    return _signals(key, *_prepared(key, clean, params, exposure_s, None))


def _prepared(key, clean, params, exposure_s, sensor_key):
    """Checked input: signal [frame, row, column], effects in the precision of the session, capture."""
    if not isinstance(params, NoiseModel):
        raise TypeError(f"params: expected a NoiseModel (fit.params of a fit), got {type(params).__name__}.")
    dtype = jnp.result_type(float)
    clean = jnp.asarray(_check_clean(clean, params.cfa), dtype)
    exposure = _check_exposure(params.exposure_s if exposure_s is None else exposure_s)
    sensor_key = named_key(key, "sensor_key") if sensor_key is None else sensor_key
    capture = Capture(jnp.asarray(exposure, dtype), clean.shape[-2:], params.cfa, params.shutter, sensor_key)
    # A fit returns float64 parameters, whatever precision the session samples in.
    numbers, rest = eqx.partition(params.effects, eqx.is_inexact_array)
    numbers = jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, dtype), numbers)
    effects = eqx.combine(numbers, rest)
    return clean.reshape(-1, *capture.shape), effects, capture


def _apply(key, signal, effects, capture):
    return reduce(lambda _, step: step[1], _signals(key, signal, effects, capture), signal)


def _signals(key, signal, effects, capture):
    scales = [_read_noise_scale(key, effect, capture, signal.shape) for effect in effects if _may_scale(effect)]
    scales = [scale for scale in scales if scale is not None]
    if scales:
        capture = dataclasses.replace(capture, read_noise_scale=reduce(jnp.multiply, scales))
    for effect in effects:
        drawn = _sample_one(key, signal, effect, capture)
        if np.shape(drawn) != signal.shape:
            raise ValueError(f"{effect.name}: its sample returned shape {np.shape(drawn)}, expected {signal.shape}.")
        signal = drawn
        yield effect, signal


_apply_in_one = jax.jit(_apply)


def _may_scale(effect: AbstractEffect) -> bool:
    return type(effect).read_noise_scale is not AbstractEffect.read_noise_scale


@partial(jax.jit, static_argnums=3)
def _read_noise_scale(key, effect, capture, shape):
    return effect.read_noise_scale(capture, shape, key=named_key(key, effect.name))


@jax.jit
def _sample_one(key, signal, effect, capture):
    return effect.sample(signal, capture, key=named_key(key, effect.name))


def _check_clean(clean, cfa: str):
    clean = clean if isinstance(clean, jax.Array) else np.asarray(clean)
    if not (jnp.issubdtype(clean.dtype, jnp.integer) or jnp.issubdtype(clean.dtype, jnp.floating)):
        raise TypeError(f"clean: expected real numbers (photoelectrons), got dtype {clean.dtype}.")
    if clean.ndim < 2 or clean.size == 0:
        raise ValueError(f"clean: expected photoelectrons [..., row, column], got shape {clean.shape}.")
    period = len(cfa_tile(cfa))
    if clean.shape[-2] % period or clean.shape[-1] % period:
        raise ValueError(f"clean: expected even rows and columns for cfa {cfa}, got {clean.shape[-2:]}.")
    if not is_traced(clean):
        with jax.ensure_compile_time_eval():  # inside jit, too, where arrays from outside have values
            low, high = float(clean.min()), float(clean.max())
        if not (low >= 0 and high < np.inf):
            raise ValueError(f"clean: expected finite photoelectrons >= 0, got values from {low} to {high}.")
    return clean


def _check_exposure(exposure_s):
    if np.ndim(exposure_s) != 0:
        raise ValueError(f"exposure_s: expected one number of seconds, got shape {np.shape(exposure_s)}.")
    if not is_traced(exposure_s) and not 0 <= float(exposure_s) < np.inf:
        raise ValueError(f"exposure_s: expected finite seconds >= 0, got {exposure_s}.")
    return exposure_s


def _fit_to_channels(effect: AbstractEffect, channels: tuple[str, ...]) -> AbstractEffect:
    """Spread scalars of per-channel parameters over the channels; refuse any other shape but [channel]."""
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


def _effect_to_json(effect: AbstractEffect, channels: tuple[str, ...]) -> dict[str, Any]:
    parameters = {}
    for field, spec in effect.specs().items():
        leaf = np.asarray(getattr(effect, field))
        value = dict(zip(channels, map(shortest, leaf), strict=True)) if spec.per_channel else shortest(leaf)
        parameters[field] = {"value": value, "unit": spec.unit}
    return {"name": effect.name, "parameters": parameters, "settings": effect.settings()}


def _effect_from_json(item: Mapping, classes: Mapping[str, type[AbstractEffect]], channels: tuple[str, ...]):
    name = item["name"]
    if name not in classes:
        raise ValueError(
            f"effect {name!r} is not built into hsnoise; pass its class: NoiseModel.load(path, effects=[MyEffect])."
        )
    specs = classes[name].specs()
    if set(item["parameters"]) != set(specs):
        raise ValueError(f"{name}: expected parameters {sorted(specs)}, got {sorted(item['parameters'])}.")
    values = {}
    for field, spec in specs.items():
        value, unit = item["parameters"][field]["value"], item["parameters"][field]["unit"]
        if unit != spec.unit:
            raise ValueError(f"{name}.{field}: expected unit {spec.unit!r}, got {unit!r}.")
        values[field] = np.array([value[channel] for channel in channels]) if spec.per_channel else value
    return classes[name](**values, **item["settings"])


def _version() -> str:
    try:
        return importlib.metadata.version("hsnoise")
    except importlib.metadata.PackageNotFoundError:
        return "not installed (source tree)"
