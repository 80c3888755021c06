"""Prints flags with which XLA compiles quickly: `make test` sets them."""

from __future__ import annotations

import jax

FLAGS = ["--xla_backend_optimization_level=1"]
FLAGS += ["--xla_cpu_parallel_codegen_split_count=1"]  # there is no idle core for the pieces
if jax.__version_info__ < (0, 12):  # later ones end the process at a flag that they do not know
    FLAGS += ["--xla_cpu_use_fusion_emitters=false"]

print(*FLAGS)
