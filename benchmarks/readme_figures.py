"""The two pictures at the head of the README: a dark frame beside samples, and the error over the steps of the story.

    python -m benchmarks.readme_figures

Fits the capture that comes with hsnoise as `hsnoise demo --real` does, and writes docs/figures/hero.png and story.png.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import hsnoise
from hsnoise import effects as fx
from hsnoise import plots
from hsnoise._output import write_figure
from hsnoise.draws import darks_of, draw_capture
from hsnoise.model import NoiseModel
from hsnoise.stack import FrameStack

ROWS, COLUMNS = slice(40, 200), slice(60, 300)  # of the frames that are shown
STRETCH = (1.0, 99.7)  # percentiles of the measured frame that are black and white
INK = ("#404040", "#0072B2", "#D55E00")


def textbook(stack: FrameStack, gain: float) -> NoiseModel:
    """Shot noise of the mean dark signal and Gaussian read noise, as strong as the noise of the longest darks."""
    counts = np.stack(list(stack.frames(len(stack.counts) - 1))).astype(float)
    noise_dn = np.sqrt(np.median(counts.var(0, ddof=1)))
    effects = [fx.ReadNoise(noise_dn / gain), fx.Gain(gain), fx.BlackLevel(float(counts.mean())), fx.ADC()]
    return NoiseModel([fx.ShotNoise(), *effects], cfa="mono", shutter=stack.shutter, exposure_s=stack.exposure_s[-1])


def hero(stack: FrameStack, model: NoiseModel) -> Figure:
    """A frame of the longest darks, one of the textbook model, one of the fitted model, and the row means below each."""
    darks = darks_of(stack)
    plain = textbook(darks, float(np.asarray(model["gain"].value).ravel()[0]))
    sides = [
        np.stack(list(of.frames(len(of.counts) - 1))).astype(float)
        for of in (darks, draw_capture(1, plain, darks), draw_capture(1, model, darks))
    ]
    level = np.median(sides[0])
    low, high = np.percentile(sides[0][0], STRETCH)
    figure = Figure(figsize=(12, 5.2), dpi=110, layout="constrained")
    axes = figure.subplots(2, 3, height_ratios=[2.2, 1], sharey="row")
    names = ("measured: a real dark frame", "textbook: Poisson and Gaussian", "drawn from the fitted model")
    for column, (frames, name, ink) in enumerate(zip(sides, names, INK, strict=True)):
        above, below = axes[:, column]
        above.imshow(
            frames[0][ROWS, COLUMNS], cmap="gray", vmin=low, vmax=high, interpolation="nearest", aspect="equal"
        )
        above.set_title(name, fontsize=12)
        above.set_xticks([])
        above.set_yticks([])
        columns = frames.mean(0).mean(0)
        below.plot(columns - np.median(columns), color=ink, linewidth=0.9)
        below.spines[["top", "right"]].set_visible(False)
    axes[1, 0].set_ylabel("column mean / DN")
    for below in axes[1]:
        below.set_xlabel("column")
    return figure


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.readme_figures", description=__doc__)
    parser.add_argument("--model", type=Path, help="a model.json instead of the loop")
    parser.add_argument("--out", type=Path, default=Path("docs/figures"))
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        stack = hsnoise.load(hsnoise.examples.st8(folder), progress=False)
        if args.model is None:
            story = hsnoise.improve(stack, progress=lambda text: print(text, file=sys.stderr))
            write_figure(args.out / "story.png", plots.story(story))
            model = story.params
        else:
            model = NoiseModel.load(args.model)
        write_figure(args.out / "hero.png", hero(stack, model))
    return 0


if __name__ == "__main__":
    sys.exit(main())
