"""field.source = "grid": the law flies by exact distances where no field was learned."""

import itertools

import numpy as np
import pytest

from keepout.control.tuning import least_offset
from keepout.errors import FieldError
from keepout.fields.evaluate import values
from keepout.geometry.target import Target
from keepout.mission.assumptions import guard_numbers
from keepout.mission.build import build_guard, load_model
from keepout.mission.first_look import require_certified, require_files
from keepout.mission.flight import fly
from keepout.mission.law import room_for_guard
from keepout.mission.scenario import Scenario
from keepout.mission.target import load_target

HALF = np.array([2.0, 1.5, 1.0])
"""Of the built-in box, m."""


def test_it_is_the_exact_distance_less_a_little_and_certified_for_the_chaser():
    scenario = Scenario.parse({"target": {"source": "box"}, "field": {"source": "grid"}})
    require_files(scenario)
    require_certified(scenario)
    model = load_model(scenario, load_target(scenario.target))
    assert model.certificate(scenario.chaser.radius).kind == "certified"
    generator = np.random.default_rng(0)
    points = generator.uniform(-6.0, 6.0, (4000, 3))
    apart = np.linalg.norm(np.maximum(np.abs(points) - HALF, 0.0), axis=1)
    error = values(model.field, points) - apart
    outside, near = apart > 0.3, (apart > 0.3) & (apart < 1.5)
    assert error[outside].max() < 0.02
    assert error[near].min() > -0.1
    assert np.median(np.abs(error[near])) < 0.05


def test_without_a_shipped_field_the_refusal_names_it():
    scenario = Scenario.parse({"target": {"source": "box"}})
    with pytest.raises(FieldError, match='"grid"'):
        require_files(scenario)
    with pytest.raises(FieldError, match='"grid"'):
        load_model(scenario, load_target(scenario.target))


def test_a_scenario_file_keeps_the_word(tmp_path):
    path = tmp_path / "mission.toml"
    path.write_text('[target]\nsource = "box"\n[field]\nsource = "grid"\n')
    assert Scenario.load(path).field.source == "grid"


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
    plain, guard = build_guard(HOSTILE, target), build_guard(kept, target)
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
        room, bound = room_for_guard(scenario, target), load_model(scenario, target).certificate(0.5).error_bound
        own = least_offset(scenario.chaser.speed_limit, scenario.control.period)
        law_keeps = bound + 0.5 + margin + room.get("nominal_offset", own)
        assert law_keeps > build_guard(scenario, target).least_value


@pytest.mark.long
def test_no_hostile_law_comes_inside_a_margin_that_the_guard_keeps():
    least = {}
    for law, keeps in itertools.product(("into the body", "through", "bang-bang"), (True, False)):
        flight = fly(HOSTILE.replace(faults={"law": law}, guard={"keeps_margin": keeps}))
        assert flight.start_certified
        assert flight.guard_flags() == {}
        least[law, keeps] = flight.audit.minimum_clearance
    assert all(clearance > (0.1 if keeps else 0.0) for (_, keeps), clearance in least.items())
    assert min(least.values()) < 0.1
