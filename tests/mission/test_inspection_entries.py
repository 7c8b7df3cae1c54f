"""The tables of an inspection: what is valid, what is refused, and that the camera's entries are the rules' ranges."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from keepout.errors import ScenarioError
from keepout.inspecting.equipment import rules_of
from keepout.mission.scenario import Scenario

BALL = {"centre": (0.0, 0.0, 0.0), "radius": 1.0}


@pytest.mark.parametrize(
    ("tree", "said"),
    [
        ({"camera": {"least_range": 5.0, "greatest_range": 5.0}}, ("camera", "least_range 5.0 m", "between them")),
        ({"camera": {"field_of_view": 3.0}}, ("camera.field_of_view", "3.0", "2.96")),
        ({"camera": {"field_of_view": 0.0}}, ("camera.field_of_view", "0.0", "greater than 0")),
        ({"camera": {"pixels": 7}}, ("camera.pixels", "7", "8")),
        ({"camera": {"greatest_incidence": 1.57}}, ("camera.greatest_incidence", "1.57", "1.55")),
        ({"camera": {"greatest_sample_distance": 0.0}}, ("camera.greatest_sample_distance", "0.0", "greater than 0")),
        ({"camera": {"period": 0.0}}, ("camera.period", "0.0", "greater than 0")),
        ({"camera": {"range": 5.0}}, ("camera.range", "no such entry", "did you mean")),
        ({"light": {"kind": "fixed"}}, ("light", 'kind = "fixed" needs direction')),
        ({"light": {"kind": "fixed", "direction": (0, 0, 0)}}, ("light", "[0, 0, 0]", "points nowhere")),
        ({"light": {"kind": "fixed", "direction": (0, math.inf, 0)}}, ("light.direction", "inf", "finite")),
        ({"light": {"greatest_incidence": 1.57}}, ("light.greatest_incidence", "1.57", "1.569")),
        ({"inspect": {"stand_off": 0.0}}, ("inspect.stand_off", "0.0", "greater than 0")),
        ({"inspect": {"patch_size": -0.1}}, ("inspect.patch_size", "-0.1", "greater than 0")),
        ({"inspect": {"coverage": 1.1}}, ("inspect.coverage", "1.1", "less than or equal to 1")),
        ({"inspect": {"tour": "random"}}, ("inspect.tour", "'random'", "'nearest'")),
        ({"inspect": {"objective": "delta-v"}}, ("inspect.objective", "'delta-v'", "'delta_v'")),
        ({"inspect": {"delta_v_worth": 5.0}}, ("inspect", "delta_v_worth 5.0", '"both"', '"time"')),
        ({"inspect": {"no_thrust_towards": [{"centre": (0, 0, 0)}]}}, ("no_thrust_towards.0", "centre and radius")),
        ({"inspect": {"no_thrust_towards": [{}]}}, ("no_thrust_towards.0", "nothing", "lower and upper")),
        ({"inspect": {"no_thrust_towards": [BALL | {"lower": (0, 0, 0)}]}}, ("no_thrust_towards.0", "of a ball, or")),
        (
            {"inspect": {"no_thrust_towards": [BALL, {"lower": (1, 0, 0), "upper": (0, 0, 0)}]}},
            ("no_thrust_towards.1", "lower [1.0, 0.0, 0.0] must not exceed upper"),
        ),
        ({"inspect": {"hold_points": [{"seconds": 5.0}]}}, ("inspect.hold_points.0.position",)),
        ({"inspect": {"hold_points": [{"position": (9, 0, 0), "seconds": 0}]}}, ("hold_points.0.seconds", "0")),
    ],
)
def test_bad_entries_are_named_with_value_and_range(tree, said):
    with pytest.raises(ScenarioError) as refusal:
        Scenario.parse(tree)
    text = str(refusal.value)
    assert "\n" not in text
    for part in said:
        assert part in text


cameras = st.fixed_dictionaries(
    {
        "field_of_view": st.floats(1e-6, math.radians(170.0)),
        "pixels": st.integers(8, 65536),
        "least_range": st.floats(1e-6, 4e5),
        "greatest_range": st.floats(4.1e5, 1e6),
        "greatest_incidence": st.floats(1e-6, math.radians(89.0)),
        "greatest_sample_distance": st.none() | st.floats(1e-9, 1e9),
    }
)


@given(cameras, st.floats(1e-6, math.radians(89.9)))
def test_every_valid_camera_is_a_rule_with_its_numbers(camera, sun):
    rules = rules_of(Scenario.parse({"camera": camera, "light": {"greatest_incidence": sun}}))
    for name, value in camera.items():
        assert getattr(rules, name) == (math.inf if value is None else value)
    assert rules.greatest_sun_incidence == sun


def test_the_defaults_are_the_rules_own():
    from keepout.seeing.rules import SeeingRules

    assert rules_of(Scenario()) == SeeingRules()


def test_tables_survive_a_file(tmp_path):
    path = tmp_path / "mission.toml"
    path.write_text(
        '[light]\nkind = "fixed"\ndirection = [0, 0, 2]\n[inspect]\ncoverage = 0.9\n'
        "[[inspect.hold_points]]\nposition = [20, 0, 0]\n"
        "[[inspect.no_thrust_towards]]\ncentre = [0, 5, 0]\nradius = 0.5\n"
        "[[inspect.no_thrust_towards]]\nlower = [0, 0, 0]\nupper = [1, 1, 1]\n"
    )
    scenario = Scenario.load(path)
    assert [hold.seconds for hold in scenario.inspect.hold_points] == [60.0]
    assert [kept.radius for kept in scenario.inspect.no_thrust_towards] == [0.5, None]
    assert Scenario.parse(scenario.model_dump()) == scenario
    path.write_text("[inspect]\nstand_off = 2.0\n[[inspect.hold_points]]\nposition = [20, 0]\n")
    with pytest.raises(ScenarioError, match=r"line 4: inspect\.hold_points\.0\.position"):
        Scenario.load(path)
