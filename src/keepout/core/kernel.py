"""Loops over arrays, written in Python and compiled by Numba; kept on disk beside their module."""

import inspect
from collections.abc import Callable
from typing import Any

import numba


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Give a decorator that compiles a function of arrays and numbers, which lets other threads run meanwhile.

    Args:
        options: of `numba.njit` beside these: `inline`, `error_model`.

    """

    def compiled(function: Callable[..., Any]) -> Any:
        # Run-time shape checks, where they are on, wrap the function; Numba takes it bare.
        return numba.njit(cache=True, nogil=True, **options)(inspect.unwrap(function))

    return compiled
