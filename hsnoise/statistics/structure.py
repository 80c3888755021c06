"""About 300 variance-stabilised statistics of dark frames, by which a capture and a model's draws are compared.

Marginal histograms cannot separate row noise from white noise of the same variance; these statistics can. They are log
ratios of variances, artanh of correlations and square roots of rare counts, so their spread hardly depends on the
camera. Mostly correlations separate effects: between colours, frames, exposures, neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hsnoise.frames.stack import FrameStack
from hsnoise.statistics import _lines, _pixels, _views
from hsnoise.statistics._anova import Layout, analyse, check_size, layout_of, read_counts, shape_of, signal_of
from hsnoise.statistics._codes import code_step
from hsnoise.statistics._exposures import VARIANCE_FRAMES, Exposures, exposures_of, joined
from hsnoise.statistics._histograms import histogram_shape
from hsnoise.statistics._places import Places, places
from hsnoise.statistics._sheet import TINY_DN2, Entry, Sheet, gather

__all__ = ["Places", "SHORT", "Structure", "check_size", "code_step", "explained", "moving_line", "places", "structure"]


@dataclass(frozen=True, eq=False)
class Structure:
    """Statistics of one capture. Names, groups and order depend on sizes, colours and numbers of frames only.

    values [statistic]: finite. error [statistic]: rough standard error under independent pixels, a floor for the
    spread over a model's draws. skipped: sentences on what was left out, and why.
    """

    names: tuple[str, ...]
    groups: tuple[str, ...]
    values: np.ndarray
    error: np.ndarray
    skipped: tuple[str, ...]


BATCH_PIXELS = 1 << 20  # of the maps of exposures whose statistics are taken together
PIXELS_AT_WORK = 1 << 21  # of the frames read together
Statistics = tuple[Callable[[Sheet, Exposures], None], ...]
STATISTICS: Statistics = (
    _pixels.levels,
    _pixels.codes,
    _lines.variances,
    _lines.colours,
    _lines.together,
    _lines.scales,
    _lines.tilts,
    _lines.noise_of_rows,
    _lines.spectra,
    _pixels.lags,
    _pixels.tails,
    _pixels.frames_over_time,
    _pixels.blocks,
    _pixels.variance_over_time,
)

SHORT = "short exposures"
WORDS = {
    " exposures": "short and long exposures: means over the shorter and the longer half of the exposure times",
    " in band ": "bands: ranges of frequency over the rows or columns of a frame, from slow to fast",
    "row x frame": "row x frame, column x frame: means of rows or columns that are new in each frame",
    "responses:": "row responses, column responses: static lines of flats less the mean of those on both sides",
    "static map": "static map: mean over the frames, what stays in place",
    " / ": "a / b: logarithm of the ratio of their mean squares, 0 if independent pixel noise makes both",
    "residual": "residual: a pixel of a frame minus its row, column and mean over frames, in spreads of its row",
    "correlation, same ": "correlation, same row (column): of two colours that share a row (column) of the sensor",
    "read together": "read together: how much more a row resembles the next inside blocks of 2 to 16 rows than across"
    " their edges",
    "coherence": "coherence: how much of a frequency band the colours have in common",
    "strongest frequency": "strongest frequency: how much of the static rows (columns) is a single sine",
    "tilt of the frames": "tilt of the frames: how much of the slow course over the rows (columns) is one slope, new in"
    " each frame",
    "steps of ": "steps of n: how much the mean changes from n rows (columns) to the next n",
    "parity": "parity: even against odd rows (columns)",
    "kurtosis": "log kurtosis: weight of the tails, 0 for a normal distribution",
    "energy of ": "energy of blocks: scatter of the means of blocks of pixels",
    "left out": "codes left out: empty ones between codes that hold many counts",
    "roughness": "roughness: how much a histogram jumps from code to code",
}

# The statistics of flats that do not depend on the light (its level, flicker or shape, including dust), and what they
# are called there.
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
        "row responses",
        "column responses",
    )
}


@np.errstate(divide="ignore", invalid="ignore", over="ignore")  # what is not finite is 0: `_ordered`
def structure(stack: FrameStack, black_level_dn: np.ndarray) -> Structure:
    """The statistics of the exposures of a stack, darks and flats apart.

    Exposures are averaged over the shorter half and the longer half of the exposure times. A single exposure gives
    averages over all its frames; what persists is then compared between its even and odd frames.

    Args:
        stack: the capture.
        black_level_dn: black level [channel] or a scalar, DN.

    Raises:
        ValueError: no dark exposure, or frames smaller than 32 x 32 pixels.
    """
    layout = layout_of(stack)
    entries = _entries(stack, layout, black_level_dn, STATISTICS)
    if "flat" in stack.kind:
        lit = _entries(stack, layout_of(stack, "flat"), black_level_dn, (*STATISTICS, _lines.responses))
        entries |= {
            (OF_FLATS[group], what): entry
            for (group, what), entry in lit.items()
            if group in OF_FLATS and not entry.of_map
        }
    return _ordered(entries, layout)


def _entries(
    stack: FrameStack, layout: Layout, black_level_dn: np.ndarray, statistics: Statistics
) -> dict[tuple[str, str], Entry]:
    """Statistics of the exposures of a layout by (group, what); `statistics`: those that each has by itself."""
    n = len(layout.frames)
    halves = [int(i >= n // 2) if n > 1 else 0 for i in range(n)]
    names = ("short", "long") if n > 1 else ("even", "odd")
    sheets, found, outliers = [], {}, np.zeros(1, np.uint16)
    for numbers in _batches(layout):
        x = _read(stack, layout, numbers, black_level_dn)
        sheets.append(_sheet(x, layout.letters, numbers, statistics))
        found |= dict(zip(numbers, _kept(x, [halves[i] for i in numbers]), strict=True))
        if x.shape[1] >= VARIANCE_FRAMES:
            outliers = outliers + x.outliers.sum(0, dtype=np.uint16)
        del x
    kept = [found[i] for i in range(n)]
    spectra, views = [of.spectra for of in kept], [view for of in kept for view in of.views]
    entries: dict[tuple[str, str], Entry] = {}
    for half in sorted(set(halves)):
        some = [i for i in range(n) if halves[i] == half]
        entries |= gather(sheets, f"{names[half]} exposures" if n > 1 else "all frames", some)
        if n > 1:
            entries |= _peaks([spectra[i] for i in some], f"{names[half]} exposures")
    entries |= _peaks(spectra, "all exposures" if n > 1 else "all frames")
    entries |= _shares([of.profiles for of in kept])
    if len(views) > 1:
        entries |= _views.persistence(views, names)
    if max(layout.frames) > 1:
        entries["blocks", "peak of the static map's spectrum"] = Entry(_views.map_peak(views), 0.15)
    if max(layout.frames) >= VARIANCE_FRAMES:
        entries |= _views.outlier_counts(outliers)
    return entries | _curvature(kept, layout)


def _batches(layout: Layout) -> list[list[int]]:
    """Numbers of the exposures whose statistics are taken together: of as many frames, and of few pixels."""
    alike = ([i for i, n in enumerate(layout.frames) if n == frames] for frames in dict.fromkeys(layout.frames))
    return [numbers for some in alike for numbers in _pieces(some, BATCH_PIXELS // _pixels_of(layout))]


def _pieces(numbers: list[int], most: int) -> list[list[int]]:
    """Runs of at most `most` of the numbers, and of at least one."""
    most = max(most, 1)
    return [numbers[start : start + most] for start in range(0, len(numbers), most)]


def _pixels_of(layout: Layout) -> int:
    return (layout.rows.stop - layout.rows.start) * (layout.columns.stop - layout.columns.start)


def _read(stack: FrameStack, layout: Layout, numbers: list[int], black_level_dn: np.ndarray) -> Exposures:
    """Exposures with one number of frames, of which no frames are kept."""
    frames = layout.frames[numbers[0]]
    pieces = _pieces(numbers, PIXELS_AT_WORK // (frames * _pixels_of(layout)))
    work = np.empty((2, *shape_of(layout, pieces[0])), np.float32)
    found = []
    for some in pieces:
        spare, signal = work[:, : len(some)]
        counts = spare.view(np.int32)
        read_counts(stack, layout, some, counts)
        codes = np.array([[histogram_shape(plane, stack.white_level) for plane in planes] for planes in counts])
        signal_of(counts, layout, black_level_dn, signal)
        found.append(exposures_of(*analyse(signal), codes, spare, halves=len(layout.frames) == 1 < frames))
    return joined(found)


def _sheet(x: Exposures, letters: tuple[str, ...], numbers: list[int], statistics: Statistics) -> Sheet:
    """Statistics that exposures have each by itself."""
    sheet = Sheet(letters, numbers)
    for some in statistics:
        some(sheet, x)
    return sheet


@dataclass(frozen=True)
class Kept:
    """What is kept of one exposure besides its sheet; never its frames. mean [plane], DN; variance [plane], DN^2."""

    spectra: dict[str, np.ndarray]
    profiles: dict[str, np.ndarray]
    views: list[_views.View]
    mean: np.ndarray
    variance: np.ndarray


def _kept(x: Exposures, halves: list[int]) -> Iterator[Kept]:
    """Of each exposure; halves: which half it belongs to."""
    spectra, profiles = _lines.periodograms(x), _lines.static_profiles(x)
    views = [_views.even_and_odd(x)] if x.half_pixel.size else [[view] for view in _views.views_of(x, halves)]
    for i, own in enumerate(views):
        yield Kept(
            {group: values[i] for group, values in spectra.items()},
            {group: values[i] for group, values in profiles.items()},
            own,
            x.mean[i],
            x.variance[i],
        )


def _peaks(spectra: list[dict[str, np.ndarray]], half: str) -> dict[tuple[str, str], Entry]:
    """Highest lines of the periodograms averaged over exposures."""
    out = {}
    for group, mean in _averages(spectra).items():
        where = "row spectrum" if group == "row x frame" else group
        out[where, f"peak of the spectrum, {half}"] = Entry(_lines.peak(mean), 0.15)
    return out


def _shares(profiles: list[dict[str, np.ndarray]]) -> dict[tuple[str, str], Entry]:
    """How much one frequency has of the static rows and columns, averaged over exposures."""
    shares = {group: _lines.strongest_share(mean) for group, mean in _averages(profiles).items()}
    return {(group, "strongest frequency"): Entry(share, 0.15) for group, share in shares.items()}


def _averages(exposures: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Mean by group, over the exposures that have it: those of one frame have nothing static."""
    groups = dict.fromkeys(group for of in exposures for group in of)
    return {group: np.mean([of[group] for of in exposures if group in of], 0) for group in groups}


def explained(names: Iterable[str]) -> tuple[str, ...]:
    """Sentences on the words in names of statistics that are not plain."""
    text = "; ".join(names)
    return tuple(sentence for word, sentence in WORDS.items() if word in text)


def moving_line(stack: FrameStack, draws: Sequence[FrameStack], black_level_dn: np.ndarray) -> tuple[str, float]:
    """The strongest line that is new in each dark frame: over "row" or "column", and its frequency, cycles each.

    Strong is what exceeds the spectra of a model's `draws`: rows of a Bayer pattern with 1/f gains have a peak at
    half a cycle, as colours take turns.
    """
    layout = layout_of(stack)
    used = {"row": layout.rows, "column": layout.columns}

    def spectra(capture: FrameStack) -> dict[str, np.ndarray]:
        found = []
        for i in range(len(layout.frames)):
            counts = np.empty(shape_of(layout, [i]), np.int32)
            read_counts(capture, layout, [i], counts)
            found.append(_lines.periodograms(analyse(signal_of(counts, layout, black_level_dn))[0]))
        return {axis: np.concatenate([of[f"{axis} x frame"] for of in found]) for axis in used}

    step = 1 if layout.cfa == "mono" else 2
    expected = [spectra(drawn) for drawn in draws]
    found = []
    for axis, lines in spectra(stack).items():
        excess = (lines / np.mean([of[axis] for of in expected], 0)).mean(0)
        height, frequency = _lines.strongest_line(excess, (used[axis].stop - used[axis].start) // step * step)
        found.append((height, axis, frequency))
    _, axis, frequency = max(found)
    return axis, frequency


def _curvature(kept: list[Kept], layout: Layout) -> dict[tuple[str, str], Entry]:
    """How far mean and variance of the middle exposure lie off the line through the first and the last."""
    if len(kept) < 3:
        return {}
    middle = len(kept) // 2
    first, between, last = layout.exposure_s[[0, middle, -1]]
    share = (between - first) / (last - first) if last > first else 0.5
    mean, variance = (np.stack([getattr(kept[i], of) for i in (0, middle, -1)]) for of in ("mean", "variance"))
    size = np.array([layout.frames[i] for i in (0, middle, -1)])
    error = float(np.sqrt((len(layout.letters) / (size * _pixels_of(layout))).sum()))
    sheet = Sheet(layout.letters, [middle])
    bent = (mean[1] - (1 - share) * mean[0] - share * mean[2]) / np.sqrt(variance[1] + TINY_DN2)
    sheet.add_colours("level", "curvature of the mean over exposure", bent[None], error)
    bent = variance[1] / ((1 - share) * variance[0] + share * variance[2] + TINY_DN2)
    sheet.add_colours("noise", "curvature of the variance over exposure", bent[None], error * np.sqrt(2))
    return {key: Entry(value.item(), sheet.errors[key].item()) for key, value in sheet.values.items()}


def _ordered(entries: dict[tuple[str, str], Entry], layout: Layout) -> Structure:
    """All statistics, group by group; what is not finite has no meaning and is 0 in captures and draws alike."""
    keys = sorted(entries, key=lambda key: key[0])
    return Structure(
        names=tuple(f"{group}: {what}" for group, what in keys),
        groups=tuple(group for group, _ in keys),
        values=np.nan_to_num(np.array([entries[key].value for key in keys]), nan=0.0, posinf=0.0, neginf=0.0),
        error=np.array([max(entries[key].error, 1e-6) for key in keys]),
        skipped=layout.skipped + _too_few(layout),
    )


def _too_few(layout: Layout) -> tuple[str, ...]:
    """Sentences on the statistics that the numbers of frames and exposures do not allow."""
    frames, n = max(layout.frames), len(layout.frames)
    out = []
    if frames < 2:
        out.append("A single frame does not tell static patterns from noise: what needs two frames is left out.")
    elif frames < VARIANCE_FRAMES:
        out.append("Two frames do not give a variance over time for each pixel: what needs three frames is left out.")
    if 2 <= frames < 4:
        out.append("Flicker and drift are told apart from four frames on: their statistics are left out.")
    if n == 1 and frames // 2 < VARIANCE_FRAMES:
        out.append("Whether noisy pixels stay noisy needs two exposures or six frames: it is left out.")
    if n < 3:
        out.append("Whether mean and variance grow in proportion to exposure needs three exposures: it is left out.")
    return tuple(out)
