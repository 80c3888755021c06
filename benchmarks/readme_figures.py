"""The two figures at the top of the README: a dark frame beside samples, and the error over the steps of the story.

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
from hsnoise._core.output import write_figure
from hsnoise.frames.stack import FrameStack
from hsnoise.model import NoiseModel
from hsnoise.simulation.draws import draw_capture
from hsnoise.simulation.portion import Portion

ROWS, COLUMNS = slice(10, 190), slice(20, 290)  # the part of the frames that is shown
STRETCH = (0.5, 99.9)  # percentiles of the measured frame shown as black and white
INK = ("#404040", "#0072B2", "#D55E00")
NAMES = ("measured: a CCD in the dark", "textbook model: Poisson and Gaussian", "what hsnoise made of it")


def textbook(stack: FrameStack, gain: float) -> NoiseModel:
    """Shot noise of the mean dark signal and Gaussian read noise, together as strong as that of the longest darks."""
    counts = np.stack(list(stack.frames(len(stack.counts) - 1))).astype(float)
    noise_dn = np.sqrt(np.median(counts.var(0, ddof=1)))
    effects = [fx.ReadNoise(noise_dn / gain), fx.Gain(gain), fx.BlackLevel(float(counts.mean())), fx.ADC()]
    return NoiseModel([fx.ShotNoise(), *effects], cfa="mono", shutter=stack.shutter, exposure_s=stack.exposure_s[-1])


def hero(stack: FrameStack, model: NoiseModel) -> Figure:
    """The mean of the longest darks, measured, of the textbook model and of the fitted one, with column means below."""
    darks = Portion.of(stack).darks.frames
    plain = textbook(darks, float(np.asarray(model["gain"].value).ravel()[0]))
    drawn = (darks, draw_capture(1, plain, darks), draw_capture(1, model, darks))
    means = [np.mean(list(of.frames(len(of.counts) - 1)), axis=0, dtype=float) for of in drawn]
    means = [one - np.median(one) for one in means]
    low, high = np.percentile(means[0][ROWS, COLUMNS], STRETCH)
    figure = Figure(figsize=(12, 5.4), dpi=110, layout="constrained")
    axes = figure.subplots(2, 3, height_ratios=[2.6, 1], sharey="row")
    for (above, below), mean, name, ink in zip(axes.T, means, NAMES, INK, strict=True):
        part = mean[ROWS, COLUMNS]
        above.imshow(part, cmap="gray", vmin=low, vmax=high, interpolation="nearest", aspect="auto")
        above.set_title(name, fontsize=13)
        above.set_xticks([])
        above.set_yticks([])
        below.plot(part.mean(0) - np.median(part.mean(0)), color=ink, linewidth=1.0)
        below.spines[["top", "right"]].set_visible(False)
        below.margins(x=0)
        below.set_xlabel("column")
    axes[1, 0].set_ylabel("column mean / DN")
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
