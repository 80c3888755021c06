"""Waves that cross the frame obliquely and move from frame to frame: a sharp point in a spectrum of two directions."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np
import scipy

from hsnoise._core.robust import robust_sigma
from hsnoise._core.types import cfa_tile
from hsnoise.frames.stack import FrameStack

MOST_SIDE, MOST_FRAMES = 512, 16  # of the middle of the frames that is looked at
LEAST_SIDE = 64
CORE_SIGMAS = 4.0  # outliers are clipped there
LEAST_CYCLES = 4  # in the part that is looked at: slower ones along an axis are bands, or drifts
NEAR, AROUND = 3, 12  # points of the spectrum that belong to a wave, and among which it stands out
SHARP, SHARP_BESIDE = 30.0, 8.0  # times the power around it; beside one that is there
RARE = 1e-3  # probability that a point of a spectrum of noise stands out
MOST_WAVES, MOST_TAKEN = 24, 4  # that a model has, and that are taken off where neighbours are compared
BLOCK = (64, 256)  # rows and columns over which a wave keeps its frequency as it was measured
ALIKE = 2.0  # times the least noise, beyond which exposures tell nothing


class Spectrum(NamedTuple):
    """Power of what changes between frames, DN^2 [row frequency, column frequency], and its mean square, over frames.

    A wave of amplitude A has a power of A^2 / 4 at its place. shape: rows and columns that were looked at; cell: side
    of a cell of the colour filter array.
    """

    power: np.ndarray
    square: np.ndarray
    n_frames: int
    shape: tuple[int, int]
    cell: int


class Wave(NamedTuple):
    """A sinusoid across the frame: cycles per row and per column, and its variance with its error, DN^2."""

    row_frequency: float
    column_frequency: float
    variance_dn2: float
    error_dn2: float


def middle_of_frame(frame: np.ndarray) -> np.ndarray:
    """The part of a frame that is looked at: even sides, cells of the colour filter array whole."""
    spans = []
    for size in frame.shape:
        first = max((size - MOST_SIDE) // 4 * 2, 0)
        spans.append(slice(first, first + min(size, MOST_SIDE) // 2 * 2))
    return frame[tuple(spans)].copy()


def spectrum_of(parts: Sequence[np.ndarray], cell: int) -> Spectrum | None:
    """The spectrum of the middles of frames of one exposure; None of one frame, and of small ones.

    cell: as in Spectrum.
    """
    if len(parts) < 2 or min(parts[0].shape) < LEAST_SIDE:
        return None
    left = np.stack(parts).astype(np.float32)
    left -= left.mean(0)
    left *= np.sqrt(len(left) / (len(left) - 1))
    width = CORE_SIGMAS * robust_sigma(left)
    np.clip(left, -width, width, out=left)
    left -= left.mean(1, keepdims=True)
    left -= left.mean(2, keepdims=True)
    window = np.outer(*(np.hanning(n + 1)[:-1] for n in left.shape[1:])).astype(np.float32)
    power = np.square(np.abs(scipy.fft.rfft2(left * window))) / float(window.sum()) ** 2
    return Spectrum(power.mean(0), np.square(power).mean(0), len(left), left.shape[1:], cell)


def waves_of(spectra: Sequence[Spectrum]) -> tuple[Wave, ...]:
    """The waves in exposures of a sensor, the strongest first; none if no point of their spectrum stands out.

    A clock that couples in brings its harmonics. Beside a first wave, weaker ones are taken as far as chance allows.
    """
    if not spectra:
        return ()
    usual = [float(np.median(one.power)) for one in spectra]
    alike = [one for one, of in zip(spectra, usual, strict=True) if of <= ALIKE * min(usual)]
    weights = np.array([one.n_frames for one in alike], float)
    power, square = (np.average([of[i] for of in alike], 0, weights) for i in (0, 1))
    (rows, columns), cell = alike[0].shape, alike[0].cell
    slow = _is_slow(np.fft.fftfreq(rows), rows, cell)[:, None] | _is_slow(np.fft.rfftfreq(columns), columns, cell)
    seen = np.where(slow, 0.0, power)
    floor, free, found = float(np.median(power)), seen > 0, []
    chance = _by_chance(int((weights - 1).sum()), power.size)
    sharp = max(SHARP, chance)
    while len(found) < MOST_WAVES:
        r, c = (int(i) for i in np.unravel_index(int(np.where(free, seen, 0.0).argmax()), seen.shape))
        around = max(_beside(seen[:, c], r, wraps=True), _beside(seen[r], c, wraps=False))
        near = np.take(power[:, max(c - 1, 0) : c + 2], [r - 1, r, r + 1], axis=0, mode="wrap")
        if not seen[r, c] > sharp * max(around, floor):
            break
        if near.max() <= power[r, c]:  # else it may be the foot of a band's peak, or of another wave's
            found.append(_wave_at(power, square, r, c, around, weights))
        elif not found:
            break
        beside = np.arange(-NEAR, NEAR + 1)
        of_columns = np.arange(max(c - NEAR, 0), min(c + NEAR + 1, free.shape[1]))
        free[(r + beside[:, None]) % rows, of_columns] = False
        if c + NEAR >= free.shape[1]:  # of half a cycle per column, the mirror image is the same wave
            free[(beside[:, None] - r) % rows, of_columns] = False
        sharp = max(SHARP_BESIDE, chance)
    return tuple(found)


def _by_chance(frames: int, points: int) -> float:
    """Power of noise over its median that hardly any of so many points reaches, in the mean of so many spectra."""
    law = scipy.stats.gamma(max(frames, 1))
    return float(law.isf(RARE / points) / law.median())


def _wave_at(power: np.ndarray, square: np.ndarray, r: int, c: int, around: float, weights: np.ndarray) -> Wave:
    """The wave at a point of the spectrum, beside which the power is `around`; weights: numbers of frames."""
    rows, columns = len(power), 2 * (power.shape[1] - 1)
    row = _off(np.take(power[:, c], [r - 1, r, r + 1], mode="wrap"))
    column = _off(power[r, c - 1 : c + 2]) if c < power.shape[1] - 1 else 0.0
    # Alternating signs are one wave; any other is the sum of two that turn in opposite senses.
    is_real = c == power.shape[1] - 1 and 2 * r == rows
    size = (1.0 if is_real else 2.0) / (_seen(row) * _seen(column))
    scatter = np.sqrt(max(float(square[r, c] - power[r, c] ** 2), 0.0) / max(weights.sum() - 1, 1))
    # What n random phases leave of a wave's power in the differences from their mean scatters by 1 / (n - 1).
    of_phases = power[r, c] * np.sqrt(np.sum((weights / (weights - 1)) ** 2)) / weights.sum()
    error = size * max(scatter, of_phases)
    frequency = (float(r) + row) / rows
    return Wave(frequency - (frequency > 0.5), (float(c) + column) / columns, size * (power[r, c] - around), error)


def over_first(waves: Sequence[Wave]) -> tuple[tuple[float, float, float], ...]:
    """Amplitude over that of the first, cycles per row and cycles per column of each."""
    return tuple(
        (float(np.sqrt(max(wave.variance_dn2 / waves[0].variance_dn2, 0.0))), wave.row_frequency, wave.column_frequency)
        for wave in waves
    )


def _is_slow(frequency: np.ndarray, lines: int, cell: int) -> np.ndarray:
    """Which frequencies are hardly more than none, or in pixels of one colour look so: they are bands, or offsets."""
    turns = frequency * cell
    return np.abs(turns - np.rint(turns)) * lines < LEAST_CYCLES * cell


def waves_in(stack: FrameStack) -> tuple[Wave, ...]:
    """The waves in the darks of a stack, of which a few frames are read, the strongest first."""
    spectra = []
    for i, kind in enumerate(stack.kind):
        if kind == "dark":
            parts = [middle_of_frame(frame) for frame in islice(stack.frames(i), MOST_FRAMES)]
            spectra.append(spectrum_of(parts, len(cfa_tile(stack.cfa))))
    return waves_of([one for one in spectra if one is not None])


def _beside(line: np.ndarray, at: int, *, wraps: bool) -> float:
    """The usual power beside a point of a line of the spectrum."""
    places = np.concatenate([np.arange(at - AROUND, at - NEAR), np.arange(at + NEAR + 1, at + AROUND + 1)])
    places = places % len(line) if wraps else places[(places >= LEAST_CYCLES) & (places < len(line))]
    values = line[places]
    return float(np.median(values[values > 0])) if (values > 0).any() else 0.0


def _off(three: np.ndarray) -> float:
    """How far from the middle of three points of the power of a windowed sinusoid its frequency lies."""
    before, middle, after = np.sqrt(np.maximum(three, 0))
    # The ratio of the two largest amplitudes under a Hann window (Grandke, IEEE Trans. Instrum. Meas. 32, 1983).
    ratio = max(before, after) / middle
    return float(np.copysign(np.clip((2 * ratio - 1) / (ratio + 1), 0, 0.5), after - before))


def _seen(off: float) -> float:
    """The share of the power of a windowed sinusoid in the point so far from its frequency."""
    return float((np.sinc(off) / (1 - off**2)) ** 2)


def without_waves(change: np.ndarray, waves: Sequence[Wave], rows: np.ndarray) -> np.ndarray:
    """Differences of frames [frame, row, column] less the strongest waves; rows: their numbers on the sensor.

    In blocks, so that a frequency that is slightly off does no harm.
    """
    left, strongest = change.copy(), waves[:MOST_TAKEN]
    if not strongest:
        return left
    for top in range(0, change.shape[1], BLOCK[0]):
        for first in range(0, change.shape[2], BLOCK[1]):
            at = (slice(None), slice(top, top + BLOCK[0]), slice(first, first + BLOCK[1]))
            part = change[at]
            both = []
            for wave in strongest:
                down, across = rows[at[1]] * wave.row_frequency, np.arange(first, first + part.shape[2])
                turns = 2 * np.pi * (down[:, None] + across * wave.column_frequency).ravel()
                both += [np.cos(turns), np.sin(turns)]
            waving = np.stack(both, 1)
            sizes = np.linalg.lstsq(waving, part.reshape(len(part), -1).T, rcond=1e-6)[0]
            left[at] -= (waving @ sizes).T.reshape(part.shape).astype(left.dtype)
    return left
