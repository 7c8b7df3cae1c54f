"""Hold the two theorems of the tracking layer against what is flown: in continuous time, and at 1 Hz with 0.1 N.

    python benchmarks/theorems.py --figure docs/figures/theorems-at-1hz.png

From each of many random states round a sphere, inside {h₁ ≥ 0}, one control period is flown without disturbance. The
theorems ask for h₁(T) ≥ exp(−β_c T) h₁(0), and, where the desired velocity is safe throughout, for V₁(T) ≤ V₁(0). Each
is tried with the force renewed all the time or held for the period, and with unlimited thrust or 0.1 N per axis. As
flown, the default law leaves out ∂v_s/∂r and limits its feedback; for the theorems it has neither omission.
"""

import dataclasses
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from kept_rows import command, keep, tell

from keepout.core.control import profiles
from keepout.core.control.guidance import Straight
from keepout.core.control.profiles import Operation
from keepout.core.fields.own import SphereField
from keepout.core.motion.chaser import Chaser
from keepout.core.motion.disturbance import paper_disturbance
from keepout.core.motion.orbit import Orbit
from keepout.core.motion.relative import RelativeMotion
from keepout.flights.pages import figures

RADIUS, MASS, FORCE, PERIOD = 4.0, 20.0, 0.1, 1.0
SUBSTEPS = 50
ROUNDING = 1e-6
"""Share of a value below which a failure is the integrator's, not the law's."""
CASES = {
    "theorem: continuous, unlimited": (True, False, False),
    "1 Hz, unlimited": (False, False, False),
    "continuous, 0.1 N": (True, True, False),
    "1 Hz, 0.1 N, as flown": (False, True, True),
}


def law(profile, *, as_flown):
    field = SphereField(jnp.zeros(3), jnp.asarray(RADIUS))
    told = Operation(
        chaser=Chaser(mass=MASS, radius=0.5, force_limit=FORCE, speed_limit=0.1),
        motion=RelativeMotion(Orbit(42_164_000.0)),
        error_bound=0.0,
        disturbance_bound=paper_disturbance().bound,
        period=PERIOD,
    )
    goal = [0.0, -9.0, 0.0]
    if profile == "paper":
        return profiles.paper(field, told, goal)
    made = profiles.default(field, told, goal, guidance=Straight(), feedforward=not as_flown)
    if as_flown:
        return made
    return dataclasses.replace(made, tracking=dataclasses.replace(made.tracking, acceleration_limit=None))


def layers(made, position, velocity):
    """Evaluate the velocity and the tracking layer at a state, without drift and with the disturbance known."""
    memory = jnp.zeros(3)
    point, _ = made.velocity(position, velocity, memory)
    return point, made.tracking(point, position - made.goal, velocity, jnp.zeros(3), made.mass)


RUNGE_KUTTA = jnp.asarray([[0.0, 1.0 / 6.0], [0.5, 1.0 / 3.0], [0.5, 1.0 / 3.0], [1.0, 1.0 / 6.0]])


def _logged(made, state):
    tracked = layers(made, *state)[1]
    return tracked.backstepping_barrier, tracked.lyapunov


def fly_period(made, state, *, continuous, limited):
    """Return position and velocity a period later, and whether v_s = v_c throughout; Runge-Kutta in small steps."""
    step = PERIOD / SUBSTEPS

    def answer(state):
        point, tracked = layers(made, *state)
        force = jnp.clip(tracked.control, -FORCE, FORCE) if limited else tracked.control
        return force, jnp.linalg.norm(point.velocity - point.desired) < 1e-9

    def substep(carry, _):
        begin, held = carry

        def stage(carry, coefficients):
            slope, moved, free = carry
            at = jax.tree.map(lambda x, y: x + coefficients[0] * step * y, begin, slope)
            force, free_here = answer(at)
            slope = (at[1], (force if continuous else held) / MASS)
            moved = jax.tree.map(lambda x, y: x + coefficients[1] * step * y, moved, slope)
            return (slope, moved, free & free_here), None

        (_, moved, free), _ = jax.lax.scan(stage, (begin, begin, jnp.asarray(True)), RUNGE_KUTTA)
        return (moved, held), free

    (end, _), free = jax.lax.scan(substep, (state, answer(state)[0]), length=SUBSTEPS)
    return end, jnp.all(free)


def states(made, count, seed):
    """Random states with 0 ≤ h ≤ 3 m and h₁ ≥ 0, at most 0.15 m/s off the safe velocity."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    barrier = rng.uniform(0.0, 3.0, count)
    position = jnp.asarray(direction * (RADIUS + float(made.velocity.offset) + barrier)[:, None])
    safe = jax.jit(jax.vmap(lambda r: made.velocity(r, jnp.zeros(3), jnp.zeros(3))[0].velocity))(position)
    off = rng.normal(size=(count, 3))
    largest = np.minimum(np.sqrt(2.0 * float(made.tracking.barrier_ratio) * barrier), 0.15)
    off *= (largest * rng.uniform(0.0, 1.0, count) / np.linalg.norm(off, axis=1))[:, None]
    return position, safe + off


def measure(profile, case, count, seed):
    continuous, limited, as_flown = CASES[case]
    made = law(profile, as_flown=as_flown)
    position, velocity = states(made, count, seed)

    run = jax.jit(jax.vmap(lambda *state: fly_period(made, state, continuous=continuous, limited=limited)))
    values = jax.jit(jax.vmap(lambda *state: _logged(made, state)))
    end, free = run(position, velocity)
    h_before, v_before = (np.asarray(x) for x in values(position, velocity))
    h_after, v_after = (np.asarray(x) for x in values(*end))
    free = np.asarray(free)
    margin = h_after - np.exp(-float(made.tracking.barrier_rate) * PERIOD) * h_before
    growth = (v_after - v_before) / v_before
    fails = margin < -ROUNDING * np.maximum(h_before, 1e-3)
    grows = free & (growth > ROUNDING)
    row = {
        "law": profile,
        "case": case,
        "states": count,
        "barrier_condition_fails": float(np.mean(fails)),
        "worst_barrier_margin_m": float(margin.min()),
        "leaves_safe_set": float(np.mean(h_after < -ROUNDING)),
        "least_h1_m": float(h_after.min()),
        "free_states": int(free.sum()),
        "lyapunov_grows": float(np.mean(grows[free])) if free.any() else None,
        "worst_lyapunov_growth": float(growth[free].max()) if free.any() else None,
    }
    return row, margin, growth[free]


def draw(found, path):
    labels = (
        "h₁(T) − exp(−β_c T) h₁(0), m  (theorem: 0 or more)",
        "V₁(T)/V₁(0) − 1 where v_s = v_c  (theorem: 0 or less)",
    )
    with figures.figure(path, width=9.0, height=6.0) as figure:
        axes = figure.subplots(2, 2, sharey=True)
        for line, profile in enumerate(("default", "paper")):
            for column, label in enumerate(labels):
                axis = axes[line, column]
                for case in CASES:
                    ordered = np.sort(found[profile, case][column])
                    share = 100.0 * np.arange(1, len(ordered) + 1) / max(len(ordered), 1)
                    # The last two lie on each other where the thrusters are saturated throughout.
                    dashes = (4.0, 2.0) if case == list(CASES)[-1] else ()
                    axis.plot(ordered, share, label=case, linewidth=1.4, dashes=dashes)
                axis.axvline(0.0, color="0.3", linewidth=0.8)
                axis.set_xscale("symlog", linthresh=1e-3 if column == 0 else 1e-2)
                axis.set_title(f"{profile} law")
                axis.set_xlabel(label)
            axes[line, 0].set_ylabel("states below, %")
        axes[0, 0].legend(loc="upper left", fontsize=8)


def main():
    parser = command(__doc__)
    parser.add_argument("--states", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--figure", type=Path, default=None)
    parser.add_argument("--out", type=Path, help="also keep the rows in this file")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", profiles.ControlWarning)
    rows, found = [], {}
    for profile in ("default", "paper"):
        for case in CASES:
            row, margin, growth = measure(profile, case, arguments.states, arguments.seed)
            rows.append(row)
            found[profile, case] = (margin, growth)
    tell(rows, arguments)
    keep(rows, arguments.out)
    if arguments.figure is not None:
        draw(found, arguments.figure)


if __name__ == "__main__":
    main()
