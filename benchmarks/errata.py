"""Measure what each misprint or slip of the source paper does: the effect column of docs/control.md.

    python benchmarks/errata.py --json

Each row names the erratum as that page does, a quantity, its value as the text printed has it, and as Keepout has it.
What is flown is told in the row; the whole takes about two minutes.
"""

import dataclasses
import json
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from kept_rows import command, tell
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from theorems import law, layers

from keepout.core.control.observer import continuous, printed_observer
from keepout.core.control.profiles import ControlWarning
from keepout.core.control.velocity import SwitchingCirculation, skew_circulation
from keepout.core.fields import load_shipped
from keepout.core.fields.field import values
from keepout.core.flight.batches import states_at
from keepout.core.geometry.target import Target
from keepout.core.mission.build import fly
from keepout.core.mission.flight import fly_audited
from keepout.core.mission.law import build_law
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.disturbance import paper_disturbance
from keepout.core.whole_file import write_whole
from keepout.flights.pages import terminal

EARTH = 3.986004418e14
"""μ, m³/s²."""
GEOSTATIONARY, LOW = 42_164_000.0, 6_778_000.0
"""Orbit radii, m."""
MASS, FORCE, SPEED, PERIOD = 20.0, 0.1, 0.1, 1.0
BETA_E, BETA_C, BETA, GAIN = 0.1, 10.0, 1.0, 50.0
"""The paper's β_e, β_c, β and L."""
OMEGA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
START = np.array([0.0, 10.0, 6.0])


def row(erratum, quantity, printed, mended, unit):
    # What is left of a zero by rounding in float64 is no effect.
    plain = [None if entry is None else float(entry) for entry in (printed, mended)]
    plain = [0.0 if entry is not None and abs(entry) < 1e-15 else entry for entry in plain]
    return {"erratum": erratum, "quantity": quantity, "printed": plain[0], "mended": plain[1], "unit": unit}


def directions(count, seed=0):
    drawn = np.random.default_rng(seed).normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def sign_of_gravity():
    """Ten minutes of free motion by the relative equation, against the difference of two Kepler orbits."""

    def pull(position):
        return -EARTH * position / np.linalg.norm(position) ** 3

    for name, radius in (("geostationary", GEOSTATIONARY), ("low", LOW)):
        rate = np.sqrt(EARTH / radius**3)
        spin = np.array([0.0, -rate, 0.0])  # VVLH: z to nadir, y against the orbit normal

        def relative(_, state, sign, spin=spin, radius=radius):
            r, v = state[:3], state[3:]
            target = np.array([0.0, 0.0, -radius])
            difference = pull(target + r) - pull(target)  # the chaser's gravity beyond the target's: -g
            turning = -2.0 * np.cross(spin, v) - np.cross(spin, np.cross(spin, r))
            return np.concatenate([v, turning + sign * difference])

        def two_orbits(_, state):
            return np.concatenate([state[3:6], pull(state[:3]), state[9:], pull(state[6:9])])

        axes = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        target, velocity = np.array([0.0, 0.0, -radius]), np.array([rate * radius, 0.0, 0.0])
        inertial = np.concatenate([target, velocity, target + START, velocity + np.cross(spin, START)])
        exact = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-9}
        end = solve_ivp(two_orbits, (0.0, 600.0), inertial, **exact).y[:, -1]
        angle = rate * 600.0
        turned = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
        truth = turned.T @ axes @ (end[6:9] - end[:3])
        errors = []
        for sign in (-1.0, 1.0):
            flown = solve_ivp(relative, (0.0, 600.0), np.concatenate([START, np.zeros(3)]), args=(sign,), **exact)
            errors.append(np.linalg.norm(flown.y[:3, -1] - truth))
        yield row("+ g", f"error of the position after 600 s of free motion, {name} orbit", *errors, "m")


def anomaly_for_rate():
    rate = np.sqrt(EARTH / GEOSTATIONARY**3)
    for name, turning in (("an hour after perigee", 3600.0 * rate),):
        printed, mended = (spin**2 * 10.0 for spin in (turning, rate))
        yield row("ω_o", f"centrifugal acceleration 10 m away, {name}, geostationary", printed, mended, "m/s²")


def worst_gradient_error():
    gradient = directions(200_000)
    for name, velocity in (("mean", directions(200_000, seed=1)), ("mean flying straight at the surface", -gradient)):
        least = -np.linalg.norm(velocity, axis=1)
        printed = np.sum(-gradient * velocity, axis=1) - least
        mended = np.sum(-velocity / np.linalg.norm(velocity, axis=1, keepdims=True) * velocity, axis=1) - least
        yield row("worst e₂", f"e₂·v above its least, in e_∇h ‖v‖: {name}", printed.mean(), mended.mean(), "")


def circulation_matrix():
    gradient = directions(200_000)
    turned = gradient @ OMEGA.T
    length = np.linalg.norm(turned, axis=1)
    along = np.abs(np.sum(gradient * turned, axis=1)) / length
    yield row("Ω", "mean angle by which Ω∇f̃ leaves the level set", np.degrees(np.arcsin(along)).mean(), 0.0, "°")
    constant = np.asarray(skew_circulation().omega)
    switching, rest = SwitchingCirculation(), jnp.zeros(3)
    for name, normal in (("ŷ", np.array([0.0, 1.0, 0.0])), ("(1, 1, 1)/√3", np.ones(3) / np.sqrt(3.0))):
        facing = jnp.asarray(normal)
        memory = switching.update(rest, jnp.asarray(0.0), facing, -facing, -facing)
        turned = {"skew": constant @ normal, "switching": np.asarray(switching.matrix(memory)) @ normal}
        for choice, vector in turned.items():
            lengths = np.linalg.norm(OMEGA @ normal), np.linalg.norm(vector)
            yield row("Ω ŷ = 0", f"length of Ω∇f̃ on a face whose normal is {name}; mended: {choice}", *lengths, "")


def heading_along_y():
    """Case 1 with start and goal straight behind each other along y, at k_p = 20 m and 1 Hz."""
    base = Scenario().replace(
        duration=1500.0,
        start={"position": (0.0, 10.0, -2.0)},
        goal={"position": (0.0, -10.0, -2.0)},
        guard={"enabled": False},
    )
    for rate, force, name in ((1.0, 0.1, "1 Hz, 0.1 N"), (0.05, 10.0, "20 Hz, 10 N")):
        left = []
        for circulation in ("printed", "skew"):
            control = {"profile": "paper", "circulation": circulation, "paper": {"slowing_length": 20.0}}
            scenario = base.replace(control=control | {"period": rate}, chaser={"force_limit": force})
            left.append(fly(scenario).outcome.final_error)
        yield row("Ω ŷ = 0", f"distance left after 1500 s, (0, 10, -2) to (0, -10, -2), k_p = 20 m, {name}", *left, "m")


def speed_box():
    """Ask both laws for their velocity at random places far from a ball, where only the limit holds them."""
    found = []
    for profile in ("paper", "default"):
        made = law(profile, as_flown=True)
        places = 60.0 * directions(2000)
        fastest = jax.vmap(lambda place, made=made: made.velocity(place, jnp.zeros(3), jnp.zeros(3))[0].velocity)
        found.append(np.linalg.norm(fastest(jnp.asarray(places)), axis=1).max() / SPEED)
    yield row("b_v", "largest ‖v_s‖ over v_max at 2000 places 60 m from a ball", *found, "")


def feasible_rest():
    model = load_shipped("intelsat30")
    certificate = model.certificate(0.5)
    target = Target.load("intelsat30")
    lower, upper = target.vertices.min(axis=0) - 2.0, target.vertices.max(axis=0) + 2.0
    points = np.random.default_rng(0).uniform(lower, upper, (200_000, 3))
    free = points[target.distance.distance(points) > 0.5]
    barrier = values(model.field, free) - certificate.error_bound - 0.5 - Scenario().safety.margin
    share = float(np.mean(barrier < 0.0))
    yield row("Theorem 2", "share of contact-free places within 2 m where v_s = 0 is infeasible", share, None, "")


def observer_rates():
    # φ = ∂φ/∂r = I with the mass: A - I/m; the paper's A = I. With L = 50 I: A - L/m.
    yield row("φ, ϕ, L", "growth of the estimation error, A - ϕC/m with ϕ = I", 1.0 - 1.0 / MASS, None, "1/s")
    rate = GAIN / MASS - 1.0
    yield row("β_e", "β_e that A = I, L = 50 I and m = 20 kg imply", BETA_E, rate, "1/s")
    yield row("β_e", "2β_e, which must exceed β_c = 10", 2.0 * BETA_E, 2.0 * rate, "1/s")


def remainder(observer, period):
    """Share of the paper's disturbance that an observer leaves, RMS over 2000 s after it has settled."""
    disturbance = paper_disturbance()
    times = np.arange(0.0, 2000.0, period)
    force = np.stack([np.asarray(disturbance.force(jnp.asarray(t))) for t in times])
    velocity = np.zeros(3)
    state = observer.initial_state(jnp.zeros(3))
    left = []
    for now in force:
        after = velocity + period * now / MASS
        left.append(now - np.asarray(observer.estimate(state, jnp.asarray(velocity))))
        state = observer.update(state, jnp.asarray(velocity), jnp.asarray(after), jnp.zeros(3), jnp.zeros(3))
        velocity = after
    settled = times > 200.0
    return np.sqrt(np.mean(np.square(left)[settled]) / np.mean(np.square(force)[settled]))


def generator():
    printed = printed_observer(mass=MASS, period=PERIOD)
    mended = continuous(np.zeros((3, 3)), np.eye(3), GAIN * np.eye(3), mass=MASS, period=PERIOD)
    for name, share in (
        ("share of the paper's disturbance left, RMS", remainder),
        ("estimate of a constant push, over it", settled),
    ):
        yield row("A = I", name, share(printed, PERIOD), share(mended, PERIOD), "")


def settled(observer, period):
    """Give what an observer says of a constant push, over the push, when nothing changes any more."""
    push, velocity = np.array([0.01, 0.0, 0.0]), np.zeros(3)
    state = observer.initial_state(jnp.zeros(3))
    for _ in range(2000):
        after = velocity + period * push / MASS
        state = observer.update(state, jnp.asarray(velocity), jnp.asarray(after), jnp.zeros(3), jnp.zeros(3))
        velocity = after
    return float(observer.estimate(state, jnp.asarray(velocity))[0]) / push[0]


def sampled_tracking():
    """Hold a force for a second, and see what becomes of v - v_s: far from a ball, where v_s hardly changes."""
    factors = []
    for profile in ("paper", "default"):
        made = dataclasses.replace(law(profile, as_flown=False), force_limit=jnp.full(3, 1e6))
        position = jnp.asarray([0.0, 60.0, 0.0])
        safe = made.velocity(position, jnp.zeros(3), jnp.zeros(3))[0].velocity
        ends = []
        for off in (1e-3, -1e-3):
            velocity = safe + jnp.asarray([off, 0.0, 0.0])
            force = layers(made, position, velocity)[1].control
            after = velocity + PERIOD * force / MASS
            there = position + PERIOD * (velocity + after) / 2.0
            ends.append(after - made.velocity(there, after, jnp.zeros(3))[0].velocity)
        factors.append((ends[0] - ends[1])[0] / 2e-3)
    yield row("λ = 15", "factor on v - v_s from one second to the next", *factors, "")


def completed_square():
    """Hold the identity of the first completion of squares against random errors, where its roots exist."""
    generator = np.random.default_rng(0)
    error, other = generator.normal(size=(2, 100_000, 3))
    yield row(
        "first completion",
        "ββ_e - ββ_c/2 at the printed β_e, under a root",
        BETA * BETA_E - BETA * BETA_C / 2,
        None,
        "",
    )
    for rate in (6.0, 10.0, 100.0):
        left = np.sum(other * error, axis=1) + (BETA * rate - BETA * BETA_C / 2) * np.sum(error**2, axis=1)
        gaps = []
        for sign in (1.0, -1.0):
            square = np.sqrt(BETA * rate + sign * BETA * BETA_C / 2) * error
            square = square + other / np.sqrt(2.0 * BETA * (2.0 * rate - BETA_C))
            right = np.sum(square**2, axis=1) - np.sum(other**2, axis=1) / (2.0 * BETA * (2.0 * rate - BETA_C))
            gaps.append(np.abs(right - left).mean() / np.abs(left).mean())
        what = f"mean gap between the two sides of the identity, relative, β_e = {rate:g} /s"
        yield row("first completion", what, *gaps, "")


def sampled_barrier():
    """Fly Case 3's starts with β_c T = 10 and 1 and all other conditions met, so that nothing else tells them apart."""
    base = Scenario().replace(
        duration=1000.0,
        goal={"position": (0.0, -10.0, 6.0)},
        guard={"enabled": False},
        control={"profile": "paper"},
        chaser={"force_limit": 10.0},
    )
    made = build_law(base, load_shipped("intelsat30"), from_start=False)
    starts = np.random.default_rng(0).uniform((-15.0, -5.0, -4.0), (15.0, 5.0, -4.0), (400, 3))
    barrier = values(load_shipped("intelsat30").field, starts) - float(made.velocity.offset)
    starts = starts[barrier > 0.0][:128]
    found = []
    for rate in (10.0, 1.0):
        change = {"gain": 1.0, "estimation_rate": 6.0, "barrier_rate": rate}
        tracking = dataclasses.replace(made.tracking, **{name: jnp.asarray(value) for name, value in change.items()})
        setup = Surroundings(base).setup(dataclasses.replace(made, tracking=tracking))
        target = Target.load("intelsat30")
        outcome, _ = fly_audited(base, target, setup, states_at(setup.motion, starts), columns=())
        found.append(np.asarray(outcome.minimum_barrier))
    count, least = ([choose(one) for one in found] for choose in (lambda h: np.mean(h < 0.0), np.min))
    yield row("β_c T", "share of 128 flights in which h falls below 0, λ = 1, β_e = 6, 10 N", *count, "")
    yield row("β_c T", "least h of them", *least, "m")


def weight_of_position():
    """Theorem 4 needs r_eᵀ H₀ tanh(r_e/k_p) > 0, which a positive-definite H₀ does not give."""
    weight = np.array([[1.0, -3.0, 0.0], [-3.0, 10.0, 0.0], [0.0, 0.0, 1.0]])
    error = np.array([20.0, 1.5, 0.0])
    assert np.linalg.eigvalsh(weight).min() > 0.0
    products = [error @ some @ np.tanh(error / 1.5) for some in (weight, np.diag(np.diag(weight)))]
    yield row("H₀", "r_eᵀ H₀ tanh(r_e/k_p) at r_e = (20, 1.5, 0) m; mended: its diagonal", *products, "m²")


def jump_of_gradient():
    """Give how far ∇f turns across the medial axis of a groove, by differences of the distance to its walls."""

    def slope(place, walls):
        steps = 1e-6 * np.eye(2)
        return np.array([(walls(place + step) - walls(place - step)) / 2e-6 for step in steps])

    grooves = {
        "a slit": (lambda p: np.minimum(1.0 - p[0], 1.0 + p[0]), (0.0, 0.0)),
        "a right-angled groove": (lambda p: np.min((p[0], p[1])), (1.0, 1.0)),
        "a groove of 120°": (
            lambda p: p[1] * np.sin(np.radians(60.0)) - abs(p[0]) * np.cos(np.radians(60.0)),
            (0.0, 1.0),
        ),
    }
    for name, (walls, place) in grooves.items():
        across = np.array([1.0, 0.0]) if place[0] == 0.0 else np.array([1.0, -1.0]) / np.sqrt(2.0)
        one, other = (slope(np.array(place) + side * 1e-3 * across, walls) for side in (1.0, -1.0))
        yield row("e_∇h", f"jump of ∇f across the middle of {name}", np.linalg.norm(one - other), None, "")


def lyapunov_decrease():
    error = 10.0
    yield row("V̇₁", "claimed decrease over the true one, 10 m off, k_p = 1.5 m", error / np.tanh(error / 1.5), 1.0, "")


def authority():
    bound, asked = float(paper_disturbance().bound), float(law("paper", as_flown=True).velocity.class_k.rate) * SPEED
    yield row("speed limits", "deceleration asked, α₀ v_max, and available", asked, (FORCE - bound) / MASS, "m/s²")


def inward_surface():
    """Find the zero level of the distance to a ball of 1 m, over-stated and under-stated by 0.1 m."""

    def drawn(overstatement):
        return brentq(lambda radius: np.linalg.norm([radius, 0.0, 0.0]) - 1.0 + overstatement, 0.0, 3.0)

    what = "radius at which a ball of 1 m is drawn, its distance over- or under-stated by 0.1 m"
    yield row("over-estimating", what, drawn(0.1), drawn(-0.1), "m")


def units_of_table():
    """Take e_h of Table I as metres, and in the radius of the target's ball, in which fields are trained."""
    for name, printed in (("iss", 0.019), ("tiangong", 0.012), ("intelsat30", 0.031)):
        scale = float(load_shipped(name).field.scale)
        yield row("Table I", f"e_h of {name}, read as metres, and in radii of its ball", printed, printed * scale, "m")


def goal_in_the_station():
    mesh = Target.load("iss").distance
    field = load_shipped("iss").field
    places = np.array([[0.0, -10.0, 6.0], [0.0, -10.0, -6.0]])
    yield row("ISS goal", "distance of the goal from the mesh, as printed and with z up", *mesh.distance(places), "m")
    yield row("ISS goal", "learned signed distance there", *values(field, places), "m")


ERRATA = (
    sign_of_gravity,
    anomaly_for_rate,
    inward_surface,
    worst_gradient_error,
    circulation_matrix,
    heading_along_y,
    speed_box,
    feasible_rest,
    observer_rates,
    generator,
    sampled_tracking,
    completed_square,
    sampled_barrier,
    lyapunov_decrease,
    weight_of_position,
    authority,
    jump_of_gradient,
    units_of_table,
    goal_in_the_station,
)


def main():
    parser = command(__doc__)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/errata.json"))
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", ControlWarning)  # that the printed constants violate conditions is the subject
    rows = []
    with terminal.progress("errata") as progress:
        for place, measure in enumerate(ERRATA):
            progress(place / len(ERRATA), measure.__name__)
            rows += measure()
    lines = ",\n".join(json.dumps(entry, ensure_ascii=False) for entry in rows)
    write_whole(arguments.out, f"[\n{lines}\n]\n")
    tell(rows, arguments)


if __name__ == "__main__":
    main()
