"""Loops over arrays compiled by Numba, the processor cores that this process may use, and work shared among them."""

import functools
import inspect
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Give a decorator that compiles a function of arrays and numbers, which lets other threads run meanwhile.

    Args:
        options: of `numba.njit` beside these: `inline`, `error_model`.

    """
    import numba  # whoever only counts cores does not wait for it
    from numba.core.types import unliteral

    def compiled(function: Callable[..., Any]) -> Any:
        # Run-time shape checks, where they are on, wrap the function; Numba takes it bare.
        made: Any = numba.njit(cache=True, nogil=True, **options)(inspect.unwrap(function))
        asked = made.get_call_template

        def plain(args: tuple[Any, ...], named: dict[str, Any]) -> Any:
            # A constant that another kernel hands over is a number like others: else it compiles this one once more.
            return asked(tuple(map(unliteral, args)), {name: unliteral(kind) for name, kind in named.items()})

        made.get_call_template = plain
        return made

    return compiled


def allowed_cores() -> tuple[int, ...]:
    """Give the cores that this process may run on, by number; none where the system does not say."""
    return tuple(sorted(os.sched_getaffinity(0))) if hasattr(os, "sched_getaffinity") else ()


def available_cores() -> int:
    """Count the cores that this process may use, at least 1."""
    return len(allowed_cores()) or os.cpu_count() or 1


def share_among_cores(work: Callable[[slice], None], count: int, *, chunk: int = 512) -> None:
    """Call `work` for slices that together cover 0 to `count`, on all cores; it must release the interpreter's lock."""
    parts, cores = [slice(n, min(n + chunk, count)) for n in range(0, count, chunk)], available_cores()
    if len(parts) <= 1 or cores == 1:
        list(map(work, parts))
    else:
        list(_threads(os.getpid(), cores).map(work, parts))


@functools.lru_cache(1)
def _threads(_process: int, cores: int) -> ThreadPoolExecutor:
    """Give the threads of this process: to start them takes as long as a thousand distances, and a fork has none."""
    return ThreadPoolExecutor(cores)
