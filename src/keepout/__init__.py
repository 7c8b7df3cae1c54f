"""Keepout: learn a spacecraft's shape, prove how wrong it can be, and fly around it without touching it."""

import lazy_loader

from keepout.core.compiled.xla import require_double_precision

# Dynamics, cone program and observer need float64; switching it on here makes forgetting it impossible.
require_double_precision()

__version__ = "0.1.0"

# Loaded on first use, so that the command line answers at once; `__init__.pyi` says what is there.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
