"""Fly dispersed approaches in legs: is a zone entered, a wall passed, a hold missed; and at what cost?

    python benchmarks/approach.py [--targets iss intelsat30] [--parts approach abort step] [--flights 1000]
        [--aborts 200] [--steps 20000] [--json] [--out benchmarks/results/approach.json]

Three rows for each target. `approach`: the start is drawn within a ball, the chaser's mass among five, the
disturbance's phase over a turn. `abort`: the same, each abandoned at a moment of its own; it flies back to the hold
point before. All are audited between samples, mesh, zones and corridors alike. `delta_v_over_straight` is the median Δv
over the estimate for the legs flown straight, each from rest to rest, without zones. `delta_v_over_without_zones` and
`time_over_without_zones` are medians over those of 200 such flights without zones, corridors and the rule of speeds.
`step`: the on-board step along such a flight, `step_p99_us` with zones and `step_p99_without_us` on the same legs
without, both of this run.
"""

import functools
import time
from pathlib import Path

import jax
import numpy as np
from kept_rows import Rows, command, on_one_line, tell

import keepout
from keepout.apps.reproduction.in_memory import run_campaign
from keepout.core.audit.audit import Contact
from keepout.core.mission.build import prepare
from keepout.core.mission.scenario import Scenario
from keepout.flights.on_board import OnBoard
from keepout.verbs.check import expected

PARTS = ["approach", "abort", "step"]
EXAMPLE = Path(__file__).parents[1] / "examples" / "approach.toml"
MASSES = [0.98, 0.99, 1.0, 1.01, 1.02]
MORE_ZONES = (
    {"name": "beam", "shape": "cylinder", "axis": [0.0, 0.0, 1.0], "radius": 5.0, "length": 100.0},
    {"name": "plume", "shape": "cone", "axis": [0.0, 1.0, 0.0], "half_angle": 0.5, "length": 60.0},
    {"name": "visitor", "shape": "ellipsoid", "semi_axes": [8.0, 5.0, 5.0]},
)
"""With the example's two zones and its corridor they make six; their centres are the target's."""
CENTRES = {
    "iss": ([10.0, 0.0, 30.0], [0.0, 45.0, 0.0], [-120.0, 60.0, 0.0]),
    "intelsat30": ([20.0, 0.0, 6.0], [0.0, 8.0, 0.0], [20.0, 20.0, 10.0]),
}
SMALL = {
    "name": "approach",
    "seed": 7,
    "duration": 1800.0,
    "target": {"source": "intelsat30"},
    "orbit": {"semi_major_axis": 42_164_000.0},
    "chaser": {"mass": 20.0, "radius": 0.5, "force_limit": 0.2, "speed_limit": 0.15},
    "thrusters": {"layout": "12"},
    "navigation": {"suite": "close"},
    "start": {"position": [3.0, 2.0, 50.0]},
    "leg": [
        {"name": "40 m", "position": [0.0, 0.0, 40.0], "tolerance": 0.5, "dwell": 60.0, "until": "go", "go_at": 250.0},
        {"name": "12 m", "position": [0.0, 0.0, 15.0], "tolerance": 0.4, "dwell": 60.0},
        {"name": "capture", "position": [0.0, 0.0, 5.2], "tolerance": 0.25, "dwell": 60.0},
    ],
    "zone": [
        {"name": "sphere", "shape": "sphere", "centre": [0.0, 0.0, 0.0], "radius": 30.0, "until": "go"},
        {
            **{"name": "into the sun", "shape": "cone", "axes": "inertial", "centre": [0.0, 0.0, 0.0]},
            **{"axis": [0.2, -0.3, 0.9], "half_angle": 0.3, "length": 60.0},
        },
    ],
    "corridor": [
        {
            **{"name": "port", "port": [0.0, 0.0, 3.06], "axis": [0.0, 0.0, 1.0], "length": 20.0},
            **{"half_angle": 0.1745, "radius": 0.7},
        }
    ],
    "approach": {
        "distance_to": [0.0, 0.0, 3.06],
        "speed_by_distance": [[30.0, 0.15], [10.0, 0.08], [3.0, 0.04], [1.0, 0.03]],
    },
}
"""Up the Earth-facing side of a communications satellite."""
PLACE, SETTINGS = ("target", "part", "flights", "seed"), ("version",)
SHOWN = ("target", "part", "flights", "refused", "contacts", "undecided", "zones_entered", "zones_undecided")
SHOWN += ("corridor_clearance_m", "zone_clearance_m", "minimum_clearance_m", "holds_kept", "reached", "guard_share")
SHOWN += ("delta_v_mps", "delta_v_over_straight", "delta_v_over_without_zones", "time_over_without_zones")
SHOWN += ("step_p50_us", "step_p99_us", "step_p99_without_us", "seconds")


def mission_of(target):
    """Give the scenario of an approach to a target, with six zones."""
    scenario = Scenario.load(EXAMPLE) if target == "iss" else Scenario.parse(SMALL)
    more = [zone | {"centre": at} for zone, at in zip(MORE_ZONES, CENTRES[target], strict=True)]
    return scenario.replace(zone=(*scenario.model_dump()["zone"], *more), seed=0)


def without_zones(scenario):
    """Give the same legs without anything in their way."""
    return scenario.replace(zone=(), corridor=(), approach={"speed_by_distance": ()})


def dispersed(scenario, flights, aborts):
    """Give a campaign of an approach."""
    radius = 0.05 * float(np.linalg.norm(scenario.start.position))
    vary = {
        "start.position": {"sphere": [0.0, radius], "centre": list(scenario.start.position)},
        "start.velocity": {"sphere": [0.0, 0.01]},
        "chaser.mass": {"choice": [scenario.chaser.mass * share for share in MASSES]},
        "disturbance.phase": {"uniform": [0.0, 6.28]},
    }
    if aborts:
        vary["faults.abort_at"] = {"choice": np.linspace(0.0, 0.7 * scenario.duration, 40).round().tolist()}
        del vary["chaser.mass"]  # each pair of mass and moment would be a mission of its own
    return scenario.replace(campaign={"runs": flights, "dispersions": vary})


def fly_row(scenario, flights, aborts):
    """Fly a row, and give its figures."""
    began = time.perf_counter()
    flown = run_campaign(dispersed(scenario, flights, aborts), series=(), progress=on_one_line)
    audits, outcome = flown.audits, flown.outcome
    zones = [zone for audit in audits for zone in audit.zones]
    walls = [zone.minimum_clearance for zone in zones if zone.name.startswith("corridor")]
    row = {
        "refused": len(flown.runs) - len(audits),
        "contacts": sum(audit.contact is Contact.YES for audit in audits),
        "undecided": sum(audit.contact is Contact.UNDECIDED for audit in audits),
        "zones_entered": sum(audit.zones_entered is Contact.YES for audit in audits),
        "zones_undecided": sum(audit.zones_entered is Contact.UNDECIDED for audit in audits),
        "corridor_clearance_m": min(walls),
        "zone_clearance_m": min(zone.minimum_clearance for zone in zones if not zone.name.startswith("corridor")),
        "minimum_clearance_m": min(audit.minimum_clearance for audit in audits),
        "holds_kept": sum(bool(one.held) for one in flown.flown.values()),
        "reached": int(np.sum(outcome.reached)),
        "guard_share": float(np.mean(outcome.guard_interventions)) / scenario.steps,
        "delta_v_mps": float(np.median(outcome.delta_v)),
    }
    if not aborts:
        row |= of_cost(scenario, flights, outcome)
    return row | {"seconds": time.perf_counter() - began}


def of_cost(scenario, flights, outcome):
    """Give Δv and time against straight legs and against the same legs without zones."""
    bare = without_zones(scenario)
    straight = expected(prepare(bare.replace(control={"guidance": "straight"})))
    free = run_campaign(dispersed(bare, min(flights, 200), aborts=False), series=(), progress=on_one_line).outcome
    return {
        "delta_v_over_straight": float(np.median(outcome.delta_v)) / straight.delta_v,
        "delta_v_over_without_zones": float(np.median(outcome.delta_v) / np.median(free.delta_v)),
        "time_over_without_zones": float(np.median(outcome.time_to_reach) / np.median(free.time_to_reach)),
    }


def step_row(scenario, steps):
    """Give the times of the on-board step with zones, and on the same legs without."""
    began, row = time.perf_counter(), {}
    for name, one in (("", scenario), ("without_", without_zones(scenario))):
        row |= {f"step_{percentile}_{name}us": of for percentile, of in step_times(one, steps).items()}
    return row | {"seconds": time.perf_counter() - began}


def step_times(scenario, steps):
    """Give the median and the 99th percentile of the on-board step, µs, along a flight."""
    mission = prepare(scenario.replace(navigation={"suite": "none"}, thrusters={"layout": "ideal"}))
    record = mission.fly().record
    board, times = OnBoard(mission.setup, mission.initial, on_gap="begin anew"), []
    while len(times) < steps:
        for time_, position, velocity in zip(record.time, record.position, record.velocity, strict=True):
            begun = time.perf_counter()
            board.step(float(time_), position, velocity)
            times.append(time.perf_counter() - begun)
    return {f"p{q}": 1e6 * float(np.percentile(times[1000:], q)) for q in (50, 99)}


def main():
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    parser = command(__doc__)
    parser.add_argument("--targets", nargs="+", choices=sorted(CENTRES), default=["iss", "intelsat30"])
    parser.add_argument("--flights", type=int, default=1000)
    parser.add_argument("--aborts", type=int, default=200)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--out", type=Path, help="JSON file of the rows")
    given = parser.parse_args()
    rows, shown = Rows(given.out, PLACE, SETTINGS), []
    for target in given.targets:
        scenario = mission_of(target)
        made = {
            "approach": (given.flights, functools.partial(fly_row, scenario, given.flights, False)),
            "abort": (given.aborts, functools.partial(fly_row, scenario, given.aborts, True)),
            "step": (given.steps, functools.partial(step_row, scenario, given.steps)),
        }
        for part in given.parts:
            flights, make = made[part]
            plan = {"target": target, "part": part, "flights": flights, "seed": 0, "version": keepout.__version__}
            shown.append(rows.made(plan, make))
    tell(shown, given, [name for name in SHOWN if any(name in row for row in shown)])


if __name__ == "__main__":
    main()
