"""What a scenario says of inspecting as objects, and what is refused before anything flies."""

import dataclasses
import itertools
import math

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from keepout.control.guidance.plan import Straight
from keepout.errors import InspectionError
from keepout.fields.analytic import SphereField
from keepout.geometry.target import Target
from keepout.inspecting import equipment
from keepout.mission.law import law_on, room_for_guard
from keepout.mission.light import Light
from keepout.mission.scenario import Scenario
from keepout.seeing.patches import Patches
from keepout.seeing.room import Room
from keepout.seeing.seeable import Hidden, Seeable, Verdict

TARGET = Target.load("box")
"""4 x 3 x 2 m, about the origin."""
ROOM = Room(TARGET.distance, 1.5)
"""A start far away is allowed whatever the stand-off."""


def scenario(**tables):
    return Scenario().replace(start={"position": (6.0, 0.0, 0.0)}).replace(**tables)


def plates(*normals, counted=None):
    """Patches of a square metre each, one for each normal."""
    n = len(normals)
    each = np.ones(2 * n, bool) if counted is None else np.array(counted)
    corners = np.zeros((n, 4, 3))
    units = np.array(normals, float).reshape(n, 3) / np.linalg.norm(normals, axis=-1, keepdims=True)
    return Patches(corners, np.full(n, 4), units, np.ones(n), np.zeros((n, 3)), np.zeros(n, int), each, 1.0)


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        (
            {"camera": {"greatest_range": 1.5}},
            ("camera.greatest_range: 1.5 m", "inspect.stand_off, 1.5 m", "more than that"),
        ),
        (
            {"inspect": {"stand_off": 5.0}, "camera": {"greatest_range": 4.0}},
            ("camera.greatest_range: 4 m", "inspect.stand_off, 5 m"),
        ),
        (
            {"camera": {"greatest_sample_distance": 0.001}},
            ("camera.greatest_sample_distance: 0.001 m", "from 1.5 m", "0.00169 m", "1733 pixels"),
        ),
        (
            {"camera": {"greatest_sample_distance": 0.002, "least_range": 3.0}},
            ("camera.greatest_sample_distance: 0.002 m", "from 3 m", "0.00338 m"),
        ),
        ({"inspect": {"patch_size": 16.0}}, ("inspect.patch_size: 16 m", "smaller patches")),
        (
            {"inspect": {"patch_size": 2.0}, "camera": {"greatest_sample_distance": 0.003}},
            ("inspect.patch_size: 2 m", "0.00319 m at best", "0.003 m"),
        ),
        ({"camera": {"period": 1.5}}, ("camera.period: 1.5 s", "whole control periods of 1 s")),
        ({"camera": {"period": 0.5}}, ("camera.period: 0.5 s", "whole control periods of 1 s")),
        ({"duration": 4.0}, ("duration: 4 s", "camera.period, 5 s")),
        (
            {"duration": 100.0, "inspect": {"hold_points": [{"position": (6, 0, 0), "seconds": 90}], "dwell": 20}},
            ("duration: 100 s", "take 110 s"),
        ),
        ({"light": {"direction": (1, 0, 0)}}, ("light.direction: [1.0, 0.0, 0.0]", 'light.kind is "none"')),
        ({"start": {"position": (3.4, 0, 0)}}, ("start.position: [3.4, 0.0, 0.0] m", "1.400 m", "inspect.stand_off")),
        (
            {"inspect": {"hold_points": [{"position": (9, 0, 0)}, {"position": (0, 0, 2)}]}},
            ("inspect.hold_points.1.position: [0.0, 0.0, 2.0] m", "1.000 m"),
        ),
        (
            {"duration": 10.0, "start": {"position": (42.0, 0, 0)}, "inspect": {"stand_off": 1.2}},
            ("duration: 10 s", "40 m from the target", "camera.greatest_range, 10 m", "300 s"),
        ),
        (
            {"duration": 2500.0, "inspect": {"hold_points": [{"position": (506.2, 0, 0), "seconds": 60}]}},
            ("duration: 2500 s", "take 60 s", "straight ways to the points 5000 s"),
        ),
        ({"inspect": {"patch_size": 1e-4}}, ("inspect.patch_size: 0.0001 m", "5.2e+09 patches", "0.00416 m at least")),
        (
            {"inspect": {"no_thrust_towards": [{"centre": (6.0, 0.2, 0), "radius": 0.5}]}},
            ("inspect.no_thrust_towards: 1 parts", "start.position, [6.0, 0.0, 0.0] m", "every thruster"),
        ),
    ],
)
def test_what_can_never_be_flown_is_refused_in_one_line_with_numbers(tables, said):
    with pytest.raises(InspectionError) as refusal:
        equipment.require_inspectable(scenario(**tables), TARGET)
    text = str(refusal.value)
    assert "\n" not in text
    for part in said:
        assert part in text


def test_what_can_be_flown_is_not_refused():
    equipment.require_inspectable(scenario(), TARGET)
    equipment.require_inspectable(scenario(camera={"greatest_sample_distance": 0.0018}), TARGET)
    held = [{"position": (0.0, 3.001, 0.0), "seconds": 10.0}]  # a millimetre beyond the stand-off
    equipment.require_inspectable(scenario(inspect={"hold_points": held}, duration=100.0), TARGET)


def test_a_part_that_only_some_plumes_reach_is_protected():
    part = [{"centre": (0.0, 0.0, 0.0), "radius": 1.0}]
    equipment.require_inspectable(scenario(inspect={"no_thrust_towards": part}), TARGET, room=ROOM)


def test_a_start_in_a_hollow_is_no_start_however_wide():
    hollow = Target.load("box", parameters={"length": 20.0, "width": 20.0, "height": 20.0})
    with pytest.raises(InspectionError, match=r"start\.position: \[0\.0, 1\.0, 0\.0\] m; no way that keeps"):
        equipment.require_inspectable(scenario(start={"position": (0.0, 1.0, 0.0)}), hollow)


def test_a_cloud_of_points_has_nothing_to_see(tmp_path):
    np.save(tmp_path / "cloud.npy", np.random.default_rng(0).uniform(-2.0, 2.0, (50, 3)))
    cloud = Target.load(tmp_path / "cloud.npy", thickness=0.1)
    with pytest.raises(InspectionError, match="cloud is a point cloud"):
        equipment.require_inspectable(scenario(), cloud)


def narrowest_cone(rays):
    """Half the angle of the narrowest cone that holds unit vectors: by all pairs and triples, as circles by points."""
    centres = [a + b for a, b in itertools.combinations(rays, 2)]
    centres += [np.cross(b - a, c - a) for a, b, c in itertools.combinations(rays, 3)]
    best = math.pi
    for centre in centres:
        if np.linalg.norm(centre) > 1e-12:
            for side in (centre, -centre):
                best = min(best, float(np.arccos(np.clip(rays @ side / np.linalg.norm(side), -1.0, 1.0)).max()))
    return best


@given(
    st.floats(0.05, 8.0),
    st.floats(0.02, 20.0),
    st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)),
    st.floats(0.0, 0.999),
)
@settings(max_examples=200, deadline=None)
def test_a_camera_that_sees_a_square_from_somewhere_is_never_refused(size, height, beside, least):
    """The limits are set to what one place has, found by brute force: it sees the square, so nothing contradicts."""
    place = np.array([beside[0] * height, beside[1] * height, height])
    corners = 0.5 * size * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    rays = corners - place
    ranges = np.linalg.norm(rays, axis=1)
    incidence = float(np.arccos(height / ranges).max())
    cone = 2.0 * narrowest_cone(rays / ranges[:, None])
    off = float(np.linalg.norm(np.maximum(np.abs(place) - [0.5 * size, 0.5 * size, 0.0], 0.0)))
    assume(incidence < math.radians(88.9) and 1e-3 < cone < math.radians(169.9))
    more = 1.0 + 1e-6
    pixel = 2.0 * math.tan(0.5 * cone * more) / 1024
    told = pixel * float((ranges**2 / height).max())
    equipment.require_inspectable(
        Scenario().replace(
            duration=1e5,
            start={"position": (1000.0, 0.0, 0.0)},
            inspect={"stand_off": off / more, "patch_size": size},
            camera={
                "field_of_view": cone * more,
                "least_range": max(least * float(ranges.min()), 1e-6),
                "greatest_range": float(ranges.max()) * more,
                "greatest_incidence": incidence * more,
                "greatest_sample_distance": told * more,
            },
        ),
        TARGET,
        room=ROOM,
    )


@given(st.floats(0.1, 3.0), st.floats(0.3, 20.0))
@settings(max_examples=100, deadline=None)
def test_straight_over_a_square_range_and_sample_distance_are_told_to_a_percent(size, height):
    """There they are least: with the stand-off at that height a percent less of either is refused."""
    far = math.sqrt(height**2 + 0.5 * size**2)
    assume(0.5 * size**2 < 0.9 * height**2)
    tight = {
        "inspect": {"stand_off": height, "patch_size": size},
        "start": {"position": (1000.0, 0.0, 0.0)},
        "duration": 1e5,
    }
    pixel = 2.0 * math.tan(math.radians(45.0)) / 1024
    wide = {"field_of_view": math.radians(90.0), "least_range": 1e-3}
    told = pixel * far**2 / height
    for camera, valid in (
        ({"greatest_range": 1.001 * far}, True),
        ({"greatest_range": 0.99 * far}, False),
        ({"greatest_range": 1e3, "greatest_sample_distance": 1.001 * told}, True),
        ({"greatest_range": 1e3, "greatest_sample_distance": 0.99 * told}, False),
    ):
        given_scenario = Scenario().replace(camera=wide | camera, **tight)
        if valid:
            equipment.require_inspectable(given_scenario, TARGET, room=ROOM)
        else:
            with pytest.raises(InspectionError, match=r"greatest_range|greatest_sample_distance|patch_size"):
                equipment.require_inspectable(given_scenario, TARGET, room=ROOM)


@pytest.mark.parametrize("errors", [{}, {"position_error": 0.1, "velocity_error": 0.01}])
def test_what_the_law_keeps_is_what_the_law_is_built_with(errors):
    flown, bound = scenario(guard=errors), 0.07
    ball, room = SphereField(jnp.zeros(3), jnp.asarray(2.0)), room_for_guard(flown, TARGET)
    law = law_on(flown, ball, bound, guidance=Straight(), from_start=False, **room)
    kept = equipment.law_keeps(flown, TARGET, bound)
    assert kept == pytest.approx(float(law.velocity.offset))
    equipment.require_stand_off(flown.replace(inspect={"stand_off": kept + 1e-9}), TARGET, bound)
    with pytest.raises(InspectionError, match=rf"inspect\.stand_off: .* guard keep {kept:.3f} m .*error 0\.070"):
        equipment.require_stand_off(flown.replace(inspect={"stand_off": kept - 1e-3}), TARGET, bound)


def test_a_light_edge_on_to_all_there_is_never_lights():
    plate = plates((0.0, 0.0, 1.0))
    dark = scenario(light={"kind": "fixed", "direction": (10.0, 0.0, 0.1)})
    with pytest.raises(InspectionError) as refusal:
        equipment.require_light(dark, Light.of(dark), plate)
    assert "light.greatest_incidence: 1.396 rad" in str(refusal.value)
    assert f"{math.atan2(10.0, 0.1):.4g} rad" in str(refusal.value)
    lit = scenario(light={"kind": "fixed", "direction": (10.0, 0.0, -3.0)})  # from below: the other side counts too
    equipment.require_light(lit, Light.of(lit), plate)
    outer = plates((0.0, 0.0, 1.0), counted=[True, False])
    with pytest.raises(InspectionError, match=r"light\.greatest_incidence"):
        equipment.require_light(lit, Light.of(lit), outer)
    none = scenario()
    equipment.require_light(none, Light.of(none), outer)


def test_a_flight_that_is_all_night_is_refused_and_one_into_the_morning_is_not():
    night = scenario(
        light={"kind": "sun"}, orbit={"semi_major_axis": 6.9e6}, sun={"direction": (-1, 0, 0)}, duration=300.0
    )
    sides = plates((1, 0, 0), (0, 1, 0), (0, 0, 1))
    with pytest.raises(InspectionError, match=r"Earth hides the sun for all of duration 300 s"):
        equipment.require_light(night, Light.of(night), sides)
    morning = night.replace(duration=2000.0)
    equipment.require_light(morning, Light.of(morning), sides)


def test_nothing_to_see_and_nothing_lit_are_refused_with_their_shares():
    sides = plates((1, 0, 0), (0, 1, 0), counted=[True, False, True, False])
    hidden = np.array([Verdict.HIDDEN, Verdict.SEEABLE, Verdict.UNDECIDED, Verdict.SEEABLE], np.int8)
    why = np.array([Hidden.ENCLOSED, Hidden.NOT, Hidden.NOT, Hidden.NOT], np.int8)
    none = np.zeros(4, bool)
    undecided = Seeable(sides, hidden, why, np.full((4, 3), np.nan), squares=7)
    with pytest.raises(InspectionError, match=r"inspect\.proof_squares: 7 of 4000000 .* 50\.0% are proved hidden"):
        equipment.require_something_to_see(scenario(), undecided, none)
    clocked = dataclasses.replace(undecided, by_clock=True)
    with pytest.raises(InspectionError, match=r"inspect\.proof_time, 0 s, ended it"):
        equipment.require_something_to_see(scenario(inspect={"proof_time": 0.0}), clocked, none)
    nothing = Seeable(sides, np.full(4, Verdict.HIDDEN, np.int8), why, np.full((4, 3), np.nan))
    with pytest.raises(InspectionError, match=r"of 2 m2, 50\.0% lie enclosed, 0\.0% show only"):
        equipment.require_something_to_see(scenario(), nothing, none)
    seen = np.array([Verdict.SEEABLE, Verdict.HIDDEN, Verdict.HIDDEN, Verdict.HIDDEN], np.int8)
    half = Seeable(sides, seen, why, np.zeros((4, 3)))
    with pytest.raises(InspectionError, match=r"light: none of the 50\.0% of 2 m2"):
        equipment.require_something_to_see(scenario(), half, np.array([False, True, False, False]))
    equipment.require_something_to_see(scenario(), half, np.array([True, False, False, False]))
    empty = Seeable(plates((1, 0, 0), counted=[False, False]), seen[:2], why[:2], np.zeros((2, 3)))
    with pytest.raises(InspectionError, match="no area that counts"):
        equipment.require_something_to_see(scenario(), empty, none[:2])


def test_patches_are_as_large_as_the_target_asks_unless_told():
    lengths = {0.8: 0.08, 2.5: 0.25, 79.0: 0.25, 81.0: 1.0}
    for length, size in lengths.items():
        body = Target("body", length * np.eye(3), np.array([[0, 1, 2]]), TARGET.report)
        assert equipment.patch_size(scenario(), body) == pytest.approx(size)
        assert equipment.patch_size(scenario(inspect={"patch_size": 0.4}), body) == 0.4


def test_frames_are_taken_from_the_start_to_the_last_whole_period():
    assert equipment.frame_times(scenario(duration=23.0)).tolist() == [0.0, 5.0, 10.0, 15.0, 20.0]
    assert equipment.frame_times(scenario(duration=25.0))[-1] == 25.0
    tenth = scenario(duration=1.0, control={"period": 0.1}, camera={"period": 0.3})
    assert equipment.frame_times(tenth) == pytest.approx([0.0, 0.3, 0.6, 0.9])


def test_the_camera_begins_at_rest_towards_the_middle():
    found = equipment.boresight_of(scenario(start={"position": (0.0, 6.0, 0.0)}), TARGET)
    np.testing.assert_allclose(found.direction, [0.0, -1.0, 0.0])
    assert not found.turning.any()
    assert (found.greatest_rate, found.greatest_acceleration) == (math.radians(1.0), 0.002)
