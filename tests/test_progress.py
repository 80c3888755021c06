"""Progress: what a line of it says, and that it comes however long one computation takes."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import pytest

from hsnoise._core.events import Event, counter
from hsnoise.cli import progress as _progress
from hsnoise.cli.progress import Account, busy


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_the_time_left_follows_from_the_rate_of_the_stage(clock):
    account = Account(Event("Fitting the first model"), clock=clock)
    assert account.line() == "[0:00] Fitting the first model"
    clock.now_s += 100
    adding = Event("Step 2: adding row_noise", "error 26.3 -> 1.6", total=60)
    assert account.tell(replace(adding, done=1))
    clock.now_s += 50
    assert not account.tell(replace(adding, done=25))
    assert account.line() == "[2:30] Step 2: adding row_noise, draw 25 of 60; error 26.3 -> 1.6; about 1:10 left"
    account.tell(replace(adding, done=24))  # of a thread that was overtaken
    assert "draw 25 of 60" in account.line()


def test_an_event_is_a_sentence_for_users():
    said: list[Event] = []
    tick = counter(said.append, Event("Step 1: adding row_noise", "error 26.3"), 60)
    tick(), tick()
    assert str(said[1]) == "Step 1: adding row_noise; error 26.3: 2 of 60"
    assert str(Event("Looking", done=7)) == "Looking: 7" and str(Event("Looking", "error 2")) == "Looking; error 2"


def test_what_is_not_known_is_not_said(clock):
    account = Account(Event("Looking"), clock=clock)
    account.tell(Event("Looking", done=7))
    clock.now_s += 3600
    assert account.line() == "[1:00:00] Looking, draw 7"
    account.tell(Event("Looking", done=8, total=8))
    assert account.line() == "[1:00:00] Looking, draw 8 of 8"


def test_the_time_left_is_at_most_what_the_limit_leaves(clock):
    account = Account(Event("Looking"), minutes=2, clock=clock)
    clock.now_s += 30
    account.tell(Event("Looking", done=1))
    assert account.line().endswith("; at most 1:30 left")
    account.tell(Event("Looking", done=1, total=1000))
    assert account.line().endswith("; about 1:30 left")
    account.tell(Event("Fitting"))
    clock.now_s += 1000
    assert account.line() == "[17:10] Fitting"


def test_a_narrow_terminal_has_the_time_rather_than_the_error(clock):
    account = Account(Event("Step 1: looking", "error 26.3"), minutes=2, clock=clock)
    assert account.line(80) == "[0:00] Step 1: looking; error 26.3; at most 2:00 left"
    assert account.line(40) == "[0:00] Step 1: looking; at most 2:00 left"


def test_each_stage_is_one_line(capsys):
    with busy("Reading", of="frame") as say:
        for i in range(1, 4):
            say(Event("Reading", done=i, total=3))
        say(Event("Fitting"))
        say(Event("Fitting"))
    shown = capsys.readouterr()
    assert [line.split("] ")[1] for line in shown.err.splitlines()] == ["Reading", "Fitting"]
    assert not shown.out


def test_a_line_comes_while_one_computation_lasts(monkeypatch, capsys):
    monkeypatch.setattr(_progress, "EVERY_S", 0.01)
    before, said, ends = threading.active_count(), "", time.monotonic() + 60
    with busy("Computing"):
        while said.count("Computing") < 4 and time.monotonic() < ends:
            time.sleep(0.01)
            said += capsys.readouterr().err
    assert said.count("Computing") >= 4
    assert threading.active_count() == before


def test_the_thread_ends_with_an_error(monkeypatch):
    before = threading.active_count()
    with pytest.raises(KeyError), busy("Computing"):
        raise KeyError
    assert threading.active_count() == before


def test_the_terminal_has_a_line_that_goes_away(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    with busy("Reading", of="frame") as say:
        say(Event("Reading", done=2, total=3))
        time.sleep(0.3)  # it is drawn ten times a second
    said = capsys.readouterr().err
    assert "Reading, frame 2 of 3" in said and said.endswith("\x1b[2K")
