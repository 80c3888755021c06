"""Figures of a fit and of the loop: functions that return a `matplotlib.figure.Figure`, without pyplot.

May import fits and what they may import; is imported only when a figure is drawn.
"""

from __future__ import annotations

from hsnoise.plots._budget import budget
from hsnoise.plots._criticism import comparison, ranking, story
from hsnoise.plots._histograms import histograms
from hsnoise.plots._of_fit import of_fit
from hsnoise.plots._photon_transfer import photon_transfer
from hsnoise.plots._pixel_map import pixel_map
from hsnoise.plots._pixel_transfer import pixel_transfer
from hsnoise.plots._residuals import residuals
from hsnoise.plots._row_spectrum import row_spectrum
from hsnoise.plots._sampled import dark_current

__all__ = [
    "budget",
    "comparison",
    "dark_current",
    "histograms",
    "of_fit",
    "photon_transfer",
    "pixel_map",
    "pixel_transfer",
    "ranking",
    "residuals",
    "row_spectrum",
    "story",
]
