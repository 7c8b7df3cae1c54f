"""D and its parts against accelerations worked out from what thrusters, bodies and frames do, errors at their vertices.

NumPy and SciPy alone: which thrusters fire is SciPy's linear program, pulses are integrated in closed form, and the
frame's accelerations are cross products. No formula is the package's.
"""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings

CORNERS = np.array(list(itertools.product([1.0, -1.0], repeat=3)))
MU = 3.986004418e14
OUTWARD = 1.0 + 1e-9
LAYOUTS_OWN = ("force_error", "excursion", "velocity_excursion", "fault_force", "fault_push")


def scenario_with(directions, forces, *, force_limit, thrusters=None, **entries):
    own = tuple(
        {"position": (0.0, 0.0, 0.0), "direction": tuple(d), "force": float(f)} for d, f in zip(directions, forces)
    )
    return Scenario().replace(
        thrusters={"layout": "own", "own": own, "least_on_time": 0.0} | (thrusters or {}),
        chaser={"force_limit": force_limit},
        **entries,
    )


class Truth:
    """A chaser whose thrusters, mass and gain are wrong by as much as a scenario allows."""

    def __init__(self, scenario):
        self.entry, self.guard, self.period = scenario.thrusters, scenario.guard, scenario.control.period
        self.mass, self.limit = scenario.chaser.mass, scenario.chaser.force_limit
        directions = np.array([own.direction for own in self.entry.own])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        self.force = np.array([own.force for own in self.entry.own])
        self.push = self.force[:, None] * directions

    def shares(self, command):
        """Shares of the period of the least thrust that gives a command, N."""
        found = linprog(self.force, A_eq=self.push.T, b_eq=command, bounds=(0.0, 1.0), method="highs")
        assert found.status == 0, found.message
        return found.x

    def on_times(self, shares, sign):
        """On-times, s: rounded as pulse-width does, or with what delta-sigma owes at the end of its range."""
        shortest = self.entry.least_on_time
        owed = 0.5 * shortest * sign * (shares > 1e-9) if self.entry.modulation == "delta-sigma" else 0.0
        wanted = self.period * shares + owed
        return np.where(wanted <= 0.5 * shortest, 0.0, np.clip(wanted, shortest, self.period))

    def pulses(self, on, before):
        """Begin and end of each thruster's pulses, (2, thrusters) each: the tail of the period before, and its own."""
        late, T = self.entry.rise_delay, self.period
        tail = np.where(before > 0.0, np.maximum(0.5 * (T + before) + late - T, 0.0), 0.0)
        begin, end = 0.5 * (T - on) + late, 0.5 * (T + on) + late
        begins = np.stack([np.zeros_like(on), np.minimum(np.where(on > 0.0, begin, T), T)])
        return begins, np.stack([tail, np.minimum(np.where(on > 0.0, end, T), T)])

    def pushes_along(self, toward):
        """Each thruster's force, N, of the size and direction within its errors that push most along `toward`."""
        size, tilt = self.entry.scale_error, self.entry.misalignment
        along = toward / np.linalg.norm(toward)
        unit = self.push / self.force[:, None]
        across = along - (unit @ along)[:, None] * unit
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        angle = np.minimum(tilt, np.arccos(np.clip(unit @ along, -1.0, 1.0)))[:, None]
        turned = self.force[:, None] * (np.cos(angle) * unit + np.sin(angle) * across)
        return turned * np.where(turned @ along > 0.0, 1.0 + size, 1.0 - size)[:, None]

    def bodies(self):
        """Every vertex of gain and mass: factors of the axes, and a mass in kg."""
        g, e = self.guard.gain_error, self.guard.mass_error
        for signs, mass in itertools.product(CORNERS if g else CORNERS[:1], (1.0 - e, 1.0 + e) if e else (1.0,)):
            yield 1.0 + g * signs, self.mass * mass

    def steps(self, commands, rng):
        """Every command's pulses, after those of another command."""
        shares = [(u, self.shares(u)) for u in commands]
        on = [(u, share, self.on_times(share, sign)) for u, share in shares for sign in (1.0, -1.0)]
        for u, shares, now in on:
            yield u, shares, self.pulses(now, on[rng.integers(len(on))][2])


def integrals(spans, pushes, time):
    """First and second integral from 0 to `time` of pulses, N s and N s²."""
    since, until = (np.maximum(time - edge, 0.0) for edge in spans)
    return (since - until).sum(axis=0) @ pushes, 0.5 * (since**2 - until**2).sum(axis=0) @ pushes


def as_steady(momentum, moment, T):
    """The two constant forces, one each half of a period, that do the same to velocity and position at its end, N."""
    mean = momentum / T
    swing = 4.0 * (moment / T**2 - 0.5 * mean)
    return mean + swing, mean - swing


def drifts(scenario, assumed, rng, count=20):
    """Accelerations of the frame, m/s², at random places and velocities as far and fast as assumed."""
    attitude = scenario.attitude
    turning, inertia = np.array(attitude.angular_velocity), np.array(attitude.inertia)
    change = np.linalg.solve(inertia, -np.cross(turning, inertia @ turning))
    target = np.array([0.0, 0.0, scenario.orbit.semi_major_axis])
    for _ in range(count):
        place, velocity = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        r = assumed.range_limit * place - np.array(scenario.target.centre_of_mass)
        v = assumed.speed_limit * velocity
        gravity = -MU * ((target + r) / np.linalg.norm(target + r) ** 3 - target / np.linalg.norm(target) ** 3)
        yield gravity - 2.0 * np.cross(turning, v) - np.cross(change, r) - np.cross(turning, np.cross(turning, r))


def shares_used(scenario, rng, commands):
    """Give of each number that the guard assumes the largest share that a vertex of the errors uses."""
    assumed, truth, T = Surroundings(scenario, extent=5.0).guard_assumptions, Truth(scenario), scenario.control.period
    drifting, disturbance = list(drifts(scenario, assumed, rng)), scenario.disturbance.bound
    times, used = np.linspace(0.0, T, 21), {}

    def use(name, *vectors):
        share = max(np.linalg.norm(vector) for vector in vectors) / getattr(assumed, name)
        used[name] = max(used.get(name, 0.0), share)

    for u, shares, spans in truth.steps(commands, rng):
        for toward in (u, -u, drifting[rng.integers(len(drifting))], rng.normal(size=3)):
            along = toward / np.linalg.norm(toward)
            # The frame and the disturbance push as far in that direction as they can.
            beside = max(drifting, key=lambda a: a @ along)
            for gain, mass in truth.bodies():
                forces = truth.pushes_along(toward) * gain
                momentum, moment = integrals(spans, forces, T)
                mean = momentum / T
                end = (moment - 0.5 * mean * T**2) / mass
                steady = as_steady(momentum, moment, T)
                lost = beside + disturbance * along / mass
                use("disturbance", *(force / mass - u / scenario.chaser.mass + lost for force in steady))
                if scenario.thrusters.least_on_time or scenario.thrusters.rise_delay:
                    use("force_error", *(force - shares @ forces for force in steady))
                for t in times:
                    speed, moved = integrals(spans, forces, t)
                    away = (moved - 0.5 * mean * t**2) / mass
                    use("velocity_excursion", (speed - mean * t) / mass)
                    use("excursion", away, away - end)
                if scenario.thrusters.survive_failure:
                    given = (spans[1] - spans[0]).sum(axis=0) / T
                    use("fault_force", *(given[:, None] * forces), *((1.0 - given)[:, None] * forces))
                    use("fault_push", *(given[:, None] * forces / mass), *((1.0 - given)[:, None] * forces / mass))
    return used


def diagonal(gain, scale):
    return scenario_with(
        CORNERS,
        np.full(8, np.sqrt(3.0) * 0.1),
        force_limit=0.1,
        thrusters={"scale_error": scale},
        guard={"gain_error": gain},
        disturbance={"kind": "none", "bound": 1e-9},
        attitude={"kind": "inertial"},
        orbit={"semi_major_axis": 9e8},
    )


@pytest.mark.parametrize(("gain", "scale"), [(0.10, 0.10), (0.15, 0.05)])
def test_the_errors_of_gain_and_of_thrusters_compound(gain, scale):
    used = shares_used(diagonal(gain, scale), np.random.default_rng(0), 0.1 * CORNERS[:1])
    # With one thruster for each corner and nothing else that acts, D is reached.
    assert 0.999 < used["disturbance"] <= OUTWARD


def test_whatever_thrusters_give_wrongly_a_wrong_gain_makes_more_of():
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    six = scenario_with(
        axes,
        np.full(6, 0.1),
        force_limit=0.1,
        thrusters={"least_on_time": 0.1, "survive_failure": True},
        guard={"gain_error": 0.3, "mass_error": 0.2},
        disturbance={"kind": "none", "bound": 1e-4},
    )
    # Fully on, half on, and just below half of the shortest pulse.
    commands = np.array([[0.1], [0.05], [0.00499]]) * CORNERS[0]
    used = shares_used(six, np.random.default_rng(0), commands)
    assert all(share <= OUTWARD for share in used.values()), used
    assert all(used[name] > 0.9 for name in LAYOUTS_OWN), used


def either(most):
    return st.sampled_from([0.0, most])


ERRORS = st.fixed_dictionaries(
    {
        "thrusters": st.fixed_dictionaries(
            {
                "scale_error": either(0.2),
                "misalignment": either(0.1),
                "least_on_time": either(0.1),
                "rise_delay": either(0.05),
                "modulation": st.sampled_from(["pulse-width", "delta-sigma"]),
                "survive_failure": st.booleans(),
            }
        ),
        "guard": st.fixed_dictionaries({"gain_error": either(0.3), "mass_error": either(0.2)}),
    }
)


def random_chaser(rng, errors):
    """Random thrusters in opposite pairs, on a random tumbling body."""
    half = rng.normal(size=(rng.integers(3, 6), 3))
    directions = np.concatenate([half, -half])
    forces = rng.uniform(0.05, 0.2, len(directions))
    pushes = forces[:, None] * directions / np.linalg.norm(directions, axis=1)[:, None]
    # The largest box whose corners all are in reach.
    cost, bounds = [0.0] * len(forces) + [-1.0], [(0.0, 1.0)] * len(forces) + [(0.0, None)]
    edges = [np.column_stack([pushes.T, -corner]) for corner in CORNERS]
    least = min(-linprog(cost, A_eq=edge, b_eq=np.zeros(3), bounds=bounds).fun for edge in edges)
    return scenario_with(
        directions,
        forces,
        force_limit=0.999 * least,
        disturbance={"kind": "none", "bound": 1e-4},
        attitude={
            "kind": "tumbling",
            "angular_velocity": tuple(0.01 * rng.normal(size=3)),
            "inertia": ((3.0, 0.2, 0.0), (0.2, 4.0, 0.0), (0.0, 0.0, 5.0)),
        },
        target={"centre_of_mass": tuple(rng.normal(size=3))},
        **errors,
    )


@pytest.mark.long
@settings(max_examples=6)
@given(st.integers(0, 10**6), ERRORS)
def test_no_vertex_of_the_errors_is_beyond_what_the_guard_assumes(seed, errors):
    rng = np.random.default_rng(seed)
    scenario = random_chaser(rng, errors)
    limit = scenario.chaser.force_limit
    commands = limit * np.array([CORNERS[rng.integers(8)], rng.uniform(-1.0, 1.0, 3)])
    used = shares_used(scenario, rng, commands)
    assert all(share <= OUTWARD for share in used.values()), used
