"""From a scenario's entries to what flies."""

import numpy as np
import pytest
import trimesh

from keepout.core.control.profiles import ControlWarning, least_offset
from keepout.core.errors import ControlError, FieldError
from keepout.core.fields import load_shipped
from keepout.core.fields.field import values
from keepout.core.geometry.target import Target
from keepout.core.mission.build import build_guard, fly, load_model, prepare
from keepout.core.mission.first_look import require_certified, require_files
from keepout.core.mission.law import build_law, room_for_guard
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings, guard_numbers
from keepout.core.mission.target import load_target

pytestmark = pytest.mark.long


def test_the_body_frame_is_the_users(tmp_path):
    path = tmp_path / "box.stl"
    trimesh.creation.box(extents=(4.0, 3.0, 2.0)).export(path)
    quarter_turn = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    entry = {"source": str(path), "units": "m", "rotation": quarter_turn, "origin": [1.0, 0.0, 0.0]}
    target = load_target(Scenario.parse({"target": entry}).target)
    # File x spans -2 to 2; about an origin at x = 1 it spans -3 to 1, and the turn takes it to body y.
    np.testing.assert_allclose(target.vertices.min(axis=0), [-1.5, -3.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(target.vertices.max(axis=0), [1.5, 1.0, 1.0], atol=1e-12)


@pytest.mark.parametrize(
    ("target", "goal", "said"),
    [
        ("box", (0.0, 0.0, 0.0), r"no gap of more than 0\.5 m leads there from outside"),
        ("iss", (-52.7, 0.0, 0.0), r"at least {:.3f} m needed\)"),
    ],
)
def test_a_goal_is_refused_with_the_reason(target, goal, said, monkeypatch):
    monkeypatch.setattr("keepout.core.mission.target.is_enclosed", lambda *_: False)  # as of a mesh with a crack
    scenario = Scenario.parse(
        {"target": {"source": target}, "start": {"position": [-60.0, 0.0, 20.0]}, "goal": {"position": goal}}
    ).replace(field={"source": "grid" if target == "box" else "shipped"})
    if target == "iss":
        # The chaser's radius, the default margin, and what its shipped field over-states.
        said = said.format(0.5 + 0.22 + load_shipped(target).certificate(0.5).error_bound)
    with pytest.raises(ControlError, match=rf"goal: .* inside the keep-out zone .*{said}.*") as refused:
        prepare(scenario)
    assert str(refused.value).count("; ") == (0 if "needed" in said else 1)


def test_what_the_paper_leaves_unprinted_reaches_its_law():
    unprinted = {"slowing_length": 20.0, "sharpness": 3.0, "position_weight": 0.5, "gradient_error": 0.2}
    scenario = Scenario().replace(control={"profile": "paper", "paper": unprinted})
    with pytest.warns(ControlWarning):
        law = build_law(scenario, load_shipped("intelsat30"))
    reached = (law.velocity.guidance.slowing_length, law.tracking.sharpness, law.tracking.position_weight[0, 0])
    assert [float(number) for number in (*reached, law.tracking.gradient_error)] == list(unprinted.values())


def test_a_grid_is_certified_for_the_chaser():
    scenario = Scenario.parse({"target": {"source": "box"}, "field": {"source": "grid"}})
    require_files(scenario)
    require_certified(scenario)
    assert load_model(scenario, load_target(scenario.target)).certificate(scenario.chaser.radius).kind == "certified"


def test_without_a_shipped_field_the_refusal_names_it():
    scenario = Scenario.parse({"target": {"source": "box"}})
    for ask in (require_files, lambda scenario: load_model(scenario, load_target(scenario.target))):
        with pytest.raises(FieldError, match='"grid"'):
            ask(scenario)


HOSTILE = Scenario().replace(
    target={"source": "box"},
    field={"source": "grid"},
    start={"position": (0.0, 0.0, 4.0)},
    goal={"position": (0.0, 0.0, -4.0)},
    duration=200.0,
)


def test_nothing_within_the_margin_is_above_a_threshold_that_keeps_it():
    target, radius = Target.load("box"), HOSTILE.chaser.radius
    kept = HOSTILE.replace(guard={"keeps_margin": True}, safety={"margin": 0.3})
    plain, guard = build_guard(Surroundings(HOSTILE, target)), build_guard(Surroundings(kept, target))
    lower, upper = target.vertices.min(axis=0) - 1.5, target.vertices.max(axis=0) + 1.5
    points = np.random.default_rng(0).uniform(lower, upper, (40_000, 3))
    away = target.distance.distance(points)
    near = points[(away > radius) & (away <= radius + 0.3)]
    said = values(guard.field, near)
    assert len(near) > 1000
    assert said.max() <= guard.threshold
    # The margin as it is would not be enough where the field rises faster than the distance.
    assert guard.threshold > plain.threshold + 0.3 * guard.lipschitz
    assert guard_numbers(guard, kept)["margin_kept_m"] == 0.3
    assert guard_numbers(plain, HOSTILE)["margin_kept_m"] == 0.0


def test_the_law_leads_to_no_goal_that_the_guard_does_not_let_it_rest_at():
    """The goal comes nearer until it is refused; the guard never is the one that refuses it."""
    for keeps, margin in ((False, 0.1), (True, 0.1), (True, 0.4)):
        scenario = HOSTILE.replace(guard={"keeps_margin": keeps}, safety={"margin": margin})
        target = Target.load("box")
        around = Surroundings(scenario, target)
        room, bound = room_for_guard(around), load_model(scenario, target).certificate(0.5).error_bound
        own = least_offset(scenario.chaser.speed_limit, scenario.control.period)
        law_keeps = bound + 0.5 + margin + room.get("nominal_offset", own)
        assert law_keeps > build_guard(around).least_value


@pytest.mark.slow  # that nothing within the margin is above the threshold is held above
@pytest.mark.parametrize("law", ["through", "into the body", "bang-bang"])
def test_no_hostile_law_comes_inside_a_margin_that_the_guard_keeps(law):
    least = []
    for keeps in (True, False):
        flight = fly(HOSTILE.replace(faults={"law": law}, guard={"keeps_margin": keeps}))
        assert flight.start_certified
        assert flight.guard_flags() == {}
        least.append(flight.audit.minimum_clearance)
    assert least[0] > 0.1
    assert least[1] > 0.0
    assert law != "through" or least[1] < 0.1  # so that the margin says something
