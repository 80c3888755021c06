"""About 300 variance-stabilised statistics of dark frames, by which a capture and a model's draws are compared.

Marginal histograms cannot separate row noise from white noise of the same variance; these statistics can. They are log
ratios of variances, artanh of correlations and square roots of rare counts, so their spread hardly depends on the
camera. Mostly correlations separate effects: between colours, frames, exposures, neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from hsnoise.frames.stack import FrameStack
from hsnoise.statistics import _lines, _pixels, _views
from hsnoise.statistics._anova import Exposure, Layout, check_size, layout_of, read_exposure
from hsnoise.statistics._codes import code_step
from hsnoise.statistics._places import places
from hsnoise.statistics._sheet import TINY_DN2, Entry, Sheet, gather

__all__ = ["SHORT", "Structure", "check_size", "code_step", "explained", "moving_line", "places", "structure"]


@dataclass(frozen=True, eq=False)
class Structure:
    """Statistics of one capture. Names, groups and order depend only on sizes, colours and numbers of frames.

    values [statistic]: finite. error [statistic]: rough standard error for independent pixels, a floor for the
    spread over a model's draws. skipped: sentences on what was left out and why.
    """

    names: tuple[str, ...]
    groups: tuple[str, ...]
    values: np.ndarray
    error: np.ndarray
    skipped: tuple[str, ...]


SHORT = "short exposures"
WORDS = {
    " exposures": "short and long exposures: means over the shorter and the longer half of the exposure times",
    " in band ": "bands: ranges of frequency over the rows or columns of a frame, from slow to fast",
    "row x frame": "row x frame, column x frame: means of rows or columns that are new in each frame",
    "static map": "static map: mean over the frames, what stays in place",
    " / ": "a / b: logarithm of the ratio of their mean squares, 0 if independent pixel noise makes both",
    "residual": "residual: a pixel of a frame minus its row, column and mean over frames, in spreads of its row",
    "correlation, same ": "correlation, same row (column): of two colours that share a row (column) of the sensor",
    "coherence": "coherence: how much of a frequency band the colours have in common",
    "strongest frequency": "strongest frequency: how much of the static rows (columns) is a single sine",
    "steps of ": "steps of n: how much the mean changes from n rows (columns) to the next n",
    "parity": "parity: even against odd rows (columns)",
    "kurtosis": "log kurtosis: weight of the tails, 0 for a normal distribution",
    "energy of ": "energy of blocks: scatter of the means of blocks of pixels",
    "roughness": "roughness: how much a histogram jumps from code to code",
}

# What flats tell whatever the light, and what it is called there: neither the light's level, its flicker nor its shape,
# to which dust belongs.
OF_FLATS = {
    group: f"flats, {group}"
    for group in (
        "noise",
        "static pixels",
        "pixels over time",
        "spatial lags",
        "tails",
        "row x frame",
        "column x frame",
    )
}


@np.errstate(divide="ignore", invalid="ignore", over="ignore")  # `_ordered` replaces non-finite values by 0
def structure(stack: FrameStack, black_level_dn: np.ndarray) -> Structure:
    """The statistics of the exposures of a stack, darks and flats separately.

    They are averaged over the shorter and the longer half of the exposure times. A single exposure is averaged over all
    its frames; persistence is then judged from its even and odd frames.

    Args:
        stack: the capture.
        black_level_dn: black level [channel] or a scalar, DN.

    Raises:
        ValueError: no dark exposure, or frames smaller than 32 x 32 pixels.
    """
    layout = layout_of(stack)
    entries = _entries(stack, layout, black_level_dn)
    if "flat" in stack.kind:
        lit = _entries(stack, layout_of(stack, "flat"), black_level_dn)
        entries |= {
            (OF_FLATS[group], what): entry
            for (group, what), entry in lit.items()
            if group in OF_FLATS and not entry.of_map
        }
    return _ordered(entries, layout)


def _entries(stack: FrameStack, layout: Layout, black_level_dn: np.ndarray) -> dict[tuple[str, str], Entry]:
    """Statistics of the exposures of a layout by (group, what)."""
    n = len(layout.frames)
    halves = [int(i >= n // 2) if n > 1 else 0 for i in range(n)]
    names = ("short", "long") if n > 1 else ("even", "odd")
    capture = _Capture([], [], [], [], [], np.zeros(1, np.uint16))
    for number in range(n):
        x = read_exposure(stack, layout, number, black_level_dn)
        capture.add(x, layout, halves[number], stack.white_level, alone=n == 1)
    entries: dict[tuple[str, str], Entry] = {}
    for half in sorted(set(halves)):
        some = [i for i in range(n) if halves[i] == half]
        entries |= gather([capture.sheets[i] for i in some], f"{names[half]} exposures" if n > 1 else "all frames")
        if n > 1:
            entries |= _peaks([capture.spectra[i] for i in some], f"{names[half]} exposures")
    entries |= _peaks(capture.spectra, "all exposures" if n > 1 else "all frames")
    entries |= _shares(capture.profiles)
    if len(capture.views) > 1:
        entries |= _views.persistence(capture.views, names)
    if max(layout.frames) > 1:
        entries["blocks", "peak of the static map's spectrum"] = Entry(_views.map_peak(capture.views), 0.15)
    if max(layout.frames) > 2:
        entries |= _views.outlier_counts(capture.outliers)
    return entries | _curvature(capture.exposures, layout)


@dataclass
class _Capture:
    """The statistics of the exposures read so far, without their frames."""

    sheets: list[Sheet]
    spectra: list[dict[str, np.ndarray]]
    profiles: list[dict[str, np.ndarray]]
    views: list[_views.View]
    exposures: list[tuple[np.ndarray, np.ndarray]]
    outliers: np.ndarray

    def add(self, x: Exposure, layout: Layout, half: int, white_level: float | None, *, alone: bool) -> None:
        sheet = Sheet(layout.letters)
        _pixels.levels(sheet, x, white_level)
        _lines.variances(sheet, x)
        _lines.colours(sheet, x)
        _lines.scales(sheet, x)
        _lines.noise_of_rows(sheet, x)
        _lines.spectra(sheet, x)
        _pixels.lags(sheet, x)
        _pixels.tails(sheet, x)
        _pixels.frames_over_time(sheet, x)
        _pixels.blocks(sheet, x)
        log_variance = None
        if x.shape[1] >= _views.VARIANCE_FRAMES:
            log_variance = _pixels.log_temporal_variance(x.residual)
            _pixels.variance_over_time(sheet, x, log_variance)
            self.outliers = self.outliers + _views.outliers_of(x)
        self.sheets.append(sheet)
        self.spectra.append(_lines.periodograms(x))
        self.profiles.append(_lines.static_profiles(x))
        self.exposures.append((x.mean, x.variance))
        self.views.extend(
            _views.even_and_odd(x) if alone and x.shape[1] > 1 else [_views.view_of(x, half, log_variance)]
        )


def _peaks(spectra: list[dict[str, np.ndarray]], half: str) -> dict[tuple[str, str], Entry]:
    """Highest peaks of the periodograms, averaged over exposures."""
    out = {}
    for group, mean in _averages(spectra).items():
        where = "row spectrum" if group == "row x frame" else group
        out[where, f"peak of the spectrum, {half}"] = Entry(_lines.peak(mean), 0.15)
    return out


def _shares(profiles: list[dict[str, np.ndarray]]) -> dict[tuple[str, str], Entry]:
    """The strongest frequency's share of static rows and columns, averaged over exposures."""
    shares = {group: _lines.strongest_share(mean) for group, mean in _averages(profiles).items()}
    return {(group, "strongest frequency"): Entry(share, 0.15) for group, share in shares.items()}


def _averages(exposures: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Mean by group over the exposures that have it: single frames have no static part."""
    groups = dict.fromkeys(group for of in exposures for group in of)
    return {group: np.mean([of[group] for of in exposures if group in of], 0) for group in groups}


def explained(names: Iterable[str]) -> tuple[str, ...]:
    """Sentences that explain the technical words in names of statistics."""
    text = "; ".join(names)
    return tuple(sentence for word, sentence in WORDS.items() if word in text)


def moving_line(stack: FrameStack, draws: Sequence[FrameStack], black_level_dn: np.ndarray) -> tuple[str, float]:
    """The strongest spectral line that is new in each dark frame: "row" or "column", and its frequency in cycles each.

    Strength is relative to the spectra of a model's `draws`: rows of a Bayer pattern with 1/f gains have a peak at
    half a cycle, because colours alternate.
    """
    layout = layout_of(stack)
    used = {"row": layout.rows, "column": layout.columns}

    def spectra(capture: FrameStack) -> dict[str, np.ndarray]:
        read = (read_exposure(capture, layout, i, black_level_dn) for i in range(len(layout.frames)))
        found = [_lines.periodograms(x) for x in read]
        return {axis: np.stack([of[f"{axis} x frame"] for of in found]) for axis in used}

    step = 1 if layout.cfa == "mono" else 2
    expected = [spectra(drawn) for drawn in draws]
    found = []
    for axis, lines in spectra(stack).items():
        excess = (lines / np.mean([of[axis] for of in expected], 0)).mean(0)
        height, frequency = _lines.strongest_line(excess, (used[axis].stop - used[axis].start) // step * step)
        found.append((height, axis, frequency))
    _, axis, frequency = max(found)
    return axis, frequency


def _curvature(exposures: list[tuple[np.ndarray, np.ndarray]], layout: Layout) -> dict[tuple[str, str], Entry]:
    """Distance of the middle exposure's mean and variance from the straight line through the first and the last."""
    if len(exposures) < 3:
        return {}
    middle = len(exposures) // 2
    first, between, last = layout.exposure_s[[0, middle, -1]]
    share = (between - first) / (last - first) if last > first else 0.5
    (mean0, variance0), (mean1, variance1), (mean2, variance2) = (exposures[i] for i in (0, middle, -1))
    size = np.array([layout.frames[i] for i in (0, middle, -1)])
    pixels = (layout.rows.stop - layout.rows.start) * (layout.columns.stop - layout.columns.start)
    error = float(np.sqrt((len(layout.letters) / (size * pixels)).sum()))
    sheet = Sheet(layout.letters)
    bent = (mean1 - (1 - share) * mean0 - share * mean2) / np.sqrt(variance1 + TINY_DN2)
    sheet.add_colours("level", "curvature of the mean over exposure", bent, error)
    bent = variance1 / ((1 - share) * variance0 + share * variance2 + TINY_DN2)
    sheet.add_colours("noise", "curvature of the variance over exposure", bent, error * np.sqrt(2))
    return sheet.entries


def _ordered(entries: dict[tuple[str, str], Entry], layout: Layout) -> Structure:
    """All statistics, group by group; non-finite values carry no information and become 0 in captures and draws."""
    keys = sorted(entries, key=lambda key: key[0])
    return Structure(
        names=tuple(f"{group}: {what}" for group, what in keys),
        groups=tuple(group for group, _ in keys),
        values=np.nan_to_num(np.array([entries[key].value for key in keys]), nan=0.0, posinf=0.0, neginf=0.0),
        error=np.array([max(entries[key].error, 1e-6) for key in keys]),
        skipped=layout.skipped + _too_few(layout),
    )


def _too_few(layout: Layout) -> tuple[str, ...]:
    """Sentences on statistics that need more frames or exposures."""
    frames, n = max(layout.frames), len(layout.frames)
    out = []
    if frames < 2:
        out.append("A single frame cannot separate static patterns from noise: statistics of two frames are left out.")
    elif frames < _views.VARIANCE_FRAMES:
        out.append("Two frames give no variance over time for each pixel: statistics of three frames are left out.")
    if 2 <= frames < 4:
        out.append("Separating flicker from drift takes four frames: their statistics are left out.")
    if n == 1 and frames // 2 < _views.VARIANCE_FRAMES:
        out.append("Testing whether noisy pixels stay noisy takes two exposures or six frames: this is left out.")
    if n < 3:
        out.append(
            "Testing whether mean and variance are proportional to exposure takes three exposures: this is left out."
        )
    return tuple(out)
