"""Which parameters a fit by likelihood moves, and the unconstrained numbers that stand for them."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hsnoise.likelihood import transforms
from hsnoise.likelihood.darks import black_level, dark_current, likelihood_part
from hsnoise.likelihood.parameters import OUTLIERS, Number, Parameters, likelihood_numbers
from hsnoise.likelihood.summary import Summary
from hsnoise.model import NoiseModel

BOUNDED = (transforms.SOFTPLUS, transforms.SOFTPLUS_BETWEEN)


class Coordinates(Parameters):
    """The free numbers of a model under the likelihood; each number depends on one coordinate only.

    base, outliers: where the fit starts, float64: a model, and the share of outliers [exposure], None for none.
    """

    base: NoiseModel
    outliers: jax.Array | None

    def inside(self, vector) -> np.ndarray:
        """How far each coordinate is inside of its nearest bound [number]; below 0 its parameter hardly changes."""
        low, high = self._bends()
        return np.minimum(np.asarray(vector) - low, high - np.asarray(vector))

    def put_inside(self, vector, i: int, depth: float) -> np.ndarray:
        """`vector` with its bounded coordinate i at `depth` inside of the bound that is nearest."""
        (low, high), moved = self._bends(), np.array(vector)
        moved[i] = low[i] + depth if vector[i] - low[i] <= high[i] - vector[i] else high[i] - depth
        return moved

    def _bends(self) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates from which on a parameter bends to its bounds [number]; infinite where there are none."""
        low = np.where([n.transform in BOUNDED for n in self.numbers], 0.0, -np.inf)
        span = [np.subtract(*n.bounds[::-1]) if n.transform in BOUNDED else np.inf for n in self.numbers]
        return low, np.asarray(span) / np.asarray(self.scale)

    def start(self) -> jax.Array:
        """The vector of where the fit starts."""
        fields = [(getattr(self.base[e], f) if e in self.base else self.outliers) for (e, f), _ in self._fields()]
        return self.coordinates(jnp.concatenate([jnp.atleast_1d(x) for x in fields]))

    def at(self, vector) -> tuple[NoiseModel, jax.Array | None]:
        """The model and the shares of outliers that a vector stands for."""
        return self.with_values(self.values(vector))

    def with_values(self, values) -> tuple[NoiseModel, jax.Array | None]:
        """The model and the shares of outliers with these values [number]."""
        model, outliers = self.base, self.outliers
        for (effect, field), own in self._fields():
            new = values[own[0] : own[-1] + 1]
            if effect == OUTLIERS:
                outliers = new
            else:
                model = _with_field(model, effect, field, new)
        return model, outliers

    def reach(self, vector) -> np.ndarray:
        """How far each coordinate may go from `vector` before the rows' quadrature has to be planned anew."""
        grown = [max(x, 0.0) if n.transform in BOUNDED else 0.0 for n, x in zip(self.numbers, vector, strict=True)]
        return np.array([n.reach for n in self.numbers]) + grown

    def sizes(self, vector) -> np.ndarray:
        """How far each coordinate moves when its parameter changes by about itself [number]."""
        value, gain = np.asarray(self.values(vector)), float(np.mean(np.asarray(self.base["gain"].value)))
        bounded = np.array([n.transform in BOUNDED for n in self.numbers])
        sizes = np.where(bounded, np.maximum(value / np.asarray(self.scale), 1.0), 1.0)
        sizes[self.where("black_level")] = gain * float(self.base["read_noise"].sigma)
        sizes[self.where("black_clamp")] = gain * float(dark_current(self.base)) + 1e-9
        return sizes

    def log_prior(self, vector) -> jax.Array:
        """Log density of the priors at a vector, up to a constant."""
        known = [np.nan if n.prior_centre is None else n.prior_centre for n in self.numbers]
        centre = jnp.where(np.isnan(known), self.start(), np.nan_to_num(known))
        return -0.5 * (((vector - centre) / np.array([n.prior_sigma for n in self.numbers])) ** 2).sum()


def _with_field(model: NoiseModel, effect: str, field: str, values) -> NoiseModel:
    """The model with other values in a field, unchecked: traced, or out of bounds on the way of a search."""
    like = getattr(model[effect], field)
    return eqx.tree_at(lambda m: getattr(m[effect], field), model, values.reshape(like.shape))


def coordinates_for(summary: Summary, start: NoiseModel, outliers: np.ndarray | None = None) -> Coordinates:
    """The parameters that this capture lets move from `start`, with a component for outliers if shares are given.

    No dark current without exposure, no exponent of white rows, no white share of 0 or 1.
    """
    start = jax.tree.map(np.asarray, likelihood_part(start))
    shares = None if outliers is None else np.asarray(outliers, np.float64)
    exposures = 0 if shares is None else len(shares)
    numbers = tuple(n for n in likelihood_numbers(start, exposures) if _moves(n, summary, start))
    scales = {
        ("dark_current", "rate"): _rate_resolution(summary, start),
        ("row_gain", "sigma"): _row_gain_resolution(summary, start),
        ("row_gain", "white_share"): _share_resolution(summary),
    }
    return Coordinates(np.array([scales.get(n.place, 1.0) for n in numbers]), numbers, start, shares)


def _moves(number: Number, summary: Summary, start: NoiseModel) -> bool:
    """Whether this capture lets a number of the likelihood move."""
    rolling_darks = bool(summary.histograms) and summary.shutter == "rolling"
    match number.place:
        case "dark_current", _:
            return bool(summary.histograms) and bool(summary.exposure_s.any()) and number.value_in(start) > 0
        case "row_gain", "exponent":
            return rolling_darks and float(start["row_gain"].white_share) < 1
        case "row_gain", "white_share":
            return rolling_darks and not number.spec.holds(number.value_in(start))
        case "black_level", _:
            return bool(summary.histograms) and summary.black_level_dn is None
    return True


def _rate_resolution(summary: Summary, start: NoiseModel) -> float:
    """The dark current, e-/s, that would just stand out of the read noise of all pixels, and a share of its own."""
    pixels = sum(float(h.counts.sum(dtype=np.float64)) for h in summary.histograms) + 1.0
    longest = max([*summary.exposure_s, 1e-12])
    return 0.02 * float(dark_current(start)) + 10 * float(start["read_noise"].sigma) / np.sqrt(pixels) / longest


def _row_gain_resolution(summary: Summary, start: NoiseModel) -> float:
    """The row gain that would just stand out of the measurement noise of the rows of a capture."""
    read_noise, smallest = start["read_noise"].sigma, [1.0]
    mean_e = dark_current(start) * summary.exposure_s
    for h in summary.histograms:
        pixels = h.row_pixels.max()
        # A row's gain shows in its mean and, through the read noise that it scales, in its variance.
        noise = 1 / (pixels * (mean_e**2 / (mean_e + read_noise**2) + 2))
        smallest.append(float((noise * np.sqrt(2 / (h.row_pixels > 0).sum((1, 2)))).min()))
    if summary.flats is not None:
        flats = summary.flats
        signal_dn = np.maximum(flats.mean_dn - black_level(start), 1e-3)
        noise = flats.variance_dn2 / (flats.row_pixels * signal_dn**2)
        smallest.append(float((noise * np.sqrt(2 / flats.row_dof)).min()))
    return float(np.sqrt(min(smallest)))


def _share_resolution(summary: Summary) -> float:
    """The white share that just shows in the spectrum of rows without measurement noise."""
    rows = sum(int((h.row_pixels > 0).sum()) for h in summary.histograms)
    return 1 / np.sqrt(max(rows, 100))
