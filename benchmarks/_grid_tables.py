"""Tables and figure of the grid of hidden effects, from its records."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import beta

from benchmarks._grid_cells import CLEAN, hidden_in
from benchmarks.simulator import ODD
from hsnoise._core.sheet import Sheet

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
WITHIN = 4.0  # standard errors


def sheets(records: Iterable[dict]) -> list[Sheet]:
    """All tables that have rows; records without a verdict (the cell raised) appear only in the table of failures."""
    told, failed = [], []
    for record in records:
        (told if "verdict" in record else failed).append(record)
    single = [r for r in told if r["kind"] == "grid" and is_single(r)]
    made = (
        detection(single),
        by_effect(single),
        confusion(single),
        false_alarms([r for r in told if r["effect"] == CLEAN and r["kind"] != "case"]),
        outside([r for r in told if r["kind"] == "grid" and r["effect"] in ODD]),
        pairs([r for r in told if r["kind"] == "grid" and len(hidden_in(r["effect"])) > 1]),
        complete([r for r in told if "improved" in r]),
        improved([r for r in told if "improved" in r]),
        cases([r for r in told if r["kind"] == "case"]),
        improvement(told),
        durations(told),
        failures([*failed, *(r for r in told if r["failure"])]),
    )
    return [sheet for sheet in made if sheet.rows]


def is_single(record: dict) -> bool:
    """Whether exactly one effect of the library is hidden."""
    hidden = hidden_in(record["effect"])
    return len(hidden) == 1 and hidden[0] not in ODD


def first_right(record: dict) -> bool:
    return record["rank"] == 1


def in_first_three(record: dict) -> bool:
    return record["rank"] is not None and record["rank"] <= 3


def named(record: dict) -> bool:
    """Whether the verdict names the right effect and no other."""
    return record["verdict"] == "named" and record["names"][0] in record["ranks"]


def upper_bound(k: int, n: int, confidence: float = 0.95) -> float:
    """Clopper-Pearson's one-sided upper bound of a rate, from k events in n."""
    return 1.0 if k >= n else float(beta.ppf(confidence, k + 1, n - k))


def interval(k: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Clopper-Pearson's two-sided interval."""
    low = 1 - upper_bound(n - k, n, (1 + confidence) / 2)
    return low, upper_bound(k, n, (1 + confidence) / 2)


def grouped(records: list[dict], key: Callable[[dict], tuple]) -> dict[tuple, list[dict]]:
    groups = defaultdict(list)
    for record in records:
        groups[key(record)].append(record)
    return dict(sorted(groups.items()))


def detection(records: list[dict]) -> Sheet:
    headings = ("camera", "amplitude", "n", "first right", "in first three", "named", "ambiguous with it")
    sheet = Sheet("One effect hidden", (*headings, "wrong name", "unexplained", "nothing missing"))
    for (camera, amplitude), group in grouped(records, lambda r: (r["camera"], r["amplitude"])).items():
        among = [r for r in group if r["names"] and set(r["names"]) & set(r["ranks"])]
        counts = (
            sum(map(first_right, group)),
            sum(map(in_first_three, group)),
            sum(map(named, group)),
            sum(r["verdict"] == "ambiguous" for r in among),
            sum(bool(r["names"]) for r in group) - len(among),
            sum(r["verdict"] == "unexplained" for r in group),
            sum(r["verdict"] == "nothing missing" for r in group),
        )
        sheet.rows.append((camera, f"{amplitude:g}", str(len(group)), *map(str, counts)))
    return sheet


def by_effect(records: list[dict]) -> Sheet:
    columns = sorted({(r["camera"], r["amplitude"]) for r in records})
    sheet = Sheet("First right / named / n of each effect", ("hidden", *(f"{c} {a:g}" for c, a in columns)))
    for (effect,), group in grouped(records, lambda r: (r["effect"],)).items():
        cells = []
        for column in columns:
            of = [r for r in group if (r["camera"], r["amplitude"]) == column]
            cells.append(f"{sum(map(first_right, of))} / {sum(map(named, of))} / {len(of)}" if of else "–")
        sheet.rows.append((effect, *cells))
    return sheet


def confusion(records: list[dict]) -> Sheet:
    """The effects that came first instead of the hidden one."""
    sheet = Sheet("Confusion: another effect first", ("hidden", "first", "verdict", "amplitudes", "count"), left=4)
    wrong = [r for r in records if not first_right(r)]
    of = grouped(wrong, lambda r: (r["effect"], r["top"][0][0] if r["top"] else "–", r["verdict"]))
    for key, group in sorted(of.items(), key=lambda item: -len(item[1])):
        amplitudes = ", ".join(f"{a:g}" for a in sorted({r["amplitude"] for r in group}))
        sheet.rows.append((*key, amplitudes, str(len(group))))
    return sheet


def false_alarms(records: list[dict]) -> Sheet:
    headings = ("camera", "layout", "n", "alarms", "that name an effect", "rate", "95 % upper bound", "first")
    sheet = Sheet("False alarms on clean captures", headings, left=2)
    groups = grouped(records, lambda r: (r["camera"], r["layout"]))
    if len(groups) > 1:
        groups[("all", "")] = records
    for key, group in groups.items():
        alarms = [r for r in group if r["verdict"] != "nothing missing"]
        naming = sum(bool(r["names"]) for r in alarms)
        rate, bound = len(alarms) / len(group), upper_bound(len(alarms), len(group))
        firsts = _counted(r["top"][0][0] for r in alarms if r["top"])
        sheet.rows.append((*key, str(len(group)), str(len(alarms)), str(naming), f"{rate:.1%}", f"{bound:.1%}", firsts))
    return sheet


def outside(records: list[dict]) -> Sheet:
    headings = ("hidden", "camera", "amplitude", "verdicts", "named", "n")
    sheet = Sheet("Effects that the library does not have", headings, left=5)
    for key, group in grouped(records, lambda r: (r["effect"], r["camera"], r["amplitude"])).items():
        names = _counted(" or ".join(r["names"]) for r in group if r["names"])
        sheet.rows.append((*_text(key), _counted(r["verdict"] for r in group), names, str(len(group))))
    return sheet


def pairs(records: list[dict]) -> Sheet:
    headings = ("hidden", "camera", "amplitude", "verdicts", "first is one of them", "both in first three", "n")
    sheet = Sheet("Two effects at once", headings, left=4)
    for key, group in grouped(records, lambda r: (r["effect"], r["camera"], r["amplitude"])).items():
        both = sum(all(rank and rank <= 3 for rank in r["ranks"].values()) for r in group)
        counts = str(sum(map(first_right, group))), str(both), str(len(group))
        sheet.rows.append((*_text(key), _counted(r["verdict"] for r in group), *counts))
    return sheet


def complete(records: list[dict]) -> Sheet:
    """How often `improve` added all that was hidden, and nothing else, by how many were hidden."""
    headings = (
        "hidden",
        "n",
        "all added",
        "95 %",
        "and no other",
        "others added",
        "error <= 1.5",
        "same with another key",
    )
    sheet = Sheet("What the whole loop added", headings, left=1)
    for (kind,), group in grouped(records, lambda r: (_kind(r["effect"]),)).items():
        added = [(set(hidden_in(r["effect"])), set(r["improved"]["added"])) for r in group]
        whole = sum(hidden <= found for hidden, found in added)
        same = sum(r["improved"]["added"] == r["improved"]["with_another_key"] for r in group)
        low, high = interval(whole, len(group))
        counts = (whole, f"{low:.0%} to {high:.0%}", sum(hidden == found for hidden, found in added))
        more = (
            sum(len(found - hidden) for hidden, found in added),
            sum(r["improved"]["error"] <= 1.5 for r in group),
            same,
        )
        sheet.rows.append((kind, *map(str, (len(group), *counts, *more))))
    return sheet


def _kind(effect: str) -> str:
    """What is hidden, by its number; effects that the library lacks apart."""
    hidden = hidden_in(effect)
    if any(name in ODD for name in hidden):
        return "not in the library"
    return f"{len(hidden)} effect{'' if len(hidden) == 1 else 's'}"


def improved(records: list[dict]) -> Sheet:
    """What `improve` made of each capture, and the base parameter that it left farthest from the truth."""
    headings = ("hidden", "camera", "added", "ended", "light", "error before", "after", "farthest of the base")
    sheet = Sheet("The whole loop", headings, left=5)
    for record in sorted(records, key=lambda r: (r["effect"], r["key"])):
        found = record["improved"]
        errors = _number(record["error_before"]), _number(found["error"])
        added = ", ".join(found["added"]) or "–"
        sheet.rows.append(
            (record["effect"], record["camera"], added, found["ended"], found["light"], *errors, bent(record))
        )
    return sheet


def bent(record: dict) -> str:
    """The gain, dark current or read noise that `improve` left farthest off, relative, and in standard errors."""
    kept = ("gain", "dark_current", "read_noise")
    truth, known = record["truth"], record["improved"]["base"].items()
    off = [(v / truth[n] - 1, (v - truth[n]) / e, n) for n, (v, e) in known if e and n.split(".")[0] in kept]
    share, errors, name = max(off, key=lambda one: abs(one[0]), default=(0.0, 0.0, "none fitted"))
    return f"{name} {share:+.1%} ({errors:+.1f})" if off else name


def cases(records: list[dict]) -> Sheet:
    headings = ("case", "hidden", "verdict", "first three, score (nats)", "rank", "error before", "after")
    sheet = Sheet("Captures of another simulator", headings, left=4)
    for record in sorted(records, key=lambda r: r["key"]):
        verdict = ": ".join(filter(None, (record["verdict"], " or ".join(record["names"]))))
        top = ", ".join(f"{name} {_number(score)}" for name, score in record["top"])
        ranks = ", ".join(str(rank or "–") for rank in record["ranks"].values())
        errors = _number(record["error_before"]), _number(record.get("error_after"))
        sheet.rows.append((record["key"], record["effect"], verdict, top, ranks, *errors))
    return sheet


def improvement(records: list[dict]) -> Sheet:
    """Errors before and after refits; for effects without refits, before, over all cells."""
    headings = ("hidden", "n", "fitted again", "error before", "after")
    share = f"base parameters within {WITHIN:g} standard errors, before"
    sheet = Sheet("Error (median) and base parameters", (*headings, share, "after"))
    groups = grouped(records, lambda r: (r["effect"],))
    if len(groups) > 1:
        groups[("all",)] = records
    for (effect,), group in groups.items():
        again = [r for r in group if r.get("error_after") is not None]
        shown = again or group
        sheet.rows.append(
            (
                effect,
                str(len(group)),
                str(len(again)),
                _median(r["error_before"] for r in shown),
                _median(r["error_after"] for r in again),
                _share_within(shown, "base_before"),
                _share_within(again, "base_after"),
            )
        )
    return sheet


def within(record: dict, estimates: str) -> list[bool]:
    """For each base parameter with a standard error, whether the truth is within `WITHIN` of them."""
    truth = record["truth"]
    known = [(value, error, truth[name]) for name, (value, error) in record.get(estimates, {}).items()]
    return [abs(value - true) < WITHIN * error for value, error, true in known if error and value is not None]


def durations(records: list[dict]) -> Sheet:
    stages = ("simulate", "fit", "compare", "diagnose", "refit", "compare again")
    sheet = Sheet("Seconds (median, with compilation)", ("layout", "n", *stages))
    for (size,), group in grouped(records, lambda r: (r["layout"].split(", ")[-1] or "cases",)).items():
        medians = [_median(r["seconds"][stage] for r in group if stage in r["seconds"]) for stage in stages]
        sheet.rows.append((size, str(len(group)), *medians))
    return sheet


def failures(records: list[dict]) -> Sheet:
    sheet = Sheet("Cells that raised", ("cell", "stage", "message"), left=3)
    for record in records:
        # The stage that raised is the last that was timed.
        sheet.rows.append((record["key"], next(reversed(record["seconds"]), "–"), record["failure"].splitlines()[0]))
    return sheet


def _share_within(records: list[dict], estimates: str) -> str:
    inside = [one for record in records for one in within(record, estimates)]
    return f"{np.mean(inside):.0%} of {len(inside)}" if inside else "–"


def _median(values: Iterable[float | None]) -> str:
    known = [v for v in values if v is not None]
    return _number(float(np.median(known))) if known else "–"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _counted(values: Iterable[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in Counter(values).most_common()) or "–"


def _text(key: tuple) -> list[str]:
    return [f"{part:g}" if isinstance(part, float) else part for part in key]


def draw_detection(records: Iterable[dict]) -> Figure | None:
    """Share of captures in which the hidden effect comes first, against amplitude; None without records."""
    single = [r for r in records if r["kind"] == "grid" and "verdict" in r and is_single(r)]
    if not single:
        return None
    fig = Figure(figsize=(7, 4.2), layout="constrained")
    axis = fig.subplots()
    for i, ((camera,), group) in enumerate(grouped(single, lambda r: (r["camera"],)).items()):
        by_amplitude = grouped(group, lambda r: (r["amplitude"],))
        counts = [(sum(map(first_right, of)), len(of)) for of in by_amplitude.values()]
        rate = np.array([k / n for k, n in counts])
        bounds = np.array([interval(k, n) for k, n in counts])
        # Cameras side by side, so that their bars do not cover each other.
        x = np.array([amplitude for (amplitude,) in by_amplitude]) * 1.02**i
        reach = np.maximum(np.abs(bounds.T - rate), 0)
        axis.errorbar(x, rate, reach, fmt="o-", color=COLOURS[i % len(COLOURS)], capsize=3, label=camera)
    axis.set_xscale("log")
    ticks = sorted({r["amplitude"] for r in single})
    axis.set_xticks(ticks, [f"{a:g}" for a in ticks])
    axis.minorticks_off()
    axis.set_ylim(-0.02, 1.02)
    axis.set_xlabel("amplitude (1: a modest real sensor)")
    axis.set_ylabel("share of captures, bars 95 % (Clopper–Pearson)")
    axis.set_title("The hidden effect comes first in the ranking", loc="left")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="lower right")
    return fig
