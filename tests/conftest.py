"""Settings of all tests: float64, no silent broadcasting between ranks, the same random numbers in every run."""

from __future__ import annotations

import builtins
import gc
import importlib
import os
from pathlib import Path

import hypothesis
import jax
import numpy as np
import pytest

from hsnoise.chain.signals import apply_by_effect
from hsnoise.criticism import candidates

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

# Tracing makes millions of objects that stay: looking through them every 700 was a twentieth of the tests' time.
gc.set_threshold(50_000)

hypothesis.settings.register_profile("hsnoise", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("hsnoise")

# Twenty seconds and more each: one that began last would leave the other core idle.
LONG = (
    "test_docs.py",
    "test_report_browser.py",
    "test_contaminated.py",
    "test_contract.py",
    "test_loop.py",
    "test_row_spectrum.py",
    "test_cli.py",
    "test_doubts.py",
)


def pytest_collection_modifyitems(items):
    """Long files first, where a worker runs whole files in this order (`make test`)."""
    items.sort(key=lambda item: item.path.name not in LONG)


@pytest.fixture(autouse=True, scope="module")
def forget_compiled_programs():
    """Thousands of compiled programs would use up the memory maps that a process may have (65530 on Linux)."""
    yield
    maps = Path("/proc/self/maps")
    if not maps.exists() or len(maps.read_bytes().splitlines()) > 30_000:
        jax.clear_caches()


@pytest.fixture(autouse=True, scope="session")
def keep_compiled_programs(tmp_path_factory, worker_id):
    """On disk, for the modules to come and for the other workers: most of the tests' time is compilation.

    A folder named in $JAX_COMPILATION_CACHE_DIR is kept from run to run. Commands that tests start use it, too.
    """
    folder = tmp_path_factory.getbasetemp()
    folder = folder if worker_id == "master" else folder.parent  # workers have folders of their own in one
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    if jax.config.jax_compilation_cache_dir is None:
        jax.config.update("jax_compilation_cache_dir", str(folder / "compiled"))
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(jax.config.jax_compilation_cache_dir)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"


@pytest.fixture(autouse=True, scope="module")
def draw_effect_by_effect(request):
    """Compiles each effect once for all models that have it: a third of the time was compiling whole models.

    Modules about the compiled sampler are marked `in_one`; it draws the same counts, as tests/test_model.py shows.
    """
    with pytest.MonkeyPatch.context() as patch:
        if request.node.get_closest_marker("in_one") is None:
            patch.setattr("hsnoise.model.apply_in_one", apply_by_effect)
        yield


@pytest.fixture
def key():
    return jax.random.key(2019)


@pytest.fixture
def rng():
    return np.random.default_rng(2019)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with data/, cases/ and clips/: $HSNOISE_SHARED, or shared/ in or beside the repository."""
    root = Path(__file__).resolve().parents[1]
    named = os.environ.get("HSNOISE_SHARED")
    places = [Path(named)] if named else [root / "shared", root.parent / "shared"]
    for place in places:
        if (place / "data").is_dir():
            return place
    pytest.skip(f"no captures: looked for data/ in {', '.join(map(str, places))}; set HSNOISE_SHARED")


@pytest.fixture
def few_candidates(monkeypatch, request):
    """A library of the effects that the test's module names in FEW, for time's sake."""
    whole = candidates.built_in

    def some(facts):
        return {name: maker for name, maker in whole(facts).items() if name in request.module.FEW}

    monkeypatch.setattr(importlib.import_module("hsnoise.criticism.diagnose"), "built_in", some)


@pytest.fixture
def no_pandas(monkeypatch):
    """As if pandas were not installed."""
    real = builtins.__import__

    def without_pandas(name, *args, **keywords):
        if name == "pandas":
            raise ImportError(name)
        return real(name, *args, **keywords)

    monkeypatch.setattr(builtins, "__import__", without_pandas)
