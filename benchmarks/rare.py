"""What subset simulation finds, held against what is known: exact probabilities, brute force, and the rows of the docs.

    python benchmarks/rare.py crossing [--groups N]   # a maximum with a known probability of 1e-7: cover and bias
    python benchmarks/rare.py flights [--groups N]    # flights against brute force at 1e-2 and 1e-3
    python benchmarks/rare.py table                   # guard on and off, faults beyond the assumptions
    python benchmarks/rare.py show                    # print all that is kept

A group is one answer of `keepout rare`: 8 runs of 1024 tapes a level, their mean and its 95 % interval. `cover` is the
share of groups whose interval holds the truth, `bias` the mean of all groups over the truth, less one. Everything is
saved to `--out` as it comes, and what is there is not done again.
"""

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
from scipy import optimize, signal, stats

from keepout.core.mission.build import prepare
from keepout.core.mission.scenario import Scenario
from keepout.core.whole_file import write_whole
from keepout.flights.rare_events.event import TapedFlights
from keepout.flights.rare_events.subset import Question, estimate, interval, simulate

RESULTS = Path(__file__).with_name("results") / "rare.json"
RUNS, TAPES = 8, 1024

CROSSINGS = {"10 of 100": (10.0, 100), "40 of 400": (40.0, 400)}
"""Correlation time and samples of an Ornstein–Uhlenbeck process that is watched once a second, s."""


def crossing_probability(level, memory, samples, nodes=800):
    """Exact probability that a stationary Gaussian Markov chain exceeds a level at any of its samples.

    Not by simulation: the density of the chain that has not exceeded it yet is carried from sample to sample, by
    Gauss–Legendre quadrature of the transition's density over (−9, level), and what leaves at each sample is added up.
    """
    x, w = np.polynomial.legendre.leggauss(nodes)
    x, w = -9.0 + (level + 9.0) * (x + 1.0) / 2.0, w * (level + 9.0) / 2.0
    spread = math.sqrt(1.0 - memory**2)
    transition = stats.norm.pdf((x[:, None] - memory * x[None, :]) / spread) / spread
    leaving = w * stats.norm.sf((level - memory * x) / spread)
    density, total = stats.norm.pdf(x), stats.norm.sf(level)
    for _ in range(samples - 1):
        total += float(leaving @ density)
        density = transition @ (w * density)
    return total


def crossing_level(probability, memory, samples):
    """Give the level that is exceeded with a probability."""
    return optimize.brentq(
        lambda b: math.log(crossing_probability(b, memory, samples, 300) / probability), 2.0, 8.0, xtol=1e-10
    )


def crossing_performance(memory):
    """Give minus the maximum of the chain that a tape drives."""
    spread = math.sqrt(1.0 - memory**2)

    def performance(tapes):
        driven = spread * tapes
        driven[:, 0] = tapes[:, 0]
        return -signal.lfilter([1.0], [1.0, -memory], driven, axis=1).max(axis=1)

    return performance


def figures(truth, runs):
    """Give cover, bias and spread of groups of runs (groups, 8) of a probability."""
    ends = np.array([interval(group) for group in runs])
    held = (ends[:, 1] <= truth) & (truth <= ends[:, 2])
    return {
        "truth": truth,
        "groups": len(runs),
        "cover": round(float(held.mean()), 3),
        "too_low": int((ends[:, 2] < truth).sum()),
        "too_high": int((ends[:, 1] > truth).sum()),
        **{f"cover_{name}": round(float(cover), 3) for name, cover in other_covers(truth, runs).items()},
        "bias": round(float(np.mean(runs) / truth - 1.0), 4),
        "bias_error": round(float(np.std(runs.mean(axis=1)) / math.sqrt(len(runs)) / truth), 4),
        "relative_spread_of_a_group": round(float(np.std(runs.mean(axis=1), ddof=1) / truth), 4)
        if len(runs) > 1
        else None,
    }


def other_covers(truth, runs):
    """Give what intervals that were not chosen cover: t on the mean, and t on the mean of the logarithms."""
    count = runs.shape[1]
    width = stats.t.ppf(0.975, count - 1) / math.sqrt(count)
    covers = {}
    for name, values, held in (("t_of_mean", runs, truth), ("t_of_logarithms", np.log(runs + 1e-300), math.log(truth))):
        covers[name] = np.mean(np.abs(values.mean(axis=1) - held) <= width * values.std(axis=1, ddof=1))
    return covers


def crossings(kept, groups, save):
    """Answer for a process whose probability is known, many times."""
    for name, (correlation, samples) in CROSSINGS.items():
        memory = math.exp(-1.0 / correlation)
        level = crossing_level(1e-7, memory, samples)
        truth = crossing_probability(level, memory, samples)
        row = kept.setdefault("crossing", {}).setdefault(name, {"runs": [], "flights": 0})
        performance = crossing_performance(memory)
        while len(row["runs"]) < groups:
            found = simulate(
                performance, samples, Question(below=-level, runs=RUNS, tapes=TAPES, seed=1000 + len(row["runs"]))
            )
            row["runs"].append(found.below(-level).tolist())
            row["flights"] = max(row["flights"], found.evaluations)
            if len(row["runs"]) % 10 == 0:
                row |= figures(truth, np.array(row["runs"]))
                save()
        row |= figures(truth, np.array(row["runs"]))
        save()


NEAR = Scenario().replace(
    name="near-pass",
    duration=120.0,
    start={"position": (8.0, 3.0, 1.2)},
    goal={"position": (8.0, -3.0, 1.2)},
    disturbance={"bound": 0.0143},
)
"""Six metres along the wing of intelsat30, 0.7 m above it."""

NOISE = {"position_noise_std": 0.03, "velocity_noise_std": 0.01, "noise_correlation_time": 10.0}
TWICE = {"kind": "random", "amplitude": 0.0286, "bound": 0.0143}
SPREAD = {"start_position_std": 0.05, "start_velocity_std": 0.002}

COMPARED = {
    "Gaussian noise, no guard": {"faults": NOISE, "guard": {"enabled": False}},
    "1 in 10 dropped, into the body, guard": {"faults": {"law": "into the body", "dropped": 0.1}},
    "random disturbance at twice its bound, into the body, guard": {
        "faults": {"law": "into the body"},
        "disturbance": TWICE,
        "rare": SPREAD,
    },
}

BEYOND = {
    "1 in 10 dropped, into the body": {"faults": {"law": "into the body", "dropped": 0.1}},
    "disturbance at twice its bound, into the body": {"disturbance": TWICE, "faults": {"law": "into the body"}},
    "thruster stuck on": {"faults": {"stuck": "-z", "stuck_force": 0.1, "stuck_from": 30.0}},
    "thruster stuck off": {"faults": {"stuck": "+z", "stuck_from": 30.0}},
    "Gaussian noise of the estimate": {"faults": NOISE},
    "1 in 10 commands dropped": {"faults": {"dropped": 0.1}},
    "disturbance at twice its bound": {"disturbance": TWICE},
}


def compared(kept, groups, brute, save, part=8192):
    """Flights against brute force; the two clearances are chosen from flights of their own."""
    for name, entries in COMPARED.items():
        flown = TapedFlights(prepare(NEAR.replace(**entries)))
        numbers = flown.tape.numbers
        row = kept.setdefault("flights", {}).setdefault(name, {"brute": 0, "hits": [0, 0], "runs": [[], []]})

        def drawn(number, numbers=numbers):
            return np.random.default_rng([77, number]).standard_normal((part, numbers))

        if "clearances_m" not in row:
            first = np.concatenate([flown.clearance(drawn(number)) for number in range(2)])
            row["clearances_m"] = [float(x) for x in np.quantile(first, [1e-2, 1e-3])]
            save()
        while row["brute"] < brute:
            values = flown.clearance(drawn(2 + row["brute"] // part))
            row["brute"] += part
            row["hits"] = [hits + int((values < c).sum()) for hits, c in zip(row["hits"], row["clearances_m"])]
            save()
        while len(row["runs"][0]) < groups:
            began = time.perf_counter()
            seed = 5000 + len(row["runs"][0])
            found = simulate(
                flown.clearance, numbers, Question(below=row["clearances_m"][1], runs=RUNS, tapes=TAPES, seed=seed)
            )
            for runs, clearance in zip(row["runs"], row["clearances_m"]):
                runs.append(found.below(clearance).tolist())
            row["flights"], row["seconds"] = found.evaluations, round(time.perf_counter() - began, 1)
            save()
        row["figures"] = [
            figures(hits / row["brute"], np.array(runs)) | {"truth_error": round(1.0 / math.sqrt(max(hits, 1)), 4)}
            for hits, runs in zip(row["hits"], row["runs"])
        ]
        save()


def table(kept, flights, save):
    """Guard on and off, under the faults of `faults.py` that are beyond the assumptions."""
    rows = kept.setdefault("table", [])
    done = {(row["fault"], row["guard"]) for row in rows}
    for name, entries in BEYOND.items():
        for guard in (True, False):
            if (name, guard) in done:
                continue
            scenario = NEAR.replace(**({"rare": SPREAD, "guard": {"enabled": guard}} | entries))
            began = time.perf_counter()
            flown = TapedFlights(prepare(scenario))
            found = simulate(
                flown.clearance,
                flown.tape.numbers,
                Question(below=0.0, runs=RUNS, tapes=flights, seed=0, most_levels=8),
            )
            rows.append(
                {
                    "fault": name,
                    "guard": guard,
                    "flights_a_level": flights,
                    **{f"probability_{k}" if k == "below" else k: v for k, v in estimate(found, 0.0).summary().items()},
                    "levels": len(found.levels),
                    "flights": found.evaluations,
                    "least_clearance_m": found.lowest_value,
                    "ended": found.ended,
                    "seconds": round(time.perf_counter() - began, 1),
                }
            )
            save()


def show(kept):
    """Print what is kept."""
    for name, row in kept.get("crossing", {}).items():
        print("crossing", name, {key: value for key, value in row.items() if key != "runs"})
    for name, row in kept.get("flights", {}).items():
        print("flights", name, {key: value for key, value in row.items() if key not in ("runs", "figures")})
        for line in row.get("figures", []):
            print("   ", line)
    for row in kept.get("table", []):
        print(row)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("crossing", "flights", "table", "show"))
    parser.add_argument("--groups", type=int, default=200)
    parser.add_argument("--brute", type=int, default=200_000, help="flights of brute force a case")
    parser.add_argument("--flights", type=int, default=512, help="of a level and run, in the table")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    kept = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}

    def save():
        parts = ",\n".join(f"{json.dumps(part)}: {json.dumps(rows)}" for part, rows in kept.items())
        write_whole(arguments.out, "{\n" + parts + "\n}\n")

    if arguments.part == "crossing":
        crossings(kept, arguments.groups, save)
    elif arguments.part == "flights":
        compared(kept, arguments.groups, arguments.brute, save)
    elif arguments.part == "table":
        table(kept, arguments.flights, save)
    show(kept)


if __name__ == "__main__":
    main()
