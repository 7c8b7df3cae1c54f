"""Chunks flown by `dask.distributed`: handed out a few ahead, taken back one by one, flown again if a worker dies.

Imported only where `--scheduler` is given. The plan travels as a plugin of the workers: the scheduler keeps it, and
each worker, one that joins later or takes a dead one's place too, gets it once, before its first chunk, and holds it
until it is taken back. Before a plan is unpacked, which starts JAX, the threads of the libraries are limited to those
that the worker has been given.
"""

import functools
import itertools
import logging
import os
import pickle
import re
import sys
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from distributed import Client, Future, KilledWorker, LocalCluster, Worker, WorkerPlugin, as_completed, get_worker

import keepout
from keepout.core.compiled.kept_programs import keep_programs, processor
from keepout.core.cores import allowed_cores, available_cores
from keepout.core.errors import ClusterError, KeepoutError
from keepout.core.kept import digest
from keepout.flights.campaign.flying import ChunkResult, Told, fly_chunk
from keepout.flights.campaign.plan import Plan

PACKAGES = ("keepout-gnc", "jax", "jaxlib", "numpy", "scipy", "numba", "equinox", "trimesh", "pyarrow")
"""What the bits of a campaign's table depend on: workers must have the very versions of who hands out the chunks."""

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "NPROC")
"""Read by libraries when they are loaded; NPROC by XLA, as the number of its threads."""
CONNECT_SECONDS = 15.0
"""The longest wait for a scheduler to answer."""
WORKERS_SECONDS = 600.0
"""The longest time with no worker at all, at the start or later."""
AHEAD = 2
"""Chunks handed out for each thread of the cluster: one flies, one waits. No more results than these are ever held."""
_LOOK_SECONDS = 0.02
_FETCH_SECONDS = 60.0
"""The longest wait for one result before the workers are looked at again."""


@dataclass(frozen=True)
class Landed:
    """A chunk as it comes back.

    Attributes:
        result: to be written.
        told: what `fly_chunk` told, one entry a batch.
        processor: that flew them.
        worker: its address.
        processor_seconds: that its process used meanwhile; for other chunks too, where it flies several at once.

    """

    result: ChunkResult
    told: tuple[tuple[int, ...], ...]
    processor: str
    worker: str
    processor_seconds: float


@dataclass(eq=False)
class Cluster:
    """Flies chunks on a cluster: a `Flyer`.

    Attributes:
        address: of its scheduler; empty where workers are started here.
        workers: processes to start here.
        mixed_processors: whether workers may have several kinds of processor.
        kinds: the kind of processor of each worker at the start, by address.
        costs: processor time of each chunk (s) on each worker, in the order they came back; the first one compiles.

    """

    address: str = ""
    workers: int = 0
    mixed_processors: bool = False
    kinds: dict[str, str] = field(default_factory=dict, init=False)
    costs: dict[str, list[float]] = field(default_factory=dict, init=False)

    def __call__(self, plan: Plan, numbers: list[int], told: Told) -> Generator[ChunkResult, None, None]:
        """Fly chunks, in any order, and give each once. Closed early, it cancels what is not finished.

        Raises:
            ClusterError: no scheduler or no workers; a worker that may not fly the plan; a chunk that failed.

        """
        if not numbers:
            return
        with ExitStack() as stack:
            client = stack.enter_context(self._client(stack))
            try:
                client.wait_for_workers(1, timeout=WORKERS_SECONDS)
            except TimeoutError:
                raise ClusterError(self._without_workers()) from None
            self._check_versions(client)
            name = f"keepout-{plan.sha256[:12]}-{client.id}"
            # All workers have the plan, now or when they join, until the chunks are flown.
            client.register_plugin(_TakePlan(name, pickle.dumps(plan, protocol=5), self._cores()), name=name)
            try:
                self._look(client, name)
                yield from self._flown(client, name, plan, numbers, told)
            finally:
                with suppress(Exception):  # the scheduler may be gone
                    client.unregister_worker_plugin(name)

    def _look(self, client: Client, name: str) -> None:
        """Ask all workers how they are.

        Raises:
            ClusterError: one may not fly this plan, or they are of several kinds and must not be.

        """
        told: Any = client.run(told_state, name)
        for address, (refusal, _) in sorted(told.items()):
            if refusal:
                raise ClusterError(f"worker {address}: {refusal}; install the same there as here")
        self.kinds = {address: kind for address, (_, kind) in sorted(told.items())}
        for address, kind in self.kinds.items():
            self._require_same_kind(address, kind)

    def _require_same_kind(self, address: str, processor: str) -> None:
        kinds = {kind: known for known, kind in reversed(self.kinds.items())}
        if not self.mixed_processors and kinds.keys() - {processor}:
            other, known = next((kind, at) for kind, at in kinds.items() if kind != processor)
            raise ClusterError(
                f"worker {address}: its processor is {processor}, that of {known} is {other}; they give other last "
                "bits: use one kind, or --mixed-processors"
            )

    def _client(self, stack: ExitStack) -> Client:
        address: Any = self.address or stack.enter_context(_processes(self.workers))
        try:
            return Client(address, timeout=CONNECT_SECONDS, set_as_default=False, name="keepout")
        except (OSError, ValueError) as error:
            cause = error.__cause__ or error  # a bare time-out has no text of its own
            said = re.sub(r"^in <[^>]*>: ", "", " ".join(str(cause).split()))[:200] or type(cause).__name__
            raise ClusterError(
                f"scheduler: {address} did not answer in {CONNECT_SECONDS:g} s ({said}); "
                "is it running, and can it be reached from here?"
            ) from None

    def _cores(self) -> dict[Any, tuple[int, ...]]:
        """Give each process started here cores of its own, by its name; none elsewhere, where others may run too."""
        if self.address:
            return {}
        cores, count = allowed_cores(), self.workers
        each = len(cores) // count
        return {place: cores[place * each : (place + 1) * each] for place in range(count)} if cores else {}

    def _without_workers(self) -> str:
        return (
            f"scheduler: {self.address or 'local'} has had no worker for {WORKERS_SECONDS:g} s; "
            "start workers, and the same command again to go on"
        )

    def _check_versions(self, client: Client) -> None:
        """Refuse workers by what is installed there before anything of this package is sent to them.

        Raises:
            ClusterError: another version, or none.

        """
        here, packages = software(), list(PACKAGES)
        versions: Any = client.get_versions(check=False, packages=packages)
        for address, told in versions["workers"].items():
            found = told["packages"]
            there = {name: found.get(name) or "" for name in packages}
            there["python"] = ".".join(str(found["python"]).split(".")[:2])
            refusal = differing({name: here[name] for name in there}, there)
            if refusal:
                raise ClusterError(f"worker {address}: {refusal}; install the same there as here")

    def _flown(
        self, client: Client, name: str, plan: Plan, numbers: list[int], told: Told
    ) -> Generator[ChunkResult, None, None]:
        waiting = iter(numbers)
        under_way: dict[Future, int] = {}
        landing = as_completed(loop=client.loop)
        without_since = time.monotonic()

        def hand_out() -> None:
            threads: Any = client.nthreads()
            window = max(1, AHEAD * sum(threads.values()))
            for number in itertools.islice(waiting, max(0, window - len(under_way))):
                key = f"{name}-{number}"
                future = client.submit(fly, name, number, key=key, pure=False)
                under_way[future] = number
                landing.add(future)

        def require_workers() -> None:
            nonlocal without_since
            if client.scheduler_info()["workers"]:
                without_since = time.monotonic()
            elif time.monotonic() - without_since > WORKERS_SECONDS:
                raise ClusterError(self._without_workers())

        hand_out()
        try:
            while under_way:
                while not landing.has_ready():
                    time.sleep(_LOOK_SECONDS)
                    require_workers()
                future = next(landing)
                landed = self._landed(future, plan, under_way[future], require_workers)
                del under_way[future]
                self.costs.setdefault(landed.worker, []).append(landed.processor_seconds)
                future.release()
                hand_out()
                for some in landed.told:
                    told(*some)
                yield landed.result
        finally:
            with suppress(Exception):  # the scheduler may be gone
                client.cancel(list(under_way), force=True)

    def _landed(self, future: Future, plan: Plan, number: int, require_workers: Callable[[], None]) -> Landed:
        if future.cancelled():
            at = self.address or "local"
            raise ClusterError(f"scheduler: {at} was lost; start the same command again to go on")
        try:
            landed = _result(future, require_workers)
        except KilledWorker as error:
            raise ClusterError(
                f"{chunk_name(plan, number)}: {error.allowed_failures + 1} workers died while flying it, the "
                f"last {error.last_worker.address}; their memory may be too small: see the workers' logs"
            ) from None
        except ClusterError:
            raise
        except Exception as error:
            error.add_note(chunk_name(plan, number))
            raise
        self._require_same_kind("that flew " + chunk_name(plan, number), landed.processor)
        return landed


def _result(future: Future, require_workers: Callable[[], None]) -> Landed:
    """Fetch what a worker has flown; where it went with it, wait for the next worker, as long as there may be one."""
    seconds = 1.0
    while True:
        try:
            return future.result(timeout=seconds)
        except TimeoutError:
            if future.status == "error":
                raise  # the chunk's own
            require_workers()
            seconds = min(2.0 * seconds, _FETCH_SECONDS)


class _TakePlan(WorkerPlugin):
    """Has each worker take the plan, once."""

    def __init__(self, name: str, packed: bytes, cores: dict[Any, tuple[int, ...]]) -> None:
        self.plan_name, self.packed, self.cores = name, packed, cores
        self.expected = software()

    def setup(self, worker: Worker) -> None:  # the name is given by dask
        cores = self.cores.get(worker.name, ())
        take_plan(self.plan_name, self.packed, self.expected, worker.state.nthreads, cores)
        self.packed = b""

    def teardown(self, worker: Worker) -> None:
        drop_plan(self.plan_name)


def _address() -> str:
    return get_worker().address


def _processes(count: int) -> LocalCluster:
    """Start workers here, which only this process may talk to; a dead one is started again."""
    return LocalCluster(
        n_workers=count,
        threads_per_worker=available_cores() // count,
        processes=True,
        host="127.0.0.1",
        protocol="tls://",
        security=True,  # else any user of this machine could have the workers run code
        memory_limit=0,  # a share of the machine's memory, as by default, says nothing of what is free
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    )


# ---- on a worker


_held: dict[str, Plan | str] = {}
"""Plans by the name that they were handed out under; text where this worker is refused, and says why."""
_WITHOUT = "it was not given the plan"


@functools.cache
def software() -> dict[str, str]:
    """Name what is installed here, as far as the bits of a flight depend on it."""
    folder = Path(keepout.__file__).parent
    sources = sorted(folder.rglob("*.py"))
    code = "".join(f"{path.relative_to(folder)} {digest(path.read_text('utf-8'))}\n" for path in sources)
    versions = {name: version(name) for name in PACKAGES if name != "keepout-gnc"}
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    flags = " ".join(os.environ.get("XLA_FLAGS", "").split())
    return {
        "keepout-gnc": keepout.__version__,
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


def fly(name: str, number: int) -> Landed:
    """Fly one chunk of a plan that this worker has taken.

    Args:
        name: of the plan.
        number: of the chunk.

    Raises:
        ClusterError: this worker may not fly it, or the chunk is refused.

    """
    plan, address = _held.get(name, _WITHOUT), _address()
    if isinstance(plan, str):
        raise ClusterError(f"worker {address}: {plan}")
    counted: list[tuple[int, ...]] = []
    began = time.process_time()
    try:
        result = fly_chunk(plan, number, workers=1, told=lambda *some: counted.append(some))
    except KeepoutError as error:
        raise ClusterError(f"{chunk_name(plan, number)}, on worker {address}: {error}") from None
    return Landed(result, tuple(counted), processor(), address, time.process_time() - began)


def chunk_name(plan: Plan, number: int) -> str:
    """Name a chunk and its runs."""
    first, last = plan.chunk_runs(number)
    return f"chunk {number} (runs {first} to {last - 1})"


def told_state(name: str) -> tuple[str, str]:
    """Say why this worker may not fly a plan, nothing if it may, and of what kind its processor is."""
    plan = _held.get(name, _WITHOUT)
    return plan if isinstance(plan, str) else "", processor()
