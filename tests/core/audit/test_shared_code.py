"""The distance that the audit shares with the rest of the package, against rational arithmetic, which does not round.

It shares the bounds on rotation and gravity too: tests/core/mission/test_orbit_bounds.py has those.
"""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from keepout.core.geometry.distance import ExactDistance


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


# --- The drift's bound ------------------------------------------------------------------------------------------------
