"""Fly random start and goal pairs around each target: does each law reach, without contact, and at what cost.

    python benchmarks/reach.py --targets intelsat30 iss pocket ../shared/meshes/ssl1300.glb --flights 1000 --json

Rows: the default law with each kind of guidance, the paper's law, and the default law round a target that tumbles about
a random axis at each of the `--tumbling` rates. Every pair keeps 0.5 m between the chaser's surface and the exact mesh,
and lies outside the target. No guard flies along: this measures the law. Contacts are judged between samples by the
audit. A target without a shipped field gets one, fitted and certified once and kept in the folder of `--out`.

Each row is written to `--out` as soon as it is flown; a run that was stopped goes on from there, and one target a run
may be given. `refused` pairs are those that the law would not fly, with the reason on standard error: they count as
flights that did not reach. `time_over_bound` is the median, over the flights that reached, of (time to reach) / (length
of the shortest free way / speed limit); `delta_v_mps` is the median, and `delta_v_over_floor` the median of
Δv / (∫‖d‖/m dt + 2 v_max).
"""

import argparse
import json
import sys
import time
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from reach_case import Case

import keepout
from keepout.audit.audit import Contact, audit_campaign
from keepout.control.conditions import drift_bound
from keepout.control.guidance.geodesic import geodesic_guidance
from keepout.control.guidance.plan import Straight
from keepout.control.profiles import ControlWarning
from keepout.control.tuning import tune
from keepout.flight.batches import BATCH, fly_batches
from keepout.flight.setup import FlightSetup
from keepout.mission import environment
from keepout.mission.build import build_law, operation
from keepout.report import terminal
from keepout.whole_file import write_whole

LAWS = {
    "geodesic": {"profile": "default", "guidance": "geodesic", "circulation": "none"},
    "none": {"profile": "default", "guidance": "straight", "circulation": "none"},
    "printed": {"profile": "default", "guidance": "straight", "circulation": "printed"},
    "skew": {"profile": "default", "guidance": "straight", "circulation": "skew"},
    "switching": {"profile": "default", "guidance": "straight", "circulation": "switching"},
    "paper": {"profile": "paper", "guidance": "straight", "circulation": "printed"},
}
TUMBLING_SPEED = {0.5: 0.05}
"""Speed limits (m/s) of fast tumblers, by rate in degrees a second: what the thrusters can follow there."""


def within_authority(case, scenario):
    """Which pairs the thrusters can follow (those not further out than the last that `tune` accepts), and how far."""
    reach = np.linalg.norm(case.pairs, axis=-1).max(axis=-1)
    designed = operation(scenario, case.model)
    ordered, reason = np.sort(reach), None

    def refusal(radius):
        try:
            tune(
                designed,
                drift_bound=drift_bound(designed.motion, radius=float(radius), speed=designed.chaser.speed_limit),
            )
        except keepout.KeepoutError as refused:
            return f"at {radius:.1f} m from the target: {refused}"
        return None

    first, last = 0, len(ordered)
    while first < last:
        middle = (first + last) // 2
        found = refusal(ordered[middle])
        if found is None:
            first = middle + 1
        else:
            last, reason = middle, found
    furthest = ordered[first - 1] if first else 0.0
    return reach <= furthest, furthest, reason


def fly_row(case, law, rate):
    """One row of the table."""
    choices = LAWS[law]
    profile = choices["profile"]
    scenario = case.scenario.replace(control=choices)
    if rate:
        tumbling = {"kind": "tumbling", "angular_velocity": (0.0, 0.0, float(np.radians(rate)))}
        speed = TUMBLING_SPEED.get(rate, scenario.chaser.speed_limit)
        scenario = scenario.replace(attitude=tumbling, chaser={"speed_limit": speed})
    began = time.perf_counter()
    reach, reason = float(np.linalg.norm(case.pairs, axis=-1).max()), None
    flown = np.ones(case.flights, bool)
    if rate:
        flown, reach, reason = within_authority(case, scenario)
    refused = [] if reason is None else [reason] * int(np.sum(~flown))
    row = {"target": case.name, "profile": profile, "guidance": choices["circulation"] if law == "paper" else law}
    row |= {"flights": case.flights, "reached": 0, "contacts": 0, "minimum_clearance_m": None}
    row |= {"saturated_fraction": None, "delta_v_mps": None, "time_over_bound": None}
    row |= {"tumbling_deg_s": rate, "speed_limit_mps": scenario.chaser.speed_limit}
    index = np.flatnonzero(flown)
    if len(index):
        chosen = {"reach": float(reach)} if profile == "default" else {}
        row |= fly_pairs(case, scenario, law, chosen, index, refused, rate)
    row |= {"refused": len(refused), "seconds": time.perf_counter() - began}
    for line in sorted(set(refused))[:3]:
        sys.stderr.write(f"{case.name} {law} {rate:g} deg/s: refused: {line}\n")
    return row


def fly_pairs(case, scenario, law, chosen, index, refused, rate):
    pairs = case.pairs
    first = scenario.replace(goal={"position": tuple(pairs[index[0], 1])})
    # Travel times are given to it pair by pair; until then it needs no grid.
    plan = Straight() if law == "geodesic" else None
    prototype = build_law(first, case.model, guidance=plan, from_start=False, **chosen)
    # The ways are measured with the default law's offset, for every law alike.
    offset = case.offset + float(prototype.nominal_offset)
    grid = case.grid(offset)
    ways = case.ways(offset)
    setup = FlightSetup(
        motion=prototype.motion,
        disturbance=environment.disturbance(scenario),
        thrusters=environment.chaser(scenario).thrusters,
        controller=prototype,
        goal=pairs[index[0], 1],
        mass=scenario.chaser.mass,
        period=scenario.control.period,
    )
    axes = np.random.default_rng(case.seed + 1).normal(size=(len(pairs), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    seconds = round(case.seconds * case.scenario.chaser.speed_limit / scenario.chaser.speed_limit)
    result = Results(case, scenario, ways)
    with terminal.progress(f"{case.name}, {law}, {rate:g} deg/s") as progress:
        # Travel times differ from goal to goal: a batch of them at a time in memory.
        size = BATCH if law == "geodesic" else len(index)
        for begin in range(0, len(index), size):
            part, guidances = index[begin : begin + size], []
            if law == "geodesic":
                part, guidances = travel_times(case, grid, offset, prototype, part, refused)
            if len(part) == 0:
                continue
            # The last batch is filled up, so that one shape is compiled; what was added is left out again.
            whole = np.resize(part, size)
            guidances = [guidances[i % len(part)] for i in range(size)] if guidances else []
            batch = with_goals(setup, jnp.asarray(pairs[whole, 1]), guidances)
            starts = jnp.asarray(pairs[whole, 0])
            initial = eqx.filter_vmap(setup.motion.initial_state)(starts, jnp.zeros_like(starts))
            if rate:
                initial = eqx.tree_at(
                    lambda s: s.angular_velocity, initial, jnp.asarray(np.radians(rate) * axes[whole])
                )
            result.add(
                part,
                batch,
                initial,
                seconds,
                lambda f, m, begin=begin: progress((begin + f * size) / max(len(index), size), m),
            )
    return result.row() | {"seconds_flown": seconds}


def travel_times(case, grid, offset, prototype, part, refused):
    """Give the pairs that a way joins, and their guidances: marched once a pair, for all rows."""
    leader = prototype.velocity.guidance
    speed, slowing = float(leader.speed), float(leader.slowing_length)
    flown, guidances = [], []
    for i in part:
        if i not in case.guidances:
            start, goal = case.pairs[i]
            try:
                case.guidances[i] = geodesic_guidance(
                    grid, case.model.field, offset, goal, speed=speed, slowing_length=slowing, start=start
                )
            except keepout.KeepoutError as refusal:
                case.guidances[i] = str(refusal)
        found = case.guidances[i]
        if isinstance(found, str):
            refused.append(found)
            continue
        flown.append(i)
        guidances.append(
            eqx.tree_at(lambda g: (g.speed, g.slowing_length), found, (leader.speed, leader.slowing_length))
        )
    return np.array(flown, dtype=int), guidances


def with_goals(setup, goals, guidances):
    """Give every flight its own goal: its own travel-time grid where there are guidances, else only the goal."""
    if guidances:
        setup = eqx.tree_at(lambda s: s.controller.velocity.guidance, setup, guidances[0])
        guidance = jax.tree.map(lambda *leaves: np.stack(leaves), *guidances)
    else:
        one = setup.controller.velocity.guidance
        guidance = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(goals), *leaf.shape)), one)
        guidance = eqx.tree_at(lambda g: g.goal, guidance, goals)
    return eqx.tree_at(lambda s: (s.goal, s.controller.velocity.guidance), setup, (goals, guidance))


class Results:
    """What became of the flights of a row."""

    def __init__(self, case, scenario, ways):
        self.case, self.scenario, self.ways = case, scenario, ways
        self.reached, self.saturated, self.delta_v, self.floor, self.ratio = [], [], [], [], []
        self.audits = []

    def add(self, part, setup, initial, seconds, progress):
        """Fly and audit the pairs `part`; flights beyond them only fill up a batch."""
        chaser, period = self.scenario.chaser, self.scenario.control.period
        bounds = environment.flight_bounds(self.scenario)
        floors = []

        def landed(first, columns):
            own = {name: column[: max(len(part) - first, 0)] for name, column in columns.items()}
            if len(own["time"]) == 0:
                return
            self.audits += audit_campaign(
                own["time"][0],
                own["position"],
                own["velocity"],
                own["force"],
                self.case.target,
                chaser_radius=chaser.radius,
                bounds=bounds,
                force_limit=chaser.force_limit,
                speed_limit=chaser.speed_limit,
            )
            push = np.linalg.norm(own["disturbance"], axis=-1).sum(axis=-1) * period
            floors.extend(push / chaser.mass + 2.0 * chaser.speed_limit)

        outcome = fly_batches(
            setup,
            initial,
            round(seconds / period),
            vary=lambda s: (s.goal, s.controller.velocity.guidance),
            columns=("time", "position", "velocity", "force", "disturbance"),
            landed=landed,
            progress=progress,
        )
        count = len(part)
        self.reached += list(np.asarray(outcome.reached)[:count])
        self.saturated += list(np.asarray(outcome.saturated_fraction)[:count])
        self.delta_v += list(np.asarray(outcome.delta_v)[:count])
        self.floor += floors
        self.ratio += list(np.asarray(outcome.time_to_reach)[:count] * chaser.speed_limit / self.ways[part])

    def row(self):
        """Give the row's figures."""
        reached = np.array(self.reached, dtype=bool)
        if len(reached) == 0:
            return {}
        return {
            "reached": int(reached.sum()),
            "contacts": sum(a.contact is Contact.YES for a in self.audits),
            "undecided": sum(a.contact is Contact.UNDECIDED for a in self.audits),
            "minimum_clearance_m": min(a.minimum_clearance for a in self.audits),
            "saturated_fraction": float(np.mean(self.saturated)),
            "delta_v_mps": float(np.median(self.delta_v)),
            "delta_v_over_floor": float(np.median(np.array(self.delta_v) / np.array(self.floor))),
            "time_over_bound": float(np.median(np.array(self.ratio)[reached])) if reached.any() else None,
        }


def key(row):
    """Tell a row from every other; a row with the same key need not be flown again."""
    names = ("target", "profile", "guidance", "tumbling_deg_s", "flights", "seed", "field_sha256", "version")
    return tuple(row.get(name) for name in names)


def show(rows):
    columns = ("target", "profile", "guidance", "tumbling_deg_s", "flights", "refused", "reached", "contacts")
    columns += ("undecided", "minimum_clearance_m", "saturated_fraction", "delta_v_mps", "delta_v_over_floor")
    columns += ("time_over_bound", "seconds")
    sys.stdout.write("| " + " | ".join(columns) + " |\n|" + " --- |" * len(columns) + "\n")
    for row in rows:
        shown = [f"{v:.3g}" if isinstance(v, float) else str(v) for v in (row.get(name, "") for name in columns)]
        sys.stdout.write("| " + " | ".join(shown) + " |\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=1000, help="pairs for each row")
    parser.add_argument(
        "--targets",
        nargs="+",
        default=["intelsat30", "iss", "pocket"],
        help="built-in names, mesh files in metres, or MESH=FIELD with a field already made",
    )
    parser.add_argument("--laws", nargs="*", default=list(LAWS), choices=list(LAWS))
    parser.add_argument("--tumbling", nargs="*", type=float, default=[0.1, 0.5], help="rates, degrees a second")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/reach.json"), help="rows flown so far")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", ControlWarning)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    kept = json.loads(arguments.out.read_text()) if arguments.out.exists() else []
    rows = []
    for source in arguments.targets:
        case = Case(source, arguments.out.parent, arguments.flights, arguments.seed)
        wanted = [(law, 0.0) for law in arguments.laws] + [("geodesic", rate) for rate in arguments.tumbling]
        for law, rate in wanted:
            choices = LAWS[law]
            mark = {"seed": arguments.seed, "field_sha256": case.model.sha256, "version": keepout.__version__}
            plan = {
                "target": case.name,
                "profile": choices["profile"],
                "tumbling_deg_s": rate,
                "flights": arguments.flights,
            }
            plan |= {"guidance": choices["circulation"] if law == "paper" else law, **mark}
            row = next((row for row in kept if key(row) == key(plan)), None)
            if row is None:
                row = fly_row(case, law, rate) | mark
                kept.append(row)
                write_whole(arguments.out, json.dumps(kept, indent=2) + "\n")
            rows.append(row)
            sys.stderr.write(json.dumps(row) + "\n")
    if arguments.json:
        sys.stdout.write(json.dumps(rows, indent=2) + "\n")
    else:
        show(rows)


if __name__ == "__main__":
    main()
