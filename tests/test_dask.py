"""Captures as Dask arrays: read and reduced on the workers of a cluster, one of which is lost."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import hsnoise
from hsnoise.likelihood.summary import summarise
from hsnoise.statistics.pixels.survey import survey

da = pytest.importorskip("dask.array")
distributed = pytest.importorskip("distributed")

EXPOSURE_S = (0.02, 0.1)
CAPTURE = {"exposure_s": EXPOSURE_S, "black_level": 64, "white_level": 65535, "cfa": "RGGB", "shutter": "global"}


@pytest.fixture(scope="module")
def counts():
    rng = np.random.default_rng(3)
    electrons = rng.poisson(118 * np.array(EXPOSURE_S)[:, None, None, None], (2, 12, 64, 96)) + rng.normal(
        0, 2.3, (2, 12, 64, 96)
    )
    return np.clip(np.rint(64 + 3.5 * electrons), 0, 65535).astype(np.uint16)


@pytest.fixture(scope="module")
def cluster():
    """Three processes on this machine."""
    with (
        distributed.LocalCluster(n_workers=3, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


def same(a, b):
    for one, other in zip(a.histograms, b.histograms, strict=True):
        np.testing.assert_array_equal(one.counts, other.counts)
        np.testing.assert_allclose(one.row_sum_of_squares, other.row_sum_of_squares, rtol=1e-12)
    if a.flats is not None:
        np.testing.assert_allclose(a.flats.variance_dn2, b.flats.variance_dn2, rtol=1e-6)
        np.testing.assert_allclose(a.flats.mean_dn, b.flats.mean_dn, rtol=1e-7)  # float32 sums, in another order


def test_summary_is_that_in_memory(counts):
    lazy = da.from_array(counts, chunks=(1, 5, 64, 96))
    same(summarise(hsnoise.FrameStack(lazy, **CAPTURE)), summarise(hsnoise.FrameStack(counts, **CAPTURE)))


@pytest.mark.slow
def test_flats_are_summed_on_the_workers(counts, cluster):
    kinds = {"kind": ["dark", "flat"]}
    lazy = da.from_array(counts, chunks=(1, 1, 64, 96))
    in_memory = summarise(hsnoise.FrameStack(counts, **CAPTURE, **kinds))
    same(summarise(hsnoise.FrameStack(lazy, **CAPTURE, **kinds)), in_memory)


def pid_after_a_while(frame, folder):
    """The frame; who read it leaves its number in the folder."""
    (folder / str(os.getpid())).touch()
    time.sleep(0.1)
    return frame


def counted(block, folder, block_info=None):
    """The block; a byte in a file of its own tells that it was read."""
    if block_info and block_info[0]["array-location"]:
        where = "_".join(str(start) for start, _ in block_info[0]["array-location"][:2])
        with (folder / where).open("ab") as file:
            file.write(b".")
    return block


@pytest.mark.parametrize("frames_of_a_chunk", [pytest.param(1, marks=pytest.mark.slow), 4])
@pytest.mark.parametrize("job", ["budget", "inspect", "compare", "fit"])
def test_each_frame_is_read_once_or_twice(job, frames_of_a_chunk, differing, tmp_path):
    """And a few of them, at the ends of an exposure, once or twice more, to choose bins and to be checked."""
    lazy = da.from_array(differing, chunks=(1, frames_of_a_chunk, 64, 96)).map_blocks(
        counted, tmp_path, meta=differing[:0]
    )
    stack = hsnoise.FrameStack(lazy, **CAPTURE)
    model = hsnoise.cameras.grasshopper3(black_level_dn=64)
    for path in tmp_path.iterdir():  # what Dask asked to know the array's kind
        path.unlink()
    hsnoise.compare(model, stack) if job == "compare" else getattr(hsnoise, job)(stack)
    reads = np.array([path.stat().st_size for path in tmp_path.iterdir()])
    chunks = differing.shape[0] * differing.shape[1] // frames_of_a_chunk
    passes = 2 if job == "fit" else 1
    assert len(reads) == chunks and np.median(reads) == passes
    assert reads.sum() <= passes * chunks + 6 * len(EXPOSURE_S)


@pytest.fixture(scope="module")
def differing():
    """Pixels that differ in offset and dark current."""
    rng = np.random.default_rng(5)
    dark = rng.gamma(4, 30, (64, 96)) * np.array(EXPOSURE_S)[:, None, None, None]
    electrons = rng.poisson(dark, (2, 24, 64, 96)) + rng.normal(0, 2, (2, 24, 64, 96))
    counts = 64 + rng.normal(0, 3, (64, 96)) + 3.5 * electrons
    return np.clip(np.rint(counts), 0, 65535).astype(np.uint16)


def test_a_survey_of_a_dask_array_is_that_in_memory_to_the_last_bit(differing):
    lazy = da.from_array(differing, chunks=(1, 5, 64, 96))
    one, other = (survey(hsnoise.FrameStack(counts, **CAPTURE)) for counts in (lazy, differing))
    for a, b in zip(one.groups, other.groups, strict=True):
        assert a.planes[0].components == b.planes[0].components
        np.testing.assert_array_equal(a.planes[0].halves.level_dn, b.planes[0].halves.level_dn)
        np.testing.assert_array_equal(a.clipped_share, b.clipped_share)


@pytest.mark.slow
def test_doubts_of_many_frames_are_those_in_memory():
    """With 200 frames the noise of each pixel is known so well that bright ones stand out of the drawn, of eight."""
    rng, exposures_s = np.random.default_rng(6), (0.02, 0.5, 2.0)
    dark, offset = rng.exponential(20, (48, 64)), rng.normal(0, 4, (48, 64))
    counts = [
        100 + offset + 2 * (rng.poisson(dark * t, (200, 48, 64)) + rng.normal(0, 2, (200, 48, 64))) for t in exposures_s
    ]
    counts = np.clip(np.rint(counts), 0, 4095).astype(np.uint16)
    known = {"exposure_s": exposures_s, "black_level": 100, "white_level": 4095, "shutter": "global"}
    lazy, whole = (hsnoise.fit(of, **known) for of in (da.from_array(counts, chunks=(1, 50, 48, 64)), counts))
    assert len(lazy.doubts) == len(whole.doubts) and not any("noise" in sentence for sentence in lazy.doubts)
    assert lazy.table["gain"][0] == pytest.approx(2.0, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("job", ["budget", "inspect", "compare", "fit"])
def test_a_worker_that_is_lost_changes_no_result(job, differing, cluster, tmp_path):
    lazy = da.from_array(differing, chunks=(1, 1, 64, 96)).map_blocks(pid_after_a_while, tmp_path, meta=differing[:0])
    model = hsnoise.cameras.grasshopper3(black_level_dn=64)

    def done(counts):
        stack = hsnoise.FrameStack(counts, **CAPTURE)
        return hsnoise.compare(model, stack) if job == "compare" else getattr(hsnoise, job)(stack)

    undisturbed = str(done(differing))
    lost = []
    killer = threading.Thread(target=kill_a_reader, args=(cluster, tmp_path, lost))
    killer.start()
    disturbed = str(done(lazy))
    killer.join()
    assert disturbed == undisturbed
    assert lost[0] not in cluster.run(os.getpid).values()


def kill_a_reader(cluster, folder, lost):
    """Kill a worker that has read a frame; the number of its process goes into `lost`."""
    for path in folder.iterdir():
        path.unlink()
    workers = set(cluster.run(os.getpid).values())
    while not (readers := workers & {int(path.name) for path in folder.iterdir()}):
        time.sleep(0.02)
    lost.append(readers.pop())
    os.kill(lost[0], 9)


@pytest.mark.slow
def test_worker_that_is_lost_changes_nothing(counts, cluster, tmp_path):
    lazy = da.from_array(counts, chunks=(1, 1, 64, 96)).map_blocks(pid_after_a_while, tmp_path, meta=counts[:0])
    lost = []
    killer = threading.Thread(target=kill_a_reader, args=(cluster, tmp_path, lost))
    killer.start()
    from_workers = summarise(hsnoise.FrameStack(lazy, **CAPTURE))
    killer.join()
    same(from_workers, summarise(hsnoise.FrameStack(counts, **CAPTURE)))
    assert lost[0] not in cluster.run(os.getpid).values()


@pytest.mark.slow
def test_cluster_that_goes_away_is_told(counts, tmp_path):
    started = [sys.executable, "-m"]
    options = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    address = tmp_path / "scheduler.json"
    scheduler = subprocess.Popen(
        [*started, "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", address],
        **options,
    )
    worker = subprocess.Popen(
        [*started, "distributed.cli.dask_worker", "--scheduler-file", address, "--nthreads", "1", "--no-dashboard"],
        **options,
    )
    try:
        # It waits for the file of the scheduler.
        with distributed.Client(scheduler_file=str(address), timeout=30) as client:
            client.wait_for_workers(1, timeout=60)
            lazy = da.from_array(counts, chunks=(1, 1, 64, 96)).map_blocks(pid_after_a_while, tmp_path, meta=counts[:0])
            killer = threading.Thread(target=kill_once_read, args=([scheduler, worker], tmp_path))
            killer.start()
            with pytest.raises(RuntimeError, match=r"frame \d+ of .*exposure \d.*: lost the cluster"):
                hsnoise.fit(lazy, **CAPTURE)
            killer.join()
    finally:
        scheduler.kill(), worker.kill()


def kill_once_read(processes, folder):
    while not any(path.name.isdigit() for path in folder.iterdir()):
        time.sleep(0.02)
    for process in processes:
        process.kill()


@pytest.mark.slow
def test_fit_of_a_dask_array_is_that_in_memory(counts):
    lazy = da.from_array(counts, chunks=(1, 4, 64, 96))
    one, other = hsnoise.fit(lazy, **CAPTURE), hsnoise.fit(counts, **CAPTURE)
    for name, (value, error, _) in one.table.items():
        assert value == pytest.approx(other.table[name][0], rel=1e-6), (name, error)


def test_bad_frame_is_named(counts):
    bad = counts.astype(np.float32)
    bad[1, 7, 3, 3] = np.nan
    with pytest.raises(ValueError, match=r"frame 7 of (dark )?exposure 1"):
        summarise(hsnoise.FrameStack(da.from_array(bad, chunks=(1, 1, 64, 96)), **CAPTURE))


def test_a_chunk_that_cannot_be_read_says_where(counts):
    def gone(block, block_info=None):
        if block_info[0]["chunk-location"][0] == 1:
            raise OSError("disk on fire")
        return block

    lazy = da.from_array(counts, chunks=(1, 4, 64, 96)).map_blocks(gone, meta=counts[:0])
    stack = hsnoise.FrameStack(lazy, **CAPTURE)
    with pytest.raises(OSError, match="disk on fire") as told:
        summarise(stack)
    assert "exposure 1" in " ".join(told.value.__notes__)
