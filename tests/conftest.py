"""Settings of all tests: float64, no silent broadcasting between ranks, the same random numbers in every run."""

from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import jax
import numpy as np
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

hypothesis.settings.register_profile("hsnoise", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("hsnoise")


@pytest.fixture(autouse=True, scope="module")
def forget_compiled_programs():
    """Thousands of compiled programs would use up the memory maps that a process may have (65530 on Linux)."""
    yield
    jax.clear_caches()


@pytest.fixture(autouse=True, scope="session")
def keep_compiled_programs(tmp_path_factory, worker_id):
    """On disk, for the modules to come and for the other workers: most of the tests' time is compilation."""
    folder = tmp_path_factory.getbasetemp()
    folder = folder if worker_id == "master" else folder.parent  # workers have folders of their own in one
    jax.config.update("jax_compilation_cache_dir", str(folder / "compiled"))


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
