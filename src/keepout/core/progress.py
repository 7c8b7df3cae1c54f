"""How long work reports its progress: a callback, so that no layer below the command line knows a terminal."""

import threading
from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with the fraction done, 0 to 1, and a short line of live figures (may be empty)."""


def silent(fraction: float, message: str) -> None:
    """Report nothing: the default of every function that takes a `Progress`."""


def part_of(progress: Progress, start: float, end: float) -> Progress:
    """Give the progress of a part of the work: its 0 to 1 are `start` to `end` of the whole."""
    return lambda fraction, message: progress(start + (end - start) * fraction, message)


def never_back(progress: Progress) -> Progress:
    """Give a progress that several threads may report to, and that is told of no fraction below an earlier one."""
    furthest, telling = 0.0, threading.Lock()

    def report(fraction: float, message: str) -> None:
        nonlocal furthest
        with telling:
            furthest = max(furthest, fraction)
            progress(furthest, message)

    return report
