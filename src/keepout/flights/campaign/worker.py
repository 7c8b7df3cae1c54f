"""What a worker of a cluster does: takes the plan once, keeps to its own cores, and flies chunks.

A worker holds the plans that it was given until they are taken back. Before a plan is unpacked, which starts JAX, the
threads of the libraries are limited to those that the worker has been given.
"""

import functools
import os
import pickle
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import keepout
from keepout.core.compiled.kept_programs import keep_programs, processor
from keepout.core.cores import allowed_cores
from keepout.core.digest import digest
from keepout.core.errors import ClusterError, KeepoutError
from keepout.flights.campaign.chunk import ChunkResult, fly_chunk
from keepout.flights.campaign.plan import Plan

PACKAGES = ("keepout", "jax", "jaxlib", "numpy", "scipy", "numba", "equinox", "trimesh", "pyarrow")
"""What the bits of a campaign's table depend on: workers must have the very versions of who hands out the chunks."""

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "NPROC")
"""Read by libraries when they are loaded; NPROC by XLA, as the number of its threads."""


@dataclass(frozen=True)
class Landed:
    """A chunk as it comes back.

    Attributes:
        result: to be written.
        flights: that flew.
        reached: of these, how many reached their goal.
        contacts: of these, how many the audit does not clear of a contact.
        processor: that flew them.
        worker: its address.
        processor_seconds: that its process used meanwhile; for other chunks too, where it flies several at once.

    """

    result: ChunkResult
    flights: int
    reached: int
    contacts: int
    processor: str
    worker: str
    processor_seconds: float


@dataclass(frozen=True)
class WorkerState:
    """What a worker says of itself.

    Attributes:
        refusal: why it may not fly this plan; empty if it may.
        processor: its kind.
        process: its number.
        threads: that its process has.
        cores: that it may run on.
        processor_seconds: that its process has used.
        memory: bytes resident.

    """

    refusal: str
    processor: str
    process: int
    threads: int
    cores: tuple[int, ...]
    processor_seconds: float
    memory: int


_held: dict[str, Plan | str] = {}
"""Plans by the name that they were handed out under; text where this worker is refused, and says why."""


@functools.cache
def software() -> dict[str, str]:
    """Name what is installed here, as far as the bits of a flight depend on it."""
    from importlib.metadata import version

    folder = Path(keepout.__file__).parent
    code = "".join(f"{path.relative_to(folder)} {digest(path.read_text('utf-8'))}\n" for path in _sources(folder))
    versions = {name: version(name) for name in PACKAGES if name != "keepout"}
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    flags = " ".join(os.environ.get("XLA_FLAGS", "").split())
    return {
        "keepout": keepout.__version__,
        "code of keepout": digest(code)[:12],
        "python": python,
        **versions,
        "XLA_FLAGS": flags,
    }


def differing(here: dict[str, str], there: dict[str, str]) -> str:
    """Say in a line what differs between what is installed where chunks are handed out and on a worker."""
    return "; ".join(
        f"{name} {there.get(name) or 'not there'} there and {here.get(name) or 'not there'} here"
        for name in here
        if here.get(name) != there.get(name)
    )


def take_plan(name: str, packed: bytes, expected: dict[str, str], threads: int, cores: tuple[int, ...]) -> None:
    """Take a plan into this process, having limited its threads; or keep the reason why it cannot fly it.

    Args:
        name: under which chunks will ask for it.
        packed: the plan, pickled.
        expected: `software` where the chunks are handed out.
        threads: chunks that this worker flies at once.
        cores: for this process alone; empty where it may run wherever it may now.

    """
    if name in _held:
        return
    keep_to(threads, cores)
    refusal = differing(expected, software())
    if refusal:
        _held[name] = refusal
        return
    keep_programs()
    _held[name] = pickle.loads(packed)


def drop_plan(name: str) -> None:
    """Forget a plan."""
    _held.pop(name, None)


def keep_to(threads: int, cores: tuple[int, ...]) -> None:
    """Limit the libraries of this process to so many threads, and all its threads to some cores (on Linux)."""
    for variable in _THREADS:
        os.environ[variable] = str(threads)
    if cores and hasattr(os, "sched_setaffinity"):
        for thread in os.listdir("/proc/self/task"):
            with suppress(ProcessLookupError):  # it ended meanwhile
                os.sched_setaffinity(int(thread), cores)
    import numba
    import pyarrow
    from threadpoolctl import threadpool_limits

    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))  # pyright: ignore
    threadpool_limits(threads)  # last: numba loads OpenMP
    pyarrow.set_cpu_count(threads)


def fly(name: str, number: int, where: Callable[[], str]) -> Landed:
    """Fly one chunk of a plan that this worker has taken.

    Args:
        name: of the plan.
        number: of the chunk.
        where: gives this worker's address.

    Raises:
        ClusterError: this worker may not fly it, or the chunk is refused.

    """
    plan = _held.get(name, "it was not given the plan")
    if isinstance(plan, str):
        raise ClusterError(f"worker {where()}: {plan}")
    counted = [0, 0, 0]

    def told(*more: int) -> None:
        counted[:] = (a + b for a, b in zip(counted, more, strict=True))

    began = time.process_time()
    try:
        result = fly_chunk(plan, number, workers=1, told=told)
    except KeepoutError as error:
        raise ClusterError(f"{chunk_name(plan, number)}, on worker {where()}: {error}") from None
    flights, reached, contacts = counted
    return Landed(result, flights, reached, contacts, processor(), where(), time.process_time() - began)


def chunk_name(plan: Plan, number: int) -> str:
    """Name a chunk and its runs."""
    first, last = plan.chunk_runs(number)
    return f"chunk {number} (runs {first} to {last - 1})"


def state(name: str) -> WorkerState:
    """Say how this worker is."""
    import psutil

    process, plan = psutil.Process(), _held.get(name, "it was not given the plan")
    used = process.cpu_times()
    return WorkerState(
        plan if isinstance(plan, str) else "",
        processor(),
        process.pid,
        process.num_threads(),
        allowed_cores(),
        used.user + used.system,
        process.memory_info().rss,
    )


def _sources(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.py"))
