"""How long work reports its progress: a callback, so that no layer below the command line knows a terminal."""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

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


@contextmanager
def moving(progress: Progress, start: float, end: float, message: str, *, usual: float) -> Iterator[None]:
    """Report while the block runs, which cannot say how far it is: by its time, ever slower towards `end`.

    Args:
        progress: called twice a second from a thread of its own, with the seconds so far in its message.
        start: fraction at the block's start.
        end: fraction that it comes near to.
        message: what is done.
        usual: after so many seconds two thirds of the way are reported, s.

    """
    progress(start, message)
    if progress is silent:
        yield
        return
    over = threading.Event()

    def report() -> None:
        seconds = 0.0
        while not over.wait(0.5):
            seconds += 0.5
            progress(end - (end - start) * math.exp(-seconds / usual), f"{message}, {seconds:.0f} s so far")

    reporting = threading.Thread(target=report, daemon=True)
    reporting.start()
    try:
        yield
    finally:
        over.set()
        reporting.join()
