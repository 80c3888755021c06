"""All figures of a fit."""

from __future__ import annotations

from matplotlib.figure import Figure

from hsnoise.fitting.result import Method
from hsnoise.plots._histograms import histograms
from hsnoise.plots._photon_transfer import has_photon_transfer, photon_transfer
from hsnoise.plots._pixel_map import pixel_map
from hsnoise.plots._pixel_transfer import pixel_transfer, transfers_of
from hsnoise.plots._row_spectrum import has_row_spectrum, row_spectrum
from hsnoise.plots._sampled import dark_current


def of_fit(fit) -> dict[str, Figure]:
    """The figures of a fit by name, as far as its frames and method allow.

    A fit of several effects by simulated statistics has none: the figures would lack the added effects.

    Args:
        fit: result of `hsnoise.fit`.
    """
    if fit.method == Method.SYNTHETIC:
        return {}
    conditional = fit.transfer is not None
    drawings = {
        "photon_transfer": (photon_transfer, has_photon_transfer(fit)),
        "histograms": (histograms, bool(fit.summary.histograms)),
        "row_spectrum": (row_spectrum, has_row_spectrum(fit)),
        "pixel_transfer": (pixel_transfer, fit.has_gain and bool(transfers_of(fit))),
        "dark_current": (dark_current, fit.has_gain and bool(transfers_of(fit))),
        "pixel_map": (pixel_map, conditional and max(fit.summary.n_frames, default=0) > 1 and fit.pixels.flags.any()),
    }
    return {name: draw(fit) for name, (draw, there) in drawings.items() if there}
