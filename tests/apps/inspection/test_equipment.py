"""What a scenario says of inspecting as objects, and what is refused before anything flies."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
import pytest
from truths.box_problems import room

from keepout.apps.inspection import problem as equipment
from keepout.apps.inspection.light import Light
from keepout.apps.inspection.seeing.patches import Patches
from keepout.apps.inspection.seeing.seeable import Hidden, Seeable, Verdict
from keepout.core.control.guidance import Straight
from keepout.core.errors import InspectionError
from keepout.core.fields.own import SphereField
from keepout.core.geometry.target import Target
from keepout.core.mission.law import law_on, room_for_guard
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings

TARGET = Target.load("box")
"""4 x 3 x 2 m, about the origin."""


def scenario(**tables):
    return Scenario().replace(start={"position": (6.0, 0.0, 0.0)}).replace(**tables)


def plates(*normals, counted=None):
    """Patches of a square metre each, one for each normal."""
    n = len(normals)
    each = np.ones(2 * n, bool) if counted is None else np.array(counted)
    corners = np.zeros((n, 4, 3))
    units = np.array(normals, float).reshape(n, 3) / np.linalg.norm(normals, axis=-1, keepdims=True)
    return Patches(corners, np.full(n, 4), units, np.ones(n), np.zeros((n, 3)), np.zeros(n, int), each, 1.0)


def held(*positions, seconds=60.0):
    return {"hold_points": [{"position": position, "seconds": seconds} for position in positions]}


FINE, BLOWN = {"greatest_sample_distance": 0.003}, {"centre": (6.0, 0.2, 0), "radius": 0.5}


@pytest.mark.long
@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"camera": {"greatest_range": 1.5}}, ("camera.greatest_range: 1.5 m", "inspect.stand_off, 1.5 m")),
        ({"camera": {"greatest_sample_distance": 0.001}}, ("camera.greatest_sample_distance: 0.001 m", "0.00169 m")),
        ({"inspect": {"patch_size": 16.0}}, ("inspect.patch_size: 16 m", "smaller patches")),
        ({"inspect": {"patch_size": 2.0}, "camera": FINE}, ("inspect.patch_size: 2 m", "0.00319 m at best")),
        ({"inspect": {"patch_size": 1e-4}}, ("inspect.patch_size: 0.0001 m", "0.00416 m at least")),
        ({"camera": {"period": 1.5}}, ("camera.period: 1.5 s", "whole control periods of 1 s")),
        ({"duration": 4.0}, ("duration: 4 s", "camera.period, 5 s")),
        ({"duration": 100.0, "inspect": held((6, 0, 0), seconds=90) | {"dwell": 20}}, ("duration: 100 s", "110 s")),
        ({"light": {"direction": (1, 0, 0)}}, ("light.direction: [1.0, 0.0, 0.0]", 'light.kind is "none"')),
        ({"start": {"position": (3.4, 0, 0)}}, ("start.position: [3.4, 0.0, 0.0] m", "inspect.stand_off")),
        ({"inspect": held((9, 0, 0), (0, 0, 2))}, ("inspect.hold_points.1.position: [0.0, 0.0, 2.0] m", "1.000 m")),
        ({"duration": 10.0, "start": {"position": (42.5, 0, 0)}}, ("duration: 10 s", "camera.greatest_range, 10 m")),
        ({"duration": 2500.0, "inspect": held((506.2, 0, 0))}, ("duration: 2500 s", "straight ways to the points")),
        ({"inspect": {"no_thrust_towards": [BLOWN]}}, ("no_thrust_towards: 1 parts", "every thruster")),
    ],
)
def test_what_can_never_be_flown_is_refused_in_one_line_with_numbers(tables, said):
    with pytest.raises(InspectionError) as refusal:
        equipment.require_inspectable(scenario(**tables), TARGET)
    assert "\n" not in str(refusal.value)
    assert all(part in str(refusal.value) for part in said), refusal.value


@pytest.mark.long
@pytest.mark.parametrize(
    "tables",
    [
        {},
        {"camera": {"greatest_sample_distance": 0.0018}},
        # A millimetre beyond the stand-off.
        {"inspect": held((0.0, 3.001, 0.0), seconds=10.0), "duration": 100.0},
        # A part that only some plumes reach.
        {"inspect": {"no_thrust_towards": [{"centre": (0.0, 0.0, 0.0), "radius": 1.0}]}},
    ],
)
def test_what_can_be_flown_is_not_refused(tables):
    # A start far away is allowed whatever the stand-off.
    equipment.require_inspectable(scenario(**tables), TARGET, room=room(1.5))


@pytest.mark.long
def test_a_start_in_a_hollow_is_no_start_however_wide():
    hollow = Target.load("box", parameters={"length": 20.0, "width": 20.0, "height": 20.0})
    with pytest.raises(InspectionError, match=r"start\.position: \[0\.0, 1\.0, 0\.0\] m; no way that keeps"):
        equipment.require_inspectable(scenario(start={"position": (0.0, 1.0, 0.0)}), hollow)


@pytest.mark.parametrize("errors", [{}, {"position_error": 0.1, "velocity_error": 0.01}])
def test_what_the_law_keeps_is_what_the_law_is_built_with(errors):
    flown, bound = scenario(guard=errors), 0.07
    ball, room = SphereField(jnp.zeros(3), jnp.asarray(2.0)), room_for_guard(Surroundings(flown, TARGET))
    law = law_on(flown, ball, bound, guidance=Straight(), from_start=False, **room)
    kept = equipment.require_stand_off(flown.replace(inspect={"stand_off": 10.0}), TARGET, bound)
    assert kept == pytest.approx(float(law.velocity.offset))
    equipment.require_stand_off(flown.replace(inspect={"stand_off": kept + 1e-9}), TARGET, bound)
    with pytest.raises(InspectionError, match=rf"inspect\.stand_off: .* guard keep {kept:.3f} m .*error 0\.070"):
        equipment.require_stand_off(flown.replace(inspect={"stand_off": kept - 1e-3}), TARGET, bound)


def test_a_light_edge_on_to_all_there_is_never_lights():
    plate = plates((0.0, 0.0, 1.0))
    dark = scenario(light={"kind": "fixed", "direction": (10.0, 0.0, 0.1)})
    with pytest.raises(InspectionError) as refusal:
        equipment.require_light(dark, Light(dark), plate)
    assert f"{math.atan2(10.0, 0.1):.4g} rad" in str(refusal.value)
    lit = scenario(light={"kind": "fixed", "direction": (10.0, 0.0, -3.0)})  # from below: the other side counts too
    equipment.require_light(lit, Light(lit), plate)
    outer = plates((0.0, 0.0, 1.0), counted=[True, False])
    with pytest.raises(InspectionError, match=r"light\.greatest_incidence"):
        equipment.require_light(lit, Light(lit), outer)
    none = scenario()
    equipment.require_light(none, Light(none), outer)


def test_a_flight_that_is_all_night_is_refused_and_one_into_the_morning_is_not():
    night = scenario(
        light={"kind": "sun"}, orbit={"semi_major_axis": 6.9e6}, sun={"direction": (-1, 0, 0)}, duration=300.0
    )
    sides = plates((1, 0, 0), (0, 1, 0), (0, 0, 1))
    with pytest.raises(InspectionError, match=r"Earth hides the sun for all of duration 300 s"):
        equipment.require_light(night, Light(night), sides)
    morning = night.replace(duration=2000.0)
    equipment.require_light(morning, Light(morning), sides)


SIDES = plates((1, 0, 0), (0, 1, 0), counted=[True, False, True, False])
WHY = np.array([Hidden.ENCLOSED, Hidden.NOT, Hidden.NOT, Hidden.NOT], np.int8)


def judged(*verdicts, of=SIDES, **more):
    number = len(verdicts)
    return Seeable(of, np.array(verdicts, np.int8), WHY[:number], np.full((number, 3), np.nan), **more)


UNDECIDED = judged(Verdict.HIDDEN, Verdict.SEEABLE, Verdict.UNDECIDED, Verdict.SEEABLE, squares=7)
HALF = judged(Verdict.SEEABLE, Verdict.HIDDEN, Verdict.HIDDEN, Verdict.HIDDEN)


@pytest.mark.parametrize(
    ("found", "lit", "said"),
    [
        (UNDECIDED, [], r"inspect\.proof_squares: 7 of 4000000 .* 50\.0% are proved hidden"),
        (dataclasses.replace(UNDECIDED, by_clock=True), [], r"inspect\.proof_time, 0 s, ended it"),
        (judged(*[Verdict.HIDDEN] * 4), [], r"of 2 m2, 50\.0% lie enclosed, 0\.0% show only"),
        (HALF, [1], r"light: none of the 50\.0% of 2 m2"),
        (judged(*[Verdict.SEEABLE] * 2, of=plates((1, 0, 0), counted=[False] * 2)), [], "no area that counts"),
    ],
)
def test_nothing_to_see_and_nothing_lit_are_refused_with_their_shares(found, lit, said):
    mission = scenario(inspect={"proof_time": 0.0} if found.by_clock else {})
    with pytest.raises(InspectionError, match=said):
        equipment.require_something_to_see(mission, found, np.isin(np.arange(len(found.verdict)), lit))
    equipment.require_something_to_see(mission, HALF, np.array([True, False, False, False]))


def test_frames_are_taken_from_the_start_to_the_last_whole_period():
    assert equipment.frame_times(scenario(duration=23.0)).tolist() == [0.0, 5.0, 10.0, 15.0, 20.0]
    assert equipment.frame_times(scenario(duration=25.0))[-1] == 25.0
