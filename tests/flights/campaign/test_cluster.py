"""A campaign flown by a cluster: the bits of one process, whoever dies; and what is refused."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
from truths.small_campaigns import flown_here, small_plan

from keepout.core.errors import ClusterError, KeepOutZoneError
from keepout.flights.campaign import cluster as worker
from keepout.flights.campaign.dataset import Dataset
from keepout.flights.campaign.run import fly_campaign, flyer_on

distributed = pytest.importorskip("distributed", reason="needs keepout-gnc[cluster]")

from keepout.flights.campaign.cluster import Cluster  # noqa: E402

pytestmark = [pytest.mark.long, pytest.mark.as_used]


def silent(*counts):
    """Hear of flights that landed, and say nothing."""


def assert_flown_as_here(folder):
    """Compare every file of a campaign's folder with what this process flies."""
    dataset = Dataset.open(folder)
    assert dataset.missing() == []
    for number in range(small_plan().chunks):
        assert (folder / f"flights/part-{number:05d}.parquet").read_bytes() == flown_here(number).table
        assert (folder / f"bands/part-{number:05d}.npz").read_bytes() == flown_here(number).bands


# ---- one process a worker


@pytest.mark.slow  # test_campaign.py has a campaign that was killed and goes on
def test_a_killed_worker_loses_only_its_chunks_and_no_bit_differs(tmp_path):
    plan = small_plan()
    dataset = Dataset.begin(tmp_path / "out", plan)
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", memory_limit=0
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as watching,
    ):
        pids = watching.run(os.getpid)
        killed = []

        class Killing(Cluster):
            """Stops a worker once a chunk has landed, lets chunks be handed to it, and kills it with them in hand."""

            def __call__(self, plan, numbers, told):
                flying = super().__call__(plan, numbers, told)
                yield next(flying)
                victim, pid = next(iter(pids.items()))
                os.kill(pid, signal.SIGSTOP)
                yield next(flying)
                in_hand = watching.processing()[victim]
                os.kill(pid, signal.SIGKILL)
                killed.append(in_hand)
                yield from flying

        flyer = Killing(cluster.scheduler_address)
        standing = fly_campaign(plan, dataset, flyer=flyer)
        assert set(flyer.kinds) == set(pids)
        assert set(pids.values()) - set(watching.run(os.getpid).values()) == {next(iter(pids.values()))}
        # The plan goes when the campaign is over.
        assert watching.run(lambda: len(worker._held)) == dict.fromkeys(watching.run(os.getpid), 0)
    assert killed[0], "the killed worker had nothing in hand: nothing was tried"
    assert (standing.done, standing.flown) == (24, 24)
    assert_flown_as_here(tmp_path / "out")


def test_a_worker_keeps_to_its_threads_and_cores():
    said = """
import os, numpy, numba, pyarrow, jax
from threadpoolctl import threadpool_info
from keepout.flights.campaign.cluster import keep_to
core = min(os.sched_getaffinity(0))
numpy.ones((300, 300)) @ numpy.ones((300, 300))
keep_to(1, (core,))
jax.jit(lambda x: x @ x)(jax.numpy.ones((500, 500))).block_until_ready()
pools = [open(f"/proc/self/task/{task}/comm").read().strip() for task in os.listdir("/proc/self/task")]
cores = {tuple(os.sched_getaffinity(int(task))) for task in os.listdir("/proc/self/task")}
assert cores == {(core,)}, cores
assert pools.count("tf_XLAEigen") <= 1, pools
assert {pool["num_threads"] for pool in threadpool_info()} == {1}, threadpool_info()
assert (numba.get_num_threads(), pyarrow.cpu_count()) == (1, 1)
"""
    answer = subprocess.run([sys.executable, "-c", said], capture_output=True, text=True, env=os.environ)
    assert answer.returncode == 0, answer.stderr


# ---- workers that are threads of this process


@pytest.fixture
def here(monkeypatch):
    """A cluster whose one worker is a thread here, left with the threads and cores it has."""
    monkeypatch.setattr(worker, "keep_to", lambda threads, cores: None)
    monkeypatch.setattr(worker, "fly_chunk", lambda plan, number, **_: flown_here(number))
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
    ) as made:
        yield made


def cluster_at(made, **more):
    return Cluster(made.scheduler_address, **more)


def flown(flyer, numbers=range(6)):
    return sorted(result.number for result in flyer(small_plan(), list(numbers), silent))


def test_each_chunk_comes_back_once_and_its_plan_is_taken_back(here):
    assert flown(cluster_at(here), [5, 1, 2]) == [1, 2, 5]
    assert flown(cluster_at(here)) == list(range(6))
    assert worker._held == {}


def test_a_refused_chunk_names_itself_and_its_runs_and_a_bug_arrives_as_itself(here, monkeypatch):
    def refusing(plan, number, **_):
        if number == 2:
            raise KeepOutZoneError("start: inside the keep-out zone", "start")
        return {}[number] if number == 3 else flown_here(number)

    monkeypatch.setattr(worker, "fly_chunk", refusing)
    with pytest.raises(ClusterError, match=r"^chunk 2 \(runs 8 to 11\), on worker inproc://.*: start: inside the keep"):
        flown(cluster_at(here), [0, 1, 2])
    with pytest.raises(KeyError) as raised:
        flown(cluster_at(here), [3])
    assert raised.value.__notes__ == ["chunk 3 (runs 12 to 15)"]


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"jax": "0.0.1"}, r"jax 0\.0\.1 there and [0-9.]+ here; install the same"),
        ({"code of keepout": "0123"}, "code of keepout 0123 there and .* here"),
    ],
)
def test_a_worker_with_another_version_or_other_code_is_refused(other, said, here, monkeypatch):
    true, own = worker.software(), threading.get_ident()
    monkeypatch.setattr(worker, "software", lambda: true if threading.get_ident() == own else true | other)
    with pytest.raises(ClusterError, match=rf"worker inproc://.*: {said}"):
        flown(cluster_at(here))


def test_a_worker_that_joins_late_with_other_code_flies_nothing(monkeypatch):
    monkeypatch.setattr(worker, "keep_to", lambda threads, cores: None)
    monkeypatch.setattr(worker, "_address", lambda: "tcp://there:1")
    expected = worker.software() | {"code of keepout": "0123"}
    worker.take_plan("late", b"never unpacked", expected, 1, ())
    try:
        with pytest.raises(ClusterError, match=r"worker tcp://there:1: code of keepout .* there and 0123 here"):
            worker.fly("late", 0)
    finally:
        worker.drop_plan("late")
    with pytest.raises(ClusterError, match="was not given the plan"):
        worker.fly("late", 0)


def test_several_kinds_of_processor_are_refused_unless_allowed(here, monkeypatch):
    def kinds():
        told = iter(["one kind", "one kind", *["another kind"] * 20])
        monkeypatch.setattr(worker, "processor", lambda: next(told))

    kinds()
    with pytest.raises(ClusterError, match=r"another kind.* one kind.*--mixed-processors"):
        flown(cluster_at(here))
    kinds()
    assert flown(cluster_at(here, mixed_processors=True)) == list(range(6))


def test_a_cluster_without_workers_is_said_so(monkeypatch):
    monkeypatch.setattr(worker, "WORKERS_SECONDS", 0.5)
    with distributed.LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as empty:
        flyer = cluster_at(empty)
        with pytest.raises(ClusterError, match=r"scheduler: inproc://.* has had no worker for 0\.5 s; start workers"):
            flown(flyer)


@pytest.mark.parametrize("when", ["in flight", "flown but not sent"])
def test_workers_that_all_go_and_never_come_back_are_said_so(when, here, monkeypatch):
    monkeypatch.setattr(worker, "WORKERS_SECONDS", 1.0)
    flying = cluster_at(here)(small_plan(), list(range(6)), silent)
    next(flying)
    if when == "flown but not sent":  # what a worker had flown and took with it is not waited for
        until = time.monotonic() + 60.0
        while not all(task.state == "memory" for task in here.scheduler.tasks.values()) and time.monotonic() < until:
            time.sleep(0.02)
        time.sleep(0.5)  # this process hears of it, too
    here.scale(0)
    with pytest.raises(ClusterError, match="has had no worker for 1 s"):
        list(flying)


def test_a_scheduler_that_does_not_answer_is_named_and_nothing_to_fly_asks_nobody(monkeypatch):
    monkeypatch.setattr(worker, "CONNECT_SECONDS", 1.0)
    said = r"scheduler: tcp://127\.0\.0\.1:1 did not answer in 1 s \(\w+Error"
    with pytest.raises(ClusterError, match=said) as raised:
        flown(Cluster("tcp://127.0.0.1:1"))
    assert "\n" not in str(raised.value)
    assert flown(flyer_on("tcp://127.0.0.1:1"), []) == []
