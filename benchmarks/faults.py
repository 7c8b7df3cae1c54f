"""Flights with everything that can go wrong, audited on the exact mesh: what the guard holds, and what it cannot.

    python benchmarks/faults.py [--flights N] [--targets intelsat30 mesh.glb …] [--json] [--out rows.json]
    python benchmarks/faults.py --keeps-margin …
    python benchmarks/faults.py --cost [--targets intelsat30]

One row for each target, fault and disturbance; N flights in all, spread evenly over the rows. `within_assumptions`
says whether the guard's theorem (docs/guard.md) covers the row; only there is zero contacts a promise. `hurt` flights
were not proved free of contact; `inside_margin` ones came nearer than the operator's margin, which the law keeps and
the guard does not, unless it is told to (`--keeps-margin`). The guard's field is a grid of exact distances; the law
flies by the shipped field where the target has one (`law_field`), else by the same grid. Rows are saved to `--out` as
they come, and are not flown again when the command is repeated with the same field (`digest`, of the mesh where the law
has the grid) and the same recipe of the guard's field (`guard_recipe`).
"""

import functools
import itertools
import json
import operator
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from faults_world import FORCE, MARGIN, MESHES, World, disturbances, look_up
from kept_rows import Rows, command

from keepout.core.audit.audit import AUDITED, Contact
from keepout.core.control.law import Command, Law
from keepout.core.flight import faults as broken
from keepout.core.flight.batches import Batching, fly_batches, states_at
from keepout.core.flight.setup import NoFaults
from keepout.core.guard.field import RECIPE
from keepout.core.guard.safety_layer import GuardFlag
from keepout.core.mission.flight import fly_audited, judge
from keepout.flights.pages import terminal

TARGETS = ("intelsat30", "iss", "tiangong", "ssl1300.glb")
VIOLATIONS = int(functools.reduce(operator.or_, (flag for flag in GuardFlag if flag is not GuardFlag.COMMAND)))
"""Flags that say that an assumption did not hold."""
TOLERANCE = 2e-3
"""How close to the truth clearances are driven, m."""
PLACE = ("target", "fault", "disturbance", "flights", "duration_s", "seed")
SETTINGS = ("digest", "guard_recipe")


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
    observer: bool = True
    close: bool = False
    told: str = ""
    """Which errors the guard is told to expect: none, "wide" or "late" (wide, and a delay of one step)."""


FAULTS = (
    Fault("none"),
    Fault("nominal law into the body", law="into the body"),
    Fault("straight to the goal", law="through"),
    Fault("random forces", law="random"),
    Fault("bang-bang forces", law="bang-bang"),
    Fault("NaN from the law", law="not a number"),
    Fault("cone program infeasible", close=True),
    Fault("observer off", observer=False),
    Fault("1 in 10 commands dropped", dropped=0.1, within=False),
    Fault("1 in 10 dropped, into the body", law="into the body", dropped=0.1, within=False),
    Fault("thruster stuck on", stuck=FORCE, within=False),
    Fault("thruster stuck off", stuck=0.0, within=False),
    Fault("thruster gain 2 %", gain=0.02, told="wide"),
    Fault("estimate wrong by 10 mm, 0.3 mm/s", errors=(0.01, 3e-4), told="wide"),
    Fault("commands a step late", told="late"),
    Fault("all three, into the body", law="into the body", gain=0.02, errors=(0.01, 3e-4), told="late"),
)
LAWLESS = ("nominal law into the body", "straight to the goal", "random forces", "bang-bang forces", "NaN from the law")
FAULTS_BEYOND = tuple(fault.name for fault in FAULTS if not fault.within)
DISTURBANCES = ("paper", "constant", "bang-bang", "resonant", "twice the bound")
ROWS = [(f, d) for f in FAULTS for d in DISTURBANCES if f.within or d != "twice the bound"]


def varied(setup):
    """Select what differs from flight to flight."""
    return setup.controller.kind, setup.faults, setup.disturbance


def row_setup(setup, fault, shape, flights, generator):
    """Give the setup of one row, its varied parts with a leading axis of flights."""
    if not fault.observer:
        setup = eqx.tree_at(lambda s: s.controller.law.observer.gain, setup, replace_fn=jnp.zeros_like)
    parts = list(setup.faults.parts)
    parts[0] = broken.WrongEstimate(0.0, 0.0, *fault.errors)
    parts[1] = broken.DroppedCommands(fault.dropped)
    parts[2] = broken.ThrusterGain(fault.gain)
    if fault.stuck is not None:
        parts[3] = broken.StuckThruster(1, 1, fault.stuck, start=30.0)
    same = (jnp.asarray(broken.KINDS.index(fault.law)), broken.CombinedFaults(tuple(parts)))
    same = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (flights, *leaf.shape)), same)
    return eqx.tree_at(varied, setup, (*same, disturbances(shape, flights, generator)))


def fly_row(world, setup, fault, plan):
    """Fly and audit one row; `plan` is what it is known by."""
    shape, flights, seed = plan["disturbance"], plan["flights"], plan["seed"]
    number = ROWS.index((fault, shape))
    generator = np.random.default_rng([seed, number])
    initial = states_at(setup.motion, world.starts(setup.guard, generator, flights, close=fault.close))
    flags = []
    began = time.perf_counter()
    outcome, audits = fly_audited(
        world.scenario(fault.told, plan["duration_s"]),
        world.target,
        row_setup(setup, fault, shape, flights, generator),
        initial,
        landed=lambda _, log: flags.extend(np.bitwise_or.reduce(log["guard_status"], axis=1) & VIOLATIONS),
        tolerance=TOLERANCE,
        seed=1000 * seed + number,
        vary=varied,
        workers=1,
    )
    hurt = np.array([a.contact is not Contact.NO for a in audits])
    flagged = np.array(flags) != 0
    return plan | {
        "within_assumptions": fault.within and shape != "twice the bound",
        "law_field": world.law_field,
        "contacts": sum(a.contact is Contact.YES for a in audits),
        "undecided": sum(a.contact is Contact.UNDECIDED for a in audits),
        "inconsistent": sum(not a.consistent for a in audits),
        "minimum_clearance_m": round(min(a.minimum_clearance for a in audits), 4),
        "reached": int(np.sum(outcome.reached)),
        "guard_share": round(float(np.mean([a.guard_interventions / a.steps for a in audits])), 6),
        "flagged": int(flagged.sum()),
        "hurt": int(hurt.sum()),
        "hurt_and_flagged": int((hurt & flagged).sum()),
        "inside_margin": sum(a.minimum_clearance < MARGIN for a in audits),
        "seconds": round(time.perf_counter() - began, 2),
    }


class Coasting(Law):
    """A law that never pushes: what is left of a step without a law."""

    order: Command

    @property
    def goal(self):
        """Nowhere in particular."""
        return jnp.zeros(3)

    def initial_state(self, state):
        """No memory."""
        return ()

    def step(self, state, estimate):
        """Push nothing."""
        return state, self.order


def cost(name, duration, flights=128):
    """Time the parts of a batched step, in microseconds of one core a flight and step."""
    world = World(name)
    base = world.setup("", duration)
    one = base.motion.initial_state(world.goal, np.zeros(3))
    order = eqx.filter_jit(lambda law: law.step(law.initial_state(one), one)[1])(world.law)
    for law in ("none", "into the body"):
        fault = next(f for f in FAULTS if f.law == law)
        generator = np.random.default_rng(0)
        initial = states_at(base.motion, world.starts(base.guard, generator, flights, close=False))
        full = row_setup(base, fault, "paper", flights, generator)
        is_none = {"is_leaf": lambda x: x is None}
        alone = eqx.tree_at(lambda s: s.guard, full, None, **is_none)
        bare = eqx.tree_at(
            lambda s: (s.faults, s.controller), alone, (NoFaults(), Coasting(jax.tree.map(jnp.zeros_like, order)))
        )
        flown = {}

        def landed(_, columns):
            flown.update(columns)  # noqa: B023

        def timed(setup, vary):
            least = np.inf
            for _ in range(3):
                began = time.process_time()
                batching = Batching(vary=vary, workers=1)
                fly_batches(setup, initial, duration, batching, columns=AUDITED, landed=landed)  # noqa: B023
                least = min(least, time.process_time() - began)
            return least / (flights * (duration + 1)) * 1e6

        rest, motion = timed(alone, varied), timed(bare, lambda s: s.disturbance)
        whole = timed(full, varied)
        began = time.process_time()
        judge(world.scenario("", duration), world.target, flown, tolerance=TOLERANCE)
        audit = (time.process_time() - began) / (flights * duration) * 1e6
        yield {
            "target": world.name,
            "law": law,
            "law_field": world.law_field,
            "motion_us": round(motion, 2),
            "law_and_faults_us": round(rest - motion, 2),
            "guard_us": round(whole - rest, 2),
            "audit_us": round(audit, 2),
            "guard_over_rest": round((whole - rest) / rest, 2),
        }


def fly_all(arguments, show):
    """Fly every row that is not in `--out` yet; give all that are there, but for those of another field than now."""
    flights = max(1, round(arguments.flights / (len(arguments.targets) * len(ROWS))))
    kind = {"keeps_margin": True} if arguments.keeps_margin else {}
    store = Rows(arguments.out, (*PLACE, "keeps_margin"), SETTINGS)
    world_of = functools.lru_cache(1)(functools.partial(World, **kind))
    setup_of = functools.lru_cache(1)(lambda world, told: world.setup(told, arguments.duration))
    with terminal.progress("faults") as progress:
        wanted = list(itertools.product(arguments.targets, ROWS))
        for done, (name, (fault, shape)) in enumerate(wanted):
            place = (Path(name).stem, fault.name, shape, flights, arguments.duration, arguments.seed)
            plan = dict(zip(PLACE + SETTINGS, (*place, look_up(name)[2], RECIPE), strict=True)) | kind
            progress(done / len(wanted), f"{place[0]}: {fault.name}, {shape}")
            if store.find(plan) is None:
                world = world_of(name)
                row = fly_row(world, setup_of(world, fault.told), fault, plan)
                store.keep(row)
                show(row)
    current = {Path(name).stem: look_up(name)[2] for name in arguments.targets}
    rows = [row for row in store.kept if row["digest"] == current.get(row["target"], row["digest"])]
    return [r for r in rows if r.get("guard_recipe") == RECIPE and r.get("keeps_margin") == kind.get("keeps_margin")]


def totals(rows):
    """Say in a table (Markdown) what all rows come to; docs/results.md has them by fault."""
    within = [row for row in rows if row["within_assumptions"]]
    groups = {
        "within the assumptions": within,
        "- nothing broken": [row for row in within if row["fault"] == "none"],
        "- a law that is none (hostile or random forces, NaN)": [row for row in within if row["fault"] in LAWLESS],
    }
    twice = [row for row in rows if row["disturbance"] == "twice the bound"]
    other = [row for row in rows if not row["within_assumptions"] and row not in twice]
    groups |= {f"beyond them: {fault}": [r for r in other if r["fault"] == fault] for fault in FAULTS_BEYOND}
    groups["beyond them: disturbance at twice its bound"] = twice
    columns = ("flights", "contacts", "undecided", "inside_margin", "flagged", "hurt", "hurt_and_flagged", "reached")
    yield "| flights | " + " | ".join(("number", *columns[1:])).replace("_", " ") + " | least clearance m |"
    yield "|" + " --- |" * (len(columns) + 2)
    for name, chosen in groups.items():
        if chosen:
            counts = [f"{sum(row[key] for row in chosen):,}".replace(",", " ") for key in columns]
            least = min(row["minimum_clearance_m"] for row in chosen)
            yield f"| {name} | " + " | ".join(counts) + f" | {least:.3f} |"


def main():
    parser = command(__doc__)
    parser.add_argument("--flights", type=int, default=2000, help="in all, spread evenly over targets and rows")
    parser.add_argument("--duration", type=int, default=600, help="of each flight, s")
    parser.add_argument("--targets", nargs="+", default=list(TARGETS), help="built-in names or mesh files")
    parser.add_argument("--keeps-margin", action="store_true", help="the guard keeps the operator's margin too")
    parser.add_argument("--out", type=Path, help="file of rows, written after each and taken up again")
    parser.add_argument("--cost", action="store_true", help="instead, time the parts of a batched step")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    there = [t for t in arguments.targets if not Path(t).suffix or Path(t).is_file() or (MESHES / t).is_file()]
    for name in sorted(set(arguments.targets) - set(there)):
        print(f"{name}: not there, left out", file=sys.stderr)
    arguments.targets = there

    def show(row):
        if not arguments.json:
            print(
                "  ".join(f"{v!s:<36}" if k == "fault" else f"{v!s:>14}" for k, v in row.items() if k != "digest"),
                flush=True,
            )

    if arguments.cost:
        rows = [row for name in there for row in cost(name, arguments.duration)]
    else:
        rows = fly_all(arguments, show)
    if arguments.json:
        print(json.dumps(rows, indent=1))
    elif arguments.cost:
        for row in rows:
            print("  ".join(f"{key} {value}" for key, value in row.items()))
    else:
        print("\n".join(totals(rows)))


if __name__ == "__main__":
    main()
