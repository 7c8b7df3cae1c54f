"""Several long computations at once, with one progress: compiling a law keeps only one core busy."""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from keepout.core.cores import available_cores
from keepout.core.progress import Progress, never_back

Answer = TypeVar("Answer")

MOST = 2
"""Computations at once, so that memory stays small."""


def side_by_side(jobs: Mapping[str, Callable[[Progress], Answer]], progress: Progress) -> dict[str, Answer]:
    """Run jobs at once, as many as there are cores and at most `MOST`; the first failure stops those not begun.

    Args:
        jobs: by name; each is given its own progress.
        progress: told the mean over all jobs, with the name of the one that reports.

    """
    done = dict.fromkeys(jobs, 0.0)
    whole = never_back(progress)

    def reporter(name: str) -> Progress:
        def report(fraction: float, message: str) -> None:
            done[name] = fraction
            whole(sum(done.values()) / len(done), f"{name} {message}".rstrip())

        return never_back(report)

    def run(name: str) -> Answer:
        own = reporter(name)
        answer = jobs[name](own)
        own(1.0, "")
        return answer

    pool = ThreadPoolExecutor(min(MOST, available_cores()))
    try:
        futures = {name: pool.submit(run, name) for name in jobs}
        return {name: future.result() for name, future in futures.items()}
    finally:
        pool.shutdown(cancel_futures=True)
