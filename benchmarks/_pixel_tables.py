"""Tables of the records of `benchmarks.pixels`: one row per kind of sensor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hsnoise._core.sheet import Sheet

MEAN_DARK = "mean dark current"  # over all pixels, e-/s
QUANTILE = 1.96  # of the normal distribution: 95 % intervals


def deviations(records: Sequence[dict], name: str) -> np.ndarray:
    """(relative error, error over its standard error) [fit, 2] of all fitted parameters called `name` or `name.X`."""
    rows = []
    for record in records:
        for parameter, truth in record["truth"].items():
            if parameter == name or parameter.startswith(f"{name}."):
                value, error = record["table"].get(parameter, (np.nan, np.nan))
                rows.append(((value - truth) / truth, (value - truth) / error if error else np.nan))
    return np.array(rows, float).reshape(-1, 2)


def figures(records: Sequence[dict]) -> dict[str, float]:
    """For the fits of one kind: relative bias, rms and largest error of the gain; coverage of the 95 % intervals;
    shares withheld (no value for the gain, or a refusal), broken and trustworthy; seconds."""
    gain = deviations(records, "gain")
    given = gain[np.isfinite(gain[:, 0]), 0]
    out = {
        "bias": given.mean() if given.size else np.nan,
        "rms": np.sqrt((given**2).mean()) if given.size else np.nan,
        "worst": np.abs(given).max() if given.size else np.nan,
        "withheld": float(np.mean([withheld(record) for record in records])),
        "broke": float(np.mean([record["broke"] is not None for record in records])),
        "trustworthy": float(np.mean([record["trustworthy"] for record in records])),
        "seconds": float(np.median([record["seconds"] for record in records])),
    }
    for name in ("gain", "read_noise.sigma", MEAN_DARK):
        pulls = deviations(records, name)[:, 1]
        pulls = pulls[np.isfinite(pulls)]
        out[f"cover {name}"] = float((np.abs(pulls) < QUANTILE).mean()) if pulls.size else np.nan
    return out


def withheld(record: dict) -> bool:
    """Whether the fit withheld the gain: NaN in the table, or a refusal instead of a table."""
    if record["broke"] is not None:
        return False
    gains = [value for name, (value, _) in record["table"].items() if name.split(".")[0] == "gain"]
    return not np.isfinite(gains).any()


def determined(records: dict[str, list[dict]]) -> Sheet:
    """One row per kind whose gain follows from its darks, one for all kinds together, and the goals."""
    headings = (
        "kind",
        "bias",
        "rms",
        "worst",
        "gain",
        "read noise",
        "dark current",
        "withheld",
        "broke",
        "trust",
        "time",
    )
    sheet = Sheet("Gain from darks: error in %; share of 95 % intervals that cover; shares of fits", headings)
    everything = [record for of_kind in records.values() for record in of_kind]
    for kind, of_kind in (*records.items(), ("all", everything)):
        f = figures(of_kind)
        sheet.rows.append(
            (
                f"{kind} ({len(of_kind)})",
                *(percent(f[name], "+.2f" if name == "bias" else ".2f") for name in ("bias", "rms", "worst")),
                *(percent(f[f"cover {name}"]) for name in ("gain", "read_noise.sigma", MEAN_DARK)),
                percent(f["withheld"]),
                percent(f["broke"]),
                percent(f["trustworthy"]),
                f"{f['seconds']:.1f} s",
            )
        )
    sheet.rows.append(("must", "", "", "5", *["90 to 98"] * 3, "0", "0", "", ""))
    sheet.rows.append(("aim", "", "2", "", *["93 to 97"] * 3, "", "", "", ""))
    return sheet


def undetermined(records: dict[str, list[dict]]) -> Sheet:
    """One row per capture from which no gain follows, and the goal."""
    headings = ("kind", "called so", "of these refused", "broke", "gains given", "trust", "time")
    sheet = Sheet("No gain follows from these frames", headings)
    for kind, of_kind in records.items():
        given = [r["table"]["gain"] for r in of_kind if r["table"] and not withheld(r)]
        sheet.rows.append(
            (
                kind,
                f"{sum(map(withheld, of_kind))} of {len(of_kind)}",
                *(str(sum(r[how] is not None for r in of_kind)) for how in ("refused", "broke")),
                ", ".join(f"{value:.3g} ± {error:.2g}" for value, error in given[:3]) or "none",
                percent(np.mean([r["trustworthy"] for r in of_kind])),
                f"{np.median([r['seconds'] for r in of_kind]):.1f} s",
            )
        )
    sheet.rows.append(("must", "all", "", "0", "none", "", ""))
    return sheet


def percent(share: float, form: str = ".0f") -> str:
    return f"{100 * share:{form}}" if np.isfinite(share) else "none"
