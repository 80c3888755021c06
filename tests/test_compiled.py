"""Commands keep compiled programs in the user's cache folder, or where the user says, or not at all."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

RUN = """
import jax
from hsnoise.cli.compiled import keep_compiled_programs

keep_compiled_programs()
print(jax.config.jax_compilation_cache_dir, float(jax.jit(lambda x: x + 1.0)(2.0)), sep="|")
"""


def told(cache, **env) -> tuple[str, str]:
    """The folder that JAX keeps programs in, and what was printed to standard error."""
    env = {name: of for name, of in os.environ.items() if "CACHE" not in name} | {"XDG_CACHE_HOME": str(cache), **env}
    found = subprocess.run([sys.executable, "-c", RUN], env=env, capture_output=True, text=True, check=True)
    folder, value = found.stdout.split("|")
    assert float(value) == 3.0
    return folder, found.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other folders")
def test_programs_are_kept_and_broken_ones_are_compiled_again(tmp_path):
    folder, _ = told(tmp_path)
    assert folder.startswith(str(tmp_path / "hsnoise" / "compiled"))
    kept = list((tmp_path / "hsnoise").rglob("*-cache"))
    assert kept
    for one in kept:
        one.write_bytes(one.read_bytes()[:20])  # as if the command that wrote it had been killed
    assert told(tmp_path) == (folder, "")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other folders")
def test_a_folder_that_cannot_be_made_is_no_error(tmp_path):
    (tmp_path / "file").write_text("")
    assert told(tmp_path / "file") == ("None", "")


@pytest.mark.slow
def test_the_user_may_say_where_or_that_nothing_is_kept(tmp_path):
    assert told(tmp_path, JAX_COMPILATION_CACHE_DIR=str(tmp_path / "own"))[0] == str(tmp_path / "own")
    told(tmp_path, JAX_COMPILATION_CACHE_DIR="")
    assert not (tmp_path / "hsnoise").exists()
