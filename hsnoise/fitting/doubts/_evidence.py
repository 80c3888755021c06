"""The basis for the checks of a fit: the survey of the frames, and pixels over time, each measured once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from hsnoise.fitting.pixel_fit import PixelFit, measure
from hsnoise.likelihood.summary import Summary
from hsnoise.statistics.pixels.survey import Survey


@dataclass(frozen=True)
class Evidence:
    """The survey of a capture, or of a part of it, and the summary that the fit was made from."""

    survey: Survey
    summary: Summary

    @cached_property
    def darks(self) -> PixelFit:
        """Pixel transfer of the darks, ignoring the flats."""
        return measure(self.survey, replace(self.summary, flats=None))

    def measured(self, whole: Survey) -> PixelFit:
        """What `measure` finds in a survey of the whole capture, flats included."""
        return self.darks if whole is self.survey and self.summary.flats is None else measure(whole, self.summary)
