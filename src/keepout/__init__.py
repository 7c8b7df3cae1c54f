"""Keepout: learn a spacecraft's shape, prove how wrong it can be, and fly around it without touching it."""

import jax

# Dynamics, cone program and observer need float64; switching it on here makes forgetting it impossible.
jax.config.update("jax_enable_x64", True)

from keepout.errors import KeepoutError  # noqa: E402  (x64 must be on before anything builds an array)

__version__ = "0.1.0"
__all__ = ["KeepoutError", "__version__"]
