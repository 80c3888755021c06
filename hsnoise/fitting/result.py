"""What a fit returns: parameters, standard errors, and how it went."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from hsnoise._core import html as _html
from hsnoise._core.conclusion import Conclusion, Light
from hsnoise._core.data_frames import table_to_pandas
from hsnoise._core.types import unit_in_words
from hsnoise.frames.stack import FrameStack
from hsnoise.likelihood import rows
from hsnoise.likelihood.darks import binning, dark_laws, likelihood_part, log_probability, row_sigma
from hsnoise.likelihood.parameters import numbers_of
from hsnoise.likelihood.summary import Summary, without_counts
from hsnoise.model import NoiseModel
from hsnoise.statistics.pixels.maps import PixelMaps, pixel_maps

BASE = ("gain", "read_noise", "dark_current", "black_level")  # printed first
MOST_ERROR_DN = 1e5  # of a value that is shown: beyond, nothing is known of it


class Method(StrEnum):
    """The method of a fit."""

    ML = "ml"
    LINE = "line"
    TRANSFER = "transfer"
    SYNTHETIC = "synthetic"


class Status(StrEnum):
    """How a fit ended."""

    CONVERGED = "converged"
    NOT_CONVERGED = "not converged"
    LINE = "line fit"  # as asked
    LINE_INSTEAD = "line fit instead"  # of a likelihood that did not converge
    TRANSFER = "pixel transfer"
    TRANSFER_INSTEAD = "pixel transfer instead"  # of a likelihood that did not converge
    CONTRADICTED = "likelihood contradicted"  # by pixels over time: pixel transfer instead
    NEARER = "pixel transfer nearer"  # than a likelihood of pooled pixels
    MET = "statistics met"  # by simulated ones
    NOT_MET = "statistics not met"


TITLES = {
    Method.ML: "Joint maximum likelihood",
    Method.LINE: "Line fit",
    Method.TRANSFER: "Pixel transfer",
    Method.SYNTHETIC: "Base fit, corrected for added effects by simulated statistics",
}
OUTCOMES = {
    Status.CONVERGED: "converged: {}",
    Status.NOT_CONVERGED: "NOT CONVERGED: {}",
    Status.LINE: "the paper's line fit, as asked",
    Status.LINE_INSTEAD: "MAXIMUM LIKELIHOOD DID NOT CONVERGE ({}); the line fit was used instead",
    Status.TRANSFER: "{}",
    Status.TRANSFER_INSTEAD: "MAXIMUM LIKELIHOOD DID NOT CONVERGE ({}); pixel transfer used instead",
    Status.CONTRADICTED: "each pixel over time; a likelihood of pooled pixels gives another gain, {}",
    Status.NEARER: "each pixel over time, because pooled pixels leave an error of {}",
    Status.MET: "simulated statistics met: {}",
    Status.NOT_MET: "NOT CONVERGED: simulated statistics not met: {}",
}
AGREES = "Nothing in these frames contradicts these numbers."
LOOK_ALIKE = "hsnoise compare checks whether frames drawn from them look alike."


def _flat_levels(number: int) -> str:
    return f", {number} flat level{'s' if number != 1 else ''}"


@dataclass(frozen=True)
class FitResult:
    """A fitted camera.

    Attributes:
        params: the NoiseModel, for `hsnoise.sample`, `save`, ...
        names, covariance: fitted parameters and their covariance, in the units of `table`.
        method: "ml", "line", "transfer" where pixels differ, or "synthetic" with effects beyond the paper's.
        status: how the fit ended; detail: its numbers, in words (`outcome` combines both in a sentence).
        iterations: quasi-Newton steps taken.
        log_likelihood: at the estimate, nats (NaN for the line fit, which has none).
        notes: sentences on what the data do not determine, and which capture would.
        summary: the row histograms and photon transfer that were fitted.
        outliers: fraction of the pixels of each dark exposure that was excluded because no model fits it; or None.
        doubts: sentences on disagreements and withheld parameters, printed above the table.
        grave: whether a doubt says that a parameter may be wrong; other doubts report what was excluded.
        grave_in_dn: likewise, but for a gain that is not determined: without one, noise in DN can still be right.
        withheld: names of parameters that the frames do not determine: NaN in `table`. `params` then has a gain of
            1 DN/e-, so its electrons are DN and darks are still drawn with the right noise.
        added: effects of `params` that the fit put in because the pixels differ.
        transfer: what pixel transfer found, where pixels differ: `hsnoise.pixel_fit.PixelFit`; else None.
        stack: the frames, for `pixels`.
    """

    params: NoiseModel
    names: tuple[str, ...]
    covariance: np.ndarray
    method: Method
    status: Status
    detail: str
    iterations: int
    log_likelihood: float
    notes: tuple[str, ...]
    summary: Summary
    outliers: np.ndarray | None = None
    doubts: tuple[str, ...] = ()
    grave: bool = False
    grave_in_dn: bool = False
    withheld: tuple[str, ...] = ()
    added: tuple[str, ...] = ()
    transfer: Any = None
    stack: FrameStack | None = None

    @property
    def trustworthy(self) -> bool:
        """Whether the fit converged, and nothing that determines a parameter disagrees with the frames."""
        return self.converged and not self.grave

    @property
    def conclusion(self) -> Conclusion:
        """Whether these numbers can be used, and if not, the first reason."""
        if not self.converged:
            return Conclusion(Light.RED, "Do not use these numbers: the fit did not converge.")
        if not self.doubts:
            return Conclusion(Light.GREEN, AGREES, LOOK_ALIKE)
        first = self.doubts[0]
        others = f" ({len(self.doubts) - 1} more below)" if len(self.doubts) > 1 else ""
        # That there is no gain is no error: noise in DN can be used.
        if not self.has_gain and not self.grave_in_dn:
            return Conclusion(Light.AMBER, "In DN only.", f"{first}{others}")
        if self.grave:
            return Conclusion(Light.RED, "Do not use these numbers.", f"{first}{others}")
        return Conclusion(Light.AMBER, "Usable, with doubts.", f"{first}{others}")

    @property
    def further_doubts(self) -> tuple[str, ...]:
        """The doubts that `conclusion` does not mention."""
        return self.doubts[1:] if self.converged else self.doubts

    @property
    def has_gain(self) -> bool:
        """Whether the frames determine the gain; row gain or dark current may still be withheld."""
        return not any(number.name in self.withheld for number in numbers_of(self.params, ["gain"]))

    @cached_property
    def pixels(self) -> PixelMaps:
        """Maps of offset, dark current, noise and flags of each pixel; the frames are read once more.

        Raises ValueError where a summary was fitted, which has no frames, or no dark exposure has two frames.
        """
        if self.stack is None:
            raise ValueError("pixels: this fit has no frames, it was made from a Summary or from flats")
        return pixel_maps(self.stack, np.asarray(self.params["gain"].value) if self.has_gain else None)

    @property
    def table(self) -> dict[str, tuple[float, float, str]]:
        """Parameter name to (value, standard error, unit); the error is 0 for a value that was held, not fitted,
        and infinite where the capture says nothing."""
        rows_ = self._rows
        return rows_ | {name: (float("nan"), float("inf"), rows_[name][2]) for name in self.withheld if name in rows_}

    @property
    def _rows(self) -> dict[str, tuple[float, float, str]]:
        """The rows of `table`, nothing withheld."""
        fitted = dict(zip(self.names, np.sqrt(np.diagonal(self.covariance)), strict=True))
        held = {"dark_current.rate": float("inf")}
        return {
            name: (value, float(fitted.get(name, held.get(name, 0.0))), unit)
            for name, (value, _, unit) in self.params.table.items()
        }

    def rows_of(self, effect: str) -> dict[str, tuple[float, float, str]]:
        """The rows of `table` that are one effect's. Raises KeyError if the model has none of that name."""
        table = self.table
        return {one.name: table[one.name] for one in self.params[effect].parameters(self.params.channels)}

    def in_dn(self, effect: str) -> dict[str, tuple[float, float, str]]:
        """`rows_of`, but where the gain is unknown, electrons as DN, by the gain that `params` has.

        Raises KeyError if the model has no such effect.
        """
        found = self.rows_of(effect)
        if self.has_gain:
            return found
        for name in found.keys() & set(self.withheld):
            found[name] = self._times_gain(name)
        return found

    def _times_gain(self, name: str) -> tuple[float, float, str]:
        """A row in DN, by the gain that `params` has; what depends on the gain is known better in DN."""
        gain, (value, error, unit) = float(np.mean(np.asarray(self.params["gain"].value))), self._rows[name]
        gains = [i for i, one in enumerate(self.names) if one in self.rows_of("gain")]
        if name in self.names and self.covariance[self.names.index(name), gains].any():
            some = [*gains, self.names.index(name)]
            slope = np.array([*[value / len(gains)] * len(gains), gain])
            error = float(np.sqrt(max(slope @ self.covariance[np.ix_(some, some)] @ slope, 0.0))) / gain
        return value * gain, error * gain, unit.replace("e-", "DN")

    @property
    def in_order(self) -> dict[str, tuple[float, float, str]]:
        """The rows of `table`, what every camera has first: on a screen that cuts the rest, it is seen."""
        table = self.table
        first = [name for base in BASE if base in self.params for name in self.rows_of(base)]
        return {name: table[name] for name in (*first, *table)}

    @property
    def shown(self) -> dict[str, tuple[float, float, str]]:
        """The rows of `table` as they are printed: without a gain, single pixels still tell electrons as DN."""
        rows = self.in_order
        if self.has_gain or self.transfer is None:
            return rows
        in_e = [name for name in self.withheld if name in rows and rows[name][2] in ("e-", "e-/s")]
        in_dn = {name: self._times_gain(name) for name in in_e}
        return rows | {name: row for name, row in in_dn.items() if row[1] < MOST_ERROR_DN}

    @property
    def told(self) -> dict[str, tuple[float, float, str]]:
        """The rows of `shown` without the parts of effects that are held at 0: these are not there."""
        not_there = {p.name for p in self.params.parameters() if p.value == 0 and p.spec.holds(0.0)}
        return {name: row for name, row in self.shown.items() if row[1] != 0 or name not in not_there}

    @property
    def outcome(self) -> str:
        """How the fit ended, in words."""
        return OUTCOMES[self.status].format(self.detail)

    @property
    def converged(self) -> bool:
        """Whether the fit ended where it should."""
        return self.status not in (Status.NOT_CONVERGED, Status.NOT_MET)

    def without(self, names: tuple[str, ...]) -> FitResult:
        """The same fit without some of the effects that it added itself; other numbers do not change."""
        params = self.params
        for name in names:
            params = params.remove(name)
        table = params.table
        kept = [i for i, name in enumerate(self.names) if name in table]
        return replace(
            self,
            params=params,
            names=tuple(self.names[i] for i in kept),
            covariance=self.covariance[np.ix_(kept, kept)],
            withheld=tuple(name for name in self.withheld if name in table),
            added=tuple(name for name in self.added if name not in names),
        )

    def with_notes(self, notes: tuple[str, ...]) -> FitResult:
        return replace(self, notes=notes)

    def expected_histograms(self) -> tuple[np.ndarray, ...]:
        """Counts that the model expects in the bins of `summary.histograms`: for each channel [exposure, bin]."""
        return tuple(
            law * h.row_pixels.sum((1, 2))[:, None]
            for h, (law, _) in zip(self.summary.histograms, self.expected_laws(), strict=True)
        )

    def expected_laws(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each channel [exposure, bin]: probability of a bin over all row gains, and its deviation between rows."""
        with jax.enable_x64(True):
            sensor, light = (likelihood_part(self.params), self.outliers), without_counts(self.summary)
            found = (
                _expected(sensor, c, light, h.edges_dn, h.outlier_law) for c, h in enumerate(self.summary.histograms)
            )
            return [jax.tree.map(np.asarray, laws) for laws in found]

    def to_pandas(self) -> Any:
        """`table` as a pandas DataFrame: parameter, value, standard_error, unit (needs `hsnoise[pandas]`).

        Raises ImportError without pandas.
        """
        return table_to_pandas(self)

    @property
    def _title(self) -> str:
        exposures = len(self.summary.exposure_s)
        darks = f"{sum(self.summary.n_frames)} dark frames at {exposures} exposure{'s' if exposures != 1 else ''}"
        flats = "" if self.summary.flats is None else _flat_levels(len(self.summary.flats.exposure_s))
        return f"{TITLES[self.method]}: {darks}{flats}"

    def _rounded_table(self) -> Table:
        table = Table()
        for heading in ("parameter", "value", "standard error", "unit"):
            table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right")
        for name, (value, error, unit) in self.told.items():
            table.add_row(name, *rounded(value, error), unit_in_words(unit))
        return table

    def __str__(self) -> str:
        console = Console(file=io.StringIO(), width=100, color_system=None)
        console.print(str(self.conclusion), markup=False, highlight=False)
        console.print(self._title, highlight=False)
        for doubt in self.doubts:
            console.print(f"! {doubt}", highlight=False)
        console.print(self._rounded_table())
        steps = f"; {self.iterations} iterations" if self.iterations else ""
        console.print(f"{self.outcome}{steps}", highlight=False)
        for note in self.notes:
            console.print(f"- {note}", highlight=False)
        return console.file.getvalue().rstrip()

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return _html.fragment(
            _html.conclusion(self.conclusion),
            _html.sentences(self.further_doubts),
            _html.paragraph(self._title),
            _html.printed(self._rounded_table()),
            _html.details(
                f"How it ended, and {len(self.notes)} note{'s' if len(self.notes) != 1 else ''}",
                _html.paragraph(f"{self.outcome}; {self.iterations} iterations"),
                _html.sentences(self.notes),
            ),
        )


@jax.jit
def _expected(sensor, c: int, summary: Summary, edges_dn, outlier_law) -> tuple[jax.Array, jax.Array]:
    """Distribution of the counts averaged over the row gain's prior, and its standard deviation [exposure, bin].

    sensor: a model and the shares of outliers beside it.
    """
    model, outliers = sensor
    beta, weight = jnp.ones(1), jnp.ones(1)
    if "row_gain" in model:
        sigma = row_sigma(model)[c]
        nodes = rows.make_nodes(jnp.zeros(1), (1 + rows.PRIOR_REACH * sigma)[None], 0.1, sigma, 256)
        beta, density = nodes.beta[0], jax.scipy.stats.norm.pdf(nodes.beta[0], 1.0, sigma)
        weight = jnp.exp(nodes.log_weight[0]) * density
        weight = weight.at[0].add(jax.scipy.stats.norm.cdf((beta[0] - 1) / sigma))

    def exposure(at):
        law = jnp.exp(log_probability(model, outliers, at, beta))
        share = weight / weight.sum()
        mixed = share @ law
        return mixed / mixed.sum(), jnp.sqrt(share @ (law - mixed[None, :]) ** 2)

    exposures = len(summary.exposure_s)
    laws = dark_laws(model, summary.exposure_s)
    at = binning(summary, laws, jnp.full(exposures, c), jnp.arange(exposures), edges_dn, outlier_law)
    return jax.lax.map(exposure, at)


def rounded(value: float, error: float) -> tuple[str, str]:
    """Value and standard error, rounded to significant digits; a word where there is no error."""
    if np.isnan(value):
        return "not determined", ""
    if not (np.isfinite(error) and error > 0):
        return f"{value:.5g}", "held" if error == 0 else "not determined"
    digits = max(1 if 0 < abs(value) < 10 else 0, 1 - int(np.floor(np.log10(error))))
    if digits > 6 and abs(value) < 1e-4 or error >= 1e4:
        return f"{value:.3e}", f"{error:.1e}"
    return f"{value:.{digits}f}", f"{error:.{digits}f}"


def number(value: float) -> str:
    """Three digits, without exponent up to a million."""
    return f"{value:.0f}" if 100 <= abs(value) < 1e6 else f"{value:.3g}"
