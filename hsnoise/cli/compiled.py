"""Compiled programs, kept on disk from one command to the next: most of a command's first seconds are compilation."""

from __future__ import annotations

import hashlib
import os
import platform
import warnings
from pathlib import Path

import jax
from platformdirs import user_cache_path

MOST_BYTES = 1 << 29  # what was used longest ago goes first
KINDS = ("model name", "flags", "Features")  # lines of /proc/cpuinfo


def keep_compiled_programs() -> None:
    """Let JAX keep compiled programs in the user's cache folder, if it can be written.

    $JAX_COMPILATION_CACHE_DIR names another folder, or none if it is empty.
    """
    # A broken entry, which a command that was killed can leave, is compiled again.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache entry")
    if jax.config.jax_compilation_cache_dir is not None:
        return
    folder = user_cache_path("hsnoise") / "compiled" / _processor()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.W_OK):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", MOST_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def _processor() -> str:
    """A name for this kind of processor: home folders are shared, and a program of one may crash on another."""
    lines = [platform.machine(), platform.processor()]
    about = Path("/proc/cpuinfo")
    if about.exists():
        first = about.read_text().split("\n\n")[0].splitlines()
        lines += [line for line in first if line.split(":")[0].strip() in KINDS]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]
