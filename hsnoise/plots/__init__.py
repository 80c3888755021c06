"""Figures of a fit and of the loop: functions that return a `matplotlib.figure.Figure`, without pyplot."""

from __future__ import annotations

from hsnoise.plots._criticism import comparison, ranking, story
from hsnoise.plots._histograms import histograms
from hsnoise.plots._photon_transfer import photon_transfer
from hsnoise.plots._row_spectrum import row_spectrum

__all__ = ["comparison", "histograms", "photon_transfer", "ranking", "row_spectrum", "story"]
