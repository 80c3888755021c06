"""Files with one thing broken: read as clean ones, refused by name, or told; never a crash, hang or wrong number."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


def failures(first: int, end: int) -> tuple[list[str], int]:
    """What is wrong with cases `first` to `end` - 1, and how many were read.

    They are read in a process of their own, because importing takes longer than hundreds of them; it is started again
    after a case that ends it.
    """
    wrong, read = [], 0
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    while first < end:
        words = [sys.executable, str(HERE / "worker.py"), str(first), str(end)]
        done = subprocess.run(words, env=environment, capture_output=True, text=True)
        lines = [json.loads(line) for line in done.stdout.splitlines()]
        case, number = "before the first", end
        for line in lines:
            case, number = line.get("case", case), line.get("begins", number)
            read += "outcome" in line
            if line.get("outcome", "").startswith("wrong"):
                wrong.append(f"{number} {case}: {line['outcome']}")
        if done.returncode:
            how = signal.Signals(-done.returncode).name if done.returncode < 0 else done.stderr[-2000:]
            wrong.append(f"{number} {case}: ended the process, {how}")
        first = number + 1
    return wrong, read


def test_what_is_broken_is_told():
    wrong, read = failures(0, 300)
    assert not wrong, "\n".join(wrong)
    assert read == 300


@pytest.mark.slow
def test_what_is_broken_is_told_of_thousands():
    wrong, read = failures(300, 5300)
    assert not wrong, "\n".join(wrong)
    assert read == 5000
