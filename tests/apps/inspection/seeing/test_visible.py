"""What is visible from a place: every point of a unit keeps every rule, and what is left out breaks one at a corner."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from keepout.apps.inspection.seeing.patches import cut
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.apps.inspection.seeing.visible import SeeingRules, in_frame, in_view, lit_units, visible
from keepout.core.geometry.target import Target

# Its kernels take ten seconds and more to compile.
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def pocket():
    target = Target.load("pocket")
    return Sightlines(target.vertices, target.faces, cut(target, 0.6))


def corners_of(patches, unit):
    return patches.corners[unit // 2, : patches.counts[unit // 2]]


def measured(patches, unit, place, points):
    """Range, incidence and slanted distance a radian of points of a unit."""
    ways = place - points
    ranges = np.linalg.norm(ways, axis=1)
    cosine = np.clip(ways @ patches.unit_normals()[unit] / ranges, -1.0, 1.0)
    return ranges, np.arccos(cosine), ranges / np.maximum(cosine, 1e-12)


@given(
    seed=st.integers(0, 2**31),
    widest=st.floats(0.2, 1.4),
    ranges=st.tuples(st.floats(0.3, 3.0), st.floats(3.5, 12.0)),
    finest=st.sampled_from([math.inf, 0.01, 0.006]),
)
def test_all_of_a_visible_unit_keeps_the_rules_and_a_corner_of_any_other_breaks_one(
    pocket, seed, widest, ranges, finest
):
    patches, rng = pocket.patches, np.random.default_rng(seed)
    rules = SeeingRules(
        least_range=ranges[0], greatest_range=ranges[1], greatest_incidence=widest, greatest_sample_distance=finest
    )
    place = rng.uniform(-7.0, 7.0, 3)
    seen = visible(pocket, rules, place)
    assert np.linalg.norm(seen.directions, axis=1) == pytest.approx(1.0)
    for unit, direction, spread in zip(seen.units, seen.directions, seen.spread):
        corners = corners_of(patches, unit)
        points = np.concatenate([corners, rng.dirichlet(np.ones(len(corners)), 50) @ corners])
        distance, incidence, slant = measured(patches, unit, place, points)
        assert distance.max() < rules.greatest_range
        assert distance[: len(corners)].min() > rules.least_range
        assert incidence.max() <= widest + 1e-9
        assert slant.max() * rules.pixel_angle <= finest * (1.0 + 1e-9)
        ways = (points - place) / distance[:, None]
        assert np.arccos(np.clip(ways @ direction, -1.0, 1.0)).max() <= spread + 1e-7
    left = np.setdiff1d(np.flatnonzero(patches.counted), seen.units)
    clear = pocket.clear(place[None], left)
    for unit in left[clear]:
        distance, incidence, slant = measured(patches, unit, place, corners_of(patches, unit))
        assert (
            distance.max() >= rules.greatest_range - 1e-9
            or distance.min() <= rules.least_range + 1e-9
            or incidence.max() >= widest - 1e-9
            or slant.max() * rules.pixel_angle >= finest * (1.0 - 1e-9)
        )


def test_a_frame_shows_what_is_visible_and_in_view(pocket):
    patches, rng = pocket.patches, np.random.default_rng(1)
    among = rng.random(patches.units) < 0.7
    rules, shown = SeeingRules(), 0
    for _ in range(40):
        place = rng.normal(size=3) * np.array([4.0, 5.0, 3.0])
        boresight = rng.normal(size=3) - place
        boresight /= np.linalg.norm(boresight)
        for asked in (None, among):
            seen = visible(pocket, rules, place, among=asked)
            expected = seen.units[in_view(seen, boresight, rules.half_angle)]
            assert in_frame(pocket, rules, place, boresight, among=asked).tolist() == expected.tolist()
            shown += len(expected)
    assert shown > 200


def test_lit_units_keep_the_incidence_and_stand_in_no_shadow(pocket):
    patches = pocket.patches
    sun = np.array([0.3, 1.0, 0.2])
    sun /= np.linalg.norm(sun)
    rules = SeeingRules(greatest_sun_incidence=math.radians(75.0))
    lit = lit_units(pocket, rules, sun)
    incidence = np.arccos(patches.unit_normals() @ sun)
    assert lit.any()
    assert not lit[incidence > math.radians(75.0)].any()
    assert not lit[~patches.counted].any()
    shadowed = (incidence < math.radians(75.0)) & patches.counted & ~lit
    assert shadowed.any()  # the pocket's walls
    assert not pocket.lit(sun, np.flatnonzero(shadowed)).any()
    half = lit & (np.arange(patches.units) % 4 == 0)
    assert (lit_units(pocket, rules, sun, among=half) == half).all()
