"""The story of each real sensor: its budget, what the textbook model believes, what was added, what is only measured.

    python -m benchmarks.sensors --out build/sensors            # all captures of shared/data, half an hour
    python -m benchmarks.sensors --only ST-8 KAF

Writes NAME.md, the numbers of docs/sensors.md, NAME.json, the model, and sensor_NAME.png: a dark frame and one drawn
from the model, both with the same grey scale, the means of all, and their means of rows and columns.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

import hsnoise
from benchmarks._real_folders import IMX, STL, TC, copied, data_folder, emva, unpacked
from hsnoise import effects as fx
from hsnoise._core.sheet import Sheet
from hsnoise.criticism.closing import ClosedModel
from hsnoise.criticism.closing import closed as closed_model
from hsnoise.simulation.draws import draw_capture
from hsnoise.simulation.portion import Portion

SENSORS: dict[str, Callable[[Path, Path], None]] = {
    "ST-8": copied("sbig_st8_cc0", "dark25s", "darkflat3s", "flat3s"),
    "KAF": copied("ccd_kaf_mit"),
    "EMVA-001": emva("001_CCD_12Bit"),
    "EMVA-002": emva("002_CMOS_08Bit"),
    "IMX541": unpacked(IMX),
    "STL-1001": unpacked(STL),
    "TC-237": unpacked(TC),
    "SITe": copied("site_2k_ccd"),
}
SHOWN = (160, 240)  # rows and columns of the frames that are shown
STRETCH = (0.5, 99.7)  # percentiles of the measured frame shown as black and white
INK = ("#404040", "#D55E00")
LEAST = 1e-3  # share of the noise below which a component is not told


def textbook(stack: hsnoise.FrameStack) -> hsnoise.NoiseModel:
    """Poisson and Gaussian noise as often calibrated: the line of pooled variance over mean; read noise of the shortest
    darks."""
    groups = [i for i, kind in enumerate(stack.kind) if kind == "dark"]
    moments = [(f.mean(), f.var(), stack.exposure_s[i]) for i in groups for f in [stack.frame(i, 0).astype(float)]]
    mean, variance, exposure_s = np.array(sorted(moments, key=lambda one: one[2])).T
    slope = np.polyfit(mean, variance, 1)[0] if np.ptp(mean) > 0 else np.nan
    gain = float(slope) if np.isfinite(slope) and slope > 0 else 1.0  # darks that do not grow: in DN
    rate = float(max(mean[-1] - mean[0], 0.0) / gain / max(exposure_s[-1] - exposure_s[0], 1e-9))
    parts = [fx.DarkCurrent(rate), fx.ReadNoise(float(np.sqrt(variance[0])) / gain), fx.Gain(gain)]
    black = fx.BlackLevel(float(mean[0] - rate * exposure_s[0] * gain))
    return hsnoise.NoiseModel(
        [fx.ShotNoise(), *parts, black, fx.ADC()], cfa="mono", shutter=stack.shutter, exposure_s=float(exposure_s[-1])
    )


def told(name: str, stack: hsnoise.FrameStack, out: Path) -> tuple[str, ...]:
    """Measure a sensor, write its page and its figure, and return a row of the summary."""
    began = time.monotonic()
    fit = hsnoise.fit(stack)
    found = hsnoise.compare(fit, stack)
    usual = textbook(stack)
    plain = hsnoise.compare(usual, stack)
    closed = closed_model(fit, stack)
    seconds = time.monotonic() - began
    lines = [
        f"# {name}",
        "",
        str(fit.conclusion),
        "",
        *budget_of(stack),
        "",
        *believed(usual, fit, plain),
        "",
        *table_of(fit),
        "",
        *left_of(found, closed),
    ]
    (out / f"{name}.md").write_text("\n".join(lines) + "\n")
    fit.params.save(out / f"{name}.json")
    draw(fit.params, stack).savefig(out / f"sensor_{name.lower().replace('-', '')}.png", dpi=100)
    errors = (f"{one:.3g}" for one in (plain.error, found.error, closed.comparison.error))
    return (name, *errors, found.worst_group, f"{seconds:.0f} s")


def budget_of(stack: hsnoise.FrameStack) -> list[str]:
    """The components of the noise of the shortest and the longest darks, in % of their variance."""
    rows = [row for row in hsnoise.budget(stack).rows if row.kind == "dark" and row.n_frames > 1]
    lines = []
    for row in {row.exposure_s: row for row in (rows[0], rows[-1])}.values():
        parts = sorted(row.components.items(), key=lambda one: -one[1].share)
        words = ", ".join(f"{part} {100 * one.share:.3g} %" for part, one in parts if one.share > LEAST)
        lines.append(f"Darks of {row.exposure_s:g} s, {np.sqrt(row.total_dn2):.3g} DN in all: {words}")
    return lines


def believed(model: hsnoise.NoiseModel, fit: hsnoise.FitResult, plain: hsnoise.Comparison) -> list[str]:
    """What the textbook model takes gain and read noise for, beside the fit."""
    words = []
    for name in ("gain", "read_noise.sigma"):
        value, error, unit = fit.table.get(name, (np.nan, np.nan, ""))
        words.append(f"{name} {model.table[name][0]:.3g} {unit}; the fit: {value:.4g} ± {error:.2g}")
    return [f"Textbook: {words[0]}, {words[1]}; error {plain.error:.3g}, worst in {plain.worst_group}"]


def table_of(fit: hsnoise.FitResult) -> list[str]:
    """The parameters of the fit, base first, with their errors."""
    rows = [(name, value, error, unit) for name, (value, error, unit) in fit.table.items() if np.isfinite(value)]
    rows = [row for row in rows if not np.isnan(row[2])]
    return [f"added: {', '.join(fit.added)}", *(f"{name} {v:.4g} ± {e:.2g} {unit}" for name, v, e, unit in rows)]


def left_of(found: hsnoise.Comparison, closed: ClosedModel) -> list[str]:
    """Where the fit differs from the frames, and what measuring closes."""
    worst = sorted(found.groups.items(), key=lambda one: -one[1])[:4]
    return [
        f"error {found.error:.3g}; {', '.join(f'{group} {misfit:.3g}' for group, misfit in worst)}",
        *found.worst[:3],
        found.unexplained,
        f"closed: error {closed.comparison.error:.3g}; replaced {', '.join(closed.replaced) or 'nothing'}",
        *shares_of(closed),
    ]


def shares_of(closed: ClosedModel) -> Iterable[str]:
    """Components of the longest darks: what is named, only measured, left."""
    longest = max(share.exposure_s for share in closed.shares)
    for share in closed.shares:
        if share.exposure_s == longest and share.of_total > LEAST:
            parts = (100 * part for part in (share.named, share.only_measured, share.unexplained))
            named, measured, left = (f"{part:.3g} %" for part in parts)
            yield f"{share.in_words}: named {named}, only measured {measured}, left {left}"


def draw(model: hsnoise.NoiseModel, stack: hsnoise.FrameStack) -> Figure:
    """A frame of the longest repeated darks and a drawn one, the means of all, and their means of rows and columns."""
    darks = Portion.of(stack).darks.frames
    e = max(darks.repeated_darks, key=lambda i: darks.exposure_s[i])
    counts = [np.stack(list(of.frames(e))).astype(float) for of in (darks, draw_capture(1, model, darks))]
    part = tuple(
        slice(max(size - most, 0) // 2, max(size - most, 0) // 2 + most)
        for size, most in zip(darks.shape, SHOWN, strict=True)
    )
    figure = Figure(figsize=(11, 9.6), layout="constrained")
    axes = figure.subplots(3, 2, height_ratios=[2, 2, 1])
    for row, of, name in ((0, 0, "a frame"), (1, slice(None), f"mean of {darks.n_frames[e]} frames")):
        shown = [one[of].reshape(-1, *darks.shape).mean(0) for one in counts]
        shown = [one - np.median(one) for one in shown]
        low, high = np.percentile(shown[0][part], STRETCH)
        for ax, one, whose in zip(axes[row], shown, ("measured", "drawn from the model"), strict=True):
            ax.imshow(one[part], cmap="gray", vmin=low, vmax=high, interpolation="nearest", aspect="auto")
            ax.set_title(f"{whose}: {name}, {low:+.1f} to {high:+.1f} DN", fontsize=11)
            ax.set_xticks([])
            ax.set_yticks([])
    for ax, axis, name in ((axes[2, 0], 2, "row"), (axes[2, 1], 1, "column")):
        for one, ink, label in zip(counts, INK, ("measured", "drawn"), strict=True):
            line = one.mean((0, axis))
            ax.plot(line - np.median(line), color=ink, linewidth=0.9, label=label)
        ax.set_xlabel(name)
        ax.set_ylabel(f"{name} mean / DN")
        ax.spines[["top", "right"]].set_visible(False)
        ax.margins(x=0)
    figure.legend(*axes[2, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    figure.suptitle(f"Darks of {darks.exposure_s[e]:g} s", fontsize=12)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=list(SENSORS), metavar="SENSOR", help=", ".join(SENSORS))
    parser.add_argument("--out", type=Path, default=Path("build/sensors"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    sheet = Sheet("Real sensors", ("sensor", "textbook", "fit", "closed", "worst group of the fit", "time"))
    for name in arguments.only:
        with TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            SENSORS[name](data_folder(), Path(folder))
            sheet.rows.append(told(name, hsnoise.load(folder, progress=False), arguments.out))
        print(sheet.rows[-1], flush=True)
    Console(width=120).print(sheet.rich())


if __name__ == "__main__":
    main()
