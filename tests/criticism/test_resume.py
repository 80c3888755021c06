"""Stories on disk: they come back to the last bit, and go on to the end that they would have reached."""

from __future__ import annotations

import dataclasses
import json

import jax
import numpy as np
import pytest

import hsnoise
from hsnoise.criticism import Candidate, Diagnosis, Step, Story, Verdict, write_story
from hsnoise.criticism.compare import Comparison
from hsnoise.criticism.finding import Unexplained
from hsnoise.criticism.outcomes import Ended, Ending
from hsnoise.criticism.resume import OF_FRAMES, read_story, steps_of
from hsnoise.criticism.shares import Share
from hsnoise.effects import BlackClamp, RowNoise
from hsnoise.fitting.result import Method, Status

CAMERA = hsnoise.cameras.grasshopper3(black_level_dn=64)
SEED = 3


def capture(seed: int) -> hsnoise.FrameStack:
    model, exposure_s = CAMERA.add(RowNoise(1.5)), (0.05, 0.4)
    counts = [
        np.asarray(hsnoise.sample_dark(jax.random.key(seed + i), 8, (32, 48), model, exposure_s=t, sensor_key=1))
        for i, t in enumerate(exposure_s)
    ]
    return hsnoise.FrameStack(counts, exposure_s, black_level=64, cfa=CAMERA.cfa, shutter="global")


@pytest.fixture(scope="module")
def stack():
    return capture(0)


@pytest.fixture(scope="module")
def story(stack):
    """A story of a step whose fit came from simulation, without the draws that make one."""
    first = hsnoise.fit(stack, method="line")
    share = Share(0.05, "G", "row_x_frame", 1 / 3, 0.01, 0.3, 0.2, 17.1)
    rows = (("noise: a", "noise", 1 / 7, 0.1, 2.2), ("tails: b", "tails", 0.0, -0.1, float("nan")))
    comparison = Comparison(7.7, {"noise": 2.5, "tails": 0.5}, rows, ("a",), 0.02, float("nan"), (), 0.1, (share,))
    candidates = (
        Candidate("row_noise", RowNoise(1 / 3, 0.7, after_gain=True), 31.7, 1e-12, float("inf")),
        Candidate("black_clamp", BlackClamp(60.0), 2.0, 0.1, 3.0),  # one number for all channels
    )
    found = Diagnosis(
        candidates, Verdict.NAMED, candidates[0], ("row_noise",), "", Unexplained(2.0, "noise", ("a (z = +3.1)",))
    )
    with jax.enable_x64(True):
        model = first.params.add(RowNoise(np.float64(np.pi / 2)))
    added = dataclasses.replace(
        first,
        params=model,
        names=(*first.names, "row_noise.sigma"),
        covariance=np.diag(np.arange(1.0, len(first.names) + 2) / 3),
        method=Method.SYNTHETIC,
        status=Status.MET,
        log_likelihood=float("nan"),
    )
    steps = (
        Step(first, comparison, found, None, -0.1, ()),
        Step(added, comparison, None, "row_noise", float("nan"), ("gain moved",), 4.5),
    )
    return Story(steps, Ending(Ended.UNFINISHED), seed=SEED)


@pytest.fixture
def file(story, tmp_path):
    write_story(tmp_path / "story.json", story)
    return tmp_path / "story.json"


def again(stack):
    return lambda model, follow: hsnoise.fit(stack, method="line")


def test_a_story_comes_back_to_the_last_bit(story, file, stack):
    steps = steps_of(read_story(file, SEED, ()), again(stack), None)
    for step, before in zip(steps, story.steps, strict=True):
        for name in ("added", "held_out", "moved", "ahead"):
            np.testing.assert_equal(getattr(step, name), getattr(before, name))
        np.testing.assert_equal(vars(step.comparison), vars(before.comparison))
        for field in dataclasses.fields(before.fit):
            if field.name not in ("params", *OF_FRAMES):
                np.testing.assert_equal(getattr(step.fit, field.name), getattr(before.fit, field.name))
        assert jax.tree.structure(step.fit.params) == jax.tree.structure(before.fit.params)
        for one, other in zip(jax.tree.leaves(step.fit.params), jax.tree.leaves(before.fit.params), strict=True):
            assert one.dtype == other.dtype and np.array_equal(one, other)
        assert step.fit.stack is stack
    ranking = steps[0].diagnosis.ranking
    assert [one.score for one in ranking] == [31.7, 2.0] and ranking[0].effect.after_gain
    assert steps[0].diagnosis.best.name == "row_noise" and steps[0].diagnosis.verdict is Verdict.NAMED


def test_a_story_of_other_frames_or_another_seed_is_refused(file):
    with pytest.raises(ValueError, match="seed: expected 3, with which .* was begun, got 4"):
        read_story(file, 4, ())
    with pytest.raises(ValueError, match="resume: the first fit comes out differently from that of .*story.json"):
        steps_of(read_story(file, SEED, ()), again(capture(7)), None)


@pytest.mark.parametrize(
    "broken",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "[" * 10_000,
        lambda text: text.replace('"held_out": -0.1', '"held_out": -0.2'),
        lambda text: text.replace("31.7", "1" + "0" * 400),
        lambda text: text.replace('"hsnoise story"', '"hsnoise noise model"'),
        lambda text: text.replace('"Comparison"', '"Popen"'),
        lambda text: text.replace('"row_noise"', '"no_such_effect"'),
        lambda text: json.dumps({**json.loads(text), "steps": []}),
        lambda text: json.dumps({**json.loads(text), "steps": {}}),
    ],
)
def test_what_is_no_story_is_refused_in_a_sentence(broken, file):
    file.write_text(broken(file.read_text()))
    with pytest.raises(ValueError, match=r"story.json: expected a story that improve saved"):
        read_story(file, SEED, ())


def test_measured_arrays_have_no_place_in_it(story, tmp_path):
    whole = story.fit.params.add(hsnoise.effects.MeasuredMap(offset=np.zeros((32, 48), np.float32)))
    closed = dataclasses.replace(story.steps[0], fit=dataclasses.replace(story.fit, params=whole))
    with pytest.raises(TypeError, match="expected values of a story, got MeasuredMap"):
        write_story(tmp_path / "story.json", dataclasses.replace(story, steps=(closed,)))
