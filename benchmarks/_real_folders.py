"""Captures of real sensors as folders of files, fitted as their owners would: `hsnoise.load(folder)`, no keywords."""

from __future__ import annotations

import json
import os
import re
import shutil
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import numpy as np
from astropy.io import fits

import hsnoise
from hsnoise._core.sheet import Sheet

COVERED = "covered"  # by the fit's own 95 % interval
MOST_ERROR = 1 / 3  # of the value; with a larger error no goal is reached
CLIPPED = "share clipped at 0"
DARK_NOISE = "temporal dark noise"  # as in EMVA 1288: of pixels, rows, columns and frames, e-
CHANGING = ("read_noise", "row_noise", "column_noise", "frame_offset")
DRAWS = 32  # frames drawn from a fit: 14 000 clipped pixels of the TC-237, a share known to 1 %


@dataclass(frozen=True)
class Known:
    """The truth that `parameter` lies from `low` to `high`, in its unit; `goal`: the relative distance outside that is
    allowed, or COVERED. NaN: the parameter must be withheld."""

    parameter: str
    low: float
    high: float
    goal: float | str = 0.0


@dataclass(frozen=True)
class Real:
    """A capture: `place(data, folder)` writes or copies its files to `folder`; each pattern of `says` must match one of
    the sentences of the fit, of the assumptions of loading, or of the warnings."""

    name: str
    place: Callable[[Path, Path], None]
    known: tuple[Known, ...]
    says: tuple[str, ...] = ()


def data_folder() -> Path:
    """The folder of the captures: $HSNOISE_SHARED/data, or shared/data beside the project."""
    beside = Path(__file__).resolve().parents[1].parent / "shared"
    folder = Path(os.environ.get("HSNOISE_SHARED", beside)) / "data"
    if not folder.is_dir():
        raise SystemExit(f"no captures in {folder}: set HSNOISE_SHARED to the folder that holds data/")
    return folder


def unpacked(name: str, chosen: str = "") -> Callable[[Path, Path], None]:
    """Write the arrays of NAME.npz whose name matches `chosen` as FITS files in bias/, dark/ and flat/."""

    def place(data: Path, folder: Path) -> None:
        about = json.loads((data / f"{name}.json").read_text())
        with np.load(data / f"{name}.npz") as arrays:
            for key, one in about["arrays"].items():
                kind = one["kind"].split()[0]
                for i, frame in enumerate(arrays[key] if re.search(chosen, key) else ()):
                    header = {"INSTRUME": about["camera"][:60]}
                    if temperatures := one.get("sensor_temp_c"):
                        header["CCD-TEMP"] = temperatures[min(i, len(temperatures) - 1)]
                    _write(folder / kind / f"{key}_{i:02d}.fits", frame, kind, one["exposure_s"], header)

    return place


def copied(name: str, *folders: str) -> Callable[[Path, Path], None]:
    """Copy the folder NAME as it is, or only these of its folders."""

    def place(data: Path, folder: Path) -> None:
        for one in folders or sorted(p.name for p in (data / name).iterdir() if p.is_dir()):
            shutil.copytree(data / name / one, folder / one)

    return place


def emva(name: str) -> Callable[[Path, Path], None]:
    """A reference set of EMVA 1288: its descriptor and the images that it lists."""

    def place(data: Path, folder: Path) -> None:
        shutil.copytree(data / "emva1288" / name, folder, dirs_exist_ok=True)

    return place


def _write(path: Path, frame: np.ndarray, kind: str, exposure_s: float, header: dict) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    hdu = fits.PrimaryHDU(frame)
    hdu.header.update({"EXPTIME": exposure_s, "IMAGETYP": f"{kind.capitalize()} Frame"} | header)
    hdu.writeto(path)


STL, IMX, TC = "sbig_stl1001_ccd", "imx541_mono_emva", "sbig_st7e_tc237_ccd_clipped"
STL_PAIRS, ST8_PAIRS = (0.515, 0.517), (1 / 2.70, 1 / 2.68)  # gains by pairs of flats, DN/e-
STL_DARKS = "bias_m05C|dark_m05C_060s$"
REAL = (
    Real("STL-1001, bias and 60 s", unpacked(STL, STL_DARKS), (Known("gain", *STL_PAIRS, 0.06),)),
    Real("STL-1001, with flats", unpacked(STL, f"{STL_DARKS}|flat"), (Known("gain", *STL_PAIRS, 0.02),)),
    Real("STL-1001, everything", unpacked(STL), (Known("gain", *STL_PAIRS, 0.02),), ("°C|Celsius|temperature",)),
    Real("IMX541, darks", unpacked(IMX, "dark"), (Known("gain", np.nan, np.nan),), ("flat",)),
    Real("IMX541, darks and flats", unpacked(IMX), (Known("gain", 0.4221, 0.4221, 0.02),)),
    Real("sbig_st8_cc0", copied("sbig_st8_cc0"), (Known("gain", *ST8_PAIRS, 0.02),), ("binn|size|pixels",)),
    Real("sbig_st8_cc0, darks", copied("sbig_st8_cc0", "dark25s", "darkflat3s"), (Known("gain", *ST8_PAIRS, COVERED),)),
    Real("ccd_kaf_mit", copied("ccd_kaf_mit"), (Known("gain", 1 / 2.35, 1 / 2.30, 0.02),), (r"1\.5\b",)),
    Real(
        "site_2k_ccd",
        copied("site_2k_ccd"),
        (Known("gain", 1 / 5.0, 1 / 4.9, 0.03),),
        ("black level.*(fall|signal)|overscan", "bend|bent|curv"),
    ),
    Real("TC-237, bias", unpacked(TC, "bias"), (Known(CLIPPED, 0.002057, 0.002057, 0.06),)),
    Real(
        "EMVA 1288 001",
        emva("001_CCD_12Bit"),
        (Known("gain", 0.28035, 0.28035, 0.01), Known(DARK_NOISE, 10.913, 10.913, 0.01)),
    ),
    Real(
        "EMVA 1288 002",
        emva("002_CMOS_08Bit"),
        (Known("gain", 0.02063, 0.02063, 0.01), Known("read_noise.sigma", 0.0, 14.0)),
    ),
)


def real_sensors(data: Path, only: list[str]) -> Sheet:
    """One row each: the truth, the fit, and whether it reaches the goal. Prints each fit when it is done."""
    headings = ("capture", "parameter", "known", "fit", "off", "goal", "reached", "trust", "time", "not said")
    sheet = Sheet("Real sensors, as loaded from their folders", headings, left=2)
    for real in REAL:
        if not only or any(word.lower() in real.name.lower() for word in only):
            sheet.rows.extend(_lines(real, data))
    return sheet


def _lines(real: Real, data: Path) -> list[tuple[str, ...]]:
    print(f"\n{real.name}", flush=True)
    with TemporaryDirectory() as folder:
        real.place(data, Path(folder))
        began = time.perf_counter()
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                stack = hsnoise.load(folder, progress=False)
                fit = hsnoise.fit(stack)
        except (ValueError, OSError) as refusal:
            how = "broke" if isinstance(refusal, np.linalg.LinAlgError) else "refused"
            print(f"{how}: {refusal}", flush=True)
            return [(real.name, k.parameter, _range(k), how, "", _goal(k), "no", "", "", "") for k in real.known]
        seconds = f"{time.perf_counter() - began:.1f} s"
    before = [*stack.assumed, *(str(one.message) for one in caught)]
    print(*before, fit, sep="\n", flush=True)
    sentences = (*before, *fit.doubts, *fit.notes)
    silent = [words for words in real.says if not any(re.search(words, said) for said in sentences)]
    end = ("yes" if fit.trustworthy else "no", seconds, ", ".join(silent) or "-")
    return [
        (real.name, known.parameter, _range(known), *judged(known, *_value(known, fit)), *end) for known in real.known
    ]


def _value(known: Known, fit) -> tuple[float, float]:
    if known.parameter == DARK_NOISE:
        parts = [fit.table[f"{name}.sigma"][:2] for name in CHANGING if f"{name}.sigma" in fit.table]
        total = float(np.sqrt(sum(value**2 for value, _ in parts)))
        return total, float(np.sqrt(sum((value * error) ** 2 for value, error in parts))) / total
    if known.parameter != CLIPPED:
        return fit.table[known.parameter][:2]
    drawn = hsnoise.sample_dark(jax.random.key(0), DRAWS, fit.summary.shape, fit.params, exposure_s=0.0)
    return float((np.asarray(drawn) == 0).mean()), np.nan


def judged(known: Known, value: float, error: float) -> tuple[str, str, str, str]:
    """(value with error, distance outside the range, goal, whether it is reached) in words."""
    said = "withheld" if np.isnan(value) else f"{value:.4g}" + (f" ± {error:.2g}" if np.isfinite(error) else "")
    nearest = np.clip(value, known.low, known.high)
    off = value / nearest - 1 if nearest else 0.0
    if np.isnan(known.low):
        reached = np.isnan(value)
    elif known.goal == COVERED:
        reached = abs(value - nearest) < 1.96 * error < 1.96 * MOST_ERROR * value
    else:
        reached = abs(off) <= known.goal and not error > MOST_ERROR * value
    return said, "" if np.isnan(off) else f"{100 * off:+.1f} %", _goal(known), "yes" if reached else "no"


def _range(known: Known) -> str:
    if np.isnan(known.low):
        return "not to be had"
    return " to ".join(f"{x:.4g}" for x in dict.fromkeys((known.low, known.high)))


def _goal(known: Known) -> str:
    if np.isnan(known.low):
        return "withheld"
    return known.goal if isinstance(known.goal, str) else f"{100 * known.goal:g} %"
