"""What the audit shares with the rest of the package, against code that shares nothing with either.

It shares two things: the exact distance to the triangles, and the bounds on rotation and differential gravity. The
distance is held against libigl and against rational arithmetic, which does not round; the bounds against accelerations
found from two bodies' paths in inertial coordinates, by differences in time, without a word of relative motion.
"""

import math
from fractions import Fraction

import igl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from keepout.core.audit.tube import Tube
from keepout.core.geometry.distance import ExactDistance
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings

MU = 3.986004418e14


def exact(vector):
    return [Fraction(float(x)) for x in vector]


def dot(a, b):
    return sum(x * y for x, y in zip(a, b))


def less(a, b):
    return [x - y for x, y in zip(a, b)]


def squared_to_segment(p, a, b):
    edge, away = less(b, a), less(p, a)
    length = dot(edge, edge)
    part = min(max(dot(away, edge) / length, Fraction(0)), Fraction(1)) if length else Fraction(0)
    rest = [x - part * y for x, y in zip(away, edge)]
    return dot(rest, rest)


def squared_to_triangle(p, a, b, c):
    """Squared distance from a point to a triangle, all rational: no rounding anywhere."""
    best = min(squared_to_segment(p, *edge) for edge in ((a, b), (b, c), (c, a)))
    ab, ac, ap = less(b, a), less(c, a), less(p, a)
    d11, d12, d22, d1, d2 = dot(ab, ab), dot(ab, ac), dot(ac, ac), dot(ap, ab), dot(ap, ac)
    area = d11 * d22 - d12 * d12
    if area == 0:
        return best
    u, v = (d22 * d1 - d12 * d2) / area, (d11 * d2 - d12 * d1) / area
    if u < 0 or v < 0 or u + v > 1:
        return best
    rest = [x - u * y - v * z for x, y, z in zip(ap, ab, ac)]
    return min(best, dot(rest, rest))


def check_against_rationals(triangles, points):
    """Every distance to a relative 1e-12, or beside the surface to 5e-14 of the coordinates' size."""
    soup = ExactDistance(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    corners = [[exact(corner) for corner in triangle] for triangle in triangles]
    rounding = Fraction(5e-14 * float(max(np.abs(triangles).max(), np.abs(points).max())))
    for point, found in zip(points, soup.distance(points)):
        truth = min(squared_to_triangle(exact(point), *triangle) for triangle in corners)
        found = Fraction(float(found))
        slack = found * Fraction(1, 10**12) + rounding
        assert max(found - slack, Fraction(0)) ** 2 <= truth <= (found + slack) ** 2


SHAPES = ("plain", "sliver", "needle", "flat", "segment", "point")


def shaped(rng, shape, thinness):
    """A triangle with a kind of degeneracy; `flat` lies in a plane x = constant, `segment` has collinear corners."""
    a, b, c = rng.normal(size=(3, 3))
    if shape == "sliver":
        c = a + rng.uniform(-0.2, 1.2) * (b - a) + thinness * rng.normal(size=3)
    elif shape == "needle":
        c = b + thinness * rng.normal(size=3)
    elif shape == "flat":
        a[0] = b[0] = c[0]
    elif shape == "segment":
        # Binary fractions along a binary edge: collinear to the bit.
        a, b = np.round(a * 64.0) / 64.0, np.round(b * 64.0) / 64.0
        c = a + rng.choice([-0.5, 0.25, 0.5, 2.0]) * (b - a)
    elif shape == "point":
        b = c = a
    return np.stack([a, b, c])[rng.permutation(3)]


@pytest.mark.long
@given(
    seed=st.integers(0, 2**32 - 1),
    shapes=st.lists(st.sampled_from(SHAPES), min_size=1, max_size=6),
    thinness=st.sampled_from([1e-3, 1e-6, 1e-9, 1e-12, 1e-15, 0.0]),
    away=st.sampled_from([0.0, 1.0, 100.0]),
)
def test_distances_to_slivers_and_degenerate_triangles_are_the_rational_ones(seed, shapes, thinness, away):
    rng = np.random.default_rng(seed)
    triangles = np.stack([shaped(rng, shape, thinness) for shape in shapes]) + away
    weights = rng.dirichlet(np.ones(3), size=8)
    on = weights @ triangles[0]
    normal = rng.normal(size=(8, 3))
    points = np.concatenate(
        [
            away + 2.0 * rng.normal(size=(8, 3)),
            on,
            on + 10.0 ** rng.uniform(-12, 0, (8, 1)) * normal,
            triangles.reshape(-1, 3),
            triangles[0] + 1e-9 * normal[:3],
        ]
    )
    check_against_rationals(triangles, points)


def by_rationals(target, point, near):
    """Distance from a point to a target's triangles, `near` being about what it is; only the last root is rounded."""
    triangles = target.vertices[target.faces]
    apart = np.maximum(np.maximum(triangles.min(axis=1) - point, point - triangles.max(axis=1)), 0.0)
    candidates = triangles[np.linalg.norm(apart, axis=1) <= near + 1e-3]
    squared = min(squared_to_triangle(exact(point), *map(exact, triangle)) for triangle in candidates)
    return math.sqrt(float(squared))


@pytest.mark.long
@pytest.mark.parametrize("name", ["box", "pocket", "intelsat30", "iss"])
def test_distances_to_targets_are_libigls_and_where_it_rounds_the_rational_ones(name):
    target = Target.load(name)
    rng = np.random.default_rng(4)
    points = rng.uniform(target.distance.lower - 2.0, target.distance.upper + 2.0, (3_000, 3))
    corners = target.vertices[target.faces[rng.integers(0, len(target.faces), 3_000)]]
    beside = np.einsum("nk,nki->ni", rng.dirichlet(np.ones(3), 3_000), corners)
    points = np.concatenate([points, beside + rng.normal(size=beside.shape) * 10.0 ** rng.uniform(-9, -1, (3_000, 1))])
    found = target.distance.distance(points)
    theirs = np.sqrt(igl.point_mesh_squared_distance(points, target.vertices, target.faces)[0])
    apart = np.abs(found - theirs) > 1e-12
    # libigl subtracts squares, and loses micrometres beside the thinnest triangles of the ISS; nowhere else.
    assert apart.mean() < 0.01
    assert found[apart].max(initial=0.0) < 1e-3
    for point, distance in zip(points[apart], found[apart]):
        assert distance == pytest.approx(by_rationals(target, point, distance), rel=1e-12, abs=2e-13)


# --- The drift's bound ------------------------------------------------------------------------------------------------


def gravity(position):
    return -MU * position / np.linalg.norm(position, axis=-1, keepdims=True) ** 3


def rk4(rate, state, step):
    k1 = rate(state)
    k2 = rate(state + 0.5 * step * k1)
    k3 = rate(state + 0.5 * step * k2)
    k4 = rate(state + step * k3)
    return state + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def fall(state):
    """Rate of a state (…, 6) that falls freely: position and velocity, inertial."""
    return np.concatenate([state[..., 3:], gravity(state[..., :3])], axis=-1)


def cross_matrix(w):
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def on_orbit(scenario, anomaly):
    """The target's inertial state at a true anomaly, by the orbit's own conic section."""
    a, e = scenario.orbit.semi_major_axis, scenario.orbit.eccentricity
    p = a * (1.0 - e * e)
    r = p / (1.0 + e * math.cos(anomaly))
    speed = math.sqrt(MU / p)
    position = [r * math.cos(anomaly), r * math.sin(anomaly), 0.0]
    return np.array([*position, -speed * math.sin(anomaly), speed * (e + math.cos(anomaly)), 0.0])


class Turning:
    """From inertial to body axes over time, for each kind of attitude; a tumble by Euler's equations."""

    def __init__(self, scenario, rng):
        self.kind = scenario.attitude.kind
        self.inertia = np.asarray(scenario.attitude.inertia)
        self.start = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        self.start *= np.linalg.det(self.start)
        self.rate = np.asarray(scenario.attitude.angular_velocity)
        # Some way along the tumble, so that every part of it is seen.
        if self.kind == "tumbling":
            for _ in range(int(rng.integers(0, 100))):
                self.rate = rk4(self._euler, self.rate, 2.0)

    def _euler(self, rate):
        return np.linalg.solve(self.inertia, -np.cross(rate, self.inertia @ rate))

    def at(self, time, target):
        """The rotation at `time` s; `target` is the target's inertial state then."""
        if self.kind == "vvlh":
            z = -target[:3] / np.linalg.norm(target[:3])
            y = -np.cross(target[:3], target[3:])
            y /= np.linalg.norm(y)
            return np.stack([np.cross(y, z), y, z])
        if self.kind == "inertial":
            return self.start
        rotation, rate = self.start, self.rate
        for _ in range(2):
            both = np.concatenate([rotation.ravel(), rate])

            def turned(both):
                matrix, w = both[:9].reshape(3, 3), both[9:]
                return np.concatenate([(-cross_matrix(w) @ matrix).ravel(), self._euler(w)])

            both = rk4(turned, both, time / 2.0)
            rotation, rate = both[:9].reshape(3, 3), both[9:]
        return rotation


STENCIL = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
FIRST = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12.0
SECOND = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / 12.0


def drifts(scenario, count, seed, *, speed=0.15, h=0.5):
    """Free flights near the target: position (m), velocity and acceleration in body axes, by differences over 4 h s."""
    rng = np.random.default_rng(seed)
    answer = []
    for _ in range(count):
        turning = Turning(scenario, rng)
        target = on_orbit(scenario, rng.uniform(-np.pi, np.pi))
        r = rng.normal(size=3)
        r *= rng.choice([1.0, 20.0, 150.0]) / np.linalg.norm(r)
        v = rng.normal(size=3)
        v *= rng.choice([0.0, speed]) / np.linalg.norm(v)
        targets = {s: target if s == 0.0 else rk4(fall, target, s * h) for s in STENCIL}
        turns = [turning.at(s * h, targets[s]) for s in STENCIL]
        # Inertial velocity of a point that moves with v in the body frame.
        carried = sum(w * turn.T for w, turn in zip(FIRST, turns)) @ r / h
        now = turns[2].T
        chaser = target + np.concatenate([now @ r, carried + now @ v])
        path = []
        for s, turn in zip(STENCIL, turns):
            there = chaser if s == 0.0 else rk4(fall, chaser, s * h)
            path.append(turn @ (there[:3] - targets[s][:3]))
        answer.append((path[2], FIRST @ path / h, SECOND @ path / h**2))
    return (np.array(column) for column in zip(*answer))


WORLDS = {
    # Scenario, the share of the bound that the largest sampled drift reaches at least, and samples.
    "circular, VVLH": ({"orbit": {"semi_major_axis": 7e6}}, 0.95, 150),
    "eccentric, VVLH": ({"orbit": {"semi_major_axis": 1.2e7, "eccentricity": 0.4}}, 0.9, 600),
    "eccentric, fixed to the stars": (
        {"orbit": {"semi_major_axis": 1.2e7, "eccentricity": 0.4}, "attitude": {"kind": "inertial"}},
        0.95,
        150,
    ),
    "eccentric, tumbling": (
        {
            "orbit": {"semi_major_axis": 9e6, "eccentricity": 0.2},
            "attitude": {
                "kind": "tumbling",
                "angular_velocity": (0.012, -0.02, 0.015),
                "inertia": ((900.0, 30.0, 0.0), (30.0, 1400.0, -50.0), (0.0, -50.0, 1800.0)),
            },
        },
        0.65,
        150,
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("world", WORLDS)
def test_no_sampled_drift_passes_the_bound_and_the_largest_comes_near_it(world):
    entries, least, count = WORLDS[world]
    scenario = Scenario.parse({**entries, "disturbance": {"kind": "none"}})
    bounds = Surroundings(scenario).flight_bounds
    kappa = bounds.angular_acceleration + bounds.angular_rate**2 + bounds.gravity_gradient
    position, velocity, acceleration = drifts(scenario, count, seed=3)
    found = np.linalg.norm(acceleration, axis=1)
    allowed = 2.0 * bounds.angular_rate * np.linalg.norm(velocity, axis=1) + kappa * np.linalg.norm(position, axis=1)
    # Differences of positions of 1e7 m leave a few nanometres, over the square of half a second.
    noise = 1e-7
    assert (found <= allowed + noise).all()
    large = allowed > 1e-5
    assert large.sum() > count / 3
    assert (found / allowed)[large].max() >= least
    # And what the tube takes for the whole step from these states is no less.
    time = np.array([0.0, 1.0])
    still = np.zeros((len(position), 2, 3))
    states = (np.repeat(column[:, None], 2, axis=1) for column in (position, velocity))
    tube = Tube.of(time, *states, still, bounds)
    assert (tube.residual[:, 0] + noise >= found).all()
    assert (tube.residual[:, 0] >= allowed - 1e-12).all()
