"""Stages go to the loggers below "hsnoise"; nothing is printed, and callbacks are told what they always were."""

from __future__ import annotations

import logging
import subprocess
import sys

import numpy as np
import pytest

import hsnoise
from hsnoise import effects as fx

MODEL = hsnoise.NoiseModel(
    [fx.ShotNoise(), fx.DarkCurrent(400.0), fx.ReadNoise(3.0), fx.Gain(2.0), fx.BlackLevel(100.0), fx.ADC()],
    cfa="mono",
    shutter="rolling",
    exposure_s=0.1,
)
EXPOSURE_S = (0.02, 0.1)
FEW = ("row_noise", "frame_offset")


def capture(model):
    counts = [np.asarray(hsnoise.sample_dark(i, 6, (32, 48), model, exposure_s=t)) for i, t in enumerate(EXPOSURE_S)]
    return hsnoise.FrameStack(counts, EXPOSURE_S, black_level=100)


def said(caplog, level):
    return [(r.name, r.getMessage()) for r in caplog.records if r.name.startswith("hsnoise.") and r.levelno == level]


@pytest.mark.slow
def test_a_fit_tells_its_stages_and_prints_nothing(caplog, capfd):
    stack = capture(MODEL)
    with caplog.at_level(logging.INFO, logger="hsnoise"):
        result = hsnoise.fit(stack, model=MODEL, pixels="alike")
    told = said(caplog, logging.INFO)
    assert {name for name, _ in told} == {"hsnoise.fit"}
    text = "\n".join(message for _, message in told)
    assert text.startswith("Reading 12 frames of 32 x 48 pixels\nMaximising the likelihood")
    assert f"Maximum likelihood, {result.iterations} iterations: " in text
    assert text.endswith(f"Fit: {result.conclusion}")
    assert not said(caplog, logging.DEBUG) and capfd.readouterr() == ("", "")
    caplog.clear()
    with caplog.at_level(logging.DEBUG, logger="hsnoise.fit"):
        hsnoise.fit(stack, model=MODEL, pixels="alike")
    assert ("hsnoise.fit", str(result)) in said(caplog, logging.DEBUG)


@pytest.mark.slow
def test_a_diagnosis_of_few_draws_tells_what_is_likely_and_what_is_missing(few_candidates, caplog, capfd):
    """With fewer draws than another step used to take, too."""
    ticks = []
    stack = capture(MODEL.add(fx.RowNoise(4.0)))
    with caplog.at_level(logging.DEBUG, logger="hsnoise"):
        found = hsnoise.diagnose(MODEL, stack, draws=16, progress=lambda: ticks.append(1))
    told = [message for name, message in said(caplog, logging.INFO) if name == "hsnoise.criticism.diagnose"]
    assert told[0] == "Drawing 16 captures from the model, and each of 2 candidates on top of it"
    assert told[1].startswith("Most likely at first: row_noise ") and told[-1] == f"Diagnosis: {found.conclusion}"
    assert found.names == ("row_noise",) and str(found) in [m for _, m in said(caplog, logging.DEBUG)]
    assert len(ticks) > 16 and capfd.readouterr() == ("", "")


LOOP = ("hsnoise.criticism.improve", "hsnoise.criticism.work")


def test_an_improvement_tells_what_is_tried_and_the_error_so_far(few_candidates, caplog, capfd):
    heard = []
    stack = capture(MODEL)
    with caplog.at_level(logging.INFO, logger="hsnoise"):
        story = hsnoise.improve(stack, model=MODEL, max_steps=0, progress=heard.append)
    told = [message for name, message in said(caplog, logging.INFO) if name in LOOP]
    stages = [sentence for sentence in heard if not sentence[-1].isdigit()]  # captures that are drawn are numbered
    assert heard[0] == stages[0] == told[0] == "Fitting the first model" and len(heard) > len(stages)
    assert [sentence for sentence in told if sentence in heard] == stages
    assert any(message.startswith("Error ") and message.endswith(" with the first model") for message in told)
    assert told[-1] == f"Improved: {story.ended}" and capfd.readouterr() == ("", "")


def test_the_library_is_silent_until_it_is_asked(tmp_path):
    code = """
import logging, hsnoise
assert [type(one) for one in logging.getLogger("hsnoise").handlers] == [logging.NullHandler]
assert not logging.getLogger().handlers and logging.getLogger("hsnoise").level == logging.NOTSET
logging.getLogger("hsnoise.fit").warning("a warning that nobody asked for")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
