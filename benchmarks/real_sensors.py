"""Fits of real sensors, with captures from a folder outside the project (HSNOISE_SHARED, or ../shared).

    python -m benchmarks.real_sensors
    python -m benchmarks.real_sensors --improve

IMX541 (darks and flats): gain and read noise beside the values that the source reports, and the local gain against
signal as a figure. TC-237 (bias frames clipped at 0): clipped fraction, whole frame and by thirds of the columns.
STL-1001 (darks at two temperatures, flats): dark current. With --improve instead: what the paper's model lacks in each,
according to `hsnoise.improve`, and the dark means of an A7S2 against exposure as a figure.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import hsnoise
from hsnoise.cli.progress import busy
from hsnoise.criticism.improve import improved

ROWS = 128  # rows that darks and flats of the IMX541 and STL-1001 share
REPORTED_GAIN, REPORTED_READ_NOISE_E = 0.422149, 1.98


def captures(folder: Path, name: str):
    data = np.load(folder / f"{name}.npz")
    return data, json.loads((folder / f"{name}.json").read_text())["arrays"]


def stack_of(data, about, names, *, white_level):
    kinds = ["flat" if name.startswith("flat") else "dark" for name in names]
    return hsnoise.FrameStack(
        [data[name][:, :ROWS] for name in names],
        [about[name]["exposure_s"] for name in names],
        kind=kinds,
        white_level=white_level,
        shutter="global",
    )


def imx541(folder: Path, figure: Path) -> None:
    data, about = captures(folder, "imx541_mono_emva")
    darks = [name for name in data.files if name.startswith("dark")]
    flats = [name for name in data.files if name.startswith("flat")]
    print("\nIMX541, darks and flats (reported: 0.4221 DN/e-, read noise 1.98 e-)")
    for title, chosen in (
        ("all flats", flats),
        ("flats of 1000 to 3200 DN", [n for n in flats if 1000 < data[n].mean() < 3200]),
        ("flats below 700 DN", [n for n in flats if data[n].mean() < 700]),
    ):
        result = hsnoise.fit(stack_of(data, about, darks + chosen, white_level=4095))
        gain, read = result.table["gain"], result.table["read_noise.sigma"]
        print(
            f"{title}: gain {gain[0]:.4f} +- {gain[1]:.4f} DN/e- ({gain[0] / REPORTED_GAIN - 1:+.1%}),"
            f" read noise {read[0]:.3f} +- {read[1]:.3f} e- ({read[0] / REPORTED_READ_NOISE_E - 1:+.1%})"
        )
        if title == "all flats":
            print(result)
            draw_gain(result, figure)


def draw_gain(result, path: Path) -> None:
    """Local gain (excess of a level's temporal variance over its signal) of the flats against signal."""
    flats, table = result.summary.flats, result.table
    gain, read_noise_e, black_dn = (table[name][0] for name in ("gain", "read_noise.sigma", "black_level"))
    signal = flats.mean_dn[:, 0] - black_dn
    floor = (gain * read_noise_e) ** 2 + 1 / 12
    local = (flats.variance_dn2[:, 0] - floor) / signal
    error = flats.variance_dn2[:, 0] * np.sqrt(2 / flats.dof[:, 0]) / signal
    fig = Figure(figsize=(7, 4.2), layout="constrained")
    axis = fig.subplots()
    axis.errorbar(
        signal, local, 2 * error, fmt="o", color="#0072b2", capsize=3, label="each flat level, 2 standard errors"
    )
    axis.axhline(REPORTED_GAIN, color="#d55e00", ls="--", label="reported, 0.4221 DN/e-")
    axis.axhline(gain, color="k", lw=1, label=f"joint fit, {gain:.4f} DN/e-")
    axis.axhspan(REPORTED_GAIN * 0.98, REPORTED_GAIN * 1.02, color="#d55e00", alpha=0.1, label="reported, within 2 %")
    axis.set_xscale("log")
    axis.set_xlabel("signal above black (DN)")
    axis.set_ylabel("local gain: variance / signal (DN/e-)")
    axis.set_title("IMX541: the photon transfer line bends", loc="left")
    axis.legend(fontsize=8, loc="upper left")
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=120)
    print(f"figure: {path}")


def tc237(folder: Path) -> None:
    data, _ = captures(folder, "sbig_st7e_tc237_ccd_clipped")
    bias = data["bias"]
    print("\nTC-237, fraction of bias pixels clipped at 0")
    thirds = np.array_split(np.arange(bias.shape[2]), 3)
    modelled = measured = 0.0
    for title, columns in (
        ("whole frame", np.arange(bias.shape[2])),
        *((f"columns {t[0]}-{t[-1]}", t) for t in thirds),
    ):
        part = bias[:, :, columns[0] : columns[-1] + 1]
        result = hsnoise.fit(part, exposure_s=[0.0], white_level=65535, shutter="global")
        expected = result.expected_histograms()[0][0]
        fraction, clipped = expected[0] / expected.sum(), (part == 0).mean()
        print(f"{title}: measured {clipped:.5f}, model {fraction:.5f} ({fraction / clipped - 1:+.1%})")
        if title != "whole frame":
            modelled, measured = modelled + fraction * part.size, measured + clipped * part.size
    print(f"sum of the thirds: model {modelled / measured - 1:+.1%}")


def stl1001(folder: Path) -> None:
    data, about = captures(folder, "sbig_stl1001_ccd")
    print("\nSTL-1001, dark current (gain from the flats at -5 C)")
    for temperature in ("m05C", "m10C"):
        names = [n for n in data.files if temperature in n and not n.startswith("flat")]
        result = hsnoise.fit(stack_of(data, about, [*names, "flat_m05C_023s"], white_level=65535))
        rate = result.table["dark_current.rate"]
        print(f"{temperature}: {rate[0]:.3f} +- {rate[1]:.3f} e-/s per pixel")
        print(result)


def print_stories(folder: Path, only: list[str]) -> None:
    """Print the story of `hsnoise.improve` on the darks of each sensor, or of `only` these; for CCDs on a part."""
    stacks = {}
    data, about = captures(folder, "imx541_mono_emva")
    names = [name for name in data.files if name.startswith("dark")]
    stacks["IMX541"] = [data[n] for n in names], [about[n]["exposure_s"] for n in names], 4095
    bias = captures(folder, "sbig_st7e_tc237_ccd_clipped")[0]["bias"]
    stacks["TC-237"] = [bias[:, 100:300, 200:456]], [0.0], 65535
    data, about = captures(folder, "sbig_stl1001_ccd")
    names = ["bias_m05C", "dark_m05C_060s"]
    stacks["STL-1001"] = [data[n][:, :ROWS] for n in names], [about[n]["exposure_s"] for n in names], 65535
    for sensor, (counts, exposure_s, white_level) in stacks.items():
        if only and sensor not in only:
            continue
        print(f"\n{sensor}")
        stack = hsnoise.FrameStack(counts, exposure_s, white_level=white_level, shutter="global")
        with busy("Fitting the first model") as say:
            story = improved(stack, say)
        print(story)


def a7s2(folder: Path, path: Path) -> None:
    """Mean of dark frames above black against exposure; it falls if the camera subtracts too much."""
    data = np.load(folder / "a7s2_dark_mean_ladder.npz")
    order = np.argsort(data["exposure_s"])
    exposure_s, means = data["exposure_s"][order], data["mean_minus_black_dn"][:, order]
    fig = Figure(figsize=(7, 4.2), layout="constrained")
    axis = fig.subplots()
    for iso, colour in zip((1600, 6400, 12800, 25600), ("#999999", "#56b4e9", "#0072b2", "#d55e00"), strict=True):
        of = means[int(np.argmin(np.abs(data["iso"] - iso)))]
        axis.plot(exposure_s, of, "o-", ms=3, lw=1, color=colour, label=f"ISO {iso}")
        print(f"ISO {iso}: mean above black from {of[0]:+.1f} DN at {exposure_s[0]:.2g} s to {of[-1]:+.1f} DN at 30 s")
    axis.axhline(0, color="k", lw=0.8)
    axis.set_xscale("log")
    axis.set_xlabel("exposure (s)")
    axis.set_ylabel("mean of dark frames above black (DN)")
    axis.set_title("A7S2: dark means fall with exposure, a black clamp", loc="left")
    axis.legend(fontsize=8, loc="lower left")
    fig.savefig(path, dpi=120)
    print(f"figure: {path}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figure", type=Path, default=Path("docs/figures/imx541_gain.png"))
    parser.add_argument("--improve", action="store_true", help="find what the paper's model lacks for each sensor")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="SENSOR", help="with --improve: IMX541, TC-237, STL-1001"
    )
    arguments = parser.parse_args()
    beside = Path(__file__).resolve().parents[1].parent / "shared"
    folder = Path(os.environ.get("HSNOISE_SHARED", beside)) / "data"
    if not folder.is_dir():
        raise SystemExit(f"no captures in {folder}: set HSNOISE_SHARED to the folder that holds data/")
    if arguments.improve:
        a7s2(folder, arguments.figure.with_name("a7s2_dark_means.png"))
        print_stories(folder, arguments.only)
        return
    imx541(folder, arguments.figure)
    tc237(folder)
    stl1001(folder)


if __name__ == "__main__":
    main()
