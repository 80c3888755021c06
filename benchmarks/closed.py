"""How well a model closed with measured components stands for real sensors: python -m benchmarks.closed

Every second dark frame of each exposure makes the model, the others judge it. For each sensor: the error of `compare`,
the largest part of the variance that stays unexplained, and whether a classifier (boosted trees on features of 24 x 24
patches, trained and tested on different ones) tells drawn frames from held-out ones: the area under its ROC curve, 0.5
if it cannot. Beside it the same for normal noise of the same mean and variance, and for the frames of the model.

Needs the extra `closed` (scikit-learn) and the captures of shared/.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import hsnoise
from benchmarks._real_folders import IMX, STL, STL_DARKS, TC, copied, data_folder, emva, unpacked
from hsnoise._core.sheet import Sheet
from hsnoise.criticism.closing import closed
from hsnoise.simulation.draws import draw_capture

PATCHES, SIDE = 600, 24
ROWS, COLUMNS = 400, 1200  # of larger frames the middle
SENSORS: dict[str, Callable[[Path, Path], None]] = {
    "STL-1001": unpacked(STL, STL_DARKS),
    "IMX541": unpacked(IMX, "dark"),
    "TC-237": unpacked(TC, "bias"),
    "sbig_st8_cc0": copied("sbig_st8_cc0", "dark25s", "darkflat3s"),
    "ccd_kaf_mit": copied("ccd_kaf_mit", "bias"),
    "site_2k_ccd": copied("site_2k_ccd", "bias"),
    "EMVA 1288 001": emva("001_CCD_12Bit"),
    "EMVA 1288 002": emva("002_CMOS_08Bit"),
}


def features(frames: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Features [patch, feature] of random patches of frames [frame, row, column]."""
    n, h, w = frames.shape
    corners = zip(*(rng.integers(0, high, PATCHES) for high in (n, h - SIDE, w - SIDE)), strict=True)
    return np.array([_of_patch(frames[f, r : r + SIDE, c : c + SIDE].astype(float)) for f, r, c in corners])


def _of_patch(patch: np.ndarray) -> list[float]:
    local = patch - np.median(patch)
    beside = np.abs(local - np.median(local, 1, keepdims=True))
    sigma = np.median(np.abs(local)) / 0.6745 + 1e-6
    core = np.clip(local, -6 * sigma, 6 * sigma)
    row, column, power = core.mean(1), core.mean(0), core.var() + 1e-12
    neighbours = [(core[:, 1:] * core[:, :-1]), (core[1:] * core[:-1]), (core[1:, 1:] * core[:-1, :-1])]
    return [
        patch.mean(),
        *(core.std(), row.std(), column.std(), np.diff(core, axis=1).std(), np.diff(core, axis=0).std()),
        *(beside.std(), beside.max(), np.sort(beside.ravel())[-10:].mean()),
        *((row[1:] * row[:-1]).mean(), (row[2:] * row[:-2]).mean(), (column[1:] * column[:-1]).mean()),
        *(one.mean() / power for one in neighbours),
        *((core**3).mean() / power**1.5, (core**4).mean() / power**2),
        *(np.mean(patch % 2), (np.abs(local) > 4 * sigma).mean()),
    ]


def told_apart(real: np.ndarray, other: np.ndarray, seed: int = 1) -> float:
    """Area under the ROC curve of a classifier that is tested on other patches than it was trained on."""
    from sklearn.ensemble import HistGradientBoostingClassifier
    from sklearn.metrics import roc_auc_score

    rng, is_real = np.random.default_rng(seed), np.repeat([1, 0], PATCHES)
    train, test = (np.concatenate([features(real, rng), features(other, rng)]) for _ in range(2))
    trees = HistGradientBoostingClassifier(max_iter=150, random_state=0).fit(train, is_real)
    return float(roc_auc_score(is_real, trees.predict_proba(test)[:, 1]))


def halves(stack: hsnoise.FrameStack) -> tuple[hsnoise.FrameStack, hsnoise.FrameStack]:
    """Every second dark frame, and the others; of large frames the middle."""
    chosen = [i for i, kind in enumerate(stack.kind) if kind == "dark" and stack.n_frames[i] > 3]
    if not chosen:
        raise ValueError("no dark exposure of four frames")
    spans = [
        ((size - most) // 4 * 2, (size - most) // 4 * 2 + most) if size > most else None
        for size, most in zip(stack.shape, (ROWS, COLUMNS), strict=True)
    ]
    darks = stack.select(exposures=chosen, rows=spans[0], columns=spans[1])
    counts = [np.stack(list(darks.frames(i))) for i in range(darks.n_exposures)]
    return tuple(darks.with_counts([of[half::2] for of in counts], darks.window) for half in (0, 1))  # type: ignore[return-value]


def rows_of(name: str, stack: hsnoise.FrameStack) -> list[tuple[str, ...]]:
    """A row for the first and the last exposure of a sensor."""
    began = time.perf_counter()
    seen, held_out = halves(stack)
    found = closed(hsnoise.fit(seen), seen, held_out=held_out)
    seconds, drawn, rng = time.perf_counter() - began, draw_capture(5, found.params, held_out), np.random.default_rng(0)
    print(f"\n{name}\n{found}", flush=True)
    rows = []
    for e in dict.fromkeys((0, held_out.n_exposures - 1)):
        real, of_model, other = held_out.counts[e], drawn.counts[e], seen.counts[e]
        normal = np.rint(rng.normal(real.mean(), real.std(), real.shape))
        left = max(
            (one for one in found.shares if one.exposure_s == held_out.exposure_s[e]),
            key=lambda share: share.unexplained_of_total,
        )
        areas = (told_apart(real, one) for one in (of_model, normal, other))
        rows.append(
            (
                f"{name}, {held_out.exposure_s[e]:.3g} s",
                f"{found.comparison.error:.1f}",
                f"{100 * left.unexplained_of_total:.2f} % ({left.component})",
                *(f"{area:.2f}" for area in areas),
                f"{seconds:.0f} s",
            )
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], metavar="SENSOR", help=", ".join(SENSORS))
    only = parser.parse_args().only
    if find_spec("sklearn") is None:
        parser.error('needs scikit-learn: pip install ".[closed]"')
    headings = ("capture", "error", "unexplained, of all", "closed", "normal", "real", "fit and closing")
    sheet = Sheet("Told from held-out frames: area under the curve of closed, normal and real frames", headings)
    for name, place in SENSORS.items():
        if only and not any(word.lower() in name.lower() for word in only):
            continue
        with TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what loading assumes is no matter here
            place(data_folder(), Path(folder))
            try:
                sheet.rows.extend(rows_of(name, hsnoise.load(folder, progress=False)))
            except (ValueError, RuntimeError) as error:
                sheet.rows.append((name, f"refused: {error}", *[""] * 5))
    print(sheet.markdown())


if __name__ == "__main__":
    main()
