"""The smallest ball around what two balls share, against points of both and a numerical minimum."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import optimize

from keepout.core.flight.navigation import Ball
from keepout.flights.navigation.known_set import cut

CUT = jax.jit(cut)
RADII = st.floats(1e-6, 1e3)
POINTS = st.tuples(*[st.floats(-1e3, 1e3)] * 3)


def ball(centre, radius):
    return Ball(jnp.asarray(centre, dtype=float), jnp.asarray(radius, dtype=float))


def shared_profile(R1, R2, d, count=4001):
    """Points of the lens's outline: along the line through both centres, and how far it is from it there."""
    x = np.linspace(max(-R1, d - R2), min(R1, d + R2), count)
    # The rim, where the two spheres meet, is the outline's corner: the grid must have it.
    if d > 0:
        x = np.append(x, np.clip((d**2 + R1**2 - R2**2) / (2 * d), x[0], x[-1]))
    return x, np.sqrt(np.maximum(np.minimum(R1**2 - x**2, R2**2 - (x - d) ** 2), 0.0))


@given(RADII, RADII, st.floats(0.0, 0.999))
@example(1.0, 1.0, 0.5)
@example(1.0, 0.2, 0.9)
@example(1.0, 1.0, 0.0)
def test_the_radius_is_the_numerical_minimum(R1, R2, share):
    d = share * (R1 + R2)
    found, meets = CUT(ball([0, 0, 0], R1), ball([d, 0, 0], R2))
    assert bool(meets)
    x, y = shared_profile(R1, R2, d)

    def reach(centre):
        return np.max(np.hypot(x - centre, y))

    # By symmetry the centre is on the axis; the largest distance is convex in it.
    small = min(R1, R2)
    ends = x[0], x[:-1].max()
    least = optimize.minimize_scalar(reach, bounds=ends, method="bounded", options={"xatol": 1e-9 * small})
    # The outline is off by rounding of the larger radius, of which a root is taken.
    assert float(found.radius) >= least.fun * (1 - 1e-5) - 1e-7 * max(R1, R2)
    assert float(found.radius) <= least.fun * (1 + 1e-5) + 1e-6 * max(R1, R2)
    assert float(found.radius) <= small


@given(POINTS, RADII, POINTS, RADII, st.integers(0, 2**31))
def test_points_of_both_are_inside_it_is_never_wider_and_balls_that_do_not_meet_are_told(first, R1, second, R2, seed):
    found, meets = CUT(ball(first, R1), ball(second, R2))
    distance = float(np.linalg.norm(np.subtract(first, second)))
    if abs(distance - R1 - R2) > 1e-9 * (distance + R1 + R2):
        assert bool(meets) == (distance <= R1 + R2)
    assert float(found.radius) <= (min(R1, R2) if bool(meets) else R1)
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(2000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length = np.where(np.arange(2000) % 2, 1.0 - 1e-15, rng.uniform(size=2000) ** (1 / 3))[:, None]
    of_first = np.asarray(first) + R1 * length * direction
    of_second = np.asarray(second) + R2 * length * direction
    both = np.concatenate([of_first, of_second])
    both = both[(np.linalg.norm(both - first, axis=1) <= R1) & (np.linalg.norm(both - second, axis=1) <= R2)]
    assert bool(meets) or not len(both)
    assert (np.linalg.norm(both - np.asarray(found.centre), axis=1) <= float(found.radius)).all()


def test_what_is_infinite_or_no_number_changes_nothing():
    known = ball([1.0, 2.0, 3.0], 0.5)
    for other, meet in (
        (ball([9.0, 9.0, 9.0], np.inf), True),
        (ball([np.nan, 0.0, 0.0], 0.5), False),
        (ball([1.0, 2.0, 3.0], np.nan), False),
    ):
        found, meets = CUT(known, other)
        assert bool(meets) == meet
        assert np.asarray(found.centre).tolist() == [1.0, 2.0, 3.0]
        assert float(found.radius) == 0.5
    found, meets = CUT(ball([9.0, 9.0, 9.0], np.inf), known)
    assert bool(meets)
    assert float(found.radius) == 0.5
    assert np.asarray(found.centre).tolist() == [1.0, 2.0, 3.0]
