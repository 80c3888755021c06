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
        np.testing.assert_allclose(a.flats.mean_dn, b.flats.mean_dn, rtol=1e-12)


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


@pytest.mark.slow
def test_worker_that_is_lost_changes_nothing(counts, cluster, tmp_path):
    lazy = da.from_array(counts, chunks=(1, 1, 64, 96)).map_blocks(pid_after_a_while, tmp_path, meta=counts[:0])
    lost = []

    def kill_a_reader():
        workers = set(cluster.run(os.getpid).values())
        while not (readers := workers & {int(path.name) for path in tmp_path.iterdir()}):
            time.sleep(0.02)
        lost.append(readers.pop())
        os.kill(lost[0], 9)

    killer = threading.Thread(target=kill_a_reader)
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
