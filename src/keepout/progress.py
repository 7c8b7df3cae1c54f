"""How long work reports its progress: a callback, so that no layer below the command line knows a terminal."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with the fraction done, 0 to 1, and a short line of live figures (may be empty)."""


def silent(fraction: float, message: str) -> None:
    """Report nothing: the default of every function that takes a `Progress`."""
