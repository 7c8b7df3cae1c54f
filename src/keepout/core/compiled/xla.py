"""How XLA compiles Keepout's programs on a CPU: `jax.jit(function, compiler_options=...)`; elsewhere without effect."""

from typing import Any

NO_LIBRARIES: dict[str, str | bool] = {"xla_cpu_experimental_ynn_fusion_type": ""}
"""XLA's own products of matrices and sums. What it hands to a library otherwise is slower at a network's sizes, by a
tenth of a training step, and cannot be put into one kernel."""
WIDE: dict[str, Any] = NO_LIBRARIES | {"xla_cpu_prefer_vector_width": 512}
"""The same, with the widest vectors, for many points: exponentials and logarithms gain a few per cent."""
