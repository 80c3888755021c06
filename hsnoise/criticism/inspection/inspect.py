"""What a capture is, before any fit: `inspect`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hsnoise._core import html as _html
from hsnoise._core.arguments import callback
from hsnoise._core.conclusion import Conclusion, Light
from hsnoise._core.data_frames import data_frame
from hsnoise._core.naming import setting
from hsnoise.criticism.budget import NoiseBudget, budget
from hsnoise.criticism.inspection._facts import Facts, GroupFacts, facts_of
from hsnoise.criticism.inspection._gain import about_gain, clipping, gain_of_flats
from hsnoise.criticism.inspection._odd import odd_frames
from hsnoise.criticism.inspection._register import about_register
from hsnoise.criticism.inspection._verdict import about_growth, about_shared_noise, judged
from hsnoise.frames.describing import levels_of, size_of
from hsnoise.frames.source import as_stack
from hsnoise.frames.stack import FrameStack
from hsnoise.statistics.decomposition import COMPONENTS, Component

MOST_ROWS = 12  # of the printed budget
HEADINGS = ("kind", "exposure / s", "frames", "degrees C", "level / DN", "noise / DN", "top 0.1 % / DN")
FALLS = 0.01  # of the signal: how far an overscan may follow the light before it is reported
FEW_CODES = 0.5  # DN of noise below which counts are too coarse


@dataclass(frozen=True)
class Inspection:
    """What the frames of a capture are; `print` it.

    Attributes:
        stack: the capture.
        groups: facts of each exposure group, those of flats elsewhere on the sensor last.
        findings: sentences about what is odd.
        determined: sentences about what can and cannot be determined.
        verdict: whether a fit makes sense, and why.
        fit_makes_sense: the same as a bool.
        next_capture: which capture is worth taking next.
        budget: the noise budget of a region of the frames; None if no frame can be used.
    """

    stack: FrameStack
    groups: tuple[GroupFacts, ...]
    findings: tuple[str, ...]
    determined: tuple[str, ...]
    verdict: str
    fit_makes_sense: bool
    next_capture: str
    budget: NoiseBudget | None

    @property
    def conclusion(self) -> Conclusion:
        """Whether a fit makes sense, and whether something about the frames is odd."""
        if not self.fit_makes_sense:
            return Conclusion(Light.RED, self.verdict)
        return Conclusion(Light.AMBER if self.findings else Light.GREEN, self.verdict)

    @property
    def parts(self) -> dict[str, tuple[str, ...]]:
        """The printed lines: capture, groups, what is odd, budget, what can be determined, what to capture next."""
        return {
            "capture": (size_of(self.stack), f"  {levels_of(self.stack)}"),
            "groups": _table(self.groups),
            "assumed": _listed("Read as", self.stack.assumed),
            "odd": _listed("Odd", self.findings) or ("Nothing odd was found.",),
            "budget": _noise_lines(self.budget),
            "determined": _listed("What can be determined", self.determined),
            "next": (f"Next: {self.next_capture}",),
        }

    def __str__(self) -> str:
        return "\n\n".join([str(self.conclusion), *("\n".join(part) for part in self.parts.values() if part)])

    __repr__ = __str__

    def to_pandas(self) -> Any:
        """`groups` as a pandas DataFrame: kind, exposure_s, frames, temperature_c, level_dn, noise_dn, hottest_dn (of
        0.1 % of the pixels, above the median) (needs `hsnoise[pandas]`).

        Raises ImportError without pandas.
        """
        columns = ("kind", "exposure_s", "frames", "temperature_c", "level_dn", "noise_dn", "hottest_dn")
        return data_frame(self, columns, map(_numbers, self.groups))

    def _repr_html_(self) -> str:
        title, heads, rows = _noise_table(self.budget)
        return _html.fragment(
            _html.conclusion(self.conclusion),
            _html.paragraph(f"{size_of(self.stack)}, {levels_of(self.stack)}"),
            _html.sentences(self.findings, "Odd:"),
            _html.table(HEADINGS, map(_cells, self.groups), words=("kind",)),
            _html.paragraph(f"Next: {self.next_capture}"),
            _html.details("What can be determined", _html.sentences(self.determined)),
            _html.details("Read as", _html.sentences(self.stack.assumed)),
            _html.details(title, _html.table(heads, rows, words=("",)) if rows else ""),
        )


def inspect(path_or_stack: Any, *, progress=None, **keywords: Any) -> Inspection:
    """Look at a capture before any fit: what its frames are, which are odd, and what can be determined from them.

    Every frame is read once; noise and budget are those of a region in the middle if the frames are large.

    Args:
        path_or_stack: what `load` reads, or a FrameStack, or an array of counts with FrameStack's keywords.
        progress: called with no argument after each frame.
        keywords: those of `load` for a path, those of FrameStack for an array.

    Raises:
        FileNotFoundError, TypeError, ValueError: as `load` or `FrameStack` raise. Frames with wrong values are reported
            instead.
    """
    tick = callback("progress", progress)
    stack = as_stack(path_or_stack, **keywords)
    facts = facts_of(stack, tick)
    elsewhere = None if stack.elsewhere is None else facts_of(stack.elsewhere, tick)
    main_budget, other_budget = _budget(facts), _budget(elsewhere)
    gain = gain_of_flats(main_budget, main_budget, facts)
    if gain is None and elsewhere is not None:
        gain = gain_of_flats(main_budget, other_budget, elsewhere)
    groups = facts.groups + (elsewhere.groups if elsewhere is not None else ())
    is_mosaic = any(group.mosaic for group in groups)
    found = judged(facts, elsewhere, main_budget, gain, is_mosaic=is_mosaic, knows_black=stack.black_level is not None)
    of_register = about_register(facts)
    findings = [
        *of_register,
        *odd_frames(facts, multiplies=bool(of_register)),
        *(odd_frames(elsewhere) if elsewhere is not None else []),
        *clipping(groups, stack.white_level is not None),
        *_coarse(groups),
        *_overscan(stack, facts),
        *about_growth(main_budget),
        *about_shared_noise(main_budget),
        *about_gain(gain, stack.stated_gain),
    ]
    if is_mosaic:
        findings.append(
            "Read as mono, but the pixels of each 2 x 2 block differ: a colour sensor?"
            f" If so, give its Bayer order, for example {setting('cfa', 'RGGB')}"
        )
    return Inspection(
        stack=stack,
        groups=groups,
        findings=tuple(findings),
        determined=found.determined,
        verdict=found.verdict,
        fit_makes_sense=found.fit_makes_sense,
        next_capture=found.next_capture,
        budget=main_budget,
    )


def _budget(facts: Facts | None) -> NoiseBudget | None:
    return None if facts is None or facts.region is None else budget(facts.region)


def _coarse(groups: tuple[GroupFacts, ...]) -> list[str]:
    """Counts scaled up from fewer bits, and noise of less than a count."""
    said = []
    steps = {group.step_dn for group in groups}
    if len(steps) == 1 and max(steps) > 1:
        said.append(f"All counts are multiples of {max(steps)}, apart from an offset: scaled up from fewer bits")
    fine = [group for group in groups if group.kind == "dark" and group.temporal_dn < FEW_CODES]
    if fine:
        said.append(
            f"The noise of the {fine[0].name} is {fine[0].temporal_dn:.2g} DN, less than a step between counts:"
            " read noise will be an upper bound"
        )
    return said


def _overscan(stack: FrameStack, facts: Facts) -> list[str]:
    """A black level that follows the light, as the overscan shows."""
    if stack.overscan_dn is not None:
        overscan = stack.overscan_dn[: len(facts.groups)]
    else:
        overscan = np.array([np.mean([frame.overscan_dn for frame in group.frames]) for group in facts.groups])
    levels = np.array([group.level_dn for group in facts.groups])
    known = np.isfinite(overscan)
    if known.sum() < 2:
        return []
    dim, bright = (
        int(pick(np.where(known, levels, value))) for pick, value in ((np.argmin, np.inf), (np.argmax, -np.inf))
    )
    moved, signal = overscan[bright] - overscan[dim], levels[bright] - levels[dim]
    if abs(moved) <= FALLS * signal:
        return []
    what = "falls" if moved < 0 else "rises"
    return [
        f"The overscan {what} from {overscan[dim]:.0f} to {overscan[bright]:.0f} DN as the level rises from"
        f" {levels[dim]:.0f} to {levels[bright]:.0f} DN: the black level depends on the signal"
    ]


def _numbers(group: GroupFacts) -> tuple[str, float, int, float, float, float, float]:
    levels = group.level_dn, group.temporal_dn, group.hot_dn
    return group.kind, group.exposure_s, group.n_frames, group.temperature_c, *levels


def _cells(group: GroupFacts) -> tuple[str, ...]:
    """The values of a group under HEADINGS, as text."""
    kind, exposure_s, n_frames, temperature_c, level_dn, noise_dn, hot_dn = _numbers(group)
    temperature = "-" if np.isnan(temperature_c) else f"{temperature_c:.1f}"
    noise = "-" if np.isnan(noise_dn) else f"{noise_dn:.4g}"
    return kind, f"{exposure_s:.6g}", f"{n_frames}", temperature, f"{level_dn:.2f}", noise, f"+{hot_dn:.4g}"


def _table(groups: tuple[GroupFacts, ...]) -> tuple[str, ...]:
    """Headings and a line for each group, in columns at least as wide as the headings."""
    widths = [len(heading) for heading in HEADINGS[1:]]
    return tuple(
        f"{kind}   " + "  ".join(f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True))
        for kind, *cells in (HEADINGS, *map(_cells, groups))
    )


def _noise_table(found: NoiseBudget | None) -> tuple[str, tuple[str, ...], list[tuple[str, ...]]]:
    """The budget as standard deviations, for groups with several frames: title, headings, rows."""
    rows = [] if found is None else [row for row in found.rows if row.n_frames > 1]
    has_colours = len({row.channel for row in rows}) > 1
    shown = [rows[i] for i in np.unique(np.linspace(0, len(rows) - 1, min(MOST_ROWS, len(rows))).astype(int))]
    some = f" ({len(shown)} of {len(rows)} lines)" if len(shown) < len(rows) else ""
    names = [f"{row.kind} {row.exposure_s:.6g} s" + (f" {row.channel}" if has_colours else "") for row in shown]
    cells = [
        (name, *(_cell(row.components[one]) for one in COMPONENTS)) for name, row in zip(names, shown, strict=True)
    ]
    heads = ("", *(name.replace("_", " ") for name in COMPONENTS))
    return f"Noise budget, standard deviations in DN{some}", heads, cells


def _noise_lines(found: NoiseBudget | None) -> tuple[str, ...]:
    title, heads, rows = _noise_table(found)
    if not rows:
        return ()
    width = max(22, *(len(name) + 2 for name, *_ in rows))
    lines = (f"{name:{width}}" + "".join(f"{cell:>16}" for cell in cells) for name, *cells in (heads, *rows))
    return (f"{title}:", *lines)


def _cell(component: Component) -> str:
    """Standard deviation, DN, or its upper bound."""
    value, error = component.variance_dn2, component.standard_error_dn2
    if not np.isfinite(value):
        return "-"
    bound = f"< {np.sqrt(max(value, 0.0) + 2 * error):.2g}"
    return bound if value < 2 * error else f"{np.sqrt(value):.3g}"


def _listed(title: str, sentences: tuple[str, ...]) -> tuple[str, ...]:
    return (f"{title}:", *(f"- {one}" for one in sentences)) if sentences else ()
