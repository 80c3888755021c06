"""Fields of FITS headers, under the names that cameras and capture programs use."""

from __future__ import annotations

import math
import re
from typing import Any

from astropy.io import fits

from hsnoise._core.types import BAYER_CFAS, StatedGain
from hsnoise.frames.bayer import shift_cfa
from hsnoise.frames.io._kinds import kind_of
from hsnoise.frames.io._recording import UNKNOWN_ORDER

EXPOSURE = ("EXPTIME", "EXPOSURE", "EXP_TIME", "EXP-TIME", "EXPOSED", "ITIME", "IMG_EXP", "ELAPTIME", "INTTIME")
KIND = ("IMAGETYP", "IMAGETYPE", "FRAME", "OBSTYPE", "IMTYPE", "IMGTYPE")
TEMPERATURE = ("CCD-TEMP", "CCDTEMP", "CCD_TEMP", "DET-TEMP", "DETTEMP", "SENSTEMP", "SET-TEMP")
GAIN = ("GAIN", "CCDGAIN", "GAINRAW")
COMBINED = ("NCOMBINE", "STACKCNT", "NSTACK", "NIMAGES")
OVERSCAN = ("BIASSEC", "OSCANSEC")
UNITS_S = {  # in comments of exposures
    r"\b(ms|msecs?|milli-?sec\w*)\b": 1e-3,
    r"\b([uµ]s|usecs?|micro-?sec\w*)\b": 1e-6,
    r"\bminutes?\b": 60.0,
}
LAMPS = re.compile(r"\b(arcs?|lamps?|comp|comparison)\b", re.IGNORECASE)  # in names of objects: spectra of lamps
HOTTEST_C = 100.0  # no sensor is hotter: more are kelvins
KELVIN = re.compile(r"\bkelvins?\b|\bK\b")
LEAST_E, MOST_E = 0.1, 10.0  # range in which a number without a unit may be electrons per DN
ELECTRONS_PER_DN = re.compile(r"\be(lectrons?)?-?\s*(/|per)\s*(adu|dn|count)", re.IGNORECASE)


def described(header: fits.Header, size: tuple[int, int]) -> dict[str, Any]:
    """Fields of a `Recording` with frames of `size` (rows, columns)."""
    kind, target = kind_of(_text(header, KIND)), _text(header, ("OBJECT",))
    if kind is None:
        kind = kind_of(target, calibration_only=True) or ("light" if LAMPS.search(target or "") else None)
    exposure_s = _exposure_s(header)
    return {
        "exposure_s": exposure_s,
        "kind": kind,
        "cfa": _cfa(header),
        "temperature_c": _temperature_c(header),
        "is_open": header["SHUTTER"] if isinstance(header.get("SHUTTER"), bool) else None,
        "binning": _binning(header),
        "gain_setting": _number(header, GAIN),
        "stated_gain": stated_gain(header),
        "filter_name": _text(header, ("FILTER",)),
        "is_master": (_number(header, COMBINED) or 0) > 1 or "master" in (_text(header, KIND) or "").lower(),
        "overscan": _section(_text(header, OVERSCAN), size),
        "taken": _text(header, ("DATE-OBS",)),
    }


def check_exposures(header: fits.Header) -> None:
    """Raise ValueError for a keyword of the exposure that is given twice, with other values."""
    for name in EXPOSURE:
        values = [str(card.value) for card in header.cards if card.keyword == name]
        if len(set(values)) > 1:
            raise ValueError(f"{name}: expected one exposure, got {' and '.join(values)}")


def _exposure_s(header: fits.Header) -> float | None:
    """The exposure in s, converted if its comment names another unit."""
    for name in EXPOSURE:
        value = _number(header, (name,))
        if value is not None:
            comment = header.comments[name]
            return value * next((factor for unit, factor in UNITS_S.items() if re.search(unit, comment, re.I)), 1.0)
    return None


def _temperature_c(header: fits.Header) -> float | None:
    """The sensor's temperature, degrees C; of cold sensors headers give kelvins, often without saying so."""
    for name in TEMPERATURE:
        value = _number(header, (name,))
        if value is not None:
            is_kelvin = value > HOTTEST_C or (value > 0 and KELVIN.search(header.comments[name]) is not None)
            return value - 273.15 if is_kelvin else value
    return None


def stated_gain(header: fits.Header) -> StatedGain | None:
    """EGAIN, or a GAIN that may be electrons per DN rather than the number of a setting."""
    electrons = _number(header, ("EGAIN",))
    if electrons is not None and electrons > 0 and math.isfinite(1 / electrons):
        # Drivers that do not know the gain write 1.
        return StatedGain(1 / electrons, f"EGAIN {electrons:.4g} e-/DN", certain=electrons != 1)
    for name in GAIN:
        value = _number(header, (name,))
        if value is None or not (value > 0 and math.isfinite(1 / value)):
            continue
        says = ELECTRONS_PER_DN.search(header.comments[name]) is not None
        if says or (LEAST_E <= value <= MOST_E and value != 1):
            return StatedGain(1 / value, f"{name} {value:.4g}{' e-/DN' if says else ' (e-/DN?)'}", certain=False)
    return None


def _first(header: fits.Header, names: tuple[str, ...]) -> Any:
    return next((header[name] for name in names if header.get(name) not in (None, "")), None)


def _text(header: fits.Header, names: tuple[str, ...]) -> str | None:
    value = _first(header, names)
    return str(value).strip() or None if isinstance(value, str) else None


def _number(header: fits.Header, names: tuple[str, ...]) -> float | None:
    """The first of the keywords that holds a number, numbers in quotes included."""
    for name in names:
        value = header.get(name)
        try:
            number = float("nan") if isinstance(value, bool) else float(value)
        except (TypeError, ValueError):
            continue
        if math.isfinite(number):
            return number
    return None


def _binning(header: fits.Header) -> tuple[int, int] | None:
    columns, rows = _number(header, ("XBINNING", "CCDXBIN")), _number(header, ("YBINNING", "CCDYBIN"))
    if columns is not None:
        return int(columns if rows is None else rows), int(columns)
    numbers = re.findall(r"\d+", _text(header, ("CCDSUM", "BINNING")) or "")
    return (int(numbers[1]), int(numbers[0])) if len(numbers) == 2 else None


def _section(text: str | None, size: tuple[int, int]) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """[first column:last column, first row:last row], counted from 1, as spans; None if outside the frame."""
    numbers = [int(n) for n in re.findall(r"\d+", text or "")]
    if len(numbers) != 4:
        return None
    (c0, c1), (r0, r1) = sorted(numbers[:2]), sorted(numbers[2:])
    inside = 1 <= r0 and r1 <= size[0] and 1 <= c0 and c1 <= size[1]
    return ((r0 - 1, r1), (c0 - 1, c1)) if inside else None


def _cfa(header: fits.Header) -> str | None:
    """Bayer order from the first stored pixel on; programs disagree on what it means with ROWORDER BOTTOM-UP."""
    pattern = str(header.get("BAYERPAT", "")).strip().upper()
    if not pattern:
        return None
    rows, columns = (_number(header, (name,)) if name in header else 0.0 for name in ("YBAYROFF", "XBAYROFF"))
    is_bottom_up = str(header.get("ROWORDER", "")).strip().upper() == "BOTTOM-UP"
    if pattern not in BAYER_CFAS or is_bottom_up or rows is None or columns is None or rows % 1 or columns % 1:
        return UNKNOWN_ORDER
    return shift_cfa(pattern, int(rows), int(columns))
