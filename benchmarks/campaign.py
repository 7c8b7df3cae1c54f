"""Speed of campaigns: Case 3's flights around intelsat30 with the default field and law, guard on.

    python benchmarks/campaign.py [--flights 1000] [--steps 3000] [--cores 1 2] [--scaling 100 1000 10000] [--json OUT]
    python benchmarks/campaign.py --equipped [--flights 256] [--steps 1000] [--json OUT]

Three tables. Time: microseconds a flight-step by the clock and of processor time, audit left out and included, on so
many cores, after start-up; medians of three. Shares: what each part costs alone on one core. Ratio: against the same
law (printed constants, no guard) written the usual way, a flight at a time with CVXPY, Clarabel and PyTorch. With
`--scaling`, time against the number of runs, of shorter flights. Each number of cores has a process of its own, which
is kept to them. On a machine that does other work, compare the processor time.

With `--equipped`, the same campaign by the true state, on sensors, and on sensors and on/off thrusters, audit included;
and what campaigns of 96 and 128 runs take the first time, one after another in one process.
"""

import argparse
import datetime
import json
import multiprocessing
import os
import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from types import SimpleNamespace

REPEATS = 3
USUAL_STEPS = 200


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--cores", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--scaling", type=int, nargs="+", default=[], metavar="RUNS")
    parser.add_argument("--scaling-steps", type=int, default=1000, help="steps of those flights")
    parser.add_argument("--no-usual", action="store_true", help="leave the usual way out")
    parser.add_argument("--equipped", action="store_true", help="flights on sensors and thrusters, and nothing else")
    parser.add_argument("--json", metavar="OUT", help="write all figures here too")
    arguments = parser.parse_args()
    from keepout.flights.pages.page import machine

    found = {"machine": machine(), "date": datetime.date.today().isoformat(), "steps": arguments.steps}
    found["scaling_steps"] = arguments.scaling_steps
    found |= {"flights": arguments.flights, "load at the start": os.getloadavg()[0]}
    if arguments.equipped:
        found["equipped"] = []
        print(f"{'cores':>5} {'first s':>8} {'again s':>8} {'clock us':>9} {'cpu us':>7} {'ratio':>6}   a flight-step")
        for name, tables in EQUIPPED.items():
            row = {"flown": name, **apart(max(arguments.cores), equipped, tables, arguments.flights, arguments.steps)}
            found["equipped"].append(row)
            ratio = row["cpu_us"] / found["equipped"][0]["cpu_us"]
            print(
                f"{row['cores']:>5} {row['first_s']:>8.1f} {row['other_number_s']:>8.1f} {row['clock_us']:>9.2f} "
                f"{row['cpu_us']:>7.2f} {ratio:>6.1f}   {name}",
                flush=True,
            )
        write(found, arguments.json)
        return
    found |= {"times": [], "scaling": []}
    print(f"{arguments.flights} flights of {arguments.steps} steps; load of the machine {os.getloadavg()[0]:.1f}")
    print(f"{'cores':>5} {'audit':>6} {'clock us':>9} {'cpu us':>7} {'seconds':>8}   a flight-step; the whole campaign")
    for cores in arguments.cores:
        for row in apart(cores, times, arguments.flights, arguments.steps):
            found["times"].append(row)
            print(
                f"{row['cores']:>5} {'yes' if row['audit'] else 'no':>6} {row['clock_us']:>9.2f} {row['cpu_us']:>7.2f} "
                f"{row['seconds']:>8.1f}",
                flush=True,
            )
    found["shares_us"] = apart(1, part_shares)
    print("\nshares of one core, us a flight-step, each part compiled alone")
    for name, figure in found["shares_us"].items():
        print(f"  {name:38} {figure:6.2f}")
    if not arguments.no_usual:
        found["usual way"] = apart(1, usual)
        print("\nthe usual way: " + "; ".join(f"{name} {figure}" for name, figure in found["usual way"].items()))
    if arguments.scaling:
        print(f"\n{'runs':>8} {'seconds':>9} {'cpu us':>7}   with audit, on {max(arguments.cores)} cores")
        found["scaling"] = apart(max(arguments.cores), scaling, arguments.scaling, arguments.scaling_steps)
        for row in found["scaling"]:
            print(f"{row['runs']:>8} {row['seconds']:>9.2f} {row['cpu_us']:>7.2f}")
        each = [row["seconds"] / row["runs"] for row in found["scaling"]]
        print(f"linear within {100 * (max(each) / min(each) - 1):.0f} %")
    write(found, arguments.json)


def write(found, path):
    """Write all figures, if a file is named."""
    if path:
        with open(path, "w", encoding="utf-8") as file:
            json.dump(found, file, indent=1)


def apart(cores, function, *arguments):
    """Call a function in a new process that is kept to so many cores: XLA reads their number once, when it starts."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), keep_to, (cores,)) as pool:
        return pool.submit(function, *arguments).result()


def keep_to(cores):
    """Keep this process, and every thread that it starts, to the first of the cores that it may use."""
    os.environ["OMP_NUM_THREADS"] = str(cores)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])


EQUIPPED = {
    "the true state": {},
    "sensors (suite close)": {"navigation": {"suite": "close"}},
    "sensors (suite close), twelve on/off thrusters": {
        "navigation": {"suite": "close"},
        "thrusters": {"layout": "12", "least_on_time": 0.02},
    },
}
"""What flights of `--equipped` have beside Case 3's."""


def equipped(tables, flights, steps):
    """Time whole campaigns of drawn runs in memory: the first of 96, one of 128, and so many after it."""
    from keepout.apps.reproduction.case3 import DEFAULTS, case3_scenarios
    from keepout.apps.reproduction.in_memory import plan_campaign

    scenario = case3_scenarios(0, quick=False)["intelsat30", DEFAULTS].replace(duration=float(steps), **tables)

    def campaign(runs):
        plan = plan_campaign(scenario.replace(campaign={"runs": runs}))
        began = time.perf_counter(), time.process_time()
        plan.fly()
        return time.perf_counter() - began[0], time.process_time() - began[1]

    first, other = campaign(96)[0], campaign(128)[0]
    pairs = [campaign(flights) for _ in range(REPEATS)]
    clock, processor = (statistics.median(values) for values in zip(*pairs, strict=True))
    return {
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "first_s": first,
        "other_number_s": other,
        "clock_us": 1e6 * clock / flights / steps,
        "cpu_us": 1e6 * processor / flights / steps,
    }


def planned(runs, *, law="default"):
    """Plan Case 3's campaign around intelsat30."""
    from keepout.apps.reproduction.case3 import DEFAULTS, PRINTED, case3_scenarios
    from keepout.apps.reproduction.in_memory import plan_campaign
    from keepout.flights.campaign.flying import initial_states

    scenario = case3_scenarios(0, quick=False)["intelsat30", DEFAULTS if law == "default" else PRINTED]
    plan = plan_campaign(scenario.replace(campaign={"runs": runs}))
    return SimpleNamespace(mission=plan.runs[0].flown, initial=initial_states(plan.runs))


def flown(plan, runs, steps, *, audit):
    """Fly the first runs of a plan; seconds by the clock and of processor time."""
    import jax

    from keepout.core.audit.audit import AUDITED
    from keepout.core.flight.batches import BATCH, Batching, fly_batches
    from keepout.core.mission.flight import judge
    from keepout.core.mission.surroundings import Surroundings

    scenario, verdicts = plan.mission.scenario, []
    bounds = Surroundings(scenario).flight_bounds

    def landed(_, log):
        verdicts.extend(judge(scenario, plan.mission.target, log, bounds=bounds))

    began = time.perf_counter(), time.process_time()
    fly_batches(
        plan.mission.setup,
        jax.tree.map(lambda array: array[:runs], plan.initial),
        steps,
        Batching(seed=scenario.seed, batch=BATCH),
        columns=AUDITED if audit else (),
        landed=landed if audit else None,
    )
    assert len(verdicts) == (runs if audit else 0)
    return time.perf_counter() - began[0], time.process_time() - began[1]


def times(flights, steps):
    """Time the campaign without and with audit on the cores of this process."""
    plan, rows = planned(flights), []
    for audit in (False, True):
        flown(plan, 1, steps, audit=audit)  # compiles
        pairs = [flown(plan, flights, steps, audit=audit) for _ in range(REPEATS)]
        clock, processor = (statistics.median(values) for values in zip(*pairs, strict=True))
        rows.append(
            {
                "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
                "audit": audit,
                "clock_us": 1e6 * clock / flights / steps,
                "cpu_us": 1e6 * processor / flights / steps,
                "seconds": clock,
            }
        )
    return rows


def scaling(numbers, steps):
    """Time campaigns of these numbers of runs, audit included."""
    plan, rows = planned(max(numbers)), []
    flown(plan, 1, steps, audit=True)
    for runs in numbers:
        clock, processor = flown(plan, runs, steps, audit=True)
        rows.append({"runs": runs, "seconds": clock, "cpu_us": 1e6 * processor / runs / steps})
    return rows


def part_shares():
    """Time each part alone."""
    from campaign_parts import shares

    from keepout.core.flight.batches import BATCH

    return shares(planned(BATCH))


def usual():
    """Time the printed law a step in a campaign, and written the usual way; say what is missing if it is."""
    import warnings

    from keepout.apps.reproduction.case3 import PRINTED, case3_scenarios
    from keepout.apps.reproduction.runtime import Contender, missing_extra, time_here
    from keepout.core.control.profiles import ControlWarning
    from keepout.core.flight.batches import BATCH

    warnings.simplefilter("ignore", ControlWarning)
    missing = missing_extra()
    if missing is not None:
        return {"ratio": "none", "why": missing}
    plan = planned(BATCH, law="printed")
    flown(plan, 1, USUAL_STEPS, audit=False)
    _, processor = flown(plan, BATCH, USUAL_STEPS, audit=False)
    ours = 1e6 * processor / BATCH / USUAL_STEPS
    # Its network is asked only where it was learned: a start of Case 3 within that ball.
    start = (8.0, 5.0, -4.0)
    scenario = case3_scenarios(0, quick=False)["intelsat30", PRINTED].replace(
        start={"position": start}, duration=float(USUAL_STEPS)
    )
    [timed] = time_here([Contender("usual", scenario, usual=True)])
    theirs = 1e6 * float(statistics.median(timed.seconds))
    return {"us a step": round(theirs, 1), "Keepout's us": round(ours, 2), "ratio": round(theirs / ours)}


if __name__ == "__main__":
    main()
