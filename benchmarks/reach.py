"""Fly random start and goal pairs around each target: does each law reach, without contact, and at what cost.

    .venv/bin/python benchmarks/reach.py --flights 1000 --json

Every pair keeps 0.5 m between the chaser's surface and the exact mesh, and lies outside the target. No guard flies
along: this measures the law. Contacts are judged between samples by the audit; `time_over_bound` is the median, over
the flights that reached, of (time to reach) / (length of the shortest free way / speed limit), and
`delta_v_over_floor` the median of Δv / (∫‖d‖/m dt + 2 v_max).
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

import keepout
from keepout import environment
from keepout.control import profiles
from keepout.control.fast_marching import travel_time
from keepout.control.geodesic import BarrierGrid, geodesic_guidance
from keepout.fields.model import FieldModel
from keepout.fields.shipped import load_shipped, shipped_names
from keepout.flight.audit import Contact, audit_campaign
from keepout.flight.campaign import campaign
from keepout.flight.setup import FlightSetup
from keepout.geometry.offset_solid import OffsetSolid
from keepout.geometry.target import Target
from keepout.scenario import Scenario

LAWS = {
    "default/geodesic": ("default", {"guidance": "geodesic", "circulation": "none"}),
    "default/straight": ("default", {"guidance": "straight", "circulation": "none"}),
    "default/printed": ("default", {"guidance": "straight", "circulation": "printed"}),
    "default/skew": ("default", {"guidance": "straight", "circulation": "skew"}),
    "default/switching": ("default", {"guidance": "straight", "circulation": "switching"}),
    "paper/straight": ("paper", {"guidance": "straight", "circulation": "none"}),
    "paper/printed": ("paper", {"guidance": "straight", "circulation": "printed"}),
}
CLEARANCE = 0.5
GROUP = 128


def draw_pairs(target, solid, radius, box, count, generator):
    """Draw starts and goals (count, 2, 3) m, uniform in the box, outside the target, with CLEARANCE of room."""
    lower, upper = box
    kept = np.empty((0, 3))
    while len(kept) < 2 * count:
        points = generator.uniform(lower, upper, (4 * count, 3))
        points = points[target.distance.distance(points) > radius + CLEARANCE]
        kept = np.concatenate([kept, points[solid.is_exterior(points)]])
    return kept[: 2 * count].reshape(count, 2, 3)


def shortest_ways(grid, goal, starts):
    """Lengths (m) of the shortest free ways from each start to the goal, by fast marching at unit speed."""
    node = grid.node(goal)
    speed = np.where(grid.values > 0.0, 1.0, 0.0)
    first = float(np.linalg.norm(grid.origin + grid.spacing * node - goal))
    reached = travel_time(speed, grid.walls, node[None], np.array([first]), grid.spacing)
    return np.array([reached[tuple(grid.node(start))] for start in starts])


def with_goals(setup, goals, guidances):
    """Give every flight its own goal: its own travel-time grid where there are guidances, else only the goal."""
    if guidances:
        setup = eqx.tree_at(lambda s: s.controller.velocity.guidance, setup, guidances[0])
        guidance = jax.tree.map(lambda *leaves: jnp.stack(leaves), *guidances)
    else:
        one = setup.controller.velocity.guidance
        guidance = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(goals), *leaf.shape)), one)
        guidance = eqx.tree_at(lambda g: g.goal, guidance, goals)
    return eqx.tree_at(lambda s: (s.goal, s.controller.velocity.guidance), setup, (goals, guidance))


def fly_law(law, name, target, model, scenario, pairs, seconds):
    """One row of the table."""
    profile, choices = LAWS[law]
    radius = scenario.chaser.radius
    certificate = model.certificate(radius)
    motion = environment.relative_motion(scenario)
    disturbance = environment.disturbance(scenario)
    common = {
        "error_bound": certificate.error_bound,
        "chaser_radius": radius,
        "margin": scenario.safety.margin,
        "motion": motion,
        "mass": scenario.chaser.mass,
        "force_limit": scenario.chaser.force_limit,
        "speed_limit": scenario.chaser.speed_limit,
        "period": scenario.control.period,
        "disturbance_bound": environment.disturbance_bound(scenario),
        **choices,
    }
    build = getattr(profiles, profile)
    points = pairs.reshape(-1, 3)
    lower = np.minimum(points.min(axis=0), target.vertices.min(axis=0)) - 3.0
    upper = np.maximum(points.max(axis=0), target.vertices.max(axis=0)) + 3.0
    law_offset = certificate.error_bound + radius + scenario.safety.margin
    prototype = build(model.field, goal=pairs[0, 1], **(common | {"guidance": "straight"}))
    offset = law_offset + float(prototype.nominal_offset)
    grid = BarrierGrid.build(model.field, offset, lower, upper)
    reach, clear, ratio, floors, delta_v, saturated = [], [], [], [], [], []
    contacts = undecided = refused = 0
    for begin in range(0, len(pairs), GROUP):
        part = pairs[begin : begin + GROUP]
        flown, guidances, ways = [], [], []
        for start, goal in part:
            try:
                if choices["guidance"] == "geodesic":
                    slowing = float(prototype.velocity.guidance.slowing_length)
                    guidances.append(
                        geodesic_guidance(
                            grid,
                            model.field,
                            offset,
                            goal,
                            speed=scenario.chaser.speed_limit,
                            slowing_length=slowing,
                            start=start,
                        )
                    )
            except keepout.KeepoutError as refusal:
                refused += 1
                sys.stderr.write(f"{name} {law}: refused: {refusal}\n")
                continue
            flown.append((start, goal))
            ways.append(shortest_ways(grid, goal, [start])[0])
        flown = np.array(flown)
        setup = FlightSetup(
            motion=motion,
            disturbance=disturbance,
            thrusters=environment.thrusters(scenario),
            controller=prototype,
            goal=part[0, 1],
            mass=scenario.chaser.mass,
            period=scenario.control.period,
        )
        setup = with_goals(setup, jnp.asarray(flown[:, 1]), guidances)
        starts = flown[:, 0]
        initial = eqx.filter_vmap(motion.initial_state)(jnp.asarray(starts), jnp.zeros_like(starts))
        logs = {}

        def landed(first, columns, logs=logs):
            logs[first] = columns

        result = campaign(
            setup,
            initial,
            round(seconds),
            vary=lambda s: (s.goal, s.controller.velocity.guidance),
            columns=("time", "position", "velocity", "force", "disturbance"),
            landed=landed,
        )
        for first in sorted(logs):
            columns = logs[first]
            audits = audit_campaign(
                columns["time"][0],
                columns["position"],
                columns["velocity"],
                columns["force"],
                target,
                chaser_radius=radius,
                bounds=environment.flight_bounds(scenario),
                force_limit=scenario.chaser.force_limit,
                speed_limit=scenario.chaser.speed_limit,
            )
            contacts += sum(a.contact is Contact.YES for a in audits)
            undecided += sum(a.contact is Contact.UNDECIDED for a in audits)
            clear += [a.minimum_clearance for a in audits]
            push = np.linalg.norm(columns["disturbance"], axis=-1).sum(axis=-1) * scenario.control.period
            floors += list(push / scenario.chaser.mass + 2.0 * scenario.chaser.speed_limit)
        reach += list(result.reached)
        saturated += list(result.saturated_fraction)
        delta_v += list(result.delta_v)
        ratio += list(np.asarray(result.time_to_reach) * scenario.chaser.speed_limit / np.array(ways))
    reach, ratio = np.array(reach), np.array(ratio)
    over_floor = np.array(delta_v) / np.array(floors)
    return {
        "target": name,
        "profile": profile,
        "guidance": law.split("/")[1],
        "flights": len(reach),
        "refused": refused,
        "reached": int(reach.sum()),
        "contacts": contacts,
        "undecided": undecided,
        "minimum_clearance_m": float(np.min(clear)),
        "saturated_fraction": float(np.mean(saturated)),
        "delta_v_mps": float(np.median(delta_v)),
        "delta_v_over_floor": float(np.median(over_floor)),
        "time_over_bound": float(np.median(ratio[reach])) if reach.any() else None,
        "seconds_flown": seconds,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=1000, help="pairs for each target and law")
    parser.add_argument(
        "--targets", nargs="+", default=None, help="built-in names; by default all with a shipped field"
    )
    parser.add_argument(
        "--field", nargs=2, action="append", default=[], metavar=("MESH", "FIELD"), help="a mesh file in m"
    )
    parser.add_argument("--laws", nargs="+", default=list(LAWS), choices=list(LAWS))
    parser.add_argument("--seconds", type=float, default=None, help="length of a flight; by default from the box")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", profiles.ControlWarning)
    names = list(shipped_names()) if arguments.targets is None else arguments.targets
    cases = [(name, Target.load(name), load_shipped(name)) for name in names]
    for mesh, path in arguments.field:
        target = Target.load(mesh, units="m")
        cases.append((Path(mesh).stem, target, FieldModel.load(path, target=target)))
    rows = []
    for name, target, model in cases:
        scenario = Scenario().replace(seed=arguments.seed)
        generator = np.random.default_rng(arguments.seed)
        solid = OffsetSolid.build(target.distance, closing_radius=min(scenario.chaser.radius, 0.25))
        lower, upper = target.vertices.min(axis=0) - 5.0, target.vertices.max(axis=0) + 5.0
        pairs = draw_pairs(target, solid, scenario.chaser.radius, (lower, upper), arguments.flights, generator)
        seconds = arguments.seconds or 600.0 + 2.0 * float(np.linalg.norm(upper - lower)) / scenario.chaser.speed_limit
        for law in arguments.laws:
            began = time.perf_counter()
            rows.append(fly_law(law, name, target, model, scenario, pairs, round(seconds)))
            rows[-1]["seconds"] = time.perf_counter() - began
            sys.stderr.write(json.dumps(rows[-1]) + "\n")
    if arguments.json:
        sys.stdout.write(json.dumps(rows, indent=2) + "\n")
        return
    columns = [key for key in rows[0] if key != "seconds_flown"]
    sys.stdout.write("| " + " | ".join(columns) + " |\n|" + " --- |" * len(columns) + "\n")
    for row in rows:
        shown = [f"{v:.3g}" if isinstance(v, float) else str(v) for v in (row[key] for key in columns)]
        sys.stdout.write("| " + " | ".join(shown) + " |\n")


if __name__ == "__main__":
    main()
