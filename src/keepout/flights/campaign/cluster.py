"""Chunks flown by `dask.distributed`: handed out a few ahead, taken back one by one, flown again if a worker dies.

Imported only where `--scheduler` is given. The plan travels as a plugin of the workers: the scheduler keeps it, and
each worker, one that joins later or takes a dead one's place too, gets it once, before its first chunk.
"""

import itertools
import logging
import pickle
import re
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from distributed import Client, Future, KilledWorker, LocalCluster, Worker, WorkerPlugin, as_completed, get_worker

from keepout.core.cores import allowed_cores, available_cores
from keepout.core.errors import ClusterError
from keepout.flights.campaign import worker
from keepout.flights.campaign.chunk import ChunkResult, Told
from keepout.flights.campaign.plan import Plan
from keepout.flights.campaign.worker import Landed, WorkerState, drop_plan, take_plan

CONNECT_SECONDS = 15.0
"""The longest wait for a scheduler to answer."""
WORKERS_SECONDS = 600.0
"""The longest time with no worker at all, at the start or later."""
AHEAD = 2
"""Chunks handed out for each thread of the cluster: one flies, one waits. No more results than these are ever held."""
_LOOK_SECONDS = 0.02
_FETCH_SECONDS = 60.0
"""The longest wait for one result before the workers are looked at again."""


class Cluster:
    """Flies chunks on a cluster: a `Flyer`.

    Attributes:
        address: of its scheduler; empty where workers are started here.
        workers: processes to start here.
        mixed_processors: whether workers may have several kinds of processor.
        connect_seconds: the longest wait for the scheduler.
        workers_seconds: the longest time without any worker.
        states: what each worker said of itself at the start, by address.
        costs: processor time of each chunk (s) on each worker, in the order they came back; the first one compiles.

    """

    def __init__(
        self,
        address: str = "",
        *,
        workers: int = 0,
        mixed_processors: bool = False,
        connect_seconds: float = CONNECT_SECONDS,
        workers_seconds: float = WORKERS_SECONDS,
    ) -> None:
        self.address = address
        self.workers = workers
        self.mixed_processors = mixed_processors
        self.connect_seconds = connect_seconds
        self.workers_seconds = workers_seconds
        self.states: dict[str, WorkerState] = {}
        self.costs: dict[str, list[float]] = {}

    def __call__(self, plan: Plan, numbers: list[int], told: Told) -> Generator[ChunkResult, None, None]:
        """Fly chunks, in any order, and give each once. Closed early, it cancels what is not finished.

        Raises:
            ClusterError: no scheduler or no workers; a worker that may not fly the plan; a chunk that failed.

        """
        if not numbers:
            return
        with ExitStack() as stack:
            client = stack.enter_context(self._client())
            self._wait_for_workers(client)
            self._check_versions(client)
            name = f"keepout-{plan.sha256[:12]}-{client.id}"
            stack.enter_context(_handed_out(client, name, plan, self._cores()))
            self._look(client, name)
            yield from self._flown(client, name, plan, numbers, told)

    def _look(self, client: Client, name: str) -> None:
        """Ask all workers how they are.

        Raises:
            ClusterError: one may not fly this plan, or they are of several kinds and must not be.

        """
        told: Any = client.run(worker.state, name)
        self.states = dict(sorted(told.items()))
        for address, state in self.states.items():
            if state.refusal:
                raise ClusterError(f"worker {address}: {state.refusal}; install the same there as here")
        for address, state in self.states.items():
            self._require_same_kind(address, state.processor)

    def _require_same_kind(self, address: str, processor: str) -> None:
        kinds = {state.processor: known for known, state in reversed(self.states.items())}
        if not self.mixed_processors and kinds.keys() - {processor}:
            other, known = next((kind, at) for kind, at in kinds.items() if kind != processor)
            raise ClusterError(
                f"worker {address}: its processor is {processor}, that of {known} is {other}; they give other last "
                "bits: use one kind, or --mixed-processors"
            )

    @contextmanager
    def _client(self) -> Iterator[Client]:
        with ExitStack() as stack:
            address: Any = self.address
            if not address:
                address = stack.enter_context(_processes(self.workers))
            try:
                client = Client(address, timeout=self.connect_seconds, set_as_default=False, name="keepout")
            except (OSError, ValueError) as error:
                cause = error.__cause__ or error  # a bare time-out has no text of its own
                said = re.sub(r"^in <[^>]*>: ", "", " ".join(str(cause).split()))[:200] or type(cause).__name__
                raise ClusterError(
                    f"scheduler: {address} did not answer in {self.connect_seconds:g} s ({said}); "
                    "is it running, and can it be reached from here?"
                ) from None
            stack.enter_context(client)
            yield client

    def _cores(self) -> dict[Any, tuple[int, ...]]:
        """Give each process started here cores of its own, by its name; none elsewhere, where others may run too."""
        if self.address:
            return {}
        cores, count = allowed_cores(), self.workers
        each = len(cores) // count
        return {place: cores[place * each : (place + 1) * each] for place in range(count)} if cores else {}

    def _wait_for_workers(self, client: Client) -> None:
        with suppress(TimeoutError):
            client.wait_for_workers(1, timeout=self.workers_seconds)
            return
        raise ClusterError(self._without_workers())

    def _without_workers(self) -> str:
        return (
            f"scheduler: {self.address or 'local'} has had no worker for {self.workers_seconds:g} s; "
            "start workers, and the same command again to go on"
        )

    def _check_versions(self, client: Client) -> None:
        """Refuse workers by what is installed there before anything of this package is sent to them.

        Raises:
            ClusterError: another version, or none.

        """
        here, packages = worker.software(), list(worker.PACKAGES)
        versions: Any = client.get_versions(check=False, packages=packages)
        for address, told in versions["workers"].items():
            found = told["packages"]
            there = {name: found.get(name) or "" for name in packages}
            there["python"] = ".".join(str(found["python"]).split(".")[:2])
            refusal = worker.differing({name: here[name] for name in there}, there)
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
                future = client.submit(worker.fly, name, number, _address, key=key, pure=False)
                under_way[future] = number
                landing.add(future)

        def require_workers() -> None:
            nonlocal without_since
            if client.scheduler_info()["workers"]:
                without_since = time.monotonic()
            elif time.monotonic() - without_since > self.workers_seconds:
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
                told(landed.flights, landed.reached, landed.contacts)
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
                f"{worker.chunk_name(plan, number)}: {error.allowed_failures + 1} workers died while flying it, the "
                f"last {error.last_worker.address}; their memory may be too small: see the workers' logs"
            ) from None
        except ClusterError:
            raise
        except Exception as error:
            error.add_note(worker.chunk_name(plan, number))
            raise
        self._require_same_kind("that flew " + worker.chunk_name(plan, number), landed.processor)
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
        self.expected = worker.software()

    def setup(self, worker: Worker) -> None:  # the name is given by dask
        cores = self.cores.get(worker.name, ())
        take_plan(self.plan_name, self.packed, self.expected, worker.state.nthreads, cores)
        self.packed = b""

    def teardown(self, worker: Worker) -> None:
        drop_plan(self.plan_name)


def _address() -> str:
    return get_worker().address


@contextmanager
def _handed_out(client: Client, name: str, plan: Plan, cores: dict[Any, tuple[int, ...]]) -> Iterator[None]:
    """Let all workers have the plan, now or when they join, as long as the block runs."""
    client.register_plugin(_TakePlan(name, pickle.dumps(plan, protocol=5), cores), name=name)
    try:
        yield
    finally:
        with suppress(Exception):  # the scheduler may be gone
            client.unregister_worker_plugin(name)


@contextmanager
def _processes(count: int) -> Iterator[LocalCluster]:
    """Start workers here, which only this process may talk to; a dead one is started again."""
    cluster = LocalCluster(
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
    try:
        yield cluster
    finally:
        cluster.close()
