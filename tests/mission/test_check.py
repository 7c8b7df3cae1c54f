"""`keepout scenario check`: conditions with margins, estimates, refusals, and nearest values that are not refused."""

import math
from pathlib import Path

import numpy as np
import pytest
from truths.command_line import keepout_command

from keepout.errors import KeepoutError
from keepout.fields.shipped import load_shipped
from keepout.geometry.target import Target
from keepout.mission.build import prepare
from keepout.mission.check import check
from keepout.mission.entry_names import with_entries
from keepout.mission.nearest import nearest_number, nearest_place, number_refusal
from keepout.mission.scenario import Scenario

EXAMPLES = Path(__file__).parents[2] / "examples"
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def target():
    return Target.load("intelsat30")


@pytest.fixture(scope="module")
def model():
    return load_shipped("intelsat30")


def straight(**entries) -> Scenario:
    return Scenario.parse({"control": {"guidance": "straight"}, "duration": 400.0} | entries)


def test_what_would_be_flown(target, model):
    scenario = straight()
    found = check(scenario, target=target, model=model)
    assert found.flies
    mission = prepare(scenario, target=target, model=model)
    assert found.conditions == mission.setup.controller.conditions
    assert found.start_certified is mission.start_certified is True
    summary = found.summary()
    for row in summary["conditions"]:
        assert row["margin"] == pytest.approx(abs(row["value"] - row["limit"]) * (1 if row["satisfied"] else -1))
    assert any("20 kg" in words and "intelsat30" in words for words in found.words)
    # The disturbance by quadrature of its closed form, m/s; the speeds by what the guidance may reach.
    t = np.arange(400.0)
    push = np.sqrt(1.0 + np.sin(0.01 * t) ** 2) * 0.01 / 20.0
    expected = summary["expected"]
    assert expected["disturbance_delta_v_mps"] == pytest.approx(push.sum(), rel=1e-9)
    assert expected["speed_delta_v_mps"] == pytest.approx(0.2, rel=1e-3)
    apart = math.dist(scenario.start.position, scenario.goal.position)
    assert expected["way_m"] is None or expected["way_m"] > apart - 0.2


def test_too_short_a_flight_is_remarked(target, model):
    found = check(straight(duration=50.0, goal={"position": (0.0, 12.0, 14.0)}), target=target, model=model)
    assert found.flies
    assert found.expected is not None
    assert found.expected.way == pytest.approx(math.hypot(2.0, 8.0), abs=0.2)
    [remark] = [remark for remark in found.remarks if remark.startswith("duration 50 s is shorter")]
    enough = float(remark.split("duration = ")[1].split()[0])
    assert enough > (found.expected.duration or math.inf)


@pytest.mark.parametrize(
    ("entries", "entry"),
    [
        ({"chaser": {"speed_limit": 0.5}}, "chaser.speed_limit"),
        ({"chaser": {"force_limit": 0.01}}, "chaser.force_limit"),
        ({"guard": {"position_error": 30.0}}, "guard.position_error"),
        ({"attitude": {"kind": "tumbling", "angular_velocity": (0.0, 0.0, 0.02)}}, "chaser.force_limit"),
    ],
)
def test_the_nearest_number_is_not_refused_and_nearly_nothing_beyond_is(entries, entry, target, model):
    scenario = straight(**entries)
    found = check(scenario, target=target, model=model)
    assert not found.flies
    [refusal] = found.refusals
    with pytest.raises(KeepoutError):
        prepare(scenario, target=target, model=model)
    near = {nearest.entry: nearest.value for nearest in refusal.nearest}
    value, was = float(near[entry]), float(_entry(scenario, entry))  # pyright: ignore[reportArgumentType]
    assert number_refusal(with_entries(scenario, {entry: value}), target) is None
    beyond = value + 0.02 * (was - value) if abs(was - value) < abs(value) else value * (1.02 if was > value else 0.98)
    assert number_refusal(with_entries(scenario, {entry: beyond}), target) is not None


def _entry(scenario: Scenario, name: str):
    table, key = name.split(".")
    return getattr(getattr(scenario, table), key)


@pytest.mark.parametrize("name", ["start", "goal"])
@pytest.mark.parametrize("place", [(0.0, 0.5, 0.0), (0.0, 1.8, 0.0)])
def test_the_nearest_place_is_flown_from(name, place, target, model):
    scenario = straight(**{name: {"position": place}})
    found = check(scenario, target=target, model=model)
    [refusal] = found.refusals
    [near] = refusal.nearest
    assert near.entry == f"{name}.position"
    mended = scenario.replace(**{name: {"position": near.value}})
    prepare(mended, target=target, model=model)
    assert isinstance(near.value, tuple)
    assert math.dist(near.value, place) < 4.0
    assert target.distance.distance(np.array([near.value]))[0] > 0.6


def test_several_refusals_are_told_at_once(target, model):
    inside = {"position": (0.0, 1.8, 0.0)}
    found = check(straight(chaser={"speed_limit": 0.5}, start=inside, goal=inside), target=target, model=model)
    said = [refusal.said for refusal in found.refusals]
    assert len(said) == 3
    assert "speed_limit" in said[0]
    assert said[1].startswith("start.position")
    assert said[2].startswith("goal.position")
    assert all(refusal.nearest for refusal in found.refusals)


def test_a_radius_without_a_certificate_has_a_nearest_one(target, model):
    [refusal] = check(straight(chaser={"radius": 0.77}), target=target, model=model).refusals
    assert [(near.entry, near.value) for near in refusal.nearest] == [("chaser.radius", 0.5)]


def test_the_command_says_it_and_fails(tmp_path):
    path = tmp_path / "fast.toml"
    path.write_text("[chaser]\nspeed_limit = 0.5\n", encoding="utf-8")
    answer = keepout_command("scenario", "check", path)
    assert answer.code == 1
    assert "refused: speed_limit: 0.5 m/s cannot be stopped" in answer.out.replace("\n", " ")
    assert "would do: chaser.speed_limit at most 0.1" in answer.out
    assert "It would not be flown." in answer.out
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_is_no_scenario_is_one_line(tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text("[chaser]\nmasss = 3\n", encoding="utf-8")
    answer = keepout_command("scenario", "check", path)
    assert answer.code == 1
    assert answer.out == ""
    assert answer.err == f"keepout: {path}: line 2: chaser.masss: no such entry; did you mean mass?\n"


@pytest.mark.parametrize("boundary", [1e-6, 0.0312, 0.5, 7.0, 123.4])
def test_bisection_finds_a_known_boundary(boundary):
    found = nearest_number(lambda x: x > boundary, 200.0, 1e-9)
    assert found is not None
    assert 0.98 * boundary <= found <= boundary
    found = nearest_number(lambda x: x < boundary, 1e-9, 1e4)
    assert found is not None
    assert boundary <= found <= 1.02 * boundary
    assert nearest_number(lambda x: True, 1.0, 2.0) is None


def test_the_search_for_a_place_finds_the_surface_of_a_ball():
    found = nearest_place(lambda points: np.linalg.norm(points, axis=1) > 3.0, np.array([0.0, 0.0, 2.0]), 20.0)
    assert found is not None
    assert 3.0 < np.linalg.norm(found) < 3.02
    assert math.dist(found, (0.0, 0.0, 2.0)) < 1.3
    assert nearest_place(lambda points: np.zeros(len(points), bool), np.zeros(3), 5.0) is None
