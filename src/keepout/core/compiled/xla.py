"""How JAX and XLA are set, without importing JAX: what needs none must not wait for it.

Double precision holds from JAX's first import on. How XLA compiles a program on a CPU is said by
`jax.jit(function, compiler_options=...)`; elsewhere it has no effect.
"""

import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

NO_LIBRARIES: dict[str, str | bool] = {"xla_cpu_experimental_ynn_fusion_type": ""}
"""XLA's own products of matrices and sums. What it hands to a library otherwise is slower at a network's sizes, by a
tenth of a training step, and cannot be put into one kernel."""
WIDE: dict[str, Any] = NO_LIBRARIES | {"xla_cpu_prefer_vector_width": 512}
"""The same, with the widest vectors, for many points: exponentials and logarithms gain a few per cent."""


class _FirstImport:
    """Finds JAX as all others do, once, and has it switched to double precision as soon as it is loaded."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name != "jax" or self not in sys.meta_path:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec("jax")
        if spec is not None and spec.loader is not None:
            loader: Any = spec.loader
            load = loader.exec_module

            def loaded(module: ModuleType) -> None:
                load(module)
                _switch(module)

            loader.exec_module = loaded
        return spec


def require_double_precision() -> None:
    """Switch JAX to double precision: now if it is loaded, else when it is."""
    if "jax" in sys.modules:
        _switch(sys.modules["jax"])
    else:
        sys.meta_path.insert(0, _FirstImport())


def _switch(jax: Any) -> None:
    jax.config.update("jax_enable_x64", True)
