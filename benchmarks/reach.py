"""Fly random start and goal pairs around each target: does each law reach, without contact, and at what cost.

    python benchmarks/reach.py --targets intelsat30 iss pocket ../shared/meshes/ssl1300.glb --flights 1000 --json
    python benchmarks/reach.py --flights 128 --laws paper --tumbling --slowing 1.5 5 10 20 \
        --gradient 0 0.2 0.42 0.9 largest

Rows: the default law with each kind of guidance, the paper's law, and the default law round a target that tumbles about
a random axis at each of the `--tumbling` rates. Every pair keeps 0.5 m between the chaser's surface and the exact mesh,
and lies outside the target. No guard flies along: this measures the law. Contacts are judged between samples by the
audit. A target without a shipped field gets one, fitted and certified once and kept in the folder of `--out`.

The paper prints neither k_p nor e_∇h: its law has a row for each `--slowing` length and each `--gradient` error, where
`largest` is the largest ‖∇d − ∇f̃‖ that was sampled within 3 m outside the target. A flight may take 6 k_p/v_max longer.

Each row is written to `--out` as soon as it is flown; a run that was stopped goes on from there, and one target a run
may be given. `refused` pairs are those that the law would not fly, with the reason on standard error: they count as
flights that did not reach. `time_over_bound` is the median, over the flights that reached, of (time to reach) / (length
of the shortest free way / speed limit); `delta_v_mps` is the median, and `delta_v_over_floor` the median of
Δv / (∫‖d‖/m dt + 2 v_max).
"""

import functools
import itertools
import sys
import time
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from kept_rows import Rows, command, tell
from reach_case import Case

import keepout
from keepout.core.audit.audit import Contact
from keepout.core.control.geodesic import geodesic_guidance
from keepout.core.control.guidance import Straight
from keepout.core.control.profiles import ControlWarning, drift_bound, tune
from keepout.core.flight.batches import BATCH, states_at
from keepout.core.mission.flight import fly_audited
from keepout.core.mission.law import build_law, operation
from keepout.core.mission.surroundings import Surroundings
from keepout.flights.pages import terminal

LAWS = {
    "geodesic": {"profile": "default", "guidance": "geodesic", "circulation": "none"},
    "none": {"profile": "default", "guidance": "straight", "circulation": "none"},
    "printed": {"profile": "default", "guidance": "straight", "circulation": "printed"},
    "skew": {"profile": "default", "guidance": "straight", "circulation": "skew"},
    "switching": {"profile": "default", "guidance": "straight", "circulation": "switching"},
    "paper": {"profile": "paper", "guidance": "straight", "circulation": "printed"},
}
PLACE = ("target", "profile", "guidance", "slowing_length_m", "gradient_error", "tumbling_deg_s", "flights", "seed")
SETTINGS = ("field_sha256", "version")
SHOWN = (
    *PLACE[:-1],
    "refused",
    "reached",
    "clean",
    "contacts",
    "undecided",
    "minimum_clearance_m",
    "saturated_fraction",
)
SHOWN += ("delta_v_mps", "delta_v_over_floor", "time_over_bound", "seconds")
_MOST_NODES = 1e9
"""Nodes of all pairs' grids together, above which guidances are not kept: they would not fit in memory."""
TUMBLING_SPEED = {0.5: 0.05}
"""Speed limits (m/s) of fast tumblers, by rate in degrees a second: what the thrusters can follow there."""


def within_authority(case, scenario):
    """Which pairs the thrusters can follow (those not further out than the last that `tune` accepts), and how far."""
    reach = np.linalg.norm(case.pairs, axis=-1).max(axis=-1)
    error_bound = case.model.certificate(scenario.chaser.radius).error_bound
    designed = operation(Surroundings(scenario), error_bound)
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


def planned(case, law, rate, slowing, gradient):
    """Give the entries by which a row is known before it is flown."""
    choices = LAWS[law]
    guidance = choices["circulation"] if law == "paper" else law
    names = (case.name, choices["profile"], guidance, slowing, gradient, rate, case.flights, case.seed)
    row = dict(zip(PLACE, names, strict=True))
    return row | dict(zip(SETTINGS, (case.model.sha256, keepout.__version__), strict=True))


def fly_row(case, law, rate, slowing, gradient):
    """One row of the table, but for what it is known by."""
    began, scenario = time.perf_counter(), case.scenario.replace(control=LAWS[law])
    if law == "paper":
        scenario = scenario.replace(control={"paper": {"slowing_length": slowing, "gradient_error": gradient}})
    reach, reason = float(np.linalg.norm(case.pairs, axis=-1).max()), None
    flown = np.ones(case.flights, bool)
    if rate:
        tumbling = {"kind": "tumbling", "angular_velocity": (0.0, 0.0, float(np.radians(rate)))}
        speed = TUMBLING_SPEED.get(rate, scenario.chaser.speed_limit)
        scenario = scenario.replace(attitude=tumbling, chaser={"speed_limit": speed})
        flown, reach, reason = within_authority(case, scenario)
    speed = scenario.chaser.speed_limit
    seconds = round(case.seconds * case.scenario.chaser.speed_limit / speed)
    if slowing is not None:
        seconds += round(6.0 * slowing / speed)
    refused = [] if reason is None else [reason] * int(np.sum(~flown))
    row = {
        "reached": 0,
        "clean": 0,
        "contacts": 0,
        "minimum_clearance_m": None,
        "saturated_fraction": None,
        "delta_v_mps": None,
    }
    row |= {"time_over_bound": None, "speed_limit_mps": speed}
    if flown.any():
        chosen = {"reach": float(reach)} if LAWS[law]["profile"] == "default" else {}
        scenario = scenario.replace(duration=float(seconds))
        row |= fly_pairs(case, scenario, law, chosen, np.flatnonzero(flown), refused, rate)
        row |= {"seconds_flown": seconds}
    for line in sorted(set(refused))[:3]:
        sys.stderr.write(f"{case.name} {law} {rate:g} deg/s: refused: {line}\n")
    return row | {"refused": len(refused), "seconds": time.perf_counter() - began}


def fly_pairs(case, scenario, law, chosen, index, refused, rate):
    """Fly the pairs `index`, and give the row's figures."""
    pairs = case.pairs
    first = scenario.replace(goal={"position": tuple(pairs[index[0], 1])})
    # Travel times are given to it pair by pair; until then it needs no grid.
    plan = Straight() if law == "geodesic" else None
    prototype = build_law(first, case.model, guidance=plan, from_start=False, **chosen)
    # The ways are measured with the default law's offset, for every law alike.
    offset = case.offset + float(prototype.nominal_offset)
    grid = case.grid(offset)
    ways = case.ways(offset)
    setup = Surroundings(first).setup(prototype)
    axes = np.random.default_rng(case.seed + 1).normal(size=(len(pairs), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    flown = []
    with terminal.progress(f"{case.name}, {law}, {rate:g} deg/s") as progress:
        # Travel times differ from goal to goal: a batch of them at a time in memory.
        size = BATCH if law == "geodesic" else len(index)
        for begin in range(0, len(index), size):
            part, guidances = index[begin : begin + size], []
            if law == "geodesic":
                part, guidances = travel_times(case, grid, offset, prototype, part, refused)
            if len(part) == 0:
                continue
            initial = states_at(setup.motion, pairs[part, 0])
            if rate:
                initial = eqx.tree_at(lambda s: s.angular_velocity, initial, jnp.asarray(np.radians(rate) * axes[part]))
            floors = []
            outcome, audits = fly_audited(
                scenario,
                case.target,
                with_goals(setup, jnp.asarray(pairs[part, 1]), guidances),
                initial,
                columns=("disturbance",),
                landed=lambda _, log, floors=floors: floors.extend(floor(scenario, log["disturbance"])),
                vary=lambda s: (s.goal, s.controller.velocity.guidance),
                batch=min(size, BATCH),
                progress=lambda f, m, begin=begin: progress((begin + f * size) / max(len(index), size), m),
            )
            flown.append((part, outcome, audits, floors))
    return figures(flown, ways, scenario.chaser.speed_limit)


def travel_times(case, grid, offset, prototype, part, refused):
    """Give the pairs that a way joins, and their guidances: marched once a pair, for all rows."""
    leader = prototype.velocity.guidance
    speed, slowing = float(leader.speed), float(leader.slowing_length)
    flown, guidances = [], []
    if grid.values.size * case.flights > _MOST_NODES:
        case.guidances = {}
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


def floor(scenario, disturbance):
    """Give the Δv (m/s) that each flight's disturbance (flights, steps + 1, 3) N and two changes of speed cost."""
    push = np.linalg.norm(disturbance, axis=-1).sum(axis=-1) * scenario.control.period
    return push / scenario.chaser.mass + 2.0 * scenario.chaser.speed_limit


def figures(flown, ways, speed_limit):
    """Give a row's figures from its parts: the pairs of each, their outcomes, audits, and floors of Δv."""
    if not flown:
        return {}
    parts, outcomes, audits, floors = zip(*flown, strict=True)
    outcome = jax.tree.map(lambda *arrays: np.concatenate(arrays), *outcomes)
    audits, reached = sum(audits, ()), outcome.reached
    touched = np.array([audit.contact is not Contact.NO for audit in audits])
    ratio = outcome.time_to_reach * speed_limit / ways[np.concatenate(parts)]
    return {
        "reached": int(reached.sum()),
        "clean": int(np.sum(reached & ~touched)),
        "contacts": sum(a.contact is Contact.YES for a in audits),
        "undecided": sum(a.contact is Contact.UNDECIDED for a in audits),
        "minimum_clearance_m": min(a.minimum_clearance for a in audits),
        "saturated_fraction": float(np.mean(outcome.saturated_fraction)),
        "delta_v_mps": float(np.median(outcome.delta_v)),
        "delta_v_over_floor": float(np.median(outcome.delta_v / np.concatenate(floors))),
        "time_over_bound": float(np.median(ratio[reached])) if reached.any() else None,
    }


def main():
    parser = command(__doc__)
    parser.add_argument("--flights", type=int, default=1000, help="pairs for each row")
    parser.add_argument(
        "--targets",
        nargs="+",
        default=["intelsat30", "iss", "pocket"],
        help="built-in names, mesh files in metres, or MESH=FIELD with a field already made",
    )
    parser.add_argument("--laws", nargs="*", default=list(LAWS), choices=list(LAWS))
    parser.add_argument("--tumbling", nargs="*", type=float, default=[0.1, 0.5], help="rates, degrees a second")
    parser.add_argument("--slowing", nargs="+", type=float, default=[1.5], help="k_p of the paper's law, m")
    parser.add_argument("--gradient", nargs="+", default=[0.0], help="e_∇h of the paper's law, or `largest`")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/reach.json"), help="rows flown so far")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", ControlWarning)
    store, rows = Rows(arguments.out, PLACE, SETTINGS), []
    for source in arguments.targets:
        case = Case(source, arguments.out.parent, arguments.flights, arguments.seed)
        largest = case.gradient_error if "largest" in arguments.gradient else None
        errors = [largest if error == "largest" else float(error) for error in arguments.gradient]
        flown = [("geodesic", rate, None, None) for rate in arguments.tumbling]
        for law in arguments.laws:
            settings = itertools.product(arguments.slowing, errors) if law == "paper" else [(None, None)]
            flown += [(law, 0.0, *setting) for setting in settings]
        for one in flown:
            rows.append(store.made(planned(case, *one), functools.partial(fly_row, case, *one)))
    tell(rows, arguments, SHOWN)


if __name__ == "__main__":
    main()
