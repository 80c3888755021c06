"""Which parameters a fit moves, and the unconstrained numbers that stand for them."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise.likelihood.physics import Physics
from hsnoise.likelihood.summary import Summary

# Weak Gaussian priors on the coordinates (log scale for gain and read noise): they hold a direction in which the data
# say nothing, and move a parameter known to 2 % by 1e-4 of its standard error.
PRIOR_SIGMA = {
    "gain": 4.0,
    "read_noise": 4.0,
    "exponent": 2.0,
    "dark_current": 300.0,
    "row_sigma": 300.0,
    "white_share": 300.0,
    "outliers": 4.0,
}
EXPONENT_PRIOR = 0.5
BOUNDED = ("dark_current", "row_sigma", "white_share")  # at 0
LARGEST = {"white_share": 1.0}  # of the bounded ones that end somewhere
OFF_BOUNDS = 1e-9  # a share that is fitted stays this far from 0 and 1, where it would be held
LOGARITHMIC = ("gain", "read_noise", "outliers")


class Coordinates(eqx.Module):
    """Maps the free fields of a Physics to a vector and back; each number depends on one coordinate only.

    Gain, read noise and outliers are logarithms; dark current and row gain, which may be zero, are softplus of their
    value over a scale that the data resolve; so is the white share, which bends to its end at 1 in the same way;
    exponent, black level and clamp are themselves.
    """

    base: Physics
    rate_scale: jax.Array
    sigma_scale: jax.Array
    share_scale: jax.Array
    free: tuple[str, ...] = eqx.field(static=True)

    def inside(self, vector) -> np.ndarray:
        """How far each coordinate is inside of its nearest bound [parameter]; below 0 its parameter hardly changes."""
        low, high = self._bounds()
        return np.minimum(np.asarray(vector) - low, high - np.asarray(vector))

    def put_inside(self, vector, i: int, depth: float) -> np.ndarray:
        """`vector` with its bounded coordinate i at `depth` inside of the bound that is nearest."""
        (low, high), moved = self._bounds(), np.array(vector)
        moved[i] = low[i] + depth if vector[i] - low[i] <= high[i] - vector[i] else high[i] - depth
        return moved

    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates from which on a parameter bends to its bounds [parameter]; infinite where there are none."""
        low = [0.0 if name in BOUNDED else -np.inf for name in self.free]
        high = [float(self._span(name)) if name in LARGEST else np.inf for name in self.free]
        sizes = [np.size(getattr(self.base, name)) for name in self.free]
        return np.repeat(low, sizes), np.repeat(high, sizes)

    def vector(self, physics: Physics) -> jax.Array:
        return jnp.concatenate([jnp.atleast_1d(self._forward(n, getattr(physics, n))) for n in self.free])

    def physics(self, vector) -> Physics:
        return self._fill(vector, self._inverse)

    def reach(self, vector) -> np.ndarray:
        """How far each coordinate may go from `vector` before the rows' quadrature has to be planned anew."""
        names = np.repeat(self.free, [np.size(getattr(self.base, name)) for name in self.free])
        doubled = 5.0 + np.maximum(np.asarray(vector), 0.0)
        fixed = {name: np.inf for name in ("black_level", "black_clamp", "dark_current", "white_share")}
        return np.where(np.isin(names, ["row_sigma"]), doubled, [fixed.get(name, 2.0) for name in names])

    def slope(self, vector) -> jax.Array:
        """d parameter / d coordinate, [parameter]."""
        return jnp.diagonal(jax.jacfwd(lambda v: self.flat(self.physics(v)))(vector))

    def sizes(self, vector) -> jax.Array:
        """How far each coordinate moves when its parameter changes by about itself, [parameter]."""
        physics, gain = self.physics(vector), jnp.mean(self.base.gain)
        fixed = {"black_level": gain * self.base.read_noise, "black_clamp": gain * self.base.dark_current + 1e-9}
        parts = []
        for name in self.free:
            value = jnp.atleast_1d(getattr(physics, name))
            size = jnp.maximum(value / self._scale(name), 1.0) if name in BOUNDED else fixed.get(name, 1.0)
            parts.append(jnp.broadcast_to(size, value.shape))
        return jnp.concatenate(parts)

    def flat(self, physics: Physics) -> jax.Array:
        """The free parameters of `physics` themselves, in the order of `vector`."""
        return jnp.concatenate([jnp.atleast_1d(getattr(physics, n)) for n in self.free])

    def from_flat(self, values) -> Physics:
        return self._fill(values, lambda _, x: x)

    def log_prior(self, vector) -> jax.Array:
        centre = self.vector(self.base)
        total, at = jnp.zeros(()), 0
        for name in self.free:
            size = np.size(getattr(self.base, name))
            if name in PRIOR_SIGMA:
                middle = EXPONENT_PRIOR if name == "exponent" else centre[at : at + size]
                total -= 0.5 * (((vector[at : at + size] - middle) / PRIOR_SIGMA[name]) ** 2).sum()
            at += size
        return total

    def _fill(self, vector, convert) -> Physics:
        fields, at = {}, 0
        for name in self.free:
            value = getattr(self.base, name)
            size = np.size(value)
            fields[name] = convert(name, vector[at : at + size]).reshape(np.shape(value))
            at += size
        return Physics(**{**{f: getattr(self.base, f) for f in Physics.__dataclass_fields__}, **fields})

    def _scale(self, name):
        scales = {"dark_current": self.rate_scale, "row_sigma": self.sigma_scale, "white_share": self.share_scale}
        return scales[name]

    def _span(self, name):
        return LARGEST[name] / self._scale(name)

    def _forward(self, name, value):
        if name in LOGARITHMIC:
            return jnp.log(value)
        if name in BOUNDED:
            ratio = jnp.maximum(value / self._scale(name), 1e-6)
            if name not in LARGEST:
                return ratio + jnp.log(-jnp.expm1(-ratio))
            left = jnp.maximum(self._span(name) - ratio, 1e-6)
            return ratio + jnp.log(jnp.expm1(-ratio) / jnp.expm1(-left))
        return value

    def _inverse(self, name, x):
        if name in LOGARITHMIC:
            return jnp.exp(jnp.clip(x, -30.0, 30.0))
        if name in LARGEST:
            share = self._scale(name) * (jax.nn.softplus(x) - jax.nn.softplus(x - self._span(name)))
            return jnp.clip(share, OFF_BOUNDS, LARGEST[name] - OFF_BOUNDS)
        if name in BOUNDED:
            return self._scale(name) * jax.nn.softplus(x)
        return x


def coordinates_for(summary: Summary, start: Physics) -> Coordinates:
    """The parameters that this capture lets move.

    No dark current without exposure, no exponent of white rows, no white share of 0 or 1.
    """
    free = ["gain", "read_noise"]
    if summary.histograms and summary.exposure_s.any() and start.dark_current > 0:
        free.append("dark_current")
    if start.row_sigma is not None:
        free.append("row_sigma")
        if summary.shutter == "rolling" and summary.histograms:
            share = 0.0 if start.white_share is None else float(start.white_share)
            free += ["exponent"] if share < 1 else []
            free += ["white_share"] if 0 < share < 1 else []
    if summary.black_level_dn is None and summary.histograms:
        free.append("black_level")
    if start.black_clamp is not None:
        free.append("black_clamp")
    if start.outliers is not None:
        free.append("outliers")
    pixels = sum(float(h.counts[..., :].sum(dtype=np.float64)) for h in summary.histograms) + 1.0
    longest = max([*summary.exposure_s, 1e-12])
    rate_scale = 0.02 * start.dark_current + 10 * start.read_noise / np.sqrt(pixels) / longest
    return Coordinates(
        base=jax.tree.map(lambda x: np.asarray(x, np.float64), start),
        rate_scale=np.asarray(rate_scale, np.float64),
        sigma_scale=np.asarray(_row_gain_resolution(summary, start)),
        share_scale=np.asarray(_share_resolution(summary)),
        free=tuple(free),
    )


def _row_gain_resolution(summary: Summary, start: Physics) -> float:
    """The row gain that would just stand out of the measurement noise of the rows of a capture."""
    mean_e, smallest = start.dark_current * summary.exposure_s, [1.0]
    for h in summary.histograms:
        pixels = h.row_pixels.max()
        # A row's gain shows in its mean and, through the read noise that it scales, in its variance.
        noise = 1 / (pixels * (mean_e**2 / (mean_e + start.read_noise**2) + 2))
        smallest.append(float((noise * np.sqrt(2 / (h.row_pixels > 0).sum((1, 2)))).min()))
    if summary.flats is not None:
        flats = summary.flats
        signal_dn = np.maximum(flats.mean_dn - start.black_level, 1e-3)
        noise = flats.variance_dn2 / (flats.row_pixels * signal_dn**2)
        smallest.append(float((noise * np.sqrt(2 / flats.row_dof)).min()))
    return float(np.sqrt(min(smallest)))


def _share_resolution(summary: Summary) -> float:
    """The white share that just shows in the spectrum of rows without measurement noise."""
    rows = sum(int((h.row_pixels > 0).sum()) for h in summary.histograms)
    return 1 / np.sqrt(max(rows, 100))


def labels(coordinates: Coordinates, channels: tuple[str, ...]) -> tuple[str, ...]:
    """Table names of the free parameters, in the order of `vector`."""
    named = {"gain": "gain", "read_noise": "read_noise.sigma", "dark_current": "dark_current.rate"}
    named |= {"row_sigma": "row_gain.sigma", "exponent": "row_gain.exponent", "black_level": "black_level"}
    named |= {"black_clamp": "black_clamp.rate", "white_share": "row_gain.white_share"}
    out = []
    for name in coordinates.free:
        if name == "outliers":
            out += [f"outliers.{e}" for e in range(np.size(coordinates.base.outliers))]
            continue
        per_channel = np.ndim(getattr(coordinates.base, name)) > 0 and channels != ("mono",)
        out += [f"{named[name]}.{c}" for c in channels] if per_channel else [named[name]]
    return tuple(out)
