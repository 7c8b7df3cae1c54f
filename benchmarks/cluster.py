"""A campaign on workers of one machine: their threads, cores and costs; and what many flights then take, on paper.

    python benchmarks/cluster.py [MISSION.toml] [--workers 2] [--runs 2048] [--flights 1e9] [--cores 32] [--json FILE]

Workers are processes of one thread each, started as `--scheduler local` starts them. The cost of a flight is processor
time, so that it holds on a machine that does other work too; each worker's first chunk, which compiles, is left out of
it. The plan scales by the number of flights and assumes that a core of the cluster is as fast as one here.
"""

import argparse
import json
import math
import os
import statistics
import tempfile
import threading
import time
from dataclasses import asdict
from pathlib import Path

import psutil

from keepout.core.mission.scenario import Scenario
from keepout.flights.campaign.cluster import Cluster
from keepout.flights.campaign.dataset import Dataset
from keepout.flights.campaign.plan import Plan
from keepout.flights.campaign.run import fly_campaign

HOURS = (1.0, 10.0, 100.0)
"""Lengths of a campaign that the plan gives machines for."""


class Watch(threading.Thread):
    """Looks at worker processes four times a second.

    It keeps the most threads and memory, how many threads have used a twentieth of the processor time or more, and the
    processor time per second of the clock.
    """

    def __init__(self, flyer):
        super().__init__(daemon=True)
        self.flyer, self.most, self.ends, self.over = flyer, {}, {}, threading.Event()

    def run(self):
        """Look until `over`."""
        while not self.over.wait(0.25):
            for state in list(self.flyer.states.values()):
                try:
                    process = psutil.Process(state.process)
                    used = sum(process.cpu_times()[:2])
                    threads, cores = process.threads(), len(process.cpu_affinity())
                    busy = sum(20 * (thread.user_time + thread.system_time) > used for thread in threads)
                    memory = process.memory_info().rss
                except psutil.Error:  # it has ended
                    continue
                now = {"threads": len(threads), "busy": busy, "cores": cores, "memory": memory}
                most = self.most.setdefault(state.process, now)
                self.most[state.process] = {name: max(value, most[name]) for name, value in now.items()} | {
                    "busy": busy
                }
                first = self.ends.get(state.process, [(time.perf_counter(), used)])[0]
                self.ends[state.process] = [first, (time.perf_counter(), used)]


def measure(scenario, workers):
    """Fly a campaign; give what its workers, its flights and its files took."""
    began = time.perf_counter()
    plan = Plan.of(scenario)
    flyer = Cluster(workers=workers)
    watch = Watch(flyer)
    watch.start()
    writing = []

    class Timed(Dataset):
        def write(self, result):
            at = time.perf_counter(), time.process_time()
            super().write(result)
            writing.append((time.perf_counter() - at[0], time.process_time() - at[1]))

    with tempfile.TemporaryDirectory() as folder:
        standing = fly_campaign(plan, Timed.begin(Path(folder), plan), flyer=flyer)
        stored = {
            kind: sum(path.stat().st_size for path in Path(folder, kind).iterdir()) for kind in ("flights", "bands")
        }
    watch.over.set()
    after_first = [cost for costs in flyer.costs.values() for cost in costs[1:]]
    if not after_first:
        raise SystemExit("too few chunks: every worker flew one, which compiles; take more --runs")
    return {
        "mission": scenario.name,
        "seconds_a_flight_lasts": scenario.duration,
        "runs": plan.runs,
        "runs_a_chunk": plan.chunk,
        "chunks": plan.chunks,
        "seconds_with_plan": time.perf_counter() - began,
        "seconds": standing.seconds,
        "first_chunk_core_seconds": statistics.median(costs[0] for costs in flyer.costs.values()),
        "core_seconds_a_flight": sum(after_first) / len(after_first) / plan.chunk,
        "table_bytes_a_flight": stored["flights"] / plan.runs,
        "bands_bytes_a_chunk": stored["bands"] / plan.chunks,
        "write_seconds_a_chunk": statistics.median(wall for wall, _ in writing),
        "workers": [
            {
                **asdict(state),
                **dict.fromkeys(("threads", "busy", "cores", "memory"), math.nan),
                **watch.most.get(state.process, {}),
                "processor_share": _share(watch.ends.get(state.process)),
            }
            for state in flyer.states.values()
        ],
    }


def _share(ends):
    return (ends[1][1] - ends[0][1]) / (ends[1][0] - ends[0][0]) if ends and len(ends) == 2 else math.nan


def plan_of(measured, flights, cores):
    """Give machines, hours and storage for a number of flights on machines of so many cores."""
    chunks = flights / measured["runs_a_chunk"]
    core_hours = flights * measured["core_seconds_a_flight"] / 3600.0
    rows = []
    for hours in HOURS:
        machines = math.ceil(core_hours / hours / cores)
        starting = measured["first_chunk_core_seconds"]
        rows.append({"hours": hours, "machines": machines, "share_of_compiling": starting / 3600.0 / hours})
    return {
        "flights": flights,
        "cores_a_machine": cores,
        "core_hours": core_hours,
        "table_bytes": flights * measured["table_bytes_a_flight"],
        "bands_bytes": chunks * measured["bands_bytes_a_chunk"],
        "files": 2 * chunks,
        "hours_of_writing": chunks * measured["write_seconds_a_chunk"] / 3600.0,
        "in": rows,
    }


def show(measured, planned):
    m, p = measured, planned
    print(
        f"{m['mission']}: {m['runs']} flights of {m['seconds_a_flight_lasts']:g} s in {m['chunks']} chunks of "
        f"{m['runs_a_chunk']}; {m['seconds']:.1f} s by the clock, start-up of the workers included"
    )
    print(f"{'worker':>8} {'cores':>6} {'threads':>8} {'busy':>5} {'processor share':>16} {'memory MB':>10}")
    for each in m["workers"]:
        print(
            f"{each['process']:>8} {each['cores']:>6} {each['threads']:>8} {each['busy']:>5} "
            f"{each['processor_share']:>16.2f} {each['memory'] / 1e6:>10.0f}"
        )
    print(
        f"a flight: {1e3 * m['core_seconds_a_flight']:.2f} ms of one core, {m['table_bytes_a_flight']:.0f} bytes of "
        f"table; a chunk: {m['bands_bytes_a_chunk'] / 1e3:.1f} kB of bands, {1e3 * m['write_seconds_a_chunk']:.1f} ms "
        f"to write; a worker's first chunk: {m['first_chunk_core_seconds']:.1f} s of one core"
    )
    print(
        f"{p['flights']:.3g} flights: {p['core_hours']:.4g} core-hours; {p['table_bytes'] / 1e9:.4g} GB of tables, "
        f"{p['bands_bytes'] / 1e9:.3g} GB of bands, {p['files']:.3g} files; {p['hours_of_writing']:.3g} h of writing "
        "by one process"
    )
    print(f"{'hours':>8} {'machines of ' + str(p['cores_a_machine']) + ' cores':>22} {'compiling':>10}")
    for row in p["in"]:
        print(f"{row['hours']:>8g} {row['machines']:>22} {row['share_of_compiling']:>10.2%}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mission", nargs="?", type=Path, default=Path(__file__).parents[1] / "examples" / "case1.toml")
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--runs", type=int, default=2048)
    parser.add_argument("--flights", type=float, default=1e9)
    parser.add_argument("--cores", type=int, default=32, help="of a machine in the plan")
    parser.add_argument("--json", type=Path, help="keep the figures here")
    parser.add_argument("--measured", type=Path, help="figures kept by --json, instead of measuring")
    arguments = parser.parse_args()
    if arguments.measured:
        measured = json.loads(arguments.measured.read_text())["measured"]
    else:
        scenario = Scenario.load(arguments.mission).replace(campaign={"runs": arguments.runs})
        measured = measure(scenario, arguments.workers)
    planned = plan_of(measured, arguments.flights, arguments.cores)
    if arguments.json:
        arguments.json.write_text(json.dumps({"measured": measured, "plan": planned}, indent=1) + "\n")
    show(measured, planned)


if __name__ == "__main__":
    main()
