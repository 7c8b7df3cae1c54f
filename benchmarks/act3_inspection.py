"""Fly the public inspection task of act3: one burn that Hill's equations chose, then coasting, with the guard on.

    python benchmarks/act3_inspection.py --seeds 1000 --json

A row for each reading of the task (`act3_task.TASKS`): what its code says and what its documents say differ. The motion
is Keepout's exact one, not Hill's equations of the plan. The guard keeps the crash sphere: its field is the chief's
ball, its threshold what the sphere is wider. `success` counts the flights that saw all points within 12,236 s without a
crash; `least_distance_m` is a bound for all flights over their whole length, between samples too. Δv and time are those
until the last point was seen; `delta_v_axes_mps` is the sum over the thruster axes.
"""

import functools
import time
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from act3_plan import Search
from act3_task import (
    FARTHEST,
    FORCE,
    LONGEST,
    MASS,
    MEAN_MOTION,
    PERIOD,
    STEPS,
    TASKS,
    darkest,
    directions_of_points,
    push_matrix,
    start,
    steps_until_seen,
    sun_directions,
)
from kept_rows import Rows, command, tell

from keepout.apps.inspection.passive import coast_matrix
from keepout.core.control.law import Command, Law
from keepout.core.fields.own import SphereField
from keepout.core.flight.batches import Batching, fly_batches, states_at
from keepout.core.flight.setup import FlightSetup
from keepout.core.guard.braking import GuardAssumptions
from keepout.core.guard.guard import Guard
from keepout.core.motion.chaser import Thrusters
from keepout.core.motion.disturbance import NoDisturbance
from keepout.core.motion.orbit import EARTH_GRAVITATIONAL_PARAMETER, Orbit
from keepout.core.motion.relative import RelativeMotion
from keepout.flights.pages import terminal

RECIPE = 1
"""Raised where the search or the flight changes: rows of an older one are flown again."""
FASTEST = 1.5
"""That the guard allows, m/s."""
ASTRAY = 20.0
"""From the plan, m, from which on the law steers back."""
PLACE = ("task", "seeds")
SETTINGS = ("recipe",)
SHOWN = ("task", "seeds", "success", "crashes", "least_distance_m", "delta_v_mps", "time_s", "guard_interventions")


class PlannedBurn(Law):
    """Holds a force for some periods and coasts; steers back to the planned motion only where it is far from it.

    Attributes:
        force: N, body axes, held for the first `burning` periods.
        burning: their number.
        coast: matrix of Hill's equations over a period.
        push: likewise, of an acceleration.

    """

    force: jnp.ndarray
    burning: jnp.ndarray
    coast: jnp.ndarray
    push: jnp.ndarray

    @property
    def goal(self):
        """The chief: the law leads round it."""
        return jnp.zeros(3)

    def initial_state(self, state):
        """Give the periods flown and the planned state."""
        return jnp.zeros((), jnp.int32), jnp.concatenate([state.position, state.velocity])

    def step(self, state, estimate):
        """Give the planned force and, far from the plan, what leads back in about five minutes."""
        flown, planned = state
        ahead = jnp.where(flown < self.burning, self.force, 0.0)
        off, faster = estimate.position - planned[:3], estimate.velocity - planned[3:]
        back = jnp.clip(-MASS / PERIOD * (faster + off / 300.0), -FORCE, FORCE)
        force = ahead + jnp.where(jnp.linalg.norm(off) > ASTRAY, back, 0.0)
        after = self.coast @ planned + self.push @ (ahead / MASS)
        return (flown + 1, after), Command.of_force(force)


def guard(task):
    """Make the guard that keeps a task's crash sphere."""
    assumptions = GuardAssumptions(
        mass=MASS,
        force_limit=FORCE,
        period=PERIOD,
        disturbance_force=0.0,
        angular_rate=1.001 * MEAN_MOTION,
        angular_acceleration=0.0,
        gravity_gradient=2.01 * MEAN_MOTION**2,
        range_limit=FARTHEST,
        speed_limit=FASTEST,
    )
    ball = SphereField(jnp.zeros(3), jnp.asarray(min(task.radius, task.crash - 1.0)))
    return Guard(ball, threshold=task.crash - float(ball.radius), lipschitz=1.0, assumptions=assumptions)


def setup(task, forces, burning):
    """Give the flights of a task: exact motion, law and guard; force (n, 3) N and periods (n,) differ between them."""
    motion = RelativeMotion(Orbit((EARTH_GRAVITATIONAL_PARAMETER / MEAN_MOTION**2) ** (1.0 / 3.0)))
    law = PlannedBurn(
        jnp.asarray(forces),
        jnp.asarray(burning),
        jnp.asarray(coast_matrix(MEAN_MOTION, PERIOD)),
        jnp.asarray(push_matrix(MEAN_MOTION, PERIOD)),
    )
    return FlightSetup(
        motion, NoDisturbance(), Thrusters(FORCE), law, goal=np.zeros(3), mass=MASS, period=PERIOD, guard=guard(task)
    )


def least_distances(positions, forces, drift):
    """Bound from below how near each flight (n, k, 3) came to the chief's centre, m, between samples too.

    A motion with an acceleration of at most a strays from the chord of a step of T seconds by at most a T²/8.
    """
    here, along = positions[:, :-1], np.diff(positions, axis=1)
    share = np.clip(-np.sum(here * along, axis=-1) / np.maximum(np.sum(along**2, axis=-1), 1e-30), 0.0, 1.0)
    chord = np.linalg.norm(here + share[..., None] * along, axis=-1)
    stray = (np.linalg.norm(forces[:, :-1], axis=-1) / MASS + drift) * PERIOD**2 / 8.0
    return np.min(chord - stray, axis=1)


def fly(task, seeds, told=lambda done, words: None):
    """Fly a task's starts; give a dictionary of arrays with an entry each flight, and the search's seconds."""
    begun = time.perf_counter()
    search, starts = Search(task), [start(task, seed) for seed in seeds]
    burns = []
    for done, one in enumerate(starts):
        burns.append(search.find(*one) or (np.zeros(3), 1))
        told(0.6 * done / len(starts), "burns")
    searched = time.perf_counter() - begun
    forces, burning = np.array([burn[0] for burn in burns]), np.array([burn[1] for burn in burns], np.int32)
    flights = setup(task, forces, burning)
    initial = states_at(flights.motion, [one[0] for one in starts], [one[1] for one in starts])
    drift, certified = float(flights.guard.assumptions.drift), _certified(flights.guard, initial)
    points, dimmest, found = directions_of_points(), darkest(task), []

    def land(first, log):
        least = least_distances(log["position"], log["force"], drift)
        for i, positions in enumerate(log["position"]):
            suns = sun_directions(starts[first + i][2])
            steps = steps_until_seen(positions, suns, points, task.radius, 0.0, dimmest)
            last = int(steps.max()) if np.all(steps >= 0) else STEPS
            pushed = log["force"][i, :last] * PERIOD / MASS
            found.append(
                {
                    "seen": int(np.sum(steps >= 0)),
                    "time_s": last * PERIOD,
                    "delta_v_mps": float(np.linalg.norm(pushed, axis=1).sum()),
                    "delta_v_axes_mps": float(np.abs(pushed).sum()),
                    "least_distance_m": float(least[i]),
                    "farthest_m": float(np.linalg.norm(positions, axis=1).max()),
                    "guard_interventions": int(np.sum(log["guard_status"][i, :-1] & 0b11 != 0)),
                    "certified": bool(certified[first + i]),
                }
            )

    fly_batches(
        flights,
        initial,
        STEPS,
        Batching(vary=lambda s: (s.controller.force, s.controller.burning)),
        columns=("position", "force", "guard_status"),
        landed=land,
        progress=lambda done, words: told(0.6 + 0.4 * done, words),
    )
    return {name: np.array([one[name] for one in found]) for name in found[0]}, searched


@eqx.filter_jit
def _certified(guard, states):
    return eqx.filter_vmap(guard.certified_start)(states)


def row(task, seeds, told=lambda done, words: None):
    """Fly a row and sum it up."""
    begun = time.perf_counter()
    found, searched = fly(task, range(seeds), told)
    points = len(directions_of_points())
    crashed = ~(found["least_distance_m"] >= task.crash)
    lost = ~(found["farthest_m"] <= FARTHEST)
    success = (found["seen"] == points) & ~crashed & ~lost & (found["time_s"] <= LONGEST)
    spread = {
        f"{name}_{what}": float(value)
        for name in ("delta_v_mps", "delta_v_axes_mps", "time_s")
        for what, value in (
            ("mean", found[name].mean()),
            ("at_90_percent", np.quantile(found[name], 0.9)),
            ("at_most", found[name].max()),
        )
    }
    return {
        "points": points,
        "success": int(success.sum()),
        "crashes": int(crashed.sum()),
        "too_far": int(lost.sum()),
        "least_seen": int(found["seen"].min()),
        "crash_radius_m": task.crash,
        "least_distance_m": float(found["least_distance_m"].min()),
        "delta_v_mps": float(np.median(found["delta_v_mps"])),
        "delta_v_axes_mps": float(np.median(found["delta_v_axes_mps"])),
        "time_s": float(np.median(found["time_s"])),
        **spread,
        "guard_interventions": int(found["guard_interventions"].sum()),
        "certified_starts": int(found["certified"].sum()),
        "search_seconds": searched,
        "seconds": time.perf_counter() - begun,
    }


def main():
    parser = command(__doc__)
    parser.add_argument("--seeds", type=int, default=1000, help="starts for each row: seeds 0, 1, 2, …")
    parser.add_argument("--tasks", nargs="*", default=list(TASKS), choices=list(TASKS))
    parser.add_argument("--out", type=Path, default=Path("out/act3-inspection.json"), help="rows flown so far")
    arguments = parser.parse_args()
    store, rows = Rows(arguments.out, PLACE, SETTINGS), []
    for name in arguments.tasks:
        plan = {"task": name, "seeds": arguments.seeds, "recipe": RECIPE}
        with terminal.progress(f"act3, {name}") as progress:
            rows.append(store.made(plan, functools.partial(row, TASKS[name], arguments.seeds, progress)))
    tell(rows, arguments, SHOWN)


if __name__ == "__main__":
    main()
