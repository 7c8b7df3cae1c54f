"""Flights with everything that can go wrong, audited on the exact mesh: what the guard holds, and what it cannot.

    python benchmarks/faults.py [--json] [--flights N] [--targets intelsat30 pocket …] [--duration 600]

One row for each target, fault and disturbance; N flights in each. `within_assumptions` says whether the guard's
theorem (docs/guard.md) covers the row; only there is zero contacts a promise.
"""

import argparse
import dataclasses
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from keepout import environment
from keepout.control import profiles
from keepout.control.guard import Guard, GuardFlag
from keepout.control.observer import NoObserver
from keepout.fields.grid_build import build_grid
from keepout.fields.grid_certificate import certify_grid
from keepout.flight import faults as broken
from keepout.flight.audit import Contact, audit_campaign
from keepout.flight.campaign import campaign, initial_states
from keepout.flight.setup import FlightSetup
from keepout.flight.tube import FlightBounds
from keepout.geometry.offset_solid import OffsetSolid
from keepout.geometry.target import Target
from keepout.motion.disturbance import CombinedDisturbance, SinusoidalDisturbance, SquareWaveDisturbance
from keepout.scenario import Scenario

MESHES = Path(__file__).resolve().parents[2] / "shared" / "meshes"
RADIUS, MARGIN = 0.5, 0.1
BOUND = 0.0143
"""Disturbance bound assumed by the guard, N: just above the paper's disturbance, 0.01 √2 N."""

GOALS = {
    "intelsat30": (0.0, -10.0, -4.0),
    "ssl1300.glb": (0.0, -10.0, -4.0),
    "pocket": (0.0, 0.0, 6.5),
    "iss": (0.0, -10.0, 12.0),
}
SPACING = {"intelsat30": 0.2, "ssl1300.glb": 0.2, "pocket": 0.15, "iss": 0.4}
VIOLATIONS = int(~np.int32(3) & ~np.int32(GuardFlag.COMMAND) & 0x7FFFFFFF)


@dataclass(frozen=True)
class Fault:
    """One kind of failure: how law and faults are set, and whether the theorem covers it."""

    name: str
    law: str = "none"
    within: bool = True
    dropped: float = 0.0
    stuck: float | None = None
    gain: float = 0.0
    errors: tuple[float, float] = (0.0, 0.0)
    delay: int = 0
    observer: str = "harmonic"
    close: bool = False
    wide: bool = False


FAULTS = (
    Fault("none"),
    Fault("nominal law into the body", law="into the body"),
    Fault("straight to the goal", law="through"),
    Fault("random forces", law="random"),
    Fault("bang-bang forces", law="bang-bang"),
    Fault("NaN from the law", law="not a number"),
    Fault("cone program infeasible", close=True),
    Fault("observer off", observer="off"),
    Fault("thruster gain 2 %", gain=0.02, wide=True),
    Fault("estimate wrong by 10 mm, 0.3 mm/s", errors=(0.01, 3e-4), wide=True),
    Fault("commands a step late", delay=1, wide=True),
    Fault("all three, into the body", law="into the body", gain=0.02, errors=(0.01, 3e-4), delay=1, wide=True),
    Fault("1 in 10 commands dropped", dropped=0.1, within=False),
    Fault("1 in 10 dropped, into the body", law="into the body", dropped=0.1, within=False),
    Fault("thruster stuck on", stuck=0.1, within=False),
    Fault("thruster stuck off", stuck=0.0, within=False),
)
DIAGONAL = np.full(3, 1 / np.sqrt(3.0))


def sinusoids(amplitude, frequency, phase):
    arrays = (np.asarray(a, float).reshape(1, 3) for a in (amplitude, frequency, phase))
    return SinusoidalDisturbance(*arrays)


def shapes(seed):
    """Every disturbance as the same structure of arrays, so that flights of one batch can differ in it."""
    still = SquareWaveDisturbance(np.zeros(3), 100.0)
    quiet = sinusoids(np.zeros(3), np.ones(3), np.zeros(3))
    direction = np.random.default_rng(seed).normal(size=3)
    direction /= np.linalg.norm(direction)
    paper = sinusoids(np.full(3, 0.01), [0.02, 0.02, 0.01], [0, np.pi / 2, 0])
    made = {
        "paper": (paper, still),
        "constant": (sinusoids(0.999 * BOUND * direction, np.zeros(3), np.full(3, np.pi / 2)), still),
        "bang-bang": (quiet, SquareWaveDisturbance(0.999 * BOUND * direction, 2.0 * np.pi / 0.05)),
        "resonant": (quiet, SquareWaveDisturbance(0.999 * BOUND * direction, 2.0)),
        "twice the bound": (sinusoids(2 * BOUND * direction, np.zeros(3), np.full(3, np.pi / 2)), still),
    }
    return {name: CombinedDisturbance(parts) for name, parts in made.items()}


def world(name):
    path = MESHES / name
    target = Target.load(path if path.suffix else name)
    solid = OffsetSolid.build(target.distance, closing_radius=0.25)
    model = build_grid(target, spacing=SPACING[name], solid=solid)
    return target, solid, certify_grid(model, target, chaser_radius=RADIUS)


def starts(target, solid, generator, count, *, close, offset, model):
    """Draw starts outside the target; `close` ones lie inside the law's own margin but outside the guard's."""
    lower, upper = target.vertices.min(axis=0) - 4.0, target.vertices.max(axis=0) + 4.0
    kept, wanted = [], count
    while sum(map(len, kept)) < wanted:
        points = generator.uniform(lower, upper, (20000, 3))
        value = np.asarray(model.field.value(jnp.asarray(points)))
        inside = (value > offset[0]) & (value < offset[1]) if close else value > offset[1] + 0.3
        points = points[inside]
        kept.append(points[solid.is_exterior(points)])
    return np.concatenate(kept)[:wanted]


def law_for(name, target, model):
    """Build the law that works; its guidance is the slow part, and all rows of a target share it."""
    scenario = scenario_for(name, "", 600)
    return profiles.default(
        model.field,
        error_bound=model.certificate(RADIUS).error_bound,
        chaser_radius=RADIUS,
        margin=MARGIN,
        goal=np.asarray(scenario.goal.position),
        motion=environment.relative_motion(scenario),
        mass=20.0,
        force_limit=0.1,
        speed_limit=0.1,
        period=1.0,
        disturbance_bound=BOUND,
        bounds=(
            np.minimum(target.vertices.min(axis=0) - 6.0, np.asarray(GOALS[name]) - 3.0),
            np.maximum(target.vertices.max(axis=0) + 6.0, np.asarray(GOALS[name]) + 3.0),
        ),
    )


def scenario_for(name, guard, steps):
    """Give the scenario behind a group of rows; `guard` says which errors its guard is told to expect."""
    goal = GOALS[name]
    entry = {"position_error": 0.01, "velocity_error": 3e-4, "gain_error": 0.02} if guard else {}
    entry |= {"delay": 1} if guard == "late" else {}
    return Scenario().replace(
        goal={"position": goal},
        start={"position": tuple(1.2 * np.asarray(goal))},
        disturbance={"bound": BOUND},
        guard=entry,
        duration=float(steps),
    )


def setup_for(scenario, target, model, law, *, wide):
    certificate = model.certificate(RADIUS)
    guard = Guard(
        field=model.field,
        threshold=certificate.error_bound + RADIUS,
        lipschitz=certificate.gradient_bound,
        assumptions=environment.guard_assumptions(scenario, target),
    )
    stuck = broken.StuckThruster(1, 1, 0.0, start=jnp.inf)
    parts = (broken.WrongEstimate(), broken.DroppedCommands(0.0), broken.ThrusterGain(0.0), stuck)
    late = (broken.DelayedCommands(1),) if wide == "late" else ()
    return FlightSetup(
        motion=environment.relative_motion(scenario),
        disturbance=shapes(0)["paper"],
        thrusters=environment.thrusters(scenario),
        controller=broken.BrokenLaw(law, model.field, "none", 0.1, 20.0, 0.1),
        goal=np.asarray(scenario.goal.position),
        mass=20.0,
        guard=guard,
        faults=broken.CombinedFaults((*parts, *late)),
    )


def varied(setup):
    return setup.controller.kind, setup.faults, setup.disturbance


def stacked(setup, cases):
    """One setup whose varying parts have a leading axis, one entry a case."""
    made = []
    for fault, disturbance in cases:
        parts = list(setup.faults.parts)
        parts[0] = broken.WrongEstimate(0.0, 0.0, *fault.errors)
        parts[1] = broken.DroppedCommands(fault.dropped)
        parts[2] = broken.ThrusterGain(fault.gain)
        if fault.stuck is not None:
            parts[3] = broken.StuckThruster(1, 1, fault.stuck, start=30.0)
        changed = (jnp.asarray(broken.KINDS.index(fault.law)), broken.CombinedFaults(tuple(parts)), disturbance)
        made.append(changed)
    arrays = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *made)
    return eqx.tree_at(varied, setup, arrays)


def fly_group(name, target, solid, model, law, group, flights, steps, seed, *, wide):
    scenario = scenario_for(name, wide, steps)
    setup = setup_for(scenario, target, model, law, wide=wide)
    guard, law = setup.guard, setup.controller.law
    generator = np.random.default_rng(seed)
    rows = [(fault, shape) for fault in group for shape in shapes(0)]
    rows = [r for r in rows if not (r[1] == "twice the bound" and not r[0].within)]
    cases, places = [], []
    for number, (fault, shape) in enumerate(rows):
        offset = (guard.least_value + 0.02, float(law.velocity.offset) if fault.close else guard.least_value + 0.2)
        places.append(starts(target, solid, generator, flights, close=fault.close, offset=offset, model=model))
        cases += [(fault, shapes(1000 * number + i + seed)[shape]) for i in range(flights)]
    places = np.concatenate(places)
    initial = initial_states(setup.motion, lambda _, n: (places, np.zeros((n, 3))), len(places), seed=seed)
    bounds = environment.flight_bounds(scenario)
    bounds = FlightBounds(**(vars(bounds) | {"disturbance_force": 2.0 * BOUND}))
    audits, flags, speeds = [], [], []

    def landed(first, columns):
        audits.extend(
            audit_campaign(
                columns["time"][0],
                columns["position"],
                columns["velocity"],
                columns["force"],
                target,
                guard_status=columns["guard_status"],
                chaser_radius=RADIUS,
                bounds=bounds,
                force_limit=0.1 * 1.03,
                speed_limit=scenario.chaser.speed_limit * 1.5,
                tolerance=2e-3,
            )
        )
        flags.extend(np.bitwise_or.reduce(columns["guard_status"], axis=1) & VIOLATIONS)
        speeds.extend(np.linalg.norm(columns["velocity"], axis=-1).max(axis=1))

    began = time.perf_counter()
    result = campaign(
        stacked(setup, cases),
        initial,
        steps,
        seed=seed,
        vary=varied,
        columns=("time", "position", "velocity", "force", "guard_status"),
        landed=landed,
        workers=1,
    )
    seconds = time.perf_counter() - began
    for i, (fault, shape) in enumerate(rows):
        own = slice(i * flights, (i + 1) * flights)
        verdicts = audits[own]
        hurt = np.array([a.contact is not Contact.NO for a in verdicts])
        flagged = np.array(flags[own]) != 0
        yield {
            "target": Path(name).stem,
            "fault": fault.name,
            "disturbance": shape,
            "within_assumptions": fault.within and shape != "twice the bound",
            "flights": flights,
            "contacts": sum(a.contact is Contact.YES for a in verdicts),
            "undecided": sum(a.contact is Contact.UNDECIDED for a in verdicts),
            "inconsistent": sum(not a.consistent for a in verdicts),
            "minimum_clearance_m": round(min(a.minimum_clearance for a in verdicts), 4),
            "reached": int(np.sum(np.asarray(result.reached)[own])),
            "guard_share": float(np.mean([a.guard_interventions / a.steps for a in verdicts])),
            "flagged": int(flagged.sum()),
            "hurt_and_flagged": int((hurt & flagged).sum()),
            "seconds": round(seconds * flights / len(places), 2),
        }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="one list of rows instead of a table")
    parser.add_argument("--flights", type=int, default=16, help="in each row")
    parser.add_argument("--duration", type=int, default=600, help="s")
    parser.add_argument("--targets", nargs="+", default=list(GOALS), choices=list(GOALS))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rows = []
    for name in arguments.targets:
        if name.endswith(".glb") and not (MESHES / name).exists():
            print(f"{name}: not there, left out", file=sys.stderr)
            continue
        target, solid, model = world(name)
        law = law_for(name, target, model)
        deaf = dataclasses.replace(law, observer=NoObserver())
        groups = [
            ([f for f in FAULTS if not f.wide and f.observer == "harmonic"], law, ""),
            ([f for f in FAULTS if f.wide and not f.delay], law, "wide"),
            ([f for f in FAULTS if f.delay], law, "late"),
            ([f for f in FAULTS if f.observer == "off"], deaf, ""),
        ]
        for group, flown, wide in groups:
            size = (arguments.flights, arguments.duration, arguments.seed)
            for row in fly_group(name, target, solid, model, flown, group, *size, wide=wide):
                rows.append(row)
                if not arguments.json:
                    print("  ".join(f"{v!s:>14}" if k != "fault" else f"{v:<36}" for k, v in row.items()), flush=True)
    promised = [r for r in rows if r["within_assumptions"]]
    hurt = [r for r in rows if r["contacts"] + r["undecided"]]
    if arguments.json:
        print(json.dumps(rows, indent=1))
    else:
        print(f"within assumptions: {sum(r['flights'] for r in promised)} flights, ", end="")
        print(f"{sum(r['contacts'] for r in promised)} contacts, {sum(r['undecided'] for r in promised)} undecided")
        print(f"hurt flights: {sum(r['contacts'] + r['undecided'] for r in hurt)}, ", end="")
        print(f"of them flagged: {sum(r['hurt_and_flagged'] for r in hurt)}")


if __name__ == "__main__":
    main()
