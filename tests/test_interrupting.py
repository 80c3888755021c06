"""Ctrl-C, at any moment, and a reader that goes away: real processes, real signals."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import hsnoise

ROOT = Path(__file__).parents[1]
MODULE = [sys.executable, "-m", "hsnoise"]
# A process that hsnoise takes for its command line, with code of a test in it.
AS_COMMAND = "import sys; sys.argv = ['hsnoise']\n"

pytestmark = pytest.mark.skipif(os.name == "nt", reason="Windows has other signals")


@pytest.fixture(autouse=True, scope="module")
def heed_ctrl_c():
    """Tests that a shell started in the background ignore it, and so would the processes that they start."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def darks(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("darks") / "darks.npz"
    camera = hsnoise.cameras.grasshopper3(black_level_dn=64)
    rng = np.random.default_rng(0)
    counts = [rng.poisson(level, (3, 64, 64)) for level in (70, 90)]
    np.savez(path, counts=np.array(counts, np.uint16), exposure_s=[0.1, 0.4], cfa="mono", shutter=camera.shutter)
    return path


def start(words: list[str]) -> subprocess.Popen:
    return subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(process: subprocess.Popen, text: str) -> str:
    """What is said until a line holds `text`."""
    said = ""
    while text not in said:
        line = process.stderr.readline()
        assert line, f"ended before {text!r}: {said}"
        said += line
    return said


def wait_for_imports(process: subprocess.Popen) -> None:
    """Until the process has begun to import what is slow; what comes before is Python's own."""
    maps, ends = Path(f"/proc/{process.pid}/maps"), time.monotonic() + 60
    if not maps.parent.exists():
        time.sleep(1.0)
        return
    while "_multiarray_umath" not in maps.read_text() and time.monotonic() < ends:
        time.sleep(0.01)


def interrupted(process: subprocess.Popen, twice: bool = False) -> str:
    """Send Ctrl-C; what the process says after it, having ended as it should."""
    process.send_signal(signal.SIGINT)
    if twice:
        process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, (process.returncode, out, err)
    assert "Traceback" not in out + err and err.splitlines()[-1].startswith("hsnoise: interrupted")
    assert err.count("interrupted") == 1
    return err


@pytest.mark.parametrize("delay_s", [pytest.param(0.0, marks=pytest.mark.slow), 0.3])
def test_while_modules_are_imported(delay_s, darks, tmp_path):
    process = start([*MODULE, "fit", str(darks), "--out", str(tmp_path / "out")])
    wait_for_imports(process)
    time.sleep(delay_s)
    interrupted(process)
    assert "model.json" not in os.listdir(tmp_path / "out" if (tmp_path / "out").exists() else tmp_path)


@pytest.mark.parametrize("twice", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["once", "twice"])
def test_while_a_fit_is_compiled(twice, darks, tmp_path):
    process = start([*MODULE, "fit", str(darks), "--out", str(tmp_path / "out")])
    wait_for(process, "Fitting")
    time.sleep(0.7)
    interrupted(process, twice)
    assert os.listdir(tmp_path / "out") == []


@pytest.mark.slow
def test_while_captures_are_drawn_in_threads(darks, tmp_path):
    process = start(
        [*MODULE, "compare", str(darks), "--model", "grasshopper3", "--cfa", "RGGB", "--out", str(tmp_path)]
    )
    wait_for(process, "Drawing")
    time.sleep(0.7)
    interrupted(process)
    assert os.listdir(tmp_path) == []


def test_while_python_code_and_threads_run():
    """A handler of Python's would have to wait for the thread that does not end."""
    code = """
import threading, time
from concurrent.futures import ThreadPoolExecutor
import hsnoise
from hsnoise._core import interrupting as _interrupting
_interrupting.on_disk("the model so far is in out/model.json")
with ThreadPoolExecutor() as pool:
    pool.submit(lambda: time.sleep(600))
    try:
        print("ready", file=sys.stderr, flush=True)
        time.sleep(600)
    except BaseException:
        print("swallowed", file=sys.stderr, flush=True)
"""
    process = start([sys.executable, "-c", AS_COMMAND + code])
    wait_for(process, "ready")
    said = interrupted(process)
    assert said == "hsnoise: interrupted; the model so far is in out/model.json\n"


def test_a_half_written_file_is_removed_and_the_old_one_stays(tmp_path):
    path = tmp_path / "model.json"
    path.write_text("old")
    code = f"""
import os, time
from hsnoise._core import output as _output
def slow(_):
    print("ready", file=sys.stderr, flush=True)
    time.sleep(600)
_output.os.fsync = slow
_output.write_atomically({str(path)!r}, b"new")
"""
    process = start([sys.executable, "-c", AS_COMMAND + code])
    wait_for(process, "ready")
    assert len(os.listdir(tmp_path)) == 2
    interrupted(process)
    assert os.listdir(tmp_path) == ["model.json"] and path.read_text() == "old"


def interrupted_when_ready(code: str) -> tuple[int, str]:
    """Exit status and standard error of code that is interrupted once it has said that it is ready."""
    process = start([sys.executable, "-c", AS_COMMAND + code])
    wait_for(process, "ready")
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    return process.returncode, err


def test_work_that_keeps_what_it_has_is_given_the_exception():
    code = """
import time
from hsnoise._core import interrupting as _interrupting
with _interrupting.as_exception():
    try:
        print("ready", file=sys.stderr, flush=True)
        time.sleep(600)
    except KeyboardInterrupt:
        print("kept", file=sys.stderr)
        sys.exit(0)
"""
    assert interrupted_when_ready(code) == (0, "kept\n")


@pytest.mark.slow
def test_after_the_work_it_changes_nothing():
    code = """
import time
from hsnoise.cli.main import main
status = main([])
print("ready", file=sys.stderr, flush=True)
time.sleep(2)
sys.exit(status)
"""
    assert interrupted_when_ready(code) == (2, "")


def test_other_processes_are_left_as_they_are():
    code = """
import signal, threading
import hsnoise, hsnoise.cli.main
assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
assert signal.set_wakeup_fd(-1) == -1
assert threading.active_count() == 1
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


@pytest.mark.parametrize(
    "words",
    [pytest.param(["--help"], marks=pytest.mark.slow), pytest.param(["inspect"], marks=pytest.mark.slow), ["sample"]],
    ids=lambda words: words[0],
)
def test_a_reader_that_is_gone_is_no_error(words, darks, tmp_path):
    more = {
        "inspect": [str(darks)],
        "sample": ["grasshopper3", "--frames", "2", "--shape", "8x8", "--out", str(tmp_path / "frames.npz")],
    }
    process = start([*MODULE, *words, *more.get(words[0], [])])
    with process:
        process.stdout.close()
        err = process.stderr.read()
    assert process.returncode in ((0, 141) if words == ["--help"] else (141,))  # argparse takes no note of it
    assert "Traceback" not in err and "BrokenPipe" not in err and "Broken pipe" not in err
    assert words != ["sample"] or hsnoise.load(tmp_path / "frames.npz").n_frames == (2,)


@pytest.mark.slow
def test_at_random_moments(darks, tmp_path):
    rng = np.random.default_rng()
    ended = []
    for i in range(30):
        out = tmp_path / str(i)
        sample = ["sample", "canon_5d3", "--frames", "60", "--out", f"{out}.npz"]
        words = [["fit", str(darks), "--out", str(out)], ["improve", str(darks), "--out", str(out)], sample][i % 3]
        process = start([*MODULE, *words])
        wait_for_imports(process)
        delay_s = rng.uniform(0, (12, 60, 5)[i % 3])
        try:
            process.wait(delay_s)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
            if i % 2:
                time.sleep(rng.uniform(0, 0.05))
                process.send_signal(signal.SIGINT)
        text = "".join(process.communicate(timeout=60))
        ended.append(process.returncode)
        assert process.returncode in (0, 130), (words, delay_s, process.returncode, text)
        assert "Traceback" not in text and (process.returncode == 0) != ("hsnoise: interrupted" in text), (words, text)
        assert not list(tmp_path.rglob("*.tmp"))
        for path in tmp_path.rglob("model.json"):
            hsnoise.NoiseModel.load(path)
    assert ended.count(130) >= 10


@pytest.mark.slow
def test_a_loop_leaves_its_last_model(darks, tmp_path):
    process = start([*MODULE, "improve", str(darks), "--out", str(tmp_path)])
    wait_for(process, "looking for what is missing")
    assert interrupted(process).splitlines()[-1].endswith(f"the model so far is in {tmp_path / 'model.json'}")
    assert "Not finished" in (tmp_path / "story.txt").read_text()
    hsnoise.NoiseModel.load(tmp_path / "model.json")
